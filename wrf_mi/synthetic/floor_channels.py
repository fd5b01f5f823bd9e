"""Channels traced between a base station and users who walk through two made-up floors: uplink and downlink.

``docs/data.md`` describes them. Subcarriers are IEEE 802.11's at -26..-1 (the uplink) and 1..26 (the downlink). By
reciprocity the base station is the record's receiver in both. Each user has a vertical antenna and walks a closed
route through rooms and doors (`wrf_mi_scenes.floor_plans`), two on each; rows run in the order of time, user after
user.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from wrf_mi_scenes import floor_plans
from wrf_mi_scenes.floor_plans import FloorPlan
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.registry import content_sha256

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.arrays import planar_array
from ..datasets import make_splits, read_nerf2_csi, write_nerf2_csi
from ..tasks import CSI
from ..tracing.sionna.scenes import open_scene
from .searches import Searches, trace_channels
from .stored import Files, scene_files, stored

PLACES = {"flat": floor_plans.flat, "office": floor_plans.office}
PREFIX = "traced-csi-"  # of the names of the data sets
ORIGIN = "wrf_mi_scenes.floor_plans"
MEASURED = "floor"  # folder beside the channels with the measured scene, the input of models
CHUNK_SIZE = 100  # users that are traced together
FORMAT = 4  # version of the files, to be raised when they change for equal parameters

CARRIER_HZ, SPACING_HZ, HALF = 2.437e9, 312.5e3, 26
UPLINK_HZ: FloatArray = CARRIER_HZ + SPACING_HZ * np.arange(-HALF, 0, dtype=float)
DOWNLINK_HZ: FloatArray = CARRIER_HZ + SPACING_HZ * np.arange(1, HALF + 1, dtype=float)
# Array's x = y of the world, y = up, boresight z = x of the world.
ORIENTATION = (0.5, 0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Walk(Searches):
    """Parameters of a floor's channels, beside those of `Searches`."""

    rows: int = 8  # rows of the base station's array
    columns: int = 13  # columns of the base station's array
    users: int = 2  # number of users on each route
    places: int = 80  # number of positions of each user
    scattered_depth: int | None = 2
    wander_m: float = 0.12  # largest deviation of users from the route, along x and along y
    height_m: float = 1.2  # height of a user's antenna
    sway_m: float = 0.15  # largest deviation of that height
    snr_db: float = 25.0  # signal-to-noise ratio of each row's uplink and downlink, mean over antennas and subcarriers


DEFAULT = Walk()


def walked_channels(
    place: str, folder: str | Path | None = None, walk: Walk = DEFAULT, progress: bool = False
) -> Record:
    """Uplink and downlink channels of the floor ``flat`` or ``office``; `InputError`: another place.

    They are read or made in a folder in the layout of NeRF2's channels (`wrf_mi.synthetic.stored.stored`). The official
    split is a seeded random split of 80 and 20 %. The record has ``task="csi"``: ``observation`` and ``truth``
    [1, n, antennas, 26], ``uplink`` [n, antennas, 26]. ``progress`` shows a bar on standard error.
    """
    if place not in PLACES:
        raise InputError(f"place {place!r}: unknown; give one of {', '.join(PLACES)}")
    name, plan = f"{PREFIX}{place}", PLACES[place]()
    facts = {"format": FORMAT, "place": place, "station_m": plan.station_m, "routes_m": plan.routes, **asdict(walk)}
    facts |= {"frequency_hz": CARRIER_HZ, "subcarrier_spacing_hz": SPACING_HZ}

    def write(folder: Path, scene_folder: Path, extra: Files) -> None:
        write_nerf2_csi(folder, _trace(scene_folder, name, plan, walk, progress), replace=True, extra=extra)

    return made_on_floor(name, folder, plan, walk, facts, write, read_nerf2_csi)


