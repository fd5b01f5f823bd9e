"""A picture of a scene in two views: from above at a slant without the ceiling, and in plan.

Surfaces, the scan they were made from, traced paths and the Gaussians of a field are drawn in both.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import trimesh
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.transforms import Affine2D
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from numpy.typing import ArrayLike, NDArray

from ..core.angles import FloatArray, rotation_matrix, unit_vectors
from ..core.paths import Paths
from . import drawing
from .mesh.surfaces import Surface, box_of, cut_lines
from .plan.pictures import PlanDrawing

KIND_COLOURS = {"floor": "#cfc6b8", "ceiling": "#e8e8e4", "wall": "#7d9cb5", "other": "#c58f5c"}
MOST_POINTS, MOST_GAUSSIANS, MOST_PATHS = 20_000, 3_000, 300
"""Points are thinned to their number; of the others the strongest or largest are drawn."""
OUTLINE_POINTS = 20
SPAN_DB = 40.0  # range of the colours below the strongest
EYE = unit_vectors(*np.radians([drawing.AZIMUTH_DEG, drawing.ELEVATION_DEG]))  # from the scene to the viewer
LIGHT = np.array([0.35, -0.5, 0.79])
CUT = 0.45  # share of the height at which the plan is cut
TOP = 0.8  # level faces above this share of the height are taken off like a ceiling
MATERIAL_COLOURS = {
    **{"itu_concrete": "#8a8f98", "itu_brick": "#b5523b", "itu_plasterboard": "#9fb8d0", "itu_wood": "#b98b4e"},
    **{"itu_glass": "#35b5c9", "itu_metal": "#4a4e69", "itu_ceiling_board": "#d8d5c7", "itu_marble": "#c9b7d8"},
}
"""Colours of materials that are not those of most surfaces of their kind; of others, `OTHER_COLOUR`."""
OTHER_COLOUR = "#6a994e"
FLOOR_ALPHA = 0.45  # of the floor above the picture of a plan
WHOLE_FACES = 50
MOST_NAMED = 40  # number of walls up to which the plan has their names
MOST_OUTLINED = 500  # number of faces above which a surface is drawn without its free edges
CREASE_RAD = 0.5  # angle between the normals of two faces from which their common edge is a crease


@dataclass(frozen=True)
class GaussianCloud:
    """Gaussians for a picture.

    Attributes:
        position_m: centres [n, 3].
        scale_m: standard deviations along the Gaussians' axes [n, 3].
        rotation_xyzw: quaternions, Gaussians' axes to world [n, 4].
        strength_db: value that colours them, [n]; for example 20 log10 of the signal's magnitude.
    """

    position_m: FloatArray
    scale_m: FloatArray
    rotation_xyzw: FloatArray
    strength_db: FloatArray

    def strongest(self, count: int) -> GaussianCloud:
        """The ``count`` strongest, weakest first, so that the strong are drawn last."""
        order = np.argsort(self.strength_db, kind="stable")[-count:]
        return GaussianCloud(**{key: np.asarray(value)[order] for key, value in vars(self).items()})

    def silhouettes(self, across: FloatArray) -> FloatArray:
        """Outlines [n, points, 2] at one standard deviation in the plane of two unit vectors [2, 3]."""
        axes = across @ (rotation_matrix(self.rotation_xyzw) * self.scale_m[:, None, :])
        half = np.linalg.cholesky(axes @ np.swapaxes(axes, -1, -2) + 1e-12 * np.eye(2))
        turn = np.linspace(0, 2 * np.pi, OUTLINE_POINTS)
        return np.swapaxes(half @ np.stack([np.cos(turn), np.sin(turn)]), -1, -2)


def draw_scene(
    surfaces: Sequence[Surface],
    *,
    materials: Mapping[str, str] | None = None,
    drawing_below: PlanDrawing | None = None,
    positions_m: ArrayLike | None = None,
    points_m: ArrayLike | None = None,
    paths: Paths | None = None,
    transmitters_m: ArrayLike | None = None,
    receivers_m: ArrayLike | None = None,
    gaussians: GaussianCloud | None = None,
    title: str = "",
) -> Figure:
    """A scene at a slant and in plan, with a scan, paths, both ends of these, or Gaussians.

    `ValueError`: no surface, or paths without both ends.

    Args:
        surfaces: surfaces of the scene, at least one.
        materials: material of each surface by its name, for colours and legend.
        drawing_below: plan that the scene was made of, below the scene's.
        positions_m: measured positions [n, 2] or [n, 3].
        points_m: a scan [n, 3] or [n, 2].
        paths: traced paths; the strongest `MOST_PATHS` are drawn, with ``transmitters_m`` and ``receivers_m``.
        transmitters_m: shape [n_tx, 3].
        receivers_m: shape [n_rx, 3].
        gaussians: Gaussians of a field.
        title: text above the picture.
    """
    if not surfaces:
        raise ValueError("draw_scene: no surface")
    ends = [None if p is None else np.asarray(p, float).reshape(-1, 3) for p in (transmitters_m, receivers_m)]
    figure = Figure(figsize=(12.5, 5.8), layout="constrained")
    grid = figure.add_gridspec(1, 2, width_ratios=[1.2, 1])
    slant: Any = figure.add_subplot(grid[0], projection="3d", computed_zorder=False)
    plan = figure.add_subplot(grid[1])
    low, high = box_of(surfaces)
    colours, patches = _colours_of(surfaces, materials or {})
    _draw_slant(slant, surfaces, colours, low, high)
    if drawing_below is not None:
        _draw_below(plan, drawing_below)
    _draw_plan(plan, surfaces, colours, low, high, 1.0 if drawing_below is None else FLOOR_ALPHA)
    if points_m is not None:
        _draw_scan(slant, plan, np.asarray(points_m, float), low[2] + TOP * (high[2] - low[2]))
    if gaussians is not None:
        _draw_gaussians(figure, slant, plan, gaussians.strongest(MOST_GAUSSIANS))
    if paths is not None:
        _draw_paths(figure, slant, plan, paths, *ends)
    if positions_m is not None:
        how: dict[str, Any] = {"marker": ".", "markersize": 3, "linestyle": "none", "color": "#c1121f", "zorder": 7}
        patches += plan.plot(*np.asarray(positions_m, float).T[:2], label="position", **how)
    figure.legend(
        handles=[*patches, *_draw_ends(slant, plan, ends)],
        fontsize=8,
        loc="outside lower center",
        ncols=8,
        frameon=False,
    )
    figure.suptitle(title, fontsize=10)
    return figure


def _colours_of(surfaces: Sequence[Surface], materials: Mapping[str, str]) -> tuple[dict[str, FloatArray], list[Any]]:
    """Colour [3] of each surface by its name, and patches of the legend.

    Those of the most frequent material of a kind have the kind's colour, others that of their material.
    """
    pairs = Counter((surface.kind, materials.get(surface.name, "")) for surface in surfaces)
    usual = {kind: material for (kind, material), _ in reversed(pairs.most_common())}
    chosen = {
        (kind, material): KIND_COLOURS[kind]
        if usual[kind] == material
        else MATERIAL_COLOURS.get(material, OTHER_COLOUR)
        for kind, material in pairs
    }
    patches = [
        Patch(facecolor=colour, edgecolor="0.3", linewidth=0.5, label=f"{kind}: {material}" if material else kind)
        for (kind, material), colour in chosen.items()
        if kind != "ceiling"
    ]
    colours = {each.name: np.array(to_rgb(chosen[each.kind, materials.get(each.name, "")])) for each in surfaces}
    return colours, patches


def _draw_below(plan: Axes, below: PlanDrawing) -> None:
    """The plan that a scene was made of, below all else."""
    to_scene = Affine2D(below.motion[np.ix_([0, 1, 3], [0, 1, 3])]) + plan.transData
    if below.pixels is not None:
        (x0, y0), (x1, y1) = below.box_m
        plan.imshow(below.pixels, extent=(x0, x1, y0, y1), transform=to_scene, zorder=0.5)
    drawing.draw_outlines(plan, [below.lines_m], colors="0.55", linewidths=0.6, transform=to_scene, zorder=0.6)


def _draw_scan(slant: Any, plan: Axes, scan: FloatArray, top_m: float) -> None:
    """Points [n, 2] or [n, 3], at a slant those below a height."""
    if not len(scan):
        return
    scan = scan[:: -(-len(scan) // MOST_POINTS)]
    plan.plot(*scan.T[:2], ",", color="0.35", alpha=0.25, zorder=2)
    if scan.shape[1] == 3:
        slant.plot(*scan[scan[:, 2] < top_m].T, ",", color="0.3", alpha=0.15, zorder=4)


def _draw_ends(slant: Any, plan: Axes, ends: Sequence[FloatArray | None]) -> list[Line2D]:
    """Markers of transmitters and receivers, and their handles for the legend."""
    handles = []
    for points, kind in zip(ends, drawing.ENDS, strict=True):
        if points is not None:
            drawing.draw_devices(slant, kind, points)
            handles.append(drawing.draw_devices(plan, kind, points))
    return handles


def _draw_gaussians(figure: Figure, slant: Any, plan: Axes, cloud: GaussianCloud) -> None:
    """The outline of each Gaussian: an orthographic view keeps Gaussians Gaussian."""
    rgba = _coloured(figure, cloud.strength_db, "signal of a Gaussian (dB)", 0.4)
    right = np.cross([0, 0, 1], EYE) / np.linalg.norm(np.cross([0, 0, 1], EYE))
    screen = np.stack([right, np.cross(EYE, right)])
    outlines = cloud.position_m[:, None] + cloud.silhouettes(screen) @ screen
    slant.add_collection3d(Poly3DCollection(outlines, facecolors=rgba, edgecolors="none", zorder=5))
    flat = cloud.position_m[:, None, :2] + cloud.silhouettes(np.eye(3)[:2])
    plan.add_collection(PolyCollection(list(flat), facecolors=rgba, edgecolors="none", zorder=4))


def _draw_paths(figure: Figure, slant: Any, plan: Axes, paths: Paths, transmitters: Any, receivers: Any) -> None:
    """The strongest paths, the weakest of them first, coloured by 20 log10 of their gains."""
    if transmitters is None or receivers is None:
        raise ValueError("draw_scene: paths need transmitters_m and receivers_m")
    if not len(paths):
        return
    strength = 20 * np.log10(np.maximum(np.abs(paths.gain), 1e-20))
    order = np.argsort(strength, kind="stable")[-MOST_PATHS:]
    corners = [
        np.vstack([transmitters[paths.tx[i]], paths.vertices_m[i][: int(paths.bounces[i])], receivers[paths.rx[i]]])
        for i in order
    ]
    rgba = _coloured(figure, strength[order], "gain of a path (dB)", 0.85)
    slant.add_collection3d(Line3DCollection(corners, colors=rgba, linewidths=0.9, zorder=6))
    plan.add_collection(LineCollection([c[:, :2] for c in corners], colors=rgba, linewidths=0.9, zorder=6))


def _coloured(figure: Figure, strength: FloatArray, label: str, alpha: float) -> FloatArray:
    """Colours [n, 4] of strengths, and their bar in the figure."""
    top = float(np.max(strength))
    colours = drawing.shades(max(float(np.min(strength)), top - SPAN_DB), top + 1e-9)
    drawing.colour_bar(figure, colours, figure.axes[:2], label, shrink=0.6, pad=0.01, aspect=30)
    return colours.to_rgba(strength, alpha=alpha)


def _normals(corners: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Unit normals [f, 3] of triangles, zero for those without an area, and which triangles are level."""
    normals = trimesh.util.unitize(trimesh.triangles.cross(corners))
    return normals, np.abs(normals[:, 2]) > 0.9


