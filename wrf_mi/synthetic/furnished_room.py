"""The furnished room: spectra of transmitters anywhere in it, at one carrier or at several, and its bare walls.

``docs/data.md`` describes both data sets. The furniture is `wrf_mi_scenes.furnished`. Transmitters stand anywhere in
the room's free volume between 0.5 and 2 m height, including the space behind the array and the inner room. The walls
are input of models. ``traced-room`` has layout and array of the laboratory (`wrf_mi.synthetic.laboratory`),
``traced-room-bands`` two arrays of 8 x 8 elements, on the ceiling and on a wall.

For several carriers paths are searched for once, at ``searched_at_hz``, and evaluated at every carrier with its
materials. Specular paths do not depend on the carrier of the search. Sionna RT draws paths with scattering or
diffraction by the reflection coefficients at the carrier of the search; scattered fields are divided by the
probabilities of the draw, so that their power at another carrier has the same expectation as by a search there, and all
carriers have the same patches of rough wall. Which paths with both diffraction and reflections are found depends on the
draw, at any carrier.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from wrf_mi_scenes.build_laboratory import LENGTH, WIDTH
from wrf_mi_scenes.furnished import furnished_parts, measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import read_spectrum_folder, write_spectrum_folder
from ..receivers.array import bartlett_spectrum
from ..receivers.channel import array_channels
from ..receivers.scaling import minmax_scale
from ..tasks import SPECTRUM
from ..tracing.options import TraceOptions
from ..tracing.paths.result import recompute
from ..tracing.sionna.path_solver import sionna_diffraction
from ..tracing.sionna.scenes import open_scene
from .laboratory import ARRAY_FACTS, FREQUENCY_HZ, RECEIVER, SCANNER_M, SPACING_M
from .searches import Searches, free_positions, searched_paths, set_scattering
from .stored import Files, scan_file, scene_files, stored

NAME, BANDS = "traced-room", "traced-room-bands"
MEASURED = "room"  # folder beside the spectra with the measured scene, the input of models
FORMAT = 3  # version of the files, to be raised when they change for equal parameters


@dataclass(frozen=True)
class TracedRoom(Searches):
    """Parameters of the traced room, beside those of `Searches`."""

    train: int = 1600  # number of training rows
    test: int = 200  # number of test rows
    low_m: float = 0.5  # least height of the transmitters, metres
    high_m: float = 2.0  # largest height of the transmitters, metres
    clear_m: float = 0.1  # least distance of transmitters from surfaces, metres
    from_array_m: float = 0.5  # least distance of transmitters from the array, metres
    depth: int = 4
    scattered_depth: int | None = 3
    rays: int = 1 << 16
    scattered_rays: int = 1 << 12


@dataclass(frozen=True)
class RoomBands(TracedRoom):
    """Parameters of the furnished room at several carriers, beside those of `TracedRoom`."""

    train: int = 240  # number of training positions, each with a row for every carrier
    test: int = 60  # number of test positions
    carriers_hz: tuple[float, ...] = (0.9e9, 1.8e9, 2.4e9, 3.5e9, 5.8e9)
    searched_at_hz: float = 2.4e9  # carrier of the search for paths
    rows: int = 8  # rows of both arrays
    columns: int = 8  # columns of both arrays
    spacing_m: float = 0.025  # distance of neighbours, metres: below half a wavelength at the highest carrier
    height: int = 45  # rows of a spectrum: 2 degrees each, a sixth of the narrowest beam
    width: int = 180  # columns of a spectrum


DEFAULT, DEFAULT_BANDS = TracedRoom(), RoomBands()
RECEIVERS = (
    # Array's x = x of the world, y = -y, boresight z = -z: straight down.
    Receiver("ceiling", np.array([3.6, 3.4, 2.9]), np.array([1.0, 0.0, 0.0, 0.0])),
    # Array's x = -y of the world, y = up, boresight z = -x: from the east wall into the room.
    Receiver("wall", np.array([8.9, 3.5, 1.8]), np.array([0.5, -0.5, -0.5, 0.5])),
)
"""Poses of the arrays, 0.1 m before ceiling and wall."""
OPAQUE = "itu_metal"
"""Material of the edges that diffract. Sionna RT treats every sheet as opaque at its edges, and so overestimates the
diffraction of thin boards, through which most of the wave passes."""


def traced_room(folder: str | Path | None = None, room: TracedRoom = DEFAULT, progress: bool = False) -> Record:
    """The traced room's spectra, read or made in some minutes in a folder (`wrf_mi.synthetic.stored.stored`).

    The official split is the first ``train`` rows and the rest; positions are drawn independently. The folder, in the
    NeRF2 layout, holds the scene of the measured room, `MEASURED`, and a simulated LiDAR scan of the furnished room.
    ``progress`` shows bars on standard error.
    """
    facts = {"frequency_hz": FREQUENCY_HZ, **ARRAY_FACTS}

    def trace(scene_folder: Path) -> Record:
        scene = open_scene(scene_folder, FREQUENCY_HZ)
        receivers = (replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M)),)
        return _spectra(NAME, room, receivers, scene, {FREQUENCY_HZ: scene}, (90, 360), progress)

    return made_in_room(folder, NAME, facts, room, trace)


def traced_room_bands(
    folder: str | Path | None = None, bands: RoomBands = DEFAULT_BANDS, progress: bool = False
) -> Record:
    """Spectra of the furnished room at several carriers, read or made in a folder like that of `traced_room`.

    The record has ``task="spectrum"`` and ``carriers_hz`` [n]: ``observation`` [2, n, height, width] in 0..1. Rows are
    ordered by position, then by carrier. The official split holds out the last ``test`` positions with all their rows;
    positions are drawn independently.
    """
    poses = {rx.name: [*rx.position_m.tolist(), *rx.orientation_xyzw.tolist()] for rx in RECEIVERS}

    def trace(scene_folder: Path) -> Record:
        scenes = {hz: open_scene(scene_folder, hz) for hz in bands.carriers_hz}
        searched_at = open_scene(scene_folder, bands.searched_at_hz)
        array_m = planar_array(bands.rows, bands.columns, bands.spacing_m)
        receivers = tuple(replace(receiver, array_m=array_m) for receiver in RECEIVERS)
        return _spectra(BANDS, bands, receivers, searched_at, scenes, (bands.height, bands.width), progress)

    return made_in_room(folder, BANDS, {"receivers": poses}, bands, trace)


def made_in_room(
    folder: str | Path | None, name: str, facts: dict[str, Any], room: TracedRoom, trace: Callable[[Path], Record]
) -> Record:
    """Spectra of the furnished room: read from a folder, or traced and stored with a scan and the measured room.

    As `wrf_mi.synthetic.stored.stored`; ``facts`` are parameters of the data beside those of the room, ``trace`` makes
    the record, of the folder of the true scene.
    """

    def write(folder: Path, recipe: Files) -> None:
        with tempfile.TemporaryDirectory() as work:
            truth = write_scene(Path(work) / "truth", furnished_parts(), "Furnished room, all that is in it")
            bare = measured_parts(room.mesh_error_m, room.seed)
            extra = scan_file(truth, room.seed, SCANNER_M) | scene_files(bare, MEASURED, "wrf_mi_scenes.furnished")
            write_spectrum_folder(folder, trace(truth.parent), replace=True, extra=extra | recipe)

    return stored(name, folder, {"format": FORMAT, **asdict(room), **facts}, write, read_spectrum_folder)


def transmitters(scene: Any, room: TracedRoom, stations_m: FloatArray = RECEIVER.position_m) -> FloatArray:
    """Positions [train + test, 3] in metres, uniform over the free volume of a ``sionna.rt.Scene``, to 0.1 mm.

    They keep the distance ``from_array_m`` from ``stations_m`` [3] or [k, 3].
    """
    box_m = np.array([[0, 0, room.low_m], [LENGTH, WIDTH, room.high_m]])
    rng, apart = np.random.default_rng([room.seed, 0]), (stations_m, room.from_array_m)
    return free_positions(scene, box_m, room.train + room.test, room.clear_m, rng, room.seed, apart)


def opaque_parts() -> list[str]:
    """Names of the furnished room's parts whose edges diffract."""
    return [name for name, (material, _) in furnished_parts().items() if material == OPAQUE]


