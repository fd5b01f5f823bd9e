"""Received signal strengths in dBm."""

from __future__ import annotations

from typing import Any

from numpy.typing import ArrayLike, NDArray

from ..core import Prediction, Record
from ..core.angles import FloatArray
from ..receivers.instruments import PowerInstrument
from .scores import abs_error_db
from .task import Task, carrier_hz


class Rssi(Task):
    """Observations are powers in dBm, float32, NaN where nothing was received, scored by the absolute error."""

    name = "rssi"
    block, label, higher_is_better = "abs_error_db", "absolute error (dB)", False
    axes, in_decibel = 0, True
    receiver = receiver_with_scene = "power"
    # Best of 0 to 1.6 m in a tenfold cross-validation, in the order of time, on flat-ble's training run.
    neighbours, softening_m = 100, 0.4
    heading, quantity = "received signal strength", "RSSI (dBm)"
    level_kind, level_note = "power", "received power as the receiver reports it"
    note = (
        "The absolute error in dB counts rows that were received; IDW averages the 100 nearest training rows "
        "that the same receiver received by inverse squared distance, 0.4 m added."
    )

    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Absolute error (`wrf_mi.tasks.scores.abs_error_db`)."""
        return abs_error_db(prediction, truth)

    def level(self, prediction: Prediction) -> Prediction:
        """The received power in dBm itself."""
        return prediction

    def unit(self, observed: NDArray[Any]) -> float:
        """Ten decibels: errors are then of the size that the learning rates expect."""
        return 10.0

    def instrument(self, record: Record) -> PowerInstrument:
        """Single antennas that report received power."""
        frequencies = carrier_hz(record, "frequency_hz in its gateway_info.yml")
        return PowerInstrument(record.receivers, frequencies, record.tx_antenna)


TASK = Rssi()