def ceiling_faces(surface: Surface, low: FloatArray, high: FloatArray) -> NDArray[np.bool_]:
    """Faces [f] of a surface that hide the inside of a scene between two corners [3] from above: ceilings, level faces
    near the top.
    """
    if surface.kind in ("floor", "ceiling"):
        return np.full(len(surface.faces), surface.kind == "ceiling")
    corners = surface.vertices_m[surface.faces]
    high_up = corners[..., 2].mean(axis=1) > low[2] + TOP * (high[2] - low[2])
    return _normals(corners)[1] & high_up


def free_edges(surface: Surface, creases: bool = False) -> FloatArray:
    """Edges [n, 2, 3] of a surface that bound one face, and perhaps its creases; none of a surface of many faces."""
    if len(surface.faces) > MOST_OUTLINED:
        return np.empty((0, 2, 3))
    edges = np.sort(trimesh.geometry.faces_to_edges(surface.faces), axis=1)
    outer = edges[trimesh.grouping.group_rows(edges, require_count=1)]
    if creases:
        mesh = surface.mesh
        outer = np.concatenate([outer, mesh.face_adjacency_edges[mesh.face_adjacency_angles > CREASE_RAD]])
    return np.asarray(surface.vertices_m[outer], float).reshape(-1, 2, 3)


