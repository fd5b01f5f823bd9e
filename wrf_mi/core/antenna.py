"""Pattern and polarisation of antennas, in the terms of Sionna RT."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .angles import FloatArray, rotation_matrix
from .digest import content_digest
from .errors import InputError
from .measured_pattern import MeasuredPattern
from .pattern_files import PATTERN_FILES, read_pattern

logger = logging.getLogger(__name__)

OMNIDIRECTIONAL = ("iso", "dipole", "hw_dipole")
"""Sionna RT's antenna patterns without dependence on azimuth: isotropic, short and half-wave dipole."""
PATTERNS = (*OMNIDIRECTIONAL, "tr38901")  # Sionna RT's antenna patterns; the last is the element of 3GPP TR 38.901
POLARIZATIONS = ("V", "H")  # Sionna RT's polarisations with one port: slant angles of 0 and 90 degrees
FRAMES = ("world", "array")

# Arrays of a Sionna RT device lie in y-z with boresight +x: array x = device y, array y = device z, array z = device x.
DEVICE_TO_ARRAY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
UPRIGHT = (0.0, 0.0, 0.0, 1.0)  # quaternion of a frame parallel to the world's
LEAST_EFFICIENCY = 0.1
"""Least efficiency without a warning: small phones have more, gains relative to a beam's maximum seem to have less."""


def pattern_path(pattern: object, folder: Path = Path()) -> Path | None:
    """Absolute path of a pattern that is a file, relative to a folder; None: not a file."""
    if not isinstance(pattern, str) or not pattern.lower().endswith(PATTERN_FILES):
        return None
    return (folder / Path(pattern).expanduser()).absolute()


@lru_cache(maxsize=64)
def _measured(path: Path, _digest: str) -> MeasuredPattern:
    """The pattern of a file of this content: receivers share it."""
    pattern = read_pattern(path)
    if pattern.efficiency < LEAST_EFFICIENCY:
        logger.warning("%s: %s; gains relative to the maximum? give them in dBi", path, pattern)
    return pattern


def boresight_orientation(azimuth_rad: float, downtilt_rad: float = 0.0) -> FloatArray:
    """Orientation of an array by its boresight: unit quaternion x, y, z, w, array's frame to world.

    The boresight, the array's z axis, has the azimuth, from +x towards +y, and points below the horizon by the
    downtilt; the array's y axis points upwards, as of Sionna RT's devices of that yaw and pitch.

    >>> from wrf_mi.core.angles import rotation_matrix
    >>> rotation_matrix(boresight_orientation(np.pi / 2))[:, 2].round(6) + 0.0
    array([0., 1., 0.])
    """
    from scipy.spatial.transform import Rotation  # half of the time that the command takes to show its help

    device = Rotation.from_euler("ZY", [azimuth_rad, downtilt_rad])
    return np.asarray((device * Rotation.from_matrix(DEVICE_TO_ARRAY.T)).as_quat())


POLE = 1e-12  # squared sine of the zenith angle below which the azimuth is taken to be zero, as Sionna RT does
WIDTH_RAD = math.radians(65)  # half-power width of the directional element


