"""Channels that are computed from the paths of a DeepMIMO scenario: base stations, subcarriers, antennas.

Names, units and defaults are those of ``deepmimo.ChannelParameters`` (DeepMIMO 4), except for the base station's array,
a single antenna by default. ``docs/data.md`` has the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from ..core import Antenna, InputError
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA, DEVICE_TO_ARRAY
from ..core.types import IntArray
from .folder_files import fits_single, numbers_of, shown

CHANNEL_PARAMS = "channel_params.yml"
"""File of a scenario's folder that selects what is computed; optional."""
ALL = "all"
PATTERNS = {"isotropic": "iso", "halfwave-dipole": "hw_dipole"}
"""Patterns of Sionna RT (`wrf_mi.core.Antenna`) by their names in DeepMIMO."""
BASE_STATIONS, ADD_CARRIER_PHASE = "base_stations", "add_carrier_phase"
KEYS = {
    "ofdm": ("bandwidth", "subcarriers", "selected_subcarriers"),
    "bs_antenna": ("shape", "spacing", "rotation", "radiation_pattern"),
    "ue_antenna": ("radiation_pattern",),
}
MAX_NUMBER, MAX_ELEMENTS = 1 << 20, 1 << 10


@dataclass(frozen=True)
class ChannelParams:
    """Base stations, subcarriers and antennas of the channels of a scenario.

    Attributes:
        base_stations: numbers of the base stations in the scenario, or ``"all"``; None: not chosen.
        bandwidth_hz: bandwidth of all subcarriers.
        subcarriers: number of subcarriers in the bandwidth, N.
        selected: subcarriers k that are computed, [K]; the frequency of k is the carrier + k bandwidth / N.
        shape: elements of the base station's array along y and z of its own frame.
        spacing: distance of neighbouring elements, wavelengths of the carrier.
        rotation: rotation [3, 3] from the base station's own frame to the world's.
        bs_antenna: antenna of each element.
        ue_antenna: antenna of the users.
        add_carrier_phase: multiply each path by exp(-j 2 pi carrier delay), which some converters leave out.
    """

    base_stations: tuple[int, ...] | str | None
    bandwidth_hz: float
    subcarriers: int
    selected: IntArray
    shape: tuple[int, int]
    spacing: float
    rotation: FloatArray
    bs_antenna: Antenna
    ue_antenna: Antenna
    add_carrier_phase: bool

    @property
    def offsets_hz(self) -> FloatArray:
        """Frequency of each selected subcarrier [K] relative to the carrier."""
        return self.selected.astype(float) * (self.bandwidth_hz / self.subcarriers)

    @property
    def elements(self) -> FloatArray:
        """Elements [m, 3] in the base station's own frame, wavelengths: the first at the origin, y fastest."""
        z, y = np.divmod(np.arange(self.shape[0] * self.shape[1]), self.shape[0])
        return np.stack([np.zeros(len(y)), y, z], axis=1) * self.spacing

    @property
    def orientation_xyzw(self) -> FloatArray:
        """Unit quaternion from the frame of the array (`wrf_mi.core.arrays`) to the world's."""
        return Rotation.from_matrix(self.rotation @ DEVICE_TO_ARRAY.T).as_quat()


