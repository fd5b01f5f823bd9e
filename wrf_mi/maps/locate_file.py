"""Observations from a CSV file, positions to one, and their picture."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from ..core import DataFault, InputError, Receiver
from ..core.angles import FloatArray
from ..core.files import one_line, write_csv
from ..core.receivers import SHOWN as SHOWN_NAMES
from ..datasets.folder_files import CsvTable, read_csv
from ..runs.folder import load_rows
from ..runs.run import Run
from ..tasks.scores import summary
from .locate import LocatedPositions
from .picture import scene_cuts

DBM, RSSI, ANCHOR = "_dbm", "rssi_", "anchor"
"""Columns are ``<receiver>_dbm``, or ``rssi_<receiver>``, where the name of ``anchor<number>`` is its number."""
SHOWN, COLUMNS = 6, 3  # number of rows that are drawn, and panels side by side
MARGIN_M = 0.5  # margin of a panel around the candidates
REGION, ESTIMATE, NEIGHBOURS, TRUTH = "tab:orange", "tab:red", "tab:purple", "black"


def read_observations(
    path: str | Path, receivers: Sequence[Receiver], left_out: Collection[str] = ()
) -> tuple[FloatArray, FloatArray | None]:
    """Read the signal strengths [n_rx, m] of each receiver, and true positions [m, 2] or None, from a CSV file.

    A column ``<receiver>_dbm``, as ``wrf-mi predict`` writes it, or ``rssi_<receiver>``, as data sets have it, is
    needed for each receiver; a field is empty where nothing was received (NaN). Columns ``x`` and ``y``, if any, are
    true positions in metres. Other columns are ignored, also those of receivers that the run left out of its data.
    `InputError`: missing or unreadable, a receiver without a column or with several, a column of an unknown receiver, a
    field that is no number, or a row without any strength.
    """
    table = read_csv(Path(path), skip_blank=True)
    columns = _columns(table, [receiver.name for receiver in receivers], left_out)
    values = np.stack([table.numbers(column, may_be_empty=True) for column in columns])
    silent = np.flatnonzero(~np.isfinite(values).any(axis=0))
    if len(silent):
        text = "no receiver of the run received anything, so there is no position; remove the row"
        raise DataFault(table.path, text, row=int(silent[0]) + 1)
    stated = [axis for axis in "xy" if axis in table.header]
    if len(stated) == 1:
        raise DataFault(table.path, f"column {stated[0]} alone is no position; give x and y, or neither", line=1)
    return values, np.stack([table.numbers(axis) for axis in "xy"], axis=1) if stated else None


def _columns(table: CsvTable, names: Sequence[str], left_out: Collection[str]) -> list[str]:
    """Columns of the receivers; `DataFault`: there is one of an unknown receiver."""
    columns = [_column(table, name) for name in names]
    ignored = [column for name in left_out for column in _able(name)]
    strengths = [column for column in table.header if column.endswith(DBM) or column.startswith(RSSI)]
    for column in [column for column in strengths if column not in (*columns, *ignored)]:
        listed = ", ".join(names[:SHOWN_NAMES]) + (", ..." if len(names) > SHOWN_NAMES else "")
        text = f"column {one_line(column)} names no receiver of the run ({one_line(listed)})"
        raise DataFault(table.path, f"{text}; rename or remove it", line=1)
    return columns


def _able(name: str) -> list[str]:
    """Names that the column of a receiver may have."""
    number = name.removeprefix(ANCHOR)
    return [f"{name}{DBM}", f"{RSSI}{name}", *([f"{RSSI}{number}"] if number.isdecimal() else [])]


def _column(table: CsvTable, name: str) -> str:
    able = _able(name)
    stated = [column for column in able if column in table.header]
    if not stated:
        text = f"no column of receiver {one_line(name)}"
        remedy = f"name one {' or '.join(map(one_line, able))}, and leave it empty where nothing was received"
        raise DataFault(table.path, f"{text}; {remedy}", line=1)
    if len(stated) > 1:
        raise DataFault(table.path, f"{stated[0]} and {stated[1]} are of one receiver; remove one of them", line=1)
    return stated[0]


def test_observations(run: Run) -> tuple[FloatArray, FloatArray]:
    """Signal strengths of the test rows of a run that were received, and true positions, as `read_observations`."""
    record = run.problem.record
    rows = load_rows(run.folder, record).test
    if not len(rows):
        text = "its split holds no rows out, which could be located; give a file of strengths"
        raise InputError(f"{run.folder}: {text} (positions of receivers are estimated by train)")
    rows = rows[np.isfinite(record.observation[:, rows]).any(axis=0)]
    return np.asarray(record.observation[:, rows], float), np.asarray(record.tx_pos_m[rows, :2], float)


def write_positions_file(out: Path, located: LocatedPositions, true_m: FloatArray | None = None) -> Path:
    """Write positions as a CSV file, a row for each observation in their order.

    Columns: ``x``, ``y``, ``z``, estimate in metres; ``radius_m`` and ``area_m2``, circle around it and region that
    hold the probability ``level``; ``knn_x``, ``knn_y``, nearest neighbours; and where true positions are known
    ``true_x``, ``true_y``, ``error_m`` and ``inside``, 1 where the region holds the true position.
    """
    columns: dict[str, Any] = dict(zip("xyz", located.tx_pos_m.T, strict=True))
    columns |= {"radius_m": located.radius_m, "area_m2": located.area_m2, "level": np.full(len(located), located.level)}
    if located.neighbours_m is not None:
        columns |= {"knn_x": located.neighbours_m[:, 0], "knn_y": located.neighbours_m[:, 1]}
    if true_m is not None:
        columns |= {"true_x": true_m[:, 0], "true_y": true_m[:, 1], "error_m": located.error_m(true_m)}
        columns["inside"] = located.covers(true_m).astype(int)
    rounded = [values if values.dtype.kind in "iu" else values.astype(float).round(4) for values in columns.values()]
    return write_csv(out, columns, zip(*rounded, strict=True))


def posterior_arrays(located: LocatedPositions) -> dict[str, Any]:
    """Probabilities over the grid: ``x_m`` [nx], ``y_m`` [ny], ``height_m``, ``probability`` [m, ny, nx]."""
    grid = located.candidates.grid
    spread = np.zeros((len(located), len(grid.x_m) * len(grid.y_m)), np.float32)
    spread[:, located.candidates.inside] = located.probability
    shape = (len(located), len(grid.y_m), len(grid.x_m))
    return {"x_m": grid.x_m, "y_m": grid.y_m, "height_m": grid.height_m, "probability": spread.reshape(shape)}


def figures_of(located: LocatedPositions, true_m: FloatArray | None = None) -> dict[str, Any]:
    """Figures of positions: likelihood, held-out rows, regions, and errors where true positions are known."""
    chosen = located.calibration
    figures: dict[str, Any] = {"n": len(located), "level": located.level, "likelihood": asdict(chosen.likelihood)}
    figures |= {"area_m2": summary(located.area_m2), "radius_m": summary(located.radius_m)}
    figures |= {"at_border": int(located.at_border.sum()), "training_rows_outside": located.rows_outside}
    if chosen.neighbours is not None:
        figures["neighbours"] = asdict(chosen.neighbours)
        names = ("rows", "error_m", "inside", "neighbours_error_m")
        figures["held_out"] = {name: getattr(chosen, name) for name in names}
    if true_m is not None:
        figures |= {"error_m": summary(located.error_m(true_m)), "inside": float(located.covers(true_m).mean())}
        figures["outside"] = int(located.candidates.outside(true_m).sum())
        if (near := located.neighbours_error_m(true_m)) is not None:
            figures["neighbours_error_m"] = summary(near)
    return figures


def draw_positions(run: Run, located: LocatedPositions, true_m: FloatArray | None = None) -> Figure:
    """Rows at equal spacing: probability, region, estimate, nearest neighbours and, if known, true positions [m, 2]."""
    rows = np.unique(np.linspace(0, len(located) - 1, min(SHOWN, len(located))).round().astype(int))
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    arrays, walls = posterior_arrays(located), scene_cuts(run, located.candidates.grid.height_m)
    size = np.array([np.ptp(arrays["x_m"]), np.ptp(arrays["y_m"])]) + 1.0
    height = 3.6 * float(np.clip(size[1] / size[0], 0.4, 2.0)) + 0.6
    figure = Figure(figsize=(3.6 * columns + 0.3, height * lines + 0.5), layout="constrained", facecolor="white")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        _draw_row(axes, arrays, located, int(row), true_m)
        for lines_m in walls:
            axes.add_collection(LineCollection(list(lines_m), colors="0.35", linewidths=1.2))
        place = np.stack([receiver.position_m[:2] for receiver in run.receivers])
        axes.plot(*place.T, "^", color="tab:blue", markersize=6, markeredgecolor="white")
        for grid_m, set_limits in ((arrays["x_m"], axes.set_xlim), (arrays["y_m"], axes.set_ylim)):
            set_limits(grid_m[0] - MARGIN_M, grid_m[-1] + MARGIN_M)
        axes.set_aspect("equal")
        axes.tick_params(labelsize=7)
    for axes in panels[len(rows) :]:
        axes.set_visible(False)
    figure.supxlabel("x (m)", fontsize=8)
    figure.supylabel("y (m)", fontsize=8)
    dot: dict[str, Any] = {"linestyle": "none"}
    handles: list[Any] = [
        Patch(color="tab:green", alpha=0.6, label="probability"),
        Line2D([], [], color=REGION, label=f"{located.level:.0%} region"),
        Line2D([], [], marker="o", color=ESTIMATE, label="estimate", **dot),
        Line2D([], [], color=ESTIMATE, linestyle=":", label=f"circle of {located.level:.0%}"),
    ]
    if located.calibration.neighbours is not None:
        name = f"{located.calibration.neighbours.count} nearest neighbours"
        handles.append(Line2D([], [], marker="s", color=NEIGHBOURS, label=name, **dot))
    if true_m is not None:
        handles.append(Line2D([], [], marker="+", color=TRUTH, markeredgewidth=2, label="true position", **dot))
    handles.append(Line2D([], [], marker="^", color="tab:blue", label="receiver", **dot))
    figure.legend(handles=handles, loc="outside upper center", ncols=4, fontsize=8)
    return figure


def _draw_row(
    axes: Axes, arrays: dict[str, Any], located: LocatedPositions, row: int, true_m: FloatArray | None
) -> None:
    grid = located.candidates.grid
    drawn = arrays["probability"][row]
    axes.pcolormesh(grid.x_m, grid.y_m, np.where(drawn > 0, drawn, np.nan), shading="nearest", cmap="Greens")
    inside = np.zeros(drawn.size)
    inside[located.candidates.inside] = located.region[row]
    if min(drawn.shape) > 1:
        # A border of zeros closes outlines at the edge of the grid.
        x, y = (np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in (grid.x_m, grid.y_m))
        bordered = np.pad(inside.reshape(drawn.shape), 1)
        axes.contour(x, y, bordered, levels=[0.5], colors=REGION, linewidths=1.4)
    x_m, y_m = located.tx_pos_m[row, :2]
    axes.add_patch(Circle((x_m, y_m), located.radius_m[row], fill=False, color=ESTIMATE, linewidth=0.8, linestyle=":"))
    axes.plot(x_m, y_m, "o", color=ESTIMATE, markersize=6)
    if located.neighbours_m is not None:
        axes.plot(*located.neighbours_m[row, :2], "s", color=NEIGHBOURS, markersize=5)
    title = f"row {row + 1}: {located.area_m2[row]:.1f} m²"
    if true_m is not None:
        axes.plot(*true_m[row], "+", color=TRUTH, markersize=11, markeredgewidth=2)
        title += f", error {located.error_m(true_m)[row]:.2f} m"
    axes.set_title(title, fontsize=9)
