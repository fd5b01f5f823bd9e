"""Tables of a comparison: scores of runs and references, and paired differences on common rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.angles import FloatArray
from ..tasks import TASKS
from ..tasks.scores import bootstrap
from .folder import known_config
from .results import Results

COLUMNS = {"run": "run", "model": "model", "dataset": "data set", "split": "split", "seed": "seed"}
COLUMNS |= {"n_train": "training rows", "n_test": "test rows", "metric": "score"}
COLUMNS |= {key: key for key in ("median", "mean", "p10", "p90")} | {"common_mean": "mean, common rows"}
COLUMNS |= {"inside_90": "inside 90 %", "crps": "CRPS", "ms_per_sample": "ms per sample"}
COLUMNS |= {"train_seconds": "training (s)", "peak_memory_mb": "peak memory (MB)"}
"""Columns of ``compare.csv`` and their headings on the page."""
DIFFERENCES = {key: key for key in ("run", "against", "verdict", "difference")}
DIFFERENCES |= {"low": "95 % from", "high": "to", "rows": "common rows"}
"""Columns of ``differences.csv`` and their headings on the page; positive differences are in favour of the run."""
BETTER, TIE, WORSE, SAME, FEW = "better", "tie", "worse", "another seed", "too few rows"
FEWEST = 2  # least number of common rows of a difference with an interval


@dataclass(frozen=True)
class Difference:
    """Paired difference of a run and a run or reference, in favour of the first where it is positive."""

    run: str  # name of the run
    against: str  # name of the other run or of the reference
    rows: int  # number of common rows
    verdict: str  # `BETTER`, `TIE` or `WORSE`, of all seeds of the two; or `SAME`, `FEW`
    # difference, low, high: mean difference of the score per row with its 95 % interval; None: too few rows
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    seeds: int = 1  # number of seeds of which the verdict is


def common(runs: Sequence[Results]) -> list[tuple[str, int]]:
    """Receiver and row of the observations that all runs score, with the same truth."""
    first, rows = runs[0], [run.scored for run in runs]

    def same(key: tuple[str, int]) -> bool:
        truth = first.truth[rows[0][key]]
        others = zip(runs[1:], rows[1:], strict=True)
        return all(key in of and np.array_equal(run.truth[of[key]], truth, equal_nan=True) for run, of in others)

    return [key for key in rows[0] if same(key)]


def common_means(runs: Sequence[Results]) -> dict[str, float]:
    """Mean score over the observations that all runs score, by the runs' names; empty without any."""
    keys = common(runs)
    return {run.name: float(np.mean([run.score[run.scored[key]] for key in keys])) for run in runs if keys}


def best_run(runs: Sequence[Results]) -> Results:
    """The run of the best mean score on common rows; of all its rows where there are none."""
    task = TASKS[runs[0].task]
    means = common_means(runs) or {run.name: run.metrics[task.block]["mean"] for run in runs}
    return (max if task.higher_is_better else min)(runs, key=lambda run: means[run.name])


def differences(runs: Sequence[Results]) -> list[Difference]:
    """Each run against its reference and, of several runs, against the best one.

    "Better" and "worse": the 95 % interval of the difference, resampled over test rows, excludes zero in all seeds; all
    else is a tie. Runs that differ in their seed alone are seeds of one method.
    """
    best, methods = best_run(runs), {run.name: _method(run) for run in runs}

    def seeds_of(run: Results) -> list[Results]:
        return [other for other in runs if methods[other.name] == methods[run.name]]

    def to_best(run: Results) -> tuple[str, FloatArray]:
        rival = next((other for other in seeds_of(best) if other.seed == run.seed), best)
        return rival.name, _paired(run, rival)

    of_runs: list[Difference] = []
    for run in runs:
        if run is not best and methods[run.name] == methods[best.name]:
            of_runs.append(replace(_of_rows(run, best.name, _paired(run, best)), verdict=SAME))
        elif run is not best:
            of_runs.append(_of_seeds(run, seeds_of(run), to_best))
        of_runs.append(_of_seeds(run, seeds_of(run), _to_reference))
    return of_runs


