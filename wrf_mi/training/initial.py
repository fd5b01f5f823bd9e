"""Starting values of Gaussians: random, on a point cloud, on a mesh's surfaces, or from traced paths.

A receiver observes a specular path as if it came from the transmitter's image. Paths of the training transmitters give
directions, powers and distances of arriving waves: clusters of their last points of interaction become Gaussians of
that power. A mesh alone gives the surfaces that can scatter.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from wrf_mi_scenes.mitsuba_xml import PERFECT

from ..backend.device import to_tensor
from ..core import InputError, Paths, Receiver, Record
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..gaussians.initial import InitialGaussians, gaussians_from_points, random_gaussians
from ..graph.graph import LEVEL, SHARE
from ..scene.coordinates import require_near
from ..scene.scan.points import read_points
from ..tracing import open_scene, trace_paths
from ..tracing.search.surfaces import scene_surfaces
from ..tracing.sionna.scenes import MESHES
from .config import InitialConfig
from .fit_plan import FitPlan
from .step import batch_on_device, evaluated, port_batches

LEAST_SCALE_M = 0.02  # smallest starting scale, for a cluster of a single point
LEAST_SHARE = 1e-3  # smallest starting power relative to the strongest cluster, so that weak Gaussians can grow
LEVEL_ROWS = 64  # observations of a receiver from which its starting level is estimated


def gaussians_from_paths(
    paths: Paths,
    tx_pos_m: FloatArray,
    receivers: tuple[Receiver, ...],
    count: int,
    rng: np.random.Generator,
    opacity: float = 0.4,
    signal: float = 0.3,
) -> InitialGaussians:
    """Gaussians on clusters of the last points of interaction of traced paths (of direct paths: the transmitter).

    Points are clustered by direction and distance from their receiver, weighted by power; a cluster's mean is the
    centre, its spread the scale, its mean power the signal and (relative to the strongest) the opacity. ``tx_pos_m``
    are the transmitters of the paths [n, 3], metres; ``opacity`` and ``signal`` opacity and amplitude of the strongest
    of ``count`` Gaussians.

    Raises:
        InputError: no path.
    """
    if not len(paths):
        raise InputError("start from paths: no path arrives; trace more kinds of path, or start at random")
    bounces = paths.bounces
    last = paths.vertices_m[np.arange(len(paths)), np.maximum(bounces - 1, 0)]
    last = np.where((bounces > 0)[:, None], last, tx_pos_m[paths.tx])
    away = last - np.stack([receiver.position_m for receiver in receivers])[paths.rx]
    distance = np.linalg.norm(away, axis=1)
    # Directions in units of a tenth of a radian, distances in octaves: the resolution of a receiver.
    features = np.column_stack([10 * away / distance[:, None], 2 * np.log2(distance)])
    power = np.abs(paths.gain) ** 2
    # Centres are found on a sample, as paths may be millions; every path then joins the nearest.
    drawn = rng.choice(len(paths), min(len(paths), 40 * count), replace=False)
    few = min(count, len(np.unique(np.round(features[drawn], 6), axis=0)))
    from scipy.cluster.vq import kmeans2

    centres, _ = kmeans2(features[drawn], few, iter=20, minit="++", rng=rng)
    label = cKDTree(centres).query(features)[1].astype(np.int64)
    used = np.unique(label)
    # With fewer clusters than Gaussians random clusters are taken more than once.
    chosen = np.concatenate([used, rng.choice(used, count - len(used))]) if len(used) < count else used
    position, (scale, strength, phase) = np.empty((count, 3)), np.empty((3, count))
    for index, cluster in enumerate(chosen):
        members = np.flatnonzero(label == cluster)
        total = power[members].sum()
        share = power[members] / total if total > 0 else np.full(len(members), 1 / len(members))
        position[index] = share @ last[members]
        square = share @ ((last[members] - position[index]) ** 2).sum(axis=1)
        # A third of the mean square distance along each axis: the Gaussian starts as a ball.
        scale[index] = max(np.sqrt(square / 3), LEAST_SCALE_M)
        strength[index] = total / paths.n_tx  # mean over all transmitters
        phase[index] = np.angle(paths.gain[members[np.argmax(power[members])]])
    repeated = np.bincount(chosen, minlength=len(centres))[chosen]
    # Copies of a cluster share its power, and are moved apart: equal Gaussians would have equal gradients for ever.
    relative = np.maximum(strength / repeated / strength.max(), LEAST_SHARE)
    amplitude = signal * np.sqrt(relative)
    opacities = np.clip(opacity * (0.1 + 0.9 * relative), 1e-3, 1 - 1e-3)
    jitter = rng.standard_normal((count, 3)) * scale[:, None] * (repeated > 1)[:, None]
    return InitialGaussians(position + jitter, scale, opacities, signal, amplitude * np.exp(1j * phase))


def gaussians_from_mesh(triangles_m: FloatArray, count: int, rng: np.random.Generator) -> InitialGaussians:
    """Gaussians on the surfaces of triangles [f, 3, 3], metres, drawn by area; scales as in `gaussians_from_points`.

    Raises:
        InputError: no surface.
    """
    corners = np.asarray(triangles_m, float).reshape(-1, 3, 3)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    if not area.sum() > 0:
        raise InputError("start from a mesh: it has no surface; give triangles with an area")
    face = rng.choice(len(corners), count, p=area / area.sum())
    a, b = rng.random((2, count, 1))
    # Even in the triangle: points of the parallelogram's other half are mirrored into it.
    flip = a + b > 1
    a, b = np.where(flip, 1 - a, a), np.where(flip, 1 - b, b)
    first, second, third = corners[face].transpose(1, 0, 2)
    return gaussians_from_points(first + a * (second - first) + b * (third - first), count, rng)


def initial_gaussians(
    config: InitialConfig, record: Record, rows: IntArray, rng: np.random.Generator, sphere: bool = False
) -> InitialGaussians:
    """Starting values of the Gaussians by the settings, for receivers and training rows of a record.

    With ``sphere`` random Gaussians lie in all directions instead of the receivers' upper hemispheres.

    Raises:
        InputError: an unusable file or scene, or paths to trace without a carrier frequency.
    """
    if config.paths:
        if Path(config.paths).suffix.lower() in MESHES:
            remedy = f"make a scene of it (wrf-mi mesh {config.paths} --out DIR) and name that folder, or start on its "
            remedy += f"surfaces: initial.mesh={config.paths}"
            raise InputError(f"setting initial.paths: {config.paths} is a mesh without radio materials; {remedy}")
        if record.frequencies_hz is None:
            raise InputError(f"setting initial.paths: {record.name} states no carrier frequency; start otherwise")
        scene = open_scene(config.paths, float(record.frequencies_hz[0]))
        tx, receivers = record.tx_pos_m[rows], record.receivers
        paths = trace_paths(scene, tx, receivers, tx_antenna=record.tx_antenna).paths
        return gaussians_from_paths(paths, tx, receivers, config.gaussians, rng, config.opacity, config.signal)
    if config.mesh:
        # The geometry does not depend on frequency and material.
        bare = Path(config.mesh).suffix.lower() in MESHES
        scene = open_scene(config.mesh, 1e9, material=PERFECT if bare else None)
        start = gaussians_from_mesh(scene_surfaces(scene).triangles, config.gaussians, rng)
    elif config.points:
        points_m = read_points(config.points)
        require_near(points_m, config.points)
        start = gaussians_from_points(points_m, config.gaussians, rng)
    else:
        distance_m = config.nearest_m, config.farthest_m
        start = random_gaussians(record.receivers, config.gaussians, rng, distance_m, config.size_deg, sphere=sphere)
    return replace(start, opacity=config.opacity, signal=config.signal)


def starting_values(plan: FitPlan, initial: InitialGaussians | None = None) -> dict[str, NDArray[np.float32]]:
    """Starting values of a fit: Gaussians, and gains and levels that match the observations on average.

    ``initial`` replaces the Gaussians of the settings.
    """
    graph, config = plan.graph, plan.config
    rng = np.random.default_rng([config.seed, 0])
    values: dict[str, NDArray[np.float32]] = {}
    if graph.field is not None:
        placed = replace(plan.record, receivers=graph.receivers)
        start = initial or initial_gaussians(config.initial, placed, plan.split.train, rng, graph.sphere)
        values = graph.field.init(start, rng)
    values |= graph.parameters(plan.traced_fields) | graph.add_surface_gaussians(plan.traced_fields)
    values |= _gains(plan, values)
    if LEVEL in values:
        values[LEVEL][0] = _levels(plan, values)
    return values


def _gains(plan: FitPlan, values: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    gains = defaultdict[str, list[NDArray[np.float32]]](list)
    for port, traced_field in enumerate(plan.traced_fields):
        if traced_field is not None and traced_field.gain_name in values and len(traced_field):
            observed = plan.targets.observed[port // plan.graph.carriers, plan.port_rows[port]]
            # Ports of several carriers share the receiver's gain, which starts at their mean.
            gains[traced_field.gain_name].append(plan.graph.match_gain(port, traced_field, observed))
    return {name: np.mean(of_ports, axis=0, dtype=np.float32) for name, of_ports in gains.items()}


def _levels(plan: FitPlan, values: Mapping[str, NDArray[np.float32]]) -> list[float]:
    """Level at which Gaussians match each receiver's observations, or far below its paths' power."""
    graph, targets, levels = plan.graph, plan.targets, list[float]()
    received = targets.received(plan.split.all_train)
    params, batches = {name: to_tensor(value) for name, value in values.items()}, port_batches(graph)
    # A receiver has one level for all of its carriers: that of the first.
    for port in range(0, targets.ports, graph.carriers):
        if (traced_field := plan.traced_fields[port]) is not None:
            levels.append(graph.power_level(traced_field, params) + float(np.log(SHARE)))
            continue
        rows = received[port][:LEVEL_ROWS]
        batch = batch_on_device(batches[port], targets.condition[:, rows])
        predicted = evaluated(graph.observation(port, None), params, batch).numpy()
        observed = targets.observed[port // graph.carriers, rows].astype(float)
        levels.append(graph.models[port].missing_gain(predicted.astype(float).reshape(observed.shape), observed))
    return levels
