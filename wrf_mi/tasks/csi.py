"""Channel state information: complex coefficients on subcarriers, at one or several antennas."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray
from ..receivers.instruments import ChannelInstrument
from .levels import level_of_amplitudes
from .scores import cea_db
from .task import Task, carrier_hz


class Csi(Task):
    """Observations are channels [subcarriers] or [antennas, subcarriers], complex64, scored by estimation accuracy."""

    name = "csi"
    block, label, higher_is_better = "cea_db", "CEA (dB)", True
    limits = -10.0, 40.0
    axes, more_axes, is_complex = 1, 1, True
    receiver = receiver_with_scene = "csi"
    from_uplink = "copy of the uplink"
    constant_words = "zero"
    heading, quantity = "channel coefficients", "power (dB)"
    level_kind, level_note = "gain", "mean of |h|^2 over antennas and subcarriers, in the unit of the data"
    note = (
        "CEA is the channel estimation accuracy, -10 log10 of the relative squared error over a sample's antennas "
        "and subcarriers; IDW averages the four nearest training rows by inverse squared distance; the copy of the "
        "uplink takes each antenna's uplink coefficients for the downlink's."
    )

    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Channel estimation accuracy (`wrf_mi.tasks.scores.cea_db`)."""
        return cea_db(prediction, truth)

    def constant(self, observed: NDArray[Any]) -> NDArray[Any]:
        """Zero, whose accuracy is 0 dB: over some wavelengths of positions the phase takes every value, and the mean of
        few training rows is what chance has left.
        """
        return np.zeros(observed.shape[1:], observed.dtype)

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Mean squared difference over received observations."""
        from .losses import squared_error

        return squared_error(prediction, truth)

    def level(self, prediction: Prediction) -> Prediction:
        """Channel gain: mean power of the coefficients over antennas and subcarriers (`level_of_amplitudes`)."""
        shape = prediction.mean.shape[1:]
        return level_of_amplitudes(prediction, np.full(shape, 1 / max(int(np.prod(shape)), 1)))

    def unit(self, observed: NDArray[Any]) -> float:
        """Root mean square of a receiver's channels: far and near receivers then have equal weight."""
        size = np.square(np.abs(np.asarray(observed, complex)))
        power = float(np.nanmean(size)) if np.isfinite(size).any() else 0.0
        return power**0.5 if power > 0 else 1.0

    def instrument(self, record: Record) -> ChannelInstrument:
        """Antennas, one or several at each receiver, that report channel coefficients."""
        frequencies = carrier_hz(record, "frequencies_hz in base-station.yml")
        several = record.observation.ndim > 3
        if several and any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antennas' positions unknown; state base_station in base-station.yml")
        single = record if several else record.with_array(None)
        return ChannelInstrument(single.receivers, frequencies, record.tx_antenna)

    def check(self, record: Record) -> None:
        """Refuse inconsistent numbers of rows, antennas, subcarriers and frequencies."""
        source, shape = record.source or record.name, record.observation.shape
        if len(shape) not in (3, 4):
            text = "expected [receivers, rows, subcarriers] or [receivers, rows, antennas, subcarriers]"
            raise InputError(f"{source}: channel coefficients {list(shape)}; {text}")
        frequencies = record.frequencies_hz
        if frequencies is not None and len(frequencies) not in (1, shape[-1]):
            raise InputError(_differ(source, "", shape[-1], len(frequencies)))
        if record.uplink is None:
            return
        antennas = shape[2] if len(shape) == 4 else 1
        if record.uplink.ndim != 3 or record.uplink.shape[:2] != (shape[1], antennas):
            raise InputError(
                f"{source}: uplink {list(record.uplink.shape)} beside a downlink of {shape[1]} rows and {antennas} "
                "antennas; give both for the same ones"
            )
        if record.uplink_hz is not None and len(record.uplink_hz) != record.uplink.shape[2]:
            raise InputError(_differ(source, "uplink ", record.uplink.shape[2], len(record.uplink_hz)))


def _differ(source: str, what: str, subcarriers: int, frequencies: int) -> str:
    return f"{source}: {subcarriers} {what}subcarriers and {frequencies} frequencies; give one for each"


TASK = Csi()