def made_on_floor(
    name: str,
    folder: str | Path | None,
    plan: FloorPlan,
    searches: Searches,
    facts: dict[str, Any],
    write: Callable[[Path, Path, Files], None],
    read: Callable[[Path, str], Record],
) -> Record:
    """The record of a folder (`wrf_mi.synthetic.stored.stored`), after tracing it on a floor unless it is there.

    ``write`` takes the folder, that of the true scene, and further files, of which the parameters come last.
    """
    with tempfile.TemporaryDirectory() as work:
        write_scene(Path(work), plan.parts, "A floor of several rooms", ORIGIN)

        def write_floor(folder: Path, recipe: Files) -> None:
            bare = floor_plans.measured(plan, searches.mesh_error_m, searches.seed)
            write(folder, Path(work), scene_files(bare, MEASURED, ORIGIN) | recipe)

        facts = {**facts, "scene_sha256": content_sha256(Path(work), "scene.xml")}
        return stored(name, folder, facts, write_floor, read)


def users_way(route: tuple[tuple[float, float], ...], walk: Walk, rng: np.random.Generator) -> FloatArray:
    """Positions [walk.places, 3] in metres, evenly along a closed route of corners (x, y), to 0.1 mm."""
    corners = np.array([*route, route[0]])
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    share = (np.arange(walk.places) + rng.uniform()) / walk.places
    places = np.stack([np.interp(share * length[-1], length, corners[:, axis]) for axis in range(2)], axis=-1)
    height = np.full(walk.places, walk.height_m)
    # Whole numbers of turns close the way; the amplitudes of two waves add up to the largest deviation.
    for cycles in (3, 7):
        turn = 2 * np.pi * (cycles * share[:, None] + rng.uniform(size=3))
        places += walk.wander_m / 2 * np.sin(turn[:, :2])
        height += walk.sway_m / 2 * np.sin(turn[:, 2])
    return np.round(np.concatenate([places, height[:, None]], axis=1), 4)


def with_noise(channel: NDArray[np.complex128], snr_db: float, rng: np.random.Generator) -> NDArray[np.complex128]:
    """Channels [n, antennas, subcarriers] with circular complex normal noise.

    ``snr_db`` is the ratio of a row's mean power over antennas and subcarriers to the power of the noise.
    """
    power = (np.abs(channel) ** 2).mean(axis=(1, 2), keepdims=True) * 10 ** (-snr_db / 10)
    noise = rng.standard_normal(channel.shape) + 1j * rng.standard_normal(channel.shape)
    return channel + np.sqrt(power / 2) * noise


def _trace(scene_folder: Path, name: str, plan: FloorPlan, walk: Walk, progress: bool) -> Record:
    scene, rng = open_scene(scene_folder, CARRIER_HZ), np.random.default_rng([walk.seed, 0])
    ways = [users_way(route, walk, rng) for route in plan.routes for _ in range(walk.users)]
    positions = np.concatenate(ways)
    array_m = planar_array(walk.rows, walk.columns, speed_of_light / CARRIER_HZ / 2)
    receiver = Receiver("base-station", np.array(plan.station_m), np.array(ORIENTATION), array_m=array_m)
    frequencies, text = np.concatenate([UPLINK_HZ, DOWNLINK_HZ]), f"tracing {name}" if progress else None
    how: dict[str, Any] = {"chunk_size": CHUNK_SIZE, "progress": text}
    channel = trace_channels(scene, receiver, positions, frequencies, walk.options(), **how)
    noise = np.random.default_rng([walk.seed, 1])
    up, down = (with_noise(band, walk.snr_db, noise) for band in (channel[..., :HALF], channel[..., HALF:]))
    record = Record(
        name=name,
        task=CSI,
        tx_pos_m=positions,
        receivers=(receiver,),
        observation=down.astype(np.complex64)[None],
        frequencies_hz=DOWNLINK_HZ,
        uplink=up.astype(np.complex64),
        uplink_hz=UPLINK_HZ,
        truth=channel[None, ..., HALF:].astype(np.complex64),
    )
    split = make_splits(record, "random", seed=walk.seed)[0]
    return replace(record, official=(split.all_train, split.test))
