"""The two bands and the array of data for methods that predict downlink from uplink coefficients."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ..model import Model, received_rows

FLAT = 0.01
"""Share of an array's largest extent along a principal axis below which phases of a few degrees do not resolve the
wave's direction along that axis."""


@dataclass(frozen=True)
class Bands:
    """Two bands and the array that observes them."""

    uplink_hz: FloatArray  # frequency of each uplink subcarrier [f]
    downlink_hz: FloatArray  # frequency of each downlink subcarrier [g]
    antennas: int
    known: bool  # whether the frequencies come with the data
    # Positions of the antennas about the centre of the array, along its q principal axes [antennas, q], metres; None:
    # unknown
    elements_m: FloatArray | None = None

    @property
    def reference_hz(self) -> float:
        """Middle of the uplink, the reference of phases over frequency."""
        return float(self.uplink_hz.mean())

    @property
    def spacing_hz(self) -> float:
        """Smallest distance of two uplink subcarriers; infinite with a single subcarrier."""
        return float(np.diff(np.sort(self.uplink_hz)).min(initial=np.inf))


def bands_of(record: Record, spacing_hz: float, gap: int = 1) -> Bands:
    """The bands of a record.

    Without known frequencies, subcarriers are taken to be ``spacing_hz`` apart around 0 Hz, the downlink ``gap``
    spacings above the uplink, and the array's elements are not used, since the wavelength is unknown.

    Raises:
        InputError: a single uplink subcarrier, or an array of another size.
    """
    assert record.uplink is not None
    (antennas, up), down = record.uplink.shape[1:], record.observation.shape[3]
    if up < 2:
        raise InputError(f"{record.name}: {up} uplink subcarrier; delays show in two or more")
    known = record.uplink_hz is not None and record.frequencies_hz is not None
    if known:
        uplink_hz, downlink_hz = np.asarray(record.uplink_hz, float), np.asarray(record.frequencies_hz, float)
    else:
        uplink_hz = spacing_hz * (np.arange(up) - up - (gap - 1) / 2 + 0.5)
        downlink_hz = spacing_hz * (np.arange(down) + (gap - 1) / 2 + 0.5)
    array_m = record.receivers[0].array_m
    elements = None if array_m is None or not known else np.asarray(array_m, float)
    if elements is not None:
        if elements.shape != (antennas, 3):
            raise InputError(f"{record.name}: array {elements.shape} for {antennas} antennas; give x, y, z of each")
        elements = (elements - elements.mean(axis=0)) @ principal_axes(elements).T
    return Bands(uplink_hz, downlink_hz, antennas, known, elements)


def principal_axes(elements_m: FloatArray) -> FloatArray:
    """Unit vectors [q, 3] of the principal axes along which an array is not flat (`FLAT`): a plane array has two."""
    _, extent, axes = np.linalg.svd(elements_m - elements_m.mean(axis=0), full_matrices=False)
    return np.asarray(axes[extent > FLAT * max(float(extent[0]), np.finfo(float).tiny)])


class UplinkModel(Model):
    """A model of the downlink from the uplink of an array."""

    tasks = ("csi",)
    uplink, headings = "required", True

    def known_rows(self, record: Record, split: Split) -> tuple[IntArray, IntArray]:
        """Rows that train at first, and rows that choose settings, see `wrf_mi.models.model.received_rows`.

        Raises:
            InputError: several receivers, no axis of antennas, or fewer than two rows.
        """
        shape = record.observation.shape
        if len(shape) != 4 or shape[0] != 1:
            raise InputError(
                f"{record.name}: channel coefficients {list(shape)}; {self.name} needs one receiver with the antennas "
                "that the uplink has, [1, rows, antennas, subcarriers]"
            )
        return received_rows(record, split, 0, self.name)


def relative_error(prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
    """Squared error over energy of coefficients, summed over the last axis: CEA in linear units."""
    power = np.square(np.abs(truth)).sum(axis=-1)
    error = np.square(np.abs(prediction - truth)).sum(axis=-1)
    return np.asarray(error / np.maximum(power, np.finfo(np.float32).tiny))
