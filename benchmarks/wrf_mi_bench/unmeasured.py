"""Carriers and receivers without measurements: the hybrid beside ray tracing and interpolation, three seeds.

Scenes are made from scans or plans; the training rows of each fold correct them, within the hybrid's fit, and for ray
tracing by `correct_scene`. Scores of the same rows are compared in pairs, as means over seeds and pooled over folds;
intervals are 95 % bootstrap intervals over rows. Each fold of each seed is stored when it is measured
(`wrf_mi_bench.comparison.stored_part`).
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record, Split
from wrf_mi.correction import CorrectionOptions, default_options, write_page
from wrf_mi.datasets import make_splits
from wrf_mi.runs.api import train
from wrf_mi.runs.results import Observations, Results, read_run
from wrf_mi.stages.correct import correct_scene
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.floor_receivers import NAME as FLOOR
from wrf_mi.synthetic.furnished_room import BANDS
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import bootstrap

from .bench import FLAT
from .comparison import MEASURED, data_folder, line, measured_on, stored_part
from .declared import pivoted
from .sources import fit_key, source_files
from .stages import TRANSMISSION
from .table_plan import SEEDS
from .tables import scene_of_data

RUNS = Path("runs/bench/unmeasured")
LEFT = (0, 5, 20, 100)  # numbers of rows at each receiver that is held out
HYBRID, TRACED, CORRECTED = "hybrid", "ray tracing", "ray tracing, corrected scene"
KRIGING, IDW, CARRIER, LAW = "kriging", "IDW", "nearest carrier", "one law"
OWN_HYBRID, OWN_KRIGING, OWN_TREES = "hybrid of these rows", "kriging of these rows", "trees of these rows"
SCORE_DIGITS = 4  # decimals of stored scores: finer than any difference that is reported
Parts = dict[str, dict[str, Callable[[], dict[str, Any]]]]  # measurements by what is held out, and by name
PAIRS = "pairs"
FACTS = (PAIRS, "inside_90", "crps", "task", MEASURED)
"""What is known of a measurement beside the scores of the methods."""


@dataclass(frozen=True)
class Held:
    """A data set, and the split whose folds are held out."""

    dataset: str  # name
    kind: str  # ``frequency`` or ``receiver``
    n_train: int | None  # number of training rows; None: all
    groups: tuple[str, ...] | None  # parameter groups that are corrected; None: the default of the task
    folds: int  # number of folds


CARRIERS = (Held(BANDS, "frequency", None, ("materials",), 5),)
RECEIVERS = (Held(FLOOR, "receiver", None, None, 4), Held(FLAT, "receiver", 400, None, 6))


def corrected(case: Held, scene: str, record: Record, split: Split, folder: Path) -> str:
    """Scene in ``folder`` that is corrected by a split's training rows, made where needed."""
    if not folder.exists():
        options: CorrectionOptions = default_options(record)
        options = options if case.groups is None else replace(options, groups=case.groups)
        write_page(correct_scene(scene, record, split, options), folder, False)
    return str(folder)


def _run(place: Path, record: str | Record, split: Split | str, seed: int, model: str, **more: Any) -> Results:
    """Run of a model, whose folder is removed once it is read."""
    shutil.rmtree(place, ignore_errors=True)
    try:
        train(record, model, out=place, split=split, seed=seed, **more)
        return read_run(place)
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _scores(run: Results, prediction: Observations | None = None) -> list[float]:
    """Scores of a run, or of another prediction of its rows, receiver by receiver where the truth is known."""
    scores = run.score if prediction is None else TASKS[run.task].of_rows(prediction, run.truth)
    scores = np.asarray(scores, float)[:, np.argsort(run.row)]
    return [round(float(score), SCORE_DIGITS) for score in scores[np.isfinite(scores)]]


