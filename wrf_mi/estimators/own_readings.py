"""Predictions for a device whose offset a handful of its own readings tell.

Phones differ by decibels, and how they are held: what one receives lies above or below what a model of other phones'
readings predicts, at all receivers alike. The offset has a Student-t prior with the scale of the runs of the data: the
device may be of another make than theirs.

A weaker antenna loses weak signals, while a chip that merely states less receives what others do. Which it is, is told
by what the device received at the places of its readings and what it did not: its probability of reception is that of
the shifted strengths where these readings are clearly likelier by it, else that of the mean device.

Source: Robinson, "That BLUP is a good thing: the estimation of random effects" (1991), Statistical Science 6(1); Lange,
Little and Taylor, "Robust statistical modeling using the t distribution" (1989), JASA 84.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray
from ..training.gains import improves
from .interpolation.pooled_process import DEGREES
from .interpolation.run_offsets import NEAR_M, RUN_SD_DB
from .model import Arrays, Decomposition, Fitted, Inputs
from .reception import LEAST

PLACE_DB = 6.0
"""Standard deviation of the error that all readings of a place have in common, by walks of a shopping centre that were
held out: ten readings of a place tell little more than three."""
CLEAR = 2.0  # standard errors by which reception has to gain: consecutive readings are alike
ROUNDS = 20  # reweightings of the prior, after which the offset changes by less than 0.05 dB


@dataclass(frozen=True)
class OwnReadings:
    """Readings of one device.

    Attributes:
        tx_pos_m: positions [m, 3], metres.
        power_dbm: received power at each receiver of a run [n_rx, m], dBm; NaN where nothing was received.
    """

    tx_pos_m: FloatArray
    power_dbm: FloatArray


def checked_readings(tx_pos_m: ArrayLike, power_dbm: ArrayLike, record: Record, receivers: int) -> OwnReadings:
    """Readings of a device beside those of a record, at a number of receivers.

    Raises:
        InputError: a record of another task or of several carriers, or arrays of other shapes.
    """
    readings = OwnReadings(np.atleast_2d(np.asarray(tx_pos_m, float)), np.asarray(power_dbm, float))
    if not record.task.in_decibel or record.task.axes:
        raise InputError(f"predicts {record.task.name}; readings tell offsets of signal strengths alone")
    if record.carriers_hz is not None:
        raise InputError("its data have several carriers; own readings are of one")
    if readings.power_dbm.shape != (receivers, len(readings.tx_pos_m)) or readings.tx_pos_m.shape[1:] != (3,):
        shapes = f"{list(readings.tx_pos_m.shape)} and {list(readings.power_dbm.shape)}"
        raise InputError(f"own readings {shapes}; give positions [m, 3] and strengths [{receivers}, m]")
    return readings


NO_READINGS = OwnReadings(np.zeros((0, 3)), np.zeros((0, 0)))


@dataclass(frozen=True)
class DeviceOffset:
    """Offset of a device from the mean of those that a model learned from.

    Attributes:
        mean_db: posterior mean.
        std_db: posterior standard deviation.
        readings: number of readings that tell it.
        loses_weak: whether its reception is that of strengths with the offset, rather than that of the mean device.
    """

    mean_db: float
    std_db: float
    readings: int
    loses_weak: bool = False


def device_offset(fitted: Fitted, own: OwnReadings | None) -> DeviceOffset:
    """The offset of a device by its own readings.

    Args:
        fitted: model of signal strengths that states standard deviations.
        own: readings; None: none.

    Raises:
        InputError: a model without standard deviations.
    """
    own = own or NO_READINGS
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
    mean_db, variance = 0.0, sd_db**2
    for _ in range(ROUNDS if told.any() else 0):
        # The scale that a Student-t prior has at the offset so far.
        prior = sd_db**2 * (DEGREES + mean_db**2 / sd_db**2) / (DEGREES + 1)
        variance = 1 / (1 / max(prior, sd_db**2) + precision.sum())
        mean_db = float(variance * (precision @ residual_db))
    offset = DeviceOffset(mean_db, float(np.sqrt(variance)), int(np.isfinite(own.power_dbm).sum()))
    return replace(offset, loses_weak=count > 0 and _loses_weak(fitted, own, offset))


def _loses_weak(fitted: Fitted, readings: OwnReadings, offset: DeviceOffset) -> bool:
    """Whether what a device received is clearly likelier by reception of strengths with its offset."""
    inputs = Inputs(readings.tx_pos_m, runs=np.full(len(readings.tx_pos_m), ""))
    loss = np.zeros((2, len(readings.tx_pos_m)))  # of the mean device and with the offset, by reading
    for receiver, power_dbm in enumerate(readings.power_dbm):
        of_mean = fitted.predict(inputs, receiver)
        if of_mean.reception is None:
            continue
        shifted = fitted.with_reception(_shifted(of_mean, offset), inputs, receiver)
        for sums, each in zip(loss, (of_mean, shifted), strict=True):
            probability = np.asarray(each.reception)
            sums -= np.log(np.maximum(np.where(np.isfinite(power_dbm), probability, 1 - probability), LEAST))
    return improves(loss[1], loss[0], higher_is_better=False, errors=CLEAR)


def _shifted(prediction: Prediction, offset: DeviceOffset) -> Prediction:
    """Strengths of the mean device as those of one with an offset, with its deviation in theirs."""
    std, std_mean = (
        None if each is None else np.hypot(each, offset.std_db) for each in (prediction.std, prediction.std_mean)
    )
    return replace(prediction, mean=prediction.mean + offset.mean_db, std=std, std_mean=std_mean)


class ForDevice(Fitted):
    """A fitted model as it predicts for a device with an offset; it is not stored."""

    def __init__(self, fitted: Fitted, offset: DeviceOffset) -> None:
        self.fitted, self.offset = fitted, offset
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz
        self.traces = fitted.traces

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Signal strengths [m] in dBm, with the deviation of the offset in theirs."""
        return self._of_device(self.fitted.predict(self._of_mean_device(inputs), receiver), inputs, receiver)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`."""
        return self.fitted.predict_mean(self._of_mean_device(inputs), receiver) + self.offset.mean_db

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """As of the model; the offset belongs to the prediction alone."""
        parts = self.fitted.decompose(self._of_mean_device(inputs), receiver, std)
        return replace(parts, prediction=self._of_device(parts.prediction, inputs, receiver))

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

    def _of_device(self, prediction: Prediction, inputs: Inputs, receiver: int) -> Prediction:
        shifted = _shifted(prediction, self.offset)
        if prediction.reception is None or not self.offset.loses_weak:
            return shifted
        return self.fitted.with_reception(shifted, inputs, receiver)
