"""Runs of kriging: what is in their folders, the command, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from calling import contents, scored_again_as_before, stored
from commands import Command, positions_file, rows_of
from made_waves import SIZE, wave_record

from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.folder import FORMAT
from wrf_mi.tasks.scores import inside_interval, ssim

QUICK = ("directions=20", "lengths=2")
"""Of spectra: a fit of a second."""
FILES = {"config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"}
ROUNDING = 1e-5
"""Predictions are float32."""


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra at two receivers, 36 rows in two folds."""
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "waves", wave_record(36, 10))


@pytest.fixture(scope="module")
def run(waves: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(waves, "kriging", out=tmp_path_factory.mktemp("runs") / "run", settings=QUICK).folder


def test_run_folder_holds_model_and_standard_deviation(waves: Path, run: Path) -> None:
    assert contents(run) == FILES
    config = yaml.safe_load((run / "config.yaml").read_text())
    known = {"model": "kriging", "dataset": str(waves), "scene": None, "split": "official", "n_train": None, "seed": 0}
    known |= {"format": FORMAT, "task": "spectrum", "material": None, "deterministic": False}
    assert known.items() <= config.items()
    assert (config["settings"]["directions"], config["settings"]["lengths"]) == (20, 2)
    record, arrays = load(waves), stored(run)
    assert record.official is not None
    np.testing.assert_array_equal(arrays["row"], record.official[1])
    assert arrays["std"].shape == arrays["prediction"].shape == (2, 10, *SIZE)
    assert arrays["std"].dtype == np.float32
    assert arrays["std"].min() > 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["model"], metrics["task"], metrics["n_train"], metrics["n_test"]) == ("kriging", "spectrum", 26, 10)
    assert metrics["ssim"]["median"] == pytest.approx(np.median(ssim(arrays["prediction"], arrays["truth"])))
    assert metrics["ssim"]["median"] > metrics["reference"]["idw4"]["median"]
    inside = inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])
    assert metrics["inside_90"] == pytest.approx(inside)
    assert 0.5 < inside < 1
    assert set(metrics["receivers"]) == {"one", "two"}
    assert [fitted["parts"] for fitted in metrics["fitted"]] == ["signals, nearby"] * 2
    assert metrics["train_seconds"] > 0
    assert metrics["peak_memory_mb"] > 10


def test_command_trains_as_the_function_does(waves: Path, run: Path, tmp_path: Path, command: Command) -> None:
    out, settings = tmp_path / "run", [part for setting in QUICK for part in ("--set", setting)]
    status, table, err = command(["train", waves, "--model", "kriging", "--out", out, *settings])
    assert status == 0, err
    lines = table.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["SSIM", "kriging", "IDW"]
    assert "of the test values lie inside the predicted 90 % intervals, continuous ranked" in lines[3]
    assert lines[-1] == f"results: {out}"
    assert "one: element signals of spectra" in err.splitlines()
    for name in ("prediction", "std"):
        np.testing.assert_allclose(stored(out)[name], stored(run)[name], atol=ROUNDING)


