"""What a prediction leaves out, and how wrong that can make it.

Every bound is on the received field R of a pixel, and holds for its grey |R| too, whose difference is never larger.
Two facts carry them all. What Gaussians from number i on send through what stands before them is, under alpha
blending, T_i times a sum of signals with weights that add up to less than one:

    |sum_{k >= i} w_k S_k T_k| <= |T_i| M_i,   M_i = max_{k >= i} |S_k|            (alpha blending)
                                               M_i = sum_{k >= i} |S_k|            (product blending, where |T| falls
                                                                                    but weights may add up to more)

and taking Gaussian i away from the sum changes it by w_i T_i (S_i - B_i), where B_i, what is seen through it, is bound
by M_{i+1} (product blending: by |1 - delta_i| M_{i+1}, |1 - delta_i| < 2). A dark Gaussian is no idle one: it hides.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

THRESHOLDS = 12
"""How many bounds on a single Gaussian are tried, each twice the last, to use up a bound on their sum."""


@dataclass(frozen=True)
class Skip:
    """Which parts of a field are not evaluated.

    Attributes:
        boxes: leave out footprints that reach no pixel of a tile, those below the horizon among them. Changes nothing.
        contribution: leave out Gaussians whose removal changes no pixel by more than this in sum; 0: none.
        early_stop_tolerance: stop a pixel's walk from near to far once what is behind cannot change it by more than
            this; 0: never. Only without gradients: those of what is behind are not bounded by it. What is behind is
            then not evaluated, but for the magnitudes of its signals, which bound it; a signal that is not finite has
            no bound, so no walk ends before it.
    """

    boxes: bool = True
    contribution: float = 0.0
    early_stop_tolerance: float = 0.0

    @property
    def error(self) -> float:
        """Largest error of a pixel's field."""
        return self.contribution + self.early_stop_tolerance


NOTHING = Skip()
"""Leaves out what changes nothing, and nothing else."""


def behind(signal: list[Any], visible: Any, order: Any, batch: int, product: bool) -> tuple[Any, Any]:
    """The bound M of what a Gaussian and all behind it send, and of what all behind it send, [batch * n] each.

    Args:
        signal: complex signal (re, im), two arrays [batch * n].
        visible: which have a footprint, [batch * n].
        order: Gaussians from near to far, [n].
        batch: number of transmitters.
        product: product blending.
    """
    n = dr.width(order)
    strength = dr.select(visible, dr.sqrt(signal[0] * signal[0] + signal[1] * signal[1]), 0)
    # A maximum would pass over NaN, and so hide it; what it can change has no bound.
    strength = dr.detach(dr.select(dr.isfinite(strength), strength, dr.inf))
    lane = dr.arange(type(order), batch * n)
    place = (lane // n) * n + dr.tile(order, batch)
    dr.eval(strength, place)
    sorted_ = dr.gather(type(strength), strength, place)
    operation = dr.ReduceOp.Add if product else dr.ReduceOp.Max
    with_own = dr.block_prefix_reduce(operation, sorted_, n, exclusive=False, reverse=True)
    out = [dr.zeros(type(strength), batch * n) for _ in range(2)]
    last = lane % n == n - 1
    beyond = dr.select(last, 0, dr.gather(type(strength), with_own, lane + 1, ~last))
    for array, values in zip(out, (with_own, beyond), strict=True):
        dr.scatter(array, values, place)
    return out[0], out[1]


def negligible(
    signal: list[Any],
    beyond: Any,
    batch: int,
    bound: float,
    opacity: Any | None = None,
    attenuation: list[Any] | None = None,
) -> Any:
    """Gaussians that may be left out together, [batch * n].

    Args:
        signal: complex signal (re, im), two arrays [batch * n].
        beyond: bound of what all behind send, from `behind`.
        batch: number of transmitters.
        bound: on the sum of what their removal changes in any pixel, for each transmitter.
        opacity: array [batch * n]; alpha blending.
        attenuation: complex factor delta (re, im); product blending.
    """
    strength = dr.sqrt(signal[0] * signal[0] + signal[1] * signal[1])
    if attenuation is not None:
        hidden = dr.sqrt(dr.square(1 - attenuation[0]) + dr.square(attenuation[1]))
        change = strength + hidden * beyond
    else:
        assert opacity is not None
        change = opacity * (strength + beyond)
    change = dr.detach(change)
    n = dr.width(change) // batch
    chosen = dr.zeros(dr.mask_t(type(change)), batch * n)
    # One bound for each alone would be bound / n; most change far more, which leaves room for the others.
    for k in range(THRESHOLDS):
        small = change <= bound / n * 2.0**k
        total = dr.block_sum(dr.select(small, change, 0), n)
        chosen |= small & (dr.repeat(total, n) <= bound)
    return chosen
