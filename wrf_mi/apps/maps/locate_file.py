"""Observations from a CSV file, positions to one, and their picture."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from ...core import DataFault, InputError, Receiver
from ...core.angles import FloatArray
from ...core.files import listed, one_line, text_lines, write_csv
from ...core.yaml_files import read_yaml
from ...runs.folder import load_rows
from ...runs.run import Run
from ...runs.scene_view import scene_cuts
from ...scene import drawing
from ...tasks.scores import block_bootstrap, summary
from ..importing.importing import FACTS
from ..importing.observed import read_observed
from ..importing.readings import id_key
from .grid import usual_height
from .locate import LocatedPositions

logger = logging.getLogger(__name__)

DBM, RSSI, ANCHOR = "_dbm", "rssi_", "anchor"
"""Columns of data sets are ``<receiver>_dbm``, or ``rssi_<receiver>``, where ``anchor<number>`` may be its number."""
SILENT = "no receiver of the run received anything, so there is no position; remove the row"
SHOWN, COLUMNS = 6, 3  # number of rows that are drawn, and panels side by side
STRETCH, STRETCHES = 20, 20
"""Consecutive rows that are resampled together, as those of a path share their errors, and least number of parts of
fewer rows."""
MARGIN_M = 0.5  # margin of a panel around the candidates
REGION, ESTIMATE, NEIGHBOURS = "tab:orange", "tab:red", "tab:purple"
TRUTH: dict[str, Any] = {"marker": "*", "markersize": 11, "color": "white", "markeredgecolor": "black"}
TRUTH |= {"linestyle": "none", "label": "true position"}


def read_own(run: Run, path: str | Path) -> Run:
    """The run as it predicts for the device of a table's readings, whose offset they tell (`Run.with_readings`).

    The table is one of `read_observations` with positions x, y; those at which no receiver of the run received anything
    tell nothing. They lie at the height of the transmitters in the run's data.

    Raises:
        InputError: a table that is not readable, without positions or without a reading of a receiver of the run.
    """
    record = run.problem.record
    values, xy_m = read_observations(path, run.receivers, run.config.left_out, record.source, silent=True)
    if xy_m is None:
        raise DataFault(Path(path), "own readings without positions; give columns x, y in metres", line=1)
    heard = np.isfinite(values).any(axis=0)
    if not heard.any():
        raise DataFault(Path(path), "no receiver of the run received anything; give readings of its receivers")
    height_m = usual_height(run, record.tx_pos_m)
    return run.with_readings(np.column_stack([xy_m[heard], np.full(heard.sum(), height_m)]), values[:, heard])


def device_text(run: Run) -> str:
    """Offset of the device of own readings in a line; "": none were given."""
    if run.own is None:
        return ""
    offset = run.device
    text = f"this device: {offset.mean_db:+.1f} +- {offset.std_db:.1f} dB against those of the data"
    return f"{text}, by {offset.readings} of its readings\n"


def read_observations(
    path: str | Path,
    receivers: Sequence[Receiver],
    left_out: Collection[str] = (),
    data: str | Path | None = None,
    silent: bool = False,
) -> tuple[FloatArray, FloatArray | None]:
    """Read the signal strengths [n_rx, m] of each receiver, and true positions [m, 2] or None, from a table.

    The table is read as `wrf_mi.import_measurements` reads it (`read_observed`). Where it has a row for each
    transmitter, each receiver needs a column, such as ``<receiver>_dbm``, as ``wrf-mi predict`` writes it, or
    ``rssi_<receiver>``, as data sets have it; a field is empty where nothing was received (NaN). Columns ``x`` and
    ``y``, if any, are true positions in metres.

    Args:
        path: the table.
        receivers: receivers of the run.
        left_out: names of receivers that the run left out of its data.
        data: folder of the run's data, whose ``import.yml``, if any, states the frame of positions.
        silent: whether rows without any strength are kept.

    Raises:
        InputError: missing or unreadable, receivers without a column or with several, a field that is no number, or a
            row without any strength.
    """
    path, names = Path(path), [receiver.name for receiver in receivers]
    facts_file = None if data is None else Path(data) / FACTS
    facts = {} if facts_file is None or not facts_file.is_file() else read_yaml(facts_file)
    # A table that was imported may have columns named as in data sets, and positions in another frame.
    was_imported = path.name in facts.get("files", ()) and path.resolve().parent != Path(data or "").resolve()
    observed = read_observed(path, facts if was_imported or not _has_layout(path, names) else {})
    numbers = {key: number for number, name in enumerate(names) for key in _keys(name)}
    number_of = np.array([numbers.get(id_key(name), -1) for name in observed.ids])
    file, heard = observed.table.files[0][0], number_of >= 0
    lacking = [name for number, name in enumerate(names) if number not in number_of]
    if not heard.any() or (lacking and not observed.is_long):
        text = f"no strengths of receiver{'s' if len(lacking) > 1 else ''} {one_line(listed(lacking))}"
        raise DataFault(file, f"{text} among {one_line(listed(observed.ids))}; name each as in the data of the run")
    if len(np.unique(number_of[heard])) < heard.sum():
        raise DataFault(file, f"two of {one_line(listed(observed.ids))} are of one receiver; remove one of them")
    keys = {key for name in left_out for key in _keys(name)} | numbers.keys()
    if unknown := [name for name in observed.ids if id_key(name) not in keys]:
        logger.warning("%s: %d receivers unknown to the run are not used: %s", file, len(unknown), listed(unknown))
    values = np.full((len(names), len(observed.first_row)), np.nan)
    values[number_of[heard]] = observed.dbm[heard]
    rows = np.flatnonzero(~np.isfinite(values).any(axis=0))
    if len(rows) and not silent:
        raise observed.table.fault(SILENT, int(observed.first_row[rows[0]]))
    return values, observed.xy_m


def _has_layout(path: Path, names: Sequence[str]) -> bool:
    """Whether a file is CSV with a column of a receiver that is named as in data sets and predictions."""
    try:
        header = [name.strip() for name in next(iter(text_lines(path)), "").split(",")]
    except InputError:  # no text in UTF-8
        return False
    able = {f"{name}{DBM}" for name in names}
    able |= {f"{RSSI}{part}" for name in names for part in (name, name.removeprefix(ANCHOR))}
    return not able.isdisjoint(header)


def _keys(name: str) -> set[str]:
    """Ids of a table, as `id_key` compares them, that are a receiver's."""
    return set(map(id_key, (name, name.removeprefix(ANCHOR))))


