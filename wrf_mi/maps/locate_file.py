"""Observations from a CSV file, and positions to one."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..core import DataFault, Receiver
from ..core.angles import FloatArray
from ..core.files import one_line, write_csv
from ..core.receivers import SHOWN
from ..datasets.folder_files import CsvTable, read_csv
from ..runs.folder import load_rows
from ..runs.run import Run
from ..tasks.scores import summary
from .locate import Positions

DBM, RSSI, ANCHOR = "_dbm", "rssi_", "anchor"
"""Columns are ``<receiver>_dbm``, or ``rssi_<receiver>``, where the name of ``anchor<number>`` is its number."""


def read_observations(
    path: str | Path, receivers: Sequence[Receiver], left_out: Collection[str] = ()
) -> tuple[FloatArray, FloatArray | None]:
    """Read the signal strengths of each receiver from a CSV file with a header.

    A column ``<receiver>_dbm``, as ``wrf-mi predict`` writes it, or ``rssi_<receiver>``, as data sets have it, is
    needed for each receiver; a field is empty where nothing was received. Columns ``x`` and ``y``, if any, are true
    positions in metres. Other columns are ignored, also those of receivers that the run left out of its data.

    Args:
        path: the file.
        receivers: receivers of the run.
        left_out: names of receivers whose columns are ignored.

    Returns:
        Signal strengths [n_rx, m], NaN where nothing was received, and true positions [m, 2], metres, or None.

    Raises:
        InputError: missing or unreadable, a receiver without a column or with several, a column of an unknown receiver,
            a field that is no number, or a row without any strength.
    """
    table = read_csv(Path(path), skip_blank=True)
    names = [receiver.name for receiver in receivers]
    columns = [_column(table, name) for name in names]
    ignored = [column for name in left_out for column in _able(name)]
    for column in table.header:
        if column not in [*columns, *ignored] and (column.endswith(DBM) or column.startswith(RSSI)):
            listed = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
            text = f"column {one_line(column)} names no receiver of the run ({one_line(listed)})"
            raise DataFault(table.path, f"{text}; rename or remove it", line=1)
    values = np.stack([table.numbers(column, may_be_empty=True) for column in columns])
    silent = np.flatnonzero(~np.isfinite(values).any(axis=0))
    if len(silent):
        text = "no receiver of the run received anything, so there is no position; remove the row"
        raise DataFault(table.path, text, row=int(silent[0]) + 1)
    stated = [axis for axis in "xy" if axis in table.header]
    if len(stated) == 1:
        raise DataFault(table.path, f"column {stated[0]} alone is no position; give x and y, or neither", line=1)
    return values, np.stack([table.numbers(axis) for axis in "xy"], axis=1) if stated else None


def _able(name: str) -> list[str]:
    """Names that the column of a receiver may have."""
    number = name.removeprefix(ANCHOR)
    return [f"{name}{DBM}", f"{RSSI}{name}", *([f"{RSSI}{number}"] if number.isdecimal() else [])]


def _column(table: CsvTable, name: str) -> str:
    """Column of a receiver."""
    able = _able(name)
    found = [column for column in able if column in table.header]
    if not found:
        text = f"no column of receiver {one_line(name)}"
        remedy = f"name one {' or '.join(map(one_line, able))}, and leave it empty where nothing was received"
        raise DataFault(table.path, f"{text}; {remedy}", line=1)
    if len(found) > 1:
        raise DataFault(table.path, f"{found[0]} and {found[1]} are of one receiver; remove one of them", line=1)
    return found[0]


def test_observations(run: Run) -> tuple[FloatArray, FloatArray]:
    """Signal strengths of the test rows of a run that were received, and true positions, as `read_observations`."""
    record = run.problem.record
    rows = load_rows(run.folder, record).test
    rows = rows[np.isfinite(record.observation[:, rows]).any(axis=0)]
    return np.asarray(record.observation[:, rows], float), np.asarray(record.tx_pos_m[rows, :2], float)


def write_positions_file(out: Path, found: Positions, true_m: FloatArray | None = None) -> Path:
    """Write positions as a CSV file, a row for each observation in their order.

    Columns: ``x``, ``y``, ``z``, estimate in metres; ``radius_m`` and ``area_m2``, circle around it and region that
    hold the probability ``level``; ``knn_x``, ``knn_y``, nearest neighbours; and where true positions are known
    ``true_x``, ``true_y``, ``error_m`` and ``inside``, 1 where the region holds the true position.
    """
    columns: dict[str, Any] = dict(zip("xyz", found.tx_pos_m.T, strict=True))
    columns |= {"radius_m": found.radius_m, "area_m2": found.area_m2, "level": np.full(len(found), found.level)}
    if found.neighbours_m is not None:
        columns |= {"knn_x": found.neighbours_m[:, 0], "knn_y": found.neighbours_m[:, 1]}
    if true_m is not None:
        columns |= {"true_x": true_m[:, 0], "true_y": true_m[:, 1], "error_m": found.error_m(true_m)}
        columns["inside"] = found.covers(true_m).astype(int)
    rounded = [values if values.dtype.kind in "iu" else values.astype(float).round(4) for values in columns.values()]
    return write_csv(out, columns, zip(*rounded, strict=True))


def posterior_arrays(found: Positions) -> dict[str, Any]:
    """Probabilities over the grid: ``x_m`` [nx], ``y_m`` [ny], ``height_m``, ``probability`` [m, ny, nx]."""
    grid = found.candidates.grid
    spread = np.zeros((len(found), len(grid.x_m) * len(grid.y_m)), np.float32)
    spread[:, found.candidates.inside] = found.probability
    shape = (len(found), len(grid.y_m), len(grid.x_m))
    return {"x_m": grid.x_m, "y_m": grid.y_m, "height_m": grid.height_m, "probability": spread.reshape(shape)}


def figures_of(found: Positions, true_m: FloatArray | None = None) -> dict[str, Any]:
    """Figures of positions: likelihood, held-out rows, regions, and errors where true positions are known."""
    chosen = found.calibration
    figures: dict[str, Any] = {"n": len(found), "level": found.level, "likelihood": asdict(chosen.likelihood)}
    figures |= {"area_m2": summary(found.area_m2), "radius_m": summary(found.radius_m)}
    if chosen.neighbours is not None:
        figures["neighbours"] = asdict(chosen.neighbours)
        names = ("rows", "error_m", "inside", "neighbours_error_m")
        figures["held_out"] = {name: getattr(chosen, name) for name in names}
    if true_m is not None:
        figures |= {"error_m": summary(found.error_m(true_m)), "inside": float(found.covers(true_m).mean())}
        near = found.neighbours_error_m(true_m)
        if near is not None:
            figures["neighbours_error_m"] = summary(near)
    return figures
