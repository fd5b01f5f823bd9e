"""The traced room: spectra of transmitters anywhere in a furnished room, and the bare walls that a model is given.

What the spectra are traced in (`wrf_mi_scenes.furnished`) has furniture, windows, doors and eight materials,
diffraction at edges of metal and diffuse reflection. What a model is given as the room's mesh has none of it: walls,
floor and ceiling, each plane off by some centimetres, all of one generic material. So a ray tracer is not judged by
itself.

The form is that of rfid-lab and of the laboratory (`wrf_mi.synthetic.laboratory`): a 4 x 4 array with 0.16 m spacing at
920 MHz, 8-bit spectra scaled to their own minimum and maximum. Transmitters stand anywhere in the room's free volume
between 0.5 and 2 m height, the space behind the array and the inner room included.
"""

from __future__ import annotations

import io
import logging
import shutil
import tempfile
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress
from scipy.spatial import cKDTree
from wrf_mi_scenes.build_laboratory import LENGTH, WIDTH
from wrf_mi_scenes.furnished import furnished_parts, measured_parts, write_scene

from ..core import Paths, Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import read_spectrum_folder, user_cache, write_spectrum_folder
from ..receivers.array import bartlett_spectrum, minmax_scale
from ..receivers.channel import array_channels
from ..scene.scan import simulate_scan
from ..tracing.devices import solids, winding_number
from ..tracing.options import TraceOptions
from ..tracing.scenes import open_scene
from ..tracing.solve import trace_paths
from ..tracing.surfaces import scene_surfaces
from .laboratory import FREQUENCY_HZ, RECEIVER, RECIPE, SCAN, SCANNED_RAYS, SCANNER_M, SPACING_M

logger = logging.getLogger(__name__)

NAME = "traced-room"
MEASURED = "room"
"""Folder beside the spectra with the measured room's scene: what a model is given."""
FORMAT = 1
"""To be raised when the same recipe would give other files."""
SCATTERING, DIFFRACTION = 2, 8
"""Kinds of interaction (`wrf_mi.core.Paths`) from which a spherical wave goes out anew."""


@dataclass(frozen=True)
class TracedRoom:
    """How the traced room is made.

    Attributes:
        train: rows that train.
        test: rows that score.
        low_m, high_m: bounds of the transmitters' height, metres.
        clear_m: from every surface, metres.
        from_array_m: from the array, metres.
        depth: interactions of a path at most.
        reflections: of these at most.
        rays: for specular paths and diffraction.
        scattered_rays: for diffuse reflection: each hit is a patch of rough surface.
        scattered_depth: interactions of a scattered path at most.
        scattering: share of the reflected amplitude that every surface scatters.
        mesh_error_m: standard deviation of the measured room's planes along their normals, metres.
        seed: of positions, of the measured room's errors, of rays.
    """

    train: int = 1600
    test: int = 200
    low_m: float = 0.5
    high_m: float = 2.0
    clear_m: float = 0.1
    from_array_m: float = 0.5
    depth: int = 4
    reflections: int = 3
    rays: int = 1 << 16
    scattered_rays: int = 1 << 12
    scattered_depth: int = 3
    scattering: float = 0.3
    mesh_error_m: float = 0.02
    seed: int = 1


DEFAULT = TracedRoom()
OPAQUE = "itu_metal"
"""Edges of other materials diffract little, as most of the wave passes through them; Sionna RT takes every sheet for
opaque at its edges, and so would put a strong wave there that a thin board does not make."""
CHUNK_SIZE = 200
"""Transmitters traced at once."""


def traced_room(
    folder: str | Path | None = None, room: TracedRoom = DEFAULT, progress: bool = False
) -> tuple[Record, Path]:
    """The traced room's spectra and the scene that a model may be given: read if made before, else made now and kept.

    Making the default takes some minutes. The official split is the first ``train`` rows and the rest; positions are
    drawn independently, so any of its beginnings is a fair draw. A simulated LiDAR scan of the furnished room lies
    beside the spectra as ``lidar/points.npz``.

    Args:
        folder: where it is kept in the NeRF2 layout; by default ``traced-room/`` in the user's cache.
        room: how it is made.
        progress: show progress bars on standard error.

    Returns:
        The record and the folder of the measured room's scene.
    """
    folder = user_cache() / NAME if folder is None else Path(folder)
    recipe = _recipe(room)
    if not (folder / RECIPE).is_file() or (folder / RECIPE).read_text(encoding="utf-8") != recipe:
        logger.info("tracing %d spectra of the furnished room into %s", room.train + room.test, folder)
        with tempfile.TemporaryDirectory() as work:
            truth = write_scene(Path(work) / "truth", furnished_parts(), "Furnished room, all that is in it")
            given = Path(work) / MEASURED
            write_scene(given, measured_parts(room.mesh_error_m, room.seed), "Bare walls as measured, one material")
            record = _trace(truth.parent, room, progress)
            extra: dict[str, str | bytes] = {RECIPE: recipe, SCAN: _scan(truth, room.seed)}
            write_spectrum_folder(folder, record, replace=True, extra=extra)
            shutil.copytree(given, folder / MEASURED)
    return read_spectrum_folder(folder, NAME), folder / MEASURED


