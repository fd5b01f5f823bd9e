"""The default data set: spectra of the `laboratory` scene, traced on this machine without noise.

Layout and array are those of rfid-lab: a 4 x 4 array with 0.16 m spacing at 920 MHz, 200 transmitter positions along a
path within 0.5 x 1 x 0.2 m, about 5 m away. A simulated LiDAR scan of the scene is included (2 cm range noise, 1 %
strays).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from wrf_mi_scenes import scenes

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import make_splits, read_spectrum_folder, write_spectrum_folder
from ..receivers.instruments import Instrument
from ..tasks import SPECTRUM
from ..tracing.options import TraceOptions
from ..tracing.tracer import RayTracer
from .stored import SCANNED_RAYS, Files, scan_file, stored

NAME = "laboratory"
FREQUENCY_HZ = 920e6
SPACING_M = 0.16
POSITIONS = 200
OPTIONS = TraceOptions(transmission=False, depth=3, seed=1)
SCANNER_M = ((2.0, 2.5, 1.5), (3.0, 5.0, 1.5), (5.5, 3.5, 1.5), (7.0, 1.8, 1.5), (7.6, 6.0, 1.6), (5.8, 1.0, 1.2))
"""Positions of the LiDAR, metres: five in the room and one in the inner room."""
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
    """The laboratory's 200 spectra in 8 bits, read or made in some 5 s in a folder of the NeRF2 layout
    (`wrf_mi.synthetic.stored.stored`), with a seeded random split of 160 and 40 rows.
    """
    info = scenes()[NAME]
    facts = {"format": FORMAT, "scene": info.name, "scene_sha256": info.sha256, "frequency_hz": FREQUENCY_HZ}
    facts |= {**ARRAY_FACTS, "positions": POSITIONS, "scanner": [list(place) for place in SCANNER_M]}
    facts |= {"scanned_rays": SCANNED_RAYS, "max_depth": OPTIONS.depth, "rays_per_source": OPTIONS.rays}
    facts["seed"] = OPTIONS.seed

    def write(folder: Path, recipe: Files) -> None:
        positions, frequency_hz = transmitter_path(), np.array([FREQUENCY_HZ])
        receiver = replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M))
        tracer = RayTracer(info.folder, Instrument("array", (receiver,), frequency_hz), OPTIONS)
        spectra = tracer.observe(tracer.trace(positions, progress))
        record = Record(NAME, SPECTRUM, positions, (receiver,), spectra, frequencies_hz=frequency_hz)
        split = make_splits(record, "random", seed=OPTIONS.seed)[0]
        record = replace(record, official=(split.all_train, split.test))
        extra = scan_file(info.xml, OPTIONS.seed, SCANNER_M) | recipe
        write_spectrum_folder(folder, record, replace=True, extra=extra)

    return stored(NAME, folder, facts, write, read_spectrum_folder)
