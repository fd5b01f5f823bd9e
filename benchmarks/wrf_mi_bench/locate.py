"""Positions of the transmitter from signal strengths: likelihood over predictions beside k nearest neighbours.

Every cell is a run of ``wrf-mi train`` on ``flat-ble``'s first run, whose second run is located, or on other measured
sets, at whose test places or along whose test walks transmitters are located. The form of the likelihood, k and the
mass of regions are chosen by held-out training rows (`wrf_mi.apps.maps.locate_calibration`). Consecutive rows of a run
share their errors, so that intervals resample stretches of the run.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.apps.maps.locate import locate
from wrf_mi.apps.maps.locate_file import test_observations
from wrf_mi.apps.maps.locate_neighbours import COUNTS, METRICS, Neighbours
from wrf_mi.core.angles import FloatArray
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.folder import METRICS as FINISHED
from wrf_mi.runs.folder import load_rows
from wrf_mi.tasks.scores import bootstrap

from .bench import FLAT
from .buildings import FLOOR, MALL, measured_set
from .comparison import data_folder, kept, line, say
from .declared import lined
from .sources import fit_key, source_files
from .tables import scene_of_data

RUNS = Path("runs/bench/locate")
STRETCH = 20  # consecutive test rows that are resampled together: the robot moves 3 m in them
INSIDE = (0.85, 0.95)  # limits of the share of true positions inside the 90 % regions
ROWS = 64
POOLED = "draws"  # last word of a row of several draws


@dataclass(frozen=True)
class Cell:
    title: str  # label in the table
    model: str  # name of the model
    n_train: int | None  # number of training rows; None: all
    seed: int = 0  # seed of their draw and of the fit
    scene: bool = True  # whether the model knows the walls
    settings: tuple[str, ...] = ()  # ``key=value`` of the model
    intervals: bool = False  # whether its standard deviations are calibrated by held-out rows, as it states none
    dataset: str = FLAT  # measured data

    @property
    def name(self) -> str:
        name = f"{self.model}-{'all' if self.n_train is None else self.n_train}-seed{self.seed}"
        return name if self.dataset == FLAT else f"{self.dataset}-{name}"


HYBRID = partial(Cell, "hybrid, knows walls", "hybrid")
KRIGING = partial(Cell, "kriging", "kriging", scene=False, intervals=True)
SEEDS = (0, 1, 2)
CELLS = (
    *(kind(ROWS, seed) for kind in (HYBRID, KRIGING) for seed in SEEDS),
    HYBRID(None),
    *(KRIGING(None, dataset=dataset) for dataset in (FLOOR, MALL)),
)


def measure(cell: Cell, scene: str | None, folder: Path) -> dict[str, Any]:
    """Errors in metres of a cell, of nearest neighbours, and whether regions hold the true positions, by test row."""
    if not (folder / FINISHED).exists():
        shutil.rmtree(folder, ignore_errors=True)
        more: dict[str, Any] = {"scene": scene if cell.scene else None, "settings": cell.settings}
        options: dict[str, Any] = {"n_train": cell.n_train, "seed": cell.seed, "intervals": cell.intervals}
        data = FLAT if cell.dataset == FLAT else measured_set(folder.parent, cell.dataset)
        train(data, cell.model, out=folder, **options, **more)
    run = open_run(folder)
    strengths_dbm, true_m = test_observations(run)
    located = locate(run, strengths_dbm, on_progress=_show(cell.name))
    record, rows = run.problem.record, load_rows(run.folder, run.problem.record).all_train
    # Errors of nearest neighbours with the k and the distance that are best on the test rows themselves.
    ways = [Neighbours(count, metric) for metric in METRICS for count in COUNTS]
    near_m = (way.locate(record, rows, strengths_dbm)[:, :2] for way in ways)
    best = min((np.linalg.norm(at - true_m, axis=1) for at in near_m), key=lambda error: float(error.mean()))
    arrays: dict[str, Any] = {"error_m": located.error_m(true_m)}
    arrays["neighbours_error_m"] = located.neighbours_error_m(true_m)
    arrays |= {"best_neighbours_error_m": best, "inside": located.covers(true_m)}
    arrays |= {"area_m2": located.area_m2, "radius_m": located.radius_m}
    lists = {name: np.asarray(values).tolist() for name, values in arrays.items()}
    return {**lists, "calibration": asdict(located.calibration)}


def stretches(values: FloatArray) -> FloatArray:
    """Means of stretches of `STRETCH` consecutive rows of values [draws, rows]; the last has up to twice as many.

    Fewer than two stretches of rows are places that were measured one by one.
    """
    every = values.mean(axis=0)
    if len(every) < 2 * STRETCH:
        return np.asarray(every)
    return np.array([part.mean() for part in np.split(every, range(STRETCH, len(every) - STRETCH + 1, STRETCH))])


def row_of(cell: Cell, draws: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Row of the table: one draw of the training rows, or all draws pooled, which score the same test rows."""

    def of(key: str) -> FloatArray:
        return np.array([draw[key] for draw in draws], float)

    def interval(values: FloatArray) -> list[float]:
        mean = bootstrap(stretches(values), statistic=np.mean)
        return [mean.value, mean.low, mean.high]

    error, near, best = of("error_m"), of("neighbours_error_m"), of("best_neighbours_error_m")
    gain, inside = interval(near - error), interval(of("inside"))
    figures = {
        "median_m": float(np.median(error)),
        "mean_m": float(error.mean()),
        "neighbours_median_m": float(np.median(near)),
        "neighbours_mean_m": float(near.mean()),
        "best_neighbours_mean_m": float(best.mean()),
        "gain_m": gain,
        "gain_over_best_m": interval(best - error),
        "inside": inside,
        "area_m2": float(np.median(of("area_m2"))),
        "radius_m": float(np.median(of("radius_m"))),
    }
    which = f"seed {cell.seed}" if len(draws) == 1 else f"{len(draws)} {POOLED}"
    data = "" if cell.dataset == FLAT else f"{cell.dataset}, "
    what = f"{data}{'all' if cell.n_train is None else cell.n_train} rows, {cell.title}, {which}"
    value = f"error {figures['median_m']:.2f} m (mean {figures['mean_m']:.2f}), kNN "
    value += f"{figures['neighbours_median_m']:.2f} m (mean {figures['neighbours_mean_m']:.2f}), "
    value += f"{inside[0]:.0%} inside"
    asked = f"gain {gain[0]:.2f} m ({gain[1]:.2f} to {gain[2]:.2f}), 85 to 95 % inside"
    return {**line(what, value, asked), **figures}