def transmitters(scene: Any, room: TracedRoom) -> FloatArray:
    """Positions [train + test, 3] in metres, uniform over the free volume of an opened scene, to 0.1 mm.

    Args:
        scene: ``sionna.rt.Scene``.
        room: bounds, clearances and seed.
    """
    surfaces, rng = scene_surfaces(scene), np.random.default_rng([room.seed, 0])
    mesh = trimesh.Trimesh(surfaces.triangles.reshape(-1, 3), np.arange(3 * len(surfaces.triangles)).reshape(-1, 3))
    # A point every 2 cm or so: much less than the clearance.
    tree = cKDTree(trimesh.sample.sample_surface(mesh, int(mesh.area / 4e-4), seed=room.seed)[0])
    count, found = room.train + room.test, np.zeros((0, 3))
    while len(found) < count:
        drawn = np.round(rng.uniform([0, 0, room.low_m], [LENGTH, WIDTH, room.high_m], (count, 3)), 4)
        free = tree.query(drawn)[0] > room.clear_m
        free &= np.linalg.norm(drawn - RECEIVER.position_m, axis=1) > room.from_array_m
        for face in solids(surfaces):
            free &= winding_number(surfaces.triangles[face], drawn) < 0.5
        found = np.concatenate([found, drawn[free]])
    return found[:count]


def array_signals(paths: Paths, receiver: Receiver, array_m: FloatArray, frequency_hz: float) -> NDArray[np.complex128]:
    """Element signals [n, m] at one frequency of paths from an array to n transmitters; see `array_channels`."""
    return array_channels(paths, receiver, array_m, frequency_hz)[..., 0]


def _trace(scene_folder: Path, room: TracedRoom, progress: bool) -> Record:
    scene, array_m = open_scene(scene_folder, FREQUENCY_HZ), planar_array(4, 4, SPACING_M)
    positions = transmitters(scene, room)
    for material in scene.radio_materials.values():
        material.scattering_coefficient = room.scattering
    # The array searches: all transmitters then see the same patches of rough wall and the same edges. Sionna RT keeps
    # the direction of the search where there is diffraction, so the array takes the transmitter's part.
    shared: dict[str, Any] = {"transmission": True, "seed": room.seed}
    shared |= {"scattering_coefficient": room.scattering}
    exact = TraceOptions(
        diffraction=True, max_depth=room.depth, max_reflections=room.reflections, rays=room.rays, **shared
    )
    rough = TraceOptions(scattering=True, max_depth=room.scattered_depth, rays=room.scattered_rays, **shared)
    opaque = tuple(name for name, (material, _) in furnished_parts().items() if material == OPAQUE)
    spectra = np.empty((1, len(positions), 90, 360), np.float32)
    with Progress(console=Console(stderr=True), transient=True, disable=not progress) as bar:
        for start in bar.track(range(0, len(positions), CHUNK_SIZE), description="tracing the furnished room"):
            part = positions[start : start + CHUNK_SIZE]
            ends = [Receiver(str(i), place, np.array([0.0, 0.0, 0.0, 1.0])) for i, place in enumerate(part)]
            signals = np.zeros((len(part), len(array_m)), complex)
            for options in (exact, rough):
                paths = trace_paths(scene, RECEIVER.position_m, ends, options).paths
                paths = paths.select(_kept(paths, opaque, options.scattering))
                signals += array_signals(paths, RECEIVER, array_m, FREQUENCY_HZ)
            for row, signal in enumerate(signals):
                spectra[0, start + row] = minmax_scale(bartlett_spectrum(signal, array_m, FREQUENCY_HZ, 90, 360))
    rows = np.arange(len(positions))
    return Record(
        name=NAME,
        task="spectrum",
        tx_pos_m=positions,
        receivers=(replace(RECEIVER, array_m=array_m),),
        observation=spectra,
        official=(rows[: room.train], rows[room.train :]),
        frequencies_hz=np.array([FREQUENCY_HZ]),
    )


def _kept(paths: Paths, opaque: tuple[str, ...], scattering: bool) -> NDArray[np.bool_]:
    """Scattered paths alone, or all but those diffracted at other edges than of opaque parts."""
    if scattering:
        return np.asarray((paths.interactions == SCATTERING).any(axis=1))
    names = np.array([paths.object_names.index(name) for name in opaque if name in paths.object_names])
    return ~((paths.interactions == DIFFRACTION) & ~np.isin(paths.objects, names)).any(axis=1)


def _scan(xml: Path, seed: int) -> bytes:
    points = simulate_scan(xml, SCANNER_M, rays_per_pose=SCANNED_RAYS, seed=seed)
    stream = io.BytesIO()
    np.savez_compressed(stream, points=points.astype(np.float32))
    return stream.getvalue()


def _recipe(room: TracedRoom) -> str:
    facts = {
        "format": FORMAT,
        **asdict(room),
        "frequency_hz": FREQUENCY_HZ,
        "array": f"4 x 4, {SPACING_M} m",
        "receiver": [*RECEIVER.position_m.tolist(), *RECEIVER.orientation_xyzw.tolist()],
        "sionna_rt": version("sionna-rt"),
    }
    return yaml.safe_dump(facts, sort_keys=False)
