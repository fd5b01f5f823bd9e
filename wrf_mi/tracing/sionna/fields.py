"""Gains of known paths by Sionna RT's field calculator, with the present materials of the scene."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...core import InputError
from ...core.angles import FloatArray
from ...core.antenna import MountedAntenna
from ..options import TraceOptions
from ..search.images import image_sources
from ..search.legs import SPECULAR, TRANSMISSION, Legs
from ..search.surfaces import Surfaces
from .buffer import point_array, to_buffer

PATHS_PER_CHUNK = 1 << 19
"""Paths in a chunk; the field calculator takes some 300 bytes per path and interaction."""
AT_ANTENNA_M = 1e-9
"""Distance within which an interaction is at the antenna, or at its image, so that it tells no direction."""
SHORT = 1e-4
"""Distance to which coinciding points are moved apart, as a share of `Surfaces.scale_m`: single precision gives the
direction from one to the other to 1e-3 rad."""


@dataclass(frozen=True)
class Devices:
    """Sources or targets of a trace, for Sionna RT's field calculator.

    Attributes:
        position_m: positions [n, 3], metres.
        antennas: an antenna for each, or a common one.
    """

    position_m: FloatArray
    antennas: tuple[MountedAntenna, ...]

    @property
    def angles(self) -> FloatArray:
        """Sionna RT's orientation of each device [n, 3] (alpha, beta, gamma; rad)."""
        angles = sionna_orientation([antenna.to_world for antenna in self.antennas])
        return np.broadcast_to(angles, (len(self.position_m), 3))


Ends = tuple[Devices, Devices]
"""Sources and targets of a search, or transmitters and receivers."""


def sionna_orientation(to_world: ArrayLike) -> FloatArray:
    """Sionna RT's orientation (alpha, beta, gamma; rad) of a device, or of several [n, 3].

    Args:
        to_world: rotation [3, 3], or rotations [n, 3, 3], from the device's frame, whose boresight is +x, to the
            world's; see `wrf_mi.core.Antenna.to_world`.
    """
    with warnings.catch_warnings():
        # A device that looks straight up or down has many equivalent angles.
        warnings.filterwarnings("ignore", "Gimbal lock")
        return np.asarray(Rotation.from_matrix(to_world).as_euler("ZYX"))


def field_of(
    scene: Any,
    buffer: Any,
    ends: Ends,
    rays: int,
    loop_mode: Literal["symbolic", "evaluated"] = "symbolic",
) -> tuple[Any, Any]:
    """Complex gains [p] of paths as Dr.Jit arrays, without the phase exp(-j k length).

    Args:
        scene: ``sionna.rt.Scene``.
        buffer: p paths from source to target, from `wrf_mi.tracing.sionna.buffer.to_buffer`; may be used again.
        ends: sources and targets.
        rays: number of rays shot per source, for diffuse reflections.
        loop_mode: Dr.Jit's mode of loops; the symbolic one is faster, the evaluated one differentiable in materials.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.field_calculator import FieldCalculator

    if buffer.buffer_size == 0:
        return mi.Float(), mi.Float()
    calculator = FieldCalculator()
    calculator.loop_mode = loop_mode
    buffer.valid = dr.full(mi.Bool, True, buffer.buffer_size)
    done = calculator(
        wavelength=scene.wavelength,
        paths=buffer,
        samples_per_src=rays,
        diffraction=buffer.diffracting_wedges is not None,
        src_positions=point_array(ends[0].position_m),
        tgt_positions=point_array(ends[1].position_m),
        src_orientations=point_array(ends[0].angles),
        tgt_orientations=point_array(ends[1].angles),
        src_antenna_patterns=[_pattern(ends[0], buffer.source_indices)],
        tgt_antenna_patterns=[_pattern(ends[1], buffer.target_indices)],
    )
    gain = done.a[0][0]
    return gain.real, gain.imag


def _pattern(devices: Devices, index: Any) -> Any:
    """Sionna RT's antenna pattern of the devices ``index`` of p paths, as a function of zenith and azimuth angle."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.antenna_pattern import antenna_pattern_registry

    from ...backend.device import to_uint

    antennas = [mounted.antenna for mounted in devices.antennas]
    distinct = list(dict.fromkeys(antennas))
    functions = [antenna_pattern_registry.get(a.pattern)(polarization=a.polarization).patterns[0] for a in distinct]
    if len(distinct) == 1:
        return functions[0]
    kind = dr.gather(mi.UInt32, to_uint(np.array([distinct.index(antenna) for antenna in antennas])), index)

    def mixed(theta: Any, phi: Any) -> tuple[Any, Any]:
        first, second = functions[0](theta, phi)
        for number, function in enumerate(functions[1:], start=1):
            other = function(theta, phi)
            first, second = dr.select(kind == number, other[0], first), dr.select(kind == number, other[1], second)
        return first, second

    return mixed


