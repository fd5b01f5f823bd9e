"""The traced room: spectra of transmitters anywhere in a furnished room, and its bare walls as input of models.

``docs/data.md`` describes both. The furniture is `wrf_mi_scenes.furnished`, layout and array are those of the
laboratory (`wrf_mi.synthetic.laboratory`). Transmitters stand anywhere in the room's free volume between 0.5 and 2 m
height, including the space behind the array and the inner room.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.build_laboratory import LENGTH, WIDTH
from wrf_mi_scenes.furnished import furnished_parts, measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from ..core import Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import read_spectrum_folder, write_spectrum_folder
from ..receivers.array import bartlett_spectrum
from ..receivers.reports import minmax_scale
from ..tracing.sionna.scenes import open_scene
from .laboratory import ARRAY_FACTS, FREQUENCY_HZ, RECEIVER, SCANNER_M, SPACING_M
from .searches import Searches, free_positions, trace_channels
from .stored import Files, scan_file, scene_files, stored

NAME = "traced-room"
MEASURED = "room"  # folder beside the spectra with the measured scene, the input of models
FORMAT = 3  # version of the files, to be raised when they change for equal parameters


@dataclass(frozen=True)
class TracedRoom(Searches):
    """Parameters of the traced room, beside those of `Searches`.

    Attributes:
        train, test: numbers of training and test rows.
        low_m, high_m: bounds of the transmitters' height, metres.
        clear_m, from_array_m: least distances from surfaces and from the array, metres.
    """

    train: int = 1600
    test: int = 200
    low_m: float = 0.5
    high_m: float = 2.0
    clear_m: float = 0.1
    from_array_m: float = 0.5
    depth: int = 4
    scattered_depth: int | None = 3
    rays: int = 1 << 16
    scattered_rays: int = 1 << 12


DEFAULT = TracedRoom()
OPAQUE = "itu_metal"
"""Material of the edges that diffract. Sionna RT treats every sheet as opaque at its edges, and so overestimates the
diffraction of thin boards, through which most of the wave passes."""


def traced_room(folder: str | Path | None = None, room: TracedRoom = DEFAULT, progress: bool = False) -> Record:
    """The traced room's spectra: read from an earlier call, or traced now (some minutes by default) and stored.

    The official split is the first ``train`` rows and the rest; positions are drawn independently. The folder holds the
    scene of the measured room, `MEASURED`, and a simulated LiDAR scan of the furnished room.

    Args:
        folder: folder of the spectra in the NeRF2 layout; by default ``traced-room/`` below ``WRF_MI_DATA`` if it
            exists, else in the user's cache.
        room: parameters.
        progress: show progress bars on standard error.
    """
    facts = {"frequency_hz": FREQUENCY_HZ, **ARRAY_FACTS}
    return made_in_room(folder, NAME, facts, room, lambda scene_folder: _trace(scene_folder, room, progress))


def made_in_room(
    folder: str | Path | None, name: str, facts: dict[str, Any], room: TracedRoom, trace: Callable[[Path], Record]
) -> Record:
    """Spectra of the furnished room: read from a folder, or traced and stored with a scan and the measured room.

    Args:
        folder: folder of the spectra in the NeRF2 layout, see `wrf_mi.synthetic.stored.stored`.
        name: name of the record.
        facts: parameters of the data beside those of the room.
        room: parameters of the room.
        trace: function of the true scene's folder that traces the record.
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
    low, high = np.array([0, 0, room.low_m]), np.array([LENGTH, WIDTH, room.high_m])
    rng = np.random.default_rng([room.seed, 0])
    apart = room.seed, stations_m, room.from_array_m
    return free_positions(scene, low, high, room.train + room.test, room.clear_m, rng, *apart)


def opaque_parts() -> list[str]:
    """Names of the furnished room's parts whose edges diffract."""
    return [name for name, (material, _) in furnished_parts().items() if material == OPAQUE]


def _trace(scene_folder: Path, room: TracedRoom, progress: bool) -> Record:
    scene, array_m = open_scene(scene_folder, FREQUENCY_HZ), planar_array(4, 4, SPACING_M)
    receiver, frequency_hz = replace(RECEIVER, array_m=array_m), np.array([FREQUENCY_HZ])
    positions = transmitters(scene, room)
    how = room.options(diffraction=True), opaque_parts()
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
