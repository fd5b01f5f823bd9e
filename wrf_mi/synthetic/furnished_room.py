"""The traced room: spectra of transmitters anywhere in a furnished room, and its bare walls as input of models.

``docs/data.md`` describes both. The furniture is `wrf_mi_scenes.furnished`, layout and array are those of the
laboratory (`wrf_mi.synthetic.laboratory`). Transmitters stand anywhere in the room's free volume between 0.5 and 2 m
height, including the space behind the array and the inner room.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
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
from wrf_mi_scenes.furnished import furnished_parts, measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.arrays import planar_array
from ..datasets import read_spectrum_folder, user_cache, write_spectrum_folder
from ..receivers.array import bartlett_spectrum, minmax_scale
from ..receivers.channel import array_channels
from ..tracing.devices import solid_around
from ..tracing.options import TraceOptions
from ..tracing.result import TraceResult
from ..tracing.scenes import open_scene
from ..tracing.solve import trace_paths
from ..tracing.surfaces import scene_surfaces
from .laboratory import ARRAY_FACTS, FREQUENCY_HZ, RECEIVER, RECIPE, SCAN, SPACING_M, is_made, scan_file, scene_files

logger = logging.getLogger(__name__)

NAME = "traced-room"
MEASURED = "room"  # folder beside the spectra with the measured scene, the input of models
FORMAT = 3  # version of the files, to be raised when they change for equal parameters
SCATTERING, DIFFRACTION = 2, 8
"""Kinds of interaction (`wrf_mi.core.Paths`) that emit a spherical wave."""


@dataclass(frozen=True)
class TracedRoom:
    """Parameters of the traced room.

    Attributes:
        train, test: numbers of training and test rows.
        low_m, high_m: bounds of the transmitters' height, metres.
        clear_m, from_array_m: least distances from surfaces and from the array, metres.
        depth, reflections, scattered_depth: most interactions of a path, reflections among them, and interactions of a
            scattered path.
        rays, scattered_rays: numbers of rays for specular paths and diffraction, and for diffuse reflection.
        scattering: share of the reflected amplitude that every surface scatters.
        mesh_error_m: standard deviation of the measured room's planes along their normals, metres.
        seed: seed of positions, errors of the measured room, and rays.
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
"""Material of the edges that diffract. Sionna RT treats every sheet as opaque at its edges, and so overestimates the
diffraction of thin boards, through which most of the wave passes."""
CHUNK_SIZE = 200  # transmitters that are traced together


def traced_room(
    folder: str | Path | None = None, room: TracedRoom = DEFAULT, progress: bool = False
) -> tuple[Record, Path]:
    """The traced room's spectra: read from an earlier call, or traced now (some minutes by default) and stored.

    The official split is the first ``train`` rows and the rest; positions are drawn independently. A simulated LiDAR
    scan of the furnished room is included as ``lidar/points.npz``.

    Args:
        folder: folder of the spectra in the NeRF2 layout; by default ``traced-room/`` in the user's cache.
        room: parameters.
        progress: show progress bars on standard error.

    Returns:
        The record and the folder of the measured room's scene, the input of models.
    """
    folder = user_cache() / NAME if folder is None else Path(folder)
    facts = {"format": FORMAT, **asdict(room), "frequency_hz": FREQUENCY_HZ, **ARRAY_FACTS}
    record = made_in_room(folder, NAME, facts, room, lambda scene_folder: _trace(scene_folder, room, progress))
    return record, folder / MEASURED


