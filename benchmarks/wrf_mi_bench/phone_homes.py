"""Furnished rooms and flats with known truth, and a phone's scan of them.

The scan is made as phones make theirs: depth pictures from a walk, fused in a truncated signed distance function
(Curless and Levoy 1996, SIGGRAPH) of which triangles of some centimetres are taken, so that corners are round,
furniture is melted into walls and the floor, and what was not seen is a hole. The frame is that of the phone: y up,
not quite level, turned at random, origin where it was switched on; poses drift. Glass returns nothing, a mirror shows
the room behind the wall.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from wrf_mi_scenes.build_laboratory import Mesh, Span, box, joined, sheet, table, wall

from wrf_mi.core.angles import FloatArray
from wrf_mi.scene.coordinates import Y_UP, extra_package
from wrf_mi.scene.mesh.outline import triangulated

from .scene import spread

DOOR_M = 0.85, 2.05  # width and height of a door
RECESS_M = 0.06, 0.14  # depth of a closed door's leaf and of a window in the wall
CLEAR_M = 0.3  # least distance of the phone from furniture, and of furniture from doors
HAND_M = 1.1, 1.7  # heights of the phone
PLACE_M2 = 1.5  # floor area for each place from which the phone looks around
YAWS, PITCHES_DEG = 10, (-50.0, -15.0, 25.0)
PICTURE = 128, 96  # pixels of a depth picture
FIELD_DEG = 62.0  # its horizontal field of view
RANGE_M = 5.0  # reach of a phone's LiDAR
TRUNCATION, LEAST_SEEN, MOST_BLOCKS = 2.0, 1.0, 30_000
"""Cells about a surface whose distance is fused, least number of pictures with one, and most blocks of 16^3 cells."""
STRIDE = 4  # pixels between those by which Open3D finds the cells of a picture
GRAZING = np.cos(np.radians(82))  # flatter views return nothing


@dataclass(frozen=True)
class Home:
    """A furnished home, z up, axes along its walls.

    Attributes:
        shell: mesh of floors, ceilings, walls, doors by name, metres.
        furniture: pieces that are flat.
        clutter: what is not flat, and has no part in the truth.
        glass: panes, which return nothing.
        mirrors: mirrors on walls.
        rooms: floor of each room (shapely).
        walls: corners [n, 2, 2] of the walls in plan.
        height_m: height of the ceiling.
        free: floor of each room that furniture leaves free (shapely).
    """

    shell: dict[str, Mesh]
    furniture: list[Mesh]
    clutter: list[Mesh]
    glass: list[Mesh]
    mirrors: list[Mesh]
    rooms: list[Any]
    walls: FloatArray
    height_m: float
    free: list[Any]

    @property
    def area_m2(self) -> float:
        """Area of the floor, that below the inner walls of a flat, too."""
        return float(
            self.rooms[0].area if len(self.rooms) == 1 else shapely.envelope(shapely.union_all(self.rooms)).area
        )


@dataclass(frozen=True)
class _Opening:
    """A door or window in a wall: across an axis (0 or 1), between two coordinates, along and up the wall."""

    axis: int
    span: Span
    along: Span
    up: Span
    kind: str  # "doorway", "door" or "window"

    @property
    def footprint(self) -> Any:
        """Its area in plan, with the space before it in which nothing stands (shapely)."""
        sides = [self.span, self.along] if self.axis == 0 else [self.along, self.span]
        (x0, x1), (y0, y1) = sides
        return shapely.buffer(shapely.box(x0, y0, x1, y1), CLEAR_M if self.kind == "window" else 0.8)

    def meshes(self) -> list[Mesh]:
        """Its reveals, and a closed door's leaf, at the second coordinate of its span."""
        span, other = sorted(self.span), 1 - self.axis
        sides = [sheet(other, at, (span[0], span[1]), self.up) for at in self.along]
        first, second = (span, self.along) if self.axis == 0 else (self.along, span)
        levels = [sheet(2, at, (first[0], first[1]), (second[0], second[1])) for at in self.up]
        return [*sides, *levels, *([self.leaf()] if self.kind == "door" else [])]

    def leaf(self) -> Mesh:
        """The sheet that closes it."""
        return sheet(self.axis, self.span[1], self.along, self.up)


