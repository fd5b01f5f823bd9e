"""Predictions for a device whose offset a handful of its own readings tell.

Phones differ by decibels, and how they are held: what one receives lies above or below what a model of other phones'
readings predicts, at all receivers alike. The offset is normal a priori, with the deviation of the runs of the data.

Source: Robinson, "That BLUP is a good thing: the estimation of random effects" (1991), Statistical Science 6(1).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction
from ..core.angles import FloatArray
from .interpolation.run_offsets import NEAR_M, RUN_SD_DB
from .model import Arrays, Decomposition, Fitted, Inputs

PLACE_DB = 3.0
"""Standard deviation of what the receivers of one place have in common, such as a crowd: ten readings of a place tell
little more than three."""


@dataclass(frozen=True)
class OwnReadings:
    """Readings of one device.

    Attributes:
        tx_pos_m: positions [m, 3], metres.
        power_dbm: received power at each receiver of a run [n_rx, m], dBm; NaN where nothing was received.
    """

    tx_pos_m: FloatArray
    power_dbm: FloatArray


@dataclass(frozen=True)
class DeviceOffset:
    """Offset of a device from the mean of those that a model learned from.

    Attributes:
        mean_db: posterior mean.
        std_db: posterior standard deviation.
        readings: number of readings that tell it.
    """

    mean_db: float
    std_db: float
    readings: int


def device_offset(fitted: Fitted, own: OwnReadings) -> DeviceOffset:
    """The offset of a device by its own readings.

    Args:
        fitted: model of signal strengths that states standard deviations.
        own: readings, perhaps none.

    Raises:
        InputError: a model without standard deviations.
    """
    count = len(own.tx_pos_m)
    inputs = Inputs(own.tx_pos_m, runs=np.full(count, ""))  # of the mean device
    # Receivers of one place, and readings a step apart, have errors in common.
    _, place = np.unique(np.floor(own.tx_pos_m / NEAR_M), axis=0, return_inverse=True)
    weight, weighted = np.zeros((2, count))
    for receiver, power_dbm in enumerate(own.power_dbm):
        received = np.flatnonzero(np.isfinite(power_dbm))
        if not len(received):
            continue
        predicted = fitted.predict(inputs.rows(received), receiver)
        if predicted.std is None:
            raise InputError("its model states no standard deviations; train it with --intervals")
        np.add.at(weight, place.reshape(-1)[received], predicted.std**-2)
        np.add.at(weighted, place.reshape(-1)[received], (power_dbm[received] - predicted.mean) * predicted.std**-2)
    told = weight > 0
    residual_db, precision = weighted[told] / weight[told], 1 / (PLACE_DB**2 + 1 / weight[told])
    sd_db = RUN_SD_DB if fitted.run_sd_db is None else fitted.run_sd_db
    variance = 1 / (sd_db**-2 + precision.sum())
    readings = int(np.isfinite(own.power_dbm).sum())
    return DeviceOffset(float(variance * (precision @ residual_db)), float(np.sqrt(variance)), readings)


class ForDevice(Fitted):
    """A fitted model as it predicts for a device with an offset; it is not stored."""

    def __init__(self, fitted: Fitted, offset: DeviceOffset) -> None:
        self.fitted, self.offset = fitted, offset
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Signal strengths [m] in dBm, with the deviation of the offset in theirs."""
        return self._shifted(self.fitted.predict(self._of_mean_device(inputs), receiver))

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`."""
        return self.fitted.predict_mean(self._of_mean_device(inputs), receiver) + self.offset.mean_db

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """As of the model; the offset belongs to the prediction alone."""
        parts = self.fitted.decompose(self._of_mean_device(inputs), receiver, std)
        return replace(parts, prediction=self._shifted(parts.prediction))

    def tracing_once(self) -> ForDevice:
        """As of the model."""
        return ForDevice(self.fitted.tracing_once(), self.offset)

    @property
    def depends_on_heading(self) -> bool:
        """As of the model."""
        return self.fitted.depends_on_heading

    def arrays(self) -> Arrays:
        """Those of the model."""
        return self.fitted.arrays()

    def _of_mean_device(self, inputs: Inputs) -> Inputs:
        return replace(inputs, runs=np.full(len(inputs), ""))

    def _shifted(self, prediction: Prediction) -> Prediction:
        std, std_mean = (
            None if each is None else np.hypot(each, self.offset.std_db)
            for each in (prediction.std, prediction.std_mean)
        )
        return replace(prediction, mean=prediction.mean + self.offset.mean_db, std=std, std_mean=std_mean)
