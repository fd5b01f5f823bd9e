"""Comparison of runs: table, score distributions, samples with their truth, training curves."""

from __future__ import annotations

import base64
import html
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..core import InputError, Prediction
from ..core.files import write_atomically, write_figure
from ..models.ray_tracing import PATHS
from ..tasks import TASKS
from . import figures
from .folder import FITTED
from .results import Results, read_runs, write_csv
from .scene_view import scene_view

QUANTILES = (0.1, 0.5, 0.9)
"""Quantiles of the first run's score at which spectra of test rows are shown."""

COLUMNS = {
    "run": "run",
    "model": "model",
    "dataset": "data set",
    "split": "split",
    "seed": "seed",
    "n_train": "training rows",
    "n_test": "test rows",
    "metric": "score",
    "median": "median",
    "mean": "mean",
    "p10": "p10",
    "p90": "p90",
    "inside_90": "inside 90 %",
    "crps": "CRPS",
    "ms_per_sample": "ms per sample",
    "train_seconds": "training (s)",
    "peak_memory_mb": "peak memory (MB)",
}
"""Columns of ``compare.csv`` and their headings in ``index.html``."""

Picture = tuple[str, str, Figure]
"""File name, heading, figure."""


def compare(run_dirs: Sequence[str | Path], out: str | Path) -> Path:
    """Write a comparison of runs.

    Runs on the same data set are compared on the same test rows, with their references (`wrf_mi.tasks.TASKS`). Writes
    into ``out`` (made if need be): ``compare.csv``, one row per run and reference; for each data set
    ``<data set>-cdf.png``, ``<data set>-samples.png`` with the truth beside each prediction, ``<data set>-scene.png``
    if one was traced and ``<data set>-training.png`` if one was trained; and ``index.html``, one file with all of it.

    Args:
        run_dirs: run folders.
        out: folder to write to.

    Returns:
        Path of ``index.html``.

    Raises:
        InputError: no run, or a folder that is not a run.
    """
    groups = _groups(read_runs(run_dirs))
    table = [row for runs in groups.values() for row in _rows(runs)]
    sections = [
        (f"{Path(runs[0].dataset).name}: {TASKS[runs[0].task].heading}", _pictures(slug, runs))
        for slug, runs in groups.items()
    ]
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    write_csv(folder / "compare.csv", table, list(COLUMNS))
    for _, pictures in sections:
        for name, _, figure in pictures:
            write_figure(folder / name, figures.without_formulas(figure))
    shown = [(heading, [(folder / name, title) for name, title, _ in pictures]) for heading, pictures in sections]
    return write_atomically(folder / "index.html", _page(table, shown))


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


def _rows(runs: Sequence[Results]) -> list[dict[str, Any]]:
    """Rows of the table for a data set: each run, and each reference once."""
    label, block_name = TASKS[runs[0].task].label, TASKS[runs[0].task].block
    named = [
        ({key: run.metrics[key] for key in COLUMNS if key in run.metrics} | {"run": run.name, "seed": run.seed}, block)
        for run in runs
        for block in [run.metrics[block_name]]
    ]
    for name, (run, key) in _references(runs).items():
        kept = {column: run.metrics[column] for column in ("split", "n_train", "n_test")}
        named.append((kept | {"run": name, "model": key}, run.metrics["reference"][key]))
    common = {"dataset": runs[0].dataset, "metric": label}
    scores = ("median", "mean", "p10", "p90")
    rows = [row | common | {key: block.get(key) for key in scores} for row, block in named]
    return [{key: row.get(key) for key in COLUMNS} for row in rows]


def _references(runs: Sequence[Results]) -> dict[str, tuple[Results, str]]:
    """A run and the key of each reference by name, once for runs with the same training and test rows."""
    found: dict[str, tuple[Results, str]] = {}
    for run in runs:
        for key, scores in run.reference_scores.items():
            known = (r.reference_scores[key] for r, k in found.values() if k == key)
            if any(np.array_equal(scores, other, equal_nan=True) for other in known):
                continue
            name = f"{TASKS[run.task].references[key]}, {run.metrics['split']}"
            found[f"{name} of {run.name}" if name in found else name] = run, key
    return found


