"""The default data set: spectra of the `laboratory` scene, traced on this machine without noise.

Layout and array are those of rfid-lab: a 4 x 4 array with 0.16 m spacing at 920 MHz, 200 transmitter positions along a
path within 0.5 x 1 x 0.2 m, about 5 m away. A simulated LiDAR scan of the scene is included (2 cm range noise, 1 %
strays).
"""

from __future__ import annotations

import io
import logging
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import yaml
from wrf_mi_scenes import scenes
from wrf_mi_scenes.mitsuba_xml import Parts, write_scene

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import load, make_splits, read_spectrum_folder, user_cache, write_spectrum_folder
from ..datasets.registry import locate
from ..receivers.instruments import SpectrumInstrument
from ..scene.scan import simulate_scan
from ..tracing.options import TraceOptions
from ..tracing.tracer import RayTracer

logger = logging.getLogger(__name__)

NAME = "laboratory"
FREQUENCY_HZ = 920e6
SPACING_M = 0.16
POSITIONS = 200
OPTIONS = TraceOptions(max_depth=3, seed=1)
RECIPE = "traced.yml"
"""File in the cached folder with the parameters of its data; other parameters make them anew."""
SCAN = "lidar/points.npz"
"""File in that folder with the simulated LiDAR scan of the scene."""
SCANNER_M = ((2.0, 2.5, 1.5), (3.0, 5.0, 1.5), (5.5, 3.5, 1.5), (7.0, 1.8, 1.5), (7.6, 6.0, 1.6), (5.8, 1.0, 1.2))
"""Positions of the LiDAR, metres: five in the room and one in the inner room."""
SCANNED_RAYS = 60_000
FORMAT = 5  # version of the files, to be raised when they change for equal parameters

RECEIVER = Receiver(
    name="gateway1",
    position_m=np.array([7.4, 3.3, 0.9]),
    # Array's x = (0.0698, -0.9976, 0), y = up, boresight z = (-0.9976, -0.0698, 0).
    orientation_xyzw=np.array([0.51712, -0.48227, -0.48227, 0.51712]),
)
ARRAY_FACTS = {
    "array": f"4 x 4, {SPACING_M} m",
    "receiver": [*RECEIVER.position_m.tolist(), *RECEIVER.orientation_xyzw.tolist()],
}
"""Entries of a recipe that describe the array."""


def transmitter_path(count: int = POSITIONS) -> FloatArray:
    """Positions [count, 3] in metres along a closed curve in the free west part of the room, in the order of time."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    offsets = np.stack([0.25 * np.sin(2 * turn + 0.3), 0.5 * np.cos(turn), 0.1 * np.sin(3 * turn)], axis=-1)
    return np.round(np.array([2.2, 3.0, 1.7]) + offsets, 4)


def laboratory_record(folder: str | Path | None = None, progress: bool = False) -> Record:
    """The laboratory's 200 spectra in 8 bits: read from an earlier call, or traced now (some 5 s) and stored.

    The official split is a seeded random split of 160 and 40 rows.

    Args:
        folder: folder of the spectra in the NeRF2 layout; by default ``laboratory/`` below ``WRF_MI_DATA`` if it
            exists, else in the user's cache.
        progress: show a progress bar on standard error.
    """
    if folder is None:
        if (found := provided(NAME)) is not None:
            return found
        folder = user_cache() / NAME
    folder = Path(folder)
    info = scenes()[NAME]
    facts = {
        "format": FORMAT,
        "scene": info.name,
        "scene_sha256": info.sha256,
        "frequency_hz": FREQUENCY_HZ,
        **ARRAY_FACTS,
        "positions": POSITIONS,
        "scanner": [list(place) for place in SCANNER_M],
        "scanned_rays": SCANNED_RAYS,
        "max_depth": OPTIONS.max_depth,
        "rays_per_source": OPTIONS.rays,
        "seed": OPTIONS.seed,
        "sionna_rt": version("sionna-rt"),
    }
    recipe = yaml.safe_dump(facts, sort_keys=False)
    if not is_made(folder, recipe):
        logger.info("tracing %d spectra in the scene %s into %s", POSITIONS, NAME, folder)
        positions, frequency_hz = transmitter_path(), np.array([FREQUENCY_HZ])
        receiver = replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M))
        tracer = RayTracer(info.folder, SpectrumInstrument((receiver,), frequency_hz), OPTIONS)
        spectra = tracer.observe(tracer.trace(positions, progress))
        record = Record(NAME, "spectrum", positions, (receiver,), spectra, frequencies_hz=frequency_hz)
        split = make_splits(record, "random", seed=OPTIONS.seed)[0]
        record = replace(record, official=(split.all_train, split.test))
        extra: dict[str, str | bytes] = {RECIPE: recipe, SCAN: scan_file(info.xml, OPTIONS.seed)}
        write_spectrum_folder(folder, record, replace=True, extra=extra)
    return read_spectrum_folder(folder, NAME)


def provided(name: str) -> Record | None:
    """The record of a known data set below ``WRF_MI_DATA``; None if it is not there."""
    found = locate(name)
    return None if found is None or found.parent == user_cache() else replace(load(found), name=name)


def is_made(folder: Path, recipe: str) -> bool:
    """Whether a folder holds data of the parameters of a recipe."""
    return (folder / RECIPE).is_file() and (folder / RECIPE).read_text(encoding="utf-8") == recipe


def scan_file(xml: Path, seed: int, scanner_m: Sequence[tuple[float, float, float]] = SCANNER_M) -> bytes:
    """Content of the file `SCAN` of a scene, by default one in the laboratory's room."""
    points = simulate_scan(xml, scanner_m, rays_per_pose=SCANNED_RAYS, seed=seed)
    stream = io.BytesIO()
    np.savez_compressed(stream, points=points.astype(np.float32))
    return stream.getvalue()


def scene_files(parts: Parts, folder: str, origin: str) -> dict[str, bytes]:
    """Content of the files of a measured scene by their paths in a folder; ``origin`` is the module of its parts."""
    with tempfile.TemporaryDirectory() as work:
        write_scene(Path(work), parts, "Bare walls as measured, one material", origin)
        files = sorted(file for file in Path(work).rglob("*") if file.is_file())
        return {f"{folder}/{file.relative_to(work).as_posix()}": file.read_bytes() for file in files}
