"""Specular paths from sources to many targets: possible chains, tested by rays, made exact in float64.

Planes are n . x = d with unit normals n. `wrf_mi.tracing.paths.field_calculator` has the differentiable image method in
Dr.Jit. Source: Balanis, "Advanced Engineering Electromagnetics" (2012), section 7.4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core.counts import count
from ...core.types import FloatArray, IntArray
from ..options import TraceOptions
from .chains import SPECULAR, PathInteractions, ReflectionChains, join, possible
from .devices import before_surfaces, clear_m
from .surfaces import Surfaces
from .visibility import reflect_on_faces, unobstructed

CANDIDATES_PER_CHUNK = 1 << 20  # candidates in a chunk, which take some 100 bytes for each interaction
PARALLEL = 1e-9  # difference of heights in metres below which a ray runs along a plane and keeps the point that it met
COINCIDENT_M = 1e-6  # distance below which two antennas are at one place, with no path straight from one to the other
DISPLACED = 5e-6
"""Displacement of a pair's first antenna, as a share of `Surfaces.scale_m`: 0.05 mm at 10 m, eighty times the rounding
of a coordinate in single precision."""
FARTHER = (1 + np.sqrt(5)) / 2
"""Displacement of the pair's second antenna by that of the first: irrational, as mirrored displacements of both would
cancel at places of round numbers."""
ASLANT = np.array([1.0, 0.7548776662466927, 0.5698402909980532])
"""Direction of both: powers of the plastic number, so that no plane of a building is parallel to it, nor at a simple
ratio."""


def mirrored(vectors: FloatArray, normal: FloatArray, offset_m: FloatArray | float = 0.0) -> FloatArray:
    """Mirror points [n, 3] in planes of normals [n, 3] or [3] and offsets [n]; directions with an offset of 0."""
    height = (vectors * normal).sum(axis=-1) - offset_m
    return vectors - 2 * height[:, None] * normal


def image_sources(normal: FloatArray, offset_m: FloatArray, plane: IntArray, source_m: FloatArray) -> FloatArray:
    """Images [c, b + 1, 3] of a source [3], or of the source of each chain [c, 3], after 0, 1, ... reflections, metres.

    A chain's planes [c, b] are in their order from the source, -1 for none; normals [q, 3] and offsets [q] are the
    scene's.
    """
    image = np.repeat(np.broadcast_to(source_m, (len(plane), 3))[:, None], plane.shape[1] + 1, axis=1)
    # The image after a reflection is that before it, mirrored in the plane that reflects: Balanis (2012), section 7.4.
    for level in range(plane.shape[1]):
        image[:, level + 1] = image[:, level]
        row = np.flatnonzero(plane[:, level] >= 0)
        mirror = plane[row, level]
        image[row, level + 1] = mirrored(image[row, level], normal[mirror], offset_m[mirror])
    return image


def meeting_point(
    start_m: FloatArray, end_m: FloatArray, normal: FloatArray, offset_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points [n, 3] where lines between points [n, 3] meet planes, and heights [n] of both points above these.

    Planes have unit normals [n, 3] and offsets [n], metres. A line parallel to its plane meets it at the first point.
    """
    near, far = ((point * normal).sum(axis=1) - offset_m for point in (start_m, end_m))
    share = np.divide(near, near - far, out=np.zeros_like(near), where=near != far)
    return start_m + (end_m - start_m) * share[:, None], near, far


def specular_paths(
    surfaces: Surfaces, chains: ReflectionChains, sources_m: FloatArray, targets_m: FloatArray, options: TraceOptions
) -> PathInteractions:
    """Unobstructed paths, exact in float64, from sources [s, 3] to targets [n, 3], metres, by chains from sources."""
    depth = max(options.depth, 1)
    direct = np.arange(len(sources_m) * len(targets_m) if options.line_of_sight else 0)
    source, target = np.divmod(direct, len(targets_m))
    apart = np.linalg.norm(targets_m[target] - sources_m[source], axis=1) > COINCIDENT_M
    # Far from the origin antennas at two places have one in single precision, in which Sionna RT takes the direction.
    apart &= (targets_m.astype(np.float32)[target] != sources_m.astype(np.float32)[source]).any(axis=1)
    # Chains (-1: none), sources and targets to test.
    columns = [(np.full(np.count_nonzero(apart), -1), source[apart], target[apart])]
    columns += [(chain, chains.source[chain], target) for chain, target in possible(surfaces, chains, targets_m)]
    candidates = [np.concatenate(column) for column in zip(*columns, strict=True)]
    pairs = len(direct) + len(chains) * len(targets_m)
    count("candidates of paths", len(candidates[0]), pairs - len(candidates[0]))
    clear = [before_surfaces(surfaces, ends) - surfaces.centre_m for ends in (sources_m, targets_m)]
    parts = []
    for start in range(0, max(1, len(candidates[0])), CANDIDATES_PER_CHUNK):
        chain, source, target = (column[start : start + CANDIDATES_PER_CHUNK] for column in candidates)
        plane = np.where(chain[:, None] >= 0, chains.plane[chain], -1) if len(chains) else chain[:, None][:, :0]
        # Existence of a path is judged for displaced antennas (`displaced`); its points are exact for the stated ones.
        near = displaced(surfaces.scale_m, clear[0][source], clear[1][target])
        vertices, meets = _vertices(surfaces, plane, *(ends + surfaces.centre_m for ends in near))
        meets &= ~_mounted(surfaces, plane, sources_m[source], targets_m[target])
        row = np.flatnonzero(meets)
        met = unobstructed(surfaces, vertices[row], plane[row], depth, options.transmission and options.depth > 0)
        is_path = row[met.candidate]
        exhaustive = np.ones(met.face.shape, np.float32)
        single = PathInteractions(
            source[is_path], target[is_path], met.interactions, met.face, met.points_m, exhaustive, {}
        )
        exact = _exact(surfaces, chains, chain[is_path], single, sources_m, targets_m)
        valid = reflect_on_faces(surfaces, exact)
        parts.append(exact if valid.all() else exact.select(valid))
    return join(parts)


