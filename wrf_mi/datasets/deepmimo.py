"""The layout of DeepMIMO 4: ray-traced paths between base stations and users; ``docs/data.md`` has the files.

Sources: DeepMIMO, Alkhateeb, "DeepMIMO: A generic deep learning dataset for millimeter wave and massive MIMO
applications", ITA 2019; format and channel: https://github.com/DeepMIMO/DeepMIMO, version 4.0.5, its
``datasets/load.py``, ``consts.py`` and ``generator/channel.py``. That package is not needed here.

Channel of subcarrier k at element m, over the paths of power P (dBW for 0 dBW sent), phase phi, delay tau and
direction of departure u in the base station's frame::

    h[m, k] = sum sqrt(10^(P / 10)) exp(j phi) exp(+j k0 p_m . u) exp(-j 2 pi k bandwidth / N tau)

which is DeepMIMO's times sqrt(N): DeepMIMO divides the sent power among all N subcarriers. By reciprocity it is the
coefficient from the user to the base station, as in the other layouts. `wrf_mi.receivers.csi` computes the sum.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation

from ..core import Antenna, InputError, Paths, Receiver, Record
from ..core.angles import FloatArray, unit_vectors
from ..core.antenna import ANTENNA, DEVICE_TO_ARRAY
from ..core.array_files import stored_array, stored_arrays
from ..core.files import readable, text_lines
from ..core.settings import CheckedSettings, Positive, settings_from
from ..core.yaml_files import read_yaml
from ..receivers import array_response, csi
from ..tasks import CSI
from .folder_files import data_folder, fits_single, numbers_of, read_official, shown
from .read_mat import FAULT, mat_arrays

CHANNEL_PARAMS = "channel_params.yml"  # file of a scenario's folder that selects what is computed; optional
MAX_NUMBER, MAX_ELEMENTS = 1 << 20, 1 << 10  # most subcarriers, and most elements of an array along one axis
PARAMS = "params.json"
OLD_PARAMS = "params.mat"  # file of scenarios before version 4
VERSION = "4.0.5"
"""Version of the package whose format is described here; scenarios of all versions 4 are read."""
SUFFIXES = (".mat", ".npz", ".npy")  # formats of a matrix, in the order in which the package tries them
PATH_MATRICES = ("power", "phase", "delay", "aod_az", "aod_el", "aoa_az", "aoa_el")
"""Matrices [users, paths]: dBW, degrees, seconds; azimuths and zenith angles in degrees. NaN: no path."""
TEST_FRACTION = 0.2  # share of the users with a path in the official test rows
SPLIT_SEED = 0  # of the official test rows, which are the same for everyone
VALUES_PER_CHUNK = 1 << 20  # complex values of the largest array in a chunk of users
SHORTEST_M = 1e-9  # length in place of 0, for which a spherical wave has no amplitude
Pattern = Literal["isotropic", "halfwave-dipole"]
"""DeepMIMO's names of antenna patterns."""


@dataclass(frozen=True)
class _Ofdm:
    bandwidth: Positive = 10e6  # Hz, of all subcarriers
    subcarriers: Annotated[int, Field(ge=1, le=MAX_NUMBER, description=f"1 to {MAX_NUMBER}")] = 512
    selected_subcarriers: tuple[int, ...] = (0,)


@dataclass(frozen=True)
class _StationAntenna:
    shape: tuple[int, int] = (1, 1)  # elements along y and z of the base station's own frame
    spacing: Positive = 0.5  # wavelengths of the carrier
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees about the world's x axis, then y, then z
    radiation_pattern: Pattern = "isotropic"


@dataclass(frozen=True)
class _UserAntenna:
    radiation_pattern: Pattern = "isotropic"