def home(seed: int, flat: bool) -> Home:
    """A room of 8 to 30 square metres, one of three L-shaped, or a flat of three to five rooms, of a seed."""
    rng = np.random.default_rng([seed, int(flat)])
    height = float(rng.uniform(2.4, 2.9))
    if flat:
        size = rng.uniform((8.0, 6.0), (11.0, 8.0))
        rooms, openings = _divided((0.0, 0.0, *size), rng)
    else:
        size = rng.uniform((3.0, 2.8), (6.5, 5.0))
        room = shapely.box(0, 0, *size)
        if rng.random() < 1 / 3:
            cut = size * rng.uniform(0.3, 0.45, 2)
            room = shapely.difference(room, shapely.box(*(size - cut), *size))
        rooms, openings = [room], []
    edges = [edge for room in rooms for edge in _edges(room)]
    openings = [*openings, *_outer_openings(edges, shapely.box(0, 0, *size), openings, height, rng)]
    furniture, clutter, mirrors, free = [], [], [], []
    doors = shapely.union_all([opening.footprint for opening in openings if opening.kind != "window"])
    for room in rooms:
        pieces, occupied = _furniture(room, doors, height, rng)
        furniture += pieces
        left = shapely.difference(room, shapely.union_all([shapely.buffer(area, CLEAR_M) for area in occupied]))
        for _ in range(int(rng.integers(1, 4))):
            if (place := _drawn(shapely.buffer(left, -0.5), rng)) is not None:
                ball = trimesh.creation.icosphere(2, 1.0)
                half = rng.uniform((0.15, 0.15, 0.2), (0.3, 0.3, 0.5))
                ball.apply_transform(np.diag([*half, 1.0]))
                ball.apply_translation([*place, half[2]])
                clutter.append(ball)
                left = shapely.difference(left, shapely.buffer(shapely.Point(place), half[0] + CLEAR_M))
        free.append(left)
    shell = {"floors": _levels(rooms, 0.0), "ceilings": _levels(rooms, height)}
    for number, (axis, at, along, _) in enumerate(edges):
        holes = [
            (opening.along, opening.up)
            for opening in openings
            if opening.axis == axis and at in opening.span[: 2 if opening.kind == "doorway" else 1]
            and along[0] <= opening.along[0] and opening.along[1] <= along[1]
        ]  # fmt: skip
        shell[f"wall_{number:02d}"] = wall(axis, at, along, (0.0, height), holes)
        if rng.random() < 0.25 and not holes and along[1] - along[0] > 1.5:
            left = float(rng.uniform(along[0] + 0.3, along[1] - 1.0))
            inwards = 0.01 * next(-sign for a, b, c, sign in edges if (a, b, c) == (axis, at, along))
            mirrors.append(sheet(axis, at + inwards, (left, left + 0.6), (0.6, 1.9)))
    for number, opening in enumerate(openings):
        shell[f"opening_{number:02d}"] = joined(opening.meshes())
    glass = [opening.leaf() for opening in openings if opening.kind == "window"]
    lines = np.array([_line(axis, at, along) for axis, at, along, _ in edges])
    return Home(shell, furniture, clutter, glass, mirrors, rooms, lines, height, free)


_Edge = tuple[int, float, Span, int]
"""A wall: the axis that it stands across, its coordinate, its extent, and on which side of it the outside is."""


def _edges(room: Any) -> Iterator[_Edge]:
    corners = np.asarray(shapely.get_coordinates(shapely.geometry.polygon.orient(room)))
    for (x0, y0), (x1, y1) in pairwise(corners):
        if x0 == x1:
            yield 0, float(x0), (float(min(y0, y1)), float(max(y0, y1))), 1 if y1 > y0 else -1
        else:
            yield 1, float(y0), (float(min(x0, x1)), float(max(x0, x1))), -1 if x1 > x0 else 1


def _line(axis: int, at: float, along: Span) -> FloatArray:
    ends = np.array([[at, along[0]], [at, along[1]]])
    return ends if axis == 0 else ends[:, ::-1]