def path_gains(scene: Any, surfaces: Surfaces, legs: Legs, ends: Ends, rays: int) -> NDArray[np.complex128]:
    """Complex gains [p] of paths, without the phase exp(-j k length), in chunks.

    Raises:
        InputError: a gain that is not a number.
    """
    import drjit as dr

    gain, legs = np.zeros(len(legs), np.complex128), apart(legs, surfaces, ends)
    for start in range(0, len(legs), PATHS_PER_CHUNK):
        part = slice(start, start + PATHS_PER_CHUNK)
        buffer = to_buffer(legs.select(part), surfaces)
        real, imaginary = field_of(scene, buffer, ends, rays)
        dr.eval(real, imaginary)  # in one kernel, not in one for each part
        gain[part] = real.numpy() + 1j * imaginary.numpy()
    if not np.isfinite(gain).all():
        raise InputError("gains that are not numbers: give materials constants that single precision can hold")
    return gain


def apart(legs: Legs, surfaces: Surfaces, ends: Ends) -> Legs:
    """Legs whose points of specular paths lie `SHORT` apart at least, so that each leg has a direction.

    Sionna RT takes directions from points, which coincide where a path is reflected in an edge. Points are moved along
    the true direction, which is that from the source's image to the leg's end.
    """
    count = np.count_nonzero(legs.interactions, axis=1)
    points = np.concatenate([ends[0].position_m[legs.source, None], legs.vertices_m], axis=1)
    points = np.pad(points, ((0, 0), (0, 1), (0, 0)))
    points[np.arange(len(legs)), count + 1] = ends[1].position_m[legs.target]
    used = np.arange(points.shape[1] - 1) <= count[:, None]
    short = used & (np.linalg.norm(np.diff(points, axis=1), axis=2) < SHORT * surfaces.scale_m)
    specular = np.isin(legs.interactions, (0, SPECULAR, TRANSMISSION)).all(axis=1)
    row = np.flatnonzero(short.any(axis=1) & specular & (count > 0))
    if not len(row):
        return legs
    reflects = legs.interactions[row] == SPECULAR
    plane = np.where(reflects, surfaces.plane[legs.face[row]], -1)
    image = image_sources(surfaces.normal, surfaces.offset, plane, points[row, 0])
    direction = points[row, 1:] - image
    size = np.linalg.norm(direction, axis=2, keepdims=True)
    direction /= np.maximum(size, 1e-30)
    for leg in reversed(range(direction.shape[1] - 1)):  # an antenna within a sheet that its path passes
        at_image = size[:, leg] < AT_ANTENNA_M
        direction[:, leg] = np.where(at_image, direction[:, leg + 1], direction[:, leg])
    moved = np.zeros_like(points[row])
    for leg in range(short.shape[1]):  # forwards from a point that stays
        step = (moved[:, leg] + SHORT * surfaces.scale_m * direction[:, leg]) * short[row, leg, None]
        moved[:, leg + 1] = step
    at_target = np.arange(len(row)), count[row] + 1
    overshoot, together = moved[at_target], np.ones(len(row), bool)
    for leg in reversed(range(short.shape[1])):  # the target stays, too: points before it are moved backwards
        together &= short[row, leg] | (leg > count[row])
        moved[:, leg] -= overshoot * (together & (leg > 0) & (leg <= count[row]))[:, None]
    vertices = legs.vertices_m.copy()
    vertices[row] += moved[:, 1:-1]
    return replace(legs, vertices_m=vertices)


@contextmanager
def scattering_materials(scene: Any, options: TraceOptions) -> Iterator[None]:
    """Set the scattering coefficient of all materials while the block lasts, if scattering is on."""
    able = [m for m in scene.radio_materials.values() if options.scattering and hasattr(m, "scattering_coefficient")]
    before = [material.scattering_coefficient for material in able]
    for material in able:
        material.scattering_coefficient = options.scattering_coefficient
    try:
        yield
    finally:
        for material, coefficient in zip(able, before, strict=True):
            material.scattering_coefficient = coefficient