def test_observations(run: Run) -> tuple[FloatArray, FloatArray]:
    """Signal strengths of the test rows of a run that were received, and true positions, as `read_observations`."""
    record = run.problem.record
    rows = load_rows(run.folder, record).test
    if not len(rows):
        text = "its split holds no rows out, which could be located; give strengths by --observed FILE, or train with"
        raise InputError(f"{run.folder}: {text} --split random (positions of receivers are estimated by train)")
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
    """Figures of positions: likelihood, held-out rows, regions, and errors where true positions are known.

    ``gain_on_neighbours_m`` is the mean by which errors are smaller than those of nearest neighbours, with its 95 %
    interval by stretches of consecutive rows.
    """
    chosen = located.calibration
    figures: dict[str, Any] = {"n": len(located), "level": located.level, "likelihood": asdict(chosen.likelihood)}
    figures |= {"area_m2": summary(located.area_m2), "radius_m": summary(located.radius_m)}
    figures |= dict(zip(("region_mass", "circle_mass"), located.masses, strict=True))
    figures["neighbours_spread_m"] = chosen.spread_m
    figures |= {"at_border": int(located.at_border.sum()), "training_rows_outside": located.rows_outside}
    if chosen.neighbours is not None:
        figures["neighbours"] = asdict(chosen.neighbours)
        names = ("rows", "folds", "error_m", "inside", "neighbours_error_m")
        figures["held_out"] = {name: getattr(chosen, name) for name in names}
    if true_m is not None:
        figures |= {"error_m": summary(located.error_m(true_m)), "inside": float(located.covers(true_m).mean())}
        figures["outside"] = int(located.candidates.outside(true_m).sum())
        if (near := located.neighbours_error_m(true_m)) is not None:
            figures["neighbours_error_m"] = summary(near)
            gain_m = near - located.error_m(true_m)
            block = np.arange(len(gain_m)) // int(np.clip(len(gain_m) // STRETCHES, 1, STRETCH))
            figures["gain_on_neighbours_m"] = asdict(block_bootstrap(gain_m, block))
    return figures