def _divided(bounds: Sequence[float], rng: np.random.Generator) -> tuple[list[Any], list[_Opening]]:
    """Rooms of a rectangle divided by walls with a doorway each, and the doorways."""
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    size = high - low
    axis = int(np.argmax(size))
    if size.prod() < 22 or size[axis] < 5.2:
        return [shapely.box(*bounds)], []
    thick = float(rng.uniform(0.1, 0.2))
    at = float(rng.uniform(low[axis] + 2.4, high[axis] - 2.4 - thick))
    first, second = [*bounds], [*bounds]
    first[2 + axis], second[axis] = at, at + thick
    (rooms_a, doors_a), (rooms_b, doors_b) = _divided(first, rng), _divided(second, rng)

    def beside(rooms: list[Any], column: int, place: float) -> list[Any]:
        return [room.bounds for room in rooms if room.bounds[column] == place]

    other, spans = 1 - axis, []
    for a in beside(rooms_a, 2 + axis, at):
        for b in beside(rooms_b, axis, at + thick):
            spans.append((max(a[other], b[other]), min(a[2 + other], b[2 + other])))
    left, right = max(spans, key=lambda span: span[1] - span[0])
    begin = float(rng.uniform(left + 0.1, right - 0.1 - DOOR_M[0]))
    door = _Opening(axis, (at, at + thick), (begin, begin + DOOR_M[0]), (0.0, DOOR_M[1]), "doorway")
    return [*rooms_a, *rooms_b], [*doors_a, *doors_b, door]


def _outer_openings(
    edges: Sequence[_Edge], outline: Any, doors: Sequence[_Opening], height: float, rng: np.random.Generator
) -> list[_Opening]:
    """A closed door and windows in outer walls, at least 1.8 m wide ones."""
    x0, y0, x1, y1 = outline.bounds
    outer = [edge for edge in edges if edge[1] in ((x0, x1) if edge[0] == 0 else (y0, y1)) and np.ptp(edge[2]) > 1.8]
    openings = []
    for number, (axis, at, along, sign) in enumerate(outer[i] for i in rng.permutation(len(outer))):
        kind = "door" if number == 0 else "window"
        if kind == "window" and rng.random() < 0.5:
            continue
        width = DOOR_M[0] if kind == "door" else float(rng.uniform(0.8, min(2.0, np.ptp(along) - 0.6)))
        begin = float(rng.uniform(along[0] + 0.2, along[1] - 0.2 - width))
        up = (0.0, DOOR_M[1]) if kind == "door" else (0.9, min(2.1, height - 0.25))
        depth = RECESS_M[0] if kind == "door" else RECESS_M[1]
        openings.append(_Opening(axis, (at, at + sign * depth), (begin, begin + width), up, kind))
    return openings


def _levels(rooms: Sequence[Any], at: float) -> Mesh:
    meshes = []
    for room in rooms:
        flat, faces = triangulated(room)
        meshes.append(Mesh(np.column_stack([flat, np.full(len(flat), at)]), faces, process=False))
    return joined(meshes)


def _furniture(room: Any, doors: Any, height: float, rng: np.random.Generator) -> tuple[list[Mesh], list[Any]]:
    """Pieces along the walls and a table, and their areas in plan (shapely)."""
    pieces, occupied = list[Mesh](), list[Any]()
    edges = [edge for edge in _edges(room) if np.ptp(edge[2]) > 1.0]
    wanted = max(3, int(room.area / 2.5))
    for _ in range(60):
        if len(pieces) == wanted or sum(area.area for area in occupied) > 0.35 * room.area:
            break
        long, deep, top = rng.choice(
            [(1.2, 0.6, 2.1), (0.8, 0.35, 1.9), (2.0, 1.5, 0.5), (1.9, 0.85, 0.45), (1.4, 0.7, 0.74), (1.2, 0.4, 0.9)]
        ) * rng.uniform(0.85, 1.15, 3)  # wardrobe, shelf, bed, sofa, desk, chest
        axis, at, along, sign = edges[rng.integers(len(edges))]
        if long > np.ptp(along):
            continue
        begin = float(rng.uniform(along[0], along[1] - long))
        ends = sorted((at - sign * 0.01, at - sign * (0.01 + deep)))
        x, y = (ends, [begin, begin + long]) if axis == 0 else ([begin, begin + long], ends)
        area = shapely.box(x[0], y[0], x[1], y[1])
        blocked = any(area.distance(other) < 0.15 for other in occupied) or area.intersects(doors)
        if blocked or not room.contains(area):
            continue
        occupied.append(area)
        if 0.6 < top < 0.8:
            pieces.append(table((x[0], x[1]), (y[0], y[1]), top))
        else:
            pieces.append(box((x[0], y[0], 0.02), (x[1], y[1], min(top, height - 0.15))))
    return pieces, occupied


