"""Comparison of runs: tables and pictures in a folder, and one page with all of it."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from ..core import InputError
from ..core.files import atomic_folder, write_atomically, write_csv, write_figure
from ..training.session import OnProgress, quiet
from . import figures
from .compare_page import Section, page
from .compare_pictures import pictures
from .compare_tables import COLUMNS, DIFFERENCES, difference_rows, differences, score_rows
from .results import Results, read_runs

INDEX = "index.html"


def compare(run_dirs: Sequence[str | Path], out: str | Path, on_progress: OnProgress = quiet) -> Path:
    """Write a comparison of runs.

    Runs on the same data set are compared on the same test rows, with their references (`wrf_mi.tasks.TASKS`). Writes
    into ``out``, whole or not at all: ``compare.csv``, one row per run and reference; ``differences.csv``, paired
    differences of each run and the best one, and its reference, on common rows; for each data set pictures
    ``<data set>-*.png`` of score distributions (``cdf``), ``samples`` with the truth beside each prediction, ``time``
    against error, where positions are known ``errors`` over them and the ``best`` run at each, ``scene`` if one was
    traced and ``training`` if one was trained; and ``index.html``, one file with all of it that needs no network.

    Args:
        run_dirs: run folders, of any data sets and tasks.
        out: folder to write; an earlier comparison there is replaced.
        on_progress: progress callback: stage and fraction done.

    Returns:
        Path of ``index.html``.

    Raises:
        InputError: no run, a folder that is not a run, or ``out`` that holds something else than a comparison.
    """
    groups = _groups(read_runs(run_dirs))
    out = Path(out)
    if out.exists() and not _is_comparison(out):
        raise InputError(f"{out}: exists and holds something else than a comparison; choose another place")
    with atomic_folder(out, replace=True) as folder:
        sections, drawn = [], []
        for done, (slug, runs) in enumerate(groups.items()):
            on_progress("comparing", done / len(groups))
            shown = pictures(slug, runs)
            drawn += shown
            files = [(folder / name, title) for name, title, _ in shown]
            sections.append(Section(slug, runs, score_rows(runs), differences(runs), files))
        tables = {"compare": (COLUMNS, [row for section in sections for row in section.scores])}
        changes = [row for section in sections for row in difference_rows(section.differences)]
        for name, (columns, rows) in (tables | {"differences": (DIFFERENCES, changes)}).items():
            write_csv(folder / f"{name}.csv", columns, ([row[key] for key in columns] for row in rows))
        for done, (name, _, figure) in enumerate(drawn):
            on_progress("drawing", done / len(drawn))
            write_figure(folder / name, figures.without_formulas(figure))
        write_atomically(folder / INDEX, page(sections, out))
    return out / INDEX


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
