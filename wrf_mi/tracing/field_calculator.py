"""Known chains of surfaces followed anew: unfolded length, directions and polarised gain, with derivatives.

The image method and the field along each path as Sionna RT computes them, for paths that it found, in any float type.
The transmitter's image after all reflections tells the length and the direction of arrival; going back through the
chain, each direction before a reflection is the mirrored one after it. No point of interaction is needed, so nothing is
divided by a distance to a wall.

Sionna RT's own stages have derivatives too (``loop_mode="evaluated"``), but in float32, at some two hundred kernels a
step, with materials that live in the scene; `docs/joint.md` compares them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from scipy.constants import speed_of_light

from ..core import Antenna
from ..core.antenna import ANTENNA, POLE
from ..gaussians.footprint import Pose
from .slab import slab

ALONG = 1e-12
"""Squared sine below which a direction lies along a wall's normal: any plane of incidence will do."""

Vector = list[Any]
Complex = tuple[Any, Any]


@dataclass
class Level:
    """What q paths meet at one depth, arrays [q].

    Attributes:
        normal: of the plane, either sign, world; zeros where nothing is met.
        offset_m: n . x of the plane.
        reflects: the wave is mirrored there.
        transmits: the wave passes through.
        material: index into the materials' tables.
        plane: index into the scene's planes.
    """

    normal: Vector
    offset_m: Any
    reflects: Any
    transmits: Any
    material: Any
    plane: Any


@dataclass
class Chains:
    """Chains of q paths from transmitters to one receiver.

    Attributes:
        source_m: transmitter of each path, world, three arrays [q].
        heading: cosine and sine of its yaw, [q].
        exists: 1, or 0 for a place holder, [q].
        levels: from the transmitter on.
    """

    source_m: Vector
    heading: Complex
    exists: Any
    levels: list[Level]

    def select(self, index: Any) -> Chains:
        """The paths ``index``, an integer array."""
        return dr.gather(Chains, self, index)


@dataclass
class Tables:
    """The materials, arrays [n]: relative permittivity, conductivity (S/m), thickness (m), see `SlabMaterials`."""

    permittivity: Any
    conductivity: Any
    thickness_m: Any
    reflected: Any


@dataclass
class EvaluatedPaths:
    """Geometry and gain of q paths.

    Attributes:
        gain: lambda / (4 pi length) times interactions and antennas' fields (re, im), [q]; without the travelling
            phase.
        length_m: unfolded, [q].
        departure: unit vector leaving the transmitter, in its own frame (turned by its heading), [q] each.
        arrival: unit vector from the receiver to where the wave comes from, in the receiver's frame, [q] each.
    """

    gain: Complex
    length_m: Any
    departure: Vector
    arrival: Vector


def evaluate_paths(
    chains: Chains,
    pose: Pose,
    tables: Tables,
    frequency_hz: float,
    rx_antenna: Antenna = ANTENNA,
    tx_antenna: Antenna = ANTENNA,
) -> EvaluatedPaths:
    """Follow chains to a receiver. Differentiable in pose, sources, planes and materials.

    Args:
        chains: q paths.
        pose: of the receiver.
        tables: of the materials.
        frequency_hz: of the carrier.
        rx_antenna: antenna of the receiver.
        tx_antenna: antenna of the transmitters.

    Source: image method and polarised reflection, Balanis, "Advanced Engineering Electromagnetics" (2012), sections 7.4
    and 5.3; slabs as `wrf_mi.tracing.slab`.
    """
    image = list(chains.source_m)
    for level in chains.levels:
        height = dr.select(level.reflects, _dot(image, level.normal) - level.offset_m, 0)
        image = [x - 2 * height * n for x, n in zip(image, level.normal, strict=True)]
    towards = [x - p for x, p in zip(image, pose.position, strict=True)]
    length = dr.sqrt(_dot(towards, towards))
    arrival = [x / length for x in towards]

    directions = [[-x for x in arrival]]
    for level in reversed(chains.levels):
        back = dr.select(level.reflects, _dot(directions[0], level.normal), 0)
        directions.insert(0, [k - 2 * back * n for k, n in zip(directions[0], level.normal, strict=True)])

    float_type = type(length)
    zero, one = float_type(0), float_type(1)
    cosine, sine = chains.heading
    x, y, z = directions[0]
    departure = [cosine * x + sine * y, cosine * y - sine * x, z]
    sent = [[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, one]]
    real = antenna_field(tx_antenna, directions[0], sent)
    imaginary = [dr.zeros(float_type, dr.width(length)) for _ in range(3)]
    for level, before, after in zip(chains.levels, directions[:-1], directions[1:], strict=True):
        real, imaginary = _interact(level, before, after, (real, imaginary), tables, frequency_hz)

    world = [[one, zero, zero], [zero, one, zero], [zero, zero, one]]
    # Columns of the array's rotation in the order of an antenna's axes: boresight z, then x, then y.
    turned = [[row[k] for row in pose.to_world] for k in (2, 0, 1)]
    taken = antenna_field(rx_antenna, arrival, world if rx_antenna.frame == "world" else turned)
    loss = chains.exists * (speed_of_light / frequency_hz / (4 * np.pi)) / length
    return EvaluatedPaths(
        (_dot(taken, real) * loss, _dot(taken, imaginary) * loss), length, departure, pose.to_local(arrival)
    )


