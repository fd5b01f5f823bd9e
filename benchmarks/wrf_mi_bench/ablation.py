"""Ablation of the mechanisms of signal strengths: kriging without each of them, by data set.

Kriging of pooled receivers is fitted with all mechanisms and without one, to the rows that a hold-out as far as the
test rows leaves (`wrf_mi.training.selection.hold_out`), and to all training rows. The gain of a mechanism is the mean
absolute error without it less that with it, row by row, of held-out rows and of test rows. A mechanism earns its place
where the interval of its held-out gain lies above zero on two data sets.
"""

import inspect
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from wrf_mi.core import Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import make_splits
from wrf_mi.estimators.held_out import fit_fold
from wrf_mi.estimators.interpolation import pooled_process, strength_fit, strength_settings, strength_terms, strengths
from wrf_mi.estimators.interpolation import strength_trees as trees
from wrf_mi.estimators.model import Problem, Session, default_settings, inputs_of
from wrf_mi.stages import residual
from wrf_mi.stages.kriging import StrengthKriging
from wrf_mi.tasks.scores import bootstrap
from wrf_mi.training.selection import hold_out

from .bench import FLAT
from .buildings import CAMPUS, FLOOR, measured_set
from .comparison import line, measured_on, say, stored_part
from .declared import pivoted

CELLS = ((FLAT, 64), (FLAT, 400), (CAMPUS, 64), (CAMPUS, 200), (FLOOR, None))
"""Data sets and numbers of training rows; None: all."""
SEED = 0


@dataclass(frozen=True)
class Mechanism:
    """What a fit is without: values in place of a module's, or settings; and the code that serves nothing else."""

    without: tuple[tuple[Any, str, Any], ...] = ()
    settings: tuple[str, ...] = ()
    code: tuple[Any, ...] = ()

    @property
    def lines(self) -> int:
        """Lines of that source, comments and docstrings among them."""
        return sum(len(inspect.getsource(part).splitlines()) for part in self.code)


def _option(name: str, *code: Any) -> Mechanism:
    others = tuple(each for each in strength_settings.SHADOWINGS if each != name)
    return Mechanism(((residual, "SHADOWINGS", others),), code=code)


ALL = "all"
MECHANISMS: Mapping[str, Mechanism] = {
    ALL: Mechanism(),
    "choice by held-out rows": Mechanism(((residual, "SHADOWINGS", (strength_settings.DEFAULT,)),)),
    "search": _option(strength_settings.BY_SEARCH, strength_fit.by_search),
    "likelihood": _option(strength_settings.LIKELIHOOD, strength_fit.by_likelihood),
    "trees": _option(strength_settings.TREES, trees),
    "receivers' patterns": Mechanism(((strengths, "RECEIVER_PATTERN_DB", strengths.NO_SHADOW_DB),)),
    "headings": Mechanism(settings=("heading=false",)),
    "Student-t noise": Mechanism(((strengths, "ROBUST_ROUNDS", 0),), code=(pooled_process.PooledProcess._reweighted,)),
    "joined stops": Mechanism(((strengths, "STOP_ROWS", 1),), code=(strength_terms.stops_of,)),
}


def errors(record: Record, split: Split, rows: Any, mechanism: Mechanism) -> FloatArray:
    """Mean absolute error in dB of each of some rows by a fit to a split without a mechanism."""
    model = StrengthKriging()
    with ExitStack() as stack, tempfile.TemporaryDirectory() as place:
        for module, name, value in mechanism.without:
            stack.enter_context(patch.object(module, name, value))
        settings = default_settings(model, mechanism.settings, {"seed": SEED})
        problem = Problem(dataset=record, settings=settings, seed=SEED, stated=frozenset())
        fitted, numbers = fit_fold(model, problem, split, Session(Path(place), Path(place)))
        error = np.full((len(numbers), len(rows)), np.nan)
        for place_of, number in enumerate(numbers):
            predicted = fitted.predict(inputs_of(record, rows), place_of).mean
            error[place_of] = np.abs(predicted - record.observation[number, rows])
    received = np.isfinite(error).any(axis=0)
    return np.asarray(np.nanmean(error[:, received], axis=0))


def measured(record: Record, count: int | None) -> dict[str, Any]:
    """``rows``: of each mechanism the gains on held-out and on test rows, with 95 % intervals, and seconds."""
    (split,) = make_splits(record, "official", SEED, count)
    fold = hold_out(record, split)
    assert fold is not None
    parts: Mapping[str, Callable[[Mechanism], FloatArray]] = {
        "held_out": partial(errors, record, fold, fold.test),
        "test": partial(errors, record, split, split.test),
    }
    rows, all_rows_error = list[dict[str, Any]](), dict[str, FloatArray]()
    for name, mechanism in MECHANISMS.items():
        if name == "headings" and record.tx_heading_rad is None:
            continue
        begun, row = time.perf_counter(), {"mechanism": name, "lines": mechanism.lines}
        for part, of in parts.items():
            error = of(mechanism)
            all_rows_error.setdefault(part, error)
            gain = bootstrap(error - all_rows_error[part], statistic=np.mean)
            row |= {f"{part}_db": float(error.mean()), part: gain.value, f"{part}_low": gain.low}
            row[f"{part}_high"] = gain.high
        rows.append({**row, "seconds": time.perf_counter() - begun})
        say("ablation", f"{record.name}: {name}: {row['held_out']:.3f} dB held out, {row['test']:.3f} dB test")
    return {"rows": rows}


def main() -> dict[str, Any]:
    """Measure the cells that are not stored; ``rows`` has a line for each cell and mechanism."""
    rows, parts = list[dict[str, Any]](), list[dict[str, Any]]()
    with tempfile.TemporaryDirectory() as folder:
        for name, count in CELLS:
            record = measured_set(Path(folder), name)
            cell = f"{record.name}, {'all' if count is None else count} rows"
            parts.append(stored_part("ablation", f"{record.name}-{count or 'all'}", partial(measured, record, count)))
            rows += [{**row, "cell": cell} for row in parts[-1]["rows"]]
    for row in rows:
        interval = f"{row['held_out_low']:+.2f} to {row['held_out_high']:+.2f}"
        row["gain"] = f"{row['held_out']:+.2f} ({interval}); {row['test']:+.2f}"
        if row["mechanism"] == ALL:
            row["gain"] = f"{row['held_out_db']:.2f}; {row['test_db']:.2f}"
        row |= line(f"{row['cell']}: {row['mechanism']}", row["gain"])
    return {"rows": rows, "measured": measured_on(parts)}


table = pivoted(
    "| mechanism (lines): held-out gain in dB, 95 % interval; gain on test rows | ... |",
    "| {mechanism} ({lines}) | ... |",
    "mechanism",
    "cell",
    "{gain}",
)
