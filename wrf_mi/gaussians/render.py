"""Splatting of a field on a receiver's perception plane."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from ..backend.vectors import Pose
from .blend import blend
from .footprint import depth_order, project
from .parameters import Gaussians
from .tiles import Plane, build_lists


def splat(gaussians: Gaussians, pose: Pose, plane: Plane) -> tuple[Any, Any]:
    """Received complex signal per direction for each transmitter of the batch.

    Args:
        gaussians: Gaussians of one field for ``batch`` transmitters.
        pose: pose of the receiver.
        plane: the receiver's perception plane, see `wrf_mi.gaussians.tiles.perception_plane`.

    Returns:
        Real and imaginary part, arrays [batch * height * width], row-major.
    """
    batch, signal = gaussians.batch, gaussians.signal
    if not gaussians.count:
        dark = type(gaussians.position[0])
        return dr.zeros(dark, batch * plane.pixels), dr.zeros(dark, batch * plane.pixels)
    # One geometry for all transmitters is projected once.
    gaussians = replace(gaussians, batch=1) if gaussians.shared else gaussians.spread()
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    lists = build_lists(footprints, order, plane, gaussians.batch)
    return blend(footprints, signal, lists, plane, batch, gaussians.blending)
