"""Parts of a field that a prediction does not evaluate, with bounds on the error.

Every bound is on the received field R of a pixel, and so on its magnitude |R|. The signals of Gaussians from number i
on, behind those before, are bounded as follows: under alpha blending their weights add up to less than one.

    |sum_{k >= i} w_k S_k T_k| <= |T_i| M_i,   M_i = max_{k >= i} |S_k|            (alpha blending)
                                               M_i = sum_{k >= i} |S_k|            (product blending, where |T| falls
                                                                                    but weights may add up to more)

Removal of Gaussian i changes the sum by w_i T_i (S_i - B_i), where the signal B_i seen through it is bounded by M_{i+1}
(product blending: by |1 - delta_i| M_{i+1}, |1 - delta_i| < 2). A Gaussian without a signal still hides others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

THRESHOLDS = 12
"""Number of bounds on a single Gaussian that are tried, each twice the last, to use up a bound on their sum."""


@dataclass(frozen=True)
class Skip:
    """Parts of a field that are not evaluated.

    Attributes:
        contribution: Gaussians are skipped whose removal changes no pixel by more than this in sum; 0: none.
        early_stop_tolerance: the walk of a pixel from near to far ends once the Gaussians behind cannot change it by
            more than this; 0: never. Only without gradients, which it does not bound. Of the Gaussians behind only the
            magnitudes of signals are read; a signal that is not finite has no bound, so no walk ends before it.
    """

    contribution: float = 0.0
    early_stop_tolerance: float = 0.0

    @property
    def error(self) -> float:
        """Largest error of a pixel's field."""
        return self.contribution + self.early_stop_tolerance


NOTHING = Skip()
"""Evaluates everything."""


def signal_bounds(signal: list[Any], visible: Any, order: Any, batch: int, product: bool) -> tuple[Any, Any]:
    """Bound M of the signal of a Gaussian and all behind it, and of all behind it, [batch * n] each.

    Args:
        signal: complex signal (re, im), two arrays [batch * n].
        visible: mask of Gaussians with a footprint, [batch * n].
        order: Gaussians from near to far, [n].
        batch: number of transmitters.
        product: product blending.
    """
    n = dr.width(order)
    strength = dr.select(visible, dr.sqrt(signal[0] * signal[0] + signal[1] * signal[1]), 0)
    # A maximum would pass over NaN, and so hide it; its effect has no bound.
    strength = dr.detach(dr.select(dr.isfinite(strength), strength, dr.inf))
    lane = dr.arange(type(order), batch * n)
    slot = (lane // n) * n + dr.tile(order, batch)
    dr.eval(strength, slot)
    sorted_ = dr.gather(type(strength), strength, slot)
    operation = dr.ReduceOp.Add if product else dr.ReduceOp.Max
    inclusive = dr.block_prefix_reduce(operation, sorted_, n, exclusive=False, reverse=True)
    last = lane % n == n - 1
    beyond = dr.select(last, 0, dr.gather(type(strength), inclusive, lane + 1, ~last))
    out = [dr.zeros(type(strength), batch * n) for _ in range(2)]
    for array, values in zip(out, (inclusive, beyond), strict=True):
        dr.scatter(array, values, slot)
    return out[0], out[1]


def negligible(signal: list[Any], beyond: Any, batch: int, bound: float, blending: list[Any]) -> Any:
    """Mask of Gaussians that may be skipped together, [batch * n].

    Args:
        signal: complex signal (re, im), two arrays [batch * n].
        beyond: bound of the signals behind, from `signal_bounds`.
        batch: number of transmitters.
        bound: tolerated sum of the changes of any pixel, for each transmitter.
        blending: [opacity] or [re, im] of the attenuation, arrays [batch * n].
    """
    strength = dr.sqrt(signal[0] * signal[0] + signal[1] * signal[1])
    if len(blending) == 2:
        hidden = dr.sqrt(dr.square(1 - blending[0]) + dr.square(blending[1]))
        change = strength + hidden * beyond
    else:
        change = blending[0] * (strength + beyond)
    change = dr.detach(change)
    n = dr.width(change) // batch
    chosen = dr.zeros(dr.mask_t(type(change)), batch * n)
    # A bound for each Gaussian alone would be bound / n; most change far more, which leaves room for the others.
    for k in range(THRESHOLDS):
        small = change <= bound / n * 2.0**k
        total = dr.block_sum(dr.select(small, change, 0), n)
        chosen |= small & (dr.repeat(total, n) <= bound)
    return chosen
