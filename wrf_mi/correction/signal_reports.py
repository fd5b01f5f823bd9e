"""Reports of channels, strengths and spectra from the signals of rows, in NumPy, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray, pixel_directions
from ..core.types import IntArray
from ..graph.combine import ArrayReceiver, PowerReceiver
from ..receivers.array import steering_matrix
from ..receivers.reports import LEAST_POWER, SILENCE, SQUARED_MAGNITUDE_EPS

if TYPE_CHECKING:
    from .misfit import Misfit

Complex = NDArray[np.complex128]
Slopes = Callable[[Complex, IntArray], FloatArray]
"""Derivatives of reports by changes of signals, and the places of their rows among those of the reports."""


class Channels:
    """Reports of signals [n, values] of some rows [n], in ascending order: sums of waves or of powers, times gains.

    Here channels of a single antenna, real and imaginary part in turn.
    """

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports [n, values] as those of `Misfit`, before the unit of each row."""
        return np.ascontiguousarray(signal).view(float)

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative of `report` by the signals."""
        return lambda change, which: self.report(change, rows[which])


class Strengths(Channels):
    """Powers in dB, as `wrf_mi.graph.combine.PowerReceiver` reports them."""

    def __init__(self, misfit: Misfit) -> None:
        self._floor = np.full((len(misfit.observed), 1), np.nan)
        for model, places in zip(misfit.models, misfit.places, strict=True):
            assert isinstance(model, PowerReceiver)
            self._floor[places] = model.floor

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Channels`."""
        power = signal.real + LEAST_POWER
        return 10 * np.log10(np.where(power > SILENCE, power + LEAST_POWER, self._floor[rows]))

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Channels`."""
        power = signal.real + LEAST_POWER
        weight = np.where(power > SILENCE, 10 / np.log(10) / (power + LEAST_POWER), 0)
        return lambda change, which: weight[which] * change.real


class Spectra(Channels):
    """Bartlett spectra of element signals, scaled as `wrf_mi.graph.combine.ArrayReceiver.instrument_scale` does."""

    def __init__(self, misfit: Misfit) -> None:
        self._matrices = list[NDArray[np.complex64]]()
        self._which = np.zeros(len(misfit.observed), np.int64)
        number_of = dict[tuple[bytes, float], int]()  # receivers of the same instrument share their matrix
        for model, places in zip(misfit.models, misfit.places, strict=True):
            assert isinstance(model, ArrayReceiver)
            key = model.elements_m.tobytes(), float(model.frequency_hz)
            if key not in number_of:
                number_of[key] = len(number_of)
                directions = pixel_directions(model.height, model.width).reshape(-1, 3)
                matrix = steering_matrix(model.elements_m, directions, model.frequency_hz)
                self._matrices.append(matrix.astype(np.complex64))
            self._which[places] = number_of[key]

    def report(self, signal: Complex, rows: IntArray) -> FloatArray:
        """Reports as of `Channels`."""
        return np.asarray(_scaled(_magnitude(self._images(signal, rows)))[0], float)

    def slopes(self, signal: Complex, rows: IntArray) -> Slopes:
        """Derivative as of `Channels`."""
        image = self._images(signal, rows)
        spectrum = _magnitude(image)
        share, low, high, inverse = _scaled(spectrum)
        weight = image.conj() / spectrum

        def slope(change: Complex, which: IntArray) -> FloatArray:
            by_pixel = (weight[which] * self._images(change, rows[which])).real
            least, most = (np.take_along_axis(by_pixel, end[which], axis=1) for end in (low, high))
            return np.asarray((by_pixel - least - share[which] * (most - least)) * inverse[which], float)

        return slope

    def _images(self, signal: Complex, rows: IntArray) -> NDArray[np.complex64]:
        """Element signals of some rows in all directions, complex."""
        single, which = signal.astype(np.complex64), self._which[rows]
        images = np.empty((len(rows), self._matrices[0].shape[1]), np.complex64)
        # Rows of paths are sorted by instrument and carrier: their slices are multiplied without copies.
        bounds = [0, *(np.flatnonzero(np.diff(which)) + 1).tolist(), len(rows)]
        for begin, end in pairwise(bounds):
            if begin < end:
                np.matmul(single[begin:end], self._matrices[which[begin]], out=images[begin:end])
        return images


def _scaled(spectrum: NDArray[np.float32]) -> tuple[NDArray[np.float32], IntArray, IntArray, NDArray[np.float32]]:
    """Rows scaled to 0..1, places of their least and largest values [n, 1], and the factor by which they are scaled."""
    low, high = spectrum.argmin(axis=1)[:, None], spectrum.argmax(axis=1)[:, None]
    least = np.take_along_axis(spectrum, low, axis=1)
    span = np.take_along_axis(spectrum, high, axis=1) - least
    inverse = np.divide(1, span, out=np.zeros_like(span), where=span > 0)
    return (spectrum - least) * inverse, low, high, inverse


def _magnitude(image: NDArray[np.complex64]) -> NDArray[np.float32]:
    return np.sqrt(np.square(image.real) + np.square(image.imag) + np.float32(SQUARED_MAGNITUDE_EPS))
