"""Differentiable field calculator: unfolded length, directions and polarised gain along known chains of surfaces.

The image method and the field along each path as in Sionna RT, for paths that it found, in any float type. The
transmitter's image after all reflections gives the length and the direction of arrival; backwards through the chain,
each direction before a reflection is the mirror image of the one after it. No interaction points are needed, hence no
division by the distance to a wall.

Vectors are lists of three Dr.Jit arrays, complex numbers pairs (re, im).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...backend.device import columns_on_device
from ...backend.vectors import Complex, Float64, Pose, Vector, cross, dot, tangent_basis, times
from ...core import Antenna
from ...core.antenna import ANTENNA
from ...core.types import FloatArray, IntArray
from ..search.chains import SPECULAR, TRANSMISSION
from ..search.images import COINCIDENT_M
from ..search.surfaces import Surfaces
from ..slabs import slab

ALONG = 1e-12  # squared sine below which a direction is along a normal, and the plane of incidence is arbitrary

Tables = tuple[Any, Any, Any, Any]  # permittivity, conductivity, thickness and reflected share [n] of materials


@dataclass
class Level:
    """Interactions of q paths at the same depth; place holders where a path has fewer."""

    normal: Vector  # unit normals of the planes, either sign, world; zeros for place holders; three float arrays [q]
    offset_m: Any  # offsets n . x of the planes, metres; float [q]
    reflects: Any  # mask of reflections
    transmits: Any  # mask of transmissions
    material: Any  # indices into `Tables`; unsigned integer [q]
    plane: Any  # indices into the scene's planes; unsigned integer [q]


@dataclass
class Chains:
    """Chains of q paths from transmitters to one receiver."""

    source_m: Vector  # transmitter positions, world frame, metres; three float arrays [q]
    heading: Complex  # cosine and sine of the transmitters' yaw; two float arrays [q]
    exists: Any  # 1 for a path, 0 for a place holder; float [q]
    levels: list[Level]  # interactions in the order from the transmitter; [depth]

    def select(self, index: Any) -> Chains:
        """Select the paths of an unsigned integer array of indices."""
        return dr.gather(Chains, self, index)

    def met(self, depth: int) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
        """Planes and materials that the p existing paths meet [p, depth], -1 for none, and whether these reflect."""
        exists = np.flatnonzero(self.exists.numpy() > 0)
        plane, material = np.full((2, len(exists), depth), -1)
        reflects = np.zeros((len(exists), depth), bool)
        for k, level in enumerate(self.levels):
            reflects[:, k] = np.asarray(level.reflects)[exists]
            is_met = reflects[:, k] | np.asarray(level.transmits)[exists]
            for column, numbers in ((plane, level.plane), (material, level.material)):
                column[is_met, k] = np.asarray(numbers)[exists[is_met]]
        return plane, material, reflects


PatternTables = list[Any] | None  # coefficients of a measured pattern on the device; None: a pattern of Sionna RT
EvaluatedPaths = tuple[Complex, Any, Vector, Vector]  # gain, length, departure, arrival, see `evaluate_paths`


def evaluate_paths(
    chains: Chains,
    pose: Pose,
    tables: Tables,
    frequency_hz: float,
    rx_antenna: Antenna = ANTENNA,
    tx_antenna: Antenna = ANTENNA,
    patterns: tuple[PatternTables, PatternTables] = (None, None),
) -> EvaluatedPaths:
    """Evaluate q paths to a receiver. Differentiable in pose (numbers or arrays [q]), sources, planes and materials.

    ``patterns``: `pattern_tables` of the receiver's and the transmitter's antenna.

    Returns:
        Gain lambda / (4 pi length) times interactions and antennas' fields, without the phase exp(-j k length);
        unfolded length, metres; unit vectors leaving the transmitter, in its frame (rotated by its heading), and from
        the receiver towards the incoming wave, in the receiver's frame.

    Source: image method and polarised reflection, Balanis, "Advanced Engineering Electromagnetics" (2012), sections 7.4
    and 5.3; slabs as `slab`.
    """
    # Image method: the transmitter mirrored in all planes, in order, sends a straight wave to the receiver.
    image = list(chains.source_m)  # three arrays [q]
    for level in chains.levels:
        image = _mirrored(image, level, level.offset_m)
    way = [x - p for x, p in zip(image, pose.position, strict=True)]
    # Place holders of a transmitter at the receiver have a length of zero, hence no direction: any other serves, as
    # their gain is multiplied by zero.
    nowhere = dot(way, way) < COINCIDENT_M**2
    towards = [dr.select(nowhere, along, part) for part, along in zip(way, (1, 0, 0), strict=True)]
    length = dr.sqrt(dot(towards, towards))
    arrival = [x / length for x in towards]

    # Directions of travel, backwards: before a reflection that of after it, mirrored.
    directions = [[-x for x in arrival]]  # of travel, from the transmitter on: [depth + 1] vectors
    for level in reversed(chains.levels):
        directions.insert(0, _mirrored(directions[0], level, 0))

    float_type = type(length)
    zero, unit = float_type(0), float_type(1)
    # What the transmitter's antenna sends, in its frame that is turned by the heading about z.
    cosine, sine = chains.heading
    x, y, z = directions[0]
    departure = [cosine * x + sine * y, cosine * y - sine * x, z]
    sent = [[cosine, sine, zero], [-sine, cosine, zero], [zero, zero, unit]]
    real, *of_phase = antenna_field(tx_antenna, directions[0], sent, patterns[1])
    imaginary = of_phase[0] if of_phase else [dr.zeros(float_type, dr.width(length)) for _ in range(3)]
    # The field after each interaction, as real and imaginary vectors.
    for level, before, after in zip(chains.levels, directions[:-1], directions[1:], strict=True):
        real, imaginary = _interact(level, before, after, (real, imaginary), tables, frequency_hz)

    # What the receiver's antenna takes of it: the scalar product with its field vector, by reciprocity, hence without
    # conjugate.
    world = [[unit, zero, zero], [zero, unit, zero], [zero, zero, unit]]
    # Columns of the array's rotation in the order of an antenna's axes: boresight z, then x, then y.
    x, y, z = map(list, zip(*pose.to_world, strict=True))
    axes = world if rx_antenna.frame == "world" else [z, x, y]
    received, *of_phase = antenna_field(rx_antenna, arrival, axes, patterns[0])
    re, im = dot(received, real), dot(received, imaginary)
    if of_phase:
        re, im = re - dot(of_phase[0], imaginary), im + dot(of_phase[0], real)
    loss = chains.exists * (speed_of_light / frequency_hz / (4 * np.pi)) / length  # Friis
    return (re * loss, im * loss), length, departure, pose.to_local(arrival)


def _mirrored(vector: Vector, level: Level, offset_m: Any) -> Vector:
    """Points mirrored in the planes of a level's reflections, or directions with an offset of 0; others as they are."""
    height = dr.select(level.reflects, dot(vector, level.normal) - offset_m, 0)
    return [x - 2 * height * n for x, n in zip(vector, level.normal, strict=True)]