def _drawn(area: Any, rng: np.random.Generator) -> FloatArray | None:
    """A point [2] of an area (shapely), or None for an empty one."""
    if area.is_empty:
        return None
    x0, y0, x1, y1 = area.bounds
    while True:
        place = rng.uniform((x0, y0), (x1, y1))
        if shapely.contains_xy(area, *place):
            return np.asarray(place)


def places_of(area: Any, count: int, rng: np.random.Generator) -> FloatArray:
    """Points [n, 2] of an area (shapely), each as far as possible from those before."""
    drawn = [place for _ in range(40 * count) if (place := _drawn(area, rng)) is not None]
    return spread(np.array(drawn), count) if drawn else np.empty((0, 2))


@dataclass(frozen=True)
class Errors:
    """Standard deviations of a scan's errors, drawn from a seed.

    Attributes:
        noise_m: noise of vertices, 5 to 10 mm.
        edge_m: side of the cells in which the depth is fused.
        tilt_rad: angle of the vertical.
        drift_m: drift along each axis between two places.
        drift_rad: drift of the heading between two places.
        holes: number of holes in a room.
    """

    noise_m: float
    edge_m: float
    tilt_rad: float
    drift_m: float = 0.003
    drift_rad: float = float(np.radians(0.03))
    holes: int = 3


def drawn_errors(rng: np.random.Generator) -> Errors:
    """Errors of a scan."""
    noise, edge, tilt = rng.uniform((0.005, 0.03, np.radians(0.3)), (0.010, 0.05, np.radians(3)))
    return Errors(float(noise), float(edge), float(tilt))


def phone_scan(place: Home, seed: int) -> tuple[Mesh, FloatArray, Errors]:
    """Mesh of a scan, y up, in the phone's frame; the motion [4, 4] from that frame to the home's; its errors.

    The motion has the mean drift of the poses.
    """
    o3d, rng = extra_package("open3d"), np.random.default_rng([seed, 7])
    errors = drawn_errors(rng)
    cast = _Camera(place)
    core, block = o3d.core, (errors.edge_m, 16, MOST_BLOCKS, o3d.core.Device("CPU:0"))
    volume = o3d.t.geometry.VoxelBlockGrid(("tsdf", "weight"), (core.float32,) * 2, ((1), (1)), *block)
    lens, depths = core.Tensor(cast.intrinsic), (1.0, RANGE_M, TRUNCATION)
    drift, motions, starts = np.eye(4), list[FloatArray](), list[FloatArray]()
    for area in place.free:
        spots = places_of(shapely.buffer(area, -0.1), max(4, round(area.area / PLACE_M2)), rng)
        for x, y in spots:
            height = rng.uniform(*HAND_M)
            starts.append(np.array([x, y, height]))
            step = trimesh.transformations.rotation_matrix(rng.normal(0, errors.drift_rad), [0, 0, 1], [x, y, 0])
            step[:3, 3] += rng.normal(0, errors.drift_m, 3)
            drift = step @ drift
            motions.append(drift)
            for pose in _poses((x, y, height), rng):
                picture = cast(pose)
                if not picture[::STRIDE, ::STRIDE].any():
                    continue  # glass, or too far away
                view = o3d.t.geometry.Image(picture), lens, core.Tensor(np.linalg.inv(drift @ pose)), *depths
                volume.integrate(volume.compute_unique_block_coordinates(*view), *view)
    fused = volume.extract_triangle_mesh(LEAST_SEEN).to_legacy()
    mesh = Mesh(np.asarray(fused.vertices), np.asarray(fused.triangles), process=False)
    mesh.vertices = mesh.vertices + rng.normal(0, errors.noise_m, mesh.vertices.shape)
    centres, gone = mesh.triangles_center, np.zeros(len(mesh.faces), bool)
    for at in centres[rng.integers(len(centres), size=errors.holes * len(place.rooms))]:
        gone |= np.linalg.norm(centres - at, axis=1) < rng.uniform(0.1, 0.3)
    mesh.update_faces(~gone)
    # The phone's frame: turned about the vertical, leaning, origin at its start, y up.
    turn = Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)])
    axis = rng.uniform(0, 2 * np.pi)
    lean = Rotation.from_rotvec(errors.tilt_rad * np.array([np.cos(axis), np.sin(axis), 0.0]))
    to_phone = np.eye(4)
    to_phone[:3, :3] = (lean * turn).as_matrix()
    to_phone[:3, 3] = -to_phone[:3, :3] @ starts[0]
    to_file = Y_UP @ to_phone
    mesh.apply_transform(to_file)
    mean = np.mean(motions, axis=0)
    mean[:3, :3] = Rotation.from_matrix(mean[:3, :3]).as_matrix()
    return mesh, np.linalg.inv(to_file @ mean), errors


