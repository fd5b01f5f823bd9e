"""Predictions of a model."""

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
        std: standard deviation of a reading (a single observation, its noise included) minus mean, real, of the mean's
            shape and unit; for a complex coefficient sqrt(E |h - mean|^2). None: the model states none.
        reception: probability that the receiver receives anything [m], of signal strengths; mean and std are those of
            what is received. None: the model states none.
        std_mean: standard deviation of the mean: of what is observed without noise (of signal strengths the local mean
            power) minus mean, otherwise as ``std``. None: the model cannot tell it from ``std``.

    Raises:
        ValueError: shapes that differ.
    """

    mean: NDArray[Any]
    std: FloatArray | None = None
    reception: FloatArray | None = None
    std_mean: FloatArray | None = None

    def __post_init__(self) -> None:
        for name in ("std", "std_mean"):
            deviation = getattr(self, name)
            if deviation is not None and np.shape(self.mean) != np.shape(deviation):
                raise ValueError(
                    f"Prediction: mean {np.shape(self.mean)} and {name} {np.shape(deviation)} differ in shape"
                )

    @property
    def stated_std(self) -> FloatArray:
        """The standard deviation of a model that states one; `ValueError`: the model states none."""
        if self.std is None:
            raise ValueError("Prediction: the model states no standard deviation")
        return self.std
