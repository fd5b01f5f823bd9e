"""The embedded default: spectra of our own laboratory scene, traced on this machine in place of measured ones.

Same form as rfid-lab: a 4 x 4 array with 0.16 m spacing at 920 MHz, 200 transmitter positions along a path within
0.5 x 1 x 0.2 m, about 5 m away. It is synthetic: no noise, no calibration error, nothing that moves. A simulated LiDAR
scan of the same scene lies beside the spectra (2 cm range noise, 1 % strays), for the way from points to a mesh.
"""

from __future__ import annotations

import io
import logging
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import yaml
from wrf_mi_scenes import SceneInfo, scenes

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import load, make_splits, read_spectrum_folder, user_cache, write_spectrum_folder
from ..datasets.registry import locate
from ..scene.scan import simulate_scan
from ..tracing.options import TraceOptions
from ..tracing.scenes import open_scene
from ..tracing.tracer import trace_spectra

logger = logging.getLogger(__name__)

NAME = "laboratory"
FREQUENCY_HZ = 920e6
SPACING_M = 0.16
POSITIONS = 200
OPTIONS = TraceOptions(max_depth=3, seed=1)
RECIPE = "traced.yml"
"""File in the cached folder that states how its spectra were made; another recipe makes them anew."""
SCAN = "lidar/points.npz"
"""File in that folder with what a simulated LiDAR sees of the scene."""
SCANNER_M = ((2.0, 2.5, 1.5), (3.0, 5.0, 1.5), (5.5, 3.5, 1.5), (7.0, 1.8, 1.5), (7.6, 6.0, 1.6), (5.8, 1.0, 1.2))
"""Where the LiDAR stands, metres: five places of the room and one of the inner room."""
SCANNED_RAYS = 60_000
FORMAT = 4
"""To be raised when the same recipe would give other files."""

RECEIVER = Receiver(
    name="gateway1",
    position_m=np.array([7.4, 3.3, 0.9]),
    # Array's x = (0.0698, -0.9976, 0), y = up, boresight z = (-0.9976, -0.0698, 0).
    orientation_xyzw=np.array([0.51712, -0.48227, -0.48227, 0.51712]),
)


def transmitter_path(count: int = POSITIONS) -> FloatArray:
    """Positions [count, 3] in metres along a closed curve in the free west part of the room, in the order of time."""
    turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
    offsets = np.stack([0.25 * np.sin(2 * turn + 0.3), 0.5 * np.cos(turn), 0.1 * np.sin(3 * turn)], axis=-1)
    return np.round(np.array([2.2, 3.0, 1.7]) + offsets, 4)


def laboratory_record(folder: str | Path | None = None, progress: bool = False) -> Record:
    """The laboratory's 200 spectra: read if they were traced before, else traced now (some 5 s) and kept.

    The official split is a seeded random one of 160 and 40 rows. Spectra are kept as 8-bit grey, as measured ones are.

    Args:
        folder: where they are kept in the NeRF2 layout; by default ``laboratory/`` below ``WRF_MI_DATA`` if it is
            there, else in the user's cache.
        progress: show a progress bar on standard error.
    """
    if folder is None:
        found = locate(NAME)
        if found is not None and found.parent != user_cache():
            return load(found)
        folder = user_cache() / NAME
    folder = Path(folder)
    info = scenes()[NAME]
    recipe = _recipe(info)
    if not (folder / RECIPE).is_file() or (folder / RECIPE).read_text(encoding="utf-8") != recipe:
        logger.info("tracing %d spectra in the scene %s into %s", POSITIONS, NAME, folder)
        extra: dict[str, str | bytes] = {RECIPE: recipe, SCAN: _scan(info)}
        write_spectrum_folder(folder, _trace(info, progress), replace=True, extra=extra)
    return read_spectrum_folder(folder, NAME)


def _trace(info: SceneInfo, progress: bool) -> Record:
    scene = open_scene(info.xml, FREQUENCY_HZ, info.thickness_m)
    positions, array_m = transmitter_path(), planar_array(4, 4, SPACING_M)
    spectra = trace_spectra(
        scene,
        positions,
        RECEIVER,
        array_m,
        FREQUENCY_HZ,
        options=OPTIONS,
        progress=progress,
    )
    record = Record(
        name=NAME,
        task="spectrum",
        tx_pos_m=positions,
        receivers=(replace(RECEIVER, array_m=array_m),),
        observation=spectra[None],
        frequencies_hz=np.array([FREQUENCY_HZ]),
    )
    split = make_splits(record, "random", seed=OPTIONS.seed)[0]
    return replace(record, official=(split.all_train, split.test))


def _scan(info: SceneInfo) -> bytes:
    points = simulate_scan(info.xml, SCANNER_M, rays_per_pose=SCANNED_RAYS, seed=OPTIONS.seed)
    stream = io.BytesIO()
    np.savez_compressed(stream, points=points.astype(np.float32))
    return stream.getvalue()


def _recipe(info: SceneInfo) -> str:
    facts = {
        "format": FORMAT,
        "scene": info.name,
        "scene_sha256": info.sha256,
        "frequency_hz": FREQUENCY_HZ,
        "array": f"4 x 4, {SPACING_M} m",
        "receiver": [*RECEIVER.position_m.tolist(), *RECEIVER.orientation_xyzw.tolist()],
        "positions": POSITIONS,
        "scanner": [list(place) for place in SCANNER_M],
        "scanned_rays": SCANNED_RAYS,
        "max_depth": OPTIONS.max_depth,
        "rays_per_source": OPTIONS.rays,
        "seed": OPTIONS.seed,
        "sionna_rt": version("sionna-rt"),
    }
    return yaml.safe_dump(facts, sort_keys=False)
