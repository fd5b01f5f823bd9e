"""Specular paths from a source to many targets: possible chains, tested by Sionna RT, made exact in float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray
from .buffer import SPECULAR, TRANSMISSION, Legs, SpecularTest, join, specular_legs
from .fields import point_array
from .image_method import meeting_point
from .options import TraceOptions
from .search import ReflectionChains, crossings, possible
from .surfaces import Surfaces

CANDIDATES_PER_CHUNK = 1 << 20
"""Candidates in a chunk; Sionna RT's image method takes some 100 bytes per candidate and interaction."""
PARALLEL = 1e-9
"""Difference of heights in metres below which a ray runs along a plane and keeps Sionna RT's point of crossing."""


def specular_paths(
    scene: Any,
    surfaces: Surfaces,
    test: SpecularTest,
    chains: ReflectionChains,
    source_m: FloatArray,
    targets_m: FloatArray,
    options: TraceOptions,
) -> Legs:
    """Every unobstructed path from a source to each target by the reflections of ``chains``.

    Args:
        scene: ``sionna.rt.Scene``.
        surfaces: surfaces of the scene.
        test: test of candidates in the scene.
        chains: chains from this source, see `wrf_mi.tracing.search.shoot`.
        source_m: position [3], metres.
        targets_m: positions [n, 3], metres.
        options: kinds of interaction and depth.

    Returns:
        Paths with source 0 and target 0..n-1, vertices in float64 on the surfaces' planes.
    """
    depth = max(options.max_depth, 1)
    ends = point_array(source_m[None]), point_array(targets_m)
    direct = np.arange(len(targets_m) if options.line_of_sight else 0)
    # Chains (-1: none) and targets to test.
    pairs = [(np.full(len(direct), -1), direct), *possible(surfaces, chains, targets_m)]
    candidates = [np.concatenate(column) for column in zip(*pairs, strict=True)]
    parts = []
    for start in range(0, len(candidates[0]), CANDIDATES_PER_CHUNK):
        chain, target = (column[start : start + CANDIDATES_PER_CHUNK] for column in candidates)
        through = np.zeros((len(chain), chains.plane.shape[1] + 1), np.int64)
        if options.transmission:
            through = _transmissions(scene, surfaces, chains, chain, target, source_m, targets_m, depth)
            short = through.sum(axis=1) + _lengths(chains, chain) <= depth
            chain, target, through = chain[short], target[short], through[short]
        legs, plane = _candidates(surfaces, chains, chain, target, through, depth)
        kept, found = test(legs, *ends)
        # Sionna RT accepts a face that mirrors the source within 1 cm of the expected one; another chain has that path.
        expected = plane[kept]
        same = ((expected < 0) | (np.append(surfaces.plane, -1)[found.face] == expected)).all(axis=1)
        parts.append(_exact(surfaces, chains, chain[kept[same]], found.select(same), source_m, targets_m))
    return join(parts, depth)


def _lengths(chains: ReflectionChains, chain: IntArray) -> IntArray:
    """Reflections of each chain, 0 for none."""
    return np.append(chains.length, 0)[chain]


def _transmissions(
    scene: Any,
    surfaces: Surfaces,
    chains: ReflectionChains,
    chain: IntArray,
    target: IntArray,
    source_m: FloatArray,
    targets_m: FloatArray,
    depth: int,
) -> IntArray:
    """Number of surfaces that a path passes before its first reflection, after it, and so on: [n, reflections + 1]."""
    length, levels = _lengths(chains, chain), chains.plane.shape[1]
    there, legs = targets_m[target].copy(), list[tuple[FloatArray, FloatArray]]()
    met = [np.flatnonzero(length >= level) for level in range(levels + 1)]  # paths with a leg after so many reflections
    for level in reversed(range(levels)):
        row = met[level + 1]
        plane, image = chains.plane[chain[row], level], chains.image[chain[row], level]
        here = meeting_point(there[row], image, surfaces.normal[plane], surfaces.offset[plane])[0]
        legs.append((here, there[row]))
        there[row] = here
    legs.append((np.broadcast_to(source_m, there.shape), there))
    start, end = (np.concatenate(points) for points in zip(*legs[::-1], strict=True))
    through = np.zeros((len(chain), levels + 1), np.int64)
    after = np.repeat(np.arange(levels + 1), [len(row) for row in met])
    through[np.concatenate(met), after] = crossings(scene, surfaces, start, end, depth)
    return through


def _candidates(
    surfaces: Surfaces, chains: ReflectionChains, chain: IntArray, target: IntArray, through: IntArray, depth: int
) -> tuple[Legs, IntArray]:
    """Candidates for the image method, and the plane of each reflection [n, depth], -1 elsewhere."""
    length = _lengths(chains, chain)
    total = length + through.sum(axis=1)
    types = np.where(np.arange(depth) < total[:, None], TRANSMISSION, 0).astype(np.uint8)
    plane, face = np.full((2, len(chain), depth), -1)
    corner = np.full((len(chain), depth, 3), np.nan)
    for level in range(chains.plane.shape[1]):
        row = np.flatnonzero(length > level)
        at = row, level + through[row, : level + 1].sum(axis=1)
        types[at] = SPECULAR
        plane[at] = chains.plane[chain[row], level]
        face[at] = surfaces.face[plane[at]]
        corner[at] = surfaces.triangles[face[at], 0]
    return specular_legs(np.zeros_like(target), target, types, face, corner), plane


def _exact(
    surfaces: Surfaces,
    chains: ReflectionChains,
    chain: IntArray,
    found: Legs,
    source_m: FloatArray,
    targets_m: FloatArray,
) -> Legs:
    """Vertices in float64, from the target back to the images of the source: single precision loses the phase."""
    here, vertices = targets_m[found.target], found.vertices_m.copy()
    reflected = np.cumsum(found.interactions == SPECULAR, axis=1)
    for level in reversed(range(vertices.shape[1])):
        row = np.flatnonzero(found.interactions[:, level])
        image = np.broadcast_to(source_m, (len(row), 3)).copy()
        before = reflected[row, level]
        image[before > 0] = chains.image[chain[row[before > 0]], before[before > 0] - 1]
        plane = surfaces.plane[found.face[row, level]]
        met, near, far = meeting_point(here[row], image, surfaces.normal[plane], surfaces.offset[plane])
        crosses = np.abs(near - far) > PARALLEL
        here[row] = vertices[row, level] = np.where(crosses[:, None], met, vertices[row, level])
    return replace(found, vertices_m=vertices)
