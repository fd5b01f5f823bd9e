"""Runs of baselines: what is in their folders, the command, folds, resuming, and what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from calling import copied, damaged_models_refused, stored
from commands import Command, rows_of
from made_channels import channels

from wrf_mi.core import InputError, Record
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.datasets import load
from wrf_mi.models import Session
from wrf_mi.runs.api import Interrupted, open_run, resume, train
from wrf_mi.runs.compare import compare
from wrf_mi.stages.scene import inside
from wrf_mi.training.loop import Progress


@pytest.fixture(scope="module")
def run(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(flat_folder, "mri", out=tmp_path_factory.mktemp("runs") / "mri").folder


@pytest.mark.parametrize("name", ["idw", "kriging", "trees", "mri"])
def test_stored_models_reproduce_the_scored_predictions(name: str, flat_folder: Path, tmp_path: Path) -> None:
    """From the file alone, headings and all; the blend is the reference of every run to the last bit."""
    few = {"trees": ("trees=20",), "kriging": ("generic=true",)}.get(name, ())
    out = train(flat_folder, name, out=tmp_path / "run", settings=few).folder
    record, arrays, opened = load(flat_folder), stored(out), open_run(out)
    assert [receiver.name for receiver in opened.receivers] == ["anchor1", "anchor2"]
    heading = record.tx_heading_rad[arrays["row"]]
    for r in range(2):
        predicted = opened.predict(arrays["tx_pos"], r, heading).mean
        assert predicted.dtype == np.float32
        np.testing.assert_array_equal(predicted, arrays["prediction"][r])
    if name == "idw":
        np.testing.assert_array_equal(arrays["prediction"], arrays["reference_idw"])
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
    first = ["absolute", "mri", "IDW", "split", "median", "RMSE", "results:"]
    assert [line.split()[0] for line in table.splitlines()] == first
    assert err.splitlines() == ["mri: receivers"]
    np.testing.assert_array_equal(stored(out)["prediction"], stored(run)["prediction"])
    chosen = ["--set", "shared=true", "--n-train", "0.5", "--seed", 4, "--split", "random"]
    metrics = command.json(["train", flat_folder, "--model", "mri", "--out", few, *chosen])
    assert (metrics["seed"], metrics["split"], metrics["n_train"]) == (4, "random", 12)
    with np.load(few / "model.npz") as arrays:
        np.testing.assert_array_equal(arrays["models/0/law"], arrays["models/1/law"])  # one law for all


def test_progress_names_the_fold_and_a_stop_in_a_part_the_run_to_resume() -> None:
    stages = list[str]()
    session = Session(Path("run"), Path("run"), lambda stage, *_: stages.append(stage), lambda: True)
    folders = [Path("run/fold0"), Path("run/fold1"), Path("run")]
    for folder in folders:
        with pytest.raises(Interrupted, match=r"--resume run$"):
            inside(session.of_part(folder, folders), "parts", "paths").progress("tracing", 0.0)
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
    uninterrupted = train(record, name, out=tmp_path / "whole", **ends).folder
    told: list[tuple[str, int]] = []

    def on_progress(stage: str, share: float, progress: Progress | None = None) -> None:
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
    assert_same_model(uninterrupted, out)


def assert_same_model(whole: Path, resumed: Path) -> None:
    with np.load(whole / "model.npz") as expected, np.load(resumed / "model.npz") as resumed_arrays:
        assert set(expected) == set(resumed_arrays)
        for key in set(expected) - {"run/train_seconds", CHECKSUM}:
            np.testing.assert_array_equal(resumed_arrays[key], expected[key], err_msg=key)


def test_sweep_and_comparison_show_baselines_and_the_reference(flat_folder, run, tmp_path, command):
    """The sweep starts a process for its run."""
    out = tmp_path / "sweep"
    (row,) = command.json(["sweep", flat_folder, "--vary", "model=idw", "--out", out])
    assert (row["model"], row["status"], row["median"]) == ("idw", "done", row["reference_median"])
    compare([run, out / "model=idw"], tmp_path / "page")
    rows = rows_of(tmp_path / "page" / "compare.csv")
    assert [row["model"] for row in rows] == ["mri", "idw", "idw", "constant", "constant"]
    assert rows[1]["median"] == rows[2]["median"] != rows[0]["median"]
    words = ["sweep", flat_folder, "--vary", "model=idw,vae", "--out", tmp_path / "no"]
    command.refused(words, "vae serves spectrum")
    assert not (tmp_path / "no").exists()


def test_damaged_runs_are_refused(run, tmp_path, command, capsys):
    damaged = copied(run, tmp_path / "run")
    damaged_models_refused(damaged, "models/1/law", capsys)
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
