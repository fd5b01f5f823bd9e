"""Observations that are not finite or missing: refused in training rows, not scored, receivers left out."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import stored
from changed_folders import error_line, refusal
from commands import Command
from small_fits import official, settings

from wrf_mi.apps.checking.rows import few_rows
from wrf_mi.apps.commands.data import render, summary
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.datasets import load
from wrf_mi.datasets.observations import fitted_receivers, scorable, warn_of_left_out, warn_of_one_place
from wrf_mi.estimators import ray_tracing
from wrf_mi.runs import api as runs
from wrf_mi.runs import sweep
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.evaluate import evaluate
from wrf_mi.runs.folder import RunRequest
from wrf_mi.runs.results import read_run
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import fit_offsets


def changed(record: Record, *changes: tuple[Any, float]) -> Record:
    """The record with other values at some places of its observations."""
    observation = record.observation.copy()
    for place, value in changes:
        observation[place] = value
    return replace(record, observation=observation)


def train_field(record: Record, out: Path, split: str = "official") -> Path:
    return train(record, "wrf-gs+", out=out, settings=settings("steps=2", "deterministic=true"), split=split).folder


def train_idw(record: Record, out: Path, split: str = "official") -> Path:
    return train(record, "idw", out=out, split=split).folder


BOTH = pytest.mark.parametrize("train", [train_field, train_idw])


@BOTH
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", ["train", "validation"])
def test_rows_that_train_are_refused(train: Any, value: float, part: str, two_gateways: Record, tmp_path: Path) -> None:
    row = int(getattr(official(two_gateways), part)[0])
    name = two_gateways.receivers[1].name
    message = f"made-here, receiver {name}, row {row}: 1 of 800 values are not finite; correct or remove the row"
    broken = changed(two_gateways, ((1, row, 4, 5), value))
    assert error_line(train, broken, re.escape(message), out=tmp_path / "run") == message
    assert not (tmp_path / "run").exists()


@BOTH
def test_observations_whose_squares_overflow_are_refused(train: Any, two_gateways: Record, tmp_path: Path) -> None:
    row, name = int(official(two_gateways).train[0]), two_gateways.receivers[1].name
    message = (
        f"made-here, receiver {name}, row {row}: 1 of 800 values are larger than 1e+15, as no amplitude or power is"
    )
    broken = changed(two_gateways, ((1, row, 4, 5), 1e30))
    assert error_line(train, broken, re.escape(message), out=tmp_path / "run").startswith(message)


def test_fields_need_every_receiver_in_every_row(two_gateways: Record, tmp_path: Path) -> None:
    """Other models are fitted to the rows that a receiver received. A row of a later fold is refused at once."""
    row = int(official(two_gateways).train[0])
    missed = changed(two_gateways, ((1, row), np.nan))
    message = f"row {row}: 800 of 800 .*; remove the row or choose another model"
    refusal(train_field, missed, tmp_path / "field", message)
    train_idw(missed, tmp_path / "idw")
    folded = changed(replace(two_gateways, folds=np.arange(len(two_gateways)) % 2), ((0, 2, 4, 5), np.nan))
    refusal(train_field, folded, tmp_path / "field", "blocked", "row 2: 1 of 800")  # it trains in the second fold
    assert not (tmp_path / "field").exists()


@BOTH
def test_rows_that_test_are_counted_and_not_scored(train: Any, two_gateways: Record, tmp_path: Path) -> None:
    a, b, c = (int(row) for row in official(two_gateways).test[:3])
    broken = changed(two_gateways, ((0, a, 4, 5), np.nan), ((1, b), np.inf), ((1, c), np.nan))
    complete_run, broken_run = train(two_gateways, out=tmp_path / "whole"), train(broken, out=tmp_path / "broken")
    metrics = json.loads((broken_run / "metrics.json").read_text())
    assert metrics["n_not_scored"] == 2
    assert json.loads((complete_run / "metrics.json").read_text())["n_not_scored"] == 0
    rows = len(official(two_gateways).test)
    names = [receiver.name for receiver in two_gateways.receivers]
    assert [metrics["receivers"][name]["n_test"] for name in names] == [rows - 1, rows - 2]
    np.testing.assert_array_equal(stored(broken_run)["prediction"], stored(complete_run)["prediction"])
    assert np.isnan(stored(broken_run)["truth"]).reshape(2, rows, -1).all(axis=2).sum(axis=1).tolist() == [1, 2]
    assert np.isfinite(list(metrics["ssim"].values())).all()
    if train is train_idw:
        compare([broken_run, complete_run], tmp_path / "compare")


def test_a_split_without_a_finite_test_row_is_refused(two_gateways: Record) -> None:
    split = official(two_gateways)
    broken = changed(two_gateways, ((slice(None), split.test, 0, 0), np.nan))
    message = "split official: no test row to score is finite; use another split"
    refusal(evaluate, broken, split, lambda rows, receiver: broken.observation[receiver, rows], message)
    # Observations that are finite or missing stay.
    missed = changed(two_gateways, ((0, 3), np.nan)).observation
    scorable_split, count = scorable(missed)
    assert (scorable_split is missed, count) == (True, 0)


@pytest.mark.parametrize("arguments", [{}, {"model": "ray-tracing", "scene": "room"}, {"model": "kriging"}], ids=str)
def test_a_sweep_is_refused_before_its_first_run(arguments: dict, two_gateways: Record, monkeypatch: Any) -> None:
    row = int(official(two_gateways).train[0])
    broken = changed(two_gateways, ((0, row, 0, 0), np.nan))
    monkeypatch.setattr(sweep, "_record", lambda dataset: broken)
    refusal(sweep.check_run, "broken", RunRequest(**arguments), f"row {row}: 1 of 800 values are not finite")


DIRECT = TraceOptions(reflection=False, depth=0)


@pytest.fixture
def silent(flat_folder: Path) -> Record:
    """Strengths in the flat, of which the second anchor received none of the training rows."""
    flat = load(flat_folder)
    return changed(replace(flat, name="silent"), ((1, flat.official[0]), np.nan))


@pytest.mark.parametrize("model", ["ray-tracing", "kriging", "mri"])
def test_a_gateway_without_training_rows_is_left_out_where_asked(model, silent, room, tmp_path, caplog):
    settings, scene = (DIRECT, room) if model == "ray-tracing" else ((), None)
    left_out, alone = (
        train(data, model, out=tmp_path / name, scene=scene, settings=settings, min_rows=2)
        for name, data in (("run", silent), ("alone", silent.at_receivers([0])))
    )
    assert left_out.metrics["receivers_left_out"] == {"anchor2": 0}
    assert left_out.metrics["abs_error_db"] == alone.metrics["abs_error_db"]
    (message,) = [record.message for record in caplog.records if record.name == "wrf_mi.datasets.observations"]
    expected = "receivers with fewer than 2 training rows are left out, with their number of rows: anchor2 (0)"
    assert message == f"silent: {expected}"


def test_data_without_a_received_training_row_are_refused_first(silent: Record, room: Path, tmp_path: Path) -> None:
    record = changed(silent, ((slice(None), slice(3)), np.nan))
    split = Split("mine", 0, np.arange(3), np.zeros(0, np.int64), np.arange(3, 5))
    stages: list[str] = []
    message = r"nothing was received in the training rows by any receiver \(anchor1, anchor2\); use another split"
    for model, options in (("ray-tracing", {"scene": room, "settings": DIRECT}), ("kriging", {})):
        options |= {"split": split, "on_progress": lambda *said: stages.append(said[0])}
        refusal(train, record, model, message, out=tmp_path / "run", **options)
        assert not (tmp_path / "run").exists()
    assert stages == []


@pytest.mark.parametrize("split", ["official", "blocked"])
def test_a_gateway_that_no_path_reaches_leaves_nothing_behind(split, flat_folder, room, tmp_path):
    """It is known only from the paths."""
    nothing = TraceOptions(line_of_sight=False, reflection=False, transmission=True, depth=1)
    (tmp_path / "run").mkdir()
    message, options = "no training row is both received and reached by a path", {"scene": room, "settings": nothing}
    refusal(train, flat_folder, "ray-tracing", message, out=tmp_path / "run", split=split, **options)
    assert not (tmp_path / "run").exists()


def test_a_fold_that_is_refused_leaves_the_paths_of_fitted_folds(flat_folder, room, tmp_path, monkeypatch):
    def refused_later(*values: Any) -> Any:
        if (tmp_path / "run" / "fold0" / "model.npz").exists():
            raise InputError("a fault; a remedy")
        return fit_offsets(*values)

    monkeypatch.setattr(ray_tracing, "fit_offsets", refused_later)
    options = {"scene": room, "settings": DIRECT, "split": "blocked"}
    refusal(train, flat_folder, "ray-tracing", "a fault", out=tmp_path / "run", **options)
    assert (tmp_path / "run" / "paths.npz").exists()


@pytest.mark.parametrize(("module", "stage"), [(ray_tracing, "fit_offsets"), (runs, "score_part")])
@pytest.mark.parametrize("split", ["official", "blocked"])
def test_a_stopped_trace_goes_on_with_its_paths(
    module: Any,
    stage: str,
    split: str,
    flat_folder: Path,
    room: Path,
    tmp_path: Path,
    monkeypatch: Any,
    command: Command,
) -> None:
    def stopped(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    out = tmp_path / "run"
    with monkeypatch.context() as patch:
        patch.setattr(module, stage, stopped)
        with pytest.raises(KeyboardInterrupt):
            train(flat_folder, "ray-tracing", out=out, scene=room, settings=DIRECT, split=split)
    written = (out / "paths.npz").stat().st_mtime_ns  # an hour's work may lie there
    again = ["train", flat_folder, "--model", "ray-tracing", "--scene", room, "--paths", "line-of-sight", "--depth", 0]
    command.refused([*again, "--out", out], f"{out}: exists and is not empty; choose another --out")
    command.refused(["compare", out, "--out", tmp_path / "page"], "no metrics.json, so no finished run; finish it")
    command.done(["train", "--resume", out])
    assert (out / "paths.npz").stat().st_mtime_ns == written
    assert read_run(out).metrics["paths"] > 0


MANY = tuple(Receiver(f"ap{number}", np.zeros(3), np.array([0.0, 0, 0, 1])) for number in range(300))
SIX = "ap0{0}, ap1{0}, ap2{0}, ap3{0}, ap4{0}, ap5{0} and 294 more"


def strengths_of_many(dbm: float) -> tuple[Record, Split]:
    """Twelve rows of 300 receivers, of which the first three train, and their split."""
    rows = np.arange(12)
    tx_pos_m = np.stack([rows, rows % 3, np.ones(12)], axis=1).astype(float)
    observation = np.full((300, 12), -60.0, np.float32)
    observation[:, :3] = dbm
    split = Split("official", 0, rows[:3], rows[:0], rows[3:])
    return Record("many", "rssi", tx_pos_m, MANY, observation, official=(rows[:3], rows[3:])), split


def test_refusal_of_hundreds_of_receivers_names_six():
    record, split = strengths_of_many(np.nan)
    refusal(fitted_receivers, record, [split], rf"by any receiver \({SIX.format('')}\); use another split")


def test_warning_of_hundreds_of_receivers_left_out_names_six(caplog: pytest.LogCaptureFixture):
    warn_of_left_out(strengths_of_many(-60)[0], {receiver.name: 1 for receiver in MANY})
    assert caplog.messages[0].endswith(f"with their number of rows: {SIX.format(' (1)')}")


def test_suspicion_of_hundreds_of_receivers_with_few_rows_names_six():
    record, _ = strengths_of_many(-60)
    silent = changed(record, (np.s_[:299, 3:], np.nan))
    ((_, text),) = few_rows(replace(silent, official=None))
    assert "received by ap0 (3), ap1 (3), ap2 (3), ap3 (3), ap4 (3), ap5 (3) and 293 more: fits" in text


def test_summary_of_hundreds_of_receivers_names_six():
    assert f"received:         {SIX.format(' 12')}\n" in render(summary(strengths_of_many(-60)[0]))


def test_training_rows_at_one_place_are_told(caplog: pytest.LogCaptureFixture):
    record, split = strengths_of_many(-60)
    warn_of_one_place(record, [split])
    assert not caplog.messages
    tx_pos_m = record.tx_pos_m.copy()
    tx_pos_m[split.train] = 1.0
    warn_of_one_place(replace(record, tx_pos_m=tx_pos_m), [split])
    assert "all of 3 training rows are at one place" in caplog.messages[0]
