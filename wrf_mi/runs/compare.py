"""Comparison of runs: tables and pictures in a folder, and one page with all of it."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import atomic_folder, listed, write_atomically, write_csv, write_figure
from ..estimators.ray_tracing import PATHS
from ..scene.drawing import without_formulas
from ..tasks import TASKS
from ..training.session import OnProgress, quiet
from . import figures
from .compare_page import Section, page
from .compare_tables import (
    COLUMNS,
    DIFFERENCES,
    METHODS,
    difference_rows,
    differences,
    method_rows,
    references,
    score_rows,
)
from .folder import FITTED
from .results import Results, read_runs
from .sample_figures import indices, samples
from .scene_view import scene_view

INDEX = "index.html"

Picture = tuple[str, str, str, Figure]  # name, heading, what is seen in words, figure


def compare(run_dirs: Sequence[str | Path], out: str | Path, on_progress: OnProgress = quiet) -> Path:
    """Write a comparison of runs.

    Runs on the same data set are compared on the same test rows, with their references (`wrf_mi.tasks.TASKS`). Writes
    into ``out``, whole or not at all: ``compare.csv``, one row per run and reference; ``differences.csv``, paired
    differences of each run and its reference and of all pairs of runs, on common rows; ``methods.csv`` where runs are
    several seeds of a method, their means and standard deviations; for each data set pictures
    ``<data set>-*.png`` of score distributions (``cdf``), ``samples`` with the measured beside each predicted, ``time``
    against error of several runs, where positions are known ``errors`` over them and the ``best`` run at each,
    ``scene`` if one was traced and ``training`` if one was trained; and ``index.html``, one file with all of it that
    needs no network.

    Args:
        run_dirs: run folders, of any data sets and tasks.
        out: folder to write; an earlier comparison there is replaced.
        on_progress: progress callback: stage and fraction done.

    Returns:
        Path of ``index.html``.

    Raises:
        InputError: no run, a folder that is not a run, or ``out`` that holds something else than a comparison.

    >>> import tempfile, wrf_mi
    >>> runs = [wrf_mi.train("laboratory", model, n_train=20) for model in ("idw", "kriging")]
    >>> compare([run.folder for run in runs], f"{tempfile.mkdtemp()}/page").name
    'index.html'
    """
    # Runs that share data and task are compared with each other.
    groups = _groups(read_runs(run_dirs))
    out = Path(out)
    if out.exists() and not _is_comparison(out):
        raise InputError(f"{out}: exists and holds something else than a comparison; choose another place")
    with atomic_folder(out, replace=True) as folder:
        # Scores, paired differences and figures of each group.
        sections, drawn = [], []
        for done, (slug, runs) in enumerate(groups.items()):
            on_progress("comparing", done / len(groups))
            shown = pictures(slug, runs)
            drawn += shown
            files = [(folder / name, title, description) for name, title, description, _ in shown]
            sections.append(Section(slug, runs, score_rows(runs), method_rows(runs), differences(runs), files))

        # Tables, pictures, and the page that holds both.
        _write_table(folder / "compare.csv", COLUMNS, (section.scores for section in sections))
        if any(section.methods for section in sections):
            _write_table(folder / "methods.csv", METHODS, (section.methods for section in sections))
        changes = (difference_rows(section.differences) for section in sections)
        _write_table(folder / "differences.csv", DIFFERENCES, changes)
        for done, (name, _, _, figure) in enumerate(drawn):
            on_progress("drawing", done / len(drawn))
            write_figure(folder / name, without_formulas(figure))
        write_atomically(folder / INDEX, page(sections, out))
    return out / INDEX


def _write_table(path: Path, columns: Iterable[str], rows: Iterable[Iterable[Mapping[str, Any]]]) -> None:
    write_csv(path, columns, ([row[key] for key in columns] for row in chain.from_iterable(rows)))


def _is_comparison(folder: Path) -> bool:
    """Whether a folder is empty or holds nothing but the files of `compare`."""
    if not folder.is_dir():
        return False
    suffixes = {file.suffix if file.is_file() else None for file in folder.iterdir()}
    return not suffixes or ((folder / INDEX).is_file() and suffixes <= {".html", ".csv", ".png"})


def _groups(runs: Sequence[Results]) -> dict[str, list[Results]]:
    """Runs by task and data set; the keys are prefixes of file names."""
    by_data: dict[tuple[str, str], list[Results]] = {}
    for run in runs:
        by_data.setdefault((run.task, run.dataset), []).append(run)
    groups: dict[str, list[Results]] = {}
    for (_, dataset), members in by_data.items():
        slug = re.sub(r"[^\w.-]+", "_", Path(dataset).name) or "data"
        while slug in groups:
            slug += "_"
        groups[slug] = members
    return groups


def pictures(slug: str, runs: Sequence[Results]) -> list[Picture]:
    """Pictures of the runs of a data set; ``slug`` begins the names of their files."""
    task = TASKS[runs[0].task]
    of_references = {name: run.reference_scores[key] for name, (run, key) in references(runs).items()}
    cdf = figures.score_cdf({run.name: run.score for run in runs}, of_references, task.label)
    medians = listed((f"{run.name} {run.metrics[task.block]['median']:.3g}" for run in runs), len(runs))
    drawn: list[tuple[str, str, Figure | None]] = [
        ("cdf", f"{task.label} over test rows", cdf),
        ("samples", *samples(runs)),
        ("time", "Time against error", _times(runs) if len(runs) > 1 else None),
        ("stages", "What each stage contributes", _stages(runs)),
        *_error_maps(runs),
        ("scene", "Mesh, traced paths and the strongest Gaussians of the field", _scene(runs)),
        ("training", "Training", _training(runs)),
    ]
    descriptions = {
        "cdf": f"a curve for each run, the share of test rows up to a score; medians: {medians}",
        "samples": "measured beside each run's prediction, a line for each of three test rows",
        "time": f"a point for each run, median score over times of prediction and training; medians: {medians}",
        "stages": "scores on held-out rows, a step for each stage",
        "errors": f"a map for each run, test positions coloured by their score; medians: {medians}",
        "best": "test positions in the colour of the run with the best score there",
        "scene": "seen from above",
        "training": "scores on validation rows over the time of training, a curve for each run",
    }
    shown = [(name, heading, figure) for name, heading, figure in drawn if figure is not None]
    return [
        (f"{slug}-{name}.png", heading, f"{heading}: {descriptions[name]}", figure) for name, heading, figure in shown
    ]


def _times(runs: Sequence[Results]) -> Figure:
    """Median scores over the times of a prediction and of the training."""
    task = TASKS[runs[0].task]
    better = "higher" if task.higher_is_better else "lower"
    medians = {run.name: run.metrics[task.block]["median"] for run in runs}
    times = {"ms per sample": "ms_per_sample", "training time (s)": "train_seconds"}
    panels = {words: {run.name: float(run.metrics[key]) for run in runs} for words, key in times.items()}
    return figures.time_scatter(panels, medians, f"median {task.label}\n({better} is better)")


def _stages(runs: Sequence[Results]) -> Figure | None:
    """What the stages of fits in stages contribute; None without such a fit."""
    stages = {run.name: run.metrics["stages"] for run in runs if run.metrics.get("stages")}
    return figures.stage_steps(stages, TASKS[runs[0].task].label) if stages else None


def _training(runs: Sequence[Results]) -> Figure | None:
    """Scores on validation rows over the time of training; None where no run has stored any."""
    curves = {f"{run.name} {fold}".strip(): points for run in runs for fold, points in run.validation.items()}
    return figures.training_curves(curves, TASKS[runs[0].task].label) if curves else None


def _error_maps(runs: Sequence[Results]) -> list[tuple[str, str, Figure | None]]:
    """Scores over the first run's test positions, and the best run at each that several predict; none without them."""
    first, task = runs[0], TASKS[runs[0].task]
    if not np.isfinite(first.tx_pos_m).all():
        return []
    scores = np.stack([_score_at(run, where) for run, where in zip(runs, indices(runs), strict=True)])
    shown: list[FloatArray | None] = [None if np.isnan(of_run).all() else of_run for of_run in scores]
    names = [run.name for run in runs]
    where = "over receivers, " if len(first.receivers) > 1 else ""
    table = figures.position_table([("", shown)], names, first.tx_pos_m, task.label)
    heading = f"{task.label} at the test positions of {first.name} (mean {where}seen from above)"
    maps: list[tuple[str, str, Figure | None]] = [("errors", heading, table)]
    several = (~np.isnan(scores)).sum(axis=0) > 1
    if several.any():
        ranked = np.where(np.isnan(scores), -np.inf, scores if task.higher_is_better else -scores)
        best = np.where(several, ranked.argmax(axis=0), -1)
        figure = figures.choice_map(best, names, first.tx_pos_m)
        maps.append(("best", "Best run at each test position that several runs predict", figure))
    return maps


def _score_at(run: Results, where: np.ndarray) -> FloatArray:
    """Mean score over receivers at the given columns; NaN where that is -1 or nothing was received."""
    scored = np.isfinite(run.score[:, where]) & (where >= 0)
    total, count = np.where(scored, run.score[:, where], 0).sum(axis=0), scored.sum(axis=0)
    return np.asarray(np.divide(total, count, out=np.full(len(where), np.nan), where=count > 0))


def _scene(runs: Sequence[Results]) -> Figure | None:
    """The first traced run's scene, with the Gaussians of the first field; None where nothing was traced."""
    traced = next((run for run in runs if (run.path / PATHS).exists()), None)
    if traced is None:
        return None
    field = next((run.path for run in runs if run.metrics.get("gaussians") and (run.path / FITTED).exists()), None)
    row = traced.row[np.argsort(np.nanmean(traced.score, axis=0))[len(traced.row) // 2]]
    try:
        return scene_view(traced.path, int(row), field)
    except InputError as error:  # a run folder outlives the scene that it was traced in
        print(f"no picture of the scene of {traced.name}: {error}", file=sys.stderr)
        return None