def _of_seeds(
    run: Results, seeds: Sequence[Results], paired: Callable[[Results], tuple[str, FloatArray]]
) -> Difference:
    by_run = {seed.name: _of_rows(seed, *paired(seed)) for seed in seeds}
    words = {seed.verdict for seed in by_run.values()}
    return replace(by_run[run.name], verdict=words.pop() if len(words) == 1 else TIE, seeds=len(seeds))


def _of_rows(run: Results, against: str, rows: FloatArray) -> Difference:
    """Difference from the differences of rows, in favour of the run where positive."""
    if len(rows) < FEWEST:
        return Difference(run.name, against, len(rows), FEW)
    interval = bootstrap(rows, statistic=np.mean)
    verdict = BETTER if interval.low > 0 else WORSE if interval.high < 0 else TIE
    return Difference(run.name, against, len(rows), verdict, interval.value, interval.low, interval.high)


def _paired(run: Results, other: Results) -> FloatArray:
    keys = common([run, other])
    change = [run.score[run.scored[key]] - other.score[other.scored[key]] for key in keys]
    return _per_row(run, [row for _, row in keys], change)


def _to_reference(run: Results) -> tuple[str, FloatArray]:
    known = np.argwhere(np.isfinite(run.score) & np.isfinite(run.reference_score))
    change = [run.score[r, m] - run.reference_score[r, m] for r, m in known]
    return run.reference_name, _per_row(run, run.row[known[:, 1]].tolist(), change)


def _per_row(run: Results, row: Sequence[int], change: Sequence[Any]) -> FloatArray:
    """Mean over the receivers of each row, since what they observe is not independent; positive is better."""
    if not len(row):
        return np.zeros(0)
    _, which = np.unique(row, return_inverse=True)
    means = np.bincount(which, np.asarray(change, float)) / np.bincount(which)
    return np.asarray(means if TASKS[run.task].higher_is_better else -means)


def _method(run: Results) -> Any:
    """What runs of several seeds have in common; runs without a configuration are methods of their own."""
    config = known_config(run.path)
    if config is None:
        return run.name
    settings = config.settings
    if "seed" in config.entry.train_arguments:
        settings = replace(settings, seed=0)
    return repr(replace(config, seed=0, settings=settings))


def score_rows(runs: Sequence[Results]) -> list[dict[str, Any]]:
    """Rows of the table for a data set: each run, and each reference once."""
    task = TASKS[runs[0].task]
    means = common_means(runs)
    rows: list[dict[str, Any]] = [
        run.metrics | run.metrics[task.block] | {"run": run.name, "seed": run.seed, "common_mean": means.get(run.name)}
        for run in runs
    ]
    for name, (run, key) in references(runs).items():
        counts = {column: run.metrics[column] for column in ("split", "n_train", "n_test")}
        rows.append(counts | run.metrics["reference"][key] | {"run": name, "model": key})
    shared = {"dataset": Path(runs[0].dataset).name or runs[0].dataset, "metric": task.label}
    return [{column: (row | shared).get(column) for column in COLUMNS} for row in rows]


def difference_rows(differences: Sequence[Difference]) -> list[dict[str, Any]]:
    """Rows of the table of differences."""
    seeds = [f" ({gain.seeds} seeds)" if gain.seeds > 1 else "" for gain in differences]
    return [asdict(gain) | {"verdict": gain.verdict + words} for gain, words in zip(differences, seeds, strict=True)]


def references(runs: Sequence[Results]) -> dict[str, tuple[Results, str]]:
    """A run and the key of each reference by name, once for runs with the same training and test rows."""
    by_name: dict[str, tuple[Results, str]] = {}
    for run in runs:
        for key, scores in run.reference_scores.items():
            known = (r.reference_scores[key] for r, k in by_name.values() if k == key)
            if any(np.array_equal(scores, other, equal_nan=True) for other in known):
                continue
            name = f"{TASKS[run.task].references[key]}, {run.metrics['split']}"
            by_name[f"{name} of {run.name}" if name in by_name else name] = run, key
    return by_name
