"""Paths on the device: values that receivers read, coherent sums at antennas and of both components, draws of phases.

An *antenna tone* is a position in the receiver's frame with a frequency. Arrays are Dr.Jit arrays with derivatives,
complex numbers pairs (re, im).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light

from ..backend.device import columns_on_device, on_device
from ..backend.vectors import Complex, Float64, Vector, times
from ..core.angles import FloatArray, solid_angles
from .channel import DRAWS, phase_draws
from .registry import How
from .scaling import SQUARED_MAGNITUDE_EPS


@dataclass
class TracedPaths:
    """Paths to a receiver as differentiable arrays: ``each`` for every transmitter of the batch.

    Arrays are float64, with the transmitter as the slowest index; place holders of gain zero fill missing paths.
    """

    # complex gain of free-space loss, interactions, antennas and instrument, without exp(-j k length); two float
    # arrays [batch * each]
    gain: Complex
    length_m: Any  # unfolded length, metres; float [batch * each]
    arrival: Vector  # unit vectors towards the incoming wave, receiver's frame; three float arrays [batch * each]
    batch: int  # number of transmitters
    each: int  # number of paths of each transmitter, place holders included

    @property
    def power(self) -> Any:
        """Sum of the powers of each transmitter's paths [batch]."""
        re, im = self.gain
        return dr.block_reduce(dr.ReduceOp.Add, re * re + im * im, self.each)


class AntennaTones:
    """Positions [m, 3] in the receiver's frame, metres, and frequencies [m] of a receiver's signals, on the device."""

    def __init__(self, offset_m: FloatArray, frequency_hz: ArrayLike) -> None:
        frequencies = np.asarray(frequency_hz, float)
        self.count = len(frequencies)
        self.offset_m = columns_on_device(np.transpose(np.asarray(offset_m, float)), Float64)
        self.wavenumber = on_device(2 * np.pi / speed_of_light * frequencies, Float64)

    @property
    def arrays(self) -> list[Any]:
        """Arrays on the device."""
        return [*self.offset_m, self.wavenumber]


