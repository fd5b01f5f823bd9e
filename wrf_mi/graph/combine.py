"""How the traced and the learned field become what a receiver reports.

The traced field arrives as paths, the learned one as a complex signal R(u) on directions. Each side is summed
coherently in itself; ``how`` says whether the two, T and L, then add as complex numbers (``coherent``: abs(T + L)) or
as powers (``power``: sqrt(abs(T)^2 + abs(L)^2)).

| receiver | T | L | reports |
| --- | --- | --- | --- |
| pixel | image of h_m, sum_m h_m exp(-j k p_m . u) | R(u) | magnitude at every pixel u |
| array | image of h_m | image of sum_u w(u) R(u) exp(+j k p_m . u) | magnitude at every pixel u |
| power | h at the origin | sum_u w(u) R(u) over the full sphere | power in dB |
| csi | h at each antenna, on each subcarrier | the same sum, or several: coefficients of a basis | T + L |

with h_m = sum over paths of g (d / d_m) exp(-j k d_m), d_m from the path's image source to element m, and w(u) the
solid angle of a pixel. Everything is a Dr.Jit array of one float type, that of the learned side, with derivatives;
complex numbers are pairs (re, im).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import on_device
from ..core.angles import FloatArray, pixel_directions
from ..core.types import SQUARED_MAGNITUDE_EPS
from ..tracing.field_calculator import Complex
from ..tracing.traced_field import TracedPaths
from .ports import Ports, Steering, direction_weights, matrix, path_sum, weighted

How = Literal["coherent", "power"]

LEAST_POWER = 1e-20
"""Added to a power before its logarithm: the report ends at -200 dB."""


def magnitude(traced: Complex | None, learned: Complex | None, how: How, dark: float = SQUARED_MAGNITUDE_EPS) -> Any:
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

    sphere, components = False, 1

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
        weights = direction_weights(self.height, self.width, 1, float_type)
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

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude by which a report is too weak: of mean magnitudes."""
        return float(np.log(np.nanmean(observed) / np.mean(report)))


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
            else self._steering.to_ports(weighted(learned, direction_weights(self.height, self.width, 1, float_type))),
        ]
        present = [side for side in sides if side is not None]
        if self.how == "coherent" and present:
            sides = [add(*present), None]
        images = [None if side is None else self._steering.to_directions(side) for side in sides]
        spectrum = magnitude(images[0], images[1], self.how)
        return scaled(spectrum, self.height * self.width) if self.instrument_scale else spectrum

    @property
    def unscaled(self) -> ArrayReceiver:
        """The same without the instrument's scaling."""
        return replace(self, instrument_scale=False)

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude by which an unscaled report is too weak: its peaks are to be 1 if scaled."""
        if not self.instrument_scale:
            return super().missing_gain(report, observed)
        return float(-np.log(np.asarray(report).reshape(len(observed), -1).max(axis=1).mean()))


@dataclass(frozen=True)
class CsiReceiver:
    """One or several antennas that report their complex channel on each subcarrier.

    The learned field is one on the full sphere. Without a basis it and the paths' gains are alike at all antennas and
    on all subcarriers, the travelling phase of paths is that of each. With a basis the field has several signals in
    each direction, whose sums over directions are the coefficients of its vectors. Complex numbers are added, so there
    is no choice of ``how``.

    Attributes:
        height: elevations of each hemisphere.
        width: azimuths.
        frequencies_hz: of the subcarriers, [k].
        elements_m: places of several antennas [m, 3], receiver's frame, metres; None: one antenna in its origin.
        basis: complex [components, k] or [components, m * k], antennas slowest; None: one component, all ones.
    """

    height: int
    width: int
    frequencies_hz: tuple[float, ...]
    elements_m: FloatArray | None = field(default=None, repr=False)
    basis: NDArray[np.complex128] | None = field(default=None, repr=False)

    sphere = True

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one report: antennas where there are several, subcarriers, real and imaginary part."""
        antennas = () if self.elements_m is None else (len(self.elements_m),)
        return *antennas, len(self.frequencies_hz), 2

    @property
    def components(self) -> int:
        """Complex signals that the learned field has in each direction."""
        return 1 if self.basis is None else len(self.basis)

    @cached_property
    def _ports(self) -> Ports:
        places = np.zeros((1, 3)) if self.elements_m is None else np.asarray(self.elements_m, float)
        count = len(self.frequencies_hz)
        return Ports(np.repeat(places, count, axis=0), np.tile(self.frequencies_hz, len(places)))

    @cached_property
    def _vectors(self) -> dict[Any, tuple[Any, Any]]:
        return {}

    def _basis(self, float_type: Any) -> tuple[Any, Any]:
        """Real and imaginary part of the basis on the device, [components, outputs]."""
        if float_type not in self._vectors:
            basis = np.asarray(self.basis)
            re, im = (matrix(on_device(part, float_type), basis.shape[1]) for part in (basis.real, basis.imag))
            self._vectors[float_type] = re, im
        return self._vectors[float_type]

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that a report of a float type reads: a recording takes them as inputs."""
        basis = [] if self.basis is None else list(self._basis(float_type))
        return [*self._ports.arrays, direction_weights(self.height, self.width, 2, float_type), *basis]

    def signals(self, traced: TracedPaths | None, learned: Complex | None) -> tuple[Complex | None, Complex | None]:
        """Both sides at the antennas, [batch * outputs]; None where a side is None."""
        float_type: Any = mi.Float if learned is None else type(learned[0])
        here, there = None, None
        if traced is not None:
            re, im = path_sum(traced, self._ports)
            here = float_type(re), float_type(im)
        if learned is not None:
            parts = weighted(learned, direction_weights(self.height, self.width, 2, float_type))
            re, im = (dr.block_reduce(dr.ReduceOp.Add, part, 2 * self.height * self.width) for part in parts)
            there = self._outputs(re, im)
        return here, there

    def _outputs(self, re: Any, im: Any) -> Complex:
        """Learned signals at all outputs, from coefficients, flat [batch * components]."""
        if self.basis is None:
            return dr.repeat(re, self._ports.count), dr.repeat(im, self._ports.count)
        b_re, b_im = self._basis(type(re))
        re, im = (matrix(part, self.components) for part in (re, im))
        return (re @ b_re - im @ b_im).array, (re @ b_im + im @ b_re).array

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Channels [batch * outputs * 2], real and imaginary part in turn, of the two sides; either may be None.

        Raises:
            ValueError: neither side.
        """
        sides = [side for side in self.signals(traced, learned) if side is not None]
        if not sides:
            raise ValueError("CsiReceiver: neither a traced nor a learned side")
        re, im = add(*sides)
        pair: Any = mi.Complex2f if type(re) is mi.Float else dr.float64_array_t(mi.Complex2f)
        return dr.ravel(pair(re, im))

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude by which a report is too weak: of root mean squares."""
        return float(np.log(_mean_square(observed) / _mean_square(report)) / 2)


def _mean_square(values: NDArray[Any]) -> float:
    return float(np.nanmean(np.square(np.asarray(values, float))))


@dataclass(frozen=True)
class PowerReceiver(CsiReceiver):
    """A single antenna that reports its power in dB: RSSI. The learned field is one on the full sphere.

    Attributes:
        how: how the sides add.
        interference: traced paths interfere with each other; False: their powers add, what remains after averaging
            over positions of a wavelength or over a wide band. Such a mean has no phase; added to the learned side as
            a complex number (``coherent``) it is its root, a positive real, which that side raises or lowers.
    """

    how: How = "coherent"
    interference: bool = True

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one report."""
        return ()

    def _mean_field(self, traced: TracedPaths, float_type: Any) -> Complex:
        """Root of the sum of paths' powers, alike at all frequencies, as a complex signal of phase zero."""
        re, im = traced.gain
        amplitude = float_type(dr.sqrt(dr.block_reduce(dr.ReduceOp.Add, re * re + im * im, traced.each) + LEAST_POWER))
        wide = dr.repeat(amplitude, self._ports.count)
        return wide, dr.zeros(float_type, dr.width(wide))

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Powers [batch] in dB of the two sides; either may be None."""
        count = self._ports.count
        here, there = self.signals(traced if self.interference else None, learned)
        if traced is not None and not self.interference:
            here = self._mean_field(traced, mi.Float if learned is None else type(learned[0]))
        received = dr.block_reduce(dr.ReduceOp.Add, power(here, there, self.how), count) / count
        return 10 * dr.log2(received + LEAST_POWER) / math.log2(10)

    def missing_gain(self, report: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the amplitude by which a report is too weak: of mean powers in dB."""
        return float((np.nanmean(observed) - np.mean(report)) * math.log(10) / 20)
