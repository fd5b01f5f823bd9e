"""The blending recurrence of both rules, front to back, and its derivative: one pixel, one Gaussian.

Alpha blending (WRF-GS+, paper eq. 14) and product blending (WRF-GS, eq. 12 and 13 with footprints) are one sum

    R = sum_i w_i S_i T_i,   T_{i+1} = T_i b_i

with weight w = o G', factor b = 1 - o G' (real) for the first and w = G', b = 1 - G' (1 - delta)
(complex) for the second. With Q_i = sum_{k > i} w_k S_k T_k, the sum behind i, the derivatives are

    dR/dw_i = S_i T_i,   dR/db_i = Q_i / b_i,   dR/dS_i = w_i T_i.

The reverse pass walks front to back again and obtains Q by subtraction from the stored sum, so its memory does not
grow with the number of layers. Transmitters that share one geometry share T and one Q, which is summed over them after
multiplication by the conjugate of each gradient.

Numbers are Dr.Jit values of any float type; a complex one is a pair (re, im), a real one a tuple of one. ``blending``
holds the parameters of a Gaussian beside its footprint, and their number selects the rule: [o], or [re, im] of delta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr

from ..backend.vectors import Complex, conjugate_times, times

SMALLEST_FACTOR = 1e-4
"""|b| below this is replaced in the derivative's quotient Q / b, of which both then vanish.

In float32, Q carries an error of 1e-7 of the pixel's sum, so the quotient is accurate to 1e-3 at this bound.
"""


@dataclass
class ForwardState:
    """State of the forward pass for each pixel of a lane: sums of its transmitters, and the transmittance T."""

    total: list[list[Complex]]
    t: list[Complex]

    @classmethod
    def start(cls, float_type: Any, pixels: int, transmitters: int = 1) -> ForwardState:
        """State before the first Gaussian."""
        zero = [[(float_type(0), float_type(0)) for _ in range(transmitters)] for _ in range(pixels)]
        return cls(zero, [(float_type(1), float_type(0)) for _ in range(pixels)])


@dataclass
class ReverseState:
    """State of the reverse pass for each pixel of a lane: T, and Q times the gradient's conjugate."""

    t: list[Complex]
    q: list[Complex]


def accumulate(total: Complex, weight: Sequence[Any], signal: Complex) -> Complex:
    """The sum R after one more Gaussian of weight w T."""
    re, im = dr.fma(weight[0], signal[0], total[0]), dr.fma(weight[0], signal[1], total[1])
    return (re, im) if len(weight) == 1 else (dr.fma(-weight[1], signal[1], re), dr.fma(weight[1], signal[0], im))


def forward_step(blending: list[Any], g: Any, t: Complex) -> tuple[tuple[Any, ...], Complex]:
    """Weight w T of a Gaussian with footprint G', and the transmittance behind it."""
    if len(blending) == 1:
        # T stays real: its imaginary part is carried along unchanged, so that both rules have one state.
        alpha = blending[0] * g
        return (t[0] * alpha,), (dr.fma(-t[0], alpha, t[0]), t[1])
    return (g * t[0], g * t[1]), times(_factor(blending, g), t)


def _factor(delta: list[Any], g: Any) -> Complex:
    return 1 - g * (1 - delta[0]), g * delta[1]


def reverse_start(
    pixels: list[list[Any]], active: list[Any], total: Complex, gradient: Complex
) -> tuple[list[list[Complex]], ReverseState]:
    """Gradients of each pixel of a lane, and the state before the first Gaussian.

    ``pixels`` are the numbers of each of a lane's pixels in the images of its transmitters, ``active`` is False where a
    pixel only fills the lane (its gradient is then zero), ``total`` is R of all images (re, im), ``gradient`` that of
    the loss by both.
    """
    float_type: Any = type(total[0])
    slopes, state = [], ReverseState([], [])
    for numbers, is_active in zip(pixels, active, strict=True):
        pairs = gradient, total
        g, r = ([tuple(dr.gather(float_type, a, i, is_active) for a in pair) for i in numbers] for pair in pairs)
        slopes.append(g)
        state.q.append(_summed(g, r))
        state.t.append((float_type(1), float_type(0)))
    return slopes, state


def _summed(slopes: list[Any], values: list[Any]) -> Complex:
    """Conjugates of the gradients times values, summed over transmitters."""
    parts = [conjugate_times(g, v) for g, v in zip(slopes, values, strict=True)]
    return sum((re for re, _ in parts[1:]), parts[0][0]), sum((im for _, im in parts[1:]), parts[0][1])


def reverse_step(
    blending: list[Any], g: Any, t: Complex, q: Complex, signals: list[Complex], slopes: list[Complex]
) -> tuple[Any, list[Any], list[Complex], Complex, Complex]:
    """Derivatives of the loss by one Gaussian in one pixel: by G', by ``blending`` and by each S; T and Q behind it.

    ``g`` is the footprint G', ``t`` T before the Gaussian, ``q`` Q before it times the gradient's conjugate (alpha
    blending uses the real part only); ``signals`` and ``slopes`` are S and the gradient of each transmitter.
    """
    weight, after = forward_step(blending, g, t)
    # dL/dS = conj(w T) dL/dR: the gradient of a product of complex numbers by one of them.
    by_signal = [conjugate_times(weight, slope) for slope in slopes]
    h = _summed(slopes, signals)
    if len(blending) == 1:
        # T and w are real: only Re(conj(slope) S) counts. c = dL/dw; dL/db = Q / b, with db = -dw.
        alpha, c_re = blending[0] * g, h[0] * t[0]
        q_re = q[0] - alpha * c_re
        by_alpha = c_re - q_re * dr.rcp(dr.maximum(1 - alpha, SMALLEST_FACTOR))
        return by_alpha * blending[0], [by_alpha * g], by_signal, after, (q_re, q[1])
    # c = conj(slope) S T: Re(c) is dL/dw of the real weight w = G'; Q / b = Q conj(b) / |b|^2 is dL/db.
    c_re, c_im = times(h, t)
    q, b = (q[0] - g * c_re, q[1] - g * c_im), _factor(blending, g)
    scale = dr.rcp(dr.maximum(b[0] * b[0] + b[1] * b[1], SMALLEST_FACTOR**2))
    f_re, f_im = (x * scale for x in conjugate_times(b, q))
    # b = 1 - G' (1 - delta): db/dG' = delta - 1 and db/d(delta) = G', complex, of which L takes the real part.
    by_g = c_re - f_re * (1 - blending[0]) - f_im * blending[1]
    return by_g, [g * f_re, -g * f_im], by_signal, after, q
