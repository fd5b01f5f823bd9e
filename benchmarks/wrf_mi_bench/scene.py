"""How well a scene made from LiDAR predicts specular paths: simulated scans of two CAD rooms (the NeWRF data)."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from scipy.optimize import linear_sum_assignment
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.files import write_arrays
from wrf_mi.core.types import IntArray
from wrf_mi.datasets.newrf import KEYS, read_arrays
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.points import lidar_package
from wrf_mi.scene.scan import OUTLIERS, RANGE_NOISE_M, RAYS_PER_POSE, simulate_scan
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.training.trainer import peak_memory_mb

from .trace import ROOMS, room_file

SAME_DIRECTION_RAD = np.radians(3.0)
SAME_LENGTH_M = 0.05
"""The same path: both of its ends' directions within 3 degrees, and as long within 5 cm."""
CLEAR_M = 0.06
"""Positions nearer to a surface are left out (the fixed end is moved away): a noisy wall may have either on its other
side. Just above `SAME_LENGTH_M`."""
SCANNER_CLEAR_M = 0.4
SCANNER_HEIGHTS_M = (1.2, 1.8)
"""A scanner stands so far from surfaces, and so high above the floor."""


def scan_to_paths(
    room: str | Path,
    *,
    receivers: int = 40,
    poses: int = 6,
    rays_per_pose: int = RAYS_PER_POSE,
    range_noise_m: float = RANGE_NOISE_M,
    rays: int = 1 << 20,
    seed: int = 1,
    keep: str | Path | None = None,
) -> dict[str, Any]:
    """Scan a room, make a scene of the points, and compare its paths with those of the room's own mesh.

    Reflectors are perfect, up to two reflections, so a path of length d has the power 1 / d^2 (up to a constant). Paths
    of both meshes between the same ends are matched one to one. *Recall* is the share of the power of the room's paths
    that have a partner, *precision* that of the made scene's.

    Args:
        room: ``<room>.npz`` with ``<room>.stl`` beside it (see `wrf_mi.datasets.newrf`).
        receivers: number of the room's receivers, drawn at random among those clear of surfaces.
        poses: number of places where the scanner stands, spread as far apart as possible.
        rays_per_pose: of the scanner.
        range_noise_m: standard deviation of the range, metres.
        rays: that search for paths.
        seed: of the draw, the noise and the rays.
        keep: where to put the scene folder; None throws it away.

    Returns:
        ``recall`` and ``precision`` of power and of the number of paths, by the number of reflections too, numbers of
        points, surfaces and paths, seconds and the process's memory.

    Raises:
        InputError: the room's files are missing or damaged, Open3D is missing, or the folder exists.
    """
    file = Path(room)
    data = read_arrays(file, KEYS[:3])
    frequency_hz = float(data["frequency_hz"])
    original = open_scene(file.with_suffix(".stl"), frequency_hz, material=PERFECT)
    clear = _clearance(scene_surfaces(original).triangles)
    moving = data["rx_pos"].astype(float)
    distance = clear(moving)
    rng = np.random.default_rng(seed)
    free = np.flatnonzero(distance > CLEAR_M)
    chosen = moving[np.sort(rng.permutation(free)[:receivers])]
    high = (moving[:, 2] > SCANNER_HEIGHTS_M[0]) & (moving[:, 2] < SCANNER_HEIGHTS_M[1])
    stands = spread(moving[high & (distance > SCANNER_CLEAR_M)], poses)
    fixed = data["tx_pos"].astype(float)
    while clear(fixed[None])[0] < CLEAR_M:
        inwards = moving.mean(axis=0) - fixed
        fixed = fixed + 0.02 * inwards / np.linalg.norm(inwards)

    points = simulate_scan(
        original.mi_scene, stands, rays_per_pose=rays_per_pose, range_noise_m=range_noise_m, seed=seed
    )
    with tempfile.TemporaryDirectory() as folder:
        scan = write_arrays(Path(folder) / f"{file.stem}.npz", {"points": points})
        start = time.perf_counter()
        made = make_scene(scan, keep or Path(folder) / "scene")
        seconds = time.perf_counter() - start
        memory = peak_memory_mb()
        other = open_scene(made.folder, frequency_hz)
        end = Receiver("fixed end", fixed, np.array([0.0, 0.0, 0.0, 1.0]))
        options = TraceOptions(max_depth=2, rays=rays, seed=seed)
        truth, ours = (trace_paths(scene, chosen, end, options).paths for scene in (original, other))
    found = match(truth, ours)
    shares = {
        name: {"power": _power_share(paths, which), "paths": len(which) / max(len(paths), 1)}
        for name, paths, which in (("recall", truth, found[0]), ("precision", ours, found[1]))
    }
    bounces = truth.bounces
    return {
        "room": file.stem,
        "points": len(points),
        "range_noise_m": range_noise_m,
        "outliers": OUTLIERS,
        "poses": len(stands),
        "surfaces": made.counts["surfaces"],
        "receivers": len(chosen),
        "paths_room": len(truth),
        "paths_made": len(ours),
        **shares,
        "recall_by_reflections": {
            depth: _power_share(truth, found[0], bounces == depth) for depth in range(int(bounces.max(initial=0)) + 1)
        },
        "make_seconds": seconds,
        "peak_memory_mb": memory,
        "memory_mb": psutil.Process().memory_info().rss / 1e6,
    }