def _show(name: str) -> Any:
    last = [""]

    def on_progress(stage: str, share: float, progress: Any = None, /) -> None:
        if stage != last[0]:
            last[0] = stage
            say("locate", f"{name}: {stage}")

    return on_progress


def main() -> dict[str, Any]:
    """Measure all cells, those that this code has measured before excepted; `InputError` where data are missing.

    ``failed`` is there where nearest neighbours are not clearly worse with `ROWS` rows and the walls, or regions do not
    hold 85 to 95 % of the true positions, draws pooled; ``calibration`` is that of each cell.
    """
    data_folder(FLAT)
    place = RUNS / fit_key(source_files())
    scene = scene_of_data(FLAT, place)
    measured: dict[Cell, dict[str, Any]] = {}
    for number, cell in enumerate(CELLS, 1):
        say("locate", f"{number} of {len(CELLS)}: {cell.name}")
        measured[cell] = kept(place / f"{cell.name}.json", partial(measure, cell, scene, place / cell.name))
        row = row_of(cell, [measured[cell]])
        say("locate", f"{row['what']}: {row['value']}; {row['asked']}")
    return {"calibration": {cell.name: result["calibration"] for cell, result in measured.items()}, **summary(measured)}


def summary(measured: Mapping[Cell, Mapping[str, Any]]) -> dict[str, Any]:
    """Rows of the table, draws of the same kind pooled after them, and the verdict on pooled rows."""
    kinds: dict[Cell, list[Cell]] = {}
    for cell in measured:
        kinds.setdefault(replace(cell, seed=0), []).append(cell)
    rows, pooled = [], {}
    for kind, cells in kinds.items():
        rows += [row_of(cell, [measured[cell]]) for cell in cells]
        pooled[kind] = row_of(kind, [measured[cell] for cell in cells])
        if len(cells) > 1:
            rows.append(pooled[kind])
    worse = [row["what"] for kind, row in pooled.items() if kind.n_train and kind.scene and row["gain_m"][1] <= 0]
    outside = [row["what"] for row in pooled.values() if not INSIDE[0] <= row["inside"][0] <= INSIDE[1]]
    verdict: dict[str, Any] = {"not_clearly_better": worse, "coverage_outside": outside}
    if worse or outside:
        text = f"not clearly better than kNN: {worse or 'none'}"
        verdict["failed"] = f"{text}; coverage outside 85 to 95 %: {outside or 'none'}"
    return {"rows": rows, **verdict}


table = lined(
    "| training rows, model | error, median (mean), m | kNN, median (mean), m | gain on kNN, m | inside 90 % regions "
    "| radius, m |",
    "| {what} | **{median_m:.2f}** ({mean_m:.2f}) | {neighbours_median_m:.2f} ({neighbours_mean_m:.2f}) "
    "| {gain_m[0]:.2f} ({gain_m[1]:.2f} to {gain_m[2]:.2f}) | {inside[0]:.0%} ({inside[1]:.0%} to {inside[2]:.0%}) "
    "| {radius_m:.1f} |",
    lambda row: row if row["what"].endswith(POOLED) or "all rows" in row["what"] else None,
)
"""Pooled draws: error, gain over nearest neighbours with its 95 % interval, and regions."""