def made_in_room(
    folder: Path, name: str, facts: Mapping[str, Any], room: TracedRoom, trace: Callable[[Path], Record]
) -> Record:
    """Spectra of the furnished room: read from a folder, or traced and stored with a scan and the measured room.

    Args:
        folder: folder of the spectra in the NeRF2 layout.
        name: name of the record.
        facts: parameters of the data; other ones make them anew.
        room: seed of scan and measured room, and errors of the latter.
        trace: function of the true scene's folder that traces the record.
    """
    recipe = yaml.safe_dump({**facts, "sionna_rt": version("sionna-rt")}, sort_keys=False)
    if not is_made(folder, recipe):
        logger.info("tracing %s into %s", name, folder)
        with tempfile.TemporaryDirectory() as work:
            truth = write_scene(Path(work) / "truth", furnished_parts(), "Furnished room, all that is in it")
            record = trace(truth.parent)
            bare = measured_parts(room.mesh_error_m, room.seed)
            extra: dict[str, str | bytes] = {RECIPE: recipe, SCAN: scan_file(truth, room.seed)}
            extra |= scene_files(bare, MEASURED, "wrf_mi_scenes.furnished")
            write_spectrum_folder(folder, record, replace=True, extra=extra)
    return read_spectrum_folder(folder, name)


def transmitters(scene: Any, room: TracedRoom, stations_m: FloatArray = RECEIVER.position_m) -> FloatArray:
    """Positions [train + test, 3] in metres, uniform over the free volume of a ``sionna.rt.Scene``, to 0.1 mm.

    They keep the distance ``from_array_m`` from ``stations_m`` [3] or [k, 3].
    """
    low, high = np.array([0, 0, room.low_m]), np.array([LENGTH, WIDTH, room.high_m])
    rng = np.random.default_rng([room.seed, 0])
    apart = room.seed, stations_m, room.from_array_m
    return free_positions(scene, low, high, room.train + room.test, room.clear_m, rng, *apart)


def free_positions(
    scene: Any,
    low_m: FloatArray,
    high_m: FloatArray,
    count: int,
    clear_m: float,
    rng: np.random.Generator,
    seed: int,
    station_m: FloatArray | None = None,
    from_station_m: float = 0.0,
) -> FloatArray:
    """Positions [count, 3] in metres, uniform over the free part of a box, to 0.1 mm.

    Args:
        scene: a ``sionna.rt.Scene``.
        low_m: lower corner of the box [3], metres.
        high_m: upper corner of the box [3], metres.
        count: number of positions.
        clear_m: least distance from surfaces, metres.
        rng: generator of the positions.
        seed: seed of the points by which distances from surfaces are judged.
        station_m: position [3], or positions [k, 3], to keep away from, metres; None: none.
        from_station_m: least distance from these, metres.
    """
    surfaces = scene_surfaces(scene)
    mesh = trimesh.Trimesh(surfaces.triangles.reshape(-1, 3), np.arange(3 * len(surfaces.triangles)).reshape(-1, 3))
    # A point every 2 cm or so: much less than the clearance.
    tree = cKDTree(trimesh.sample.sample_surface(mesh, int(mesh.area / 4e-4), seed=seed)[0])
    found = np.zeros((0, 3))
    while len(found) < count:
        drawn = np.round(rng.uniform(low_m, high_m, (count, 3)), 4)
        free = tree.query(drawn)[0] > clear_m
        if station_m is not None:
            apart = np.linalg.norm(drawn[:, None] - np.atleast_2d(station_m), axis=-1)
            free &= apart.min(axis=1) > from_station_m
        free &= solid_around(surfaces, drawn) < 0
        found = np.concatenate([found, drawn[free]])
    return found[:count]


def trace_channels(
    scene: Any,
    receiver: Receiver,
    positions: FloatArray,
    frequencies_hz: FloatArray,
    options: Sequence[TraceOptions],
    opaque: Sequence[str] = (),
    chunk_size: int = CHUNK_SIZE,
    progress: str | None = None,
) -> NDArray[np.complex128]:
    """Channels [n, m, f] between positions [n, 3] and the m elements of a receiver, summed over searches for paths.

    Paths are those of `searched_paths`.
    """
    assert receiver.array_m is not None
    channel = np.zeros((len(positions), len(receiver.array_m), len(frequencies_hz)), complex)
    for rows, traced in searched_paths(scene, receiver, positions, options, opaque, chunk_size, progress):
        channel[rows] += array_channels(traced.paths, receiver, receiver.array_m, frequencies_hz)
    return channel


