"""Scenes made from simulated scans of two CAD rooms (the NeWRF data), and from the map and returns of a robot.

Specular paths in the rooms are compared with those of their own meshes, the walls of a furnished flat with those that
were measured by hand.
"""

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import InputError, Paths, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.array_files import write_arrays
from wrf_mi.core.memory import peak_memory_mb
from wrf_mi.core.types import IntArray
from wrf_mi.datasets.newrf import KEYS, read_arrays
from wrf_mi.scene.coordinates import extra_package
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.sources import Row0, read_layout, read_plan
from wrf_mi.scene.plan.storey import layout_walls
from wrf_mi.scene.plan.walls import find_walls
from wrf_mi.scene.register import best_scale, register_walls, sample_walls
from wrf_mi.scene.scan.simulated import OUTLIERS, RANGE_NOISE_M, RAYS_PER_POSE, simulate_scan
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import scene_surfaces

from .comparison import data_folder, line, room_file
from .trace import ROOMS, assign

SAME_DIRECTION_RAD = np.radians(3.0)  # largest difference of directions of equal paths, at both ends
SAME_LENGTH_M = 0.05  # and of their lengths
CLEAR_M = 0.06  # least distance of positions from surfaces, as a noisy wall may lie on the other side of nearer ones
SCANNER_CLEAR_M = 0.4  # least distance of a scanner from surfaces
SCANNER_HEIGHTS_M = (1.2, 1.8)  # range of its height above the floor
POSES = 6  # number of a scan's poses


def scan_to_paths(room: str | Path, receivers: int = 40, poses: int = POSES, seed: int = 1) -> dict[str, Any]:
    """Paths of a scene made from a scan, compared with those of the room's own mesh.

    Reflections are perfect, two at most, so a path of length d has the power 1 / d^2 up to a constant. Paths of equal
    ends are matched one to one. *Recall* is the share of power of the room's paths that are matched, *precision* that
    of the made scene's; both are also of the number of paths, and by the number of reflections.
    """
    file = Path(room)
    points, frequency_hz = scanned_points(file, poses, seed=seed)
    data = read_arrays(file, KEYS[:3])
    original = open_scene(file.with_suffix(".stl"), frequency_hz, material=PERFECT)
    triangles, moving = scene_surfaces(original).triangles, data["rx_pos"].astype(float)
    free = np.flatnonzero(_clearance(triangles)(moving) > CLEAR_M)
    chosen = moving[np.sort(np.random.default_rng(seed).permutation(free)[:receivers])]
    fixed = clear_of_walls(data["tx_pos"], moving, triangles)
    with tempfile.TemporaryDirectory() as folder:
        scan = write_arrays(Path(folder) / f"{file.stem}.npz", {"points": points})
        measured = make_scene(scan, Path(folder) / "scene")
        other = open_scene(measured.folder, frequency_hz)
        agreement = path_agreement(original, other, [(fixed, chosen)], seed)
    return {
        "room": file.stem,
        "points": len(points),
        "range_noise_m": RANGE_NOISE_M,
        "outliers": OUTLIERS,
        "poses": poses,
        "surfaces": measured.counts["surfaces"],
        "receivers": len(chosen),
        **agreement,
    }


def path_agreement(
    original: Any, made: Any, ends: Sequence[tuple[FloatArray, FloatArray]], seed: int, rays: int = 1 << 20
) -> dict[str, Any]:
    """Recall and precision of `scan_to_paths` of a made scene in the frame of the original one (``sionna.rt.Scene``).

    ``ends`` are fixed ends [3], each with positions [n, 3] of the other end.
    """
    options = TraceOptions(transmission=False, depth=2, rays=rays, seed=seed)
    sums = {name: np.zeros((4, options.depth + 1)) for name in ("recall", "precision")}
    for fixed, moving in ends:
        end = Receiver("fixed end", fixed, np.array([0.0, 0.0, 0.0, 1.0]))
        truth, ours = (trace_paths(scene, moving, end, options).paths for scene in (original, made))
        for total, paths, which in zip(sums.values(), (truth, ours), match(truth, ours), strict=True):
            for row, selected in ((0, which), (2, slice(None))):
                depth, power = paths.bounces[selected], paths.length_m[selected] ** -2.0
                total[row] += np.bincount(depth, power, options.depth + 1)
                total[row + 1] += np.bincount(depth, minlength=options.depth + 1)
    shares = {
        name: {"power": _share(total[0].sum(), total[2].sum()), "paths": _share(total[1].sum(), total[3].sum())}
        for name, total in sums.items()
    }
    by_reflections = {depth: _share(*sums["recall"][[0, 2], depth]) for depth in range(options.depth + 1)}
    numbers = {"paths_room": int(sums["recall"][3].sum()), "paths_made": int(sums["precision"][3].sum())}
    return {**numbers, **shares, "recall_by_reflections": by_reflections}


