"""Transmitter positions as inputs of networks."""

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
        """Arrays for a run file."""
        return {"centre_m": self.centre_m, "extent_m": np.asarray(self.extent_m)}

    @classmethod
    def load(cls, arrays: Mapping[str, NDArray[Any]]) -> Coordinates:
        """The frame that `arrays` described."""
        return cls(np.asarray(arrays["centre_m"], float), float(arrays["extent_m"]))

    def features(self, positions_m: ArrayLike, octaves: int, scale_m: float) -> Any:
        """Features of positions [n, 3]: a Dr.Jit tensor [3 + 6 octaves, n], see `with_encoding`."""
        points = to_tensor((np.asarray(positions_m, float) - self.centre_m).T)
        return with_encoding(points, octaves, scale_m, 1 / self.extent_m)


def with_encoding(points: Any, octaves: int, scale_m: float, factor: Any) -> Any:
    """Points [3, n] times a factor, and their positional encoding, [3 + 6 octaves, n].

    NeRF's code gives its network both. ``scale_m`` is the unit of the encoding (`wrf_mi.gaussians.encoding`).
    """
    return dr.concat([points * factor, encode(points, octaves, scale_m)], axis=0)


def feature_count(octaves: int) -> int:
    """Rows of the result of `with_encoding`."""
    return 3 + encoded_size(octaves)