def searched_paths(
    scene: Any,
    receiver: Receiver,
    positions: FloatArray,
    options: Sequence[TraceOptions],
    opaque: Sequence[str] = (),
    chunk_size: int = CHUNK_SIZE,
    progress: str | None = None,
) -> Iterator[tuple[slice, TraceResult]]:
    """Paths from a receiver's array, as "transmitter", to chunks of positions [n, 3], as "receivers".

    A search with scattering counts its scattered paths, another search all but those diffracted at other edges than of
    the ``opaque`` objects. ``progress`` is the text of a progress bar on standard error.

    Yields:
        Rows of a chunk, and its paths by a search.
    """
    set_scattering(scene, options[0].scattering_coefficient)
    with Progress(console=Console(stderr=True), transient=True, disable=progress is None) as bar:
        for start in bar.track(range(0, len(positions), chunk_size), description=progress or ""):
            part = positions[start : start + chunk_size]
            ends = [Receiver(str(row), position, np.array(UPRIGHT)) for row, position in enumerate(part)]
            for search in options:
                # The array searches, so that all positions see the same patches of rough wall and the same edges.
                # With diffraction Sionna RT searches from transmitters, so the array is the transmitter.
                traced = trace_paths(scene, receiver.position_m, ends, search, search_from="transmitters")
                paths = traced.paths
                kept = (paths.interactions == SCATTERING).any(axis=1)
                if not search.scattering:
                    names = np.array([paths.object_names.index(name) for name in opaque if name in paths.object_names])
                    kept = ~((paths.interactions == DIFFRACTION) & ~np.isin(paths.objects, names)).any(axis=1)
                yield slice(start, start + len(part)), traced.select(kept)


def set_scattering(scene: Any, coefficient: float) -> None:
    """Set the share of the reflected amplitude that every surface of a ``sionna.rt.Scene`` scatters."""
    for material in scene.radio_materials.values():
        material.scattering_coefficient = coefficient


def room_searches(room: TracedRoom) -> tuple[TraceOptions, TraceOptions]:
    """Searches for the paths in the furnished room: specular and diffracted ones, and scattered ones."""
    shared: dict[str, Any] = {"transmission": True, "seed": room.seed, "scattering_coefficient": room.scattering}
    exact = TraceOptions(
        diffraction=True, max_depth=room.depth, max_reflections=room.reflections, rays=room.rays, **shared
    )
    return exact, TraceOptions(scattering=True, max_depth=room.scattered_depth, rays=room.scattered_rays, **shared)


def opaque_parts() -> list[str]:
    """Names of the furnished room's parts whose edges diffract."""
    return [name for name, (material, _) in furnished_parts().items() if material == OPAQUE]


def _trace(scene_folder: Path, room: TracedRoom, progress: bool) -> Record:
    scene, array_m = open_scene(scene_folder, FREQUENCY_HZ), planar_array(4, 4, SPACING_M)
    receiver, frequency_hz = replace(RECEIVER, array_m=array_m), np.array([FREQUENCY_HZ])
    positions = transmitters(scene, room)
    how = room_searches(room), opaque_parts()
    text = "tracing the furnished room" if progress else None
    signals = trace_channels(scene, receiver, positions, frequency_hz, *how, progress=text)[..., 0]
    spectra = [minmax_scale(bartlett_spectrum(signal, array_m, FREQUENCY_HZ, 90, 360)) for signal in signals]
    rows = np.arange(len(positions))
    return Record(
        name=NAME,
        task="spectrum",
        tx_pos_m=positions,
        receivers=(receiver,),
        observation=np.asarray(spectra, np.float32)[None],
        official=(rows[: room.train], rows[room.train :]),
        frequencies_hz=frequency_hz,
    )
