"""Signals at a receiver's ports, positions with a frequency each, from traced paths and from directions.

Everything is a Dr.Jit array of one float type with derivatives; complex numbers are pairs (re, im).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..backend.device import columns_on_device, on_device
from ..backend.vectors import Complex, times
from ..core.angles import FloatArray, solid_angles
from ..tracing.paths.traced_field import Float64, TracedPaths


@lru_cache(maxsize=16)
def direction_weights(height: int, width: int, halves: int, float_type: Any) -> Any:
    """`solid_angles` of one or both hemispheres on the device."""
    return on_device(np.tile(solid_angles(height, width), halves), float_type)


class Ports:
    """Positions and frequencies of a receiver's m complex signals, kept on the device.

    Args:
        offset_m: positions in the receiver's frame, [m, 3], metres.
        frequency_hz: frequency of each port, [m].
    """

    def __init__(self, offset_m: FloatArray, frequency_hz: FloatArray) -> None:
        self.count = len(frequency_hz)
        self.offset_m = columns_on_device(np.transpose(np.asarray(offset_m, float)), Float64)
        self.wavenumber = on_device(2 * np.pi / speed_of_light * np.asarray(frequency_hz, float), Float64)

    @property
    def arrays(self) -> list[Any]:
        """Arrays on the device."""
        return [*self.offset_m, self.wavenumber]


def path_sum(paths: TracedPaths, ports: Ports) -> Complex:
    """Coherent sum of a receiver's paths at m ports, spherical waves as in `wrf_mi.receivers.antenna_csi`.

    Args:
        paths: paths of a batch of transmitters.
        ports: ports of the receiver.

    Returns:
        Real and imaginary part, float64 [batch * m]. A fixed order of summation: the same in every run.
    """
    each = paths.each
    # A lane for each path at each port, the paths of a port side by side: one reduction in fixed order then sums them.
    lane = dr.arange(mi.UInt32, paths.batch * ports.count * each)
    port = (lane // each) % ports.count
    slot = (lane // (each * ports.count)) * each + lane % each

    def of_path(array: Any) -> Any:
        return dr.gather(Float64, array, slot)

    def of_port(array: Any) -> Any:
        return dr.gather(Float64, array, port)

    length = of_path(paths.length_m)
    away = [of_path(u) * length - of_port(p) for u, p in zip(paths.arrival, ports.offset_m, strict=True)]
    distance = dr.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
    sine, cosine = dr.sincos(-of_port(ports.wavenumber) * distance)
    # The gain has the loss lambda / (4 pi d) of the origin; at the port the wave has travelled d_m.
    re, im = (of_path(part) * length / distance for part in paths.gain)
    terms = times((re, im), (cosine, sine))
    return tuple(dr.block_reduce(dr.ReduceOp.Add, term, each) for term in terms)


class ComplexMatrix:
    """A complex matrix M [m, n] on the device, for rows of complex numbers as pairs of flat arrays.

    Args:
        values: complex matrix [m, n].

    Attributes:
        values: the matrix.
    """

    def __init__(self, values: ArrayLike) -> None:
        self.values: NDArray[np.complex128] = np.asarray(values, complex)
        self._device: dict[Any, tuple[Any, Any]] = {}

    def arrays(self, float_type: Any) -> tuple[Any, Any]:
        """Real and imaginary parts side by side on the device, of M [m, 2 n] and of its transpose [n, 2 m]."""
        if float_type not in self._device:
            forward, adjoint = (
                matrix(on_device(np.hstack([part.real, part.imag]).ravel(), float_type), 2 * part.shape[1])
                for part in (self.values, self.values.T)
            )
            self._device[float_type] = forward, adjoint
        return self._device[float_type]

    def forward(self, x: Complex) -> Complex:
        """Products x M of rows, flat [batch * m], to flat [batch * n]."""
        re_c, re_s, im_c, im_s = _products(x, self.arrays(type(x[0]))[0])
        return re_c - im_s, re_s + im_c

    def adjoint(self, x: Complex) -> Complex:
        """Products x M^H of rows, flat [batch * n], to flat [batch * m]."""
        re_c, re_s, im_c, im_s = _products(x, self.arrays(type(x[0]))[1])
        return re_c + im_s, im_c - re_s


def _products(x: Complex, parts: Any) -> list[Any]:
    """Real products of both parts of rows x, flat [batch * k], with both parts of a matrix, [k, 2 n]: flat [batch * n].

    One matrix product in place of four, for each of which Dr.Jit would rearrange the matrix.
    """
    rows = matrix(dr.concat(x), parts.shape[0])
    real_products = type(parts)((rows @ parts).array, (2, rows.shape[0] // 2, 2, parts.shape[1] // 2))
    return [real_products[i, :, j].array for i in range(2) for j in range(2)]


def matrix(flat: Any, columns: int) -> Any:
    """A flat array as a tensor with this number of columns."""
    tensor_type: Any = dr.tensor_t(type(flat))
    return tensor_type(flat, (dr.width(flat) // columns, columns))


def weighted(signal: Complex, weight: Any) -> Complex:
    """A signal on directions, flat [batch * n], times weights [n] of the same float type."""
    index = dr.arange(dr.uint32_array_t(type(weight)), dr.width(signal[0])) % dr.width(weight)
    factor = dr.gather(type(weight), weight, index)
    return signal[0] * factor, signal[1] * factor
