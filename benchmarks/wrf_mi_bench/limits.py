"""Figures of ``docs/scenes.md``, as a Markdown table: ``python -m wrf_mi_bench.limits``."""

import logging
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.constants import speed_of_light

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

from .wave_formulas import wedge

HZ = 2.44e9
DIFFRACTED = TraceOptions(transmission=False, line_of_sight=False, reflection=False, diffraction=True, depth=1)
REFLECTED = TraceOptions(transmission=False, line_of_sight=False, depth=1)
BEFORE, BEHIND = (-3.0, 0.0, -1.5), (3.0, 0.0, -1.5)
"""Ends on both sides of a screen at x = 0 whose upper edge lies at z = 0."""
CUBE = """<scene version="2.1.0">
<bsdf type="itu-radio-material" id="metal">
<string name="type" value="metal"/><float name="thickness" value="0.1"/></bsdf>
<shape type="cube" id="cube"><transform name="to_world"><scale value="0.5"/></transform><ref id="metal"/></shape>
</scene>"""


def opened(mesh: trimesh.Trimesh, material: str = "metal") -> Any:
    """A scene (``sionna.rt.Scene``) of one mesh."""
    with tempfile.TemporaryDirectory() as folder:
        mesh.export(f"{folder}/mesh.ply")
        return open_scene(f"{folder}/mesh.ply", HZ, material=material)


def traced(scene: Any, tx_pos_m: Any, rx_pos_m: Any, options: TraceOptions = DIFFRACTED) -> Paths:
    """Paths from transmitters [n, 3] to one receiver [3], metres."""
    return trace_paths(scene, tx_pos_m, Receiver("rx", np.array(rx_pos_m, float), np.array(UPRIGHT)), options).paths


def level_db(paths: Paths) -> float:
    """Power of the sum of all gains."""
    return float(20 * np.log10(abs(paths.gain.sum())))


def free_space_db(distance_m: float) -> float:
    """Friis' path gain of isotropic antennas."""
    return float(20 * np.log10(speed_of_light / HZ / (4 * np.pi * distance_m)))


def half_plane_db() -> float:
    """Gain from `BEFORE` to `BEHIND` by a conducting half plane, relative to free space; field across the edge."""
    s = float(np.hypot(BEFORE[0], BEFORE[2]))
    angle = np.arctan2(abs(BEFORE[0]), abs(BEFORE[2]))  # from the screen; that of the other side is its mirror
    _, across = wedge(2, 2 * np.pi * HZ / speed_of_light, s, s, angle, np.array([2 * np.pi - angle]))
    return float(20 * np.log10(abs(across[0]) * abs(BEHIND[0] - BEFORE[0])))


def sheet(halvings: int = 0) -> trimesh.Trimesh:
    """The screen below z = 0, 40 m wide and 20 m high, each of its two triangles divided into four some times."""
    corners = [[0, -20, -20], [0, 20, -20], [0, 20, 0], [0, -20, 0]]
    mesh = trimesh.Trimesh(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], process=False)
    for _ in range(halvings):
        mesh = mesh.subdivide()
    return mesh


def facets(count: int, tilt_deg: float) -> trimesh.Trimesh:
    """A wall of 10 m at x = 0 of count x count squares, each tilted about an axis of its own in the wall."""
    rng, half = np.random.default_rng(0), 5 / count
    square = half * np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]])
    middles = np.linspace(-5 + half, 5 - half, count)
    vertices, faces = list[FloatArray](), list[FloatArray]()
    for y in middles:
        for z in middles:
            azimuth = rng.uniform(0, 2 * np.pi)
            axis = [0, np.cos(azimuth), np.sin(azimuth)]
            turn = trimesh.transformations.rotation_matrix(np.radians(tilt_deg), axis)[:3, :3]
            faces.append(4 * len(vertices) + np.array([[0, 1, 2], [0, 2, 3]]))
            vertices.append(square @ turn.T + [0, y, z])
    return trimesh.Trimesh(np.concatenate(vertices), np.concatenate(faces), process=False)


