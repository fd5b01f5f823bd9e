"""Traced powers at many positions, kept on the disk.

Fits of the same scene with other rows trace the same grid. Powers are kept in the user's cache by a digest of all that
determines them: faces and materials of the scene, carrier, positions, receivers, antennas, options, and the code.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from ..core import Antenna, Receiver, receiver_arrays
from ..core.angles import FloatArray
from ..core.array_files import stored_arrays, write_arrays
from ..core.digest import content_digest
from ..datasets import user_cache
from ..receivers import rssi_dbm
from .material_parameters import slabs_of_faces
from .options import TraceOptions
from .solve import Prepared, trace_paths

FOLDER, POWER = "powers", "power_dbm"
PACKAGES = ("mitsuba", "drjit", "sionna-rt", "numpy")


def traced_powers(
    scene: Any,
    prepared: Prepared,
    tx_pos_m: FloatArray,
    receivers: Sequence[Receiver],
    options: TraceOptions,
    tx_antenna: Antenna,
) -> FloatArray:
    """Received power for 0 dBm sent, traced or read.

    Args:
        scene: from `wrf_mi.tracing.open_scene`.
        prepared: shared state of the scene.
        tx_pos_m: transmitters [m, 3], metres, outside of solids.
        receivers: n_rx receivers.
        options: paths that are traced.
        tx_antenna: antenna of the transmitters.

    Returns:
        Power in dBm [n_rx, m], NaN without a path.
    """
    slabs, slab_of_face = slabs_of_faces(scene, prepared.surfaces, "named")
    path = None
    if (slab_of_face >= 0).all():  # other materials have no digest
        here = Path(__file__).parent
        code = {one.name: one for folder in (here, here.parent / "receivers") for one in folder.glob("*.py")}
        versions = [importlib.metadata.version(name) for name in PACKAGES]
        faces = prepared.surfaces.triangles, slab_of_face, slabs, float(scene.frequency[0])
        asked = tx_pos_m, receiver_arrays(receivers), asdict(options), tx_antenna
        path = user_cache() / FOLDER / f"{content_digest(code, versions, faces, asked)}.npz"
        if path.exists():
            return np.asarray(stored_arrays(path)[POWER], float)
    how: dict[str, Any] = {"prepared": prepared, "tx_antenna": tx_antenna, "check": False}
    power = np.asarray(rssi_dbm(trace_paths(scene, tx_pos_m, receivers, options, **how).paths), float)
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_arrays(path, {POWER: power})
    return power
