"""Receiver models of spectra, channels and signal strengths (`wrf_mi.receivers.registry`)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

from ..backend.vectors import Complex  # chooses the backend before Dr.Jit is imported

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..core import Paths, Receiver
from ..core.angles import FloatArray, pixel_directions
from ..core.types import IntArray
from .array import bartlett_spectrum, steering_matrix
from .channel import antenna_csi, csi, rssi_dbm, with_phase_errors
from .device_paths import (
    AntennaTones,
    ComplexMatrix,
    TracedPaths,
    add,
    direction_weights,
    magnitude,
    path_sum,
    power,
    weighted,
)
from .registry import PIXEL, ComplexArray, How, ObservationSpec, ReceiverModel, Slopes, Sums
from .scaling import LEAST_POWER, SILENCE, arrives, magnitudes, minmax_scale, scaled, scaled_rows, strength_db

CHUNK_SIZE = 64  # transmitters observed together: float64 spectra of all would take several times the result


def _float_type(learned: Complex | None) -> Any:
    return mi.Float if learned is None else type(learned[0])


def _elements(receiver: Receiver, count: int = 0) -> FloatArray:
    return np.zeros((count, 3)) if receiver.array_m is None else np.asarray(receiver.array_m, float)


@dataclass(frozen=True)
class PixelReceiver(ReceiverModel):
    """The papers' receiver: magnitude of the field at each direction of the upper hemisphere.

    Attributes:
        height: elevations of the plane.
        width: azimuths of the plane.
        elements_m: elements of the array that receives traced paths, [m, 3], receiver's frame, metres.
        frequency_hz: carrier.
        how: sum of the traced and the learned component.
    """

    height: int
    width: int
    elements_m: FloatArray = field(repr=False)
    frequency_hz: float
    how: How = "coherent"

    name, tasks = PIXEL, ("spectrum",)
    sphere, components = False, 1

    @classmethod
    def of(cls, form: ObservationSpec, receiver: Receiver) -> PixelReceiver:
        """Model of a receiver whose observations have a form."""
        return cls(*form.size, _elements(receiver), form.carrier_hz)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an observation."""
        return self.height, self.width

    @cached_property
    def _steering(self) -> ComplexMatrix:
        directions = pixel_directions(self.height, self.width).reshape(-1, 3)
        return ComplexMatrix(steering_matrix(self.elements_m, directions, self.frequency_hz))

    @cached_property
    def _tones(self) -> AntennaTones:
        return AntennaTones(self.elements_m, np.full(len(self.elements_m), self.frequency_hz))

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that an observation of a float type reads, inputs of a recording."""
        weights = direction_weights(self.height, self.width, 1, float_type)
        return [*self._tones.arrays, *self._steering.arrays(float_type), weights]

    def elements(self, traced: TracedPaths, float_type: Any) -> Complex:
        """Signals of the array's elements, [batch * m], of the traced paths."""
        re, im = path_sum(traced, self._tones)
        return float_type(re), float_type(im)

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Magnitudes [batch * height * width] of the traced and the learned component; either may be None."""
        image = None if traced is None else self._steering.forward(self.elements(traced, _float_type(learned)))
        return magnitude(image, learned, self.how)

    def missing_gain(self, predicted: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the missing amplitude of an observation, by mean magnitudes."""
        return float(np.log(np.nanmean(observed) / np.mean(predicted)))


