"""Sionna RT's path solver on plain arrays: its random search, its image method, its field calculator.

Sionna RT's path solver has three stages: a search for candidates, the image method that makes exact paths of them, and
the field calculator. This module alone sets attributes of ``PathsBuffer`` that have no setter; the version is pinned.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ...core import Antenna
from ...core.angles import FloatArray
from ...core.antenna import MountedAntenna
from ..options import TraceOptions
from ..search.chains import SPECULAR, TRANSMISSION, PathInteractions, join
from ..search.images import image_sources
from ..search.surfaces import Surfaces
from .diffraction import diffraction_matrix

SLOTS_PER_CHUNK = 1 << 22
"""Rays x targets x interactions of one search. Sionna RT takes 8 bytes for each to find duplicates, and some 70 bytes
for an entry of the buffer, which has room for all so that no path is dropped: about 1 GB at a depth of 3."""
WEDGE = ("o", "e_hat", "length", "n0", "nn", "prim0", "primn", "local_edge")  # fields of ``WedgeGeometry``
PATHS_PER_CHUNK = 1 << 19  # paths in a chunk; the field calculator takes some 300 bytes per path and interaction
AT_ANTENNA_M = 1e-9  # distance within which an interaction is at the antenna or its image and tells no direction
TINY_M = 1e-30  # in place of a length of zero in a denominator
SHORT = 1e-4
"""Distance to which coinciding points are moved apart, as a share of `Surfaces.scale_m`: single precision gives the
direction from one to the other to 1e-3 rad."""


@dataclass(frozen=True)
class Devices:
    """Sources or targets of a trace, for Sionna RT's field calculator."""

    position_m: FloatArray  # positions [n, 3], metres
    antennas: tuple[MountedAntenna, ...]  # an antenna for each, or a common one

    @property
    def angles(self) -> FloatArray:
        """Sionna RT's orientation of each device [n, 3] (alpha, beta, gamma; rad)."""
        angles = sionna_orientation([antenna.to_world for antenna in self.antennas])
        return np.broadcast_to(angles, (len(self.position_m), 3))


Ends = tuple[Devices, Devices]  # sources and targets of a search, or transmitters and receivers


def sionna_orientation(to_world: ArrayLike) -> FloatArray:
    """Orientations (alpha, beta, gamma; rad) of devices in Sionna RT [..., 3].

    Of rotations [..., 3, 3] from the device's frame, boresight +x, to the world's (`wrf_mi.core.Antenna.to_world`).
    """
    with warnings.catch_warnings():
        # A device that looks straight up or down has many equivalent angles.
        warnings.filterwarnings("ignore", "Gimbal lock")
        return np.asarray(Rotation.from_matrix(to_world).as_euler("ZYX"))