def displaced(scale_m: float, source_m: FloatArray, target_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions [n, 3] of pairs of antennas near the stated ones, in general position; the same in both directions.

    Source: symbolic perturbation, Edelsbrunner and Mücke, "Simulation of simplicity" (1990), ACM Trans. Graphics 9(1);
    here by a number that single precision resolves.
    """
    # At stated positions, which are often round numbers, a path may meet the foot of a wall, the seam of two sheets or
    # the edge in which two reflections coincide. Then two answers are right, those of the positions on both sides, and
    # rounding would choose between them at random: neighbouring walls would choose differently, and a closed room leak.
    # Displaced positions have one answer for all surfaces.
    differs = source_m != target_m
    axis = differs.argmax(axis=1)[:, None]
    first = np.take_along_axis(source_m, axis, axis=1) <= np.take_along_axis(target_m, axis, axis=1)
    # The antenna that comes first in the order of coordinates takes the shorter displacement, whichever is the source.
    largest = np.maximum(np.abs(source_m), np.abs(target_m)).max(axis=1, keepdims=True, initial=0.0)
    by = DISPLACED * np.maximum(scale_m, largest) * ASLANT
    return source_m + np.where(first, 1, FARTHER) * by, target_m + np.where(first, FARTHER, 1) * by


def _vertices(
    surfaces: Surfaces, plane: IntArray, source_m: FloatArray, target_m: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Sources, points of reflection and targets [n, b + 2, 3] of chains of planes [n, b]; which exist [n]."""
    images = image_sources(surfaces.normal, surfaces.offset, plane, source_m)
    length, levels = np.count_nonzero(plane >= 0, axis=1), plane.shape[1]
    vertices, point = np.full((len(plane), levels + 2, 3), np.nan), target_m.copy()
    vertices[:, 0], meets = source_m, np.ones(len(plane), bool)
    vertices[np.arange(len(plane)), length + 1] = point
    # From the target backwards: the line from a vertex to the image before it meets the plane at the vertex before.
    for level in reversed(range(levels)):
        row = np.flatnonzero(length > level)
        mirror, image = plane[row, level], images[row, level + 1]
        point[row], near, far = meeting_point(point[row], image, surfaces.normal[mirror], surfaces.offset[mirror])
        vertices[row, level + 1] = point[row]
        meets[row] &= near * far < 0  # else the image is on the vertex's side, and nothing is reflected
    return vertices, meets


def _mounted(surfaces: Surfaces, plane: IntArray, source_m: FloatArray, target_m: FloatArray) -> NDArray[np.bool_]:
    """Mask [n] of chains whose first plane holds the source, or last the target: on a wall there is no image."""
    rows, last = np.arange(len(plane)), np.count_nonzero(plane >= 0, axis=1) - 1
    mounted = np.zeros(len(plane), bool)
    if not plane.shape[1]:
        return mounted
    for mirror, ends in ((plane[:, 0], source_m), (plane[rows, last], target_m)):
        height = (surfaces.normal[mirror] * ends).sum(axis=1) - surfaces.offset[mirror]
        mounted |= (last >= 0) & (np.abs(height) < 1.5 * clear_m(surfaces))
    return mounted


def _exact(
    surfaces: Surfaces,
    chains: ReflectionChains,
    chain: IntArray,
    single: PathInteractions,
    sources_m: FloatArray,
    targets_m: FloatArray,
) -> PathInteractions:
    """Vertices in float64, from the target back to the images of the source: single precision loses the phase."""
    point, vertices = targets_m[single.target], single.vertices_m.copy()
    reflected = np.cumsum(single.interactions == SPECULAR, axis=1)
    for level in reversed(range(vertices.shape[1])):
        row = np.flatnonzero(single.interactions[:, level])
        image = sources_m[single.source[row]]
        before = reflected[row, level]
        # A wave that passes a surface goes on towards the same image; without a reflection before, that is the source.
        image[before > 0] = chains.image[chain[row[before > 0]], before[before > 0] - 1]
        plane = surfaces.plane[single.face[row, level]]
        met, near, far = meeting_point(point[row], image, surfaces.normal[plane], surfaces.offset[plane])
        crosses = np.abs(near - far) > PARALLEL
        point[row] = vertices[row, level] = np.where(crosses[:, None], met, vertices[row, level])
    return replace(single, vertices_m=vertices)
