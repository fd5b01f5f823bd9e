"""Picture of a radio map: power, standard deviation and coverage over plan or mesh, with the measured points."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from numpy.typing import NDArray

from ...core import Prediction, Split
from ...core.angles import FloatArray
from ...core.carriers import FREQUENCY
from ...estimators.receiver_places import stored_places
from ...runs.folder import load_rows
from ...runs.results import RECEPTION
from ...runs.run import Run
from ...runs.scene_view import scene_cuts
from ...scene import drawing
from .dataset import COVERAGE, POWER, STD, STD_OF_MEAN

if TYPE_CHECKING:
    import xarray

PANEL_IN, BAR_IN, COLUMNS = 3.2, 0.5, 3  # width of a panel and of its colour scale; number of panels in a line
MOST_PANELS = 12  # largest number of receivers that are drawn, the first ones
MOST_ELLIPSES = 8  # receivers in one panel up to which ellipses of estimated places are drawn
MOST_POINTS = 250  # largest number of training rows of a panel, and of other measured rows
TAIL = 1.0  # percentage of values beyond either end of the colour scale
MEASURED_TAIL = 10.0  # the same percentage of measured levels, among which are single deep fades
STRONGEST = "strongest receiver"
AT_ESTIMATED = "receiver at an estimated place, with one standard deviation"
TRAINED: dict[str, Any] = {"label": "training rows", "marker": "o", "s": 13, "edgecolors": "white"}
OTHER: dict[str, Any] = {"label": "other measured rows", "marker": "s", "s": 11, "edgecolors": "black"}
EDGE = 0.02  # margin around all that is drawn, a share of its size
NEARBY = 0.25  # distance from the rest of a map up to which estimated receivers are drawn, a share of its size
MOST_DEVIATIONS = 3  # number of receivers up to which the standard deviation of each is drawn
CERTAIN = 0.9  # least coverage of a panel in one colour, whose title states the values
LETTERS_PER_INCH, LINE_IN = 14, 0.16  # of the text above the panels, and height of its lines in inches
SAME_CARRIER = 1e-9  # relative difference of frequencies that are the same


class _Measured(NamedTuple):
    """Measured rows of a panel: positions [n, 3] in metres, levels [n], and whether each trained the model."""

    points_m: FloatArray
    level: FloatArray
    trained: NDArray[np.bool_]


class _Panel(NamedTuple):
    """Values [y, x] or [point] with their colours and unit, and the sides on which values may lie beyond these.

    ``number`` is the receiver's, None: all; ``measured`` are its rows.
    """

    title: str
    values: FloatArray
    colours: ScalarMappable
    unit: str
    beyond: Literal["neither", "both"]
    number: int | None
    measured: _Measured | None


def map_figure(dataset: xarray.Dataset, run: Run) -> Figure:
    """Expected power, its standard deviation and the coverage, of the strongest receiver; then power at each receiver,
    and of at most `MOST_DEVIATIONS` receivers the standard deviation at each.

    Walls are the cut of the run's scene at the map's height; measured rows of the run's data at this receiver and at
    the map's carrier have their measured level as colour, circles those that trained the model, squares all others.
    """
    flat = "point" not in dataset.sizes
    split = load_rows(run.folder, run.problem.record)
    measured = [_measured(dataset, run, split, k) for k in range(dataset.sizes["receiver"])]
    panels, estimated = _panels(dataset, measured), stored_places(run.folder)
    lines = -(-len(panels) // COLUMNS)
    columns = min(COLUMNS, len(panels))
    width = (PANEL_IN + BAR_IN) * columns
    walls = scene_cuts(run, float(dataset["height"])) if flat else []
    area_m = _area(dataset, measured, estimated, walls)
    at_m, around_m = _receivers(dataset)[:, : area_m.shape[1]], NEARBY * np.ptp(area_m, axis=0).max()
    is_drawn = ((at_m >= area_m[0] - around_m) & (at_m <= area_m[1] + around_m)).all(axis=1)
    area_m = _with_margin(np.concatenate([area_m, at_m[is_drawn]]))
    heading = _heading(dataset, measured, is_drawn, int(width * LETTERS_PER_INCH))
    height = (PANEL_IN * _aspect(dataset) + 0.5) * lines + 0.6 + LINE_IN * heading.count("\n")
    figure = Figure(figsize=(width, height), layout="constrained")
    kind: dict[str, Any] = {} if flat else {"projection": "3d", "computed_zorder": False}
    grid = figure.subplots(lines, columns, squeeze=False, subplot_kw=kind)
    for axes, panel in zip(grid.flat, panels, strict=False):
        if panel is None:
            axes.set_axis_off()
            continue
        if flat:
            drawing.draw_layer(axes, dataset["x"].values, dataset["y"].values, panel.values, panel.colours)
            drawing.draw_outlines(axes, walls)
        else:
            triangles = dataset["triangle"].values
            drawing.draw_faces(axes, triangles, panel.colours.to_rgba(np.ma.masked_invalid(panel.values)), zorder=1)
            drawing.set_box(axes, triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1)))
        _draw_points(axes, dataset, panel, estimated, is_drawn)
        if flat:  # after ellipses, which may reach beyond
            drawing.set_plan(axes, *area_m)
        axes.set_title(textwrap.fill(panel.title, int(PANEL_IN * LETTERS_PER_INCH)), fontsize=8)
        top = f" (largest: {np.nanmax(panel.values):.0f})" if panel.beyond == "both" else ""
        how = {"shrink": 0.8, "pad": 0.02 if flat else 0.12, "extend": panel.beyond}
        drawing.colour_bar(figure, panel.colours, axes, f"{panel.unit}{top}", **how)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    figure.suptitle(heading, fontsize=8)
    drawing.add_legend(figure)
    return drawing.without_formulas(figure)


def _panels(dataset: xarray.Dataset, measured: Sequence[_Measured]) -> list[_Panel | None]:
    """Panels of the strongest receiver, then of each of the first ones, in lines; None leaves a place free."""
    power = dataset[POWER].values
    low, high = _range(power, np.concatenate([rows.level for rows in measured]))
    colours = drawing.shades(low, max(high, low + 1e-3))
    unit = dataset[POWER].attrs["units"]
    names = [str(name) for name in dataset["receiver"].values]
    several = len(names) > 1
    number = None if several else 0
    who = STRONGEST if several else names[0]
    # Positions without a value, inside solids, have none at any receiver.
    best = np.where(np.isfinite(power), power, -np.inf).argmax(axis=0)[None]

    def of_best(name: str) -> FloatArray:
        return np.take_along_axis(dataset[name].values, best, axis=0)[0]

    rows = None if several else measured[0]
    panels: list[_Panel | None] = []
    panels.append(_Panel(f"{who}: expected power", of_best(POWER), colours, unit, "both", number, rows))
    # The map is of the mean power: its deviation where the model states it, else that of a reading.
    deviation, of = (STD_OF_MEAN, "the mean") if STD_OF_MEAN in dataset else (STD, "a reading")
    title, each = "{}: standard deviation of " + of, deviation in dataset and 1 < len(names) <= MOST_DEVIATIONS
    if deviation in dataset:
        drawn = dataset[deviation].values if each else of_best(deviation)
        spread = drawing.shades(0, max(float(np.nanmax(drawn)), 1e-3))
        panels.append(_Panel(title.format(who), of_best(deviation), spread, "dB", "neither", number, None))
    if COVERAGE in dataset:
        probable = drawing.shades(0, 1)
        values = of_best(COVERAGE)
        panels.append(_Panel(_covered(dataset, who, values), values, probable, "probability", "neither", number, None))
    numbers = range(len(names) if several else 0)[:MOST_PANELS]
    powers = [_Panel(f"{names[k]}: expected power", power[k], colours, unit, "both", k, measured[k]) for k in numbers]
    if not each:
        return panels + powers
    std = dataset[deviation].values
    spreads = [_Panel(title.format(names[k]), std[k], spread, "dB", "neither", k, None) for k in numbers]
    return [panel for line in (panels, powers, spreads) for panel in (*line, *[None] * (COLUMNS - len(line)))]


def _covered(dataset: xarray.Dataset, who: str, values: FloatArray) -> str:
    """Title of the coverage: what the probability is of, and its values where all of them have one colour."""
    threshold = next(dataset.attrs[key] for key in ("threshold_dbm", "threshold_db") if key in dataset.attrs)
    received = "reception and " if RECEPTION in dataset else ""
    title = f"{who}: probability of {received}more than {threshold:g} {dataset[POWER].attrs['units']}"
    low, high = np.nanmin(values), np.nanmax(values)
    if low < CERTAIN:
        return title
    return f"{title}: {low:.2f} to {high:.2f} here" + (", as readings are lost at any power" if received else "")


def _receivers(dataset: xarray.Dataset) -> FloatArray:
    """Positions of receivers [n, 3], metres; NaN where unknown."""
    return np.stack([dataset[f"receiver_{axis}"].values for axis in "xyz"], axis=-1)


def _area(
    dataset: xarray.Dataset, measured: Sequence[_Measured], estimated: Mapping[str, Any], walls: Sequence[FloatArray]
) -> FloatArray:
    """Least and largest coordinates [2, 2], of a mesh [2, 3], of all that is drawn but receivers at estimated places.

    Those far outside, whose places are often uncertain, would shrink the map.
    """
    axes, names = "xy" if "point" not in dataset.sizes else "xyz", map(str, dataset["receiver"].values)
    surveyed_m = _receivers(dataset)[[name not in estimated for name in names]]
    points = [rows.points_m for rows in measured] + [surveyed_m]
    shown = [np.concatenate([dataset[axis].values, *(part[:, k] for part in points)]) for k, axis in enumerate(axes)]
    ends = np.array([[np.nanmin(values), np.nanmax(values)] for values in shown]).T
    for lines in walls:
        ends = np.stack([np.minimum(ends[0], lines.min(axis=(0, 1))), np.maximum(ends[1], lines.max(axis=(0, 1)))])
    return ends


def _with_margin(points_m: FloatArray) -> FloatArray:
    """Least and largest coordinates [2, k] of points [n, k], with a margin for marks at the edge."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    margin_m = EDGE * (high - low).max()
    return np.stack([low - margin_m, high + margin_m])