def _interact(
    level: Level, before: Vector, after: Vector, field: tuple[Vector, Vector], tables: Tables, frequency_hz: float
) -> tuple[Vector, Vector]:
    """The field (re, im) after a reflection, a transmission, or nothing."""
    met = level.reflects | level.transmits

    def of(table: Any) -> Any:
        return dr.gather(type(table), table, level.material)

    # At a place holder the wave comes straight: no denominator vanishes in what is not used.
    cosine = dr.select(met, dr.abs(_dot(before, level.normal)), 1)
    c = slab(cosine, of(tables.permittivity), of(tables.conductivity), of(tables.thickness_m), frequency_hz)
    share = of(tables.reflected)
    te = dr.select(level.reflects, c.reflected_te * share, c.transmitted_te)
    tm = dr.select(level.reflects, c.reflected_tm * share, c.transmitted_tm)
    across = _unit_or(_cross(before, level.normal), _any_across(before))
    along_before, along_after = _cross(across, before), _cross(across, after)
    parts = []
    for part in field:
        parts.append((_dot(part, across), _dot(part, along_before)))
    (s_re, p_re), (s_im, p_im) = parts
    s = te.real * s_re - te.imag * s_im, te.real * s_im + te.imag * s_re
    p = tm.real * p_re - tm.imag * p_im, tm.real * p_im + tm.imag * p_re
    out = []
    for old, s_part, p_part in zip(field, s, p, strict=True):
        new = [s_part * a + p_part * b for a, b in zip(across, along_after, strict=True)]
        out.append([dr.select(met, n, o) for n, o in zip(new, old, strict=True)])
    return out[0], out[1]


def antenna_field(antenna: Antenna, direction: Vector, axes: list[Vector]) -> Vector:
    """Real field vectors of an antenna in some directions, with derivatives: `wrf_mi.core.Antenna.field`.

    Args:
        antenna: pattern and polarisation.
        direction: unit vectors, three arrays [q] of any float type, world frame.
        axes: the antenna's x, y and z axis in the world's frame.

    Returns:
        Three arrays [q], world frame.
    """
    x, y, z = (_dot(direction, axis) for axis in axes)
    square = x * x + y * y
    pole: Any = square < POLE
    inverse = dr.rsqrt(dr.select(pole, 1, square))
    cosine, sine = dr.select(pole, 1, x * inverse), dr.select(pole, 0, y * inverse)
    level = square * inverse
    if antenna.polarization == "V":
        own = [z * cosine, z * sine, -level]
    else:
        own = [-sine, cosine, dr.zeros(type(z), dr.width(z))]
    own = [_amplitude(antenna.pattern, level, z, (cosine, sine), pole, inverse) * component for component in own]
    return [sum(component * axis[k] for component, axis in zip(own, axes, strict=True)) for k in range(3)]


def _amplitude(pattern: str, level: Any, z: Any, azimuth: Complex, pole: Any, inverse: Any) -> Any:
    """Amplitude of a pattern; ``level`` and ``z``: sine and cosine of the zenith angle, ``inverse``: 1 / level."""
    if pattern == "iso":
        return type(z)(1)
    if pattern == "dipole":
        return math.sqrt(1.5) * level
    if pattern == "hw_dipole":
        return dr.select(pole, 0, math.sqrt(1.643) * dr.cos(np.pi / 2 * z) * inverse)
    width = math.radians(65)
    vertical = dr.minimum(12 * dr.square((dr.atan2(level, z) - np.pi / 2) / width), 30)
    level_db = dr.minimum(12 * dr.square(dr.atan2(azimuth[1], azimuth[0]) / width), 30)
    return dr.exp(math.log(10) / 20 * (8 - dr.minimum(vertical + level_db, 30)))


def _any_across(direction: Vector) -> Vector:
    """A vector across a direction: x, or y where the direction is near x, less what lies along it (as Sionna RT)."""
    one: Any = type(direction[0])(1)
    steep = dr.abs(direction[0]) >= 0.9 * one
    reference = [dr.select(steep, 0, one), dr.select(steep, one, 0), 0]
    along = _dot(direction, reference)
    rest = [r - along * k for r, k in zip(reference, direction, strict=True)]
    scale = dr.rsqrt(_dot(rest, rest))
    return [scale * r for r in rest]


def _unit_or(vector: Vector, other: Vector) -> Vector:
    """The vector normalised, or another one where it vanishes."""
    square = _dot(vector, vector)
    usable: Any = square > ALONG
    scale = dr.rsqrt(dr.select(usable, square, 1))
    return [dr.select(usable, v * scale, o) for v, o in zip(vector, other, strict=True)]


def _dot(a: Vector, b: Vector) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
