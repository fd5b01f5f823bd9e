"""Where the Gaussians of a fit start, as its settings say."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from wrf_mi_scenes.mitsuba_xml import PERFECT

from ..core import InputError, Record
from ..core.types import IntArray
from ..gaussians import InitialGaussians, gaussians_from_points, random_gaussians
from ..scene.points import read_points
from ..tracing import open_scene, trace_paths
from ..tracing.scenes import MESHES
from ..tracing.surfaces import scene_surfaces
from .config import InitialConfig
from .initial_paths import gaussians_from_mesh, gaussians_from_paths


def initial_gaussians(
    config: InitialConfig, record: Record, rows: IntArray, rng: np.random.Generator, sphere: bool = False
) -> InitialGaussians:
    """Starting values of the Gaussians.

    Args:
        config: which start; see there.
        record: whose receivers look at them.
        rows: training rows: only their transmitters' paths are traced.
        rng: draws what is drawn.
        sphere: random ones are seen in all directions, or else in the receivers' upper hemispheres.

    Raises:
        InputError: a file or scene that cannot be used, or paths to trace and no carrier frequency.
    """
    if config.paths:
        if Path(config.paths).suffix.lower() in MESHES:
            remedy = f"make a scene of it (wrf-mi mesh {config.paths} --out DIR) and name that folder, "
            remedy += f"or start on its surfaces: initial.mesh={config.paths}"
            raise InputError(f"setting initial.paths: {config.paths} is a mesh without radio materials; {remedy}")
        if record.frequencies_hz is None:
            raise InputError(f"setting initial.paths: {record.name} states no carrier frequency; start otherwise")
        scene = open_scene(config.paths, float(record.frequencies_hz[0]))
        here = record.tx_pos_m[rows]
        paths = trace_paths(scene, here, record.receivers, tx_antenna=record.tx_antenna).paths
        return gaussians_from_paths(paths, here, record.receivers, config.gaussians, rng, config.opacity, config.signal)
    if config.mesh:
        # Only its geometry counts: any frequency and material will do.
        bare = Path(config.mesh).suffix.lower() in MESHES
        scene = open_scene(config.mesh, 1e9, material=PERFECT if bare else None)
        triangles = scene_surfaces(scene).triangles
        return gaussians_from_mesh(triangles, config.gaussians, rng, config.opacity, config.signal)
    if config.points:
        start = gaussians_from_points(read_points(config.points), config.gaussians, rng)
        return replace(start, opacity=config.opacity, signal=config.signal)
    distance = (config.nearest_m, config.farthest_m)
    return random_gaussians(
        record.receivers, config.gaussians, rng, distance, config.size_deg, config.opacity, config.signal, sphere
    )