def channels_at_carriers(
    scenes: Sequence[Any],
    receiver: Receiver,
    positions: FloatArray,
    searched_at: Any,
    options: Sequence[TraceOptions],
    opaque: Sequence[str] = (),
    progress: str | None = None,
) -> NDArray[np.complex128]:
    """Channels [n, m, f] between positions [n, 3] and the m elements of a receiver, at the carriers of f scenes.

    Paths are those of `wrf_mi.synthetic.searches.searched_paths` in the scene ``searched_at``, which may be one of
    ``scenes``.
    """
    assert receiver.array_m is not None
    channel = np.zeros((len(positions), len(receiver.array_m), len(scenes)), complex)
    for scene in scenes:
        set_scattering(scene, options[0].scattering_coefficient)
    for rows, traced in searched_paths(searched_at, receiver, positions, options, opaque, progress=progress):
        for number, scene in enumerate(scenes):
            paths = (traced if scene is searched_at else recompute(traced, scene)).paths
            channel[rows, :, number] += array_channels(paths, receiver, receiver.array_m, scene.frequency)[..., 0]
    return channel


def _spectra(
    name: str,
    room: TracedRoom,
    receivers: tuple[Receiver, ...],
    searched_at: Any,
    scenes: Mapping[float, Any],
    size: tuple[int, int],
    progress: bool,
) -> Record:
    """Spectra of ``size`` (height, width); ``scenes`` by their carriers, Hz; rows by position, then by carrier."""
    positions = transmitters(searched_at, room, np.stack([receiver.position_m for receiver in receivers]))
    how = positions, searched_at, room.options(diffraction=True), opaque_parts()
    spectra = np.empty((len(receivers), len(positions), len(scenes), *size), np.float32)
    for index, receiver in enumerate(receivers):
        assert receiver.array_m is not None
        text = "tracing the furnished room" + (f" to the {receiver.name}" if len(receivers) > 1 else "")
        with sionna_diffraction():
            signals = channels_at_carriers([*scenes.values()], receiver, *how, progress=text if progress else None)
        for number, hz in enumerate(scenes):
            for row, signal in enumerate(signals[..., number]):
                spectra[index, row, number] = minmax_scale(bartlett_spectrum(signal, receiver.array_m, hz, *size))
    first_test, rows = room.train * len(scenes), np.arange(len(positions) * len(scenes))
    record = Record(
        name=name,
        task=SPECTRUM,
        tx_pos_m=np.repeat(positions, len(scenes), axis=0),
        receivers=receivers,
        observation=spectra.reshape(len(receivers), len(rows), *size),
        official=(rows[:first_test], rows[first_test:]),
    )
    return record.at_carriers(np.tile([*scenes], len(positions)))