def draw_positions(run: Run, located: LocatedPositions, true_m: FloatArray | None = None) -> Figure:
    """Rows at equal spacing: probability, region, estimate, nearest neighbours and, if known, true positions [m, 2]."""
    rows = np.unique(np.linspace(0, len(located) - 1, min(SHOWN, len(located))).round().astype(int))
    columns = min(COLUMNS, len(rows))
    lines = -(-len(rows) // columns)
    arrays, walls = posterior_arrays(located), scene_cuts(run, located.candidates.grid.height_m)
    ends_m = np.stack([arrays["x_m"][[0, -1]], arrays["y_m"][[0, -1]]], axis=1)
    size = ends_m[1] - ends_m[0] + 1.0
    height = 3.6 * float(np.clip(size[1] / size[0], 0.4, 2.0)) + 0.6
    figure = Figure(figsize=(3.6 * columns + 0.3, height * lines + 0.5), layout="constrained", facecolor="white")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        _draw_row(axes, arrays, located, int(row), true_m)
        drawing.draw_outlines(axes, walls)
        drawing.draw_devices(axes, "receiver", [receiver.position_m for receiver in run.receivers])
        drawing.set_plan(axes, ends_m[0] - MARGIN_M, ends_m[1] + MARGIN_M)
    for axes in panels[len(rows) :]:
        axes.set_visible(False)
    drawing.add_legend(figure, "outside upper center")
    return figure


def _draw_row(
    axes: Axes, arrays: dict[str, Any], located: LocatedPositions, row: int, true_m: FloatArray | None
) -> None:
    grid = located.candidates.grid
    drawn = arrays["probability"][row]
    colours = drawing.shades(0, float(drawn.max()))
    # Cells of probability zero are searched, others are not.
    searched = np.full(drawn.size, np.nan)
    searched[located.candidates.inside] = drawn.ravel()[located.candidates.inside]
    drawing.draw_layer(axes, grid.x_m, grid.y_m, searched.reshape(drawn.shape), colours)
    inside = np.zeros(drawn.size)
    inside[located.candidates.inside] = located.region[row]
    if min(drawn.shape) > 1:
        # A border of zeros closes outlines at the edge of the grid.
        x, y = (np.concatenate([[2 * a[0] - a[1]], a, [2 * a[-1] - a[-2]]]) for a in (grid.x_m, grid.y_m))
        bordered = np.pad(inside.reshape(drawn.shape), 1)
        axes.contour(x, y, bordered, levels=[0.5], colors=REGION, linewidths=1.4)
        axes.plot([], color=REGION, label=f"{located.level:.0%} region over the probability, brightest where largest")
    x_m, y_m = located.tx_pos_m[row, :2]
    axes.add_patch(Circle((x_m, y_m), located.radius_m[row], fill=False, color=ESTIMATE, linewidth=0.8, linestyle=":"))
    mark: dict[str, Any] = {"markeredgecolor": "white", "linestyle": "none"}
    axes.plot(x_m, y_m, "o", color=ESTIMATE, label=f"estimate, and its circle of {located.level:.0%}", **mark)
    if located.neighbours_m is not None and located.calibration.neighbours is not None:
        name = f"{located.calibration.neighbours.count} nearest neighbours"
        axes.plot(*located.neighbours_m[row, :2], "s", color=NEIGHBOURS, label=name, **mark)
    title = f"row {row + 1}: {located.area_m2[row]:.1f} m²"
    if true_m is not None:
        axes.plot(*true_m[row], **TRUTH)
        title += f", error {located.error_m(true_m)[row]:.2f} m"
    axes.set_title(title, fontsize=9)