@dataclass(frozen=True)
class _ChannelParams(CheckedSettings):
    """Content of `CHANNEL_PARAMS`: what is computed from the paths of a scenario.

    Names, units and defaults are those of ``deepmimo.ChannelParameters`` (DeepMIMO 4), except for the base station's
    array, a single antenna by default. ``add_carrier_phase`` multiplies each path by exp(-j 2 pi carrier delay), which
    some converters leave out.
    """

    ofdm: _Ofdm = field(default_factory=_Ofdm)
    bs_antenna: _StationAntenna = field(default_factory=_StationAntenna)
    ue_antenna: _UserAntenna = field(default_factory=_UserAntenna)
    base_stations: tuple[int, ...] | Literal["all"] | None = None
    add_carrier_phase: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        lists = {"ofdm.selected_subcarriers": (self.ofdm.selected_subcarriers, self.ofdm.subcarriers - 1)}
        if isinstance(self.base_stations, tuple):
            lists["base_stations"] = self.base_stations, MAX_NUMBER
        for name, (numbers, high) in lists.items():
            if len(set(numbers)) < len(numbers) or not 0 <= min(numbers, default=-1) <= max(numbers) <= high:
                text = f"setting {name}: {shown(list(numbers))}"
                raise InputError(f"{text}; give a list of different whole numbers from 0 to {high}")
        if not 1 <= min(self.bs_antenna.shape) <= max(self.bs_antenna.shape) <= MAX_ELEMENTS:
            text = f"setting bs_antenna.shape: {shown(list(self.bs_antenna.shape))}"
            raise InputError(f"{text}; give two whole numbers from 1 to {MAX_ELEMENTS}, elements along y and z")
        if not fits_single(np.array([*self.bs_antenna.rotation, self.bs_antenna.spacing, self.ofdm.bandwidth])):
            raise InputError("setting bs_antenna.rotation, bs_antenna.spacing or ofdm.bandwidth is too large; lower it")

    @property
    def offsets_hz(self) -> FloatArray:
        """Frequency of each selected subcarrier [K] relative to the carrier."""
        return np.array(self.ofdm.selected_subcarriers, float) * (self.ofdm.bandwidth / self.ofdm.subcarriers)

    @property
    def elements(self) -> FloatArray:
        """Elements [m, 3] in the base station's own frame, wavelengths: the first at the origin, y fastest."""
        across, up = self.bs_antenna.shape
        z, y = np.divmod(np.arange(across * up), across)
        return np.stack([np.zeros(len(y)), y, z], axis=1) * self.bs_antenna.spacing

    @property
    def rotation(self) -> FloatArray:
        """Rotation [3, 3] from the base station's own frame to the world's (3GPP TR 38.901, equation 7.1-2)."""
        return np.asarray(Rotation.from_euler("xyz", self.bs_antenna.rotation, degrees=True).as_matrix())


def _antennas(chosen: _ChannelParams) -> tuple[Antenna, ...]:
    patterns = (chosen.bs_antenna.radiation_pattern, "array"), (chosen.ue_antenna.radiation_pattern, "world")
    # An isotropic antenna is vertical in the world, as everywhere; powers do not state another polarisation.
    return tuple(ANTENNA if name == "isotropic" else Antenna("hw_dipole", frame=frame) for name, frame in patterns)


def _channel_params(file: Path, params: Mapping[str, Any] | None) -> _ChannelParams:
    if params is None:
        params = read_yaml(file) if file.exists() else {}
    try:
        return settings_from(_ChannelParams, params, str(file))
    except InputError as error:
        text = str(error).removeprefix(f"{file}, ")
        raise InputError(f"{file}: {text}{'' if ';' in text else '; correct it (docs/data.md)'}") from None


@dataclass(frozen=True)
class _Scenario:
    """Folder, carrier in Hz, base stations as (set, number in the set), and sets of users."""

    folder: Path
    carrier_hz: float
    stations: list[tuple[int, int]]
    user_sets: list[int]


