"""Table and picture of the project's README: ``python -m wrf_mi_bench.front_page`` prints the one, writes the other.

The table has a line for each question, from entries of the table of radio fields. Columns with and without a scene
are apart. The picture shows a floor whose signal strengths are known everywhere: scan and measurements, prediction,
standard deviation, truth.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from wrf_mi_scenes.floor_plans import office
from wrf_mi_scenes.mitsuba_xml import write_scene

import wrf_mi
from wrf_mi.apps.table.entries import ALL_ROWS, Entry, read_entries
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.files import write_figure
from wrf_mi.core.receivers import receiver_index
from wrf_mi.datasets.ble_folder import CARRIER_HZ
from wrf_mi.receivers.channel import received_power
from wrf_mi.receivers.reports import strength_db
from wrf_mi.runs.folder import load_rows
from wrf_mi.runs.scene_view import scene_cuts
from wrf_mi.scene import drawing
from wrf_mi.synthetic.floor_receivers import DEFAULT, NAME
from wrf_mi.synthetic.searches import SCATTERING, set_scattering
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tasks.scores import inside_interval
from wrf_mi.tracing import open_scene, trace_paths

from .comparison import data_folder
from .declared import pivoted
from .entries import OPEN
from .sources import fit_key, source_files
from .stages import HYBRID, Cell, run_of_cell
from .table_pages import FORMER
from .table_pages import STORED as ENTRIES
from .tables import scene_of_data

COLUMNS = ("hybrid", "ray tracing", "WRF-GS+", "WRF-GS+", "kriging", "IDW")
SCENE = 3
"""Number of columns whose methods have a scene; the others have none."""
HEAD = [f"{name}, {'scan' if k < SCENE else 'no scan'}" for k, name in enumerate(COLUMNS)]
METHODS = {"hybrid": 0, "wrf-gs+-joint": 2, "wrf-gs+": 3, "kriging": 4, "idw": 5, "mri": 5}
METHODS |= dict.fromkeys(
    ("ray-tracing", *(f"ray-tracing-{how}" for how in ("calibrated", "materials", "corrected"))), 1
)
"""Column of each method of the table; ray tracing is the best of the scene as made, calibrated and corrected."""
LAW = "mri"  # the column of interpolation has it where nothing can be interpolated, and names it
MADE = {"random-room": "made by `wrf-mi bench stages`"}  # data that only a benchmark makes


class Question(NamedTuple):
    """Line of the table: question, data set, split, number of training rows, and whether it was measured before."""

    text: str
    dataset: str
    split: str = "official"
    share: int | float = ALL_ROWS
    former: bool = False  # whether an earlier version was measured
    pooled: bool = False  # whether of the entries that are pooled over seeds

    @property
    def data(self) -> str:
        """Arguments of ``wrf-mi train``."""
        words = [self.dataset] + ([] if self.split == "official" else ["--split", self.split])
        words += ["--n-train", str(self.share)] if isinstance(self.share, int) else []
        return MADE.get(self.dataset, f"`{' '.join(words)}`")


QUESTIONS = (
    Question("spectra in a region without measurements, scanned room", "laboratory", "blocked"),
    Question("spectra at held-out positions, furnished room", "traced-room", former=True),
    Question("power in a region without measurements, flat with a plan", "flat-ble", "blocked", 400),
    Question("power in the flat from five measured positions", "flat-ble", share=5),
    Question(
        "power at a receiver without any measurement, same flat", "flat-ble", "receiver", 400, former=True, pooled=True
    ),
    Question(
        "spectra at a carrier without measurements, furnished room",
        "traced-room-bands",
        "frequency",
        former=True,
        pooled=True,
    ),
    Question("channels from 100 measured ones, scanned room", "random-room", share=100),
    Question("measurements a few millimetres apart", "rfid-lab"),
)


def medians_of(question: Question, entries: Mapping[str, Entry]) -> dict[str, float]:
    """Median score by method of the entries that answer a question, mean over seeds."""
    wanted = question.dataset, question.split, question.share, type(question.share), question.pooled
    by_method: dict[str, list[float]] = {}
    for entry in entries.values():
        found = entry.dataset, entry.split, entry.share, type(entry.share), entry.seed is None
        # Without a mesh the paths of free space are no ray tracing in a scan, and a hybrid has none.
        without = entry.dataset in OPEN and METHODS.get(entry.method, SCENE) < SCENE
        if found == wanted and not without:
            by_method.setdefault(entry.method, []).append(float(entry.score["median"]))
    return {method: float(np.mean(medians)) for method, medians in by_method.items()}


def question_table(table: Path = ENTRIES) -> str:
    """Markdown table of medians over test rows from a folder of entries, the best of each line bold."""
    rows, entries = [], read_entries(table)
    for question in QUESTIONS:
        medians, columns = medians_of(question, entries), dict[int, tuple[float, str]]()
        task = next(entry.of for entry in entries.values() if entry.dataset == question.dataset)
        better = max if task.higher_is_better else min
        for method, median in medians.items():
            if (column := METHODS.get(method)) is not None and not (method == LAW and "idw" in medians):
                prefix = "MRI " if method == LAW else ""
                columns[column] = better(columns.get(column, (median, prefix)), (median, prefix))
        best = better(columns.values())
        text = f"{question.text}, {task.label}{f' {FORMER}' if question.former else ''}"
        for column, (median, prefix) in columns.items():
            cell = f"{prefix}{median:.{task.digits}f}"
            cell = f"**{cell}**" if median == best[0] else cell
            rows.append({"question": text, "data": question.data, "column": column, "cell": cell})
    head, line = "| question | data | ... |", "| {question} | {data} | ... |"
    return pivoted(head, line, "question", "column", "{cell}", dict(enumerate(HEAD)))(rows)


RUNS, PICTURE = Path("runs/bench/front-page"), Path("docs/images/front-page.png")
"""Run of the picture, and the picture."""
N_TRAIN, RECEIVER, HEIGHT_M, STEP_M = 40, "anchor1", 1.2, 0.25
"""Measured positions; receiver shown; height and spacing of the map, metres."""
SLICE_M = (0.3, 2.4)  # heights of the scan's points that are drawn: no floor, no ceiling


def true_power(receiver: wrf_mi.Receiver, positions_m: FloatArray) -> FloatArray:
    """Power in dBm [n] that a receiver of the floor gets from positions [n, 3] for 0 dBm sent, without its offset.

    Paths are searched as for the data set: specular and scattered ones apart, powers added.
    """
    plan, total = office(), np.zeros(len(positions_m))
    with tempfile.TemporaryDirectory() as work:
        write_scene(Path(work), plan.parts, "A floor of several rooms", __name__)
        scene = open_scene(Path(work), CARRIER_HZ)
        set_scattering(scene, DEFAULT.scattering)
        for options in DEFAULT.options():
            # Points of a grid may lie in bodies, where no path arrives.
            how: dict[str, Any] = {"progress": True, "check": False, "search_from": "receivers"}
            paths = trace_paths(scene, positions_m, receiver, options, **how).paths
            scattered = (paths.interactions == SCATTERING).any(axis=1)
            total += received_power(paths.select(scattered == options.scattering))[0]
    return np.asarray(strength_db(total))


def picture(folder: Path) -> Figure:
    """Scan and measurements, predicted map, its standard deviation, and the traced truth; runs are kept in a folder."""
    cell = Cell(NAME, "official", N_TRAIN)
    run_of_cell(cell, NAME, folder / HYBRID, HYBRID, scene=scene_of_data(NAME, folder))
    run_of_cell(cell, NAME, folder / "idw", "idw")
    run, idw = (wrf_mi.open_run(folder / name) for name in (HYBRID, "idw"))
    dataset = run.map(height_m=HEIGHT_M, step_m=STEP_M, receivers=[RECEIVER])
    power, std_db = (dataset[name].values[0] for name in ("power_dbm", "power_std_mean_db"))
    record = run.problem.record
    number = receiver_index(record.receivers, RECEIVER)

    # Truth at the free points of the map.
    x, y = np.meshgrid(dataset["x"].values, dataset["y"].values)
    grid_m, free = np.stack([x, y, np.full(x.shape, HEIGHT_M)], axis=-1), np.isfinite(power)
    # Known rows follow the grid: their median residual is the receiver's offset, which every measurement has.
    receiver = record.receivers[number]
    powers = true_power(receiver, np.concatenate([grid_m[free], record.tx_pos_m]))
    powers += np.nanmedian(record.observation[number] - powers[free.sum() :])
    truth = np.full(x.shape, np.nan)
    truth[free] = powers[: free.sum()]
    train = load_rows(run.folder, record).all_train
    errors = [np.nanmedian(np.abs(of - truth[free])) for of in (power[free], idw.predict(grid_m[free], RECEIVER).mean)]
    points = np.load(data_folder(NAME) / SCAN)["points"]

    powers_dbm = drawing.shades(*np.nanpercentile(truth, [2, 98]))
    deviations_db = drawing.shades(0, float(np.nanmax(std_db)))
    figure = Figure(figsize=(10, 5.4), layout="constrained", facecolor="white")
    (given, predicted), (spread, true) = panels = figure.subplots(2, 2, sharex=True, sharey=True)
    scan = points[(points[:, 2] > SLICE_M[0]) & (points[:, 2] < SLICE_M[1])]
    given.scatter(*scan[:, :2].T, s=0.05, color="0.65", linewidths=0, rasterized=True)
    levels = record.observation[number][train]
    marks = {"s": 42, "edgecolors": "black", "linewidths": 0.6}
    drawing.draw_values(given, record.tx_pos_m[train], levels, powers_dbm, **marks)
    given.set_title(f"Given: LiDAR scan and power at {len(train)} positions (circles)")
    drawing.draw_layer(predicted, x, y, power, powers_dbm)
    predicted.set_title(f"Predicted power: median error {errors[0]:.1f} dB (IDW: {errors[1]:.1f} dB)")
    drawing.draw_layer(true, x, y, truth, powers_dbm)
    true.set_title("True power")
    drawing.draw_layer(spread, x, y, std_db, deviations_db)
    inside = inside_interval(power[free], std_db[free], truth[free])
    spread.set_title(f"Its standard deviation: {100 * inside:.0f} % of the truth in 90 % intervals")
    star: Any = {"markersize": 15, "color": drawing.ENDS["receiver"][1], "markeredgecolor": "white"}
    for axes in panels.flat:
        drawing.draw_outlines(axes, scene_cuts(run, HEIGHT_M) if axes is not given else (), linewidths=0.8)
        axes.plot(*receiver.position_m[:2], "*", **star)
        drawing.set_plan(axes, (x.min() - 0.3, y.min() - 0.3), (x.max() + 0.3, y.max() + 0.3))
        axes.label_outer()
        axes.title.set_fontsize(9.5)
    drawing.colour_bar(figure, powers_dbm, panels[:, 1], "received power (dBm)", extend="both")
    how: Any = {"location": "left", "shrink": 0.44, "anchor": (0.0, 0.0), "panchor": False}
    drawing.colour_bar(figure, deviations_db, panels[:, 0], "standard deviation (dB)", **how)
    return figure


if __name__ == "__main__":
    print(question_table())
    write_figure(PICTURE, picture(RUNS / fit_key(source_files())))
