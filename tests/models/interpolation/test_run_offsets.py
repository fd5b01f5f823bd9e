"""Offsets of the runs of a measurement, and predictions for other runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_walks import STEPS, walked

from wrf_mi.core import Record, Split
from wrf_mi.core.stored import from_arrays, to_arrays
from wrf_mi.datasets import make_splits
from wrf_mi.estimators.interpolation.run_offsets import RUN_SD_DB, RunOffsets
from wrf_mi.estimators.interpolation.strengths import Strengths, fit_strengths
from wrf_mi.estimators.model import Inputs
from wrf_mi.runs.api import train

OFFSETS = dict(zip("abcdefghij", (9.0, -8.0, 5.0, -6.0, 0.0, 7.0, -4.0, -3.0, 0.0, 0.0), strict=True))
WITHIN_DB = 1.5
"""Of an offset: a walk crosses seven others at two or three stops of eight receivers each, whose noise and shadowing
over a metre make 3 dB a difference."""


@pytest.fixture(scope="module")
def record() -> Record:
    return walked(OFFSETS)


@pytest.fixture(scope="module")
def split(record: Record) -> Split:
    return make_splits(record, "official")[0]


@pytest.fixture(scope="module")
def fitted(record: Record, split: Split) -> Strengths:
    return fit_strengths(record, split.all_train, runs=True)


def test_offsets_are_told_where_runs_cross(fitted: Strengths) -> None:
    assert fitted.offsets is not None
    true = np.array([OFFSETS[name] for name in fitted.offsets.names])
    np.testing.assert_allclose(fitted.offsets.offset_db, true - true.mean(), atol=WITHIN_DB)
    assert fitted.offsets.sd_db == pytest.approx(true.std(), rel=0.4)  # of eight draws


def offsets_of(record: Record) -> RunOffsets:
    fitted = fit_strengths(record, np.arange(len(record)), runs=True, calibrate=False)
    assert fitted.offsets is not None
    return fitted.offsets


def test_runs_that_never_meet_have_no_offsets() -> None:
    record = walked({"a": 9.0, "b": -9.0, "c": 0.0, "d": 0.0, "e": 0.0})
    apart = record.tx_pos_m + np.repeat(np.arange(5), STEPS)[:, None] * [0.0, 1000.0, 0.0]
    offsets = offsets_of(replace(record, tx_pos_m=apart))
    assert (offsets.sd_db, offsets.offset_db.tolist()) == (RUN_SD_DB, [0.0] * 5)


def test_rows_without_a_run_and_runs_that_nobody_received_change_no_offset(record: Record) -> None:
    every = offsets_of(record)
    runs, observation = record.runs, record.observation.copy()
    assert runs is not None
    unnamed = offsets_of(replace(record, runs=np.where(runs == "a", "", runs)))
    assert "a" not in unnamed.names
    np.testing.assert_allclose(unnamed.offset_db, every.offset_db[1:], atol=WITHIN_DB)
    observation[:, runs == "a"] = np.nan
    silent = offsets_of(replace(record, observation=observation))
    np.testing.assert_array_equal(silent.names, unnamed.names)
    np.testing.assert_allclose(silent.offset_db, unnamed.offset_db)


def test_another_run_is_as_uncertain_as_runs_differ(fitted: Strengths, record: Record) -> None:
    assert fitted.offsets is not None
    where = record.tx_pos_m[:4]
    other, mean, same_run = (
        fitted.predict(Inputs(where, runs=runs), 0) for runs in (None, np.full(4, ""), np.full(4, "a"))
    )
    assert other.std is not None
    assert mean.std is not None
    np.testing.assert_allclose(other.mean, mean.mean)
    np.testing.assert_allclose(other.std**2 - mean.std**2, (fitted.offsets.sd_db * fitted.widen[0]) ** 2)
    np.testing.assert_allclose(same_run.mean - mean.mean, fitted.offsets.offset_db[0])
    np.testing.assert_allclose(fitted.predict_mean(Inputs(where, runs=np.full(4, "a")), 0), same_run.mean)
    again = from_arrays(RunOffsets, to_arrays(fitted.offsets))
    np.testing.assert_array_equal(again.of(np.array(["b", "", "z"]), 3), fitted.offsets.of(np.array(["b", "", "z"]), 3))


POOLED_DB = 2.7
"""Median error of the test walks where no walk has an offset: `train` of `walked` with offsets of 0."""


def test_the_engine_takes_offsets_where_runs_differ(record: Record, tmp_path: Path) -> None:
    metrics = train(record, "kriging", split="official", out=tmp_path / "run").metrics
    assert [each["option"] for each in metrics["options"] if each["stage"] == "runs" and each["taken"]] == ["offsets"]
    # Test walks have no offset: what offsets of the others leave is little more than without any.
    assert metrics["abs_error_db"]["median"] < POOLED_DB + 1
    assert metrics["inside_90"] > 0.85
