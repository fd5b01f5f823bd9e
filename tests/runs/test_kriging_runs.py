"""Runs of kriging: what is in their folders, the command, and what is refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from calling import call, contents, refused, scored_again_as_before, stored
from made_waves import SIZE, wave_record

from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.folder import FORMAT
from wrf_mi.tasks.scores import inside_interval, ssim

QUICK = ("directions=20", "lengths=2")
"""Of spectra: a fit of a second."""
SET = [part for setting in QUICK for part in ("--set", setting)]
FILES = {"config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"}
ROUNDING = 1e-5
"""Predictions are float32."""


@pytest.fixture(scope="module")
def waves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Spectra at two receivers, 36 rows in two folds."""
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "waves", wave_record(36, 10))


@pytest.fixture(scope="module")
def run(waves: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(waves, tmp_path_factory.mktemp("runs") / "run", "kriging", settings=QUICK).folder


@pytest.fixture(scope="module")
def strengths(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on signal strengths with headings."""
    return train(flat_folder, tmp_path_factory.mktemp("runs") / "strengths", "kriging").folder


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
    assert [one["parts"] for one in metrics["fitted"]] == ["signals, nearby"] * 2
    assert metrics["train_seconds"] > 0
    assert metrics["peak_memory_mb"] > 10


def test_command_trains_as_the_function_does(
    waves: Path, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    status, table, err = call(["train", waves, "--model", "kriging", "--out", out, *SET], capsys)
    assert status == 0, err
    lines = table.splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["SSIM", "kriging", "IDW"]
    assert "of the test values lie inside the predicted 90 % intervals, CRPS " in lines[3]
    assert lines[-1] == f"results: {out}"
    assert "one: element signals of spectra" in err.splitlines()
    np.testing.assert_allclose(stored(out)["prediction"], stored(run)["prediction"], atol=ROUNDING)
    np.testing.assert_allclose(stored(out)["std"], stored(run)["std"], atol=ROUNDING)


def test_evaluation_reproduces_the_scores(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scored_again_as_before(run, capsys)


def test_predictions_at_new_positions_have_standard_deviations(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held_out = stored(run)
    rows = [",".join(repr(float(v)) for v in p) for p in held_out["tx_pos"]]
    (tmp_path / "tx.csv").write_text("\n".join(["x,y,z", *rows]) + "\n")
    (tmp_path / "turned.csv").write_text("\n".join(["heading_rad,x,y,z", *(f"0.5,{row}" for row in rows)]) + "\n")
    out = tmp_path / "tx.npz"
    status, printed, err = call(["predict", run, "--tx", tmp_path / "tx.csv", "--out", out, "--json"], capsys)
    assert (status, err) == (0, "")
    assert json.loads(printed)["arrays"]["std"] == [2, 10, *SIZE]
    with np.load(out) as arrays:
        np.testing.assert_allclose(arrays["prediction"], held_out["prediction"], atol=ROUNDING)
        np.testing.assert_allclose(arrays["std"], held_out["std"], atol=ROUNDING)
        assert arrays["receiver_name"].tolist() == ["one", "two"]
    # How the transmitter is turned changes no spectrum: a model that cannot use it says so.
    turned = ["predict", run, "--tx", tmp_path / "turned.csv", "--out", tmp_path / "turned.npz"]
    refused(turned, "does not know how the transmitter is turned", capsys)
    assert not (tmp_path / "turned.npz").exists()


def test_heading_changes_signal_strengths(
    flat_folder: Path, strengths: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held_out, record = stored(strengths), load(flat_folder)
    assert record.tx_heading_rad is not None
    metrics = json.loads((strengths / "metrics.json").read_text())
    assert metrics["task"] == "rssi"
    assert 0.5 < metrics["inside_90"] <= 1
    turned = record.tx_heading_rad[held_out["row"]]
    np.savez(tmp_path / "turned.npz", tx_pos=held_out["tx_pos"], heading_rad=turned)
    np.savez(tmp_path / "tx.npz", tx_pos=held_out["tx_pos"])
    found = {}
    for name in ("tx", "turned"):
        out = tmp_path / f"{name}-out.npz"
        status, _, err = call(["predict", strengths, "--input", tmp_path / f"{name}.npz", "--out", out], capsys)
        assert status == 0, err
        with np.load(out) as arrays:
            found[name] = dict(arrays)
    np.testing.assert_allclose(found["turned"]["prediction"], held_out["prediction"], atol=1e-3)
    assert np.abs(found["tx"]["prediction"] - held_out["prediction"]).max() > 0.01
    assert found["tx"]["std"].shape == found["tx"]["prediction"].shape == (2, 6)


def test_standard_deviations_of_folds_are_pooled(waves: Path, tmp_path: Path) -> None:
    run = train(waves, tmp_path / "run", "kriging", split="blocked", settings=QUICK)
    arrays = stored(run.folder)
    assert run.metrics["inside_90"] == inside_interval(arrays["prediction"], arrays["std"], arrays["truth"])


def test_comparison_shows_kriging_and_reference(run: Path, tmp_path: Path) -> None:
    page = compare([run], tmp_path / "page").read_text()
    assert "inside 90 %" in page
    with (tmp_path / "page" / "compare.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["model"] for row in rows] == ["kriging", "idw4"]
    metrics = json.loads((run / "metrics.json").read_text())
    assert float(rows[0]["inside_90"]) == metrics["inside_90"]
    assert rows[1]["inside_90"] == ""
    assert (tmp_path / "page" / "waves-samples.png").is_file()


# What is refused


def test_bad_calls_are_refused(
    waves: Path, run: Path, flat_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    train = ["train", waves, "--model", "kriging", "--out", tmp_path / "out"]
    for arguments, message in (
        ([*train, "--n-train", 0], "n_train 0; choose 1 to 26"),
        ([*train, "--n-train", -1], "n_train -1; choose 1 to 26"),
        ([*train, "--split", "nowhere"], "split 'nowhere'"),
        ([*train, "--split", ""], "split ''"),
        ([*train, "--seed", -1], "seed -1"),
        ([*train, "--set", "lengths=0"], "setting lengths: 0 is out of range, choose 1 or more"),
        ([*train, "--set", "lengths=many"], "expected int, got 'many'"),
        (
            [*train, "--material", "concrete"],
            "--material and antenna options belong to a scene that is traced; give --scene",
        ),
        ([*train, "--scene", tmp_path / "none.xml"], "takes no scene; omit --scene"),
        (
            ["train", waves, "--model", "ray-tracing", "--out", tmp_path / "out"],
            "needs a scene; give --scene SCENE, or choose kriging",
        ),
        (
            [*train, "--depth", 2],
            "--paths, --depth, --reflections, --rays, --phase-error and --calibrate belong to --model ray-tracing",
        ),
        (["train", "--resume", run, "--scene", "x"], "omit data set and settings"),
        (["train", "--resume", run, "--set", "lengths=2"], "omit data set and settings"),
        (["train", waves, "--scene", "x", "--out", tmp_path / "out"], "x: no such scene file"),
        (["evaluate", run, "--split", "nowhere"], "split 'nowhere'"),
    ):
        refused(arguments, message, capsys)
        assert not (tmp_path / "out").exists(), arguments


BAD_HEADINGS = {
    "nan.csv": ("x,y,z,heading_rad\n0,0,0,nan\n", "row 1: heading_rad is 'nan'; give a finite number"),
    "short.csv": ("x,y,z,heading_rad\n0,0,0\n", "row 1: 3 fields, but the header has 4"),
}


@pytest.mark.parametrize("name", BAD_HEADINGS)
def test_bad_headings_are_refused(name: str, run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    content, message = BAD_HEADINGS[name]
    (tmp_path / name).write_text(content)
    refused(["predict", run, "--tx", tmp_path / name, "--out", tmp_path / "out.npz"], message, capsys)
    np.savez(tmp_path / "tx.npz", tx_pos=np.zeros((2, 3)), heading_rad=np.zeros(3))
    refused(["predict", run, "--input", tmp_path / "tx.npz", "--out", tmp_path / "out.npz"], "omit heading_rad", capsys)


# In Python


def test_record_in_memory_and_progress(tmp_path: Path) -> None:
    heard: list[tuple[str, float]] = []
    record = wave_record(36, 10, receivers=1)
    out = train(
        record, tmp_path / "run", "kriging", settings=QUICK, on_progress=lambda *told: heard.append(told[:2])
    ).folder
    stages = {"one: element signals of spectra", "one: signals", "one: weights", "kriging: receivers"}
    assert {what for what, _ in heard} == stages
    assert stored(out)["std"].shape == (10, *SIZE)  # one receiver: no axis for it


def test_settings_of_every_task_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = call(["train", "--help-settings"], capsys)
    assert status == 0
    for line in (
        "kriging, signal strengths:",
        "kriging, spectra:",
        "cone_deg=80.0",
        "shadow_db=",
        "generic=False",
    ):
        assert line in out