def read_deepmimo(path: str | Path, name: str | None = None, params: Mapping[str, Any] | None = None) -> Record:
    """Read and check a scenario of DeepMIMO 4 and compute its channels.

    Args:
        path: folder of the scenario.
        name: name of the record; by default that of the folder.
        params: content of `CHANNEL_PARAMS`, in place of that file, see ``docs/data.md``.

    Returns:
        A record with ``task="csi"``: users as transmitters, a receiver for each chosen base station, ``observation``
        [n_rx, n, subcarriers] for a single antenna or [n_rx, n, antennas, subcarriers]; NaN for users without a path.

    Raises:
        InputError: anything missing, unreadable or inconsistent, or several base stations without a choice.
    """
    folder = data_folder(path, f"a scenario of DeepMIMO, {PARAMS} and its matrices")
    scenario, chosen = _read_scenario(folder), _channel_params(folder / CHANNEL_PARAMS, params)
    bs_antenna, ue_antenna = _antennas(chosen)
    orientation = Rotation.from_matrix(chosen.rotation @ DEVICE_TO_ARRAY.T).as_quat()
    numbers = _choose(scenario, chosen)
    of_stations = (_of_station(scenario, scenario.stations[number], chosen) for number in numbers)
    positions_m, (users, *others), channels = zip(*of_stations, strict=True)
    for number, other in zip(numbers[1:], others, strict=True):
        if not np.array_equal(other, users):
            text = f"users of base station {number} are at other positions than those of {numbers[0]}"
            raise InputError(f"{folder}: {text}; choose one of them in {CHANNEL_PARAMS}")
    observation = np.stack(channels)
    finite = np.isfinite(observation).reshape(len(numbers), len(users), -1)
    received = np.flatnonzero(finite.all(axis=2).any(axis=0))
    if len(received) < 2:
        text = f"{len(received)} of {len(users)} users have a path to the base stations {numbers}"
        raise InputError(f"{folder}: {text}; two at least are needed, to train on and to score")
    official = read_official(folder, len(users), first=0, source=folder.name)
    if official is None:
        order, n_test = np.random.default_rng(SPLIT_SEED).permutation(received), round(TEST_FRACTION * len(received))
        official = np.sort(order[max(1, n_test) :]), np.sort(order[: max(1, n_test)])
    array_m: FloatArray | None = (chosen.elements @ DEVICE_TO_ARRAY.T) * (speed_of_light / scenario.carrier_hz)
    if len(chosen.elements) == 1:
        array_m, observation = None, observation[:, :, 0]
    return Record(
        name=name or folder.resolve().name,
        task=CSI,
        tx_pos_m=users,
        receivers=tuple(
            Receiver(f"bs{number}", position, orientation, bs_antenna, array_m)
            for number, position in zip(numbers, positions_m, strict=True)
        ),
        observation=observation,
        official=official,
        frequencies_hz=scenario.carrier_hz + chosen.offsets_hz,
        tx_antenna=ue_antenna,
        source=str(folder),
    )


def _read_scenario(folder: Path) -> _Scenario:
    file = folder / PARAMS
    params = _read_params(folder)
    scene, rt_params = (_mapping(file, params, key) for key in ("scene", "rt_params"))
    if (scenes := scene.get("num_scenes", 1)) != 1:
        text = f"dynamic scenario of {shown(scenes)} scenes"
        raise InputError(f"{file}: {text}; give the folder of one scene, with a {PARAMS} that states num_scenes 1")
    carrier = numbers_of(rt_params.get("frequency"))
    if carrier.size != 1 or not 0 < carrier.item() < np.inf:
        raise InputError(f"{file}: rt_params: frequency is {shown(rt_params.get('frequency'))}; give the carrier in Hz")
    return _Scenario(folder, float(carrier.item()), *_stations_and_users(file, _mapping(file, params, "txrx_sets")))


def _read_params(folder: Path) -> Mapping[str, Any]:
    """Content of `PARAMS`, checked to be of a version 4."""
    file = folder / PARAMS
    if not file.exists() and (folder / OLD_PARAMS).exists():
        text = f"{folder / OLD_PARAMS}: a scenario before version 4 of DeepMIMO"
        raise InputError(f"{text}; fetch it in version 4, which has {PARAMS}")
    lines = text_lines(file)
    with readable(file, "", "fetch the scenario again"):
        params = json.loads("\n".join(lines))
    params = params if isinstance(params, dict) else {}
    version = params.get("version", VERSION)  # the first scenarios of version 4 do not state it
    if not isinstance(version, str) or version.partition(".")[0] != "4":
        text = f"version {shown(version)} of DeepMIMO"
        raise InputError(f"{file}: {text}; give a scenario of version 4, such as {VERSION}")
    return params


