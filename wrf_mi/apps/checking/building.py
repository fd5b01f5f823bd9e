"""Positions against the building that a data set's folder shows: a plan, a mesh or a scene folder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import shapely
import trimesh

from ...core import InputError, Record
from ...core.angles import FloatArray
from ...core.files import listed
from ...scene.folder import FACTS_FILE, XML_FILE
from ...scene.make import has_faces
from ...scene.mesh.facets import planes_of_mesh
from ...scene.mesh.files import SUFFIXES, mesh_parts, read_mesh, sound_surfaces
from ...scene.mesh.surfaces import Surface, bodies, box_of
from ...scene.plan.sources import Mask, read_layout
from ...scene.plan.storey import plan_surfaces
from ...scene.positions import LARGEST_SHARE, TOLERATED, TOLERATED_SHARE, conflicts, distinct
from ...tracing.search.devices import winding_number
from .plans import placements
from .rows import named_rows
from .scene_findings import Finding
from .scene_geometry import ShapePart
from .units import Found

LAYOUT = "layout.csv"  # file of wall vertices in a data set's folder
HEIGHT_M = 2.7  # height of the walls of a plan, at which positions are not compared
THICKEST_WALL_M = 0.4  # largest distance of the two sides of a wall in a plan
PARALLEL = np.cos(np.radians(5))
DEEP_M = 0.03
"""Least depth within a wall or a solid: what hangs on a surface is at it, with the error of a tape measure."""
AT_VERTEX_M = 1e-3
"""Largest distance from a vertex of a plan that is no coincidence: positions are measured to a centimetre."""
THICKEST_SOLID_M = 1.0  # bodies with all sides longer than this are rooms or buildings, whose inside is air


@dataclass(frozen=True)
class Building:
    """What a folder shows of the building.

    Attributes:
        source: file or folder of the building.
        surfaces: floors, ceilings, walls and others.
        solids: triangles [f, 3, 3] of each closed body that is thinner than `THICKEST_SOLID_M`.
        walls_m: stretches [n, 2, 2] of the walls of a plan; none for a mesh.
    """

    source: Path
    surfaces: Sequence[Surface]
    solids: Sequence[FloatArray]
    walls_m: FloatArray


def building_file(source: str | Path) -> Path | None:
    """The plan, mesh or scene folder that belongs to the data of a file or folder; None without a single one.

    That of a file is a mesh with its name; that of a folder is `LAYOUT`, the only scene folder, or the only mesh.
    """
    path = Path(source)
    if path.is_file():
        return next(filter(Path.is_file, map(path.with_suffix, SUFFIXES)), None)
    if not path.is_dir():
        return None
    if (path / LAYOUT).is_file():
        return path / LAYOUT
    scenes = [facts.parent for facts in sorted(path.glob(f"*/{FACTS_FILE}")) if (facts.parent / XML_FILE).is_file()]
    candidates = scenes or list(filter(has_faces, sorted(path.iterdir())))
    return candidates[0] if len(candidates) == 1 else None


def read_building(path: Path) -> Building:
    """Read a plan, a mesh or a scene folder; `InputError` for one that is not readable."""
    if path.name == LAYOUT:
        vertices = read_layout(path)
        walls = np.stack([vertices[:-1], vertices[1:]], axis=1)
        return Building(path, plan_surfaces(vertices, height_m=HEIGHT_M, name=str(path)), (), walls)
    raw = _scene_surfaces(path) if path.is_dir() else read_mesh(path)
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in raw])
    closed = [body for body in bodies(corners) if body.closed and body.volume_m3]
    solids = [body.corners_m for body in closed if np.ptp(body.bounds_m, axis=0).min() <= THICKEST_SOLID_M]
    return Building(path, planes_of_mesh(raw), solids, np.empty((0, 2, 2)))


def _scene_surfaces(folder: Path) -> Sequence[Surface]:
    """Surfaces of a scene folder, whose extent together is a building's; pieces of furniture are smaller than rooms."""
    parts = [part for file in sorted((folder / "meshes").glob("*.ply")) for part in mesh_parts(file)]
    if not parts:
        raise InputError(f"{folder}: a scene folder without faces in meshes/*.ply; write the scene anew")
    return sound_surfaces(parts, 1.0, folder)