def _facts(hybrid: Results) -> dict[str, Any]:
    """Intervals and task of the hybrid; names of the receivers and rows of all scores, in their order."""
    scored = np.isfinite(np.asarray(hybrid.score, float)[:, np.argsort(hybrid.row)])
    pairs = [[hybrid.receivers[r], int(np.sort(hybrid.row)[i])] for r, i in np.argwhere(scored)]
    return {PAIRS: pairs, **{key: hybrid.metrics[key] for key in FACTS[1:-1]}}


def at_carrier(case: Held, fold: int, seed: int, folder: Path) -> dict[str, Any]:
    """Scores of the methods at a carrier that is held out, by name; ``inside_90`` and ``crps`` of the hybrid."""
    scene, record = str(scene_of_data(case.dataset, folder.parent)), load_record(case.dataset)
    split = f"{case.kind}:{fold}"
    (rows,) = make_splits(record, split, seed, case.n_train)
    better = corrected(case, scene, record, rows, folder.parent / f"corrected-{folder.name}")
    fit = partial(_run, folder, case.dataset, split, seed, n_train=case.n_train)
    hybrid = fit("hybrid", scene=scene)
    scores: dict[str, Any] = {HYBRID: _scores(hybrid)}
    for name, where in ((TRACED, scene), (CORRECTED, better)):
        scores[name] = _scores(fit("ray-tracing", scene=where, settings=TRANSMISSION))
    scores[KRIGING] = _scores(fit("kriging"))
    scores[IDW] = _scores(hybrid, hybrid.references["idw"])
    return scores | {CARRIER: _scores(hybrid, hybrid.references["carrier"]), **_facts(hybrid)}


def at_receivers(case: Held, left: int, fold: int, seed: int, folder: Path) -> dict[str, Any]:
    """Scores of the methods at receivers that are held out but for ``left`` rows each, as `at_carrier`.

    The scene is corrected without any of their rows.
    """
    scene, record = str(scene_of_data(case.dataset, folder.parent)), load_record(case.dataset)
    (none,) = make_splits(record, f"{case.kind}:{fold}", seed, case.n_train)
    name = f"corrected-{case.dataset}-{fold}-{seed}"
    better = corrected(case, scene, record, none, folder.parent / name)
    split = f"{case.kind}:{fold}" if not left else f"{case.kind}+{left}:{fold}"
    (rows,) = make_splits(record, split, seed, case.n_train)
    hybrid = _run(folder, record, rows, seed, "hybrid", scene=scene)
    scores: dict[str, Any] = {HYBRID: _scores(hybrid)}
    if left:
        fit = partial(_run, folder, *only(record, rows), seed)
        scores[OWN_HYBRID] = _scores(fit("hybrid", scene=scene))
        scores |= {OWN_KRIGING: _scores(fit("kriging")), OWN_TREES: _scores(fit("trees"))}
    else:
        for name, where in ((TRACED, scene), (CORRECTED, better)):
            scores[name] = _scores(_run(folder, record, rows, seed, "ray-tracing", scene=where, settings=TRANSMISSION))
        scores[LAW] = _scores(hybrid, hybrid.references["law"])
    return scores | _facts(hybrid)


def only(record: Record, split: Split) -> tuple[Record, Split]:
    """The receivers that a split holds out by themselves, with the rows that it leaves them."""
    # Rows to be scored are left, too: they are no training rows.
    scored = np.stack(np.meshgrid(split.held_receivers, split.test, indexing="ij"), axis=-1).reshape(-1, 2)
    alone = record.seen(replace(split, left=np.concatenate([split.left, scored]))).at_receivers(split.held_receivers)
    train = np.unique(split.left[:, 1])
    return alone, Split(f"{split.name}-alone", split.seed, train, train[:0], split.test)


