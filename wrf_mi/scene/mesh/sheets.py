"""Thin solids and doubled faces of meshes as single sheets, as radio materials have a thickness of their own."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import shapely
import trimesh

from ...core.angles import FloatArray
from .planes import Mask, Plane, with_axes
from .surfaces import Surface, bodies, main_extent

logger = logging.getLogger(__name__)

PANEL_M = 0.005
"""Thickness up to which a closed body is a drawn sheet: scanning programs of phones draw walls 1 mm thick."""
SAME_PLANE_M, SAME_NORMAL = 1e-3, 1e-4
"""Steps of the offsets and normals of one plane: copies of a face differ by the rounding of a file."""
COVERED = 0.99  # least share of a triangle's area that lies on faces which look the other way: a copy but for rounding


def as_sheets(surfaces: Sequence[Surface], name: str | Path) -> list[Surface]:
    """Surfaces in which a wall is one sheet: a path would meet both faces of a thin panel, or both copies of a face.

    Closed bodies up to `PANEL_M` thick become the sheet in their middle. Of faces of one plane that look in opposite
    directions and cover the same place, those of the smaller side are left out, but for faces of closed bodies, which
    would be open without the side on which they stand. Both are logged.

    Args:
        surfaces: surfaces of a mesh, metres.
        name: the source in messages.
    """
    flat, is_open, panels = [], list[Mask](), 0
    for surface in surfaces:
        parts = []
        for body in bodies(surface.vertices_m[surface.faces]):
            sheet = _middle(body.corners_m) if body.closed else None
            panels += sheet is not None
            parts.append(body.corners_m if sheet is None else sheet)
            is_open.append(np.full(len(parts[-1]), not body.closed))
        flat.append(np.concatenate(parts))
    if panels:
        logger.warning("%s: %d panels up to %g mm thick are single sheets", name, panels, 1e3 * PANEL_M)
    corners = np.concatenate(flat)
    of_sheets = np.concatenate(is_open)
    copies = np.zeros(len(corners), bool)
    if of_sheets.any():
        copies[of_sheets] = _copies(corners[of_sheets])
    if copies.any():
        logger.warning("%s: %d faces left out, behind which another face looks the other way", name, copies.sum())
    owner = np.repeat(np.arange(len(surfaces)), list(map(len, flat)))
    if not panels and not copies.any():
        return list(surfaces)
    sheets = []
    for number, surface in enumerate(surfaces):
        if (rows := (owner == number) & ~copies).any():
            vertices, faces = np.unique(corners[rows].reshape(-1, 3), axis=0, return_inverse=True)
            sheets.append(replace(surface, vertices_m=vertices, faces=faces.reshape(-1, 3)))
    return sheets


def _middle(corners_m: FloatArray) -> FloatArray | None:
    """One face of a thin closed body, moved to its middle; None for a thicker one."""
    normal, low, high = main_extent(corners_m)
    if high - low > PANEL_M:
        return None
    cross = trimesh.triangles.cross(corners_m)
    front = corners_m[cross @ normal > np.linalg.norm(cross, axis=-1) / 2]
    return np.asarray(front + ((low + high) / 2 - front @ normal)[..., None] * normal)


def _copies(corners_m: FloatArray) -> Mask:
    """Triangles [f] that lie on faces of the same plane that look the other way."""
    copies = np.zeros(len(corners_m), bool)
    for normal, rows, facing in _planes(corners_m):
        plane = with_axes(Plane(normal, float(corners_m[rows[0], 0] @ normal), corners_m[:1], np.zeros(3), 0.0))
        flat = shapely.polygons(plane.flat(corners_m[rows]))
        area = shapely.area(flat)
        # The larger side stays: the other one may be a copy of a part of it.
        larger = area[facing].sum() >= area[~facing].sum()
        behind = facing != larger
        front = shapely.union_all(shapely.make_valid(flat[~behind]), grid_size=0.1 * SAME_PLANE_M)
        shared = shapely.area(shapely.intersection(flat[behind], front))
        copies[rows[behind][shared >= COVERED * area[behind]]] = True
    return copies


def _planes(corners_m: FloatArray) -> Iterator[tuple[FloatArray, np.ndarray, Mask]]:
    """Planes with faces of both directions: normal, numbers of their triangles, and which look along the normal."""
    cross = trimesh.triangles.cross(corners_m)
    normals = cross / np.linalg.norm(cross, axis=-1, keepdims=True)
    # Rounded normals and offsets are keys: comparing all pairs of faces would grow with their square.
    leading = np.take_along_axis(normals, np.abs(normals).argmax(axis=1)[:, None], axis=1)
    upward = normals * np.sign(leading)  # one direction for both sides of a plane
    offset = np.einsum("fk,fk->f", corners_m.mean(axis=1), upward)
    keys = np.round(np.column_stack([upward / SAME_NORMAL, offset / SAME_PLANE_M])).astype(np.int64)
    _, plane = np.unique(keys, axis=0, return_inverse=True)
    plane = plane.reshape(-1)
    along = leading[:, 0] > 0
    both = (np.bincount(plane, along) > 0) & (np.bincount(plane, ~along) > 0)
    order = np.argsort(plane, kind="stable")
    for rows in np.split(order, np.cumsum(np.bincount(plane))[:-1]):
        if both[plane[rows[0]]]:
            yield upward[rows[0]], rows, along[rows]
