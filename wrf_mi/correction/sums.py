"""What instruments report of sums over paths, and the derivatives of the reports.

Each kind takes totals [n, values], sums of waves or of powers, and factors [n, 1] of the receivers' gains, of some rows
[n], in ascending order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray, pixel_directions
from ..core.types import SQUARED_MAGNITUDE_EPS, IntArray
from ..graph.combine import LEAST_POWER, SILENCE, ArrayReceiver, PowerReceiver
from ..graph.ports import steering

if TYPE_CHECKING:
    from .misfit import Misfit

Complex = NDArray[np.complex128]


Slopes = Callable[[Complex, IntArray], FloatArray]
"""Derivatives of reports by changes of totals, and the places of their rows among those of the reports."""


class Reports(Protocol):
    """Reports of totals."""

    def report(self, total: Complex, factor: Complex, rows: IntArray) -> FloatArray:
        """Reports [n, values] as those of `Misfit`, before the unit of each row."""
        ...

    def slopes(self, total: Complex, factor: Complex, rows: IntArray) -> Slopes:
        """Derivative of `report` by that of the totals."""
        ...


class Channels:
    """Channels of a single antenna, real and imaginary part in turn."""

    def report(self, total: Complex, factor: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Reports`."""
        return np.ascontiguousarray(total * factor).view(float)

    def slopes(self, total: Complex, factor: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Reports`."""
        return lambda change, which: self.report(change, factor[which], rows[which])


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

    def report(self, total: Complex, factor: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Reports`."""
        power = total.real * np.abs(factor) ** 2 + LEAST_POWER
        return 10 * np.log10(np.where(power > SILENCE, power + LEAST_POWER, self._floor[rows]))

    def slopes(self, total: Complex, factor: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Reports`."""
        scale = np.abs(factor) ** 2
        power = total.real * scale + LEAST_POWER
        weight = np.where(power > SILENCE, 10 / np.log(10) * scale / (power + LEAST_POWER), 0)
        return lambda change, which: weight[which] * change.real


class Spectra:
    """Bartlett spectra of element signals, scaled as `wrf_mi.graph.combine.ArrayReceiver.instrument_scale` does.

    Args:
        misfit: residuals of spectra.
    """

    def __init__(self, misfit: Misfit) -> None:
        self._matrices = list[NDArray[np.complex64]]()
        self._side = np.zeros(len(misfit.observed), np.int64)
        for side, (model, places) in enumerate(zip(misfit.models, misfit.places, strict=True)):
            assert isinstance(model, ArrayReceiver)
            directions = pixel_directions(model.height, model.width).reshape(-1, 3)
            matrix = steering(model.elements_m, directions, model.frequency_hz).values
            self._matrices.append(matrix.astype(np.complex64))
            self._side[places] = side

    def report(self, total: Complex, factor: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Reports`."""
        spectrum = _magnitude(self._images(total * factor, rows))
        low, _, inverse = _scale(spectrum)
        return np.asarray((spectrum - np.take_along_axis(spectrum, low, axis=1)) * inverse, float)

    def slopes(self, total: Complex, factor: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Reports`."""
        image = self._images(total * factor, rows)
        spectrum = _magnitude(image)
        low, high, inverse = _scale(spectrum)
        weight = image.conj() / spectrum
        share = (spectrum - np.take_along_axis(spectrum, low, axis=1)) * inverse

        def slope(change: Complex, which: IntArray) -> FloatArray:
            found = (weight[which] * self._images(change * factor[which], rows[which])).real
            least, most = (np.take_along_axis(found, end[which], axis=1) for end in (low, high))
            return np.asarray((found - least - share[which] * (most - least)) * inverse[which], float)

        return slope

    def _images(self, signal: Complex, rows: IntArray) -> NDArray[np.complex64]:
        """Element signals of some rows in all directions, complex."""
        side, single = self._side[rows], signal.astype(np.complex64)
        if len(self._matrices) == 1:
            return single @ self._matrices[0]
        found = np.empty((len(rows), self._matrices[0].shape[1]), np.complex64)
        for number in np.unique(side):
            found[side == number] = single[side == number] @ self._matrices[number]
        return found


def _scale(spectrum: NDArray[np.float32]) -> tuple[IntArray, IntArray, NDArray[np.float32]]:
    """Places of the least and the largest value of each row [n, 1], and the factor that scales them to 0 and 1."""
    low, high = spectrum.argmin(axis=1)[:, None], spectrum.argmax(axis=1)[:, None]
    span = np.take_along_axis(spectrum, high, axis=1) - np.take_along_axis(spectrum, low, axis=1)
    return low, high, np.divide(1, span, out=np.zeros_like(span), where=span > 0)


def _magnitude(image: NDArray[np.complex64]) -> NDArray[np.float32]:
    return np.sqrt(np.square(image.real) + np.square(image.imag) + np.float32(SQUARED_MAGNITUDE_EPS))