def gains(measurements: Sequence[Mapping[str, Any]]) -> dict[str, tuple[float, float, Any]]:
    """Median and mean of each method, pooled, and the hybrid's mean gain over it with its interval, by name.

    Seeds score the same pairs of receiver and row, whose mean counts once.
    """
    task = TASKS[measurements[0]["task"]]
    sign = 1 if task.higher_is_better else -1
    names = [name for name in measurements[0] if name not in FACTS]
    pairs = [tuple(pair) for measurement in measurements for pair in measurement[PAIRS]]
    place = {pair: k for k, pair in enumerate(dict.fromkeys(pairs))}
    number = np.array([place[pair] for pair in pairs])
    pooled = {}
    for name in names:
        scores = np.clip(np.concatenate([measurement[name] for measurement in measurements]), *task.limits)
        pooled[name] = np.bincount(number, scores) / np.bincount(number)
    return {
        name: (
            float(np.median(scores)),
            float(scores.mean()),
            None if name == HYBRID else bootstrap(sign * (pooled[HYBRID] - scores), statistic=np.mean),
        )
        for name, scores in pooled.items()
    }


def _rows(what: str, measurements: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    digits = TASKS[measurements[0]["task"]].digits
    inside = float(np.mean([measurement["inside_90"] for measurement in measurements]))
    rows = []
    for name, (median, mean, gain) in gains(measurements).items():
        value = f"median {median:.{digits}f}, mean {mean:.{digits}f}"
        asked = f"{inside:.0%} inside (80 to 97 %)" if gain is None else f"hybrid better by {gain}"
        figures = {"at": what, "method": name, "median": median, "mean": mean, "inside": inside, "digits": digits}
        interval = None if gain is None else [gain.value, gain.low, gain.high]
        rows.append({**line(f"{what}: {name}", value, asked), **figures, "gain": interval})
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table: median (mean) score of each method, and the hybrid's mean gain with its 95 % interval."""
    shown = []
    for row in rows:
        score = f"{row['median']:.{row['digits']}f} ({row['mean']:.{row['digits']}f})"
        if row["gain"]:
            score += " [{}: {} to {}]".format(*(f"{part:.{row['digits']}f}" for part in row["gain"]))
        shown.append({**row, "score": score})
    return pivoted("| held out | inside | ... |", "| {at} | {inside:.0%} | ... |", "at", "method", "{score}")(shown)


def carriers() -> dict[str, Any]:
    """Measure every carrier held out in turn, three seeds; parts that are stored are read."""
    place = RUNS / fit_key(source_files())
    parts: Parts = {}
    for case in CARRIERS:
        hz = np.unique(load_record(case.dataset).carriers_hz)  # type: ignore[arg-type]
        for fold in range(case.folds):
            names = {seed: f"{case.dataset}-{fold}-{seed}" for seed in SEEDS}
            parts[f"{case.dataset}, {hz[fold] / 1e9:.1f} GHz"] = {
                name: partial(at_carrier, case, fold, seed, place / name) for seed, name in names.items()
            }
    return _measured("new-carriers", parts)


def receivers() -> dict[str, Any]:
    """Measure receivers held out in turn, without and with few rows of their own, three seeds, as `carriers`."""
    data_folder(FLAT)
    place = RUNS / fit_key(source_files())
    parts: Parts = {}
    for case in RECEIVERS:
        for left in LEFT:
            names = {(seed, k): f"{case.dataset}-{left}-{k}-{seed}" for seed in SEEDS for k in range(case.folds)}
            parts[f"{case.dataset}, {left} rows at new receivers"] = {
                name: partial(at_receivers, case, left, k, seed, place / name) for (seed, k), name in names.items()
            }
    return _measured("new-receivers", parts)


def _measured(benchmark: str, parts: Parts) -> dict[str, Any]:
    """Rows of the table, of stored or new measurements by name, which are pooled by what was held out."""
    rows, measurements = list[dict[str, Any]](), list[dict[str, Any]]()
    for what, works in parts.items():
        pooled = [stored_part(benchmark, name, work) for name, work in works.items()]
        measurements += pooled
        rows += _rows(what, pooled)
    return {"rows": rows, "measured": measured_on(measurements)}
