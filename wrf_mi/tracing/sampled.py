"""Paths with scattering or diffraction by Sionna RT's search, which draws them at random."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ..core.angles import FloatArray
from .buffer import SPECULAR, TRANSMISSION, Legs, exact_paths, from_buffer, join
from .fields import point_array
from .options import TraceOptions
from .surfaces import Surfaces

SLOTS_PER_CHUNK = 1 << 22
"""Rays x targets x interactions of one search. Sionna RT takes 8 bytes for each to find duplicates, and some 70 bytes
for an entry of the buffer, which has room for all so that no path is dropped: about 1 GB at a depth of 3."""


def sampled_paths(
    scene: Any, surfaces: Surfaces, source_m: FloatArray, targets_m: FloatArray, options: TraceOptions, rays: int
) -> Legs:
    """Paths with at least one diffuse reflection or diffraction from a source to each target.

    Args:
        scene: ``sionna.rt.Scene``.
        surfaces: surfaces of the scene.
        source_m: position [3], metres.
        targets_m: positions [n, 3], metres.
        options: kinds of interaction and depth.
        rays: number of rays from the source.

    Returns:
        Paths with source 0 and target 0..n-1; vertices in single precision.
    """
    import drjit as dr
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
        found = from_buffer(exact_paths(scene.mi_scene, buffer, *ends), surfaces)
        types = found.interactions
        found = found.select(((types != 0) & (types != SPECULAR) & (types != TRANSMISSION)).any(axis=1))
        parts.append(replace(found, target=found.target + start))
    return join(parts, options.max_depth)
