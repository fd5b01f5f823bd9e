"""Comparison of two methods by a paired bootstrap over test rows.

Both methods are scored on the same rows, rows are resampled with replacement, and a method is better where the 95 %
interval of the difference lies above zero. Over several seeds it must do so for each (`agreed`); all else is a tie.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import bootstrap

from ..core import InputError
from ..core.angles import FloatArray
from ..tasks import TASKS

Verdict = Literal["better", "worse", "tie"]

RESAMPLES = 4000
"""Number of resamples: each end of a 95 % interval then has 100 of them beyond it."""
VALUES_PER_CHUNK = 1 << 22
"""Number of resampled scores in memory at a time: 32 MiB."""


@dataclass(frozen=True)
class PairedDifference:
    """Difference of the scores of methods a and b in the score's unit; positive where a is better.

    Attributes:
        median: median score of a less median score of b.
        median_low: lower end of its 95 % interval.
        median_high: upper end.
        mean: mean score of a less mean score of b.
        mean_low: lower end of its 95 % interval.
        mean_high: upper end.
        verdict: on a, by the interval of the medians: ``better``, ``worse`` or ``tie``.
        mean_verdict: on a, by the interval of the means.
        rows: number of test rows compared.
    """

    median: float
    median_low: float
    median_high: float
    mean: float
    mean_low: float
    mean_high: float
    verdict: Verdict
    mean_verdict: Verdict
    rows: int

    def plain(self) -> dict[str, Any]:
        """Dictionary for ``metrics.json``."""
        return asdict(self)


def paired_difference(
    scores_a: ArrayLike, scores_b: ArrayLike, seed: int, task: str, resamples: int = RESAMPLES
) -> PairedDifference:
    """Compare two methods by their scores on the same test rows.

    Rows are resampled, not single scores: a row is drawn with the scores of all its receivers. Neighbouring rows of a
    path are not independent, so that the true interval is wider than the one stated.

    Args:
        scores_a: scores of a method, [..., rows], see `wrf_mi.tasks.scores`; NaN where nothing was received.
        scores_b: scores of the other method, of the same shape. NaN in either excludes the score of both.
        seed: seed of the resamples.
        task: name of a task in `wrf_mi.tasks.TASKS`, which states whether higher scores are better.
        resamples: number of resamples.

    Raises:
        InputError: shapes that differ, no row with two scores, an unknown task, or fewer than 100 resamples.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), section 13.3 (percentile interval);
    `scipy.stats.bootstrap`.
    """
    if task not in TASKS:
        raise InputError(f"task {task!r}: unknown; choose {', '.join(TASKS)}")
    if resamples < 100:
        raise InputError(f"{resamples} resamples: too few for a 95 % interval; choose 100 or more")
    a, b = (np.atleast_1d(np.asarray(scores, float)) for scores in (scores_a, scores_b))
    if a.shape != b.shape:
        raise InputError(f"scores {a.shape} and {b.shape} differ in shape; score both methods on the same rows")
    gap = (np.isnan(a) | np.isnan(b)).reshape(-1, a.shape[-1])
    rows = np.flatnonzero(~gap.all(axis=0))
    if not len(rows):
        raise InputError("no test row has a score of both methods; score them on the same rows")
    sign = 1.0 if TASKS[task].higher_is_better else -1.0
    a, b = (sign * np.where(gap, np.nan, v.reshape(gap.shape))[:, rows] for v in (a, b))
    known = not gap[:, rows].any()

    def interval(statistic: Callable[..., Any]) -> tuple[float, float, float]:
        def difference(drawn: NDArray[np.intp], axis: int = -1) -> FloatArray:
            x, y = (np.moveaxis(v[:, drawn.astype(np.intp)], 0, -2).reshape(*drawn.shape[:-1], -1) for v in (a, b))
            return np.asarray(statistic(x, axis=-1) - statistic(y, axis=-1))

        # SciPy asks for two rows; a single one twice has the same statistics.
        index, chunk = np.resize(np.arange(len(rows)), max(2, len(rows))), max(1, VALUES_PER_CHUNK // a.size)
        found = bootstrap((index,), difference, n_resamples=resamples, batch=chunk, method="percentile", rng=seed)
        low, high = found.confidence_interval
        return float(difference(index)), float(low), float(high)

    median, median_low, median_high = interval(np.median if known else np.nanmedian)
    mean, mean_low, mean_high = interval(np.mean if known else np.nanmean)
    return PairedDifference(
        median=median,
        median_low=median_low,
        median_high=median_high,
        mean=mean,
        mean_low=mean_low,
        mean_high=mean_high,
        verdict=_verdict(median_low, median_high),
        mean_verdict=_verdict(mean_low, mean_high),
        rows=len(rows),
    )


def agreed(verdicts: Iterable[str]) -> Verdict:
    """The verdict over several seeds: ``better`` or ``worse`` where all seeds agree, else ``tie``.

    Raises:
        InputError: no verdict.
    """
    found = set(verdicts)
    if not found:
        raise InputError("no verdicts to agree on: compare at least one seed")
    return "better" if found == {"better"} else "worse" if found == {"worse"} else "tie"


def _verdict(low: float, high: float) -> Verdict:
    return "better" if low > 0 else "worse" if high < 0 else "tie"
