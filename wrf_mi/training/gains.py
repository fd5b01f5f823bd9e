"""Gains by which a choice is made.

An option with more freedom is taken where its gain over the one before exceeds the gain's standard error (`improves`),
since the larger of two scores of few rows is larger by chance half of the time.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TypeVar

import numpy as np
from scipy.special import stdtrit

from ..core.angles import FloatArray

Option = TypeVar("Option")


def improves(score: FloatArray, before: FloatArray, higher_is_better: bool, errors: float = 1.0) -> bool:
    """Whether the mean gain of paired scores [rows] exceeds ``errors`` of its standard errors; NaN where nothing was
    received.
    """
    gain = (score - before) * (1 if higher_is_better else -1)
    gain = gain[np.isfinite(gain)]
    # Paired scores: rows differ among each other by more than options do, which the difference removes.
    return len(gain) > 1 and float(gain.mean()) > errors * float(gain.std(ddof=1)) / np.sqrt(len(gain))


def last_gain(
    scores: Iterable[tuple[Option, FloatArray]],
    higher_is_better: bool,
    doubt: Mapping[Option, float] | None = None,
    confidence: float | None = None,
) -> Option:
    """The last option that improves on the one kept before it (`improves`); the first, if none does.

    Args:
        scores: options in the order of their freedom, each with its scores of the same rows.
        higher_is_better: direction of the scores.
        doubt: standard errors by which a gain has to exceed zero for an option to be left; 1 for options without.
        confidence: one-sided confidence in a gain by Student's t distribution, in place of standard errors: the
            rows, such as receivers, may be a handful.
    """
    (chosen, best), *others = scores
    for option, score in others:
        errors = (doubt or {}).get(chosen, 1.0)
        if confidence is not None:
            pairs = np.count_nonzero(np.isfinite(score - best))
            errors = float(stdtrit(pairs - 1, confidence)) if pairs > 1 else np.inf
        # Against the one chosen so far, not the one before: a series of unclear gains may add up to a clear one.
        if improves(score, best, higher_is_better, errors):
            chosen, best = option, score
    return chosen
