"""Transmitter positions as the networks of this package see them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...backend.device import to_tensor
from ...core.angles import FloatArray
from ...gaussians.encoding import encode, encoded_size

LEAST_M = 1e-3
"""Smallest extent that coordinates are divided by: all rows may lie at one height."""


@dataclass(frozen=True)
class Coordinates:
    """A frame of positions, fitted on training rows.

    Attributes:
        centre_m: mean of the training positions [3].
        extent_m: largest distance from it along an axis, metres.
    """

    centre_m: FloatArray
    extent_m: float

    @classmethod
    def of(cls, positions_m: ArrayLike) -> Coordinates:
        """The frame of training positions [n, 3]."""
        p = np.asarray(positions_m, float)
        centre = p.mean(axis=0)
        return cls(centre, max(float(np.abs(p - centre).max()), LEAST_M))

    def arrays(self) -> dict[str, NDArray[Any]]:
        """For a checkpoint."""
        return {"centre_m": self.centre_m, "extent_m": np.asarray(self.extent_m)}

    @classmethod
    def load(cls, arrays: Mapping[str, NDArray[Any]]) -> Coordinates:
        """What `arrays` described."""
        return cls(np.asarray(arrays["centre_m"], float), float(arrays["extent_m"]))

    def features(self, positions_m: ArrayLike, octaves: int, scale_m: float) -> Any:
        """Features of positions [n, 3]: a Dr.Jit tensor [3 + 6 octaves, n].

        The coordinates in units of the extent, and their positional encoding in metres (`wrf_mi.gaussians.encoding`),
        as NeRF's code gives its network both.
        """
        from_centre = np.asarray(positions_m, float) - self.centre_m
        points = to_tensor(from_centre.T)
        return dr.concat([points * (1 / self.extent_m), encode(points, octaves, scale_m)], axis=0)


def feature_count(octaves: int) -> int:
    """Rows of what `Coordinates.features` returns."""
    return 3 + encoded_size(octaves)