def _heading(dataset: xarray.Dataset, measured: Sequence[_Measured], is_drawn: NDArray[np.bool_], width: int) -> str:
    """Title, heights of the transmitter and carrier, in lines of at most ``width`` letters."""
    heights = np.concatenate([rows.points_m[:, 2] for rows in measured])
    words = [] if "point" in dataset.sizes else [f"transmitter at z = {float(dataset['height']):.2f} m"]
    if FREQUENCY in dataset.attrs:
        words.append(f"{dataset.attrs[FREQUENCY] / 1e6:.6g} MHz")
    if not len(heights):
        words.append("no measured row at this carrier" if FREQUENCY in dataset.attrs else "no measured row")
    elif f"{heights.min():.2f}" == f"{heights.max():.2f}":
        words.append(f"measured at z = {heights.min():.2f} m")
    else:
        words.append(f"measured at z = {heights.min():.2f} to {heights.max():.2f} m")
    if outside := np.count_nonzero(np.isfinite(_receivers(dataset)).all(axis=1) & ~is_drawn):
        words.append(f"{outside} receivers estimated outside of the map, not drawn")
    parts = [dataset.attrs["title"], ", ".join(words)]
    if not dataset.attrs["level_is_absolute"]:
        parts.append("levels relative to full scale are no signal strengths")
    return "\n".join(textwrap.fill(part, width) for part in parts)


