"""Pattern and polarisation of antennas, in the terms of Sionna RT."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from .angles import FloatArray, rotation_matrix
from .errors import InputError

if TYPE_CHECKING:
    from .types import Record

OMNIDIRECTIONAL = ("iso", "dipole", "hw_dipole")
"""Sionna RT's antenna patterns without dependence on azimuth: isotropic, short and half-wave dipole."""
PATTERNS = (*OMNIDIRECTIONAL, "tr38901")
"""Sionna RT's antenna patterns; the last is the element of 3GPP TR 38.901."""
POLARIZATIONS = ("V", "H")
"""Sionna RT's polarisations with one port: slant angles of 0 and 90 degrees."""
FRAMES = ("world", "array")

# Arrays of a Sionna RT device lie in y-z with boresight +x: array x = device y, array y = device z, array z = device x.
DEVICE_TO_ARRAY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
"""Quaternion of a frame parallel to the world's."""
POLE = 1e-12
"""Squared sine of the zenith angle below which the azimuth is taken to be zero, as Sionna RT does."""


@dataclass(frozen=True)
class Antenna:
    """Pattern and polarisation of an antenna.

    The pattern is Sionna RT's function of zenith and azimuth angle in the antenna's frame, whose z axis is the axis
    of a dipole and whose x axis is the boresight of a directional element. The polarisation turns the field about the
    direction of propagation and leaves the pattern's amplitude as it is (model 2 of 3GPP TR 38.901, section 7.3.2).

    Attributes:
        pattern: name in `PATTERNS`.
        polarization: ``"V"``: along the unit vector of the zenith angle; ``"H"``: along the unit vector of the azimuth.
        frame: ``"world"``: the antenna's z axis is the world's, for any orientation of the array. ``"array"``: its z
            axis is the array's y axis, its boresight the array's normal.
    """

    pattern: str = "iso"
    polarization: str = "V"
    frame: str = "world"

    def __post_init__(self) -> None:
        """Refuse unknown names, and a directional pattern without orientation.

        Raises:
            InputError: naming the attribute and its values.
        """
        for name, known in (("pattern", PATTERNS), ("polarization", POLARIZATIONS), ("frame", FRAMES)):
            if getattr(self, name) not in known:
                text = f"antenna: {name} is {str(getattr(self, name))[:40]!r}; choose from {', '.join(known)}"
                raise InputError(text)
        if self.pattern == "tr38901" and self.frame == "world":
            raise InputError(
                "antenna: pattern tr38901 has a boresight, which the frame world does not tell; state frame array "
                "(--rx-frame array), or for transmitters and anchors one of " + ", ".join(OMNIDIRECTIONAL)
            )

    @property
    def turned(self) -> Antenna:
        """The antenna with its polarisation turned by 90 degrees."""
        return replace(self, polarization="H" if self.polarization == "V" else "V")

    def to_world(self, orientation_xyzw: ArrayLike) -> FloatArray:
        """Rotation [3, 3] from the antenna's frame to the world's.

        Args:
            orientation_xyzw: unit quaternion of the array, its frame to world.
        """
        return np.eye(3) if self.frame == "world" else rotation_matrix(orientation_xyzw) @ DEVICE_TO_ARRAY

    def mounted(self, orientation_xyzw: ArrayLike = UPRIGHT) -> MountedAntenna:
        """The antenna of an array with an orientation (unit quaternion, array's frame to world)."""
        return MountedAntenna(self, self.to_world(orientation_xyzw))

    def field(self, directions: ArrayLike) -> FloatArray:
        """Real field vectors [..., 3] in directions [..., 3] (unit vectors), both in the antenna's own frame.

        Source: Sionna RT's antenna patterns; Balanis, "Antenna Theory" (1997), equations 4-26a and 4-84; 3GPP
        TR 38.901, table 7.3-1 and equations 7.3-4 and 7.3-5.
        """
        u = np.asarray(directions, float)
        x, y, z = np.moveaxis(u, -1, 0)
        level = np.hypot(x, y)
        pole = level**2 < POLE
        divisor = np.where(pole, 1.0, level)
        cosine, sine = np.where(pole, 1.0, x / divisor), np.where(pole, 0.0, y / divisor)
        if self.polarization == "V":
            unit = np.stack([z * cosine, z * sine, -level], axis=-1)
        else:
            unit = np.stack([-sine, cosine, np.zeros_like(z)], axis=-1)
        return unit * self._amplitude(level, z, np.arctan2(sine, cosine), pole)[..., None]

    def _amplitude(self, level: FloatArray, z: FloatArray, azimuth: FloatArray, pole: Any) -> FloatArray:
        if self.pattern == "iso":
            return np.ones_like(z)
        if self.pattern == "dipole":
            result: FloatArray = np.sqrt(1.5) * level
            return result
        if self.pattern == "hw_dipole":
            return np.where(pole, 0.0, np.sqrt(1.643) * np.cos(np.pi / 2 * z) / np.where(pole, 1.0, level))
        width = np.radians(65)
        vertical = np.minimum(12 * ((np.arctan2(level, z) - np.pi / 2) / width) ** 2, 30)
        decibel = 8 - np.minimum(vertical + np.minimum(12 * (azimuth / width) ** 2, 30), 30)
        return np.asarray(10 ** (decibel / 20))


@dataclass(frozen=True)
class MountedAntenna:
    """An antenna in the world.

    Attributes:
        antenna: pattern and polarisation.
        to_world: rotation [3, 3] from the antenna's frame to the world's.
    """

    antenna: Antenna
    to_world: FloatArray

    def field(self, directions: ArrayLike) -> FloatArray:
        """Real field vectors [..., 3] in directions [..., 3] (unit vectors), both in the world's frame."""
        return self.antenna.field(np.asarray(directions, float) @ self.to_world) @ self.to_world.T


ANTENNA = Antenna()
"""The default: isotropic, polarised along the vertical of the world."""


@dataclass(frozen=True)
class AntennaOptions:
    """Antennas that replace those in the data; None: no replacement.

    Attributes:
        rx_pattern: pattern of every receiver's antennas.
        rx_polarization: polarisation of every receiver's antennas.
        rx_frame: frame of every receiver's antennas.
        tx_pattern: pattern of the transmitter's antenna.
        tx_polarization: polarisation of the transmitter's antenna.
    """

    rx_pattern: str | None = None
    rx_polarization: str | None = None
    rx_frame: str | None = None
    tx_pattern: str | None = None
    tx_polarization: str | None = None

    def __bool__(self) -> bool:
        """Whether any attribute is stated."""
        return any(getattr(self, field.name) is not None for field in fields(self))

    def of(self, record: Record) -> Record:
        """A record with these antennas.

        Raises:
            InputError: names that `Antenna` refuses.
        """
        if not self:
            return record
        stated = [(*field.name.split("_"), getattr(self, field.name)) for field in fields(self)]
        rx, tx = (
            {key: value for end, key, value in stated if end == which and value is not None} for which in ("rx", "tx")
        )
        receivers = tuple(replace(receiver, antenna=replace(receiver.antenna, **rx)) for receiver in record.receivers)
        return replace(record, receivers=receivers, tx_antenna=replace(record.tx_antenna, **tx))


AS_STATED = AntennaOptions()
"""Antennas as in the data."""
