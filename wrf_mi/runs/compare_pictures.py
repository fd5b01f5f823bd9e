"""Pictures of a comparison: distributions, samples with their truth, time and error, maps, training."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from ..core import InputError, Prediction
from ..core.angles import FloatArray
from ..models.ray_tracing import PATHS
from ..tasks import TASKS
from . import figures
from .compare_tables import references
from .folder import FITTED
from .results import Results
from .scene_view import scene_view

QUANTILES = (0.1, 0.5, 0.9)  # quantiles of the first run's score at which spectra of test rows are shown

Picture = tuple[str, str, Figure]
"""File name, heading, figure."""


def pictures(slug: str, runs: Sequence[Results]) -> list[Picture]:
    """Pictures of the runs of a data set; ``slug`` begins the names of their files."""
    task = TASKS[runs[0].task]
    cdf = figures.score_cdf(
        {run.name: run.score for run in runs},
        {name: run.reference_scores[key] for name, (run, key) in references(runs).items()},
        task.label,
    )
    samples = _spectra(runs) if task.image else _maps(runs)
    found: list[Picture] = [
        (f"{slug}-cdf.png", f"{task.label} over test rows", cdf),
        (f"{slug}-samples.png", *samples),
    ]
    better = "higher" if task.higher_is_better else "lower"
    medians = {run.name: run.metrics[task.block]["median"] for run in runs}
    times = {"ms per sample": "ms_per_sample", "training time (s)": "train_seconds"}
    panels = {words: {run.name: float(run.metrics[key]) for run in runs} for words, key in times.items()}
    scatter = figures.time_scatter(panels, medians, f"median {task.label}\n({better} is better)")
    found.append((f"{slug}-time.png", "Time against error", scatter))
    staged = {run.name: run.metrics["stages"] for run in runs if run.metrics.get("stages")}
    if staged:
        found.append((f"{slug}-stages.png", "What each stage contributes", figures.stage_steps(staged, task.label)))
    if np.isfinite(runs[0].tx_pos_m).all():
        found += _error_maps(slug, runs)
    if (view := _scene(runs)) is not None:
        found.append((f"{slug}-scene.png", "Mesh, traced paths and the strongest Gaussians of the field", view))
    curves = {f"{run.name} {fold}".strip(): points for run in runs for fold, points in run.validation.items()}
    if curves:
        found.append((f"{slug}-training.png", "Training", figures.training_curves(curves, task.label)))
    return found


def _error_maps(slug: str, runs: Sequence[Results]) -> list[Picture]:
    """Scores over the first run's test positions, and the best run at each that several predict."""
    first, task = runs[0], TASKS[runs[0].task]
    scores = np.stack([_score_at(run, where) for run, where in zip(runs, indices(runs), strict=True)])
    shown: list[FloatArray | None] = [None if np.isnan(one).all() else one for one in scores]
    names = [run.name for run in runs]
    where = "over receivers, " if len(first.receivers) > 1 else ""
    table = figures.position_table([("", shown)], names, first.tx_pos_m, task.label)
    found: list[Picture] = [
        (
            f"{slug}-errors.png",
            f"{task.label} at the test positions of {first.name} (mean {where}seen from above)",
            table,
        )
    ]
    several = (~np.isnan(scores)).sum(axis=0) > 1
    if several.any():
        ranked = np.where(np.isnan(scores), -np.inf, scores if task.higher_is_better else -scores)
        best = np.where(several, ranked.argmax(axis=0), -1)
        figure = figures.choice_map(best, names, first.tx_pos_m)
        found.append((f"{slug}-best.png", "Best run at each test position that several runs predict", figure))
    return found


def _score_at(run: Results, where: np.ndarray) -> FloatArray:
    """Mean score over receivers at the given columns; NaN where that is -1 or nothing was received."""
    known = np.isfinite(run.score[:, where]) & (where >= 0)
    total = np.where(known, run.score[:, where], 0).sum(axis=0)
    count = known.sum(axis=0)
    result: FloatArray = np.divide(total, count, out=np.full(len(where), np.nan), where=count > 0)
    return result


def _scene(runs: Sequence[Results]) -> Figure | None:
    """The first traced run's scene, with the Gaussians of the first field; None where nothing was traced."""
    traced = next((run for run in runs if (run.path / PATHS).exists()), None)
    if traced is None:
        return None
    learned = (run.path for run in runs if run.metrics.get("gaussians") and (run.path / FITTED).exists())
    field = next(learned, None)
    row = traced.row[np.argsort(np.nanmean(traced.score, axis=0))[len(traced.row) // 2]]
    try:
        return scene_view(traced.path, int(row), field)
    except InputError as error:
        # A run folder outlives the scene that it was traced in.
        print(f"no picture of the scene of {traced.name}: {error}", file=sys.stderr)
        return None


def _spectra(runs: Sequence[Results]) -> tuple[str, Figure]:
    """Heading and picture of a few test rows, chosen among those that all runs predict, else the first run's."""
    first = runs[0]
    positions = indices(runs)
    shared = (positions >= 0).all(axis=0)
    candidates = np.flatnonzero(shared if shared.any() else np.ones_like(shared))
    score = first.score[:, candidates]
    order = np.argsort(score, axis=None, kind="stable")
    rows = []
    for quantile in QUANTILES:
        receiver, chosen = np.unravel_index(order[round(quantile * (len(order) - 1))], score.shape)
        m = candidates[chosen]
        name = f"row {first.row[m]}" + (f", {first.receivers[receiver]}" if len(first.truth) > 1 else "")
        found = [None if p < 0 else run.prediction[receiver, p] for run, p in zip(runs, positions[:, m], strict=True)]
        rows.append((name, [first.truth[receiver, m], *found, first.reference[receiver, m]]))
    percent = ", ".join(f"{100 * q:g}" for q in QUANTILES)
    heading = f"Test rows at the {percent} % quantiles of the score of {first.name}"
    return heading, figures.spectrum_table(rows, _columns(runs))


def _columns(runs: Sequence[Results]) -> list[str]:
    return ["truth", *(run.name for run in runs), f"{runs[0].reference_name} ({runs[0].metrics['split']})"]


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
    quantity = task.quantity
    if not np.isfinite(first.tx_pos_m).all():
        heading = f"Power at each receiver over the test rows of {first.name}"
        return heading, figures.row_table(rows, _columns(runs), first.row, quantity)
    heading = f"Power at each receiver over the test positions of {first.name}"
    return heading, figures.position_table(rows, _columns(runs), first.tx_pos_m, quantity)


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
    found = np.full((len(runs), len(first.row)), -1)
    for index, run in zip(found, runs, strict=True):
        for m, row in enumerate(first.row) if len(run.truth) == len(first.truth) else ():
            same = np.flatnonzero(run.row == row)
            if len(same) == 1 and np.array_equal(run.truth[:, same[0]], first.truth[:, m], equal_nan=True):
                index[m] = same[0]
    return found
