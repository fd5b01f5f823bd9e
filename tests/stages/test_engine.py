"""Selection by the engine: options, their order, few rows, resumption, and a stage from outside of the package."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from wrf_mi.core import InputError, Prediction, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.estimators.interpolation.idw import MODEL as IDW
from wrf_mi.estimators.model import Arrays, Fitted, Inputs, Problem, Session
from wrf_mi.stages.engine import CONFIDENCE, LEAST_ROWS, Engine
from wrf_mi.stages.residual import FEW_ROWS
from wrf_mi.stages.stage import Option, Stage, State
from wrf_mi.training.selection import hold_out

ROWS = 60
LEVEL_DBM = -50.0


class Level(Fitted):
    """The same strength everywhere."""

    def __init__(self, level_dbm: float) -> None:
        self.level_dbm = level_dbm

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        return Prediction(np.full(len(inputs), self.level_dbm), np.ones(len(inputs)))

    def arrays(self) -> Arrays:
        return {}


@dataclass
class Levels(Stage):
    """Options that predict levels, with their freedom; the fits that were made are noted."""

    levels: Sequence[tuple[str, float, int]]
    fits: list[tuple[str, int]]
    trusts_default: bool = False
    after: str = ""  # option that the last one goes on from
    name = "level"

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        options = [Option(name, partial(self._fit, name, level), freedom) for name, level, freedom in self.levels]
        return [*options[:-1], options[-1]._replace(after=self.after)]

    def confidence(self, rows: int) -> float | None:
        return CONFIDENCE if self.trusts_default and rows < FEW_ROWS else None

    def _fit(self, name: str, level: float, state: State, split: Split, session: Session) -> State:
        self.fits.append((name, len(split.all_train)))
        if np.isnan(level):
            raise InputError("these data are not for it")
        return replace(state, fitted=Level(level + (0.0 if state.mean is None else state.mean)))


class Shift(Stage):
    """A mean that the levels are about."""

    name = "shift"

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        return [Option(f"{by:g} dB", lambda state, *_, by=by: replace(state, mean=by)) for by in (5.0, 0.0)]


def record_of(rows: int) -> Record:
    rng = np.random.default_rng(0)
    observed = (LEVEL_DBM + rng.normal(0, 2, (1, rows))).astype(np.float32)
    receiver = Receiver("r", np.zeros(3), np.array(UPRIGHT))
    official = np.arange(rows - 2), np.arange(rows - 2, rows)
    return Record("made", "rssi", rng.uniform(0, 9, (rows, 3)), (receiver,), observed, official=official)


def engine_of(folder: Path, stages: Sequence[Stage], rows: int = ROWS) -> Engine:
    record = record_of(rows)
    split = Split("official", 0, record.official[0], np.zeros(0, np.int64), record.official[1])
    return Engine(IDW, stages, Problem(record, None), split, Session(folder, folder))


@pytest.mark.parametrize(
    ("levels", "taken"),
    [
        ([("far", -60.0, 0), ("near", -50.1, 0)], "near"),
        ([("stated", -50.0, 0), ("free", -50.0, 1)], "stated"),  # freedom without a gain
        ([("stated", -55.0, 0), ("free", -50.0, 1)], "free"),
        ([("stated", -50.0, 0), ("other", float("nan"), 0)], "stated"),  # refused by the data
    ],
)
def test_best_option_is_taken_and_reported(levels: list[tuple[str, float, int]], taken: str, tmp_path: Path) -> None:
    fits = list[tuple[str, int]]()
    engine = engine_of(tmp_path, [Levels(levels, fits)])
    fitted = engine.fit().fitted
    assert isinstance(fitted, Level)
    assert fitted.level_dbm == dict((name, level) for name, level, _ in levels)[taken]
    assert [report.option for report in engine.reports if report.taken] == [taken]
    assert {report.option for report in engine.reports} == {name for name, _, _ in levels}
    # All rows are those of the last fit; options are judged without the held-out ones.
    fold = hold_out(record_of(ROWS), engine._split)
    assert fold is not None
    assert fits[-1] == (taken, ROWS - 2)
    assert {rows for _, rows in fits[:-1]} == {len(fold.all_train)}
    assert engine.unseen is not None
    assert len(engine.unseen.mean) == len(fold.test)


@dataclass
class Chained(Levels):
    """Levels, each of which goes on from the one before."""

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        options = super().options(problem, split)
        return [options[0]] + [each._replace(after=before.name) for before, each in pairwise(options)]


@pytest.mark.parametrize(("level", "tried"), [(-51.5, True), (-52.0, False)])
def test_an_option_is_tried_where_the_one_it_goes_on_from_gained(level, tried, tmp_path: Path) -> None:
    levels, fits = [("stated", -52.0, 0), ("second", level, 1), ("third", -50.0, 2)], list[tuple[str, int]]()
    engine = engine_of(tmp_path, [Chained(levels, fits)])
    engine.fit()
    assert ("third" in {name for name, _ in fits}) is tried
    reports = {report.option: report for report in engine.reports}
    assert reports["third"].taken is tried
    assert ("second, which it goes on from, is no better than stated" in reports["third"].why) is not tried


@pytest.mark.parametrize(("level", "tried"), [(-50.5, True), (-52.0, False)])
def test_an_option_that_goes_on_from_another_is_tried_where_that_one_leads(level, tried, tmp_path: Path) -> None:
    levels = [("stated", -54.0, 0), ("rival", -51.0, 1), ("found", level, 1), ("further", -50.0, 1)]
    fits = list[tuple[str, int]]()
    engine = engine_of(tmp_path, [Levels(levels, fits, after="found")])
    engine.fit()
    assert ("further" in {name for name, _ in fits}) is tried
    reports = {report.option: report for report in engine.reports}
    assert list(reports) == [name for name, _, _ in levels]
    assert reports["further"].taken is tried
    assert ("found, which it goes on from, is clearly behind" in reports["further"].why) is not tried


def test_an_option_is_judged_by_the_finished_chain(tmp_path: Path) -> None:
    """A shift that is wrong by itself is right before a level that is 5 dB too low."""
    engine = engine_of(tmp_path, [Shift(), Levels([("low", -55.0, 0)], [])])
    fitted = engine.fit().fitted
    assert isinstance(fitted, Level)
    assert fitted.level_dbm == LEVEL_DBM


def test_few_rows_keep_the_defaults_and_say_so(tmp_path: Path) -> None:
    engine = engine_of(tmp_path, [Levels([("first", -90.0, 0), ("right", -50.0, 0)], [])], rows=7)
    fitted = engine.fit().fitted
    assert isinstance(fitted, Level)
    assert fitted.level_dbm == -90
    assert "too few to choose by" in engine.reports[0].why
    assert engine.unseen is not None
    assert len(engine.unseen.mean) < LEAST_ROWS


@pytest.mark.parametrize(
    ("level", "trusted", "taken"), [(-52.0, True, "first"), (-90.0, True, "right"), (-52.0, False, "right")]
)
def test_few_rows_doubt_options_beside_a_trusted_default(level, trusted, taken, tmp_path):
    engine = engine_of(tmp_path, [Levels([("first", level, 0), ("right", -50.2, 0)], [], trusted)], rows=20)
    engine.fit()
    assert engine.unseen is not None
    assert LEAST_ROWS <= len(engine.unseen.mean) < FEW_ROWS
    assert [report.option for report in engine.reports if report.taken] == [taken]


def test_a_stopped_fit_goes_on_with_the_judged_options(tmp_path: Path) -> None:
    fits = list[tuple[str, int]]()
    stages = [Levels([("far", -60.0, 0), ("near", -50.0, 0)], fits)]
    first = engine_of(tmp_path, stages)
    first.fit()
    fits.clear()
    again = engine_of(tmp_path, stages)
    again.fit()
    # The chosen option alone is fitted again: to the fold, from whose state all rows continue, and to all rows.
    assert [name for name, _ in fits] == ["near", "near"]
    assert again.reports == first.reports


def test_the_default_that_the_data_refuse_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not for it"):
        engine_of(tmp_path, [Levels([("first", float("nan"), 0), ("second", -50.0, 0)], [])]).fit()
