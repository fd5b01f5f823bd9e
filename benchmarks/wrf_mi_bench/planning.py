"""Where to measure next: errors of maps by number of rows, of planned rows and of rows chosen otherwise.

From ten random training rows, rows are added ten at a time by each rule, a model is fitted to them, and its error on
the official test rows is stored. Rules are random rows, those that fill space (each the farthest from all before),
those of the greatest variance, and `wrf_mi.plan`. Where a scene is known the model is the hybrid's mean in it with
interpolation.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.distance import cdist

import wrf_mi
from wrf_mi.core import Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.datasets import make_splits
from wrf_mi.maps.plan import error_priors, plan
from wrf_mi.runs.api import Run
from wrf_mi.scene.make import make_scene
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import bootstrap

from .bench import FLAT
from .comparison import data_folder, kept_work, line, say
from .random_room import random_room_record
from .sources import fit_key, source_files

RUNS = Path("runs/bench/plan")
SIZES = (10, 20, 30, 40, 50, 60)
STARTS = range(5)
MOST_CANDIDATES = 400  # training rows among which rules choose, drawn at random
IN_SCENE = ("stages=mean,residual",)
RANDOM, FILLING, VARIANCE, OURS = "random", "space-filling", "greatest variance", "plan"
RULES = (RANDOM, FILLING, VARIANCE, OURS)


@dataclass(frozen=True)
class Place:
    """Data, and the scene of the hybrid or None for kriging."""

    record: Record
    scene: Path | None


def _flat(folder: Path) -> Place:
    plan_file = data_folder(FLAT) / "layout.csv"
    return Place(wrf_mi.load(FLAT), make_scene(plan_file, folder / "scene", height_m=2.7).folder)


def _scanned(name: str, scene: bool, folder: Path) -> Place:
    record = wrf_mi.load(name)
    scan = Path(record.source) / SCAN
    return Place(record, make_scene(scan, folder / "scene").folder if scene else None)


def _room(seed: int, folder: Path) -> Place:
    record, _, scan = random_room_record(seed, folder)
    return Place(record, scan)


PLACES: Mapping[str, Any] = {
    FLAT: _flat,
    "traced-floor-receivers": partial(_scanned, "traced-floor-receivers", True),
    "laboratory": partial(_scanned, "laboratory", False),
    "traced-room": partial(_scanned, "traced-room", False),
    **{f"random room {seed}": partial(_room, seed) for seed in (201, 202, 203, 204)},
}


def farthest_points(positions_m: FloatArray, count: int, known_m: FloatArray) -> IntArray:
    """Indices of positions [n, 3] each of which is the farthest from those before and from known ones [k, 3].

    Source: Gonzalez, "Clustering to minimize the maximum intercluster distance" (1985), Theor. Computer Science 38.
    """
    distance, chosen = cdist(positions_m, known_m).min(axis=1), []
    for _ in range(count):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(positions_m - positions_m[chosen[-1]], axis=1))
    return np.asarray(chosen)


def next_rows(rule: str, run: Run, record: Record, rows: IntArray, able: IntArray, count: int, seed: int) -> IntArray:
    """Rows that a rule adds to those of a run, of those that it may choose from."""
    left = np.setdiff1d(able, rows)
    if rule == RANDOM:
        return np.random.default_rng([seed, len(rows)]).choice(left, count, replace=False)
    if rule == FILLING:
        return left[farthest_points(record.tx_pos_m[left], count, record.tx_pos_m[rows])]
    if rule == VARIANCE:
        covariances = [p.posterior(record.tx_pos_m[left]) for p in error_priors(run, [0], record.tx_pos_m[left])]
        chosen = list[int]()
        for _ in range(count):
            variance = np.sum([covariance.diagonal() for covariance in covariances], axis=0)
            variance[chosen] = -np.inf
            chosen.append(int(np.argmax(variance)))
            for covariance in covariances:
                column = covariance[:, chosen[-1]].copy()
                covariance -= np.outer(column, column / column[chosen[-1]])
        return left[chosen]
    candidates_m, first = np.unique(record.tx_pos_m[left], axis=0, return_index=True)
    low, high = (corner(record.tx_pos_m[able, :2], axis=0) for corner in (np.min, np.max))
    planned = plan(run, count, candidates_m=candidates_m, area_m=(low - 0.1, high + 0.1)).tx_pos_m
    return left[first[[int(np.flatnonzero((candidates_m == place).all(axis=1))[0]) for place in planned]]]


def measure(name: str, rule: str, start: int, folder: Path) -> list[float]:
    """Median error on the test rows by the number of rows, from one start."""
    place = PLACES[name](folder)
    record, official = place.record, make_splits(place.record, "official")[0]
    rng = np.random.default_rng([start, 7])
    able = np.sort(rng.permutation(official.all_train)[:MOST_CANDIDATES])
    rows, scores = np.sort(rng.permutation(able)[: SIZES[0]]), list[float]()
    model, settings = ("kriging", ()) if place.scene is None else ("hybrid", IN_SCENE)
    for size in SIZES:
        split = Split("chosen", start, rows, rows[:0], official.test)
        run = wrf_mi.train(record, model, out=folder / f"{size}", scene=place.scene, split=split, settings=settings)
        scores.append(run.metrics[TASKS[record.task].block]["median"])
        if size < SIZES[-1]:
            count = SIZES[SIZES.index(size) + 1] - size
            rows = np.sort(np.concatenate([rows, next_rows(rule, run, record, rows, able, count, start)]))
    return scores


def main() -> dict[str, Any]:
    """Measure all places, rules and starts; parts that this code has measured before are not measured again."""
    data_folder(FLAT)  # missing data are reported first
    place = RUNS / fit_key(source_files())
    rows = []
    for name in PLACES:
        errors: dict[str, list[list[float]]] = {}
        for rule in RULES:
            say("plan", f"{name}, {rule}")
            parts = {k: f"{name}-{rule}-{k}".replace(" ", "-") for k in STARTS}
            errors[rule] = [kept_work(place, part, partial(measure, name, rule, k)) for k, part in parts.items()]
        rows.append({**line(name, summary(errors, name), ""), "errors": errors})
    return {"rows": rows}


def summary(errors: Mapping[str, Sequence[Sequence[float]]], name: str) -> str:
    """Scores of each rule at 20, 30 and 60 rows, and rows of the plan that equal 60 random ones."""
    sizes = [SIZES.index(size) for size in (20, 30, 60)]
    means = {rule: np.mean(values, axis=0) for rule, values in errors.items()}
    parts = [f"{rule} " + ", ".join(f"{mean[k]:.3g}" for k in sizes) for rule, mean in means.items()]
    better = 1 if means[RANDOM][-1] > means[RANDOM][0] else -1
    reached = np.flatnonzero(better * (means[OURS] - means[RANDOM][-1]) >= 0)
    equal = f"{SIZES[reached[0]]} planned rows equal 60 random ones" if len(reached) else "60 random rows not equalled"
    gain = better * (np.asarray(errors[OURS]) - np.asarray(errors[RANDOM]))[:, 1:].mean(axis=1)
    return "; ".join([*parts, equal, f"gain over random {bootstrap(gain, statistic=np.mean)}"])