def room() -> tuple[Any, FloatArray, FloatArray]:
    """A closed concrete room of 6 x 5 x 2.5 m with three boxes in it, and 60 pairs of free positions [60, 3] each."""
    rng = np.random.default_rng(0)
    walls = np.array([(0, 0, 0), (6, 5, 2.5)])
    low_m = np.array([(1.5, 1.7, 0), (3.7, 2.5, 0), (2.9, 0.6, 0)])
    pieces = np.stack([low_m, [(2.5, 2.3, 1.2), (4.3, 3.5, 2), (4.1, 1.4, 0.8)]], axis=1)
    ends = rng.uniform([0.3, 0.3, 0.3], [5.7, 4.7, 2.3], (400, 3))
    solid = np.any([((ends > piece[0]) & (ends < piece[1])).all(axis=1) for piece in pieces], axis=0)
    boxes: Any = trimesh.util.concatenate([trimesh.creation.box(bounds=corners) for corners in (walls, *pieces)])
    tx_pos_m, rx_pos_m = np.split(ends[~solid][:120], 2)
    return opened(boxes, "concrete"), tx_pos_m, rx_pos_m


def rows() -> Iterator[tuple[str, str]]:
    relative = [level_db(traced(opened(sheet()), [BEFORE], BEHIND)), half_plane_db()]
    relative[0] -= free_space_db(BEHIND[0] - BEFORE[0])
    text = "conducting half plane, vertical antennas 3 m from it and 1.5 m below its edge, relative to free space"
    yield text, f"{relative[0]:.1f} dB; in theory {relative[1]:.1f} dB"
    wall = trimesh.creation.box(bounds=[(-0.1, -20, -20), (0.1, 20, 0)])
    yield "the same behind a wall of 0.2 m", f"{len(traced(opened(wall), [BEFORE], BEHIND))} paths"
    scene, tx_pos_m, rx_pos_m = room()
    pairs = [[traced(scene, [a], b), traced(scene, [b], a)] for a, b in zip(tx_pos_m, rx_pos_m, strict=True)]
    change_db = np.array([abs(level_db(forth) - level_db(back)) for forth, back in pairs if len(forth) and len(back)])
    share = f"{np.mean(change_db > 1):.0%} of {len(change_db)} pairs by more than 1 dB"
    yield "diffracted power from A to B against that from B to A, concrete room with three boxes", f"{share} apart"
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "cube.xml").write_text(CUBE)
        cube, mesh = open_scene(f"{folder}/cube.xml", HZ), opened(trimesh.creation.box((1, 1, 1)))
    ends = np.array([[(-3, 0.1, 0), (0.2, 3, 0.1)], [(-3, 0.1, 0), (3, 0.2, 0.7)], [(-3, 0.1, 0.7), (0.3, 2, -0.1)]])
    apart = [level_db(traced(cube, [a], b)) - level_db(traced(mesh, [a], b)) for a, b in ends]
    text = ", ".join(f"{x:.1f}" for x in apart)
    yield "Mitsuba's `cube` of metal less the same cube as a mesh, three pairs", f"{text} dB"
    divided = opened(sheet(4))
    for rays in (1 << 12, 1 << 17):
        options = [TraceOptions(**{**vars(DIFFRACTED), "rays": rays, "seed": seed}) for seed in range(1, 9)]
        counts = [len(traced(divided, [(-5.0, 0.0, -1.0)], (5.0, 0.0, -1.0), each)) for each in options]
        numbers = f"{min(counts)} to {max(counts)}" if min(counts) < max(counts) else str(counts[0])
        yield f"edges of the half plane of 512 triangles, {rays} rays, eight seeds", f"{numbers} found"
    tx = np.random.default_rng(1).uniform([0.5, -3, -3], [4, 3, 3], (200, 3))
    for count in (10, 50, 100):
        paths = traced(opened(facets(count, 1.0)), tx, (3.0, 0.3, 0.2), REFLECTED)
        reflections = np.bincount(paths.tx, minlength=len(tx))
        text = f"{np.mean(reflections == 0):.0%} without, {np.mean(reflections > 1):.0%} with several"
        yield f"reflections at a wall of facets of {1000 / count:.0f} cm that are tilted by 1 degree, 200 pairs", text
    box = opened(trimesh.creation.box(bounds=[(0, 0, 0), (5, 4, 2.7)]))
    for depth, passing in ((10, False), (6, True), (8, True)):
        begun = time.perf_counter()
        paths = traced(box, [(1.0, 1.5, 1.2)], (4.0, 3.0, 2.0), TraceOptions(depth=depth, transmission=passing))
        text = f"{time.perf_counter() - begun:.1f} s, {len(paths)} paths"
        kinds = "with" if passing else "without"
        yield f"closed metal box of 5 x 4 x 2.7 m, one pair, depth {depth}, {kinds} transmission", text


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    print("| set-up | result |\n| --- | --- |")
    for what, result in rows():
        print(f"| {what} | {result} |", flush=True)
