"""An office floor with receivers on its ceiling: signal strengths, and channels of single antennas.

``docs/data.md`` describes both data sets, which have the same receivers, transmitters and paths. The floor is
`wrf_mi_scenes.floor_plans.office`. There is no diffraction: metal shelves and the metal-clad core shade what neither
reflections nor diffuse scattering reach.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from wrf_mi_scenes import floor_plans
from wrf_mi_scenes.floor_plans import FloorPlan

from ..core import Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..core.paths import ARRAYS
from ..datasets import read_ble_folder, read_deepmimo, write_ble_folder
from ..datasets.ble_folder import CARRIER_HZ
from ..datasets.deepmimo import CHANNEL_PARAMS
from ..datasets.folder_files import write_extra, write_official
from ..receivers.channel import rssi_dbm
from ..tasks import RSSI
from ..tracing.deepmimo import write_deepmimo
from ..tracing.paths.result import TraceResult
from ..tracing.paths.solve import trace_paths
from ..tracing.search.devices import winding_number
from ..tracing.sionna.scenes import open_scene
from .floor_channels import made_on_floor
from .searches import SCATTERING, Searches, free_positions, set_scattering
from .stored import Files, scan_file

NAME = "traced-floor-receivers"
CHANNELS = f"{NAME}-csi"
FORMAT = 3  # version of the files, to be raised when they change for equal parameters
CANDIDATES = 1000  # free points of the ceiling among which the receivers' places are chosen: one in 0.2 m^2
SCANNER_X_M = (1.6, 5.4, 8.2, 11.5, 14.5, 3.65, 14.5, 1.6, 6.2, 10.6, 15.0)
SCANNER_Y_M = (2.7, 4.85, 0.8, 3.0, 4.8, 6.2, 6.2, 7.7, 7.7, 7.7, 7.7)
SCANNER_M = tuple((x, y, 1.5) for x, y in zip(SCANNER_X_M, SCANNER_Y_M, strict=True))
"""Positions of the LiDAR, metres: five in the open plan, two in the corridor, one in each room."""


@dataclass(frozen=True)
class FloorReceivers(Searches):
    """Parameters of the floor's receivers, beside those of `Searches`; lengths in metres."""

    columns: int = 4  # number of receivers along x, one in each cell of a grid over the floor
    rows: int = 4  # number of receivers along y
    train: int = 320  # number of training positions of the transmitter
    test: int = 80  # number of its test positions
    mount_m: float = 2.85  # height of the receivers
    low_m: float = 0.8  # least height of the transmitter
    high_m: float = 1.6  # largest height of the transmitter
    clear_m: float = 0.1  # least distance of antennas from surfaces
    from_receiver_m: float = 0.5  # least distance of transmitters from receivers
    power_dbm: float = 0.0  # power that the transmitter radiates
    sensitivity_dbm: float = -75.0  # signal strength below which nothing is received
    offset_db: float = 1.0  # standard deviation of the receivers' offsets, each the same for all rows
    noise_db: float = 1.0  # standard deviation of the noise of each signal strength
    subcarriers: int = 16  # number of the channels' subcarriers, from the carrier upwards
    bandwidth_hz: float = 20e6  # bandwidth of the channels


DEFAULT = FloorReceivers()


def traced_floor_strengths(
    folder: str | Path | None = None, floor: FloorReceivers = DEFAULT, progress: bool = False
) -> Record:
    """Signal strengths on the floor, read or made in a folder of the BLE layout (`wrf_mi.synthetic.stored.stored`).

    The record has ``task="rssi"``: ``observation`` [receivers, n] in dBm, NaN below the sensitivity. Its official split
    is the first ``train`` rows and the rest; positions are drawn independently. ``progress`` shows a bar on standard
    error.
    """

    def write(folder: Path, traced: TraceResult, extra: Files) -> None:
        write_ble_folder(folder, strengths_of(traced, floor), replace=True, extra=extra)

    return _made(NAME, folder, floor, progress, write, read_ble_folder)


def traced_floor_channels(
    folder: str | Path | None = None, floor: FloorReceivers = DEFAULT, progress: bool = False
) -> Record:
    """Channels of single antennas on the floor, without noise, as `traced_floor_strengths`, of a DeepMIMO scenario.

    The record has ``task="csi"``: ``observation`` [receivers, n, subcarriers], NaN where no path arrives.
    """

    def write(folder: Path, traced: TraceResult, extra: Files) -> None:
        ofdm = {"bandwidth": floor.bandwidth_hz, "subcarriers": floor.subcarriers}
        params = {"base_stations": "all", "ofdm": ofdm | {"selected_subcarriers": list(range(floor.subcarriers))}}
        write_deepmimo(folder, traced, replace=True)
        write_official(folder, (np.arange(floor.train), floor.train + np.arange(floor.test)), first=0)
        # The recipe comes last: without it the data are made again.
        write_extra(folder, {CHANNEL_PARAMS: yaml.safe_dump(params), **extra})

    return _made(CHANNELS, folder, floor, progress, write, read_deepmimo)