def _share(part: float, total: float) -> float:
    return float(part / total) if total else 0.0


def match(truth: Paths, ours: Paths) -> tuple[IntArray, IntArray]:
    """Indices into the paths of two traces between the same ends that are the same, one to one."""

    def distances(a: IntArray, b: IntArray) -> list[FloatArray]:
        turned = [
            np.arccos(np.clip(mine[a] @ other[b].T, -1, 1)) / SAME_DIRECTION_RAD
            for mine, other in ((truth.arrival, ours.arrival), (truth.departure, ours.departure))
        ]
        return [np.abs(truth.length_m[a, None] - ours.length_m[None, b]) / SAME_LENGTH_M, *turned]

    return assign(truth.tx, ours.tx, distances)


def scanned_points(
    room: Path, poses: int, rays_per_pose: int = RAYS_PER_POSE, seed: int = 1
) -> tuple[FloatArray, float]:
    """Points [n, 3] of a simulated scan of a NeWRF room from distant poses, and the room's frequency in Hz."""
    data = read_arrays(room, KEYS[:3])
    frequency_hz, places = float(data["frequency_hz"]), data["rx_pos"].astype(float)
    scene = open_scene(room.with_suffix(".stl"), frequency_hz, material=PERFECT)
    high = (places[:, 2] > SCANNER_HEIGHTS_M[0]) & (places[:, 2] < SCANNER_HEIGHTS_M[1])
    clear = _clearance(scene_surfaces(scene).triangles)(places) > SCANNER_CLEAR_M
    stands = spread(places[high & clear], poses)
    return simulate_scan(scene.mi_scene, stands, rays_per_pose=rays_per_pose, seed=seed), frequency_hz


def clear_of_walls(position_m: FloatArray, others_m: FloatArray, triangles: FloatArray) -> FloatArray:
    """A position [3] moved towards the centre of others [n, 3] until it is `CLEAR_M` from triangles [f, 3, 3]."""
    position_m, clear = position_m.astype(float), _clearance(triangles)
    while clear(position_m[None])[0] < CLEAR_M:
        inwards = others_m.mean(axis=0) - position_m
        position_m = position_m + 0.02 * inwards / np.linalg.norm(inwards)
    return position_m


def spread(places: FloatArray, count: int) -> FloatArray:
    """At most ``count`` of the places [n, 3], each as far as possible from those before (Gonzalez 1985)."""
    chosen = [places[0]]
    while len(chosen) < min(count, len(places)):
        distance = np.min([np.linalg.norm(places - place, axis=1) for place in chosen], axis=0)
        chosen.append(places[np.argmax(distance)])
    return np.stack(chosen)


def _clearance(triangles: FloatArray) -> Any:
    """A function from points [n, 3] to their distances [n] from triangles [f, 3, 3]."""
    core = extra_package("open3d").core
    scene = extra_package("open3d").t.geometry.RaycastingScene()
    scene.add_triangles(
        core.Tensor(triangles.reshape(-1, 3).astype(np.float32)),
        core.Tensor(np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)),
    )
    return lambda points_m: scene.compute_distance(core.Tensor(points_m.astype(np.float32))).numpy()


def scans() -> dict[str, Any]:
    """Scans of both rooms of the NeWRF data, at 200 receivers, for the benchmark."""
    figures = {name: scan_to_paths(room_file(name), receivers=200) for name in ROOMS}
    rows = []
    for name, shares in figures.items():
        value = f"{100 * shares['recall']['power']:.1f} % ({100 * shares['precision']['power']:.1f} %)"
        what = f"{name}, received power on specular paths found again (of that predicted, right)"
        rows.append(line(what, value, "80 %, aim 90 %"))
    return {"rows": rows, "rooms": figures}


