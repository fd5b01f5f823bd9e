"""The furnished room at several carriers: spectra of two arrays of 8 x 8 elements, one on the ceiling, one on a wall.

``docs/data.md`` describes them. Scene and kinds of path are those of `wrf_mi.synthetic.furnished_room`. Paths are
searched for once, at ``searched_at_hz``, and evaluated at every carrier with its materials. Specular paths do not
depend on the carrier of the search. Sionna RT draws paths with scattering or diffraction by the reflection coefficients
at the carrier of the search; scattered fields are divided by the probabilities of the draw, so that their power at
another carrier has the same expectation as by a search there, and all carriers have the same patches of rough wall.
Which paths with both diffraction and reflections are found depends on the draw, at any carrier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..receivers.array import bartlett_spectrum
from ..receivers.channel import array_channels
from ..receivers.reports import minmax_scale
from ..tracing.options import TraceOptions
from ..tracing.paths.result import recompute
from ..tracing.sionna.scenes import open_scene
from .furnished_room import TracedRoom, made_in_room, opaque_parts, transmitters
from .searches import searched_paths, set_scattering

NAME = "traced-room-bands"


@dataclass(frozen=True)
class RoomBands(TracedRoom):
    """Parameters of the furnished room at several carriers.

    Further parameters are those of `TracedRoom`.

    Attributes:
        train, test: numbers of training and test positions, each with a row for every carrier.
        carriers_hz: carriers, Hz.
        searched_at_hz: carrier of the search for paths, Hz.
        rows, columns, spacing_m: numbers of elements of both arrays, and distance of neighbours, metres: below half a
            wavelength at the highest carrier.
        height, width: pixels of a spectrum: 2 degrees, a sixth of the narrowest beam.
    """

    train: int = 240
    test: int = 60
    carriers_hz: tuple[float, ...] = (0.9e9, 1.8e9, 2.4e9, 3.5e9, 5.8e9)
    searched_at_hz: float = 2.4e9
    rows: int = 8
    columns: int = 8
    spacing_m: float = 0.025
    height: int = 45
    width: int = 180


DEFAULT = RoomBands()
RECEIVERS = (
    # Array's x = x of the world, y = -y, boresight z = -z: straight down.
    Receiver("ceiling", np.array([3.6, 3.4, 2.9]), np.array([1.0, 0.0, 0.0, 0.0])),
    # Array's x = -y of the world, y = up, boresight z = -x: from the east wall into the room.
    Receiver("wall", np.array([8.9, 3.5, 1.8]), np.array([0.5, -0.5, -0.5, 0.5])),
)
"""Poses of the arrays, 0.1 m before ceiling and wall."""


def traced_room_bands(folder: str | Path | None = None, bands: RoomBands = DEFAULT, progress: bool = False) -> Record:
    """Spectra of the furnished room at several carriers: read from an earlier call, or traced now and stored.

    Rows are ordered by position, then by carrier. The official split holds out the last ``test`` positions with all
    their rows; positions are drawn independently. The folder holds the measured room and a simulated LiDAR scan, as
    that of `wrf_mi.synthetic.traced_room`.

    Args:
        folder: folder of the spectra in the NeRF2 layout; by default ``traced-room-bands/`` below ``WRF_MI_DATA`` if
            it exists, else in the user's cache.
        bands: parameters.
        progress: show progress bars on standard error.

    Returns:
        A record with ``task="spectrum"`` and ``carriers_hz`` [n]: ``observation`` [2, n, height, width] in 0..1.
    """
    poses = {rx.name: [*rx.position_m.tolist(), *rx.orientation_xyzw.tolist()] for rx in RECEIVERS}
    return made_in_room(
        folder, NAME, {"receivers": poses}, bands, lambda scene_folder: _trace(scene_folder, bands, progress)
    )


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

    Paths are those of `wrf_mi.synthetic.searches.searched_paths` in the scene ``searched_at``.
    """
    assert receiver.array_m is not None
    channel = np.zeros((len(positions), len(receiver.array_m), len(scenes)), complex)
    for scene in scenes:
        set_scattering(scene, options[0].scattering_coefficient)
    for rows, traced in searched_paths(searched_at, receiver, positions, options, opaque, progress=progress):
        for number, scene in enumerate(scenes):
            paths = recompute(traced, scene).paths
            channel[rows, :, number] += array_channels(paths, receiver, receiver.array_m, scene.frequency)[..., 0]
    return channel


def _trace(scene_folder: Path, bands: RoomBands, progress: bool) -> Record:
    array_m = planar_array(bands.rows, bands.columns, bands.spacing_m)
    receivers = tuple(replace(receiver, array_m=array_m) for receiver in RECEIVERS)
    scenes, searched_at = (
        [open_scene(scene_folder, hz) for hz in carriers] for carriers in (bands.carriers_hz, [bands.searched_at_hz])
    )
    positions = transmitters(searched_at[0], bands, np.stack([receiver.position_m for receiver in receivers]))
    how = positions, searched_at[0], bands.options(diffraction=True), opaque_parts()
    size = len(positions), len(scenes), bands.height, bands.width
    spectra = np.empty((len(receivers), *size), np.float32)
    for index, receiver in enumerate(receivers):
        text = f"tracing the furnished room to the {receiver.name}" if progress else None
        signals = channels_at_carriers(scenes, receiver, *how, progress=text)
        for number, hz in enumerate(bands.carriers_hz):
            for row, signal in enumerate(signals[..., number]):
                spectra[index, row, number] = minmax_scale(bartlett_spectrum(signal, array_m, hz, *size[2:]))
    rows = np.arange(len(positions) * len(scenes))
    record = Record(
        name=NAME,
        task="spectrum",
        tx_pos_m=np.repeat(positions, len(scenes), axis=0),
        receivers=receivers,
        observation=spectra.reshape(len(receivers), len(rows), *size[2:]),
        official=(rows[: bands.train * len(scenes)], rows[bands.train * len(scenes) :]),
    )
    return record.at_carriers(np.tile(bands.carriers_hz, len(positions)))
