"""Specular paths from one source to many targets: possible chains, tested by Sionna RT, made exact in float64."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray
from .buffer import SPECULAR, TRANSMISSION, Legs, exact_paths, join, specular_legs, to_buffer
from .fields import point_array
from .image_method import meeting_point
from .options import TraceOptions
from .search import Chains, count_crossings, possible
from .surfaces import Surfaces

CANDIDATES_PER_CHUNK = 1 << 20
"""Candidates in one call of Sionna RT's image method, which takes some 100 bytes per candidate and interaction."""
PARALLEL = 1e-9
"""A ray that runs along a plane keeps the point where Sionna RT saw it cross."""


def specular_paths(
    scene: Any, surfaces: Surfaces, chains: Chains, source_m: FloatArray, targets_m: FloatArray, options: TraceOptions
) -> Legs:
    """Every unobstructed path from a source to each target by the reflections of ``chains``.

    Args:
        scene: ``sionna.rt.Scene``.
        surfaces: of that scene.
        chains: from this source, see `wrf_mi.tracing.search.shoot`.
        source_m: shape [3].
        targets_m: shape [n, 3].
        options: kinds of interaction and depth.

    Returns:
        Paths with source 0 and target 0..n-1, vertices in float64 on the surfaces' planes.
    """
    depth = max(options.max_depth, 1)
    ends = point_array(source_m[None]), point_array(targets_m)
    parts = []
    for chain, target in _in_parts(surfaces, chains, targets_m, options):
        through = np.zeros((len(chain), chains.plane.shape[1] + 1), np.int64)
        if options.transmission:
            through = _transmissions(scene, surfaces, chains, chain, target, source_m, targets_m, depth)
            short = through.sum(axis=1) + _lengths(chains, chain) <= depth
            chain, target, through = chain[short], target[short], through[short]
        legs, plane = _candidates(surfaces, chains, chain, target, through, depth)
        kept, found = exact_paths(scene, surfaces, to_buffer(legs, surfaces, valid=False), *ends)
        # Sionna RT takes a face for the expected one if it mirrors the source within 1 cm: then its own chain has it.
        own = np.ones(len(kept), bool)
        row, level = np.nonzero(plane[kept] >= 0)
        own[row[surfaces.plane[found.face[row, level]] != plane[kept][row, level]]] = False
        parts.append(_exact(surfaces, chains, chain[kept[own]], found.select(own), source_m, targets_m))
    return join(parts, depth)


def _in_parts(
    surfaces: Surfaces, chains: Chains, targets_m: FloatArray, options: TraceOptions
) -> Iterator[tuple[IntArray, IntArray]]:
    """Chains (-1: none) and targets to be tested, in parts of bounded size."""
    everyone = np.arange(len(targets_m)) if options.line_of_sight else np.zeros(0, np.int64)
    waiting = [(np.full(len(everyone), -1), everyone)]
    for pairs in possible(surfaces, chains, targets_m):
        waiting.append(pairs)
        if sum(len(chain) for chain, _ in waiting) >= CANDIDATES_PER_CHUNK:
            yield from _split(waiting)
            waiting = []
    yield from _split(waiting)


def _split(pairs: list[tuple[IntArray, IntArray]]) -> Iterator[tuple[IntArray, IntArray]]:
    if not pairs:
        return
    chain, target = (np.concatenate(column) for column in zip(*pairs, strict=True))
    for start in range(0, len(chain), CANDIDATES_PER_CHUNK):
        yield chain[start : start + CANDIDATES_PER_CHUNK], target[start : start + CANDIDATES_PER_CHUNK]


def _lengths(chains: Chains, chain: IntArray) -> IntArray:
    """Reflections of each chain, 0 for none."""
    return np.append(chains.length, 0)[chain]


def _transmissions(
    scene: Any,
    surfaces: Surfaces,
    chains: Chains,
    chain: IntArray,
    target: IntArray,
    source_m: FloatArray,
    targets_m: FloatArray,
    depth: int,
) -> IntArray:
    """Surfaces that a path goes through before its first reflection, after it, and so on: [n, reflections + 1]."""
    length = _lengths(chains, chain)
    through = np.zeros((len(chain), chains.plane.shape[1] + 1), np.int64)
    there = targets_m[target].copy()
    for level in reversed(range(chains.plane.shape[1])):
        has = length > level
        plane, image = chains.plane[chain[has], level], chains.image[chain[has], level]
        here = meeting_point(there[has], image, surfaces.normal[plane], surfaces.offset[plane])[0]
        through[has, level + 1] = count_crossings(scene, here, there[has], depth)
        there[has] = here
    through[:, 0] = count_crossings(scene, np.broadcast_to(source_m, there.shape), there, depth)
    return through


def _candidates(
    surfaces: Surfaces, chains: Chains, chain: IntArray, target: IntArray, through: IntArray, depth: int
) -> tuple[Legs, IntArray]:
    """Candidates for the image method, and the plane of each reflection [n, depth], -1 elsewhere."""
    length = _lengths(chains, chain)
    total = length + through.sum(axis=1)
    types = np.where(np.arange(depth) < total[:, None], TRANSMISSION, 0).astype(np.uint8)
    plane, face = np.full((2, len(chain), depth), -1)
    corner = np.full((len(chain), depth, 3), np.nan)
    for level in range(chains.plane.shape[1]):
        row = np.flatnonzero(length > level)
        place = level + through[row, : level + 1].sum(axis=1)
        types[row, place] = SPECULAR
        plane[row, place] = chains.plane[chain[row], level]
        face[row, place] = surfaces.face[plane[row, place]]
        corner[row, place] = surfaces.triangles[face[row, place], 0]
    return specular_legs(np.zeros_like(target), target, types, face, corner), plane


def _exact(
    surfaces: Surfaces, chains: Chains, chain: IntArray, found: Legs, source_m: FloatArray, targets_m: FloatArray
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
    return Legs(found.source, found.target, found.interactions, found.face, vertices, found.probability, found.wedge)