def _range(power: FloatArray, measured: FloatArray) -> tuple[float, float]:
    """Ends of the colour scale: nearly all of the map, and all but the fades of the measured levels."""
    ends = [np.percentile(power[np.isfinite(power)], [TAIL, 100 - TAIL])]
    if len(measured):
        ends.append(np.percentile(measured, [MEASURED_TAIL, 100 - MEASURED_TAIL]))
    return float(np.min(ends)), float(np.max(ends))


def _aspect(dataset: xarray.Dataset) -> float:
    x_m, y_m = (np.ptp(dataset[axis].values) + 0.1 for axis in "xy")
    return 0.9 if "point" in dataset.sizes else float(np.clip(y_m / x_m, 0.3, 1.6))


def _measured(dataset: xarray.Dataset, run: Run, split: Split, number: int) -> _Measured:
    """Rows with a level at a receiver of a map, at its carrier, thinned."""
    record = run.problem.record
    task, index = record.task, int(np.atleast_1d(dataset.attrs["receiver_numbers"])[number])
    added = float(dataset.attrs["transmit_power_dbm"]) if task.level_kind == "gain" else 0.0
    level = task.level(Prediction(record.observation[index])).mean + added
    measured = np.isfinite(level) & np.isfinite(record.tx_pos_m).all(axis=1)
    if record.carriers_hz is not None and FREQUENCY in dataset.attrs:
        measured &= np.isclose(record.carriers_hz, dataset.attrs[FREQUENCY], rtol=SAME_CARRIER, atol=0)
    used = split.left[split.left[:, 0] == index, 1] if index in split.held_receivers else split.all_train
    trained = np.isin(np.arange(len(measured)), used)
    kinds = (np.flatnonzero(measured & part) for part in (trained, ~trained))
    rows = np.concatenate([part[:: max(1, -(-len(part) // MOST_POINTS))] for part in kinds])
    return _Measured(record.tx_pos_m[rows], level[rows], trained[rows])


def _draw_points(
    axes: Any, dataset: xarray.Dataset, panel: _Panel, estimated: Mapping[str, Any], is_drawn: NDArray[np.bool_]
) -> None:
    """Measured levels of a receiver, and the receivers, open with an ellipse where estimated."""
    dims, at = 3 if "point" in dataset.sizes else 2, _receivers(dataset)
    for k in np.flatnonzero(is_drawn) if panel.number is None else [panel.number] * bool(is_drawn[panel.number]):
        place = estimated.get(str(dataset["receiver"].values[k]))
        colour = drawing.ENDS["receiver"][1]
        mark = {} if place is None else {"markeredgecolor": colour, "label": AT_ESTIMATED, "markerfacecolor": "none"}
        drawing.draw_devices(axes, "receiver", at[k], **mark)
        # Ellipses of a dozen receivers would hide a panel of all of them.
        if place is not None and dims == 2 and (panel.number is not None or is_drawn.sum() <= MOST_ELLIPSES):
            spread = 2 * np.array(place["std_m"])[:2]
            axes.add_patch(Ellipse((at[k, 0], at[k, 1]), *spread, fill=False, edgecolor=colour, linewidth=1, zorder=5))
            paper = {"facecolor": "white", "edgecolor": "none", "alpha": 0.7, "pad": 0.5}
            text = {"textcoords": "offset points", "fontsize": 6, "color": colour, "bbox": paper, "zorder": 5}
            axes.annotate("estimated", at[k, :2], (7, 4), **text)
    if panel.measured is None:
        return
    # Training rows, often the fewer, lie above the others.
    for rows, mark in ((~panel.measured.trained, OTHER), (panel.measured.trained, TRAINED)):
        points_m, level = panel.measured.points_m[rows], panel.measured.level[rows]
        if len(level):
            drawing.draw_values(axes, points_m, level, panel.colours, **mark, linewidths=0.4, zorder=4)
