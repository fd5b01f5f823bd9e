"""Spatial spectra: grey images over directions."""

from __future__ import annotations

from numpy.typing import ArrayLike

from ..core import InputError, Record
from ..core.angles import FloatArray
from ..receive.instruments import SpectrumInstrument
from .scores import ssim
from .task import Task, carrier_hz


class Spectrum(Task):
    """Observations are spectra [height, width] in 0..1, float32, scored by structural similarity."""

    name = "spectrum"
    block, label, digits, higher_is_better = "ssim", "SSIM", 3, True
    axes, image = 2, True
    heading, quantity = "spatial spectra", "grey"
    note = (
        "SSIM is scikit-image's structural similarity with a data range of one; the blend mixes the four nearest "
        "training spectra by inverse squared distance."
    )

    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """See `wrf_mi.tasks.scores.ssim`."""
        return ssim(prediction, truth)

    def instrument(self, record: Record) -> SpectrumInstrument:
        """An array that reports scaled Bartlett spectra."""
        frequencies = carrier_hz(record, "frequency_hz in its gateway_info.yml")
        if any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antenna array unknown; state array in its gateway_info.yml")
        height, width = record.observation.shape[-2:]
        return SpectrumInstrument(record.receivers, frequencies, record.tx_antenna, (height, width))


TASK = Spectrum()
