"""From a field to what a receiver's perception plane sees, by splatting."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr

from .blend import blend
from .blend_batched import blend_shared
from .footprint import Pose, depth_order, project
from .parameters import Gaussians
from .skip import NOTHING, Skip, behind, negligible
from .tiles import Plane, build_lists


def splat(gaussians: Gaussians, pose: Pose, plane: Plane, skip: Skip = NOTHING) -> tuple[Any, Any]:
    """Received complex signal per direction for each transmitter of the batch.

    Args:
        gaussians: of one field for ``batch`` transmitters.
        pose: of the receiver.
        plane: the receiver's perception plane, see `wrf_mi.gaussians.perception_plane`.
        skip: what is not evaluated, with bounds on the error.

    Returns:
        Real and imaginary part, arrays [batch * height * width], row-major.
    """
    if not gaussians.count:
        dark = type(gaussians.position[0])
        return dr.zeros(dark, gaussians.batch * plane.pixels), dr.zeros(dark, gaussians.batch * plane.pixels)
    if gaussians.shared and not skip.error:
        one = replace(gaussians, batch=1)
        seen_once = project(one, pose)
        order = depth_order(seen_once.depth, gaussians.position)
        lists = build_lists(seen_once, order, plane, 1, skip.boxes)
        own = (gaussians.opacity, gaussians.attenuation)
        return blend_shared(seen_once, gaussians.signal, lists, plane, gaussians.batch, *own)
    gaussians = gaussians.spread()
    footprints = project(gaussians, pose)
    order = depth_order(footprints.depth, gaussians.position)
    parts = (gaussians.opacity, gaussians.attenuation)
    reach = None
    if skip.error:
        seen, product = footprints.visible, gaussians.attenuation is not None
        sent, beyond = behind(gaussians.signal, seen, order, gaussians.batch, product)
        if skip.contribution:
            small = negligible(gaussians.signal, beyond, gaussians.batch, skip.contribution, *parts)
            footprints.visible = seen & ~small
        if skip.early_stop_tolerance:
            reach = sent * (1 / skip.early_stop_tolerance)
    lists = build_lists(footprints, order, plane, gaussians.batch, skip.boxes)
    return blend(footprints, gaussians.signal, lists, plane, gaussians.batch, *parts, reach)