def _stations_and_users(file: Path, sets: Mapping[Any, Any]) -> tuple[list[tuple[int, int]], list[int]]:
    """Base stations as (set, number in the set), and sets of users."""
    stations: list[tuple[int, int]] = []
    users: list[int] = []
    for entry in (_mapping(file, sets, key) for key in sorted(sets, key=str) if str(key).startswith("txrx_set_")):
        if entry.get("is_tx"):
            stations += [(_number(file, entry, "id"), k) for k in range(_number(file, entry, "num_points"))]
        elif entry.get("is_rx"):
            users.append(_number(file, entry, "id"))
    for what, of_kind in (("base station (is_tx)", stations), ("set of users (is_rx, not is_tx)", users)):
        if not of_kind:
            raise InputError(f"{file}: no {what} in txrx_sets; give a scenario that has one")
    return stations, users


def _mapping(file: Path, entries: Mapping[Any, Any], key: str) -> Mapping[Any, Any]:
    value = entries.get(key)
    if not isinstance(value, Mapping):
        state = "missing" if value is None else shown(value)
        raise InputError(f"{file}: {key} is {state}; give a scenario of DeepMIMO 4")
    return value


def _number(file: Path, entry: Mapping[Any, Any], key: str) -> int:
    value = entry.get(key)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 30:
        raise InputError(f"{file}: txrx_sets: {key} is {shown(value)}; give a whole number from 0")
    return value


def _choose(scenario: _Scenario, chosen: _ChannelParams) -> list[int]:
    count, file = len(scenario.stations), scenario.folder / CHANNEL_PARAMS
    if chosen.base_stations is None and count > 1:
        text = f"{scenario.folder}: {count} base stations, 0 to {count - 1}"
        raise InputError(f"{text}; choose in {CHANNEL_PARAMS}, base_stations: [0] or base_stations: all")
    if chosen.base_stations is None or isinstance(chosen.base_stations, str):
        return list(range(count))
    if beyond := [number for number in chosen.base_stations if number >= count]:
        raise InputError(f"{file}: base station {beyond[0]} is out of range; the scenario has 0 to {count - 1}")
    return list(chosen.base_stations)


def _of_station(
    scenario: _Scenario, station: tuple[int, int], chosen: _ChannelParams
) -> tuple[FloatArray, FloatArray, NDArray[np.complex64]]:
    """Position [3], users [n, 3] and channels [n, m, k] of a base station, over all sets of users."""
    positions, users, channels = [], [], []
    for user_set in scenario.user_sets:
        pair = f"t{station[0]:03}_tx{station[1]:03}_r{user_set:03}"
        paths = _matrices(scenario.folder, pair)
        _check_shapes(scenario.folder, pair, paths)
        positions.append(paths.pop("tx_pos").reshape(3).astype(float))
        users.append(paths.pop("rx_pos").astype(float))
        channels.append(_channels(scenario, pair, paths, chosen))
    if any(not np.array_equal(position, positions[0]) for position in positions):
        text = f"base station {station[1]} of set {station[0]} has several positions"
        raise InputError(f"{scenario.folder}: {text}; fetch the scenario again")
    return positions[0], np.concatenate(users), np.concatenate(channels)


def _check_shapes(folder: Path, pair: str, matrices: Mapping[str, NDArray[Any]]) -> None:
    station, users = matrices["tx_pos"], matrices["rx_pos"]
    for key, fits, wanted in (
        ("tx_pos", station.size == 3, "x, y, z in metres"),
        ("rx_pos", users.shape[1:] == (3,), "[users, 3] in metres"),
    ):
        if not (fits and np.isfinite(matrices[key]).all()):
            text = f"{key}_{pair} has shape {list(matrices[key].shape)} or is not finite"
            raise InputError(f"{folder}: {text}; it must be {wanted}")
    expected = (len(users), *matrices["power"].shape[1:2])
    for key in PATH_MATRICES:
        if matrices[key].ndim != 2 or matrices[key].shape != expected:
            shape = list(matrices[key].shape)
            text = f"{key}_{pair} has shape {shape}, expected {list(expected)} as rx_pos and power"
            raise InputError(f"{folder}: {text}; fetch the scenario again")


