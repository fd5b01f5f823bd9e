"""Runs of baselines: what is in their folders, the command, folds, resuming, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calling import contents, copied, damaged_models_refused, scored_again_as_before, stored
from commands import Command, positions_file, rows_of
from made_channels import channels

from wrf_mi.core import InputError, Record
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.datasets import load, make_splits, write_nerf2_csi
from wrf_mi.models import Session
from wrf_mi.runs.api import Interrupted, evaluate_run, open_run, resume, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.results import read_run
from wrf_mi.stages.scene import inside
from wrf_mi.training.checkpoint import read_checkpoint
from wrf_mi.training.loop import Progress

FILES = {"config.yaml", "split.npz", "model.npz", "metrics.json", "predictions.npz"}
ROUNDING = 1e-4
"""Powers of tens of dBm are stored in single precision."""


@pytest.fixture(scope="module")
def run(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(flat_folder, "mri", out=tmp_path_factory.mktemp("runs") / "mri").folder


def test_run_folder_holds_the_model(flat_folder: Path, run: Path) -> None:
    assert contents(run) == FILES
    config = yaml.safe_load((run / "config.yaml").read_text())
    assert (config["model"], config["dataset"], config["settings"]) == ("mri", str(flat_folder), {"shared": False})
    assert {"wrf-mi", "scipy", "scikit-learn"} <= set(config["versions"])
    with np.load(run / "model.npz", allow_pickle=False) as arrays:
        assert set(arrays) == {"run/format", "run/train_seconds", CHECKSUM, "heading", "0/law", "1/law"}
    metrics = json.loads((run / "metrics.json").read_text())
    assert (metrics["model"], metrics["task"], metrics["n_train"], metrics["n_test"]) == ("mri", "rssi", 24, 6)
    assert set(metrics["receivers"]) == {"anchor1", "anchor2"}
    assert "inside_90" not in metrics
    assert set(metrics["reference"]) == {"idw100"}


@pytest.mark.parametrize("name", ["idw", "kriging", "trees", "mri"])
def test_stored_models_reproduce_the_scored_predictions(name: str, flat_folder: Path, tmp_path: Path) -> None:
    """From the file alone, headings and all; the blend is the reference of every run to the last bit."""
    few = {"trees": ("trees=20",), "kriging": ("generic=true",)}.get(name, ())
    out = train(flat_folder, name, out=tmp_path / "run", settings=few).folder
    record, arrays, opened = load(flat_folder), stored(out), open_run(out)
    assert [receiver.name for receiver in opened.receivers] == ["anchor1", "anchor2"]
    heading = record.tx_heading_rad[arrays["row"]]
    for r in range(2):
        found = opened.predict(arrays["tx_pos"], r, heading).mean
        assert found.dtype == np.float32
        np.testing.assert_array_equal(found, arrays["prediction"][r])
    if name == "idw":
        np.testing.assert_array_equal(arrays["prediction"], arrays["reference_idw100"])
    elif name != "mri":
        with pytest.raises(InputError, match="give heading_rad, or train with heading=false"):
            opened.predict(arrays["tx_pos"], 0)
    with pytest.raises(InputError, match="no receiver 2"):
        opened.predict(arrays["tx_pos"], 2, heading)
    with pytest.raises(InputError, match="predicts from positions"):
        opened.predict(np.full((1, 3), np.nan), 0, heading[:1])


def test_command_trains_as_the_function_does(flat_folder: Path, run: Path, tmp_path: Path, command: Command) -> None:
    out, few = tmp_path / "run", tmp_path / "few"
    status, table, err = command(["train", flat_folder, "--model", "mri", "--out", out])
    assert status == 0, err
    assert [line.split()[0] for line in table.splitlines()] == ["absolute", "mri", "IDW", "split", "results:"]
    assert err.splitlines() == ["mri: receivers"]
    np.testing.assert_array_equal(stored(out)["prediction"], stored(run)["prediction"])
    chosen = ["--set", "shared=true", "--n-train", "0.5", "--seed", 4, "--split", "random"]
    metrics = command.json(["train", flat_folder, "--model", "mri", "--out", few, *chosen])
    assert (metrics["seed"], metrics["split"], metrics["n_train"]) == (4, "random", 12)
    with np.load(few / "model.npz") as arrays:
        np.testing.assert_array_equal(arrays["0/law"], arrays["1/law"])  # one law for all


def test_evaluation_reproduces_the_scores(flat_folder: Path, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    again = scored_again_as_before(run, capsys)
    other = evaluate_run(run, "random")
    assert other["split"] == "random (rows unseen by official)"
    (drawn,) = make_splits(load(flat_folder), "random")
    assert 0 < other["n_test"] == np.isin(drawn.test, stored(run)["row"]).sum() < len(drawn.test)
    assert json.loads((run / "metrics.json").read_text()) == again


def test_every_block_is_held_out_in_turn_and_a_stopped_run_goes_on(
    folder: Path, tmp_path: Path, command: Command
) -> None:
    out = train(folder, "kriging", out=tmp_path / "run", split="blocked").folder
    assert contents(out) == FILES - {"split.npz", "model.npz"} | {"fold0", "fold1", "fold2"}
    whole = read_run(out)
    assert sorted(whole.row) == list(range(24))
    for name in ("fold1/model.npz", "fold1/metrics.json", "fold1/predictions.npz", "metrics.json"):
        (out / name).unlink()
    kept = (out / "fold0" / "model.npz").stat().st_mtime_ns
    command.refused(["evaluate", out], "model.npz: missing, the fit was stopped; finish it with train --resume")
    status, _, err = command(["train", "--resume", out])
    assert (status, err.splitlines()) == (0, ["fold 2 of 3: kriging: receivers"])
    assert (out / "fold0" / "model.npz").stat().st_mtime_ns == kept
    np.testing.assert_array_equal(read_run(out).prediction, whole.prediction)
    asked = ["--tx", positions_file(tmp_path / "tx.csv", [[0, 0, 0]]), "--out", tmp_path / "out.npz"]
    command.refused(["predict", out, *asked], "one model for each block; choose one")
    command.done(["predict", out / "fold0", *asked])


def test_a_stopped_run_keeps_the_folds_that_are_fitted(folder: Path, tmp_path: Path) -> None:
    out, stages = tmp_path / "run", list[str]()
    ends: dict[str, Any] = {"on_progress": lambda stage, share, _: stages.append(stage)}
    ends["stop"] = lambda: stages[-1].startswith("fold 2 of 3: ")
    with pytest.raises(Interrupted, match=rf"stopped in kriging: receivers; go on with: wrf-mi train --resume {out}"):
        train(folder, "kriging", out=out, split="blocked", **ends)
    assert [(out / f"fold{k}" / "model.npz").exists() for k in range(3)] == [True, False, False]
    assert sorted(read_run(resume(out).folder).row) == list(range(24))


def test_progress_names_the_fold_and_a_stop_in_a_part_the_run_to_resume() -> None:
    stages = list[str]()
    session = Session(Path("run"), Path("run"), lambda stage, share, _: stages.append(stage), lambda: True)
    folders = [Path("run/fold0"), Path("run/fold1"), Path("run")]
    for folder in folders:
        with pytest.raises(Interrupted, match=r"--resume run$"):
            inside(session.of_part(folder, folders), "parts", "paths").report("tracing", 0.0)
    assert stages == ["fold 1 of 2: tracing", "fold 2 of 2: tracing", "all rows: tracing"]


SHORT = ("steps=20", "checkpoint_every=8", "log_every=4", "validate_every=4", "optimiser.warm_up=2", "batch=6")
TRAINED: dict[str, tuple[str, tuple[str, ...], tuple[str, ...]]] = {
    "vae": ("spectra", ("width=8", "last=8"), ("vae gateway1", "vae gateway2")),
    "dcgan": ("spectra", ("hidden=4", "channels=8", "noise=2"), ("dcgan gateway1", "dcgan gateway2")),
    "nerf2": ("spectra", ("rays=16", "samples=2", "networks.width=8", "networks.layers=2"), ("nerf2",)),
    "fire": ("channels", ("sample=antenna", "width=8", "latent=2"), ("fire antenna",)),
    "optml": ("channels", ("simulation.channels=30", "width=4", "rounds=1", "wavefront=plane"), ("paths",)),
}
"""Data, settings of a small version, and the networks that are trained in turn."""


@pytest.mark.parametrize("name", TRAINED)
def test_resumed_network_is_bit_identical(name: str, two_gateways: Record, tmp_path: Path) -> None:
    """The run is stopped between two checkpoints of the last network."""
    data, settings, networks = TRAINED[name]
    record = two_gateways if data == "spectra" else channels()
    ends: dict[str, Any] = {"settings": (*SHORT, *settings), "deterministic": True}
    whole = train(record, name, out=tmp_path / "whole", **ends).folder
    told: list[tuple[str, int]] = []

    def on_progress(stage: str, share: float, progress: Progress | None) -> None:
        if progress is not None:
            told.append((stage, progress.step))

    out = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped after step 12 of 20 of {networks[-1]}; .* --resume {out}"):
        train(record, name, out=out, **ends, on_progress=on_progress, stop=lambda: told[-1:] == [(networks[-1], 12)])
    assert (out / "checkpoint.npz").exists()
    del told[:]
    resume(out, record=record, on_progress=on_progress)
    assert min(step for _, step in told) > 12, "no step is taken again"
    assert {stage for stage, _ in told} == {networks[-1]}
    assert not (out / "checkpoint.npz").exists()
    assert_same_model(whole, out)


def assert_same_model(whole: Path, resumed: Path) -> None:
    with np.load(whole / "model.npz") as expected, np.load(resumed / "model.npz") as found:
        assert set(expected) == set(found)
        for key in set(expected) - {"run/train_seconds", CHECKSUM}:
            np.testing.assert_array_equal(found[key], expected[key], err_msg=key)


def test_a_killed_network_goes_on_from_its_last_checkpoint(two_gateways: Record, tmp_path: Path) -> None:
    _, settings, networks = TRAINED["vae"]
    ends: dict[str, Any] = {"settings": (*SHORT, *settings), "deterministic": True}

    def kill(stage: str, share: float, progress: Progress | None) -> None:
        if progress is not None and (stage, progress.step) == (networks[0], 16):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(two_gateways, "vae", out=tmp_path / "killed", **ends, on_progress=kill)
    assert int(read_checkpoint(tmp_path / "killed")["step"]) == 8
    resume(tmp_path / "killed", record=two_gateways)
    train(two_gateways, "vae", out=tmp_path / "whole", **ends)
    assert_same_model(tmp_path / "whole", tmp_path / "killed")


@pytest.mark.parametrize("name", ["tx.csv", "tx.npz"])
def test_predictions_at_new_positions(name: str, run: Path, tmp_path: Path, command: Command) -> None:
    held_out = stored(run)
    heading = np.zeros(len(held_out["tx_pos"])) if name == "tx.npz" else None
    arrays = command.predicted(run, positions_file(tmp_path / name, held_out["tx_pos"], heading))
    assert set(arrays) == {"row", "prediction", "tx_pos", "receiver_name"}
    np.testing.assert_allclose(arrays["prediction"], held_out["prediction"], atol=ROUNDING)


def test_sweep_and_comparison_show_baselines_and_the_reference(
    flat_folder: Path, run: Path, tmp_path: Path, command: Command
) -> None:
    """The sweep starts a process for its run."""
    out = tmp_path / "sweep"
    (row,) = command.json(["sweep", flat_folder, "--vary", "model=idw", "--out", out])
    assert (row["model"], row["status"], row["median"]) == ("idw", "done", row["reference_median"])
    compare([run, out / "model=idw"], tmp_path / "page")
    rows = rows_of(tmp_path / "page" / "compare.csv")
    assert [row["model"] for row in rows] == ["mri", "idw", "idw100", "constant"]
    assert rows[1]["median"] == rows[2]["median"] != rows[0]["median"]
    words = ["sweep", flat_folder, "--vary", "model=idw,vae", "--out", tmp_path / "no"]
    command.refused(words, "vae serves spectrum")
    assert not (tmp_path / "no").exists()


def test_bad_calls_are_refused(flat_folder: Path, tmp_path: Path, command: Command) -> None:
    unplaced = write_nerf2_csi(tmp_path / "unplaced", channels(positions=False))
    for data, options, message in (
        (unplaced, "mri", "unplaced: holds csi; mri serves rssi, so choose another model: "),
        (unplaced, "idw", "positions are not known, from which idw predicts"),
        (flat_folder, "fire", "flat: holds rssi; fire serves csi"),
        (flat_folder, "mri --n-train 1", "anchor1: mri: 1 rows at one distance; an exponent shows at two or more"),
        (flat_folder, "mri --set shared=maybe", "expected bool, got 'maybe'"),
        (flat_folder, "idw --set neighbours=0", "k = 0: IDW needs at least one"),
        (flat_folder, "kriging --set trend=cubic", "trend 'cubic'; choose constant"),
        (
            flat_folder,
            "kriging --n-train 1 --set generic=true",
            "training rows received: 1; its trend needs 2, so give",
        ),
        (flat_folder, "mri --scene x", "mri on .*flat: takes no scene; omit --scene"),
        (
            flat_folder,
            "mri --preset fast",
            "--preset fast: mri for such data has no presets; use --set",
        ),
    ):
        command.refused(["train", data, "--out", tmp_path / "out", "--model", *options.split()], message)
        assert not (tmp_path / "out").exists(), options


def test_damaged_runs_are_refused(
    run: Path, tmp_path: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = copied(run, tmp_path / "run")
    damaged_models_refused(damaged, "1/law", capsys)
    (damaged / "model.npz").unlink()
    split = (damaged / "split.npz").read_bytes()
    (damaged / "split.npz").write_bytes(b"")
    command.refused(["train", "--resume", damaged], "split.npz: not readable")
    config = damaged / "config.yaml"  # a run that was there is never taken away
    (damaged / "split.npz").write_bytes(split)
    content = yaml.safe_load(config.read_text())
    for changed, message in (
        (content | {"settings": {"shared": 3}}, "setting shared: expected bool, got 3"),
        ({k: v for k, v in content.items() if k != "settings"}, "config.yaml: not readable .*settings.*; restore it"),
        (content | {"model": "no-such"}, "model 'no-such': no such model; choose from"),
    ):
        config.write_text(yaml.safe_dump(changed))
        command.refused(["evaluate", damaged], message)
