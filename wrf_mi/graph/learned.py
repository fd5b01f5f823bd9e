"""Gaussians splatted on the directions that a receiver model asks for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import drjit as dr
import numpy as np

from ..core.angles import FloatArray, pixel_directions
from ..gaussians import Gaussians, InitialGaussians
from ..gaussians.footprint import Pose
from ..gaussians.render import splat
from ..gaussians.skip import NOTHING, Skip
from ..gaussians.tiles import Plane
from ..tracing.field_calculator import Complex


class Field(Protocol):
    """What a learned field is, see `wrf_mi.gaussians.WrfGs` and `wrf_mi.gaussians.WrfGsPlus`."""

    def init(self, initial: InitialGaussians, rng: Any) -> dict[str, Any]:
        """Parameters as NumPy arrays."""
        ...

    def gaussians(self, params: Mapping[str, Any], tx_pos: Any) -> Gaussians:
        """Gaussians for transmitter positions [3, batch] in metres."""
        ...


def learned_field(
    gaussians: Gaussians, pose: Pose, plane: Plane, sphere: bool = False, skip: Skip = NOTHING
) -> Complex:
    """Complex signal on the upper hemisphere or the full sphere. Differentiable in Gaussians and pose.

    Args:
        gaussians: of one field for a batch of transmitters.
        pose: of the receiver.
        plane: pixels of a hemisphere.
        sphere: the lower hemisphere too: what a receiver turned about its x axis by half a turn sees.
        skip: what is not evaluated, with bounds on the error of each direction's signal.

    Returns:
        Real and imaginary part, [batch * directions]; with ``sphere``, for each transmitter the pixels of the upper
        hemisphere, then those of the lower one, see `hemisphere_pair`.
    """
    upper = splat(gaussians, pose, plane, skip)
    if not sphere:
        return upper
    lower = splat(gaussians, facing_down(pose), plane, skip)
    tensor_type: Any = dr.tensor_t(type(upper[0]))
    shape = (gaussians.batch, plane.pixels)
    re, im = (
        dr.concat([tensor_type(half, shape) for half in halves], axis=1).array
        for halves in zip(upper, lower, strict=True)
    )
    return re, im


def facing_down(pose: Pose) -> Pose:
    """The pose after half a turn about the receiver's x axis: its upper hemisphere is the lower one of ``pose``."""
    return Pose(pose.position, [[row[0], -row[1], -row[2]] for row in pose.to_world])


def hemisphere_pair(height: int, width: int) -> FloatArray:
    """Unit vectors [2 * height * width, 3] of the pixels of the upper, then the lower hemisphere, receiver's frame.

    The lower hemisphere is the upper one after half a turn about x, in the order of `wrf_mi.core.pixel_directions`; for
    one grid over the full sphere see `wrf_mi.core.angles.equirectangular_sphere`.
    """
    upper = pixel_directions(height, width).reshape(-1, 3)
    return np.concatenate([upper, upper * [1, -1, -1]])
