"""Score of WRF-GS+ against the number of training rows: random start, start from a mesh, jointly with its paths, and
the paths alone with trained gain and materials.

The *rows saved* are the share of the rows of a random start that joint training needs for the same score.
"""

import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.runs.api import train
from wrf_mi.synthetic.furnished_room import NAME as ROOM
from wrf_mi.tasks import TASKS, Task

from .bench import FLAT
from .comparison import Row, data_folder, kept, line
from .sources import fit_key, source_files
from .stages import LAB, Cell
from .table_plan import SEEDS
from .tables import scene_of_data

RUNS = Path("runs/bench/rows-saved")  # kept results
ROWS: Mapping[str, Sequence[int]] = {LAB: (20, 40, 80, 160), ROOM: (50, 100, 200, 400), FLAT: (50, 100, 200, 400)}
STEPS = 3000
RANDOM, MESH, JOINT = "random start", "start from the mesh", "joint with its paths"
PATHS, IDW = "paths alone", "IDW"
CURVES = (RANDOM, MESH, JOINT, PATHS)
CALIBRATION = ("calibration=gain,materials", "transmission=true")  # settings of the paths alone


def measure(cell: Cell, seed: int, folder: Path, steps: int = STEPS) -> dict[str, Any]:
    """Median scores of all `CURVES` by name, and of inverse-distance weighting; ``task``."""
    scene, scores, field = scene_of_data(cell.dataset, folder.parent), dict[str, Any](), (f"steps={steps}",)
    for name, model, field_scene, settings in (
        (RANDOM, "wrf-gs+", None, field),
        (MESH, "wrf-gs+", None, (*field, f"initial.mesh={scene}")),
        (JOINT, "wrf-gs+", scene, field),
        (PATHS, "ray-tracing", scene, CALIBRATION),
    ):
        place = folder / name.replace(" ", "-")
        shutil.rmtree(place, ignore_errors=True)
        run = train(
            cell.dataset, model, out=place, scene=field_scene, n_train=cell.n_train, seed=seed, settings=settings
        )
        task, reference = TASKS[run.metrics["task"]], run.metrics["reference"]
        idw = reference[task.reference]["median"]
        scores |= {name: run.metrics[task.block]["median"], IDW: idw, "task": task.name}
    shutil.rmtree(folder)
    return scores


def rows_needed(rows: Sequence[int], score: Sequence[float], goal: float, higher_is_better: bool) -> float | None:
    """Number of rows at which a curve reaches a score, linear in the logarithm of the rows; the first number where it
    is reached at once, None: never.
    """
    sign = 1 if higher_is_better else -1
    best = np.maximum.accumulate(sign * np.asarray(score, float))
    if best[-1] < sign * goal:
        return None
    reached = int(np.argmax(best >= sign * goal))
    if reached == 0:
        return float(rows[0])
    share = (sign * goal - best[reached - 1]) / (best[reached] - best[reached - 1])
    low, high = np.log(rows[reached - 1]), np.log(rows[reached])
    return float(np.exp(low + share * (high - low)))


def curves(scores: Sequence[Mapping[str, Any]], dataset: str, name: str) -> np.ndarray:
    """Scores [sizes, seeds] of a data set by a name of `measure`."""
    of_data = [entry for entry in scores if entry["dataset"] == dataset]
    return np.array([[entry[name] for entry in of_data if entry["rows"] == n] for n in ROWS[dataset]])


def saved(scores: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Rows of the table: scores of each data set and size, and the rows that joint training needs."""
    lines = []
    for dataset, rows in ROWS.items():
        task = _task(scores, dataset)
        means = {name: curves(scores, dataset, name).mean(axis=1) for name in CURVES}
        for number, n in enumerate(rows):
            shown = ", ".join(f"{name} {means[name][number]:.{task.digits}f}" for name in means)
            needed = rows_needed(rows, means[JOINT], means[RANDOM][number], task.higher_is_better)
            text = "more than measured" if needed is None else f"{needed:.0f} ({needed / n:.0%})"
            lines.append(line(f"{dataset}, {n} rows", f"{shown}; joint needs {text}", "half of the rows"))
    return lines


def _task(scores: Sequence[Mapping[str, Any]], dataset: str) -> Task:
    return TASKS[next(entry["task"] for entry in scores if entry["dataset"] == dataset)]


def main() -> dict[str, Any]:
    """Measure all data sets, sizes and seeds, what this code has measured before excepted.

    `InputError` for signal strengths that are not on this machine; the other data are made here.
    """
    data_folder(FLAT)
    place, scores = RUNS / fit_key(source_files()), list[dict[str, Any]]()
    for seed in SEEDS:
        for dataset, rows in ROWS.items():
            for n in rows:
                cell, name = Cell(dataset, "official", n), f"{dataset}-{n}-{seed}"
                entry = kept(place / f"{name}.json", partial(measure, cell, seed, place / name))
                scores.append({"dataset": dataset, "rows": n, "seed": seed, **entry})
    return {"rows": saved(scores), "scores": scores}
