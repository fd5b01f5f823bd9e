"""The surfaces of a scene in the two views of `wrf_mi.scene.preview`: at a slant without the ceiling, and in plan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection

from ..core.angles import FloatArray
from .surfaces import Surface

ELEVATION_DEG, AZIMUTH_DEG = 48.0, -60.0
"""From where the slanted view looks."""
LIGHT = np.array([0.35, -0.5, 0.79])
CUT = 0.45
"""Share of the height at which the plan is cut."""
TOP = 0.8
"""Level faces above this share of the height are taken off like a ceiling."""
MOST_FACES = 20_000
WHOLE_FACES = 50


def extent(surfaces: Sequence[Surface]) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest coordinates of all vertices, two arrays [3]."""
    vertices = np.concatenate([surface.vertices_m for surface in surfaces])
    return vertices.min(axis=0), vertices.max(axis=0)


def toward_viewer() -> FloatArray:
    """Unit vector from the scene to the eye of the slanted view."""
    elevation, azimuth = np.radians([ELEVATION_DEG, AZIMUTH_DEG])
    flat = np.cos(elevation)
    return np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])


def draw_slant(
    axes: Any, surfaces: Sequence[Surface], colours: Sequence[str], low: FloatArray, high: FloatArray
) -> None:
    """Faces without the ceiling, lit from one side; walls in front are glassy."""
    middle, eye = (low + high) / 2, toward_viewer()
    # One empty part each, so that a scene of ceilings alone draws nothing.
    faces, rgba, floor = [np.empty((0, 3, 3))], [np.empty((0, 4))], [np.empty(0, bool)]
    for surface, colour in zip(surfaces, colours, strict=True):
        if surface.kind == "ceiling":
            continue
        corners = surface.vertices_m[surface.faces]
        normal = _normals(corners)
        normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
        level = np.abs(normal[:, 2]) > 0.9
        centre = corners.mean(axis=1)
        kept = ~(level & (centre[:, 2] > low[2] + TOP * (high[2] - low[2])) & (surface.kind != "floor"))
        light = 0.55 + 0.45 * np.abs(normal @ LIGHT)
        if surface.kind == "floor":
            front = np.zeros(len(corners), bool)
        else:
            # A wall fades as one; a large body that holds a whole room fades face by face.
            where = centre if len(centre) > WHOLE_FACES else np.broadcast_to(centre.mean(axis=0), centre.shape)
            front = (where - middle)[:, :2] @ eye[:2] > 0.05 * np.linalg.norm(high - low)
        shade = np.clip(light[:, None] * to_rgb(colour), 0, 1)
        faces.append(corners[kept])
        rgba.append(np.column_stack([shade, np.where(front & ~level, 0.16, 0.95)])[kept])
        floor.append(np.full(np.count_nonzero(kept), surface.kind == "floor"))
    corners, shades, is_floor = np.concatenate(faces), np.concatenate(rgba), np.concatenate(floor)
    largest = np.argsort(-np.linalg.norm(_normals(corners), axis=-1))[:MOST_FACES]
    for part, order in ((is_floor[largest], 1), (~is_floor[largest], 2)):
        chosen = largest[part]
        if len(chosen):
            axes.add_collection3d(
                Poly3DCollection(
                    corners[chosen], facecolors=shades[chosen], edgecolors="none", antialiaseds=False, zorder=order
                )
            )
    _rims(axes, surfaces)
    axes.set_proj_type("ortho")
    axes.view_init(ELEVATION_DEG, AZIMUTH_DEG)
    size = np.maximum(high - low, 0.1)
    for setter, a, s in zip((axes.set_xlim, axes.set_ylim, axes.set_zlim), low, size, strict=True):
        setter(a, a + s)
    axes.set_box_aspect(size, zoom=0.98)
    axes.set_xlabel("x (m)", fontsize=8)
    axes.set_ylabel("y (m)", fontsize=8)
    axes.set_zlabel("z (m)", fontsize=8, labelpad=-4)
    axes.tick_params(labelsize=7, pad=0)
    axes.zaxis.set_major_locator(MaxNLocator(3))
    axes.grid(False)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((1, 1, 1, 0))


def _normals(corners: FloatArray) -> FloatArray:
    """Normals of triangles [f, 3, 3], as long as twice their areas."""
    return np.asarray(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))


def _rims(axes: Any, surfaces: Sequence[Surface]) -> None:
    """Thin lines along the free edges of walls and floors, which make the corners readable."""
    rims = []
    for surface in surfaces:
        if surface.kind == "ceiling" or len(surface.faces) > 500:
            continue
        edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edge, count = np.unique(edges, axis=0, return_counts=True)
        rims.append(surface.vertices_m[edge[count == 1]])
    # Closed bodies have no free edge.
    if any(len(lines) for lines in rims):
        axes.add_collection3d(
            Line3DCollection(np.concatenate(rims), colors="#2b2d42", linewidths=0.5, alpha=0.7, zorder=3)
        )


def draw_plan(
    axes: Axes, surfaces: Sequence[Surface], colours: Sequence[str], low: FloatArray, high: FloatArray
) -> None:
    """The floor, and a cut through everything that stands on it."""
    level = float(low[2] + CUT * (high[2] - low[2]))
    for surface, colour in zip(surfaces, colours, strict=True):
        if surface.kind == "floor":
            triangles = surface.vertices_m[surface.faces][..., :2]
            light = 0.45 * np.array(to_rgb(colour)) + 0.55
            axes.add_collection(
                PolyCollection(list(triangles), facecolors=[light], edgecolors="none", antialiased=False, zorder=1)
            )
            continue
        mesh = trimesh.Trimesh(surface.vertices_m, surface.faces, process=False)
        cut = trimesh.intersections.mesh_plane(mesh, [0, 0, 1], [0, 0, level])
        if len(cut):
            edge = tuple(0.6 * c for c in to_rgb(colour))
            axes.add_collection(
                LineCollection(list(cut[..., :2]), colors=[edge], linewidths=2.2, capstyle="round", zorder=3)
            )
    size = np.maximum(high - low, 0.1)[:2]
    margin = 0.06 * size.max()
    axes.set_xlim(low[0] - margin, low[0] + size[0] + margin)
    axes.set_ylim(low[1] - 2 * margin, low[1] + size[1] + margin)
    axes.set_aspect("equal")
    axes.set_xlabel("x (m)", fontsize=8)
    axes.set_ylabel("y (m)", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.set_title(f"plan, cut at z = {level:.2g} m", fontsize=9)
    bar = max((b for b in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if b <= size[0] / 3), default=0.1)
    corner = low[0], low[1] - 1.35 * margin
    axes.add_patch(Rectangle(corner, bar, 0.25 * margin, color="black", zorder=9))
    axes.annotate(f"{bar:g} m", (low[0] + bar, corner[1]), (4, 0), textcoords="offset points", fontsize=8)
