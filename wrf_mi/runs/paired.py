"""Is one method better than another on the same test rows? A paired bootstrap over the rows decides.

"Better" is a claim about a difference, and the rows are its sample: both methods are scored on the same rows, rows are
drawn anew with replacement, and the 95 % interval of the difference must lie above zero. Over several seeds it must do
so in each (`agreed`). Everything else is called a tie.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError
from ..core.angles import FloatArray
from ..tasks import TASKS

Verdict = Literal["better", "worse", "tie"]

RESAMPLES = 4000
"""Draws of all test rows: each end of a 95 % interval then has 100 of them beyond it."""
INTERVAL = (2.5, 97.5)
"""Percentiles that bound 95 %."""
VALUES_PER_CHUNK = 1 << 23
"""Weights of resampled values at once: 32 MiB."""


@dataclass(frozen=True)
class Paired:
    """How much better method a is than method b; positive is better whatever the score, in the score's unit.

    Attributes:
        median: median score of a and median score of b, their difference.
        median_low: lower end of its 95 % interval.
        median_high: upper end.
        mean: the same difference of means.
        mean_low: lower end of its 95 % interval.
        mean_high: upper end.
        verdict: of a, by the interval of the medians: ``better``, ``worse`` or ``tie``.
        mean_verdict: of a, by the interval of the means.
        rows: test rows that were compared.
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
        """As numbers and words, for ``metrics.json``."""
        return asdict(self)


def paired_difference(
    scores_a: ArrayLike, scores_b: ArrayLike, seed: int, task: str, resamples: int = RESAMPLES
) -> Paired:
    """Compare two methods by their scores on the same test rows.

    Rows are drawn, not single scores: all receivers of a row come or stay out together. Rows along a path are not
    independent of each other; where they are alike the true interval is wider than this one.

    Args:
        scores_a: of one method, [..., rows], as `wrf_mi.tasks.scores` computes them; NaN where nothing was received.
        scores_b: of the other on the same rows, the same shape. What is NaN in either is left out of both.
        seed: of the draws.
        task: of the record; whether more is better stands in `wrf_mi.tasks.TASKS`.
        resamples: number of draws.

    Raises:
        InputError: shapes that differ, no row with two scores, an unknown task, or fewer than 100 draws.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), section 13.3 (percentile interval).
    """
    if task not in TASKS:
        raise InputError(f"task {task!r}: unknown; choose {', '.join(TASKS)}")
    if resamples < 100:
        raise InputError(f"{resamples} resamples: too few for a 95 % interval; choose 100 or more")
    a, b = (np.atleast_1d(np.asarray(scores, float)) for scores in (scores_a, scores_b))
    if a.shape != b.shape:
        raise InputError(f"scores {a.shape} and {b.shape} differ in shape; score both methods on the same rows")
    known = ~np.isnan(a) & ~np.isnan(b)
    rows = int(known.reshape(-1, a.shape[-1]).any(axis=0).sum())
    if not rows:
        raise InputError("no test row has a score of both methods; score them on the same rows")
    row = np.broadcast_to(np.arange(a.shape[-1]), a.shape)[known]
    row = np.unique(row, return_inverse=True)[1]
    sign = 1.0 if TASKS[task].higher_is_better else -1.0
    values = sign * a[known], sign * b[known]
    median, mean = _bootstrap(values, row, rows, seed, resamples)
    (median_low, median_high), (mean_low, mean_high) = np.percentile(median, INTERVAL), np.percentile(mean, INTERVAL)
    return Paired(
        median=float(np.median(values[0]) - np.median(values[1])),
        median_low=float(median_low),
        median_high=float(median_high),
        mean=float(values[0].mean() - values[1].mean()),
        mean_low=float(mean_low),
        mean_high=float(mean_high),
        verdict=_verdict(median_low, median_high),
        mean_verdict=_verdict(mean_low, mean_high),
        rows=rows,
    )


def agreed(verdicts: Iterable[str]) -> Verdict:
    """The verdict over several seeds: ``better`` or ``worse`` if each of them says so, else ``tie``.

    Raises:
        InputError: no verdict.
    """
    said = set(verdicts)
    if not said:
        raise InputError("no verdicts to agree on: compare at least one seed")
    return "better" if said == {"better"} else "worse" if said == {"worse"} else "tie"


def _verdict(low: float, high: float) -> Verdict:
    return "better" if low > 0 else "worse" if high < 0 else "tie"


def _bootstrap(
    values: tuple[FloatArray, FloatArray], row: NDArray[np.intp], rows: int, seed: int, resamples: int
) -> tuple[FloatArray, FloatArray]:
    """Differences of medians and of means in each draw.

    A draw is how often each row comes, so a resampled median is a weighted one: values are sorted once for all draws.
    """
    rng = np.random.default_rng(seed)
    order = [np.argsort(v, kind="stable") for v in values]
    median, mean = np.empty(resamples), np.empty(resamples)
    step = max(1, VALUES_PER_CHUNK // len(row))
    for start in range(0, resamples, step):
        part = slice(start, min(start + step, resamples))
        weight = rng.multinomial(rows, np.full(rows, 1 / rows), size=part.stop - part.start).astype(np.int32)
        medians = [_weighted_median(v[o], weight[:, row[o]]) for v, o in zip(values, order, strict=True)]
        median[part] = medians[0] - medians[1]
        of_value = weight[:, row]
        mean[part] = of_value @ (values[0] - values[1]) / of_value.sum(axis=1)
    return median, mean


def _weighted_median(values: FloatArray, weight: NDArray[np.int32]) -> FloatArray:
    """Median of sorted values [n] that come ``weight`` [draws, n] times: mean of the two middle ones if even."""
    below = np.cumsum(weight, axis=1, dtype=np.int32)
    total = below[:, -1:]
    low, high = ((below > middle).argmax(axis=1) for middle in ((total - 1) // 2, total // 2))
    return (values[low] + values[high]) / 2
