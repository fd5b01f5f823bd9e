"""Spatial spectra: grey images over directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray, solid_angles
from ..receivers.instruments import SpectrumInstrument
from .levels import level_of_amplitudes
from .mixtures import MixtureScores, ssim_mixtures
from .scores import ssim
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
        """Structural similarity on windows that do not overlap (`wrf_mi.tasks.mixtures.ssim_mixtures`)."""
        return ssim_mixtures(predictions, truth)

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Structural similarity on the device, equal to scikit-image's."""
        from ..backend.device import to_float
        from .ssim import ssim as on_device

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


TASK = Spectrum()
