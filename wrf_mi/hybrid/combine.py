"""How the traced and the learned field become what a receiver reports.

The traced field arrives as paths, the learned one as a complex signal R(u) on directions. Each side is summed
coherently in itself; ``how`` says whether the two, T and L, then add as complex numbers (``coherent``: abs(T + L)) or
as powers (``power``: sqrt(abs(T)^2 + abs(L)^2)).

| receiver | T | L | reports |
| --- | --- | --- | --- |
| pixel | image of h_m, sum_m h_m exp(-j k p_m . u) | R(u) | magnitude at every pixel u |
| array | image of h_m | image of sum_u w(u) R(u) exp(+j k p_m . u) | magnitude at every pixel u |
| power | h at the origin | sum_u w(u) R(u) over the full sphere | power in dB |
| csi | h at the origin, on each subcarrier | the same sum, alike on all subcarriers | T + L |

with h_m = sum over paths of g (d / d_m) exp(-j k d_m), d_m from the path's image source to element m, and w(u) the
solid angle of a pixel. Everything is a Dr.Jit array of one float type, that of the learned side, with derivatives;
complex numbers are pairs (re, im).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light

from ..backend.device import on_device
from ..core.angles import FloatArray, pixel_directions, solid_angles
from .follow import Complex
from .traced import Float64, TracedPaths

How = Literal["coherent", "power"]

DARK = 1e-8
"""Added to a squared magnitude under the root, whose slope at zero is infinite: 1e-4 is the least magnitude."""
LEAST_POWER = 1e-20
"""Added to a power before its logarithm: the report ends at -200 dB."""


def _wavenumber(frequency_hz: Any) -> Any:
    return 2 * np.pi * frequency_hz / speed_of_light


@lru_cache(maxsize=16)
def _weights(height: int, width: int, halves: int, float_type: Any) -> Any:
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
        self.wavenumber = on_device(_wavenumber(np.asarray(frequency_hz, float)), Float64)

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
        phase = _wavenumber(frequency_hz) * np.asarray(offset_m, float) @ np.asarray(directions, float).T
        self._parts: FloatArray = np.stack([np.cos(phase), np.sin(phase)])
        self._device: dict[Any, tuple[Any, Any]] = {}

    def arrays(self, float_type: Any) -> list[Any]:
        """All that it keeps on the device for signals of a float type."""
        return list(self._matrices(float_type))

    def _matrices(self, float_type: Any) -> tuple[Any, Any]:
        if float_type not in self._device:
            c, s = (_matrix(on_device(part, float_type), part.shape[1]) for part in self._parts)
            self._device[float_type] = c, s
        return self._device[float_type]

    def to_ports(self, signal: Complex) -> Complex:
        """sum_u R(u) exp(+j k p_m . u): from directions, flat [batch * n], to ports, flat [batch * m]."""
        c, s = self._matrices(type(signal[0]))
        re, im = (_matrix(part, self._parts.shape[2]) for part in signal)
        c, s = _transposed(c), _transposed(s)
        return (re @ c - im @ s).array, (re @ s + im @ c).array

    def to_directions(self, ports: Complex) -> Complex:
        """sum_m h_m exp(-j k p_m . u): from ports, flat [batch * m], to directions, flat [batch * n] (Bartlett)."""
        c, s = self._matrices(type(ports[0]))
        re, im = (_matrix(part, self._parts.shape[1]) for part in ports)
        return (re @ c + im @ s).array, (im @ c - re @ s).array


def _matrix(flat: Any, columns: int) -> Any:
    tensor_type: Any = dr.tensor_t(type(flat))
    return tensor_type(flat, (dr.width(flat) // columns, columns))


def _transposed(matrix: Any) -> Any:
    return dr.moveaxis(matrix, 0, 1)


def weighted(signal: Complex, weight: Any) -> Complex:
    """A signal on directions, flat [batch * n], times a weight of each, [n] of the same float type."""
    index = dr.arange(dr.uint32_array_t(type(weight)), dr.width(signal[0])) % dr.width(weight)
    factor = dr.gather(type(weight), weight, index)
    return signal[0] * factor, signal[1] * factor


def magnitude(traced: Complex | None, learned: Complex | None, how: How, dark: float = DARK) -> Any:
    """abs(T + L) or sqrt(abs(T)^2 + abs(L)^2), flat arrays; None is a side that is not there."""
    return dr.sqrt(power(traced, learned, how) + dark)


def power(traced: Complex | None, learned: Complex | None, how: How) -> Any:
    """abs(T + L)^2 or abs(T)^2 + abs(L)^2, flat arrays; None is a side that is not there.

    Raises:
        ValueError: neither side, or another ``how``.
    """
    sides = [side for side in (traced, learned) if side is not None]
    if not sides or how not in ("coherent", "power"):
        raise ValueError(f"power: how {how!r} with {len(sides)} sides; give coherent or power, and one side at least")
    if how == "coherent":
        sides = [add(*sides)]
    squares = [re * re + im * im for re, im in sides]
    return sum(squares[1:], squares[0])


def add(*sides: Complex) -> Complex:
    """Sum of complex flat arrays."""
    return sum((re for re, _ in sides[1:]), sides[0][0]), sum((im for _, im in sides[1:]), sides[0][1])


def scaled(image: Any, pixels: int) -> Any:
    """Each image of ``pixels`` values scaled to its own minimum and maximum, 0..1, as the instrument does.

    Differentiable, the two extremes included; an image without contrast becomes 0.
    """
    index = dr.arange(dr.uint32_array_t(type(image)), dr.width(image)) // pixels
    low, high = (dr.block_reduce(op, image, pixels) for op in (dr.ReduceOp.Min, dr.ReduceOp.Max))
    span = high - low
    inverse = dr.select(span > 0, dr.rcp(dr.select(span > 0, span, 1)), 0)
    return (image - dr.gather(type(image), low, index)) * dr.gather(type(image), inverse, index)


@dataclass(frozen=True)
class PixelReceiver:
    """A receiver that reports the field's magnitude at each direction of the upper hemisphere: the paper's.

    Attributes:
        height: elevations of the plane.
        width: azimuths of the plane.
        elements_m: the array through which traced paths are seen, [m, 3], receiver's frame, metres.
        frequency_hz: of the carrier.
        how: how the sides add.
    """

    height: int
    width: int
    elements_m: FloatArray = field(repr=False)
    frequency_hz: float
    how: How = "coherent"

    sphere = False

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one report."""
        return self.height, self.width

    @cached_property
    def _steering(self) -> Steering:
        return Steering(self.elements_m, pixel_directions(self.height, self.width).reshape(-1, 3), self.frequency_hz)

    @cached_property
    def _ports(self) -> Ports:
        return Ports(self.elements_m, np.full(len(self.elements_m), self.frequency_hz))

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that a report of a float type reads: a recording takes them as inputs."""
        weights = _weights(self.height, self.width, 1, float_type)
        return [*self._ports.arrays, *self._steering.arrays(float_type), weights]

    def elements(self, traced: TracedPaths, float_type: Any) -> Complex:
        """Signals of the array's elements, [batch * m], of the traced paths."""
        re, im = path_sum(traced, self._ports)
        return float_type(re), float_type(im)

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Magnitudes [batch * height * width] of the two sides; either may be None."""
        float_type: Any = mi.Float if learned is None else type(learned[0])
        image = None if traced is None else self._steering.to_directions(self.elements(traced, float_type))
        return magnitude(image, learned, self.how)


@dataclass(frozen=True)
class ArrayReceiver(PixelReceiver):
    """An antenna array that reports the Bartlett spectrum of its element signals.

    Attributes:
        instrument_scale: scale each spectrum to its own minimum and maximum, as measured ones are.
    """

    instrument_scale: bool = False

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Spectra [batch * height * width] of the two sides; either may be None."""
        float_type: Any = mi.Float if learned is None else type(learned[0])
        sides = [
            None if traced is None else self.elements(traced, float_type),
            None
            if learned is None
            else self._steering.to_ports(weighted(learned, _weights(self.height, self.width, 1, float_type))),
        ]
        present = [side for side in sides if side is not None]
        if self.how == "coherent" and present:
            sides = [add(*present), None]
        images = [None if side is None else self._steering.to_directions(side) for side in sides]
        spectrum = magnitude(images[0], images[1], self.how)
        return scaled(spectrum, self.height * self.width) if self.instrument_scale else spectrum


