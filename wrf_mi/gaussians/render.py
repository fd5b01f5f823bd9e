"""Splatting of a field on a receiver's perception plane."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from .blend import blend
from .footprint import Pose, depth_order, project
from .parameters import Gaussians
from .skip import NOTHING, Skip, negligible, signal_bounds
from .tiles import Plane, build_lists


def splat(gaussians: Gaussians, pose: Pose, plane: Plane, skip: Skip = NOTHING) -> tuple[Any, Any]:
    """Received complex signal per direction for each transmitter of the batch.

    Args:
        gaussians: Gaussians of one field for ``batch`` transmitters.
        pose: pose of the receiver.
        plane: the receiver's perception plane, see `wrf_mi.gaussians.tiles.perception_plane`.
        skip: parts that are not evaluated, with bounds on the error.

    Returns:
        Real and imaginary part, arrays [batch * height * width], row-major.
    """
    batch, signal = gaussians.batch, gaussians.signal
    if not gaussians.count:
        dark = type(gaussians.position[0])
        return dr.zeros(dark, batch * plane.pixels), dr.zeros(dark, batch * plane.pixels)
    # One geometry for all transmitters is projected once, but bounds of signals differ between transmitters.
    gaussians = replace(gaussians, batch=1) if gaussians.shared and not skip.error else gaussians.spread()
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    reach = None
    if skip.error:
        seen, blending = footprints.visible, gaussians.blending
        sent, beyond = signal_bounds(signal, seen, order, batch, product=len(blending) == 2)
        if skip.contribution:
            footprints.visible = seen & ~negligible(signal, beyond, batch, skip.contribution, blending)
        if skip.early_stop_tolerance:
            reach = sent * (1 / skip.early_stop_tolerance)
    lists = build_lists(footprints, order, plane, gaussians.batch)
    return blend(footprints, signal, lists, plane, batch, gaussians.blending, reach)