def large_scan() -> dict[str, Any]:
    """Time and memory of a scene made from a large scan of the office of the NeWRF data."""
    cloud, _ = scanned_points(room_file("office"), 10, 500_000)
    with tempfile.TemporaryDirectory() as folder:
        scan = write_arrays(Path(folder) / "scan.npz", {"points": cloud.astype(np.float32)})
        count = len(cloud)
        del cloud
        start = time.perf_counter()
        scene = make_scene(scan, Path(folder) / "scene")
        seconds = time.perf_counter() - start
    peak = peak_memory_mb()
    value = f"{seconds:.0f} s, {peak / 1024:.1f} GiB"
    row = line(f"{count / 1e6:.1f} million points of the office", value, "120 s, 4 GiB")
    figures = {"points": count, "surfaces": scene.counts["surfaces"], "seconds": seconds, "peak_memory_mb": peak}
    return {"rows": [row], **figures}


NEAR_M = 0.2  # distance within which walls agree: the blur of the robot's poses
GRID_RESOLUTION_M = 0.04
"""Resolution of the SLAM map: ``size = 20, res = 0.04``, so 500 cells, in the notebook of its author
(github.com/marckolak/graphSLAM, examples/Mapping.ipynb); registration to the layout finds the same."""
GRID_ROW_0: Row0 = "top"  # side of the map's first row; registration to the layout refuses the mirror image
ASKED = "0.85 and 0.85"


def wall_agreement(made_m: FloatArray, true_m: FloatArray, near_m: float = NEAR_M) -> tuple[float, float]:
    """Shares of true walls [m, 2, 2] near walls made [n, 2, 2], by length, and the reverse; end points in m."""
    made_walls, true = (shapely.unary_union(shapely.linestrings(walls)) for walls in (made_m, true_m))
    share_found = shapely.intersection(true, shapely.buffer(made_walls, near_m)).length / true.length
    right = shapely.intersection(made_walls, shapely.buffer(true, near_m)).length / made_walls.length
    return float(share_found), float(right)


def flat_plan() -> dict[str, Any]:
    """Walls from ``lidar/gridmap.npz`` of flat-ble, registered to ``layout.csv``.

    An upper bound for any method is the share of the layout near an occupied cell. Figures are shares, what can be
    seen, walls, and the scale of the registration.
    """
    home = data_folder("flat-ble")
    true = layout_walls(read_layout(home / "layout.csv"))
    file = home / "lidar" / "gridmap.npz"
    grid = read_plan(file, GRID_RESOLUTION_M, GRID_ROW_0)
    if not isinstance(grid, PlanGrid):
        raise InputError(f"{file}: expected log_odds")
    shares = _measured_plan(grid, true)
    what = f"gridmap: layout within {NEAR_M} m of a wall made, and the reverse"
    value = "{layout_found:.2f} and {walls_right:.2f} (seen at all: {layout_seen:.2f})".format_map(shares)
    return {"rows": [line(what, value, ASKED)], "gridmap": shares}


def _measured_plan(grid: PlanGrid, true: FloatArray) -> dict[str, Any]:
    walls, cells = find_walls(grid), grid.centres_m(grid.occupied)
    motion = register_walls(sample_walls(walls), true)
    walls, cells = (points @ motion[:2, :2].T + motion[:2, 3] for points in (walls, cells))
    scale, _ = best_scale(sample_walls(walls), np.zeros(3), true)
    share_found, right = wall_agreement(walls, true)
    layout = shapely.unary_union(shapely.linestrings(true))
    near = shapely.intersection(layout, shapely.buffer(shapely.multipoints(cells), NEAR_M))
    return {
        "layout_found": share_found,
        "walls_right": right,
        "layout_seen": float(near.length / layout.length),
        "walls": len(walls),
        "length_m": float(np.linalg.norm(walls[:, 1] - walls[:, 0], axis=-1).sum()),
        "scale": scale,
    }
