"""What every method that predicts downlink from uplink coefficients is told: the two bands and the array."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record, Split
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...datasets.observations import check_observations
from ..checks import check_record
from ..method import Inputs, Method

FLAT = 0.01
"""Extent of an array along a principal axis, as a share of its longest, below which it counts as flat there: the wave's
direction along that axis cannot be told from phases of a few degrees."""


@dataclass(frozen=True)
class Bands:
    """Two bands and the array that observes them.

    Attributes:
        uplink_hz: frequency of each uplink subcarrier [f].
        downlink_hz: of each downlink subcarrier [g].
        antennas: number of antennas.
        elements_m: their positions about the centre of the array, along its q principal axes [antennas, q], metres;
            None where the data do not tell.
        known: whether the frequencies come with the data.
    """

    uplink_hz: FloatArray
    downlink_hz: FloatArray
    antennas: int
    elements_m: FloatArray | None
    known: bool

    @property
    def reference_hz(self) -> float:
        """Middle of the uplink, from which phases over frequency count."""
        return float(self.uplink_hz.mean())

    @property
    def spacing_hz(self) -> float:
        """Smallest distance of two uplink subcarriers; of a band of one, infinite."""
        return float(np.diff(np.sort(self.uplink_hz)).min(initial=np.inf))


def bands_of(record: Record, spacing_hz: float, gap: int = 1) -> Bands:
    """The bands of a record.

    Where it names no frequencies, the subcarriers are taken to be ``spacing_hz`` apart around 0 Hz, the downlink
    ``gap`` spacings above the uplink, and the array's elements are of no use, since the wavelength is not known.

    Raises:
        InputError: one uplink subcarrier, frequencies for another number of them, or an array of another size.
    """
    assert record.uplink is not None, "see `training_rows`"
    (antennas, up), down = record.uplink.shape[1:], record.observation.shape[3]
    if up < 2:
        raise InputError(f"{record.name}: {up} uplink subcarrier; delays show in two or more")
    known = record.uplink_hz is not None and record.frequencies_hz is not None
    if known:
        uplink_hz, downlink_hz = np.asarray(record.uplink_hz, float), np.asarray(record.frequencies_hz, float)
    else:
        if not (spacing_hz > 0 and gap >= 1):
            raise InputError(f"subcarriers {spacing_hz} Hz apart, bands {gap} spacings: both must be positive")
        uplink_hz = spacing_hz * (np.arange(up) - up - (gap - 1) / 2 + 0.5)
        downlink_hz = spacing_hz * (np.arange(down) + (gap - 1) / 2 + 0.5)
    if len(uplink_hz) != up or len(downlink_hz) != down:
        raise InputError(
            f"{record.name}: {up} uplink and {down} downlink subcarriers, but {len(uplink_hz)} and {len(downlink_hz)} "
            "frequencies; give one for each"
        )
    array_m = record.receivers[0].array_m
    elements = None if array_m is None or not known else np.asarray(array_m, float)
    if elements is not None and elements.shape != (antennas, 3):
        raise InputError(f"{record.name}: array {elements.shape} for {antennas} antennas; give x, y, z of each")
    return Bands(uplink_hz, downlink_hz, antennas, None if elements is None else principal(elements), known)


def principal(elements_m: FloatArray) -> FloatArray:
    """Positions of an array's elements about their mean, along its principal axes, [antennas, q], metres.

    Axes along which it is flat (`FLAT`) are left out: a plane array has two, a line one, a single antenna none.
    """
    centred = elements_m - elements_m.mean(axis=0)
    _, extent, axes = np.linalg.svd(centred, full_matrices=False)
    return np.asarray(centred @ axes[extent > FLAT * max(float(extent[0]), np.finfo(float).tiny)].T)


def training_rows(method: Method, record: Record, split: Split) -> tuple[IntArray, IntArray]:
    """Rows to learn from while choosing and rows to choose by, those that were received, of a record that was checked.

    Without the former, the latter are learned from.

    Raises:
        InputError: as `check_record` and `check_observations`; several receivers, no axis of antennas, or fewer than
            two rows.
    """
    check_record(method, record)
    check_observations(record, split)
    shape = record.observation.shape
    if len(shape) != 4 or shape[0] != 1:
        raise InputError(
            f"{record.name}: channel coefficients {list(shape)}; {method.name} needs one receiver with the antennas "
            "that the uplink has, [1, rows, antennas, subcarriers]"
        )
    seen = np.isfinite(record.observation[0]).all(axis=(1, 2))
    train, validation = split.train[seen[split.train]], split.validation[seen[split.validation]]
    if len(train) + len(validation) < 2:
        raise InputError(
            f"{record.name}: {len(train) + len(validation)} training row; {method.name} needs two at least"
        )
    return (train, validation) if len(train) else (validation, train)


def uplink_of(inputs: Inputs, bands: Bands) -> NDArray[np.complex128]:
    """The uplink coefficients [m, antennas, subcarriers] of rows to predict.

    Raises:
        InputError: none, of another shape, or not finite.
    """
    return finite_uplink(inputs, bands.antennas, len(bands.uplink_hz))


def finite_uplink(inputs: Inputs, antennas: int, subcarriers: int) -> NDArray[np.complex128]:
    """The same of a model that knows no frequencies.

    Raises:
        InputError: as `uplink_of`.
    """
    if inputs.uplink is None:
        raise InputError("rows without uplink coefficients: give `uplink` [rows, antennas, subcarriers]")
    expected = (antennas, subcarriers)
    if inputs.uplink.ndim != 3 or inputs.uplink.shape[1:] != expected:
        raise InputError(f"uplink {inputs.uplink.shape}: fitted on {expected} antennas and subcarriers a row")
    wrong = int(np.count_nonzero(~np.isfinite(inputs.uplink)))
    if wrong:
        raise InputError(f"uplink: {wrong} of {inputs.uplink.size} values are not finite; correct or remove the rows")
    return np.asarray(inputs.uplink, complex)


def relative_error(prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
    """Squared error over energy of coefficients, summed over the last axis: what CEA is the logarithm of."""
    power = np.square(np.abs(truth)).sum(axis=-1)
    error = np.square(np.abs(prediction - truth)).sum(axis=-1)
    return np.asarray(error / np.maximum(power, np.finfo(np.float32).tiny))