def _poses(place: Sequence[float], rng: np.random.Generator) -> Iterator[FloatArray]:
    """Poses [4, 4] of a camera (z ahead, y down) that looks around at a place."""
    for pitch in PITCHES_DEG:
        for yaw in 2 * np.pi * (np.arange(YAWS) + rng.random()) / YAWS:
            up = np.radians(pitch)
            ahead = np.array([np.cos(yaw) * np.cos(up), np.sin(yaw) * np.cos(up), np.sin(up)])
            right = np.array([np.sin(yaw), -np.cos(yaw), 0.0])
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
            pose[:3, 3] = place
            yield pose


class _Camera:
    """Depth pictures of a home: a callable from a pose [4, 4]."""

    def __init__(self, place: Home) -> None:
        self._o3d = extra_package("open3d")
        self._scene = self._o3d.t.geometry.RaycastingScene()
        solid = joined([*place.shell.values(), *place.furniture, *place.clutter])
        self._solid, self._glass, self._mirror = (
            self._add(joined(part)) if part else -1 for part in ([solid], place.glass, place.mirrors)
        )
        width, height = PICTURE
        focal = width / 2 / np.tan(np.radians(FIELD_DEG / 2))
        self.intrinsic = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
        v, u = np.mgrid[:height, :width]
        self._rays = np.stack([(u - width / 2 + 0.5) / focal, (v - height / 2 + 0.5) / focal, np.ones_like(u)], axis=-1)

    def _add(self, mesh: Mesh) -> int:
        core = self._o3d.core
        return int(
            self._scene.add_triangles(
                core.Tensor(np.asarray(mesh.vertices, np.float32)), core.Tensor(np.asarray(mesh.faces, np.uint32))
            )
        )

    def _hits(self, origin: FloatArray, rays: FloatArray) -> tuple[FloatArray, Any, FloatArray]:
        """Distance in lengths of the rays, number of the mesh, and cosine of the angle to its normal."""
        packed = np.concatenate([np.broadcast_to(origin, rays.shape), rays], axis=-1).astype(np.float32)
        answer = {key: value.numpy() for key, value in self._scene.cast_rays(self._o3d.core.Tensor(packed)).items()}
        unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
        return answer["t_hit"], answer["geometry_ids"], np.abs((unit * answer["primitive_normals"]).sum(axis=-1))

    def __call__(self, pose: FloatArray) -> NDArray[np.float32]:
        """Depth picture from a pose, 0 where nothing returns."""
        rays = self._rays @ pose[:3, :3].T
        depth, hit, cosine = self._hits(pose[:3, 3], rays)
        mirrored = hit == self._mirror
        if self._mirror >= 0 and mirrored.any():
            first = depth[mirrored]
            at = pose[:3, 3] + first[:, None] * rays[mirrored]
            normal = self._normal_of_mirror(pose[:3, 3], rays[mirrored])
            bent = rays[mirrored] - 2 * (rays[mirrored] * normal).sum(axis=-1, keepdims=True) * normal
            more, hit[mirrored], cosine[mirrored] = self._hits(at + 1e-3 * bent, bent)
            depth[mirrored] = first + more
        lost = ~np.isfinite(depth) | (hit == self._glass) | (cosine < GRAZING) | (depth > RANGE_M)
        return np.where(lost, 0, depth).astype(np.float32)

    def _normal_of_mirror(self, origin: FloatArray, rays: FloatArray) -> FloatArray:
        packed = np.concatenate([np.broadcast_to(origin, rays.shape), rays], axis=-1).astype(np.float32)
        return np.asarray(self._scene.cast_rays(self._o3d.core.Tensor(packed))["primitive_normals"].numpy(), float)
