"""Conversion of plain arrays to and from Sionna RT's ``PathsBuffer``, its image method and its random search.

Sionna RT's path solver has three stages: a search for candidates, the image method that makes exact paths of them, and
the field calculator. This module alone sets attributes of ``PathsBuffer`` that have no setter; the version is pinned.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ...core.angles import FloatArray
from ..options import TraceOptions
from ..search.legs import SPECULAR, TRANSMISSION, Legs, join
from ..search.surfaces import Surfaces

SLOTS_PER_CHUNK = 1 << 22
"""Rays x targets x interactions of one search. Sionna RT takes 8 bytes for each to find duplicates, and some 70 bytes
for an entry of the buffer, which has room for all so that no path is dropped: about 1 GB at a depth of 3."""
WEDGE = ("o", "e_hat", "length", "n0", "nn", "prim0", "primn", "local_edge")
"""Fields of Sionna RT's ``WedgeGeometry`` besides the shape."""


def point_array(points: FloatArray) -> Any:
    """Points [n, 3] as Mitsuba's ``Point3f``."""
    import mitsuba as mi

    from ...backend.device import to_vectors

    return to_vectors(points, mi.Point3f)


def to_buffer(legs: Legs, surfaces: Surfaces) -> Any:
    """A ``PathsBuffer`` of these paths."""
    import drjit as dr
    import mitsuba as mi
    from sionna.rt.path_solvers.paths_buffer import PathsBuffer

    from ...backend.device import columns_on_device, on_device, to_vectors

    count, depth = legs.face.shape
    buffer: Any = PathsBuffer(count, depth, bool(legs.wedge))
    used = legs.interactions != 0
    face = np.where(used, legs.face, 0)
    thing = surfaces.object_of(face)
    shape, primitive = np.full(face.shape, 0xFFFFFFFF, np.uint32), np.full(face.shape, 0xFFFFFFFF, np.uint32)
    shape[used] = surfaces.shape_ids[thing[used]]
    primitive[used] = (face - surfaces.first_face[thing])[used]
    buffer._valid = dr.opaque(mi.Bool, True, count)
    buffer._src_indices, buffer._tgt_indices = columns_on_device((legs.source, legs.target), mi.UInt32)
    integers: Any = mi.TensorXu
    numbers = columns_on_device((legs.interactions, shape, primitive), mi.UInt32)
    buffer._interaction_types, buffer._shapes, buffer._primitives = (integers(values, face.shape) for values in numbers)
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


def from_buffer(buffer: Any, surfaces: Surfaces) -> Legs:
    """The valid paths in a buffer."""
    import drjit as dr

    buffer.schedule()
    dr.eval()
    kept = np.flatnonzero(buffer.valid.numpy())
    types = buffer.interaction_types.numpy()[kept].astype(np.uint8)
    used = types != 0
    shape, primitive = (tensor.numpy()[kept].astype(np.int64) for tensor in (buffer.shapes, buffer.primitives))
    face = np.full(shape.shape, -1, np.int64)
    face[used] = surfaces.first_by_shape[shape[used]] + primitive[used]
    vertices = np.stack([getattr(buffer, f"vertices_{axis}").numpy()[kept] for axis in "xyz"], axis=-1).astype(float)
    vertices[~used] = np.nan
    wedges = buffer.diffracting_wedges
    wedge = {} if wedges is None else {name: getattr(wedges, name).numpy().T[kept] for name in WEDGE}
    source, target = (index.numpy()[kept].astype(np.int64) for index in (buffer.source_indices, buffer.target_indices))
    return Legs(source, target, types, face, vertices, buffer.probs.numpy()[kept], wedge)


def sampled_paths(
    scene: Any, surfaces: Surfaces, source_m: FloatArray, targets_m: FloatArray, options: TraceOptions, rays: int
) -> Legs:
    """Paths with at least one diffuse reflection or diffraction from a source [3] to each target [n, 3], metres.

    Source 0, target 0..n-1; vertices are in single precision.
    """
    import drjit as dr
    from sionna.rt.path_solvers.image_method import ImageMethod
    from sionna.rt.path_solvers.sb_deterministic import SBDeterministicCandidateGenerator

    step = max(1, SLOTS_PER_CHUNK // (rays * options.max_depth))
    parts = []
    for start in range(0, len(targets_m), step):
        batch = targets_m[start : start + step]
        ends = point_array(source_m[None]), point_array(batch)
        dr.make_opaque(*ends)
        buffer = SBDeterministicCandidateGenerator()(
            mi_scene=scene.mi_scene,
            src_positions=ends[0],
            tgt_positions=ends[1],
            samples_per_src=rays,
            max_num_paths_per_src=rays * options.max_depth * len(batch),
            max_depth=options.max_depth,
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
        buffer = ImageMethod()(
            scene=scene.mi_scene,
            paths=buffer,
            diffraction=buffer.diffracting_wedges is not None,
            diffraction_lit_region=True,
            src_positions=ends[0],
            tgt_positions=ends[1],
        )
        found = from_buffer(buffer, surfaces)
        types = found.interactions
        found = found.select(((types != 0) & (types != SPECULAR) & (types != TRANSMISSION)).any(axis=1))
        parts.append(replace(found, target=found.target + start))
    return join(parts, options.max_depth)