def _interact(
    level: Level, before: Vector, after: Vector, field: tuple[Vector, Vector], tables: Tables, frequency_hz: float
) -> tuple[Vector, Vector]:
    """Field (re, im), three arrays [q] each, after a reflection, a transmission, or a place holder."""
    met = level.reflects | level.transmits
    permittivity, conductivity, thickness_m, share = (dr.gather(type(t), t, level.material) for t in tables)
    # At place holders the wave comes straight, so that no unused denominator vanishes.
    cosine = dr.select(met, dr.abs(dot(before, level.normal)), 1)
    c = slab(cosine, permittivity, conductivity, thickness_m, frequency_hz)
    te = dr.select(level.reflects, c.reflected_te * share, c.transmitted_te)
    tm = dr.select(level.reflects, c.reflected_tm * share, c.transmitted_tm)
    # The TE component is along the normal of the plane of incidence, before and after; the TM component turns.
    across = cross(before, level.normal)
    square = dot(across, across)
    oblique: Any = square > ALONG
    scale = dr.rsqrt(dr.select(oblique, square, 1))
    across = [dr.select(oblique, c * scale, a) for c, a in zip(across, tangent_basis(before)[0], strict=True)]
    along_before, along_after = cross(across, before), cross(across, after)
    (s_re, p_re), (s_im, p_im) = ((dot(part, across), dot(part, along_before)) for part in field)
    s, p = times((te.real, te.imag), (s_re, s_im)), times((tm.real, tm.imag), (p_re, p_im))
    out = []
    for old, s_part, p_part in zip(field, s, p, strict=True):
        new = [s_part * a + p_part * b for a, b in zip(across, along_after, strict=True)]
        out.append([dr.select(met, n, o) for n, o in zip(new, old, strict=True)])
    return out[0], out[1]


def pattern_tables(antenna: Antenna, float_type: Any) -> PatternTables:
    """Coefficients of a measured pattern on the device, inputs of recorded functions; None: a pattern of Sionna RT."""
    return None if antenna.measured is None else columns_on_device(antenna.measured.flat, float_type)


def antenna_field(antenna: Antenna, direction: Vector, axes: list[Vector], tables: PatternTables) -> list[Vector]:
    """Field vectors of `wrf_mi.core.Antenna.components`, three arrays [q] in the arguments' frame, differentiable."""
    x, y, z = (dot(direction, axis) for axis in axes)
    parts = antenna.components(dr, x, y, z, tables)
    return [[sum(c * axis[k] for c, axis in zip(part, axes, strict=True)) for k in range(3)] for part in parts]


def chains_of(
    surfaces: Surfaces, types: NDArray[np.uint8], face: IntArray, material: IntArray, sources: Sequence[FloatArray]
) -> Chains:
    """Chains of p paths with interactions ``types`` at faces, of materials by their indices, all [p, depth].

    ``sources``: five columns [p], coordinates of each path's transmitter, cosine and sine of its heading.
    """
    depth = types.shape[1] if types.any() else 0
    types, face = types[:, :depth], face[:, :depth]
    plane, used, index = np.append(surfaces.plane, 0)[face], types != 0, material[:, :depth].astype(np.uint32)
    # All columns of a type by one copy: each copy is a kernel of its own.
    normal, offset = surfaces.normal[plane] * used[..., None], surfaces.offset[plane] * used
    columns = [column for k in range(depth) for column in (*normal[:, k].T, offset[:, k])]
    numbers = columns_on_device([*columns, *sources, np.ones(len(types))], Float64)
    kinds = [types[:, k] == kind for k in range(depth) for kind in (SPECULAR, TRANSMISSION)]
    masks = columns_on_device(kinds, mi.Bool)
    indices = columns_on_device([table[:, k] for k in range(depth) for table in (index, plane)], mi.UInt32)
    levels = [
        Level(numbers[4 * k : 4 * k + 3], numbers[4 * k + 3], *masks[2 * k : 2 * k + 2], *indices[2 * k : 2 * k + 2])
        for k in range(depth)
    ]
    *place, exists = numbers[4 * depth :]
    return Chains(place[:3], tuple(place[3:]), exists, levels)
