"""Specular paths from sources to many targets: possible chains, tested by rays, made exact in float64."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..core.angles import FloatArray
from ..core.types import IntArray
from .buffer import SPECULAR, Legs, join, specular_legs
from .image_method import meeting_point
from .options import TraceOptions
from .search import ReflectionChains, possible
from .surfaces import Surfaces
from .visibility import unobstructed

CANDIDATES_PER_CHUNK = 1 << 20
"""Candidates in a chunk, which take some 100 bytes for each interaction."""
PARALLEL = 1e-9
"""Difference of heights in metres below which a ray runs along a plane and keeps the point that it met."""


def specular_paths(
    scene: Any,
    surfaces: Surfaces,
    chains: ReflectionChains,
    sources_m: FloatArray,
    targets_m: FloatArray,
    options: TraceOptions,
) -> Legs:
    """Every unobstructed path from sources to each target by the reflections of ``chains``.

    Args:
        scene: ``sionna.rt.Scene``.
        surfaces: surfaces of the scene.
        chains: chains from these sources, see `wrf_mi.tracing.search.shoot`.
        sources_m: positions [s, 3], metres.
        targets_m: positions [n, 3], metres.
        options: kinds of interaction and depth.

    Returns:
        Paths with source 0..s-1 and target 0..n-1, vertices in float64 on the surfaces' planes.
    """
    depth = max(options.max_depth, 1)
    direct = np.arange(len(sources_m) * len(targets_m) if options.line_of_sight else 0)
    # Chains (-1: none), sources and targets to test.
    columns = [(np.full(len(direct), -1), direct // len(targets_m), direct % len(targets_m))]
    columns += [(chain, chains.source[chain], target) for chain, target in possible(surfaces, chains, targets_m)]
    candidates = [np.concatenate(column) for column in zip(*columns, strict=True)]
    parts = []
    for start in range(0, len(candidates[0]), CANDIDATES_PER_CHUNK):
        chain, source, target = (column[start : start + CANDIDATES_PER_CHUNK] for column in candidates)
        plane = np.where(chain[:, None] >= 0, chains.plane[chain], -1) if len(chains) else chain[:, None][:, :0]
        vertices = _vertices(surfaces, chains, chain, sources_m[source], targets_m[target])
        met = unobstructed(scene, surfaces, vertices, plane, depth, options.transmission)
        kept = met.candidate
        found = specular_legs(source[kept], target[kept], met.interactions, met.face, met.points_m)
        parts.append(_exact(surfaces, chains, chain[kept], found, sources_m, targets_m))
    return join(parts, depth)


def _vertices(
    surfaces: Surfaces, chains: ReflectionChains, chain: IntArray, source_m: FloatArray, target_m: FloatArray
) -> FloatArray:
    """Sources, points of reflection and targets [n, reflections + 2, 3] of chains (-1: none), NaN beyond a target."""
    length, levels = np.append(chains.length, 0)[chain], chains.plane.shape[1]
    vertices, here = np.full((len(chain), levels + 2, 3), np.nan), target_m.copy()
    vertices[:, 0] = source_m
    vertices[np.arange(len(chain)), length + 1] = here
    for level in reversed(range(levels)):
        row = np.flatnonzero(length > level)
        plane, image = chains.plane[chain[row], level], chains.image[chain[row], level]
        here[row] = meeting_point(here[row], image, surfaces.normal[plane], surfaces.offset[plane])[0]
        vertices[row, level + 1] = here[row]
    return vertices


def _exact(
    surfaces: Surfaces,
    chains: ReflectionChains,
    chain: IntArray,
    found: Legs,
    sources_m: FloatArray,
    targets_m: FloatArray,
) -> Legs:
    """Vertices in float64, from the target back to the images of the source: single precision loses the phase."""
    here, vertices = targets_m[found.target], found.vertices_m.copy()
    reflected = np.cumsum(found.interactions == SPECULAR, axis=1)
    for level in reversed(range(vertices.shape[1])):
        row = np.flatnonzero(found.interactions[:, level])
        image = sources_m[found.source[row]]
        before = reflected[row, level]
        image[before > 0] = chains.image[chain[row[before > 0]], before[before > 0] - 1]
        plane = surfaces.plane[found.face[row, level]]
        met, near, far = meeting_point(here[row], image, surfaces.normal[plane], surfaces.offset[plane])
        crosses = np.abs(near - far) > PARALLEL
        here[row] = vertices[row, level] = np.where(crosses[:, None], met, vertices[row, level])
    return replace(found, vertices_m=vertices)
