"""What receivers report as Dr.Jit arrays with derivatives, each the twin of a function in NumPy.

| here | in NumPy |
| --- | --- |
| `gaussian_signals` | `wrf_mi.receivers.footprints.gaussian_signals` |
| `with_gains` | `wrf_mi.receivers.physical_array.Array` |
| `LagMatrix` | `wrf_mi.receivers.lags.Lags` |

Coherent sums of paths at elements and subcarriers, steering, spectra and their scaling are in `wrf_mi.graph.combine`.
Complex numbers are pairs (re, im). Float types are those of the arguments.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .lags import Lags

Complex = tuple[Any, Any]


def gaussian_signals(
    amplitude: Complex,
    direction: list[Any],
    axes: list[list[Any]],
    elements: list[Any],
    wavenumber: Any,
    batch: int = 1,
) -> Complex:
    """Element signals of Gaussian footprints in closed form, summed. Differentiable in all but ``batch``.

    Args:
        amplitude: complex signal of each footprint, flat [batch * n].
        direction: unit vectors of their centres, three arrays [batch * n], array's frame.
        axes: three vectors, each three arrays [batch * n], whose outer products add up to the covariance in rad^2: the
            principal axes of a 3D Gaussian, times their deviations, over its distance. Their part along the direction
            does not count.
        elements: positions, three arrays [m], array's frame, metres.
        wavenumber: 2 pi f / c, an array of width 1.
        batch: number of sums.

    Returns:
        Real and imaginary part, flat [batch * m], in a fixed order of summation.
    """
    import drjit as dr

    count, ports = dr.width(amplitude[0]) // batch, dr.width(elements[0])
    lane = dr.arange(dr.uint32_array_t(type(amplitude[0])), batch * ports * count)
    source = (lane // (count * ports)) * count + lane % count
    port = (lane // count) % ports

    def of_source(array: Any) -> Any:
        return dr.gather(type(array), array, source)

    def dot(a: list[Any], b: list[Any]) -> Any:
        return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

    # Of each footprint: trace and determinant (Lagrange's identity) of its covariance across the direction.
    along = [dot(axis, direction) for axis in axes]
    across = [
        [a - n * part for a, n in zip(axis, direction, strict=True)] for axis, part in zip(axes, along, strict=True)
    ]
    trace = sum((dot(t, t) for t in across[1:]), dot(across[0], across[0]))
    # Of two vectors in a plane across n the cross product has the length of the determinant.
    minors = [dr.square(dot(_cross(across[i], across[j]), direction)) for i, j in ((0, 1), (0, 2), (1, 2))]
    determinant = minors[0] + minors[1] + minors[2]

    n = [of_source(c) for c in direction]
    p = [wavenumber * dr.gather(type(c), c, port) for c in elements]
    ahead = dot(n, p)
    q2 = dot(p, p) - dr.square(ahead)
    width = sum(dr.square(dot([of_source(c) for c in t], p)) for t in across)
    trace, determinant = of_source(trace), of_source(determinant)
    # B = I + z C with z = 3 + j ahead; (numerator / det B) / 2 is the exponent's damping.
    det_re = 1 + 3 * trace + (9 - dr.square(ahead)) * determinant
    det_im = ahead * trace + 6 * ahead * determinant
    up_re, up_im = width + 3 * determinant * q2, ahead * determinant * q2
    size = dr.square(det_re) + dr.square(det_im)
    damping = -0.5 * (up_re * det_re + up_im * det_im) / size
    phase = ahead - 0.5 * (up_im * det_re - up_re * det_im) / size - 0.5 * dr.atan2(det_im, det_re)
    height = 2 * np.pi * dr.sqrt(determinant) * dr.rcp(dr.sqrt(dr.sqrt(size))) * dr.exp(damping)
    sine, cosine = dr.sincos(phase)
    re, im = (of_source(part) * height for part in amplitude)
    terms = re * cosine - im * sine, re * sine + im * cosine
    real, imaginary = (dr.block_reduce(dr.ReduceOp.Add, term, count) for term in terms)
    return real, imaginary


def _cross(a: list[Any], b: list[Any]) -> list[Any]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def with_gains(signals: Complex, gain: Complex) -> Complex:
    """Element signals, flat [batch * m], times a complex gain of each element, [m]. Differentiable in both."""
    import drjit as dr

    index = dr.arange(dr.uint32_array_t(type(signals[0])), dr.width(signals[0])) % dr.width(gain[0])
    a, b = (dr.gather(type(part), part, index) for part in gain)
    re, im = signals
    return re * a - im * b, re * b + im * a


class LagMatrix:
    """`Lags` on the device: from element signals to lags to squared spectra.

    Args:
        lags: the map in NumPy.
    """

    def __init__(self, lags: Lags) -> None:
        self.lags = lags
        self._device: dict[Any, tuple[Any, Any, Any]] = {}

    def squared(self, lags: Any) -> Any:
        """Squared spectra, flat [batch * height * width], of lags, flat [batch * count]. Differentiable."""
        basis, _, _ = self._matrices(type(lags))
        return (_rows(lags, self.lags.count) @ basis).array

    def of_signals(self, signals: Complex) -> Any:
        """Lags, flat [batch * count], of element signals, flat [batch * m]. Differentiable."""
        import drjit as dr

        m = self.lags.elements
        _, real, imaginary = self._matrices(type(signals[0]))
        lane = dr.arange(dr.uint32_array_t(type(signals[0])), dr.width(signals[0]) * m)
        first, second = lane // m, lane // (m * m) * m + lane % m
        a_re, a_im = (dr.gather(type(part), part, first) for part in signals)
        b_re, b_im = (dr.gather(type(part), part, second) for part in signals)
        products = _rows(a_re * b_re + a_im * b_im, m * m), _rows(a_im * b_re - a_re * b_im, m * m)
        return (products[0] @ real + products[1] @ imaginary).array

    def _matrices(self, float_type: Any) -> tuple[Any, Any, Any]:
        from ..backend.device import on_device

        if float_type not in self._device:
            parts = (self.lags.basis.T, *self.lags.pairs)
            basis, real, imaginary = (_rows(on_device(part, float_type), part.shape[1]) for part in parts)
            self._device[float_type] = basis, real, imaginary
        return self._device[float_type]


def _rows(flat: Any, columns: int) -> Any:
    import drjit as dr

    tensor_type: Any = dr.tensor_t(type(flat))
    return tensor_type(flat, (dr.width(flat) // columns, columns))