def channel_params(file: Path, given: Mapping[Any, Any]) -> ChannelParams:
    """Parameters from the content of `CHANNEL_PARAMS`; those that are not given have their defaults.

    Args:
        file: file named in messages.
        given: ``base_stations``, ``add_carrier_phase`` and `KEYS`.

    Raises:
        InputError: an unknown key, or a value of another kind or out of range.
    """
    _refuse_unknown(file, "", given, (BASE_STATIONS, ADD_CARRIER_PHASE, *KEYS))
    parts: dict[str, Mapping[Any, Any]] = {}
    for name, keys in KEYS.items():
        part = given.get(name, {})
        if not isinstance(part, Mapping):
            raise InputError(f"{file}: {name} is {shown(part)}; give some of {', '.join(keys)}")
        _refuse_unknown(file, f"{name}: ", part, keys)
        parts[name] = part
    ofdm, station = parts["ofdm"], parts["bs_antenna"]
    number = numbers_of(stated := ofdm.get("subcarriers", 512))
    if number.shape != () or isinstance(stated, bool) or not _are_whole(number, 1, MAX_NUMBER):
        raise InputError(f"{file}: subcarriers is {shown(stated)}; give a whole number from 1")
    count = int(number)
    shape = numbers_of(stated := station.get("shape", [1, 1]))
    if shape.shape != (2,) or not _are_whole(shape, 1, MAX_ELEMENTS):
        text = f"shape is {shown(stated)}; give two whole numbers from 1 to {MAX_ELEMENTS}, elements along y and z"
        raise InputError(f"{file}: {text}")
    selected, wanted = ofdm.get("selected_subcarriers", [0]), f"a list of different whole numbers from 0 to {count - 1}"
    rotation_deg = numbers_of(station.get("rotation", [0, 0, 0]))
    if rotation_deg.shape != (3,) or not fits_single(rotation_deg):
        text = f"rotation is {shown(station['rotation'])}"
        raise InputError(f"{file}: {text}; give the angles about x, y and z in degrees")
    add_phase = given.get(ADD_CARRIER_PHASE, False)
    if not isinstance(add_phase, bool):
        raise InputError(f"{file}: {ADD_CARRIER_PHASE} is {shown(add_phase)}; give true or false")
    return ChannelParams(
        _base_stations(file, given.get(BASE_STATIONS)),
        _positive(file, "bandwidth", ofdm.get("bandwidth", 10e6), "Hz"),
        count,
        _list(file, "selected_subcarriers", selected, count - 1, wanted),
        (int(shape[0]), int(shape[1])),
        _positive(file, "spacing", station.get("spacing", 0.5), "wavelengths"),
        # 3GPP TR 38.901, equation 7.1-2: about the world's x axis, then y, then z.
        Rotation.from_euler("xyz", rotation_deg, degrees=True).as_matrix(),
        _antenna(file, "bs_antenna", station, "array"),
        _antenna(file, "ue_antenna", parts["ue_antenna"], "world"),
        add_phase,
    )


def _refuse_unknown(file: Path, where: str, given: Mapping[Any, Any], known: tuple[str, ...]) -> None:
    for key in given:
        if key not in known:
            raise InputError(f"{file}: {where}{shown(key)} is not known; give some of {', '.join(known)}")


def _base_stations(file: Path, value: Any) -> tuple[int, ...] | str | None:
    if value is None or (isinstance(value, str) and value == ALL):
        return value
    numbers = _list(file, BASE_STATIONS, value, MAX_NUMBER, f"{ALL} or a list of different whole numbers from 0")
    return tuple(numbers.tolist())


def _list(file: Path, name: str, value: Any, high: int, wanted: str) -> IntArray:
    numbers = numbers_of(value)
    if numbers.ndim != 1 or not len(numbers) or not _are_whole(numbers, 0, high):
        raise InputError(f"{file}: {name} is {shown(value)}; give {wanted}")
    if len(np.unique(numbers)) != len(numbers):
        raise InputError(f"{file}: {name} is {shown(value)}, with a number twice; give {wanted}")
    return numbers.astype(np.int64)


def _are_whole(numbers: FloatArray, low: int, high: int) -> bool:
    return bool(((numbers >= low) & (numbers <= high) & (numbers % 1 == 0)).all())


def _positive(file: Path, name: str, value: Any, unit: str) -> float:
    number = numbers_of(value)
    if number.shape != () or isinstance(value, bool) or not (number > 0 and fits_single(number)):
        raise InputError(f"{file}: {name} is {shown(value)}; give a positive number of {unit}")
    return float(number)


def _antenna(file: Path, name: str, given: Mapping[Any, Any], frame: str) -> Antenna:
    pattern = given.get("radiation_pattern", "isotropic")
    if not isinstance(pattern, str) or pattern not in PATTERNS:
        text = f"{name}: radiation_pattern is {shown(pattern)}"
        raise InputError(f"{file}: {text}; choose from {', '.join(PATTERNS)}")
    # An isotropic antenna is vertical in the world, as everywhere; powers do not state another polarisation.
    return ANTENNA if pattern == "isotropic" else Antenna(PATTERNS[pattern], frame=frame)