@dataclass(frozen=True)
class ArrayReceiver(PixelReceiver):
    """An antenna array that observes the Bartlett spectrum of its element signals.

    Attributes:
        instrument_scale: scale each spectrum to its own minimum and maximum, as measured ones are.
        phase_error: standard deviation of the phase that each interaction but transmission adds, rad; spectra that are
            `observed` are then expectations.
    """

    instrument_scale: bool = False
    phase_error: float = 0.0

    name, needs_array, needs_carrier = "array", True, True

    @classmethod
    def of(cls, form: ObservationSpec, receiver: Receiver) -> ArrayReceiver:
        """Model of a receiver whose observations have a form."""
        return cls(*form.size, _elements(receiver), form.carrier_hz, instrument_scale=True)

    def with_phase_error(self, phase_error: float) -> ArrayReceiver:
        """The receiver whose observed spectra are expectations."""
        return replace(self, phase_error=phase_error)

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Spectra [batch * height * width] of the traced and the learned component; either may be None."""
        signals: list[Complex | None] = [None if traced is None else self.elements(traced, _float_type(learned)), None]
        if learned is not None:
            weights = direction_weights(self.height, self.width, 1, _float_type(learned))
            # The integral over directions gives element signals, so that a learned spectrum has the array's lobes.
            signals[1] = self._steering.adjoint(weighted(learned, weights))
        if self.how == "coherent" and any(signals):
            # The Bartlett sum is linear: one image of the sum in place of one of each component.
            signals = [add(*filter(None, signals)), None]
        images = [None if signal is None else self._steering.forward(signal) for signal in signals]
        spectrum = magnitude(images[0], images[1], self.how)
        return scaled(spectrum, self.height * self.width) if self.instrument_scale else spectrum

    def observed(self, paths: Paths, receiver: Receiver) -> NDArray[np.float32]:
        """Scaled spectra [n_tx, height, width] of the paths to a receiver, 0 where no path arrives."""
        images = np.zeros((paths.n_tx, self.height, self.width), np.float32)
        draws = with_phase_errors(paths, self.phase_error) if self.phase_error else [paths]
        for drawn in draws:
            signals = antenna_csi(drawn, receiver, self.elements_m, self.frequency_hz)[0, ..., 0]
            for start in range(0, len(signals), CHUNK_SIZE):
                rows = slice(start, start + CHUNK_SIZE)
                spectra = bartlett_spectrum(signals[rows], self.elements_m, self.frequency_hz, self.height, self.width)
                images[rows] += minmax_scale(spectra) / len(draws)
        return images

    @property
    def sums(self) -> Sums | None:
        """Fields at the elements; without scaling `signal_observation` is not defined."""
        return "elements" if self.instrument_scale else None

    @cached_property
    def signal_key(self) -> tuple[bytes, float]:
        """Equal for receivers whose `signal_observation` is the same function."""
        return self.elements_m.tobytes(), float(self.frequency_hz)

    def signal_observation(self, signal: ComplexArray) -> FloatArray:
        """Scaled spectra [n, pixels] of element signals [n, m], in single precision as those of the call."""
        return np.asarray(scaled_rows(magnitudes(self._images(signal)))[0], float)

    def signal_slopes(self, parts: Sequence[ComplexArray]) -> Slopes:
        """Derivative of `signal_observation` at parts of element signals [n, m], pixels that set the scale included."""
        image = np.concatenate([np.zeros((0, self.height * self.width), np.complex64), *map(self._images, parts)])
        spectrum = magnitudes(image)
        share, low, high, inverse = scaled_rows(spectrum)
        weight = image.conj() / spectrum  # d|z| = Re(conj(z) dz) / |z|

        def slopes(change: ComplexArray, which: IntArray) -> FloatArray:
            by_pixel = (weight[which] * self._images(change)).real
            least, most = (np.take_along_axis(by_pixel, end[which], axis=1) for end in (low, high))
            # Of (s - min) / (max - min), the quotient rule with share = s_scaled.
            return np.asarray((by_pixel - least - share[which] * (most - least)) * inverse[which], float)

        return slopes

    @cached_property
    def _single_steering(self) -> NDArray[np.complex64]:
        return self._steering.values.astype(np.complex64)

    def _images(self, signal: ComplexArray) -> NDArray[np.complex64]:
        """Bartlett sums [n, pixels] of element signals [n, m] in all directions."""
        return np.asarray(signal.astype(np.complex64) @ self._single_steering)

    @property
    def unscaled(self) -> ArrayReceiver:
        """The receiver without the instrument's scaling."""
        return replace(self, instrument_scale=False)

    def missing_gain(self, predicted: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the missing amplitude of an unscaled observation, whose peaks are to be 1 if scaled."""
        if not self.instrument_scale:
            return super().missing_gain(predicted, observed)
        return float(-np.log(np.asarray(predicted).reshape(len(observed), -1).max(axis=1).mean()))


@dataclass(frozen=True)
class CsiReceiver(ReceiverModel):
    """One or several antennas that observe their complex channel on each subcarrier.

    The learned field covers the full sphere. Without a basis it and the paths' gains are equal at all antennas and on
    all subcarriers; the phase of paths differs between them. With a basis the field has several signals in each
    direction, whose sums over directions are the coefficients of its vectors. Both components add as complex numbers.

    Attributes:
        height: elevations of each hemisphere.
        width: azimuths.
        frequencies_hz: frequencies of the subcarriers, [k].
        elements_m: positions of several antennas [m, 3], receiver's frame, metres; None: one antenna at the origin.
        basis: complex [components, k] or [components, m * k], antennas slowest; None: one component, all ones.
    """

    height: int
    width: int
    frequencies_hz: tuple[float, ...]
    elements_m: FloatArray | None = field(default=None, repr=False)
    basis: NDArray[np.complex128] | None = field(default=None, repr=False)

    name, tasks = "csi", ("csi",)
    levels, complex_valued = True, True

    @classmethod
    def of(cls, form: ObservationSpec, receiver: Receiver) -> CsiReceiver:
        """Model of a receiver whose observations have a form."""
        # Without frequencies no path is evaluated. Narrow channels may state their carrier alone.
        frequencies_hz = 0.0 if form.frequencies_hz is None else form.frequencies_hz
        tones = tuple(map(float, np.broadcast_to(frequencies_hz, form.outputs[-1:])))
        # With features (uplink) each antenna has a condition, so the model has one antenna.
        several = len(form.outputs) > 1 and not form.features
        return cls(*form.size, tones, _elements(receiver, form.outputs[0]) if several else None, form.basis)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an observation: antennas where there are several, subcarriers, real and imaginary part."""
        antennas = () if self.elements_m is None else (len(self.elements_m),)
        return *antennas, len(self.frequencies_hz), 2

    @property
    def components(self) -> int:
        """Complex signals that the learned field has in each direction."""
        return 1 if self.basis is None else len(self.basis)

    @cached_property
    def _tones(self) -> AntennaTones:
        places = np.zeros((1, 3)) if self.elements_m is None else np.asarray(self.elements_m, float)
        count = len(self.frequencies_hz)
        return AntennaTones(np.repeat(places, count, axis=0), np.tile(self.frequencies_hz, len(places)))

    @cached_property
    def _basis(self) -> ComplexMatrix:
        return ComplexMatrix(np.asarray(self.basis))

    def arrays(self, float_type: Any) -> list[Any]:
        """Constants on the device that an observation of a float type reads, inputs of a recording."""
        basis = [] if self.basis is None else self._basis.arrays(float_type)
        return [*self._tones.arrays, direction_weights(self.height, self.width, 2, float_type), *basis]

    def signals(self, traced: TracedPaths | None, learned: Complex | None) -> tuple[Complex | None, Complex | None]:
        """Both components at the antennas, [batch * outputs]; None where a component is None."""
        float_type, count = _float_type(learned), self._tones.count
        signals: list[Complex | None] = [None, None]
        if traced is not None:
            re, im = path_sum(traced, self._tones)
            signals[0] = float_type(re), float_type(im)
        if learned is not None:
            parts = weighted(learned, direction_weights(self.height, self.width, 2, float_type))
            re, im = (dr.block_reduce(dr.ReduceOp.Add, part, 2 * self.height * self.width) for part in parts)
            equal = dr.repeat(re, count), dr.repeat(im, count)
            signals[1] = equal if self.basis is None else self._basis.forward((re, im))
        return signals[0], signals[1]

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Channels [batch * outputs * 2], real and imaginary part in turn; one of both components may be None."""
        signals = [signal for signal in self.signals(traced, learned) if signal is not None]
        if not signals:
            raise ValueError("CsiReceiver: neither a traced nor a learned component")
        re, im = add(*signals)
        pair: Any = mi.Complex2f if type(re) is mi.Float else dr.float64_array_t(mi.Complex2f)
        # Real and imaginary parts in turn, as a record's complex numbers are in memory.
        return dr.ravel(pair(re, im))

    def observed(self, paths: Paths, receiver: Receiver) -> NDArray[Any]:
        """Channel coefficients [n_tx, k] or [n_tx, m, k] of the paths to a receiver, 0 where no path arrives."""
        if self.elements_m is None:
            return np.asarray(csi(paths, self.frequencies_hz)[0])
        return np.asarray(antenna_csi(paths, receiver, self.elements_m, self.frequencies_hz)[0])

    @property
    def sums(self) -> Sums | None:
        """Fields at one antenna; not defined of several."""
        return "fields" if self.elements_m is None else None

    @property
    def signal_key(self) -> object:
        """Equal for receivers whose `signal_observation` is the same function."""
        return CsiReceiver

    def signal_observation(self, signal: ComplexArray) -> FloatArray:
        """Channels [n, 2 values] of signals [n, values], real and imaginary part in turn."""
        return np.ascontiguousarray(signal).view(float)

    def signal_slopes(self, parts: Sequence[ComplexArray]) -> Slopes:
        """Derivative of `signal_observation`, which is linear."""
        return lambda change, which: np.ascontiguousarray(change).view(float)

    def missing_gain(self, predicted: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the missing amplitude of an observation, by root mean squares."""
        # Half the logarithm of a ratio of powers is that of amplitudes.
        powers = [np.nanmean(np.square(np.asarray(values, float))) for values in (observed, predicted)]
        return float(np.log(powers[0] / powers[1]) / 2)


@dataclass(frozen=True)
class PowerReceiver(CsiReceiver):
    """A single antenna that observes its power in dB: RSSI. The learned field covers the full sphere.

    Attributes:
        how: sum of the traced and the learned component.
        interference: traced paths interfere with each other; False: their powers add, as in an average over positions
            within a wavelength or over a wide band. Such a mean has no phase: in a ``coherent`` sum with the learned
            component its root enters as a positive real number.
        floor: power that is observed where neither component arrives.
    """

    how: How = "coherent"
    interference: bool = True
    floor: float = LEAST_POWER

    name, tasks, complex_valued = "power", ("rssi",), False

    @classmethod
    def of(cls, form: ObservationSpec, receiver: Receiver) -> PowerReceiver:
        """Model of a receiver whose observations have a form: powers of paths are added."""
        frequencies_hz = (0.0 if form.frequencies_hz is None else form.carrier_hz,)
        floor = LEAST_POWER if np.isnan(form.floor_db) else 10 ** (form.floor_db / 10)
        return cls(*form.size, frequencies_hz, interference=False, floor=floor)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of an observation."""
        return ()

    def __call__(self, traced: TracedPaths | None, learned: Complex | None) -> Any:
        """Powers [batch] in dB of the traced and the learned component; either may be None."""
        count = self._tones.count
        of_paths, of_gaussians = self.signals(traced if self.interference else None, learned)
        if traced is not None and not self.interference:
            # The root of the sum of powers, equal at all frequencies, as a signal of phase zero.
            mean = dr.repeat(_float_type(learned)(dr.sqrt(traced.power + LEAST_POWER)), count)
            of_paths = mean, dr.zeros(type(mean), dr.width(mean))
        received = dr.block_reduce(dr.ReduceOp.Add, power(of_paths, of_gaussians, self.how), count) / count
        return strength_db(received, self.floor, LEAST_POWER)

    def observed(self, paths: Paths, receiver: Receiver) -> NDArray[Any]:
        """Sums of the powers of paths to a receiver [n_tx], dB, NaN where no path arrives."""
        return np.asarray(rssi_dbm(paths)[0])

    @property
    def sums(self) -> Sums | None:
        """Powers; not defined with interference."""
        return None if self.interference else "powers"

    @property
    def signal_key(self) -> object:
        """Equal for receivers whose `signal_observation` is the same function."""
        return self.floor

    def signal_observation(self, signal: ComplexArray) -> FloatArray:
        """Powers in dB of sums of powers [n, 1] (complex numbers without imaginary part)."""
        # The call adds the constant twice: under the root of the paths' power and under the logarithm.
        return np.asarray(strength_db(signal.real + LEAST_POWER, self.floor, LEAST_POWER), float)

    def signal_slopes(self, parts: Sequence[ComplexArray]) -> Slopes:
        """Derivative of `signal_observation` at parts of sums of powers [n, 1]; 0 where the floor is observed."""
        power = np.concatenate([np.zeros((0, 1)), *(part.real for part in parts)]) + LEAST_POWER
        weight = np.where(power > SILENCE, 10 / np.log(10) / (power + LEAST_POWER), 0)
        return lambda change, which: weight[which] * change.real

    def missing_gain(self, predicted: NDArray[Any], observed: NDArray[Any]) -> float:
        """Logarithm of the missing amplitude of an observation, by mean powers in dB."""
        received = arrives(predicted, self.floor)
        if not received.any():
            return 0.0
        # dB to nepers of an amplitude: ln(10) / 20.
        return float((np.nanmean(observed[received]) - np.mean(predicted[received])) * math.log(10) / 20)