def _pictures(slug: str, runs: Sequence[Results]) -> list[Picture]:
    task = TASKS[runs[0].task]
    cdf = figures.score_cdf(
        {run.name: run.score for run in runs},
        {name: run.reference_scores[key] for name, (run, key) in _references(runs).items()},
        task.label,
    )
    samples = _spectra(runs) if task.image else _maps(runs)
    pictures: list[Picture] = [
        (f"{slug}-cdf.png", f"{task.label} over test rows", cdf),
        (f"{slug}-samples.png", *samples),
    ]
    if (view := _scene(runs)) is not None:
        pictures.append((f"{slug}-scene.png", "Mesh, traced paths and the strongest Gaussians of the field", view))
    curves = {f"{run.name} {fold}".strip(): points for run in runs for fold, points in run.validation.items()}
    if curves:
        pictures.append((f"{slug}-training.png", "Training", figures.training_curves(curves, task.label)))
    return pictures


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
    positions = _positions(runs)
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
    """Heading and picture of each receiver's power over the first run's test positions, or rows without positions."""
    first = runs[0]
    aligned = [_aligned(run, indices) for run, indices in zip(runs, _positions(runs), strict=True)]
    maps, task = [first.truth, *aligned, first.reference], TASKS[first.task]
    rows = [
        (name, [None if values is None else task.level(Prediction(values[r])).mean for values in maps])
        for r, name in enumerate(first.receivers)
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


def _positions(runs: Sequence[Results]) -> np.ndarray:
    """Index in each run of each test row of the first, [n, m]; -1 where it is absent or another measurement."""
    first = runs[0]
    found = np.full((len(runs), len(first.row)), -1)
    for index, run in zip(found, runs, strict=True):
        for m, row in enumerate(first.row) if len(run.truth) == len(first.truth) else ():
            same = np.flatnonzero(run.row == row)
            if len(same) == 1 and np.array_equal(run.truth[:, same[0]], first.truth[:, m], equal_nan=True):
                index[m] = same[0]
    return found


def _page(table: Sequence[dict[str, Any]], sections: Sequence[tuple[str, Sequence[tuple[Path, str]]]]) -> str:
    """HTML page with the table, and each data set's pictures embedded."""
    head = "".join(f"<th>{html.escape(title)}</th>" for title in COLUMNS.values())
    body = "\n".join("<tr>" + "".join(f"<td>{_cell(row[key])}</td>" for key in COLUMNS) + "</tr>" for row in table)
    images = "\n".join(
        f"<h2>{html.escape(heading)}</h2>\n" + "\n".join(_image(path, title) for path, title in pictures)
        for heading, pictures in sections
    )
    shown = {row["metric"] for row in table}
    notes = "\n".join(f"<li>{html.escape(task.note)}</li>" for task in TASKS.values() if task.label in shown)
    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>Comparison of runs</title>
<style>
body {{ font-family: sans-serif; margin: 2em; }}
table {{ border-collapse: collapse; }}
th, td {{ border-bottom: 1px solid #ccc; padding: 0.3em 0.6em; text-align: right; }}
th:nth-child(-n+4), td:nth-child(-n+4) {{ text-align: left; }}
img {{ max-width: 100%; }}
</style>
<h1>Comparison of runs</h1>
<table>
<tr>{head}</tr>
{body}
</table>
<ul>
{notes}
</ul>
{images}
</html>
"""


def _image(path: Path, title: str) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<h3>{html.escape(title)}</h3>\n<img src="data:image/png;base64,{data}" alt="{html.escape(title)}">'


def _cell(value: Any) -> str:
    """Text of a value: four significant digits, empty where unknown."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))
