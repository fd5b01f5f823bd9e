"""A room of six walls and a board with known errors of its planes, and channels in it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Receiver, Record
from wrf_mi.correction.state import rigid_motions
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.tracer import RayTracer

CARRIER_HZ = 2.4e9
LENGTH, WIDTH, HEIGHT = 6.0, 4.5, 2.7
TRUE_MATERIALS = {
    "floor": "itu_concrete",
    "ceiling": "itu_plasterboard",
    "wall_01": "itu_brick",
    "wall_02": "itu_glass",
    "wall_03": "itu_brick",
    "wall_04": "itu_wood",
    "board": "itu_metal",
}


def surfaces() -> list[Surface]:
    """The room as a scan would have it, less its errors."""
    parts: dict[str, tuple[Any, Any]] = {
        "floor": ("floor", sheet(2, 0, (0, LENGTH), (0, WIDTH))),
        "ceiling": ("ceiling", sheet(2, HEIGHT, (0, LENGTH), (0, WIDTH))),
        "wall_01": ("wall", sheet(0, 0, (0, WIDTH), (0, HEIGHT))),
        "wall_02": ("wall", sheet(0, LENGTH, (0, WIDTH), (0, HEIGHT))),
        "wall_03": ("wall", sheet(1, 0, (0, LENGTH), (0, HEIGHT))),
        "wall_04": ("wall", sheet(1, WIDTH, (0, LENGTH), (0, HEIGHT))),
        "board": ("other", sheet(0, 4.1, (0.4, 1.9), (0.3, 2.0))),
    }
    return [Surface(n, kind, np.asarray(m.vertices), np.asarray(m.faces)) for n, (kind, m) in parts.items()]


def stated_scene(folder: Path, materials: dict[str, str] | None = None) -> Path:
    """The room with the materials of the rules, or with others."""
    facts = Materials(surfaces=materials or {})
    return write_scene(folder, surfaces(), frame="made up", source="made up", materials=facts)


def channels(scene: Path, count: int, snr_db: float = np.inf, seed: int = 0) -> Record:
    """Channels on eight subcarriers at random positions in a scene."""
    rng = np.random.default_rng([seed, 1])
    positions = rng.uniform([0.4, 0.4, 0.4], [LENGTH - 0.4, WIDTH - 0.4, 1.9], (count, 3))
    positions = positions[np.abs(positions[:, 0] - 4.1) > 0.15]
    count = len(positions)
    receiver = Receiver("anchor", np.array([1.0, 1.1, 2.2]), np.array([0, 0, 0, 1.0]))
    hz = CARRIER_HZ + np.linspace(-50e6, 50e6, 8)
    empty = np.zeros((1, count, 8), np.complex64)
    official = np.arange(count - 10), np.arange(count - 10, count)
    record = Record("made-up", "csi", positions, (receiver,), empty, frequencies_hz=hz, official=official)
    tracer = RayTracer(scene, instrument_of(record), TraceOptions(transmission=True, depth=3))
    observed = tracer(positions)
    noise = np.sqrt(np.square(np.abs(observed)).mean() / 10 ** (snr_db / 10) / 2)
    observed = observed + noise * (rng.normal(size=observed.shape) + 1j * rng.normal(size=observed.shape))
    return replace(record, observation=observed.astype(np.complex64))


def true_scene(folder: Path, seed: int = 0) -> tuple[Path, np.ndarray, np.ndarray]:
    """The room as it is: each plane and the whole frame moved. Shifts [q] in metres and tilts [q, 2] in rad."""
    rng = np.random.default_rng(seed)
    base = open_scene(stated_scene(folder / "base", TRUE_MATERIALS), CARRIER_HZ)
    planes = scene_surfaces(base)
    count = len(planes.normal)
    frame = rigid_motions(planes) @ np.concatenate([rng.normal(0, 0.015, 3), rng.normal(0, 0.005, 3)])
    shift = rng.normal(0, 0.01, count) + frame[:count]
    tilt = rng.normal(0, 0.003, (count, 2)) + frame[count:].reshape(count, 2)
    return write_corrected_scene(folder / "true", base, {SHIFT: shift, TILT: tilt}), shift, tilt
