"""The tasks of this package: spatial spectra, signal strengths, and channel coefficients."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray, solid_angles
from ..receivers.instruments import ChannelInstrument, PowerInstrument, SpectrumInstrument
from .levels import level_of_amplitudes
from .scores import MixtureScores, abs_error_db, cea_db, ssim, ssim_mixtures
from .task import Task, carrier_hz


class Spectrum(Task):
    """Observations are spectra [height, width] in 0..1, float32, scored by structural similarity."""

    name = "spectrum"
    block, label, digits, higher_is_better = "ssim", "SSIM", 3, True
    axes, image = 2, True
    receiver, receiver_with_scene = "pixel", "array"
    heading, quantity = "spatial spectra", "grey"
    level_kind = "relative"
    level_note = (
        "mean of the squared grey values over the solid angle of the upper hemisphere, relative to a spectrum of ones; "
        "spectra are scaled to their own maximum, so this states how much of the sky the signal arrives from, not how "
        "strong it is"
    )
    note = (
        "SSIM is scikit-image's structural similarity with a data range of one; IDW averages the four nearest "
        "training spectra by inverse squared distance."
    )

    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Structural similarity (`wrf_mi.tasks.scores.ssim`)."""
        return ssim(prediction, truth)

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Loss of the papers (`wrf_mi.tasks.losses.spectrum_loss`)."""
        from .losses import spectrum_loss

        return spectrum_loss(prediction, truth, batch, shape[0], shape[1], ssim_weight)[0]

    def level(self, prediction: Prediction) -> Prediction:
        """Mean power over the solid angle: greys are magnitudes of a beam former (`level_of_amplitudes`)."""
        height, width = prediction.mean.shape[1:]
        weight = solid_angles(height, width)
        return level_of_amplitudes(prediction, weight / weight.sum())

    def mixtures(self, predictions: NDArray[Any], truth: NDArray[Any]) -> MixtureScores:
        """Structural similarity on windows that do not overlap (`wrf_mi.tasks.scores.ssim_mixtures`)."""
        return ssim_mixtures(predictions, truth)

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Structural similarity on the device, equal to scikit-image's."""
        from ..backend.device import to_float
        from .losses import ssim as on_device

        shape = np.shape(truth)
        scores = on_device(to_float(prediction), to_float(truth), shape[0], shape[1], shape[2])
        return np.asarray(scores.numpy(), float)

    def instrument(self, record: Record) -> SpectrumInstrument:
        """An array that reports scaled Bartlett spectra."""
        frequencies = carrier_hz(record, "frequency_hz in its gateway_info.yml")
        if any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antenna array unknown; state array in its gateway_info.yml")
        height, width = record.observation.shape[-2:]
        return SpectrumInstrument(record.receivers, frequencies, record.tx_antenna, (height, width))


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
