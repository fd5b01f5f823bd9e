"""Tables of a comparison: scores of runs and references, and paired differences on common rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray
from ..tasks import TASKS
from ..tasks.scores import block_bootstrap
from ..training.selection import clusters
from .baselines import CONSTANT, CONSTANT_RMSE, constant_of, warnings_of
from .folder import known_config
from .results import PREDICTED, Results

COLUMNS = {"rank": "rank", "run": "run", "model": "model", "dataset": "data set", "split": "split", "seed": "seed"}
COLUMNS |= {"n_train": "training rows (mean of folds)", "n_test": "test rows", "metric": "score"}
COLUMNS |= {key: key for key in ("median", "mean", "p10", "p90")} | {"common_mean": "mean, common rows"}
COLUMNS |= {"bias": "bias (dB)", "std": "standard deviation of the error (dB)", "rmse": "RMSE (dB)"}
COLUMNS |= {"inside_90": "inside 90 %", "crps": "CRPS", "ms_per_sample": "ms per sample"}
COLUMNS |= {"train_seconds": "training (s)", "peak_memory_mb": "peak memory (MB)"}
"""Columns of ``compare.csv`` and their headings on the page."""
SCORES = ("median", "mean", "p10", "p90", "bias", "std", "rmse")  # columns of a block of scores
DIFFERENCES = {key: key for key in ("run", "against", "verdict", "difference")}
DIFFERENCES |= {"low": "95 % from", "high": "to", "rows": "common rows", "blocks": "blocks"}
"""Columns of ``differences.csv`` and their headings on the page; positive differences are in favour of the run."""
METHODS = {"method": "method", "seeds": "seeds", "median": "median, mean of seeds", "median_sd": "standard deviation"}
METHODS |= {"mean": "mean, mean of seeds", "mean_sd": "its standard deviation"}
METHODS |= {"difference": "difference from the best", "low": "95 % from", "high": "to"}
"""Columns of ``methods.csv`` and their headings on the page."""
BETTER, TIE, WORSE, SAME, FEW = "better", "tie", "worse", "another seed", "too few rows"
NO_GAIN = "no better than a constant"
OTHER_ROWS, UNKNOWN_ROWS = "not comparable: trained on other rows", "not comparable: training rows are not stored"
FEWEST = 2  # least number of common rows of a difference with an interval
MOST_BLOCKS, ROWS_OF_BLOCK, LEAST_BLOCKS = 20, 5, 10
"""Blocks of the bootstrap: one of five rows, twenty at most; ten, or each row, where rows are few, since percentile
intervals of fewer blocks are too narrow."""


@dataclass(frozen=True)
class Difference:
    """Paired difference of a run and a run or reference, in favour of the first where it is positive."""

    run: str  # name of the run
    against: str  # name of the other run or of the reference
    rows: int  # number of common rows
    # `BETTER`, `NO_GAIN`, `TIE` or `WORSE`, of all seeds of the two; or `SAME`, `FEW`, `OTHER_ROWS`, `UNKNOWN_ROWS`
    verdict: str
    # difference, low, high: mean difference of the score per row with its 95 % interval; None: too few rows, or not
    # comparable
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    blocks: int | None = None  # number of blocks of rows that are resampled
    seeds: int = 1  # number of seeds of which the verdict is


def common(runs: Sequence[Results]) -> list[tuple[str, int]]:
    """Receiver and row of the observations that all runs score, with the same truth."""
    first, *others = (run.truth_digests for run in runs)
    return [key for key, digest in first.items() if all(other.get(key) == digest for other in others)]


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
    """Each run against the best one, of several runs, and against its best reference; then all other pairs of runs.

    "Better" and "worse": the 95 % interval of the difference, of resampled blocks of test rows, excludes zero in all
    seeds; all else is a tie. `NO_GAIN`: better, but some seed is no better than the constant prediction
    (`wrf_mi.runs.baselines.warnings_of`). Runs that differ in their seed alone are seeds of one method; methods are
    compared by runs of the same seed. Runs that predict the common rows from other training rows are not comparable.
    """
    best, of_name, by_name = best_run(runs), methods(runs), {run.name: run for run in runs}

    def seeds_of(run: Results) -> Sequence[Results]:
        return of_name[run.name]

    @cache  # of several seeds each pair is in the verdict of each
    def pair(run: str, other: str, is_method: bool) -> Difference:
        return _of_pair(by_name[run], by_name[other], is_method)

    def between(run: Results, other: Results) -> Difference:
        if seeds_of(other) is seeds_of(run):
            return replace(pair(run.name, other.name, False), verdict=SAME)

        def to_rival(seed: Results) -> Difference:
            rival = next((each for each in seeds_of(other) if each.seed == seed.seed), other)
            return pair(seed.name, rival.name, True)

        return _of_seeds(run, seeds_of(run), to_rival)

    of_runs: list[Difference] = []
    for run in runs:
        of_runs += [between(run, best)] if run is not best else []
        of_runs.append(_of_seeds(run, seeds_of(run), _to_reference))
    listed = {frozenset((gain.run, gain.against)) for gain in of_runs}
    for run, other in combinations(runs, 2):
        if seeds_of(other) is seeds_of(run):
            continue
        gain = between(run, other)
        of_runs += [gain] if (names := frozenset((gain.run, gain.against))) not in listed else []
        listed.add(names)
    return of_runs


def first_differences(runs: Sequence[Results], gains: Sequence[Difference]) -> Sequence[Difference]:
    """Of `differences` those against the best run and the references."""
    return gains[: 2 * len(runs) - 1]


def _of_seeds(run: Results, seeds: Sequence[Results], against: Callable[[Results], Difference]) -> Difference:
    by_run = {seed.name: against(seed) for seed in seeds}
    words = {gain.verdict for gain in by_run.values() if gain.difference is not None}
    gain = by_run[run.name]
    if gain.difference is None:
        return gain
    compared = sum(each.difference is not None for each in by_run.values())
    verdict = words.pop() if len(words) == 1 else TIE
    # Of such a run the commands say that it is no better than a constant: no praise here.
    if verdict == BETTER and any(warnings_of(seed.metrics) for seed in seeds):
        verdict = NO_GAIN
    return replace(gain, verdict=verdict, seeds=compared)


def _of_pair(run: Results, other: Results, is_method: bool) -> Difference:
    """Difference of two runs on common rows; without a value where methods have other training rows."""
    keys = common([run, other])
    rows = [row for _, row in keys]
    trained = [(run.training_digests.get(key), other.training_digests.get(key)) for key in keys]
    if is_method and any(digest != another or digest is None for digest, another in trained):
        unknown = any(None in pair for pair in trained)
        return Difference(run.name, other.name, len(set(rows)), UNKNOWN_ROWS if unknown else OTHER_ROWS)
    change = [run.score[run.scored[key]] - other.score[other.scored[key]] for key in keys]
    return _of_rows(run, other.name, rows, change)


def _to_reference(run: Results) -> Difference:
    """Difference of a run and its reference, which has the same training rows."""
    pairs = np.argwhere(np.isfinite(run.score) & np.isfinite(run.reference_score))
    change = [run.score[r, m] - run.reference_score[r, m] for r, m in pairs]
    return _of_rows(run, run.reference_name, run.row[pairs[:, 1]].tolist(), change)


def _of_rows(run: Results, against: str, row: Sequence[int], change: Sequence[Any]) -> Difference:
    """Difference from those of observations, given their rows; in favour of the run where positive."""
    rows, which = np.unique(np.asarray(row, int), return_inverse=True)
    if len(rows) < FEWEST:
        return Difference(run.name, against, len(rows), FEW)
    # Mean over the receivers of each row, since what they observe is not independent.
    means = np.bincount(which, np.asarray(change, float)) / np.bincount(which)
    place = {row: m for m, row in enumerate(run.row.tolist())}
    tx_pos_m = run.tx_pos_m[[place[row] for row in rows.tolist()]]
    blocks = row_blocks(tx_pos_m)
    interval = block_bootstrap(means if TASKS[run.task].higher_is_better else -means, blocks)
    verdict = BETTER if interval.low > 0 else WORSE if interval.high < 0 else TIE
    figures = interval.value, interval.low, interval.high, len(np.unique(blocks))
    return Difference(run.name, against, len(rows), verdict, *figures)


def row_blocks(tx_pos_m: FloatArray) -> IntArray:
    """Number of the block of each row [n] for `block_bootstrap`: k-means clusters of the positions [n, 3].

    Rows whose positions are not all known, or all the same, fall into stretches of consecutive rows.
    """
    return _row_blocks(np.asarray(tx_pos_m, float).tobytes())


@lru_cache(maxsize=64)  # most pairs of runs have the same rows
def _row_blocks(stored_m: bytes) -> IntArray:
    tx_pos_m = np.frombuffer(stored_m).reshape(-1, 3)
    n = len(tx_pos_m)
    count = min(MOST_BLOCKS, max(n // ROWS_OF_BLOCK, min(n, LEAST_BLOCKS)))
    distinct, place = np.unique(tx_pos_m, axis=0, return_inverse=True)
    if np.isfinite(distinct).all() and len(distinct) > 1:
        few = len(distinct) <= count
        labels = np.arange(len(distinct)) if few else clusters(distinct, count, np.random.default_rng(0))
        return np.asarray(labels[place.reshape(-1)], np.int64)
    return np.arange(n) * count // n


def methods(runs: Sequence[Results]) -> dict[str, list[Results]]:
    """Runs that differ from a run in their seed alone, itself among them, by its name."""
    groups: dict[Any, list[Results]] = {}
    for run in runs:
        groups.setdefault(_method(run), []).append(run)
    alike: dict[str, list[Results]] = {}
    for members in groups.values():
        # Two runs of one seed differ in something else, which no configuration states.
        distinct = len({run.seed for run in members}) == len(members)
        alike |= {run.name: members if distinct else [run] for run in members}
    return alike


def method_rows(runs: Sequence[Results]) -> list[dict[str, Any]]:
    """Rows of the table of methods, best mean first; none where no method has several seeds.

    The difference is that from the best, of scores that are means over seeds, with its interval over blocks of rows.
    """
    task, keys = TASKS[runs[0].task], common(runs)
    groups = list({id(group): group for group in methods(runs).values()}.values())
    if not keys or all(len(group) == 1 for group in groups):
        return []
    of_group = [np.mean([[run.score[run.scored[key]] for key in keys] for run in group], axis=0) for group in groups]
    order = sorted(range(len(groups)), key=lambda k: float(of_group[k].mean()), reverse=task.higher_is_better)
    rows = []
    for k in order:
        group = groups[k]
        # Of splits that a seed draws, methods are compared by the same seeds alone.
        digests, best = (_trained(runs, keys) for runs in (group, groups[order[0]]))
        gain = Difference(group[0].name, "", len({row for _, row in keys}), OTHER_ROWS)
        if digests == best and not any(None in rows for rows in digests):
            gain = _of_rows(group[0], "", [row for _, row in keys], of_group[k] - of_group[order[0]])
        row: dict[str, Any] = {"method": ", ".join(run.name for run in group), "seeds": len(group)}
        for name in ("median", "mean"):
            values = [run.metrics[task.block][name] for run in group]
            row |= {name: float(np.mean(values)), f"{name}_sd": float(np.std(values, ddof=1)) if group[1:] else None}
        rows.append(row | {key: getattr(gain, key) for key in ("difference", "low", "high")})
    return rows


def _trained(runs: Sequence[Results], keys: Sequence[tuple[str, int]]) -> set[tuple[int | None, ...]]:
    """Digests of the training rows behind the predictions of some observations, of each run."""
    return {tuple(run.training_digests.get(key) for key in keys) for run in runs}


def _method(run: Results) -> Any:
    """What runs of several seeds have in common; runs of unknown configuration are methods of their own."""
    config = known_config(run.path)
    if config is None:
        facts = [run.metrics.get(key) for key in (PREDICTED, "model", "split", "n_train")]
        return run.name if facts[0] is None else repr(facts[1:])
    settings = config.settings
    if "seed" in config.entry.train_arguments:
        settings = replace(settings, seed=0)
    return repr(replace(config, seed=0, settings=settings))


def score_rows(runs: Sequence[Results]) -> list[dict[str, Any]]:
    """Rows of the table for a data set, ranked by the median: each run, and each reference and constant once."""
    task = TASKS[runs[0].task]
    means = common_means(runs)
    rows: list[dict[str, Any]] = [
        run.metrics | run.metrics[task.block] | {"run": run.name, "seed": run.seed, "common_mean": means.get(run.name)}
        for run in runs
    ]
    for name, (run, key) in references(runs).items():
        counts = {column: run.metrics[column] for column in ("split", "n_train", "n_test")}
        rows.append(counts | run.metrics["reference"][key] | {"run": name, "model": key})
    rows += _constants(runs)
    shared = {"dataset": Path(runs[0].dataset).name or runs[0].dataset, "metric": task.label}
    ranked = sorted(range(len(rows)), key=lambda k: float(rows[k]["median"]), reverse=task.higher_is_better)
    for rank, k in enumerate(ranked, 1):
        rows[k] |= {"rank": rank}
    return [{column: (row | shared).get(column) for column in COLUMNS} for row in rows]


def _constants(runs: Sequence[Results]) -> list[dict[str, Any]]:
    """Rows of the constant prediction (`wrf_mi.tasks.Task.constants`), once for runs with the same scores of it."""
    by_name: dict[str, dict[str, Any]] = {}
    for run, kind in ((run, kind) for run in runs for kind in (CONSTANT, CONSTANT_RMSE) if kind in run.metrics):
        shown = {column: run.metrics[column] for column in ("split", "n_train", "n_test")}
        shown |= {key: run.metrics[kind].get(key) for key in SCORES} | {"model": CONSTANT}
        if shown not in by_name.values():
            name = f"{constant_of(run.metrics, kind).removeprefix('the ')}, {run.metrics['split']}"
            by_name[f"{name} of {run.name}" if name in by_name else name] = shown
    return [{"run": name} | shown for name, shown in by_name.items()]


def difference_rows(differences: Sequence[Difference]) -> list[dict[str, Any]]:
    """Rows of the table of differences."""
    seeds = [f" ({gain.seeds} seeds)" if gain.seeds > 1 else "" for gain in differences]
    return [asdict(gain) | {"verdict": gain.verdict + words} for gain, words in zip(differences, seeds, strict=True)]


def references(runs: Sequence[Results]) -> dict[str, tuple[Results, str]]:
    """A run and the key of each reference by name, once for runs with the same training and test rows."""
    by_name: dict[str, tuple[Results, str]] = {}
    for run in runs:
        for key, scores in run.reference_scores.items():
            earlier_scores = (r.reference_scores[key] for r, k in by_name.values() if k == key)
            if any(np.array_equal(scores, other, equal_nan=True) for other in earlier_scores):
                continue
            name = f"{run.words_of(key)}, {run.metrics['split']}"
            by_name[f"{name} of {run.name}" if name in by_name else name] = run, key
    return by_name