def match(truth: Paths, ours: Paths) -> tuple[IntArray, IntArray]:
    """Paths of two traces between the same ends that are the same, one to one, as few as possible left over.

    Returns:
        Indices into both, of equal length.
    """
    pairs = []
    for position in np.intersect1d(truth.tx, ours.tx):
        a, b = (np.flatnonzero(paths.tx == position) for paths in (truth, ours))
        longer = np.abs(truth.length_m[a, None] - ours.length_m[None, b])
        turned = [
            np.arccos(np.clip(one[a] @ other[b].T, -1, 1))
            for one, other in ((truth.arrival, ours.arrival), (truth.departure, ours.departure))
        ]
        cost = longer / SAME_LENGTH_M + sum(turned) / SAME_DIRECTION_RAD
        same = (longer < SAME_LENGTH_M) & (np.maximum(*turned) < SAME_DIRECTION_RAD)
        rows, columns = linear_sum_assignment(np.where(same, cost, 1e3))
        kept = same[rows, columns]
        pairs.append((a[rows[kept]], b[columns[kept]]))
    if not pairs:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([pair[0] for pair in pairs]), np.concatenate([pair[1] for pair in pairs])


def spread(places: FloatArray, count: int) -> FloatArray:
    """At most ``count`` of the places [n, 3], each as far as possible from those before (Gonzalez 1985)."""
    chosen = [places[0]]
    while len(chosen) < min(count, len(places)):
        distance = np.min([np.linalg.norm(places - one, axis=1) for one in chosen], axis=0)
        chosen.append(places[np.argmax(distance)])
    return np.stack(chosen)


def _power_share(paths: Paths, which: IntArray, among: Any = None) -> float:
    """Share of the power, of paths of a mask, that some of them carry."""
    power = paths.length_m**-2.0
    if among is not None:
        power = power * among
    return float(power[which].sum() / power.sum()) if power.sum() else 0.0


def _clearance(triangles: FloatArray) -> Any:
    """A function from points [n, 3] to their distances [n] from triangles [f, 3, 3]."""
    core = lidar_package("open3d").core
    scene = lidar_package("open3d").t.geometry.RaycastingScene()
    scene.add_triangles(
        core.Tensor(triangles.reshape(-1, 3).astype(np.float32)),
        core.Tensor(np.arange(3 * len(triangles), dtype=np.uint32).reshape(-1, 3)),
    )
    return lambda points_m: scene.compute_distance(core.Tensor(points_m.astype(np.float32))).numpy()


def scans() -> dict[str, Any]:
    """Scans of both rooms of the NeWRF data, at 200 receivers, for the benchmark."""
    figures = {name: scan_to_paths(room_file(name), receivers=200) for name in ROOMS}
    rows = [
        {
            "what": f"{name}, received power on specular paths found again (of that predicted, right)",
            "value": f"{100 * found['recall']['power']:.1f} % ({100 * found['precision']['power']:.1f} %)",
            "asked": "80 %, aim 90 %",
        }
        for name, found in figures.items()
    ]
    return {"rows": rows, "rooms": figures}


def large_scan(points: int = 5_000_000, poses: int = 10) -> dict[str, Any]:
    """Time and memory of a scene made from a large scan of the office of the NeWRF data."""
    file = room_file("office")
    scene = open_scene(file.with_suffix(".stl"), float(read_arrays(file, KEYS[:3])["frequency_hz"]), material=PERFECT)
    places = read_arrays(file, KEYS[:3])["rx_pos"].astype(float)
    high = (places[:, 2] > SCANNER_HEIGHTS_M[0]) & (places[:, 2] < SCANNER_HEIGHTS_M[1])
    clear = _clearance(scene_surfaces(scene).triangles)(places) > SCANNER_CLEAR_M
    cloud = simulate_scan(scene.mi_scene, spread(places[high & clear], poses), rays_per_pose=points // poses)
    with tempfile.TemporaryDirectory() as folder:
        scan = write_arrays(Path(folder) / "scan.npz", {"points": cloud.astype(np.float32)})
        count = len(cloud)
        del cloud
        start = time.perf_counter()
        made = make_scene(scan, Path(folder) / "scene")
        seconds = time.perf_counter() - start
    peak = peak_memory_mb()
    value = f"{seconds:.0f} s, {peak / 1024:.1f} GiB"
    row = {"what": f"{count / 1e6:.1f} million points of the office", "value": value, "asked": "120 s, 4 GiB"}
    figures = {"points": count, "surfaces": made.counts["surfaces"], "seconds": seconds, "peak_memory_mb": peak}
    return {"rows": [row], **figures}