def plan_against_walls(record: Record, building: Building) -> Found:
    """Transmitters outside the building or across its walls, and the plan in which they are not."""
    if not record.has_positions or not any(surface.kind == "wall" for surface in building.surfaces):
        return
    count = len(distinct(record.tx_pos_m))
    crossings, outside = conflicts(record.tx_pos_m, building.surfaces)
    middle = box_of(building.surfaces).mean(axis=0)[:2]
    tolerated = TOLERATED + TOLERATED_SHARE * count
    text = f"{crossings} lines between neighbouring transmitters cross walls of {building.source.name}"
    text += f" and {outside} of {count} transmitters lie outside"
    others = [(conflicts(other.positions_m, building.surfaces), other) for other in placements(record.tx_pos_m, middle)]
    (crossed, beyond), best = min(others, key=lambda pair: sum(pair[0]))
    allowed = tolerated + LARGEST_SHARE * count
    if crossed + beyond <= allowed and crossings + outside > 2 * (crossed + beyond) + tolerated:
        yield "walls", f"{text}, and {crossed} and {beyond} if {best.motion}; {best.remedy}"
    elif crossings + outside > allowed:
        yield "walls", f"{text}; give positions and building in one frame"


def inside_solids(record: Record, building: Building) -> Found:
    """Receivers and transmitters within walls and solid bodies; a few transmitters are errors of their positions."""
    groups = {"transmitters": record.tx_pos_m, "receivers": np.stack([r.position_m for r in record.receivers])}
    for what, places in groups.items():
        known = np.flatnonzero(np.isfinite(places).all(axis=1))
        within = np.zeros(len(known), bool)
        for solid in building.solids:
            within |= in_solid(places[known], solid)
        within |= in_wall(places[known, :2], building.walls_m)
        rows = known[within]
        if len(rows) <= (TOLERATED_SHARE * len(places) if what == "transmitters" else 0):
            continue
        names = named_rows(rows) if what == "transmitters" else listed(record.receivers[k].name for k in rows)
        text = f"{len(rows)} of {len(places)} {what} lie inside walls or solids of {building.source.name}: {names}"
        yield "inside-solids", f"{text}; correct their positions, or the frame of the building"


def at_vertices(record: Record, building: Building) -> Found:
    """Receivers at the vertices of a plan: points of the drawing in place of measured positions."""
    if not len(building.walls_m):
        return
    vertices = building.walls_m.reshape(-1, 2)
    places = [(receiver.name, *receiver.position_m[:2]) for receiver in record.receivers]
    away = [np.linalg.norm(vertices - place, axis=1).min() for _, *place in places]
    named = [f"{name} at ({x:g}, {y:g})" for (name, x, y), m in zip(places, away, strict=True) if m <= AT_VERTEX_M]
    if named:
        text = f"{len(named)} of {len(record.receivers)} receivers are at vertices of walls in {building.source.name}"
        yield "wall-vertices", f"{text}: {listed(named)}; give the antenna's position, in front of the wall"


def in_wall(places_m: FloatArray, walls_m: FloatArray) -> Mask:
    """Which places [n, 2] lie between two parallel stretches of wall [m, 2, 2] as far apart as a wall is thick."""
    inside = np.zeros(len(places_m), bool)
    length = np.linalg.norm(walls_m[:, 1] - walls_m[:, 0], axis=1)
    walls, length = walls_m[length > 0], length[length > 0]
    along = (walls[:, 1] - walls[:, 0]) / length[:, None]
    # Way along each stretch and distance to its left, [n, m].
    to = places_m[:, None] - walls[:, 0]
    foot, side = (to * along).sum(axis=-1), to[..., 1] * along[:, 0] - to[..., 0] * along[:, 1]
    near = (foot >= 0) & (foot <= length) & (np.abs(side) >= DEEP_M)
    for i, j in combinations(range(len(walls)), 2):
        cosine = along[i] @ along[j]
        if abs(cosine) > PARALLEL:
            between = side[:, i] * side[:, j] * cosine < 0  # the left of a wall is the right of one that runs back
            thin = np.abs(side[:, i]) + np.abs(side[:, j]) <= THICKEST_WALL_M
            inside |= near[:, i] & near[:, j] & between & thin
    return inside


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
        known = np.flatnonzero(np.isfinite(positions).all(axis=1))
        floorless = without_floor(positions[known], np.concatenate([part.corners_m for part in parts]))
        # Few: else the scene has no floor, as a model of facades.
        if TOLERATED_SHARE * len(known) < floorless.sum() < len(known) / 2:
            text = f"{floorless.sum()} of {len(positions)} {what} inside the scene, first number "
            text += f"{known[floorless.argmax()] + 1}, have no floor below"
            remedy = "close the outer walls in the plan, or correct the positions; maps and plans leave such places out"
            yield Finding("no-floor", path, "", text, remedy)
        for name, body in solids:
            if np.ptp(body.bounds_m, axis=0).min() > THICKEST_SOLID_M:
                continue
            if rows := known[in_solid(positions[known], body.corners_m)].tolist():
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
