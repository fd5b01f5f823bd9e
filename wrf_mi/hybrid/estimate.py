"""What a hybrid predicts: a value and how far it may be off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.angles import FloatArray


@dataclass(frozen=True)
class Estimate:
    """Predictions at m transmitter positions.

    Attributes:
        mean: [m, *shape of an observation]: grey in 0..1, dBm, or complex channel coefficients.
        std: predicted standard deviation of observation minus mean, real, the same shape and unit; of a complex
            coefficient that of its magnitude of error, sqrt(E |h - mean|^2).
    """

    mean: NDArray[Any]
    std: FloatArray

    def __post_init__(self) -> None:
        """Reject shapes that differ.

        Raises:
            ValueError: naming both.
        """
        if np.shape(self.mean) != np.shape(self.std):
            raise ValueError(f"Estimate: mean {np.shape(self.mean)} and std {np.shape(self.std)} differ in shape")