def _lit_faces(
    surface: Surface, colour: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Corners [f, 3, 3] of faces below the ceiling, and colours [f, 4] lit from the side; walls in front fade."""
    corners = surface.vertices_m[surface.faces]
    (normal, level), centre = _normals(corners), corners.mean(axis=1)
    light = 0.55 + 0.45 * np.abs(normal @ LIGHT)
    # A wall fades as a whole; a large body that holds a whole room fades face by face.
    place = centre if len(centre) > WHOLE_FACES else np.broadcast_to(centre.mean(axis=0), centre.shape)
    front = (place - (low + high) / 2)[:, :2] @ EYE[:2] > 0.05 * np.linalg.norm(high - low)
    alpha = np.where(front & ~level & (surface.kind != "floor"), 0.16, 0.95)
    shade = np.clip(light[:, None] * colour, 0, 1)
    drawn = ~ceiling_faces(surface, low, high)
    return corners[drawn], np.column_stack([shade, alpha])[drawn]


def _draw_slant(
    axes: Any, surfaces: Sequence[Surface], colours: Mapping[str, FloatArray], low: FloatArray, high: FloatArray
) -> None:
    """Faces and free edges without the ceiling."""
    floors = [surface for surface in surfaces if surface.kind == "floor"]
    others = [surface for surface in surfaces if surface.kind not in ("floor", "ceiling")]
    for order, group in enumerate((floors, others), start=1):
        # The empty part serves groups without surfaces.
        lit = [
            (np.empty((0, 3, 3)), np.empty((0, 4))),
            *(_lit_faces(surface, colours[surface.name], low, high) for surface in group),
        ]
        corners, shades = map(np.concatenate, zip(*lit, strict=True))
        drawing.draw_faces(axes, corners, shades, zorder=order)
    # Thin lines along the free edges of walls and floors make the corners readable; closed bodies have none.
    if len(lines := np.concatenate([np.empty((0, 2, 3)), *map(free_edges, floors + others)])):
        axes.add_collection3d(Line3DCollection(lines, colors="#2b2d42", linewidths=0.5, alpha=0.7, zorder=3))
    drawing.set_box(axes, low, high)
    axes.set_title("ceiling not drawn, walls in front transparent", fontsize=9)
    axes.zaxis.labelpad = -8


def _draw_plan(
    axes: Axes,
    surfaces: Sequence[Surface],
    colours: Mapping[str, FloatArray],
    low: FloatArray,
    high: FloatArray,
    floor_alpha: float,
) -> None:
    """The floor, and a cut through everything that stands on it, with the names of few walls."""
    level = float(low[2] + CUT * (high[2] - low[2]))
    named = sum(surface.kind == "wall" for surface in surfaces) <= MOST_NAMED
    for surface in surfaces:
        colour = colours[surface.name]
        if surface.kind == "floor":
            triangles = surface.vertices_m[surface.faces][..., :2]
            flat: dict[str, Any] = {"edgecolors": "none", "antialiased": False, "zorder": 1}
            axes.add_collection(
                PolyCollection(list(triangles), facecolors=[[*(0.45 * colour + 0.55), floor_alpha]], **flat)
            )
        elif len(cut := cut_lines(surface, level)):
            drawing.draw_outlines(axes, [cut], colors=[0.6 * colour], linewidths=2.2, zorder=3)
            if named and surface.kind == "wall":
                _draw_name(axes, surface.name, cut)
    size = np.maximum(high - low, 0.1)[:2]
    margin = 0.06 * size.max()
    drawing.set_plan(axes, low[:2] - margin * np.array([1, 2]), low[:2] + size + margin)
    axes.set_title(f"plan, cut at z = {level:.1f} m", fontsize=9)
    bar = max((b for b in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if b <= size[0] / 3), default=0.1)
    corner = low[0], low[1] - 1.35 * margin
    axes.add_patch(Rectangle(corner, bar, 0.25 * margin, color="black", zorder=9))
    axes.annotate(f"{bar:g} m", (low[0] + bar, corner[1]), (4, 0), textcoords="offset points", fontsize=8)


def _draw_name(axes: Axes, name: str, cut: FloatArray) -> None:
    """Write a wall's name along its cut [n, 2, 2], in the middle."""
    start, end = max(cut, key=lambda line: float(np.linalg.norm(line[1] - line[0])))
    angle = (np.degrees(np.arctan2(*(end - start)[::-1])) + 90) % 180 - 90  # never upside down
    corners = cut.reshape(-1, 2)
    along = corners @ (end - start)  # a wall of several faces is cut into as many lines
    middle = (corners[along.argmin()] + corners[along.argmax()]) / 2
    box = {"boxstyle": "square,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.8}
    at = {"ha": "center", "va": "center", "rotation": angle, "rotation_mode": "anchor", "zorder": 9}
    axes.text(middle[0], middle[1], name, fontsize=6, bbox=box, parse_math=False, **at)
