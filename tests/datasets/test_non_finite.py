"""Observations that are not finite: refused in training rows by every model, not scored in test rows."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import stored
from small_fits import official, settings

from wrf_mi.core import InputError, Record
from wrf_mi.datasets.observations import scorable
from wrf_mi.runs import sweep
from wrf_mi.runs.api import train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.evaluate import evaluate
from wrf_mi.runs.folder import RunRequest


def changed(record: Record, *changes: tuple[Any, float]) -> Record:
    """The record with other values at some places of its observations."""
    observation = record.observation.copy()
    for place, value in changes:
        observation[place] = value
    return replace(record, observation=observation)


def train_field(record: Record, out: Path, split: str = "official") -> Path:
    return train(record, out, "wrf-gs+", settings=settings("steps=2", "deterministic=true"), split=split).folder


def train_idw(record: Record, out: Path, split: str = "official") -> Path:
    return train(record, out, "idw", split=split).folder


BOTH = pytest.mark.parametrize("train", [train_field, train_idw])


@BOTH
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", ["train", "validation"])
def test_training_rows_are_refused_before_anything_is_written(
    train: Callable[..., Path], value: float, part: str, two_gateways: Record, tmp_path: Path
) -> None:
    row = int(getattr(official(two_gateways), part)[0])
    name = two_gateways.receivers[1].name
    with pytest.raises(InputError) as error:
        train(changed(two_gateways, ((1, row, 4, 5), value)), tmp_path / "run")
    message = f"made-here, receiver {name}, row {row}: 1 of 800 values are not finite; correct or remove the row"
    assert str(error.value) == message
    assert not (tmp_path / "run").exists()


def test_a_row_of_a_later_fold_is_refused_at_once(two_gateways: Record, tmp_path: Path) -> None:
    folded = replace(two_gateways, folds=np.arange(len(two_gateways)) % 2)
    with pytest.raises(InputError, match="row 2: 1 of 800"):  # it trains in the second fold alone
        train_field(changed(folded, ((0, 2, 4, 5), np.nan)), tmp_path / "run", "blocked")
    assert not (tmp_path / "run").exists()


def test_fields_need_every_receiver_in_every_row(two_gateways: Record, tmp_path: Path) -> None:
    """Other models are fitted to the rows that a receiver received."""
    row = int(official(two_gateways).train[0])
    missed = changed(two_gateways, ((1, row), np.nan))
    with pytest.raises(InputError, match=f"row {row}: 800 of 800 .*; remove the row or choose another model"):
        train_field(missed, tmp_path / "field")
    train_idw(missed, tmp_path / "idw")


@BOTH
def test_test_rows_that_are_not_finite_are_counted_and_not_scored(
    train: Callable[..., Path], two_gateways: Record, tmp_path: Path
) -> None:
    a, b, c = (int(row) for row in official(two_gateways).test[:3])
    broken = changed(two_gateways, ((0, a, 4, 5), np.nan), ((1, b), np.inf), ((1, c), np.nan))
    whole, found = train(two_gateways, tmp_path / "whole"), train(broken, tmp_path / "broken")
    metrics = json.loads((found / "metrics.json").read_text())
    assert metrics["n_not_scored"] == 2
    assert json.loads((whole / "metrics.json").read_text())["n_not_scored"] == 0
    rows = len(official(two_gateways).test)
    names = [receiver.name for receiver in two_gateways.receivers]
    assert [metrics["receivers"][name]["n_test"] for name in names] == [rows - 1, rows - 2]
    np.testing.assert_array_equal(stored(found)["prediction"], stored(whole)["prediction"])
    assert np.isnan(stored(found)["truth"]).reshape(2, rows, -1).all(axis=2).sum(axis=1).tolist() == [1, 2]
    assert np.isfinite(list(metrics["ssim"].values())).all()
    compare([found, whole], tmp_path / "compare")


def test_a_split_without_a_finite_test_row_is_refused(two_gateways: Record) -> None:
    split = official(two_gateways)
    broken = changed(two_gateways, ((slice(None), split.test, 0, 0), np.nan))
    with pytest.raises(InputError, match="split official: no test row to score is finite; use another split"):
        evaluate(broken, split, lambda rows, receiver: broken.observation[receiver, rows])


def test_finite_and_missing_observations_stay(two_gateways: Record) -> None:
    missed = changed(two_gateways, ((0, 3), np.nan)).observation
    kept, count = scorable(missed)
    assert kept is missed
    assert count == 0


@pytest.mark.parametrize("arguments", [{}, {"model": "ray-tracing", "scene": "room"}, {"model": "kriging"}], ids=str)
def test_a_sweep_is_refused_before_its_first_run(
    arguments: dict[str, str], two_gateways: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    row = int(official(two_gateways).train[0])
    broken = changed(two_gateways, ((0, row, 0, 0), np.nan))
    monkeypatch.setattr(sweep, "_record", lambda dataset: broken)
    with pytest.raises(InputError, match=f"row {row}: 1 of 800 values are not finite"):
        sweep.check_run("broken", RunRequest(**arguments))
