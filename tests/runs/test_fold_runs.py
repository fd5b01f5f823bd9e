"""Runs of several folds: the split none, and fitted parts that stay where a later one fails."""

import errno
import logging
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SMALL, scored_again_as_before, strength_commands
from commands import Command
from made_channels import channels
from traced_rooms import LENGTH, SHOEBOX, WIDTH, receiver, write_xml

from wrf_mi.apps.commands.output import Watch
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, make_splits, write_ble_folder
from wrf_mi.receivers import rssi_dbm
from wrf_mi.runs import api
from wrf_mi.runs.api import evaluate_run, open_run, train
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths


@pytest.fixture(scope="module")
def strengths(flat_folder: Path) -> Record:
    """Signal strengths without an official split."""
    return replace(load(flat_folder), official=None)


@pytest.fixture(scope="module")
def table(strengths: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ble_folder(tmp_path_factory.mktemp("data") / "office", strengths)


@pytest.fixture(scope="module")
def run(table: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(table, "kriging", out=tmp_path_factory.mktemp("runs") / "run", split="none").folder


def test_all_rows_train_and_each_is_tested_once(strengths: Record):
    *folds, final = make_splits(strengths, "none")
    rows = np.arange(len(strengths))
    np.testing.assert_array_equal(np.sort(np.concatenate([fold.test for fold in folds])), rows)
    np.testing.assert_array_equal(final.all_train, rows)
    assert (final.name, len(final.test)) == ("none", 0)
    for fold, blocked in zip(folds, make_splits(strengths, "blocked"), strict=True):
        np.testing.assert_array_equal(fold.test, blocked.test)
        np.testing.assert_array_equal(fold.validation, blocked.validation)


def test_folds_are_drawn_where_space_has_none():
    for record in (channels(positions=False), replace(channels(), tx_pos_m=np.ones((30, 3)))):
        *folds, final = make_splits(record, "none")
        assert [len(fold.test) for fold in folds] == [6] * 5
        assert len(final.all_train) == 30
    few = replace(channels(), tx_pos_m=np.ones((1, 3)), observation=channels().observation[:, :1], official=None)
    with pytest.raises(InputError, match=r"split none:\d: no row that was received trains"):
        make_splits(few, "none")


def test_scores_are_those_of_blocks_and_the_model_that_of_all_rows(table: Path, run: Path, tmp_path: Path):
    record, metrics = load(table), open_run(run).metrics
    blocked = train(table, "kriging", out=tmp_path / "blocked", split="blocked").metrics
    assert metrics["abs_error_db"] == blocked["abs_error_db"]
    assert metrics["reference"] == blocked["reference"]
    assert metrics["cross_validated"] == {"folds": 5, "n_train": blocked["n_train"]}
    assert (metrics["n_train"], metrics["n_test"], metrics["split"]) == (len(record), len(record), "none")
    # The same training rows, with a further row to score.
    twice, final = np.append(np.arange(len(record)), 0), make_splits(record, "none")[-1]
    longer = replace(record, tx_pos_m=record.tx_pos_m[twice], tx_heading_rad=np.asarray(record.tx_heading_rad)[twice])
    longer = replace(longer, observation=record.observation[:, twice])
    split = replace(final, test=np.array([len(record)]))
    everything = train(longer, "kriging", out=tmp_path / "all", split=split)
    place = [[1.0, 2.0, 1.3]], 1, [0.5]
    np.testing.assert_array_equal(open_run(run).predict(*place).mean, everything.predict(*place).mean)


def test_it_is_the_default_of_data_without_a_split(table: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    with caplog.at_level(logging.WARNING, "wrf_mi"):
        metrics = train(table, "idw", out=tmp_path / "run").metrics
    assert metrics["split"] == "none"
    assert f"{table}: no official split, so --split none: scores are of folds held out in space" in caplog.text
    with pytest.raises(InputError, match="has no official split"):
        train(table, "idw", out=tmp_path / "official", split="official")


GAUSSIANS = (*SMALL, "patience=0")


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        *(("trees", ("trees=10",)), ("mri", ()), ("hybrid", ("stages=residual",))),
        pytest.param("wrf-gs+", GAUSSIANS, marks=pytest.mark.slow),
    ],
)
def test_models_of_strengths(model: str, settings: tuple[str, ...], strengths: Record, tmp_path: Path):
    run = train(strengths, model, out=tmp_path / "run", split="none", settings=settings)
    headings = [0.1, 0.2] if run.takes_heading else None
    assert np.isfinite(run.predict([[1, 2, 1.3], [2, 2, 1.3]], 0, headings).mean).all()
    assert run.metrics["n_test"] == len(strengths)


def test_models_of_spectra(one_gateway: Record, tmp_path: Path):
    run = train(one_gateway, "idw", out=tmp_path / "run", split="none")
    assert run.predict(one_gateway.tx_pos_m[:2]).mean.shape == (2, *one_gateway.observation.shape[2:])
    assert run.metrics["cross_validated"]["folds"] >= 2


@pytest.mark.parametrize("model", ["linear", "kriging"])
def test_models_of_channels(model: str, tmp_path: Path):
    record = channels()
    run = train(record, model, out=tmp_path / "run", split="none")
    assert run.predict(uplink=record.uplink[:2], tx_pos_m=record.tx_pos_m[:2]).mean.shape == (2, 3, 4)


def test_ray_tracing_keeps_the_paths_of_each_part(room: Path, strengths: Record, tmp_path: Path):
    direct = ["depth=0", "reflection=false"]
    run = train(strengths, "ray-tracing", out=tmp_path / "run", scene=room, split="none", settings=direct)
    assert np.isfinite(run.predict([[1, 2, 1.3]]).mean).all()
    assert evaluate_run(run.folder)["abs_error_db"] == run.metrics["abs_error_db"]


@pytest.mark.usefixtures("undrawn")
def test_commands_take_such_a_run(run: Path, table: Path, tmp_path: Path, command: Command):
    tx = "x,y,z,heading_rad\n1,2,1.3,0\n"
    for words in strength_commands(run, tmp_path, {"1": "-60", "2": "-70"}, tx):
        assert ("scores are cross-validated: each row" in command.done(words)) == (words[0] == "evaluate")
    command.refused(["evaluate", run, "--split", "random"], "every row is held out in one of its folds; omit --split")
    command.refused(
        ["locate", run, "--step", "1", "--out", tmp_path / "test.csv"],
        "give strengths by --observed FILE, or train with --split random",
    )


def test_scored_again_as_before(run: Path, capsys: pytest.CaptureFixture[str]):
    scored_again_as_before(run, capsys)


def test_a_run_is_opened_from_any_folder(table: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Also from one in which another folder has the name of the data set, and from a copy of all."""
    for name in ("made", "elsewhere/table"):
        (tmp_path / name).mkdir(parents=True)
    shutil.copytree(table, tmp_path / "made" / "table")
    monkeypatch.chdir(tmp_path / "made")
    train("table", "idw", out="run")
    monkeypatch.chdir(tmp_path / "elsewhere")
    record = open_run(tmp_path / "made" / "run").problem.record
    np.testing.assert_array_equal(record.tx_pos_m, load(table).tx_pos_m)
    (tmp_path / "made").rename(tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    assert len(open_run("run").problem.record.tx_pos_m) == len(record.tx_pos_m)


HZ = 2.44e9
QUICK = ("stages=mean,residual",)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("room"), SHOEBOX)


@pytest.fixture(scope="module")
def walked(room: Path) -> Record:
    """Strengths that are traced in the room, with noise of 1 dB; an official split."""
    rng = np.random.default_rng(2)
    places = np.column_stack([rng.uniform(0.5, [LENGTH - 0.5, WIDTH - 0.5], (36, 2)), np.full(36, 1.2)])
    receivers = (receiver([5.2, 2.4, 2.1], "rx0"), receiver([0.6, 4.2, 2.1], "rx1"))
    paths = trace_paths(open_scene(room, HZ), places, receivers, TraceOptions(depth=1, rays=1 << 12)).paths
    observed = np.asarray(rssi_dbm(paths) + rng.normal(0, 1, (2, 36)), np.float32)
    official = np.arange(30), np.arange(30, 36)
    return Record("room", "rssi", places, receivers, observed, official=official, frequencies_hz=np.array([HZ]))


def failing_at(stage: str, error: BaseException) -> Callable[..., None]:
    """Progress callback that raises an error at a stage."""

    def on_progress(reported: str, *more: Any) -> None:
        if reported.startswith(stage):
            raise error

    return on_progress


def stages_of(resumed: Callable[..., Any]) -> tuple[Any, list[str]]:
    """What a call returns, and the stages that it reports."""
    stages = list[str]()
    return resumed(on_progress=lambda stage, *_: stages.append(stage)), stages


def assert_noted(error: BaseException, folder: Path) -> None:
    assert error.__notes__ == [f"what was fitted is kept; go on with: wrf-mi train --resume {folder}"]


@pytest.mark.parametrize("kind", [InputError, KeyboardInterrupt])
def test_folds_that_are_fitted_stay_where_a_later_one_fails(kind, strengths: Record, tmp_path: Path):
    options: dict[str, Any] = {"model": "mri", "split": "none"}
    folder, plain = tmp_path / "run", api.train(strengths, out=tmp_path / "plain", **options)
    with pytest.raises(kind) as raised:
        api.train(strengths, out=folder, on_progress=failing_at("fold 3", kind("a fault")), **options)
    assert_noted(raised.value, folder)
    resumed, stages = stages_of(lambda **how: api.resume(folder, record=strengths, **how))
    assert not any(stage.startswith(("fold 1", "fold 2")) for stage in stages)
    assert resumed.metrics["abs_error_db"] == plain.metrics["abs_error_db"]


def test_stages_that_are_fitted_stay_where_a_later_one_fails(walked: Record, room: Path, tmp_path: Path):
    """The scene's stages take minutes; then interpolation without the scene fails."""
    options: dict[str, Any] = {"scene": room, "settings": QUICK, "deterministic": True}
    folder, plain = tmp_path / "run", api.train(walked, out=tmp_path / "plain", **options)
    with pytest.raises(InputError, match="a fault") as raised:
        api.train(walked, out=folder, on_progress=failing_at("kriging", InputError("a fault")), **options)
    assert_noted(raised.value, folder)
    stored = {path: path.stat().st_mtime_ns for path in (folder / "parts" / "paths").rglob("*.*")}
    # Predictions by the options of each stage, and by the chosen ones.
    assert {"chosen.npz", "as stated+local+default.npz"} <= {path.name for path in stored}
    resumed = api.resume(folder, record=walked)
    assert all(path.stat().st_mtime_ns == time for path, time in stored.items() if path.exists())
    for name in ("abs_error_db", "weights", "held_out"):
        assert resumed.metrics[name] == plain.metrics[name]


@pytest.mark.parametrize("intervals", [False, True])
def test_no_part_is_fitted_again_where_the_model_could_not_be_stored(intervals, walked, room, tmp_path, monkeypatch):
    """The disk is full; parts without a weight are removed only after the model is stored."""
    options: dict[str, Any] = {"model": "kriging"} if intervals else {"scene": room, "settings": QUICK}

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(api, "write_fitted", full)
        with pytest.raises(OSError, match="No space left") as raised:
            api.train(walked, out=tmp_path / "run", intervals=intervals, **options)
    assert_noted(raised.value, tmp_path / "run")
    _, stages = stages_of(lambda **how: api.resume(tmp_path / "run", record=walked, **how))
    assert not [stage for stage in stages if ", held-out rows" in stage]
    left = {path.name for path in (tmp_path / "run").rglob("*") if path.is_dir()}
    assert not left & {"tried", "held_out"}


def test_last_line_of_a_failed_fit_says_how_to_go_on(strengths: Record, tmp_path: Path, command, monkeypatch):
    data, folder = write_ble_folder(tmp_path / "data", strengths), tmp_path / "run"
    words = ["train", data, "--model", "mri", "--split", "none", "--out", folder]
    with monkeypatch.context() as patched:
        fails = failing_at("fold 3", InputError("a fault in the data"))
        patched.setattr(Watch, "on_progress", lambda self, *report: fails(*report))
        status, _, err = command(words)
    note = f"a fault in the data; what was fitted is kept; go on with: wrf-mi train --resume {folder}"
    assert (status, err.splitlines()[-1]) == (2, f"wrf-mi: {note}")
    command.done(["train", "--resume", folder])


def test_folder_without_anything_fitted_is_removed(strengths: Record, tmp_path: Path):
    fault = InputError("a fault in the data")
    with pytest.raises(InputError, match=re.escape(str(fault))) as raised:
        api.train(strengths, "kriging", out=tmp_path / "run", split="none", on_progress=failing_at("fold 1", fault))
    assert not hasattr(raised.value, "__notes__")
    assert not (tmp_path / "run").exists()