def test_evaluation_reproduces_the_scores(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scored_again_as_before(run, capsys)


def test_predictions_at_new_positions_have_standard_deviations(run: Path, tmp_path: Path, command: Command) -> None:
    held_out = stored(run)
    arrays = command.predicted(run, positions_file(tmp_path / "tx.csv", held_out["tx_pos"]))
    assert arrays["std"].shape == (2, 10, *SIZE)
    for name in ("prediction", "std"):
        np.testing.assert_allclose(arrays[name], held_out[name], atol=ROUNDING)
    assert arrays["receiver_name"].tolist() == ["one", "two"]
    # How the transmitter is turned changes no spectrum: a model that cannot use it says so.
    out = ["--out", tmp_path / "out.npz"]
    for option, name, content, message in (
        ("--tx", "turned.csv", "x,y,z,heading_rad\n0,0,0,0.5\n", "does not know how the transmitter is turned"),
        ("--tx", "nan.csv", "x,y,z,heading_rad\n0,0,0,nan\n", "row 1: heading_rad is 'nan'; give a finite number"),
        ("--tx", "short.csv", "x,y,z,heading_rad\n0,0,0\n", "row 1: 3 fields, but the header has 4"),
        ("--input", "turned.npz", None, "omit heading_rad"),
    ):
        if content is None:
            positions_file(tmp_path / name, np.zeros((3, 3)), np.zeros(3))
        else:
            (tmp_path / name).write_text(content)
        command.refused(["predict", run, option, tmp_path / name, *out], message)
    assert not (tmp_path / "out.npz").exists()


def test_heading_changes_signal_strengths(flat_folder: Path, tmp_path: Path, command: Command) -> None:
    run, record = train(flat_folder, "kriging", out=tmp_path / "run"), load(flat_folder)
    held_out = stored(run.folder)
    assert record.tx_heading_rad is not None
    assert run.metrics["task"] == "rssi"
    assert 0.5 < run.metrics["inside_90"] <= 1
    heading = record.tx_heading_rad[held_out["row"]]
    turned = command.predicted(run.folder, positions_file(tmp_path / "turned.npz", held_out["tx_pos"], heading))
    without = command.predicted(run.folder, positions_file(tmp_path / "tx.npz", held_out["tx_pos"]))
    np.testing.assert_allclose(turned["prediction"], held_out["prediction"], atol=1e-3)
    assert np.abs(without["prediction"] - held_out["prediction"]).max() > 0.01
    assert without["std"].shape == without["prediction"].shape == (2, 6)


def test_standard_deviations_of_folds_are_pooled(waves: Path, tmp_path: Path) -> None:
    run = train(waves, "kriging", out=tmp_path / "run", split="blocked", settings=QUICK)
    arrays = stored(run.folder)
    assert run.metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])


def test_comparison_shows_kriging_and_reference(run: Path, tmp_path: Path) -> None:
    assert "inside 90 %" in compare([run], tmp_path / "page").read_text()
    rows = rows_of(tmp_path / "page" / "compare.csv")
    assert [row["model"] for row in rows] == ["kriging", "idw4", "constant"]
    assert float(rows[0]["inside_90"]) == json.loads((run / "metrics.json").read_text())["inside_90"]
    assert rows[1]["inside_90"] == ""
    assert (tmp_path / "page" / "waves-samples.png").is_file()


def test_bad_calls_are_refused(waves: Path, run: Path, tmp_path: Path, command: Command) -> None:
    out = ["--out", tmp_path / "out"]
    train = ["train", waves, *out, "--model", "kriging"]
    for words, message in (
        ([*train, "--seed", -1], "seed -1"),
        ([*train, "--set", "lengths=0"], "setting lengths: 0 is out of range, choose 1 or more"),
        ([*train, "--set", "lengths=many"], "expected int, got 'many'"),
        ([*train, "--material", "x"], "--material and antenna options belong to a scene that is traced; give --scene"),
        ([*train, "--scene", tmp_path / "none.xml"], "takes no scene; omit --scene"),
        ([*train[:-1], "ray-tracing"], "needs a scene; give --scene SCENE, or choose kriging"),
        ([*train, "--depth", 2], "--depth belongs to --model ray-tracing, not to kriging; omit it"),
        (["train", waves, "--scene", "x", *out], "x: no such scene file"),
    ):
        command.refused(words, message)
        assert not (tmp_path / "out").exists(), words


def test_record_in_memory_and_progress(tmp_path: Path) -> None:
    heard: list[str] = []
    known = {"settings": QUICK, "on_progress": lambda stage, *told: heard.append(stage)}
    run = train(wave_record(36, 10, receivers=1), "kriging", out=tmp_path / "run", **known)
    assert set(heard) == {"one: element signals of spectra", "one: signals", "one: weights", "kriging: receivers"}
    assert stored(run.folder)["std"].shape == (10, *SIZE)  # one receiver: no axis for it
