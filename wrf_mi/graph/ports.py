"""Signals at a receiver's ports: places, each with a frequency; from traced paths and from directions.

Everything is a Dr.Jit array of one float type with derivatives; complex numbers are pairs (re, im).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light

from ..backend.device import on_device
from ..core.angles import FloatArray, solid_angles
from ..tracing.field_calculator import Complex
from ..tracing.traced_field import Float64, TracedPaths


def wavenumber(frequency_hz: Any) -> Any:
    """2 pi f / c, rad/m."""
    return 2 * np.pi * frequency_hz / speed_of_light


@lru_cache(maxsize=16)
def direction_weights(height: int, width: int, halves: int, float_type: Any) -> Any:
    """`solid_angles` of one or both hemispheres on the device."""
    return on_device(np.tile(solid_angles(height, width), halves), float_type)


class Ports:
    """Where and at what frequency a receiver takes m complex signals, kept on the device.

    Args:
        offset_m: places in the receiver's frame, [m, 3], metres.
        frequency_hz: of each, [m].
    """

    def __init__(self, offset_m: FloatArray, frequency_hz: FloatArray) -> None:
        self.count = len(frequency_hz)
        self.offset_m = [on_device(c, Float64) for c in np.transpose(np.asarray(offset_m, float))]
        self.wavenumber = on_device(wavenumber(np.asarray(frequency_hz, float)), Float64)

    @property
    def arrays(self) -> list[Any]:
        """All that it keeps on the device."""
        return [*self.offset_m, self.wavenumber]


def path_sum(paths: TracedPaths, ports: Ports) -> Complex:
    """Coherent sum of a receiver's paths at m ports: sum over paths of g (d / d_m) exp(-j k_m d_m).

    Each path is a spherical wave from its image source, at the unfolded length d in the direction of arrival; for flat
    mirrors that is exact, near field included. What it leaves out: a path may be blocked for some elements only, and
    reflects at the angle of the array's origin.

    Args:
        paths: of a batch of transmitters.
        ports: of the receiver.

    Returns:
        Real and imaginary part, float64 [batch * m]. A fixed order of summation: the same in every run.

    Source: image method, Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
    """
    each = paths.each
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
    re, im = (of_path(part) * length / distance for part in paths.gain)
    terms = re * cosine - im * sine, re * sine + im * cosine
    return tuple(dr.block_reduce(dr.ReduceOp.Add, term, each) for term in terms)


class Steering:
    """The complex matrix E = exp(+j k p . u) of m ports and n directions, kept on the device.

    Args:
        offset_m: ports [m, 3] in the receiver's frame, metres.
        directions: unit vectors [n, 3] in that frame.
        frequency_hz: of the carrier.
    """

    def __init__(self, offset_m: FloatArray, directions: FloatArray, frequency_hz: float) -> None:
        phase = wavenumber(frequency_hz) * np.asarray(offset_m, float) @ np.asarray(directions, float).T
        self._parts: FloatArray = np.stack([np.cos(phase), np.sin(phase)])
        self._device: dict[Any, tuple[Any, Any]] = {}

    def arrays(self, float_type: Any) -> list[Any]:
        """All that it keeps on the device for signals of a float type."""
        return list(self._matrices(float_type))

    def _matrices(self, float_type: Any) -> tuple[Any, Any]:
        if float_type not in self._device:
            c, s = (matrix(on_device(part, float_type), part.shape[1]) for part in self._parts)
            self._device[float_type] = c, s
        return self._device[float_type]

    def to_ports(self, signal: Complex) -> Complex:
        """sum_u R(u) exp(+j k p_m . u): from directions, flat [batch * n], to ports, flat [batch * m]."""
        c, s = self._matrices(type(signal[0]))
        re, im = (matrix(part, self._parts.shape[2]) for part in signal)
        c, s = _transposed(c), _transposed(s)
        return (re @ c - im @ s).array, (re @ s + im @ c).array

    def to_directions(self, ports: Complex) -> Complex:
        """sum_m h_m exp(-j k p_m . u): from ports, flat [batch * m], to directions, flat [batch * n] (Bartlett)."""
        c, s = self._matrices(type(ports[0]))
        re, im = (matrix(part, self._parts.shape[1]) for part in ports)
        return (re @ c + im @ s).array, (im @ c - re @ s).array


def matrix(flat: Any, columns: int) -> Any:
    """A flat array as a tensor of so many columns."""
    tensor_type: Any = dr.tensor_t(type(flat))
    return tensor_type(flat, (dr.width(flat) // columns, columns))


def _transposed(matrix: Any) -> Any:
    return dr.moveaxis(matrix, 0, 1)


def weighted(signal: Complex, weight: Any) -> Complex:
    """A signal on directions, flat [batch * n], times a weight of each, [n] of the same float type."""
    index = dr.arange(dr.uint32_array_t(type(weight)), dr.width(signal[0])) % dr.width(weight)
    factor = dr.gather(type(weight), weight, index)
    return signal[0] * factor, signal[1] * factor
