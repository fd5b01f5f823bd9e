"""Faces of a scene as closed screens: enlarged a little at free and sharp edges, so that no ray passes at a seam.

Rays in single precision miss triangles that they meet on an edge, and sheets that were modelled one by one may leave a
gap of rounding at their seam. A wave that meets an edge counts as meeting its surface (`visibility`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from ...core.angles import FloatArray
from ...scene.surfaces import shared_edges

ENLARGED = 4e-5
"""Distance by which faces are enlarged, as a share of `scale_m`: 0.4 mm at 10 m. Four times as far as positions are
displaced (`images.DISPLACED`), so that a path through a free edge stays blocked when displaced."""
OVERLAP = 5e-7
"""The same at edges at which a face goes on in another: eight times the rounding of a coordinate in single precision,
by which edges of enlarged faces do not match."""
SMOOTH_COS = np.cos(np.radians(10))
"""Cosine of the bend of two faces up to which one goes on in the other: facets of curved furniture would otherwise
overlap, and waves that pass such a body would meet two facets in place of one."""
FARTHEST = 25.0
"""Largest scale by that about the middle of the scene: a room at 10 km from the origin keeps its doors."""
MOST_AT_CORNER = 8.0
"""Largest distance of an enlarged corner from the corner, in units of the enlargement: corners of slivers reach to
infinity."""


def scale_m(triangles: FloatArray, centre_m: FloatArray) -> float:
    """Largest coordinate of triangles [f, 3, 3] plus 1 m: the rounding of their corners in files grows with it.

    Far from the origin it is bounded by `FARTHEST` times the same about the middle [3] of the scene.
    """
    stated, centred = (1.0 + float(np.abs(part).max(initial=0.0)) for part in (triangles, triangles - centre_m))
    return min(stated, FARTHEST * centred)


def screens(triangles: FloatArray, scale_m: float) -> Any:
    """A Mitsuba scene of one mesh for rays, whose primitives are the triangles [f, 3, 3] in their order, enlarged."""
    import mitsuba as mi

    from ...backend.device import on_device

    mesh: Any = mi.Mesh("screens", 3 * len(triangles), len(triangles))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = on_device(enlarged(triangles, scale_m), mi.Float)
    parameters["faces"] = on_device(np.arange(3 * len(triangles)), mi.UInt32)
    parameters.update()
    # Embree's robust mode loses fewer rays at edges; OptiX is watertight as it is.
    return mi.load_dict({"type": "scene", "mesh": mesh, "embree_use_robust_intersections": True})


def enlarged(triangles: FloatArray, scale_m: float) -> FloatArray:
    """Triangles [f, 3, 3] enlarged in their planes by `ENLARGED` at edges that are free, sharp or of three faces.

    At other edges they overlap by rounding. Degenerate triangles stay as they are.
    """
    if not len(triangles):
        return triangles
    along = np.roll(triangles, -1, axis=1) - triangles  # edge k runs from corner k to corner k + 1
    length = np.linalg.norm(along, axis=2, keepdims=True)
    along = np.divide(along, length, out=np.zeros_like(along), where=length > 0)
    incoming = np.roll(along, 1, axis=1)
    sine = np.linalg.norm(np.cross(incoming, along), axis=2, keepdims=True)
    margin = np.where(_smooth(triangles), OVERLAP, ENLARGED)[..., None] * scale_m
    # Both edges at a corner are shifted outwards by their margins: the corner moves to where the shifted lines meet.
    moved = np.roll(margin, 1, axis=1) * -along + margin * incoming
    moved = np.divide(moved, sine, out=np.zeros_like(moved), where=sine > 0)
    farthest = MOST_AT_CORNER * margin.max(initial=0.0)
    size = np.linalg.norm(moved, axis=2, keepdims=True)
    moved *= np.minimum(1.0, np.divide(farthest, size, out=np.ones_like(size), where=size > 0))
    solid = trimesh.triangles.area(triangles) > 0
    return np.where(solid[:, None, None], triangles + moved, triangles)


def _smooth(triangles: FloatArray) -> Any:
    """Mask of edges [f, 3] at which a face goes on in exactly one other face, bent by less than 10 degrees."""
    edge = shared_edges(triangles)[0]
    count = np.bincount(edge)
    order = np.argsort(edge, kind="stable")
    pairs = order[np.repeat(count, count) == 2].reshape(-1, 2)
    # From the edge to the third corner of each of both faces: opposite directions where the faces are in one plane.
    start, end, third = (np.roll(triangles, -k, axis=1).reshape(-1, 3)[pairs] for k in range(3))
    along = end - start
    share = ((third - start) * along).sum(axis=-1, keepdims=True)
    square = (along * along).sum(axis=-1, keepdims=True)
    away = third - start - along * np.divide(share, square, out=np.zeros_like(share), where=square > 0)
    cosine = (away[:, 0] * away[:, 1]).sum(axis=-1)
    sizes = np.linalg.norm(away, axis=-1).prod(axis=1)
    smooth = np.zeros(3 * len(triangles), bool)
    smooth[pairs[cosine < -SMOOTH_COS * sizes]] = True
    return smooth.reshape(-1, 3)
