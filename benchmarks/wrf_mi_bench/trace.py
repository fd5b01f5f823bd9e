"""Ray tracing compared with MATLAB's image method in two CAD rooms (the NeWRF data)."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from scipy.optimize import linear_sum_assignment
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.datasets.newrf import KEYS, read_arrays
from wrf_mi.receivers import csi
from wrf_mi.tasks.scores import summary
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import scene_surfaces

from .comparison import line, room_file

ROOMS = ("conference", "office")
SAME_LENGTH_M = 1e-3  # largest difference of the lengths of equal paths
SAME_POINT_M = 1e-2  # and of their last interaction points
ON_SURFACE_M = 1e-4  # distance from a path's points within which a crossing is the reflection itself
MIRRORED = 1e-5  # tolerance of the cosine between bisector and normal of a reflection
SHORTEST_M = 1e-2  # least length of a segment in Sionna RT


def image_method_agreement(room: str | Path, rays: Any = "auto") -> dict[str, Any]:
    """Paths and channels of a room of the NeWRF data compared with MATLAB's.

    MATLAB's image method has perfect reflections without change of sign, two at most, so the channel is the sum over
    paths of lambda / (4 pi d) exp(-j k d). Paths that MATLAB lacks are confirmed in float64 by `confirm_paths`.
    Quantiles of ``cea_db`` are over all receivers with a channel in MATLAB, and over those where MATLAB lacks no path;
    quantiles of no receiver and the share of no path are None.
    """
    file = Path(room)
    data = read_arrays(file, KEYS)
    frequency_hz = float(data["frequency_hz"])
    wavelength = speed_of_light / frequency_hz
    scene = open_scene(file.with_suffix(".stl"), frequency_hz, material=PERFECT)
    access_point = Receiver("access-point", data["tx_pos"].astype(float), np.array([0.0, 0.0, 0.0, 1.0]))
    options = TraceOptions(transmission=False, depth=2, rays=rays, seed=1)
    # The moving end is the transmitter, by reciprocity, so MATLAB's last point is the first one here.
    trace = trace_paths(scene, data["rx_pos"], access_point, options)
    paths = trace.paths
    row = np.repeat(np.arange(len(data["rx_pos"])), np.diff(data["path_offsets"]))
    length = wavelength / (4 * np.pi * np.abs(data["path_gain"]))
    none = paths.bounces == 0
    point = np.where(none[:, None], access_point.position_m, paths.vertices_m[:, 0])
    ours, theirs = match_paths((paths.tx, paths.length_m, point), (row, length, data["path_last_point"]))
    extra = np.setdiff1d(np.arange(len(paths)), ours)
    missing = np.setdiff1d(np.arange(len(row)), theirs)
    triangles = scene_surfaces(scene).triangles
    confirmed = confirm_paths(paths.select(extra), data["rx_pos"], access_point.position_m, triangles)
    last = np.linalg.norm(data["path_last_point"][missing] - data["rx_pos"][row[missing]], axis=1)
    free_space = replace(paths, gain=(wavelength / (4 * np.pi * paths.length_m)).astype(complex))
    # An error relative to a channel that is zero, as where MATLAB has no path, is not defined.
    reached = np.flatnonzero(data["csi"])
    error = csi(free_space, frequency_hz)[0, reached, 0] - data["csi"][reached]
    cea = -20 * np.log10(np.abs(error) / np.abs(data["csi"][reached]))
    incomplete = np.unique(paths.tx[extra])
    complete = cea[~np.isin(reached, incomplete)]
    return {
        "room": file.stem,
        "receivers": paths.n_tx,
        "rays": trace.rays,
        "paths_matlab": len(row),
        "paths_found": len(theirs),
        "share_found": len(theirs) / len(row) if len(row) else None,
        "length_error_m": float(np.abs(paths.length_m[ours] - length[theirs]).max(initial=0)),
        "missing_within_1cm_of_receiver": int((last < SHORTEST_M).sum()),
        "paths_matlab_lacks": len(extra),
        "of_these_confirmed": int(confirmed.sum()),
        "receivers_matlab_lacks_paths": len(incomplete),
        "cea_db": summary(cea) if len(cea) else None,
        "cea_db_where_matlab_lacks_none": summary(complete) if len(complete) else None,
    }


PathKey = tuple[IntArray, FloatArray, FloatArray]
Distances = Callable[[IntArray, IntArray], Sequence[FloatArray]]


def match_paths(ours: PathKey, theirs: PathKey) -> tuple[IntArray, IntArray]:
    """Indices into two lists of paths that are the same, one to one.

    Each list has the index of the position [p], the length [p] and the last interaction point [p, 3] in m.
    """

    def distances(a: IntArray, b: IntArray) -> Sequence[FloatArray]:
        longer = np.abs(ours[1][a, None] - theirs[1][None, b])
        return longer / SAME_LENGTH_M, np.linalg.norm(ours[2][a, None] - theirs[2][None, b], axis=-1) / SAME_POINT_M

    return assign(ours[0], theirs[0], distances)


def assign(ours: IntArray, theirs: IntArray, distances: Distances) -> tuple[IntArray, IntArray]:
    """One-to-one assignment of as many paths as possible of the same position, all of whose distances are below 1.

    Positions are indices [p] and [q] of both lists of paths; ``distances`` gives matrices [n, m] between paths a [n]
    and b [m] of both. Returns indices into both lists, of equal length.
    """
    pairs = [np.zeros((2, 0), np.int64)]
    for position in np.intersect1d(ours, theirs):
        a, b = (np.flatnonzero(side == position) for side in (ours, theirs))
        apart = np.stack(distances(a, b))
        same = apart.max(axis=0) < 1
        rows, columns = linear_sum_assignment(np.where(same, apart.sum(axis=0), 1e3))
        matched = same[rows, columns]
        pairs.append(np.stack([a[rows[matched]], b[columns[matched]]]))
    first, second = np.concatenate(pairs, axis=1)
    return first, second


def confirm_paths(paths: Paths, tx_pos_m: FloatArray, rx_pos_m: FloatArray, triangles: FloatArray) -> NDArray[np.bool_]:
    """Which paths are mirror reflections or lines of sight without obstruction, by brute force in float64.

    Transmitters [n_tx, 3], receivers [n_rx, 3], or one [3], and corners of the mesh's triangles [f, 3, 3] in metres.
    """
    corner, first, second = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    normal = np.cross(first, second)
    area = np.linalg.norm(normal, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = normal / area[:, None]
    offset, slack = (corner * normal).sum(axis=1), ON_SURFACE_M / np.sqrt(np.maximum(area, 1e-12))

    def inside(points: FloatArray, which: IntArray, slack: Any) -> NDArray[np.bool_]:
        """Whether points in the planes of triangles lie inside them, by barycentric coordinates."""
        s, n = points - corner[which], normal[which] / area[which, None]
        u, v = (np.cross(s, second[which]) * n).sum(axis=1), (np.cross(first[which], s) * n).sum(axis=1)
        return np.asarray((u >= -slack) & (v >= -slack) & (u + v <= 1 + slack))

    def obstructed(start: FloatArray, end: FloatArray) -> bool:
        length = float(np.linalg.norm(end - start))
        way = (end - start) / length
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (offset - normal @ start) / (normal @ way)
        which = np.flatnonzero((t > ON_SURFACE_M) & (t < length - ON_SURFACE_M))
        return bool(inside(start + t[which, None] * way, which, 0.0).any())

    def mirrored(before: FloatArray, at: FloatArray, after: FloatArray) -> bool:
        which = np.flatnonzero(np.abs(normal @ at - offset) < ON_SURFACE_M)
        which = which[inside(at, which, slack[which])]
        half = sum((end - at) / np.linalg.norm(end - at) for end in (before, after))
        return bool((np.abs(normal[which] @ half) > (1 - MIRRORED) * np.linalg.norm(half)).any())

    good, receivers_m = np.ones(len(paths), bool), np.atleast_2d(rx_pos_m)
    for index, bounces in enumerate(paths.bounces):
        points = [tx_pos_m[paths.tx[index]], *paths.vertices_m[index, :bounces], receivers_m[paths.rx[index]]]
        good[index] = not any(obstructed(*ends) for ends in pairwise(points))
        good[index] &= all(mirrored(*turn) for turn in zip(points, points[1:], points[2:], strict=False))
    return good


def newrf() -> dict[str, Any]:
    """Both rooms of the NeWRF data compared with MATLAB's image method, with rows for the table."""
    figures = {name: image_method_agreement(room_file(name)) for name in ROOMS}
    rows = []
    for name, room in figures.items():
        lacking = f"MATLAB lacks {room['paths_matlab_lacks']} more, of which {room['of_these_confirmed']} are confirmed"
        value = f"{100 * room['share_found']:.2f} %, lengths within {1e3 * room['length_error_m']:.2f} mm"
        cea = f"{room['cea_db']['median']:.0f} dB (p10 {room['cea_db']['p10']:.0f} dB)"
        rows += [
            line(f"{name}, paths found ({lacking})", value, "99 %, 1 mm"),
            line(f"{name}, channel of all {room['receivers']} positions, median CEA", cea, "30 dB"),
        ]
    return {"rows": rows, "rooms": figures}