def to_buffer(legs: PathInteractions, surfaces: Surfaces) -> Any:
    """A ``PathsBuffer`` of these paths."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.paths_buffer import PathsBuffer

    from ...backend.device import columns_on_device, on_device, to_vectors

    # Objects and triangles by Mitsuba's numbers; all bits set is Sionna RT's number for none.
    count, depth = legs.face.shape
    buffer: Any = PathsBuffer(count, depth, bool(legs.wedge))
    used = legs.interactions != 0
    # Sionna RT takes the normal from the corners of the triangle: that of the largest one is exact.
    face = np.where(used, np.append(surfaces.flattest, 0)[legs.face], 0)
    object_index = surfaces.object_of(face)
    shape, primitive = np.full(face.shape, 0xFFFFFFFF, np.uint32), np.full(face.shape, 0xFFFFFFFF, np.uint32)
    shape[used] = surfaces.shape_ids[object_index[used]]
    primitive[used] = (face - surfaces.first_face[object_index])[used]
    buffer._valid = dr.opaque(mi.Bool, True, count)
    buffer._src_indices, buffer._tgt_indices = columns_on_device((legs.source, legs.target), mi.UInt32)
    integers: Any = mi.TensorXu
    numbers = columns_on_device((legs.interactions, shape, primitive), mi.UInt32)
    buffer._interaction_types, buffer._shapes, buffer._primitives = (integers(values, face.shape) for values in numbers)
    # Points in single precision: the phase exp(-j k length) is that of lengths in float64, see `path_gains`.
    vertices = np.nan_to_num(legs.vertices_m, nan=0.0).astype(np.float32)
    for level in range(1, depth):  # beyond the last interaction Sionna RT reads the last point, and adds its distance
        vertices[:, level] = np.where(used[:, level, None], vertices[:, level], vertices[:, level - 1])
    values = columns_on_device((legs.probability, *np.moveaxis(vertices, -1, 0)), mi.Float)
    for name, column in zip(("_probs", "_vertices_x", "_vertices_y", "_vertices_z"), values, strict=True):
        setattr(buffer, name, mi.TensorXf(column, face.shape))
    if legs.wedge:
        for name in WEDGE:
            kind: Any = type(getattr(buffer._diffracting_wedges, name))
            convert = to_vectors if dr.depth_v(kind) > 1 else on_device
            setattr(buffer._diffracting_wedges, name, convert(legs.wedge[name], kind))
    buffer._paths_counter = mi.UInt32(count)
    return buffer


def from_buffer(buffer: Any, surfaces: Surfaces) -> PathInteractions:
    """The valid paths in a buffer."""
    import drjit as dr

    buffer.schedule()
    dr.eval()
    valid = np.flatnonzero(buffer.valid.numpy())
    types = buffer.interaction_types.numpy()[valid].astype(np.uint8)
    used = types != 0
    shape, primitive = (tensor.numpy()[valid].astype(np.int64) for tensor in (buffer.shapes, buffer.primitives))
    face = np.full(shape.shape, -1, np.int64)
    face[used] = surfaces.first_by_shape[shape[used]] + primitive[used]
    vertices = np.stack([getattr(buffer, f"vertices_{axis}").numpy()[valid] for axis in "xyz"], axis=-1).astype(float)
    vertices[~used] = np.nan
    wedges = buffer.diffracting_wedges
    wedge = {} if wedges is None else {name: getattr(wedges, name).numpy().T[valid] for name in WEDGE}
    source, target = (index.numpy()[valid].astype(np.int64) for index in (buffer.source_indices, buffer.target_indices))
    return PathInteractions(source, target, types, face, vertices, buffer.probs.numpy()[valid], wedge)


def sampled_paths(
    scene: Any, surfaces: Surfaces, source_m: FloatArray, targets_m: FloatArray, options: TraceOptions, rays: int
) -> PathInteractions:
    """Paths from a source [3] to targets [n, 3], metres, that scatter or diffract; vertices in single precision."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.image_method import ImageMethod
    from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

    from ...backend.device import to_vectors

    # Stage 1: rays find candidates; the buffer has room for a path of every ray and interaction to each target.
    step = max(1, SLOTS_PER_CHUNK // (rays * options.depth))
    parts = []
    for start in range(0, len(targets_m), step):
        batch = targets_m[start : start + step]
        ends = to_vectors(source_m[None], mi.Point3f), to_vectors(batch, mi.Point3f)
        dr.make_opaque(*ends)
        buffer = SBDeterministicCandidateGenerator()(
            mi_scene=scene.mi_scene,
            src_positions=ends[0],
            tgt_positions=ends[1],
            samples_per_src=rays,
            max_num_paths_per_src=rays * options.depth * len(batch),
            max_depth=options.depth,
            los=False,
            specular_reflection=options.reflection,
            diffuse_reflection=options.scattering,
            refraction=options.transmission,
            diffraction=options.diffraction,
            edge_diffraction=options.diffraction,
            seed=options.seed,
        )
        buffer.schedule()
        dr.eval()
        buffer.shrink()
        # Stage 2: the image method moves specular points, and tests visibility.
        buffer = ImageMethod()(
            scene=scene.mi_scene,
            paths=buffer,
            diffraction=buffer.diffracting_wedges is not None,
            diffraction_lit_region=True,
            src_positions=ends[0],
            tgt_positions=ends[1],
        )
        legs = from_buffer(buffer, surfaces)
        # Specular paths are those of `images`: Sionna RT's search finds them by chance, in single precision.
        specular = np.isin(legs.interactions, (0, SPECULAR, TRANSMISSION)).all(axis=1)
        legs = legs.select(np.flatnonzero(~specular))
        parts.append(replace(legs, target=legs.target + start))
    return join(parts)


def field_of(
    scene: Any, buffer: Any, ends: Ends, rays: int, loop_mode: Literal["symbolic", "evaluated"] = "symbolic"
) -> tuple[Any, Any]:
    """Complex gains [p] of paths as Dr.Jit arrays, without the phase exp(-j k length).

    The buffer of `to_buffer` may be used again; diffuse reflections depend on the number of rays shot per source. Loops
    are faster in Dr.Jit's symbolic mode, and differentiable in materials in the evaluated one.
    """
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.field_calculator import FieldCalculator

    from ...backend.device import to_vectors

    if buffer.buffer_size == 0:
        return mi.Float(), mi.Float()
    # Stage 3: fields along each path, from the source's antenna to the target's.
    calculator = FieldCalculator()
    calculator.loop_mode = loop_mode
    # The calculator marks paths of gain zero as invalid; all are evaluated again in the next call.
    buffer.valid = dr.full(mi.Bool, True, buffer.buffer_size)
    points = (values for end in ends for values in (end.position_m, end.angles))
    source_m, source_angles, target_m, target_angles = (to_vectors(rows, mi.Point3f) for rows in points)
    with corrected():
        evaluated = calculator(
            wavelength=scene.wavelength,
            paths=buffer,
            samples_per_src=rays,
            diffraction=buffer.diffracting_wedges is not None,
            src_positions=source_m,
            tgt_positions=target_m,
            src_orientations=source_angles,
            tgt_orientations=target_angles,
            src_antenna_patterns=[_pattern(ends[0], buffer.source_indices)],
            tgt_antenna_patterns=[_pattern(ends[1], buffer.target_indices, receives=True)],
        )
    gain = evaluated.a[0][0]
    return gain.real, gain.imag


_AS_SIONNA = ContextVar("diffracted fields of Sionna RT", default=False)
_CORRECTED = ContextVar("corrected fields", default=False)


@contextmanager
def _set(variable: ContextVar[bool]) -> Iterator[None]:
    token = variable.set(True)
    try:
        yield
    finally:
        variable.reset(token)


def sionna_diffraction() -> AbstractContextManager[None]:
    """Diffracted fields of Sionna RT 2.2 while the block lasts: data that were made with them stay as they are."""
    return _set(_AS_SIONNA)


def corrected() -> AbstractContextManager[None]:
    """Correct Sionna RT's fields while the block lasts: diffraction, and coefficients of slabs.

    In this thread alone: other threads may trace at the same time, and use Sionna RT as it is.
    """
    _correctable()
    return _set(_CORRECTED)


@cache
def _correctable() -> None:
    """Replace functions of Sionna RT, once, by functions that are corrected within `corrected`."""
    from sionna.rt.radio_materials import radio_material

    # They are never restored: a thread that does so takes the correction from another one that is in its block. Two
    # threads that come first at the same time replace them twice, to the same effect.
    module: Any = radio_material
    material: Any = module.RadioMaterial
    stated_slab, stated_matrix = module.itu_coefficients_single_layer_slab, material._diffraction_matrix

    def slab(*arguments: Any, **named: Any) -> Any:
        return (_slab if _CORRECTED.get() else stated_slab)(*arguments, **named)

    def matrix(*arguments: Any) -> Any:
        ours = _CORRECTED.get() and not _AS_SIONNA.get()
        return (diffraction_matrix if ours else stated_matrix)(*arguments)

    module.itu_coefficients_single_layer_slab, material._diffraction_matrix = slab, matrix


def _slab(cosine: Any, eta: Any, thickness_m: Any, wavelength_m: Any) -> tuple[Any, Any, Any, Any]:
    """Coefficients of a slab, with the arguments of Sionna RT's ``itu_coefficients_single_layer_slab``."""
    import drjit as dr

    from ..slabs import slab_coefficients

    c = slab_coefficients(cosine, eta, thickness_m * (dr.two_pi / wavelength_m))
    return c.reflected_te, c.reflected_tm, c.transmitted_te, c.transmitted_tm


def _pattern(devices: Devices, index: Any, receives: bool = False) -> Any:
    """Sionna RT's antenna pattern of the devices ``index`` of p paths, as a function of zenith and azimuth angle."""
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import to_uint

    antennas = [mounted.antenna for mounted in devices.antennas]
    distinct = list(dict.fromkeys(antennas))
    functions = [sionna_pattern(antenna, receives) for antenna in distinct]
    if len(distinct) == 1:
        return functions[0]
    # The field calculator takes one pattern for all paths: this one evaluates each and selects by the path's antenna.
    kind = dr.gather(mi.UInt32, to_uint(np.array([distinct.index(antenna) for antenna in antennas])), index)

    def mixed(theta: Any, phi: Any) -> tuple[Any, Any]:
        first, second = functions[0](theta, phi)
        for number, function in enumerate(functions[1:], start=1):
            other = function(theta, phi)
            first, second = dr.select(kind == number, other[0], first), dr.select(kind == number, other[1], second)
        return first, second

    return mixed


def sionna_pattern(antenna: Antenna, receives: bool = False) -> Any:
    """Sionna RT's antenna pattern: function of zenith and azimuth angle to the field's complex components of both.

    Sionna RT multiplies by the conjugate of the receiver's pattern, so that reciprocity asks for the conjugate of a
    measured phase where the antenna ``receives``.
    """
    from sionna.rt.antenna_pattern import PolarizedAntennaPattern, antenna_pattern_registry

    measured = antenna.measured
    if measured is None:
        factory: Any = antenna_pattern_registry.get(antenna.pattern)
        return factory(polarization=antenna.polarization).patterns[0]
    import drjit as dr
    import mitsuba as mi

    from ...backend.device import columns_on_device

    tables = columns_on_device(measured.flat, mi.Float)
    complex_type: Any = mi.Complex2f
    sign = -1 if receives else 1

    def vertical(theta: Any, phi: Any) -> Any:
        real, *imaginary = measured.amplitude(dr, theta, phi, tables)
        return complex_type(real, sign * imaginary[0] if imaginary else 0)

    how: dict[str, Any] = {"polarization": antenna.polarization, "polarization_model": "tr38901_2"}
    return PolarizedAntennaPattern(v_pattern=vertical, **how).patterns[0]


def path_gains(scene: Any, surfaces: Surfaces, legs: PathInteractions, ends: Ends, rays: int) -> NDArray[np.complex128]:
    """Complex gains [p] of paths, without the phase exp(-j k length); NaN where single precision has none."""
    import drjit as dr

    gain, legs = np.zeros(len(legs), np.complex128), apart(legs, surfaces, ends)
    for start in range(0, len(legs), PATHS_PER_CHUNK):
        part = slice(start, start + PATHS_PER_CHUNK)
        buffer = to_buffer(legs.select(part), surfaces)
        real, imaginary = field_of(scene, buffer, ends, rays)
        dr.eval(real, imaginary)  # in one kernel, not in one for each part
        gain[part] = real.numpy() + 1j * imaginary.numpy()
    return gain


def apart(legs: PathInteractions, surfaces: Surfaces, ends: Ends) -> PathInteractions:
    """PathInteractions whose points of specular paths lie `SHORT` apart at least, so that each leg has a direction."""
    # Sionna RT takes directions from points, which coincide where a path is reflected in an edge.
    count = np.count_nonzero(legs.interactions, axis=1)
    points = np.concatenate([ends[0].position_m[legs.source, None], legs.vertices_m], axis=1)
    points = np.pad(points, ((0, 0), (0, 1), (0, 0)))
    points[np.arange(len(legs)), count + 1] = ends[1].position_m[legs.target]
    used = np.arange(points.shape[1] - 1) <= count[:, None]
    way = np.diff(points, axis=1)
    length = np.linalg.norm(way, axis=2)
    short = used & (length < SHORT * surfaces.scale_m)
    specular = np.isin(legs.interactions, (0, SPECULAR, TRANSMISSION)).all(axis=1)
    row = np.flatnonzero(short.any(axis=1) & specular & (count > 0))
    if not len(row):
        return legs
    reflects = legs.interactions[row] == SPECULAR
    plane = np.where(reflects, surfaces.plane[legs.face[row]], -1)
    # The true direction of a leg is that from the source's image to the leg's end.
    image = image_sources(surfaces.normal, surfaces.offset, plane, points[row, 0])
    direction = points[row, 1:] - image
    size = np.linalg.norm(direction, axis=2, keepdims=True)
    direction /= np.maximum(size, TINY_M)
    # An antenna within a sheet that its path passes is at its first point: that leg takes the next one's direction.
    for leg in reversed(range(direction.shape[1] - 1)):
        at_image = size[:, leg] < AT_ANTENNA_M
        direction[:, leg] = np.where(at_image, direction[:, leg + 1], direction[:, leg])
    # Each short leg becomes longer, and the longest one shorter: the points before it move forwards from the source,
    # which stays, those after it backwards from the target, and all other legs keep their directions.
    longest = np.arange(len(row)), np.where(used[row], length[row], -1).argmax(axis=1)
    change = np.where(short[row, :, None], SHORT * surfaces.scale_m * direction - way[row], 0)
    change[longest] = 0
    # By half of the longest leg at most, which keeps its direction then where both antennas are as near.
    largest = np.maximum(np.linalg.norm(change, axis=2).sum(axis=1), TINY_M)
    change *= np.minimum(1, length[row][longest] / 2 / largest)[:, None, None]
    moved = np.pad(np.cumsum(change, axis=1), ((0, 0), (1, 0), (0, 0)))
    after = np.arange(moved.shape[1]) > longest[1][:, None]
    moved -= after[..., None] * moved[:, -1:]
    vertices = legs.vertices_m.copy()
    vertices[row] += moved[:, 1:-1]
    return replace(legs, vertices_m=vertices)
