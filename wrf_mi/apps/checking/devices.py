"""Receivers and transmitters of a data set against the triangles of a scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import shapely
import trimesh

from ...core import Record
from ...core.angles import FloatArray
from ...scene.mesh.surfaces import bodies
from ...scene.plan.grid import Mask
from ...scene.positions import TOLERATED_SHARE
from ...tracing.search.devices import winding_number
from .scene_findings import Finding
from .scene_geometry import ShapePart

DEEP_M = 0.03
"""Least depth within a solid: what hangs on a surface is at it, with the error of a tape measure."""
THICKEST_SOLID_M = 1.0  # bodies with all sides longer than this are rooms or buildings, whose inside is air


def in_solid(places_m: FloatArray, body_m: FloatArray) -> Mask:
    """Which places [n, 3] lie at least `DEEP_M` inside a closed body of triangles [f, 3, 3]."""
    inside = np.zeros(len(places_m), bool)
    low, high = body_m.min(axis=(0, 1)) + DEEP_M, body_m.max(axis=(0, 1)) - DEEP_M
    near = np.flatnonzero(((places_m >= low) & (places_m <= high)).all(axis=1))
    near = near[winding_number(body_m, places_m[near]) > 0.5]
    if len(near):
        body = trimesh.Trimesh(**trimesh.triangles.to_kwargs(body_m), process=False)
        _, depth_m, _ = trimesh.proximity.closest_point_naive(body, places_m[near])
        inside[near] = depth_m >= DEEP_M
    return inside


def device_findings(parts: Sequence[ShapePart], path: Path, record: Record) -> Iterator[Finding]:
    """Devices of a record inside closed bodies that are no rooms, and beside the floor of a scene that has one."""
    places = {"transmitters": record.tx_pos_m, "receivers": np.stack([r.position_m for r in record.receivers])}
    solids = [(part.name, body) for part in parts for body in bodies(part.corners_m) if body.closed]
    for what, positions in places.items():
        placed = np.flatnonzero(np.isfinite(positions).all(axis=1))
        floorless = without_floor(positions[placed], np.concatenate([part.corners_m for part in parts]))
        # Few: else the scene has no floor, as a model of facades.
        if TOLERATED_SHARE * len(placed) < floorless.sum() < len(placed) / 2:
            text = f"{floorless.sum()} of {len(positions)} {what} inside the scene, first number "
            text += f"{placed[floorless.argmax()] + 1}, have no floor below"
            remedy = "close the outer walls in the plan, or correct the positions; maps and plans leave such places out"
            yield Finding("no-floor", path, "", text, remedy)
        for name, body in solids:
            if np.ptp(body.bounds_m, axis=0).min() > THICKEST_SOLID_M:
                continue
            if rows := placed[in_solid(positions[placed], body.corners_m)].tolist():
                text = f"{len(rows)} of {len(positions)} {what} inside, first number {rows[0] + 1}"
                yield Finding("device-inside", path, name, text, "correct the positions, or the scene's frame")


def without_floor(places_m: FloatArray, triangles: FloatArray) -> Mask:
    """Which places [n, 3] within the box around triangles [f, 3, 3], seen from above, have none of them below."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    within = ((places_m[:, :2] >= low[:2]) & (places_m[:, :2] <= high[:2])).all(axis=1)
    flat = shapely.polygons(triangles[..., :2])
    level = triangles[shapely.area(flat) > 0]
    tree = shapely.STRtree(flat[shapely.area(flat) > 0])
    place, triangle = tree.query(shapely.points(places_m[:, :2]), predicate="intersects")
    below = level[triangle, :, 2].min(axis=1) <= places_m[place, 2]
    within[place[below]] = False
    return within
