"""Predictions of a model: mean and, where the model states it, standard deviation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .angles import FloatArray


@dataclass(frozen=True)
class Prediction:
    """Predictions for m transmitters at one receiver.

    Attributes:
        mean: [m, *shape of an observation], as in `wrf_mi.core.Record`: grey in 0..1, dBm, or complex coefficients.
        std: standard deviation of observation minus mean, real, of the mean's shape and unit; for a complex coefficient
            sqrt(E |h - mean|^2). None: the model states none.
    """

    mean: NDArray[Any]
    std: FloatArray | None = None

    def __post_init__(self) -> None:
        """Refuse shapes that differ.

        Raises:
            ValueError: naming both shapes.
        """
        if self.std is not None and np.shape(self.mean) != np.shape(self.std):
            raise ValueError(f"Prediction: mean {np.shape(self.mean)} and std {np.shape(self.std)} differ in shape")

    @property
    def stated_std(self) -> FloatArray:
        """The standard deviation of a model that states one.

        Raises:
            ValueError: the model states none.
        """
        if self.std is None:
            raise ValueError("Prediction: the model states no standard deviation")
        return self.std