@dataclass(frozen=True)
class Antenna:
    """Pattern and polarisation of an antenna.

    The pattern is Sionna RT's function of zenith and azimuth angle in the antenna's frame, whose z axis is the axis
    of a dipole and whose x axis is the boresight of a directional element. The polarisation turns the field about the
    direction of propagation and leaves the pattern's amplitude as it is (model 2 of 3GPP TR 38.901, section 7.3.2).

    Attributes:
        pattern: name in `PATTERNS`, or path of a file with a measured pattern (`wrf_mi.core.pattern_files`).
        polarization: ``"V"``: along the unit vector of the zenith angle; ``"H"``: along the unit vector of the azimuth.
        frame: ``"world"``: the antenna's z axis is the world's, for any orientation of the array. ``"array"``: its z
            axis is the array's y axis, its boresight the array's normal.
        digest: of a measured pattern's file, set from it; empty of other patterns.

    Raises:
        InputError: an unknown name, a directional pattern without orientation, or a file that is missing, wrong, or not
            the one of the digest.
    """

    pattern: str = "iso"
    polarization: str = "V"
    frame: str = "world"
    digest: str = ""

    measured: ClassVar[MeasuredPattern | None] = None
    """The pattern of the file, of instances; None: a pattern of Sionna RT."""

    def __post_init__(self) -> None:
        path = pattern_path(self.pattern)
        for name, choices in (("pattern", PATTERNS), ("polarization", POLARIZATIONS), ("frame", FRAMES)):
            if (value := getattr(self, name)) not in choices and (name != "pattern" or path is None):
                text = f"antenna: {name} is {str(value)[:40]!r}; choose from {', '.join(choices)}"
                raise InputError(text + f", or a file *{', *'.join(PATTERN_FILES)}" * (name == "pattern"))
        if path is not None:
            digest = content_digest(path)
            if self.digest not in ("", digest):
                raise InputError(f"{path}: changed since this antenna was stated; restore it, or state it anew")
            # Attributes of a frozen class: the path from anywhere, and what equality and digests depend on.
            for name, content in (("pattern", str(path)), ("digest", digest), ("measured", _measured(path, digest))):
                object.__setattr__(self, name, content)
        if self.pattern == "tr38901" and self.frame == "world":
            text = "antenna: pattern tr38901 has a boresight, which the frame world does not tell; state frame array "
            text += "(--rx-frame array), for anchors azimuth_deg, or for transmitters one of "
            raise InputError(text + ", ".join(OMNIDIRECTIONAL))

    @property
    def turned(self) -> Antenna:
        """The antenna with its polarisation turned by 90 degrees."""
        return replace(self, polarization="H" if self.polarization == "V" else "V")

    def to_world(self, orientation_xyzw: ArrayLike) -> FloatArray:
        """Rotation [3, 3] from the antenna's frame to the world's, for an array's orientation (quaternion to world)."""
        return np.eye(3) if self.frame == "world" else rotation_matrix(orientation_xyzw) @ DEVICE_TO_ARRAY

    def mounted(self, orientation_xyzw: ArrayLike = UPRIGHT) -> MountedAntenna:
        """The antenna of an array with an orientation (unit quaternion, array's frame to world)."""
        return MountedAntenna(self, self.to_world(orientation_xyzw))

    def field(self, directions: ArrayLike) -> NDArray[Any]:
        """Field vectors [..., 3] in directions [..., 3] (unit vectors), both in the antenna's own frame.

        Real, or of a pattern with a measured phase complex.
        Source: Sionna RT's antenna patterns; Balanis, "Antenna Theory" (1997), equations 4-26a and 4-84; 3GPP
        TR 38.901, table 7.3-1 and equations 7.3-4 and 7.3-5.
        """
        parts = self.components(np, *np.moveaxis(np.asarray(directions, float), -1, 0))
        real, *imaginary = (np.stack(part, axis=-1) for part in parts)
        return real + 1j * imaginary[0] if imaginary else real

    def components(self, arrays: Any, x: Any, y: Any, z: Any, tables: list[Any] | None = None) -> list[list[Any]]:
        """Components of `field` for unit vectors: of the real part and, of a measured phase, of the imaginary part.

        Differentiable where ``arrays`` is Dr.Jit in place of NumPy; ``tables`` as of `MeasuredPattern.amplitude`.
        """
        select = arrays.where if arrays is np else arrays.select
        square = x * x + y * y
        pole = square < POLE
        inverse = 1 / arrays.sqrt(select(pole, 1.0, square))
        # Cosine and sine of the azimuth, and ``level``, the sine of the zenith angle.
        cosine, sine, level = select(pole, 1.0, x * inverse), select(pole, 0.0, y * inverse), square * inverse
        unit = [z * cosine, z * sine, -level] if self.polarization == "V" else [-sine, cosine, 0 * z]
        if self.pattern == "iso":
            return [unit]
        if self.measured is not None:
            angles = arrays.atan2(level, z), arrays.atan2(sine, cosine)
            return [[part * axis for axis in unit] for part in self.measured.amplitude(arrays, *angles, tables)]
        if self.pattern == "dipole":
            amplitude = math.sqrt(1.5) * level  # directivity 1.5
        elif self.pattern == "hw_dipole":
            # Its limit at the poles is 0, where the quotient is 0 / 0; directivity 1.643.
            amplitude = select(pole, 0.0, math.sqrt(1.643) * arrays.cos(math.pi / 2 * z) * inverse)
        else:
            angles = (arrays.atan2(level, z) - math.pi / 2) / WIDTH_RAD, arrays.atan2(sine, cosine) / WIDTH_RAD
            vertical, horizontal = (arrays.minimum(12 * angle * angle, 30.0) for angle in angles)
            amplitude = arrays.exp(math.log(10) / 20 * (8 - arrays.minimum(vertical + horizontal, 30.0)))
        return [[amplitude * part for part in unit]]


@dataclass(frozen=True)
class MountedAntenna:
    """An antenna in the world, and the rotation [3, 3] from its frame to the world's."""

    antenna: Antenna
    to_world: FloatArray


ANTENNA = Antenna()  # the default: isotropic, polarised along the vertical of the world


@dataclass(frozen=True)
class AntennaOptions:
    """Antennas of every receiver and of the transmitter that replace those in the data; None: no replacement."""

    rx_pattern: str | None = None
    rx_polarization: str | None = None
    rx_frame: str | None = None
    tx_pattern: str | None = None
    tx_polarization: str | None = None

    def __post_init__(self) -> None:
        for name in ("rx_pattern", "tx_pattern"):
            if (path := pattern_path(getattr(self, name))) is not None:  # runs are opened from anywhere
                object.__setattr__(self, name, str(path))

    def __bool__(self) -> bool:
        """Whether any attribute is stated."""
        return any(getattr(self, field.name) is not None for field in fields(self))

    def replaced(self, antenna: Antenna, end: Literal["rx", "tx"]) -> Antenna:
        """An antenna of the data, of a receiver or a transmitter, with the attributes that are stated for this end.

        `InputError`: names that `Antenna` refuses.
        """
        replacements = {
            field.name[3:]: getattr(self, field.name) for field in fields(self) if field.name.startswith(end)
        }
        replacements = {name: value for name, value in replacements.items() if value is not None}
        return replace(antenna, **replacements, **({"digest": ""} if "pattern" in replacements else {}))


AS_STATED = AntennaOptions()  # antennas as in the data
