"""Figure of a scene: mesh, traced paths and learned Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ..core.angles import FloatArray
from ..estimators.ray_tracing import PATHS
from ..gaussians.parameters import Gaussians
from ..scene.mesh.surfaces import KINDS, Kind, Surface, cut_lines
from ..scene.preview import GaussianCloud, draw_scene
from ..tracing import load_trace
from ..tracing.search.surfaces import scene_surfaces
from .api import open_run
from .run import Run

SHOWN_GAUSSIANS = 40  # number of Gaussians shown, the strongest
WEAKEST = 1e-6  # lower limit of drawn signals: -120 dB


def scene_view(traced: str | Path, row: int, field: str | Path | None = None) -> Figure:
    """Mesh, traced paths and optionally the Gaussians of a learned field for the transmitter of a row of the data.

    ``traced`` is a run folder of the ray tracer, ``field`` that of a field which was trained on the same data, or None.
    `InputError`: not such run folders, or a scene that no longer exists.
    """
    run, trace = open_run(traced), load_trace(Path(traced) / PATHS)
    scene, transmitter = run.problem.open_scene(trace.frequency_hz), trace.tx_pos_m[row]
    paths, cloud = trace.paths.select(trace.paths.tx == row), None
    if field is not None:
        cloud = gaussian_cloud(open_run(field).predictor().gaussians(transmitter[None])).strongest(SHOWN_GAUSSIANS)
    return draw_scene(
        surfaces_of(scene),
        paths=replace(paths, tx=np.zeros_like(paths.tx), n_tx=1),
        transmitters_m=transmitter,
        receivers_m=[receiver.position_m for receiver in trace.receivers],
        gaussians=cloud,
        title=f"{run.config.scene}, transmitter of row {row}",
    )


def surfaces_of(scene: Any) -> list[Surface]:
    """Objects of a ``sionna.rt.Scene`` as surfaces; the kind is the prefix of the name, else ``other``."""
    faces = scene_surfaces(scene)
    surfaces = []
    for index, name in enumerate(faces.names):
        triangles: FloatArray = faces.triangles[faces.first_face[index] : faces.first_face[index + 1]]
        kind: Kind = next((kind for kind in KINDS if name.startswith(kind)), "other")
        vertices, vertex = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
        surfaces.append(Surface(name, kind, vertices, vertex.reshape(-1, 3)))
    return surfaces


def scene_cuts(run: Run, height_m: float) -> Sequence[FloatArray]:
    """Lines [n, 2, 2] in which a height cuts surfaces of a run's scene, metres, of those that it cuts."""
    scene = run.problem.opened_scene
    cuts = [] if scene is None else [cut_lines(part, height_m) for part in surfaces_of(scene)]
    return [lines for lines in cuts if len(lines)]  # a floor has none


def gaussian_cloud(gaussians: Gaussians) -> GaussianCloud:
    """Gaussians for a transmitter, coloured by opacity times magnitude of all signals, in dB."""
    shapes = gaussians.position, gaussians.scale, gaussians.rotation
    position, scale, rotation = (np.array(values, float).T for values in shapes)
    strength = np.sqrt(np.square(np.array(gaussians.signal, float)).sum(axis=0))
    if gaussians.opacity is not None:
        strength = strength * np.array(gaussians.opacity, float)
    return GaussianCloud(position, scale, rotation, 20 * np.log10(np.maximum(strength, WEAKEST)))
