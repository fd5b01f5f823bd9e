"""Pictures of test rows: the measured, the predictions of runs and the interpolation side by side."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..core import Prediction
from ..tasks import TASKS
from . import figures
from .results import Results

QUANTILES = (0.1, 0.5, 0.9)  # quantiles of the first run's score at which spectra of test rows are shown


def samples(runs: Sequence[Results]) -> tuple[str, Figure]:
    """Heading and picture of test rows of runs on one data set: spectra of some rows, or power over positions."""
    return _spectra(runs) if TASKS[runs[0].task].image else _maps(runs)


def _spectra(runs: Sequence[Results]) -> tuple[str, Figure]:
    """Heading and picture of a few test rows, chosen among those that all runs predict, else the first run's."""
    first, positions = runs[0], indices(runs)
    shared = (positions >= 0).all(axis=0)
    candidates = np.flatnonzero(shared if shared.any() else np.ones_like(shared))
    score = first.score[:, candidates]
    order = np.argsort(score, axis=None, kind="stable")
    rows = []
    for quantile in QUANTILES:
        receiver, chosen = np.unravel_index(order[round(quantile * (len(order) - 1))], score.shape)
        m = candidates[chosen]
        name = f"row {first.row[m]}" + (f", {first.receivers[receiver]}" if len(first.truth) > 1 else "")
        columns = zip(runs, positions[:, m], strict=True)
        predicted = [None if p < 0 else run.prediction[receiver, p] for run, p in columns]
        rows.append((name, [first.truth[receiver, m], *predicted, first.reference[receiver, m]]))
    percent = ", ".join(f"{100 * q:g}" for q in QUANTILES)
    heading = f"Test rows at the {percent} % quantiles of the score of {first.name}"
    return heading, figures.spectrum_table(rows, _columns(runs))


def _columns(runs: Sequence[Results]) -> list[str]:
    return ["measured", *(run.name for run in runs), f"{runs[0].reference_name} ({runs[0].metrics['split']})"]


def _maps(runs: Sequence[Results]) -> tuple[str, Figure]:
    """Heading and picture of each receiver's power over the first run's test positions, or rows without positions.

    Receivers without a test value, as trained ones are where others are held out, are left out.
    """
    first = runs[0]
    aligned = [_aligned(run, indices) for run, indices in zip(runs, indices(runs), strict=True)]
    maps, task = [first.truth, *aligned, first.reference], TASKS[first.task]
    rows = [
        (name, [None if values is None else task.level(Prediction(values[r])).mean for values in maps])
        for r, name in enumerate(first.receivers)
        if np.isfinite(first.truth[r]).any()
    ]
    heading = "Power at each receiver over the test {} of " + first.name
    if not np.isfinite(first.tx_pos_m).all():
        return heading.format("rows"), figures.row_table(rows, _columns(runs), first.row, task.quantity)
    return heading.format("positions"), figures.position_table(rows, _columns(runs), first.tx_pos_m, task.quantity)


def _aligned(run: Results, positions: np.ndarray) -> np.ndarray | None:
    """Predictions of a run at the given indices, NaN where that is -1; None where all are."""
    if (positions < 0).all():
        return None
    values = run.prediction[:, positions]
    values[:, positions < 0] = np.nan
    return values


def indices(runs: Sequence[Results]) -> np.ndarray:
    """Index in each run of each test row of the first, [n, m]; -1 where it is absent or another measurement."""
    first = runs[0]
    places = np.full((len(runs), len(first.row)), -1)
    for index, run in zip(places, runs, strict=True):
        for m, row in enumerate(first.row) if len(run.truth) == len(first.truth) else ():
            same = np.flatnonzero(run.row == row)
            if len(same) == 1 and np.array_equal(run.truth[:, same[0]], first.truth[:, m], equal_nan=True):
                index[m] = same[0]
    return places
