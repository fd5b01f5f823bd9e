"""From a field to what a receiver's perception plane sees, by splatting."""

from __future__ import annotations

from typing import Any

from ..field.gaussians import Gaussians
from ..project.footprint import Pose, depth_order, project
from .blend import blend
from .tiles import Plane, build_lists


def splat(gaussians: Gaussians, pose: Pose, plane: Plane) -> tuple[Any, Any]:
    """Received complex signal per direction for each transmitter of the batch.

    Args:
        gaussians: of one field for ``batch`` transmitters.
        pose: of the receiver.
        plane: the receiver's perception plane, see `wrf_mi.splat.perception_plane`.

    Returns:
        Real and imaginary part, arrays [batch * height * width], row-major.
    """
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    lists = build_lists(footprints, order, plane, gaussians.batch)
    return blend(footprints, gaussians.signal, lists, plane, gaussians.batch, gaussians.opacity, gaussians.attenuation)
