"""A furnished room as a CAD program exports it: curved furniture of 100,000 facets, most in planes of their own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import Parts, write_scene

from wrf_mi.core import Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import RayTracer

CARRIER_HZ = 920e6
LENGTH, WIDTH, HEIGHT = 5.0, 4.0, 2.6
WALLS = ("itu_concrete", "itu_plasterboard", "itu_brick", "itu_brick", "itu_wood", "itu_wood")
"""Stated materials of floor, ceiling and walls."""
TRUE_WALLS = ("itu_wood", "itu_metal", "itu_plasterboard", "itu_brick", "itu_concrete", "itu_glass")


def cushion(low: tuple[float, ...], high: tuple[float, ...], count: int, roundness: float = 0.35) -> trimesh.Trimesh:
    """A closed body of 2 count (2 count - 1) or so facets between two corners [3], metres: a superellipsoid.

    Exponents below 1 flatten its sides; all facets but those about the poles differ in their planes.
    """
    sphere = trimesh.creation.uv_sphere(count=[count, 2 * count])
    points = np.sign(sphere.vertices) * np.abs(sphere.vertices) ** roundness
    centre, half = (np.add(high, low) / 2, np.subtract(high, low) / 2)
    # A bulge without symmetry, so that the two triangles of a quadrilateral are not in one plane.
    points += 0.01 * np.sin(3.1 * points[:, [1, 2, 0]] + [0.3, 0.7, 1.1])
    return trimesh.Trimesh(centre + half * points, sphere.faces, process=False)


def handle(x: float, y: float, z: float, sections: int) -> trimesh.Trimesh:
    """A horizontal handle of a drawer, a capsule of 12 cm."""
    mesh = trimesh.creation.capsule(0.12, 0.008, count=[sections, sections])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    mesh.apply_translation([x, y, z])
    return mesh


def box(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    """A box between two corners [3], metres."""
    return trimesh.creation.box(bounds=[low, high])


def furniture(detail: int = 33) -> Parts:
    """Name of each piece with its material and mesh; about 94 detail^2 facets."""
    join = trimesh.util.concatenate
    mattress = cushion((0.3, 0.2, 0.3), (2.3, 1.8, 0.55), 2 * detail, 0.2)
    pillows = [cushion((0.35, y, 0.55), (0.8, y + 0.6, 0.7), detail, 0.6) for y in (0.3, 1.1)]
    seats = [cushion((x, 3.1, 0.25), (x + 0.7, 3.8, 0.5), detail, 0.3) for x in (0.4, 1.15, 1.9)]
    backs = [cushion((x, 3.6, 0.5), (x + 0.7, 3.9, 1.0), detail, 0.4) for x in (0.4, 1.15, 1.9)]
    drawers = [box((4.2, y, 0.05), (4.9, y + 0.75, 0.9)) for y in (0.4, 1.2, 2.0)]
    handles = [handle(4.19, y + 0.3, z, detail // 4) for y in (0.4, 1.2, 2.0) for z in (0.25, 0.5, 0.75)]
    lamp = trimesh.creation.cone(0.2, 0.25, sections=4 * detail)
    lamp.apply_translation([2.6, 2.0, 2.0])
    return {
        "mattress": ("itu_plasterboard", mattress),
        "pillows": ("itu_plasterboard", join(pillows)),
        "bed": ("itu_wood", box((0.25, 0.15, 0.05), (2.35, 1.85, 0.3))),
        "seats": ("itu_wood", join(seats)),
        "backs": ("itu_wood", join(backs)),
        "cabinets": ("itu_chipboard", join(drawers)),
        "handles": ("itu_metal", join(handles)),
        "lamp": ("itu_metal", lamp),
    }


def parts(detail: int = 33, walls: Sequence[str] = WALLS) -> Parts:
    """The furniture in six walls of given materials."""
    sheets = (
        sheet(2, 0.0, (0.0, LENGTH), (0.0, WIDTH)),
        sheet(2, HEIGHT, (0.0, LENGTH), (0.0, WIDTH)),
        sheet(0, 0.0, (0.0, WIDTH), (0.0, HEIGHT)),
        sheet(0, LENGTH, (0.0, WIDTH), (0.0, HEIGHT)),
        sheet(1, 0.0, (0.0, LENGTH), (0.0, HEIGHT)),
        sheet(1, WIDTH, (0.0, LENGTH), (0.0, HEIGHT)),
    )
    names = ("floor", "ceiling", "west", "east", "south", "north")
    return {**dict(zip(names, zip(walls, sheets, strict=True), strict=True)), **furniture(detail)}


def write_room(folder: Path, detail: int = 33, walls: Sequence[str] = WALLS) -> Path:
    """The room as a scene folder."""
    return write_scene(folder, parts(detail, walls), "Room of a CAD program", "tests.cad_room").parent


def positions(count: int, seed: int = 0) -> np.ndarray:
    """Transmitters [count, 3] in metres, between the pieces of furniture."""
    rng = np.random.default_rng([seed, 2])
    return rng.uniform([0.4, 1.95, 1.1], [4.0, 3.6, 2.3], (count, 3)).round(3)


def record(truth: Path, task: str, rows: int = 15) -> Record:
    """Observations in a room, those of the last rows for tests: spectra of a 4 x 4 array, signal strengths or channels
    of one antenna on eight subcarriers.
    """
    hz = CARRIER_HZ + np.linspace(-20e6, 20e6, 8) * (task == "csi")
    array_m = planar_array(4, 4, 0.16) if task == "spectrum" else None
    receiver = Receiver("gateway", np.array([3.2, 0.5, 1.4]), np.array(UPRIGHT), array_m=array_m)
    shape = {"spectrum": (90, 360), "rssi": (), "csi": (8,)}[task]
    empty = np.zeros((1, rows, *shape), np.complex64 if task == "csi" else np.float32)
    official = np.arange(rows - rows // 5), np.arange(rows - rows // 5, rows)
    frequencies_hz = hz if task == "csi" else hz[:1]
    made = Record(
        "cad-room", task, positions(rows), (receiver,), empty, frequencies_hz=frequencies_hz, official=official
    )
    observed = RayTracer(truth, instrument_of(made), TraceOptions(transmission=True, depth=3))(made.tx_pos_m)
    return replace(made, observation=observed.astype(empty.dtype))