def path_sum(paths: TracedPaths, tones: AntennaTones) -> Complex:
    """Coherent sums of a batch's paths at m antenna tones, float64 [batch * m]: spherical waves as in `antenna_csi`."""
    each = paths.each
    # A lane for each path at each tone, the paths of a tone side by side: one reduction in fixed order then sums them,
    # the same in every run.
    lane = dr.arange(mi.UInt32, paths.batch * tones.count * each)
    tone = (lane // each) % tones.count
    slot = (lane // (each * tones.count)) * each + lane % each

    def of_path(array: Any) -> Any:
        return dr.gather(Float64, array, slot)

    def of_tone(array: Any) -> Any:
        return dr.gather(Float64, array, tone)

    length = of_path(paths.length_m)
    away = [of_path(u) * length - of_tone(p) for u, p in zip(paths.arrival, tones.offset_m, strict=True)]
    distance = dr.sqrt(away[0] * away[0] + away[1] * away[1] + away[2] * away[2])
    sine, cosine = dr.sincos(-of_tone(tones.wavenumber) * distance)
    # The gain has the loss lambda / (4 pi d) of the origin; at the antenna the wave has travelled d_m.
    re, im = (of_path(part) * length / distance for part in paths.gain)
    re, im = times((re, im), (cosine, sine))
    return dr.block_reduce(dr.ReduceOp.Add, re, each), dr.block_reduce(dr.ReduceOp.Add, im, each)


@lru_cache(maxsize=64)
def draws_on_device(each: int) -> Any:
    """`wrf_mi.receivers.channel.phase_draws` of ``each`` paths, flat."""
    return on_device(phase_draws(each).ravel(), Float64)


def expected_observation(
    observe: Callable[[TracedPaths, Complex | None], Any], paths: TracedPaths, learned: Complex | None, deviation: Any
) -> Any:
    """Mean of a receiver's observations over `DRAWS` draws of its paths' phases (`wrf_mi.receivers.channel`).

    ``learned`` is the learned signal of the transmitters of ``paths``, flat, or None; ``deviation`` the standard
    deviation of each path's phase [batch * each], rad.
    """
    batch, each, drawn = paths.batch, paths.each, paths.batch * DRAWS
    # The copies of a transmitter's paths lie one after the other, so that they count as transmitters.
    lane = dr.arange(mi.UInt32, drawn * each)
    path, copy = lane % each, lane // each
    source = copy // DRAWS * each + path
    draw = dr.gather(Float64, draws_on_device(each), path * DRAWS + copy % DRAWS)
    sine, cosine = dr.sincos(dr.gather(Float64, deviation, source) * draw)
    parts = *paths.gain, paths.length_m, *paths.arrival
    re, im, length_m, *arrival = (dr.gather(Float64, part, source) for part in parts)
    if learned is not None:  # the same beside all draws
        size = dr.width(learned[0]) // batch
        lane = dr.arange(mi.UInt32, drawn * size)
        of_learned = lane // (DRAWS * size) * size + lane % size
        re_l, im_l = (dr.gather(type(part), part, of_learned) for part in learned)
        learned = re_l, im_l
    observations = observe(TracedPaths(times((re, im), (cosine, sine)), length_m, arrival, drawn, each), learned)
    # Observations lie draw by draw: gathered value by value, so that one reduction in fixed order sums the draws.
    size = dr.width(observations) // drawn
    lane = dr.arange(mi.UInt32, dr.width(observations))
    value, number = lane // DRAWS, lane % DRAWS
    entry = (value // size * DRAWS + number) * size + value % size
    return dr.block_reduce(dr.ReduceOp.Add, dr.gather(type(observations), observations, entry), DRAWS) / DRAWS


def spread(values: Any, count: int) -> Any:
    """Each value ``count`` times, one after the other."""
    return dr.gather(type(values), values, dr.arange(mi.UInt32, dr.width(values) * count) // count)


class ComplexMatrix:
    """A complex matrix M [m, n] on the device, ``values``, for rows of complex numbers as pairs of flat arrays."""

    def __init__(self, values: ArrayLike) -> None:
        self.values: NDArray[np.complex128] = np.asarray(values, complex)
        self._device: dict[Any, tuple[Any, Any]] = {}

    def arrays(self, float_type: Any) -> tuple[Any, Any]:
        """Real and imaginary parts side by side on the device, of M [m, 2 n] and of its transpose [n, 2 m]."""
        if float_type not in self._device:
            forward, adjoint = (
                _tensor(on_device(np.hstack([part.real, part.imag]).ravel(), float_type), 2 * part.shape[1])
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
    """Real products [batch * n] of both parts of rows x, flat [batch * k], with both parts of a matrix [k, 2 n]."""
    # One matrix product in place of four, for each of which Dr.Jit would rearrange the matrix.
    rows = _tensor(dr.concat(x), parts.shape[0])
    real_products = type(parts)((rows @ parts).array, (2, rows.shape[0] // 2, 2, parts.shape[1] // 2))
    return [real_products[i, :, j].array for i in range(2) for j in range(2)]


def _tensor(flat: Any, columns: int) -> Any:
    tensor_type: Any = dr.tensor_t(type(flat))
    return tensor_type(flat, (dr.width(flat) // columns, columns))


@lru_cache(maxsize=16)
def direction_weights(height: int, width: int, halves: int, float_type: Any) -> Any:
    """`solid_angles` of one or both hemispheres on the device."""
    return on_device(np.tile(solid_angles(height, width), halves), float_type)


def weighted(signal: Complex, weight: Any) -> Complex:
    """A signal on directions, flat [batch * n], times weights [n] of the same float type."""
    index = dr.arange(dr.uint32_array_t(type(weight)), dr.width(signal[0])) % dr.width(weight)
    factor = dr.gather(type(weight), weight, index)
    return signal[0] * factor, signal[1] * factor


def magnitude(traced: Complex | None, learned: Complex | None, how: How) -> Any:
    """abs(T + L) or sqrt(abs(T)^2 + abs(L)^2), flat arrays; None is an absent component."""
    return dr.sqrt(power(traced, learned, how) + SQUARED_MAGNITUDE_EPS)


def power(traced: Complex | None, learned: Complex | None, how: How) -> Any:
    """abs(T + L)^2 or abs(T)^2 + abs(L)^2, flat arrays; `ValueError` without components or for another ``how``."""
    components = [signal for signal in (traced, learned) if signal is not None]
    if not components or how not in ("coherent", "power"):
        raise ValueError(
            f"power: how {how!r} with {len(components)} components; give coherent or power, and one component at least"
        )
    if how == "coherent":
        components = [add(*components)]
    squares = [re * re + im * im for re, im in components]
    return sum(squares[1:], squares[0])


def add(*signals: Complex) -> Complex:
    """Sum of complex flat arrays."""
    return sum((re for re, _ in signals[1:]), signals[0][0]), sum((im for _, im in signals[1:]), signals[0][1])