@dataclass(frozen=True)
class CsiReceiver:
    """A single antenna that reports its complex channel on each subcarrier.

    The learned field is one on the full sphere. Narrow band: it and the paths' gains are alike on all subcarriers, the
    travelling phase is that of each. Complex numbers are added, so there is no choice of ``how``.

    Attributes:
        height: elevations of each hemisphere.
        width: azimuths.
        frequencies_hz: of the subcarriers, [k].
    """

    height: int
    width: int
    frequencies_hz: tuple[float, ...]

    sphere = True

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one report: subcarriers, real and imaginary part."""
        return len(self.frequencies_hz), 2

    @cached_property
    def _ports(self) -> Ports:
        return Ports(np.zeros((len(self.frequencies_hz), 3)), np.array(self.frequencies_hz))

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that a report of a float type reads: a recording takes them as inputs."""
        return [*self._ports.arrays, _weights(self.height, self.width, 2, float_type)]

    def signals(self, traced: TracedPaths | None, learned: Complex | None) -> tuple[Complex | None, Complex | None]:
        """Both sides at the antenna, [batch * k]; None where a side is None."""
        float_type: Any = mi.Float if learned is None else type(learned[0])
        count, here, there = len(self.frequencies_hz), None, None
        if traced is not None:
            re, im = path_sum(traced, self._ports)
            here = float_type(re), float_type(im)
        if learned is not None:
            parts, pixels = (
                weighted(learned, _weights(self.height, self.width, 2, float_type)),
                self.height * self.width,
            )
            re, im = (dr.repeat(dr.block_reduce(dr.ReduceOp.Add, part, 2 * pixels), count) for part in parts)
            there = re, im
        return here, there

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Channels [batch * k * 2], real and imaginary part in turn, of the two sides; either may be None.

        Raises:
            ValueError: neither side.
        """
        sides = [side for side in self.signals(traced, learned) if side is not None]
        if not sides:
            raise ValueError("CsiReceiver: neither a traced nor a learned side")
        re, im = add(*sides)
        pair: Any = mi.Complex2f if type(re) is mi.Float else dr.float64_array_t(mi.Complex2f)
        return dr.ravel(pair(re, im))


@dataclass(frozen=True)
class PowerReceiver(CsiReceiver):
    """A single antenna that reports its power in dB: RSSI. The learned field is one on the full sphere.

    Attributes:
        frequencies_hz: the mean power over these is reported: of the channels that the instrument hops over.
        how: how the sides add.
        interference: traced paths interfere with each other; False: their powers add, what remains after averaging
            over positions of a wavelength or over a wide band (then ``how`` must be ``power``).
    """

    how: How = "coherent"
    interference: bool = True

    def __post_init__(self) -> None:
        """Refuse to add complex numbers that have no phase.

        Raises:
            ValueError: ``coherent`` without interference.
        """
        if not self.interference and self.how != "power":
            raise ValueError(f"PowerReceiver: how {self.how!r} without interference; add powers")

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one report."""
        return ()

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Powers [batch] in dB of the two sides; either may be None."""
        count = len(self.frequencies_hz)
        if self.interference or traced is None:
            here, there = self.signals(traced, learned)
            received = dr.block_reduce(dr.ReduceOp.Add, power(here, there, self.how), count) / count
        else:
            re, im = traced.gain
            received = dr.block_reduce(dr.ReduceOp.Add, re * re + im * im, traced.each)
            if learned is not None:
                _, there = self.signals(None, learned)
                alone = dr.block_reduce(dr.ReduceOp.Add, power(None, there, self.how), count) / count
                received = type(alone)(received) + alone
            else:
                received = mi.Float(received)
        return 10 * dr.log2(received + LEAST_POWER) / math.log2(10)