def _made(
    name: str,
    folder: str | Path | None,
    floor: FloorReceivers,
    progress: bool,
    write: Callable[[Path, TraceResult, Files], None],
    read: Callable[[Path, str], Record],
) -> Record:
    """As `made_on_floor`; ``write`` takes the folder, the trace and further files, the parameters last."""
    plan = floor_plans.office()

    def write_traced(folder: Path, scene_folder: Path, extra: Files) -> None:
        scan = scan_file(scene_folder / "scene.xml", floor.seed, SCANNER_M)
        write(folder, trace_floor(scene_folder, plan, floor, progress), scan | extra)

    facts = {"format": FORMAT, **asdict(floor), "frequency_hz": CARRIER_HZ}
    return made_on_floor(name, folder, plan, floor, facts, write_traced, read)


def trace_floor(scene_folder: Path, plan: FloorPlan, floor: FloorReceivers, progress: bool = False) -> TraceResult:
    """Specular and scattered paths between all transmitters and receivers in the scene of a floor plan."""
    scene = open_scene(scene_folder, CARRIER_HZ)
    receivers, transmitters = floor_devices(scene, plan, floor)
    set_scattering(scene, floor.scattering)
    # Scattered fields from receivers, which are not reciprocal: the data stay as they were made.
    how: dict[str, Any] = {"progress": progress, "search_from": "receivers"}
    specular, every = (trace_paths(scene, transmitters, receivers, options, **how) for options in floor.options())
    scattered = every.select((every.paths.interactions == SCATTERING).any(axis=1))
    # Two traces of the same devices, scene and depth as one, with the options of the second.
    parts, traces = (specular.paths, scattered.paths), (specular, scattered)

    def rows(of: Sequence[Any], name: str) -> NDArray[Any]:
        return np.concatenate([getattr(part, name) for part in of])

    order = np.lexsort([rows(parts, name) for name in ("length_m", "tx", "rx")])
    arrays: dict[str, Any] = {name: rows(parts, name)[order] for name in ARRAYS}
    primitives, probability = (rows(traces, name)[order] for name in ("primitives", "probability"))
    return replace(scattered, paths=replace(parts[0], **arrays), primitives=primitives, probability=probability)


def floor_devices(scene: Any, plan: FloorPlan, floor: FloorReceivers) -> tuple[tuple[Receiver, ...], FloatArray]:
    """Receivers named ``anchor1``, ... and positions [train + test, 3] of the transmitter, outside all bodies.

    A receiver is at a random place around the middle of each cell of a grid over the floor.
    """
    bounds, rng = scene.mi_scene.bbox(), np.random.default_rng([floor.seed, 0])
    (x0, y0), (x1, y1) = ([corner.x, corner.y] for corner in (bounds.min, bounds.max))

    def free(low_m: float, high_m: float, count: int, apart: tuple[FloatArray, float] | None = None) -> FloatArray:
        """Free positions, twice as many as needed, but for those within a body."""
        box_m = np.array([[x0, y0, low_m], [x1, y1, high_m]])
        drawn = free_positions(scene, box_m, 2 * count, floor.clear_m, rng, floor.seed, apart)
        # Large bodies, such as the core, count as rooms there.
        closed = [mesh.triangles for _, mesh in plan.parts.values() if mesh.is_watertight]
        inside = np.any([winding_number(triangles, drawn) > 0.5 for triangles in closed], axis=0)
        return drawn[~inside][:count]

    places = free(floor.mount_m, floor.mount_m, CANDIDATES)
    y, x = np.divmod(np.arange(floor.rows * floor.columns), floor.columns)
    cell = np.array([x1 - x0, y1 - y0]) / [floor.columns, floor.rows]
    wanted = [x0, y0] + cell * (np.stack([x, y], axis=1) + rng.uniform(0.25, 0.75, (len(x), 2)))
    receivers_m = places[cKDTree(places[:, :2]).query(wanted)[1]]
    receivers = tuple(Receiver(f"anchor{k}", place, np.array(UPRIGHT)) for k, place in enumerate(receivers_m, start=1))
    count = floor.train + floor.test
    return receivers, free(floor.low_m, floor.high_m, count, (receivers_m, floor.from_receiver_m))


def strengths_of(traced: TraceResult, floor: FloorReceivers) -> Record:
    """Signal strengths of traced paths, with offsets, noise and sensitivity."""
    rng = np.random.default_rng([floor.seed, 2])
    strength = rssi_dbm(traced.paths) + floor.power_dbm
    strength += rng.normal(0, floor.offset_db, (len(strength), 1)) + rng.normal(0, floor.noise_db, strength.shape)
    strength[strength < floor.sensitivity_dbm] = np.nan
    return Record(
        name=NAME,
        task=RSSI,
        tx_pos_m=traced.tx_pos_m,
        receivers=traced.receivers,
        observation=strength.astype(np.float32),
        official=(np.arange(floor.train), floor.train + np.arange(floor.test)),
        frequencies_hz=np.array([CARRIER_HZ]),
    )