def _matrices(folder: Path, pair: str) -> dict[str, NDArray[Any]]:
    """Matrices of a pair of a base station and a set of users, in whichever format each is stored."""
    files = {}
    for key in ("tx_pos", "rx_pos", *PATH_MATRICES):
        stem = folder / f"{key}_{pair}"
        files[key] = next(filter(Path.exists, (Path(f"{stem}{suffix}") for suffix in SUFFIXES)), stem)
        if files[key] == stem:
            raise InputError(f"{stem}: no {', '.join(SUFFIXES)} file of that name; fetch the scenario again")
    of_mat = mat_arrays(files, "fetch the scenario again")
    matrices = {}
    for key, file in files.items():
        with readable(file, "", "fetch the scenario again"):
            values = _matrix(file, key, of_mat)
        if values is None or values.dtype.kind not in "fiu":
            what = f"no array {key}" if values is None else f"{key} holds {values.dtype}"
            raise InputError(f"{file}: {what}; give real numbers by the name {key}")
        matrices[key] = values
    return matrices


def _matrix(file: Path, key: str, of_mat: Mapping[str, NDArray[Any]]) -> NDArray[Any] | None:
    if file.suffix != ".mat":
        return stored_array(file) if file.suffix == ".npy" else stored_arrays(file).get(key)
    if fault := of_mat.get(f"{FAULT}{key}"):
        raise ValueError(str(fault))
    return of_mat.get(key)


def _channels(
    scenario: _Scenario, pair: str, paths: Mapping[str, NDArray[Any]], chosen: _ChannelParams
) -> NDArray[np.complex64]:
    """Channels [n, m, k], NaN for users without a path."""
    elements_m, offsets_hz = chosen.elements * (speed_of_light / scenario.carrier_hz), chosen.offsets_hz
    if chosen.add_carrier_phase:
        offsets_hz = offsets_hz + scenario.carrier_hz
    n, most = paths["power"].shape
    channel = np.empty((n, len(elements_m), len(offsets_hz)), np.complex64)
    symbol_s = chosen.ofdm.subcarriers / chosen.ofdm.bandwidth
    step = max(1, VALUES_PER_CHUNK // max(1, most * len(elements_m), len(offsets_hz)))
    for start in range(0, n, step):
        rows = slice(start, start + step)
        # Matrices are padded with NaN to the most paths of a user.
        exist = ~np.isnan(paths["power"][rows])
        user, _ = np.nonzero(exist)
        power, phase, delay, *angles = (paths[key][rows][exist].astype(float) for key in PATH_MATRICES)
        if delay.max(initial=0.0) >= symbol_s:  # the package would leave such a path out
            text = f"{pair} has a delay of {delay.max():.3g} s, and a symbol of subcarriers / bandwidth lasts"
            raise InputError(f"{scenario.folder}: {text} {symbol_s:.3g} s; give more subcarriers in {CHANNEL_PARAMS}")
        departure, arrival = (
            unit_vectors(np.radians(azimuth), np.pi / 2 - np.radians(zenith))
            for azimuth, zenith in (angles[:2], angles[2:])
        )
        at_station = departure @ chosen.rotation  # rows times R: from the world's frame to the array's
        with np.errstate(over="ignore", invalid="ignore"):
            gain = 10 ** (power / 20) * np.exp(1j * np.radians(phase))
            for antenna, directions in zip(_antennas(chosen), (at_station, arrival), strict=True):
                gain = gain * np.linalg.norm(antenna.field(directions), axis=-1)
            length_m = np.where(delay >= 0, np.maximum(delay * speed_of_light, SHORTEST_M), np.nan)
            ends = user, np.zeros_like(user), gain, length_m, arrival, departure
            none, places = np.zeros((len(user), 0), np.uint8), np.zeros((len(user), 0, 3))
            to_first = Paths(*ends, none, places, none.astype(np.int32), (), len(exist), 1)
            # Waves are plane at the array, as DeepMIMO's: each element has the paths of the first, turned in phase.
            for element, response in enumerate(array_response(elements_m, at_station, scenario.carrier_hz).T):
                channel[rows, element] = csi(replace(to_first, gain=gain * response), offsets_hz)[0]
        bad = np.flatnonzero(~np.isfinite(channel[rows]).all(axis=(1, 2)))
        if len(bad):
            text = f"user {start + bad[0]} (from 0) of {pair}: power, phase, delay or angle of a path is not finite"
            raise InputError(f"{scenario.folder}: {text}, or its delay is negative; correct or remove the path")
        channel[rows][~exist.any(axis=1)] = np.nan
    return channel
