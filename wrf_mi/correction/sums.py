"""What instruments report of sums over paths, and the derivatives of the reports.

Each kind takes totals [rows, values], sums of waves or of powers, and factors [rows, 1] of the receivers' gains.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray, pixel_directions
from ..core.types import SQUARED_MAGNITUDE_EPS
from ..graph.combine import LEAST_POWER, SILENCE, ArrayReceiver, PowerReceiver
from ..graph.ports import steering

if TYPE_CHECKING:
    from .misfit import Misfit

Complex = NDArray[np.complex128]


class Reports(Protocol):
    """Reports of totals."""

    def report(self, total: Complex, factor: Complex) -> FloatArray:
        """Reports [rows, values] as those of `Misfit`, before the unit of each row."""
        ...

    def slope(self, total: Complex, change: Complex, factor: Complex) -> FloatArray:
        """Derivative of `report` by that of the totals, [rows, values]."""
        ...


class Channels:
    """Channels of a single antenna, real and imaginary part in turn."""

    def report(self, total: Complex, factor: Complex) -> FloatArray:
        """Reports as of `Reports`."""
        return np.ascontiguousarray(total * factor).view(float)

    def slope(self, total: Complex, change: Complex, factor: Complex) -> FloatArray:
        """Derivative as of `Reports`."""
        return self.report(change, factor)


class Strengths:
    """Powers in dB, of totals of powers, as `wrf_mi.graph.combine.PowerReceiver` reports them.

    Args:
        misfit: residuals of signal strengths.
    """

    def __init__(self, misfit: Misfit) -> None:
        self._floor = np.full((len(misfit.observed), 1), np.nan)
        for model, places in zip(misfit.models, misfit.places, strict=True):
            assert isinstance(model, PowerReceiver)
            self._floor[places] = model.floor

    def report(self, total: Complex, factor: Complex) -> FloatArray:
        """Reports as of `Reports`."""
        power = total.real * np.abs(factor) ** 2 + LEAST_POWER
        return 10 * np.log10(np.where(power > SILENCE, power + LEAST_POWER, self._floor))

    def slope(self, total: Complex, change: Complex, factor: Complex) -> FloatArray:
        """Derivative as of `Reports`."""
        scale = np.abs(factor) ** 2
        power, slope = total.real * scale + LEAST_POWER, change.real * scale
        return np.where(power > SILENCE, 10 / np.log(10) * slope / (power + LEAST_POWER), 0)


class Spectra:
    """Bartlett spectra of element signals, as `wrf_mi.graph.combine.ArrayReceiver` reports them.

    Args:
        misfit: residuals of spectra.
    """

    def __init__(self, misfit: Misfit) -> None:
        self._parts = list[tuple[ArrayReceiver, NDArray[np.complex64], NDArray[np.int64]]]()
        for model, places in zip(misfit.models, misfit.places, strict=True):
            assert isinstance(model, ArrayReceiver)
            directions = pixel_directions(model.height, model.width).reshape(-1, 3)
            matrix = steering(model.elements_m, directions, model.frequency_hz).values
            self._parts.append((model, matrix.astype(np.complex64), places))

    def report(self, total: Complex, factor: Complex) -> FloatArray:
        """Reports as of `Reports`."""
        return self._each(total * factor, None)

    def slope(self, total: Complex, change: Complex, factor: Complex) -> FloatArray:
        """Derivative as of `Reports`."""
        return self._each(total * factor, change * factor)

    def _each(self, signal: Complex, change: Complex | None) -> FloatArray:
        """Spectra of element signals, or their derivatives by that of the signals."""
        found = np.empty((len(signal), self._parts[0][1].shape[1]))
        for model, matrix, places in self._parts:
            image = signal[places].astype(np.complex64) @ matrix
            spectrum = np.sqrt(np.square(np.abs(image)) + SQUARED_MAGNITUDE_EPS)
            row = np.arange(len(places))
            low, high = spectrum.argmin(axis=1), spectrum.argmax(axis=1)
            span = (spectrum[row, high] - spectrum[row, low])[:, None]
            inverse = np.divide(1, span, out=np.zeros_like(span), where=span > 0) if model.instrument_scale else 1
            least = spectrum[row, low][:, None] if model.instrument_scale else 0
            if change is None:
                found[places] = (spectrum - least) * inverse
                continue
            slope = (image.conj() * (change[places].astype(np.complex64) @ matrix)).real / spectrum
            if model.instrument_scale:
                ends = [slope[row, end][:, None] for end in (low, high)]
                slope = (slope - ends[0] - (spectrum - least) * inverse * (ends[1] - ends[0])) * inverse
            found[places] = slope
        return found
