"""Paths as the surfaces that they meet one after the other, without their fields."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray

SPECULAR, TRANSMISSION = 1, 4  # values of Sionna RT's ``InteractionType``
ARRAYS = ("source", "target", "interactions", "face", "vertices_m", "probability")
"""Fields of `Legs` with a value, or a row, for each path."""


@dataclass(frozen=True)
class Legs:
    """Interactions of p paths from source to target, the input of Sionna RT's stages."""

    source: IntArray  # indices of the points that each path joins, shape [p]
    target: IntArray  # indices of the points that each path joins, shape [p]
    # ``InteractionType`` of each interaction, uint8, shape [p, depth], 0 beyond the last
    interactions: NDArray[np.uint8]
    # index of the face at each interaction into `Surfaces.triangles`, shape [p, depth], -1 beyond the last
    face: IntArray
    vertices_m: FloatArray  # interaction points [p, depth, 3], metres, NaN beyond the last
    # probability of the interaction in a random search, shape [p, depth]; 1 in an exhaustive one
    probability: NDArray[np.float32]
    # edges of diffraction, fields of ``WedgeGeometry`` by name with first axis p; empty without diffraction
    wedge: dict[str, NDArray[Any]]

    def __len__(self) -> int:
        """Number of paths."""
        return len(self.source)

    def select(self, which: NDArray[Any] | slice) -> Legs:
        """The paths of a mask or of indices."""
        wedge = {name: array[which] for name, array in self.wedge.items()}
        return Legs(**{name: getattr(self, name)[which] for name in ARRAYS}, wedge=wedge)

    def reverse(self) -> Legs:
        """The same paths from target to source; edges of diffraction keep the faces of the original direction."""
        depth = self.interactions.shape[1]
        last = np.count_nonzero(self.interactions, axis=1)[:, None] - 1
        level = np.arange(depth)
        turned = np.arange(len(self))[:, None], np.where(level <= last, last - level, level)
        arrays = {name: getattr(self, name)[turned] for name in ("interactions", "face", "vertices_m", "probability")}
        return replace(self, source=self.target, target=self.source, **arrays)


def join(parts: list[Legs]) -> Legs:
    """Concatenate legs of the same depth."""
    wedge: dict[str, NDArray[Any]] = {}
    for name, like in next((part.wedge for part in parts if part.wedge), {}).items():
        zeros = [np.zeros((len(part), *like.shape[1:]), like.dtype) for part in parts]
        wedge[name] = np.concatenate([part.wedge.get(name, zero) for part, zero in zip(parts, zeros, strict=True)])
    return Legs(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS}, wedge=wedge)
