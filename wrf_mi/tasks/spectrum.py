"""Spectra."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction, Record, Task
from ..core.angles import FloatArray, solid_angles
from ..receivers.scaling import SQUARED_MAGNITUDE_EPS
from .scores import level_of_amplitudes, ssim, ssim_mixtures

SCORED_TOGETHER = 16  # Images whose similarity is computed at a time
JOINT = (
    "batch=8",
    "steps=2000",
    # Paths explain most of an image: a network of an eighth of the operations corrects them as well, in half the time.
    "network.width=128",
    "network.layers=4",
    "initial.signal=0.02",
    "density.every=0",
    "validate_every=100",
    "patience=3",
    "traced.alone=0.15",
    "traced.materials=surface",
)
"""Settings of Gaussians beside the paths of a scene, which explain most of an image: Gaussians add little at first."""


class Spectrum(Task):
    """Observations are spectra [height, width] in 0..1, float32, scored by structural similarity."""

    name = "spectrum"
    block, label, digits, higher_is_better = "ssim", "SSIM", 3, True
    axes, image, complete = 2, True, True
    dimensions = MappingProxyType({2: ("elevation", "azimuth")})
    has_gain, averages_phases = False, True
    settings_with_scene, settings_of_paths = JOINT, ("batch=8",)  # an image has thousands of numbers
    receiver, receiver_with_scene = "pixel", "array"
    heading, quantity = "spatial spectra", "grey"
    score, mixtures = staticmethod(ssim), staticmethod(ssim_mixtures)
    level_kind = "relative"
    level_note = (
        "mean of the squared grey values over the solid angle of the upper hemisphere, relative to a spectrum of ones; "
        "spectra are scaled to their own maximum, so this states how much of the sky the signal arrives from, not how "
        "strong it is"
    )
    note = (
        "SSIM is scikit-image's structural similarity with a data range of one; IDW averages the nearest "
        "training spectra, whose number held-out ones choose, by inverse squared distance."
    )

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Loss of the papers (`wrf_mi.tasks.losses.spectrum_loss`)."""
        from .losses import spectrum_loss

        return spectrum_loss(prediction, truth, batch, shape[0], shape[1], ssim_weight)[0]

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """A black spectrum, which is the most similar to spectra of few narrow lobes, and the mean and median."""
        return {"black": np.zeros(observed.shape[1:], observed.dtype)} | super().constants(observed)

    def level(self, prediction: Prediction) -> Prediction:
        """Mean power over the solid angle: greys are magnitudes of a beam former (`level_of_amplitudes`)."""
        height, width = prediction.mean.shape[1:]
        weight = solid_angles(height, width)
        return level_of_amplitudes(prediction, weight / weight.sum())

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Structural similarity on the device, equal to scikit-image's."""
        from ..backend.device import to_float
        from .losses import ssim as on_device

        count, *shape = np.shape(truth)
        # The moments of an image take forty times its memory, which Dr.Jit then keeps.
        parts = [slice(start, start + SCORED_TOGETHER) for start in range(0, count, SCORED_TOGETHER)]
        scores = [on_device(to_float(prediction[k]), to_float(truth[k]), len(truth[k]), *shape).numpy() for k in parts]
        return np.concatenate([np.zeros(0), *scores])

    def image_size(self, shape: tuple[int, ...]) -> tuple[int, int]:
        """Height and width of a spectrum."""
        return int(shape[-2]), int(shape[-1])

    def limited(self, values: NDArray[Any], most: bool = True) -> NDArray[Any]:
        """Greys in 0..1."""
        return np.asarray(np.clip(values, 0, 1 if most else None))

    def of_rays(self, parts: tuple[Any, Any], shape: tuple[int, int, int], offset: Any, receiver: Any) -> Any:
        """Greys [batch, rays] of rays through the pixels."""
        import drjit as dr

        re, im = parts
        return type(offset)(dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS), shape[1:])

    def with_arrays(self, record: Record) -> Record:
        """The record; `InputError`: a receiver without a known array."""
        if any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antenna array unknown; state array in its gateway_info.yml")
        return record
