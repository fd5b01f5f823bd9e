"""Several runs side by side: a table, score distributions, spectra and training curves."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core.files import write_atomically

from . import figures
from .run_folder import Run, read_runs

QUANTILES = (0.1, 0.5, 0.9)
"""Test rows that are shown: those at these quantiles of the first run's similarity."""

BLEND = "blend of 4 nearest"

COLUMNS = {
    "run": "run",
    "model": "model",
    "split": "split",
    "seed": "seed",
    "n_train": "training rows",
    "n_test": "test rows",
    "ssim_median": "SSIM median",
    "ssim_mean": "mean",
    "ssim_p10": "p10",
    "ssim_p90": "p90",
    "idw4_median": f"{BLEND}, median",
    "ms_per_sample": "ms per spectrum",
    "train_seconds": "training (s)",
    "peak_memory_mb": "peak memory (MB)",
}
"""Columns of ``compare.csv`` and their headings in ``index.html``."""


def compare(run_dirs: Sequence[str | Path], out: str | Path) -> Path:
    """Write the comparison of several runs.

    Writes into ``out`` (made if need be): ``compare.csv``, one row per run; ``ssim_cdf.png``;
    ``spectra.png``, test rows at fixed quantiles of the first run's similarity, truth beside each run and the blend;
    ``training.png``, validation similarity over seconds, if a run was trained; and ``index.html`` with all of it.

    Args:
        run_dirs: run folders on spectra.
        out: folder to write to.

    Returns:
        Path of ``index.html``.

    Raises:
        InputError: no run, or a folder that is not one.
    """
    runs = read_runs(run_dirs)
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    table = [_table_row(run) for run in runs]
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(COLUMNS), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    write_atomically(folder / "compare.csv", text.getvalue())

    pictures = [("ssim_cdf.png", "Similarity over test rows", _cdf(runs)), ("spectra.png", *_spectra(runs))]
    curves = {f"{run.name} {fold}".strip(): points for run in runs for fold, points in run.validation.items()}
    if curves:
        pictures.append(("training.png", "Training", figures.training_curves(curves)))
    for name, _, figure in pictures:
        figures.save(figure, folder / name)
    return write_atomically(folder / "index.html", _page(table, [(name, title) for name, title, _ in pictures]))


def _table_row(run: Run) -> dict[str, Any]:
    metrics = run.metrics
    return {
        "run": run.name,
        "seed": run.seed,
        **{f"ssim_{key}": metrics["ssim"].get(key) for key in ("median", "mean", "p10", "p90")},
        "idw4_median": metrics["reference"]["idw4"]["median"],
        **{key: metrics[key] for key in COLUMNS if key in metrics and key != "seed"},
    }


def _cdf(runs: Sequence[Run]) -> Any:
    """Each run's distribution, and the blend's once for runs with the same training and test rows."""
    references: dict[str, Any] = {}
    for run in runs:
        if any(np.array_equal(run.reference_ssim, known) for known in references.values()):
            continue
        name = f"{BLEND}, {run.metrics['split']}"
        references[f"{name} of {run.name}" if name in references else name] = run.reference_ssim
    return figures.score_cdf({run.name: run.ssim for run in runs}, references)


def _spectra(runs: Sequence[Run]) -> tuple[str, Any]:
    """Heading and picture of a few test rows, chosen among those that all runs predict, else the first run's."""
    first = runs[0]
    shared = np.array([all(_position(run, first, m) is not None for run in runs) for m in range(len(first.row))])
    candidates = np.flatnonzero(shared if shared.any() else np.ones_like(shared))
    score = first.ssim[:, candidates]
    order = np.argsort(score, axis=None, kind="stable")
    rows = []
    for quantile in QUANTILES:
        receiver, chosen = np.unravel_index(order[round(quantile * (len(order) - 1))], score.shape)
        m = int(candidates[chosen])
        places = [_position(run, first, m) for run in runs]
        name = f"row {first.row[m]}" + (f", receiver {receiver}" if len(first.truth) > 1 else "")
        predictions = [None if p is None else run.prediction[receiver, p] for run, p in zip(runs, places, strict=True)]
        rows.append((name, [first.truth[receiver, m], *predictions, first.reference[receiver, m]]))
    columns = ["truth", *(run.name for run in runs), f"{BLEND} ({first.metrics['split']})"]
    percent = ", ".join(f"{100 * q:g}" for q in QUANTILES)
    heading = f"Test rows at the {percent} % quantiles of the similarity of {first.name}"
    return heading, figures.spectrum_table(rows, columns)


def _position(run: Run, first: Run, m: int) -> int | None:
    """Where ``run`` keeps test row ``m`` of ``first``; None if it has not, or if it is another measurement."""
    found = np.flatnonzero(run.row == first.row[m])
    if len(found) != 1 or len(run.truth) != len(first.truth):
        return None
    return int(found[0]) if np.array_equal(run.truth[:, found[0]], first.truth[:, m]) else None


def _page(table: Sequence[dict[str, Any]], pictures: Sequence[tuple[str, str]]) -> str:
    """A plain page with the table and the pictures."""
    head = "".join(f"<th>{html.escape(title)}</th>" for title in COLUMNS.values())
    body = "\n".join("<tr>" + "".join(f"<td>{_cell(row[key])}</td>" for key in COLUMNS) + "</tr>" for row in table)
    images = "\n".join(
        f'<h2>{html.escape(title)}</h2>\n<img src="{name}" alt="{html.escape(title)}">' for name, title in pictures
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>Comparison of runs</title>
<style>
body {{ font-family: sans-serif; margin: 2em; }}
table {{ border-collapse: collapse; }}
th, td {{ border-bottom: 1px solid #ccc; padding: 0.3em 0.6em; text-align: right; }}
th:nth-child(-n+3), td:nth-child(-n+3) {{ text-align: left; }}
img {{ max-width: 100%; }}
</style>
<h1>Comparison of runs</h1>
<p>SSIM is scikit-image's structural similarity with a data range of one; the {BLEND} training spectra,
weighted by inverse squared distance, stands beside each run on the same test rows.</p>
<table>
<tr>{head}</tr>
{body}
</table>
<p>The same as <a href="compare.csv">CSV</a>.</p>
{images}
</html>
"""


def _cell(value: Any) -> str:
    """A value of the table as text: four significant digits, nothing for what is unknown."""
    if value is None:
        return ""
    return f"{value:.4g}" if isinstance(value, float) else html.escape(str(value))
