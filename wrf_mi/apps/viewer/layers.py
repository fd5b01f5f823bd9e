"""Layers of a view: mesh and edges of a scene; held-out rows, observations, Gaussians and paths of a run."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.colors import to_hex
from numpy.typing import NDArray

from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...estimators.gaussian.model import FittedField
from ...estimators.ray_tracing import CORRECTED, PATHS
from ...runs.folder import SPLIT
from ...runs.results import Results
from ...runs.run import Run
from ...runs.scene_view import gaussian_cloud, surfaces_of
from ...scene.mesh.surfaces import Surface, box_of
from ...scene.preview import ceiling_faces, free_edges
from ...tasks import TASKS
from ...tracing import TraceOptions, TraceResult, load_trace, open_scene, trace_paths
from ...tracing.sionna.scenes import MESHES
from .content import GaussiansContent, MaterialMesh, PathsContent, RowsContent, SceneContent, ViewOptions

MOST_TRIANGLES = 100_000  # triangles of a page, the largest: 3 MB
MOST_EDGES = 20_000
OPENED_HZ = 3.5e9
"""Carrier at which a scene without data is opened; materials are shown by name, so that it has no influence."""
NO_MATERIAL, ANY_MATERIAL = "no material", "concrete"  # label of a bare mesh, and the material that it is opened with
IMAGE_BYTES = 4_000_000  # bytes of a page for observations that are images, at most
PATH_NUMBERS = 500_000  # coordinates of all paths of a page, at most: 4 MB
WEAKEST_GAIN, SMALLEST_M = 1e-20, 1e-9  # limits before logarithms
KINDS = {1: "reflection", 2: "scattering", 4: "transmission", 8: "diffraction"}
"""Words for Sionna RT's ``InteractionType``."""
Look = tuple[str, str]  # name of a radio material, and its colour in Sionna RT, ``#rrggbb``
OnStage = Callable[[str, float], None]  # progress callback: stage and fraction done


def read_scene(source: str | Path, material: str | None = None) -> tuple[list[Surface], dict[str, Look]]:
    """Surfaces of a scene, by name, folder, XML or mesh, and the look of each by its name.

    A mesh without a material is shown without one. `InputError` for no such scene, or one that cannot be opened.
    """
    bare = material is None and Path(source).suffix.lower() in MESHES
    if bare and not Path(source).is_file():
        raise InputError(f"{source}: no such file; give a run folder, a map or a scene")
    surfaces, looks = surfaces_in(open_scene(source, OPENED_HZ, material=ANY_MATERIAL if bare else material))
    return surfaces, {name: (NO_MATERIAL, colour) for name, (_, colour) in looks.items()} if bare else looks


def surfaces_in(scene: Any) -> tuple[list[Surface], dict[str, Look]]:
    """Surfaces of a ``sionna.rt.Scene``, and the look of each by its name."""
    looks = {}
    for name, thing in scene.objects.items():
        # Names of radio materials without the prefix of ITU-R P.2040's.
        label = re.sub("^itu[_-]", "", thing.radio_material.name).replace("_", " ")
        looks[name] = label, to_hex(thing.radio_material.color)
    return surfaces_of(scene), looks


def scene_content(
    surfaces: Sequence[Surface], looks: Mapping[str, Look], most: int = MOST_TRIANGLES
) -> tuple[SceneContent, str | None]:
    """Triangles by material, and a note if there are more than ``most``, of which the largest are kept."""
    low, high = box_of(surfaces)
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    ceiling = np.concatenate([ceiling_faces(surface, low, high) for surface in surfaces])
    names = np.repeat([surface.name for surface in surfaces], [len(surface.faces) for surface in surfaces])
    drawn = np.argsort(-trimesh.triangles.area(corners), kind="stable")[:most]
    note = f"Mesh: the largest {most} of {len(corners)} triangles." if len(drawn) < len(corners) else None
    meshes = []
    for look in sorted({looks[surface.name] for surface in surfaces}):
        of_material = np.isin(names[drawn], [name for name in looks if looks[name] == look])
        for above in (False, True):
            if len(chosen := drawn[of_material & (ceiling[drawn] == above)]):
                meshes.append(MaterialMesh(*look, above, corners[chosen], names[chosen]))
    return SceneContent(tuple(meshes), _longest_edges(surfaces)), note


def _longest_edges(surfaces: Sequence[Surface]) -> FloatArray:
    edges = np.concatenate([free_edges(surface, creases=True) for surface in surfaces if surface.kind != "ceiling"])
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=-1)
    return np.asarray(edges[np.argsort(-length, kind="stable")[:MOST_EDGES]])


def rows_content(results: Results, options: ViewOptions) -> tuple[RowsContent | None, list[str]]:
    """Held-out rows of known positions with their observations, and notes."""
    task = TASKS[results.task]
    placed = np.flatnonzero(np.isfinite(results.tx_pos_m).all(axis=1))
    if not len(placed):
        return None, ["The positions of the held-out rows are not known."]
    score = results.score[:, placed]
    most = options.transmitters
    if task.image:
        height, width = results.truth.shape[-2:]
        most = min(most, max(1, IMAGE_BYTES // (2 * len(results.receivers) * height * width * 4 // 3)))
    chosen = placed[stored := representative(score, most)]
    notes = []
    if len(stored) < len(placed):
        text = f"evenly over the order of their {task.label} (option --max-transmitters)"
        notes.append(f"Transmitters: {len(stored)} of {len(placed)} held-out rows, {text}.")
    observed = observations_of(results, chosen)
    rows = results.row[placed], results.tx_pos_m[placed], score
    return RowsContent(*rows, task.label, task.digits, stored, observed, task.quantity), notes


def representative(score: FloatArray, count: int) -> IntArray:
    """Indices, ascending, of at most ``count`` rows evenly over the order of their mean scores [n_rx, m].

    Rows that nobody received come last in that order, and are taken only if all are.
    """
    received = np.isfinite(score)
    total = np.where(received, score, 0.0).sum(axis=0)
    mean = np.where(received.any(axis=0), total / np.maximum(received.sum(axis=0), 1), np.inf)
    order = np.argsort(mean, kind="stable")
    if count >= len(order):
        return np.arange(len(order))
    heard = order[: max(int(np.isfinite(mean).sum()), 1)]
    return np.unique(heard[np.round(np.linspace(0, len(heard) - 1, min(count, len(heard)))).astype(int)])


def observations_of(results: Results, rows: IntArray) -> dict[str, Any]:
    """Measured and predicted observations of some test rows.

    ``kind`` and, by ``measured`` and ``predicted``: ``image``, spectra [n_rx, rows, H, W] in steps of 1/255;
    ``level``, numbers [n_rx, rows]; ``curve``, power in dB [n_rx, rows, k], mean over antennas.
    """
    task = TASKS[results.task]
    both = {"measured": results.truth[:, rows], "predicted": results.prediction[:, rows]}
    if task.image:
        # Spectra that were not received are zero.
        clipped = {key: np.clip(np.nan_to_num(values), 0, 1) for key, values in both.items()}
        return {"kind": "image"} | {key: np.round(255 * values).astype(np.uint8) for key, values in clipped.items()}
    if task.axes == 0:
        return {"kind": "level"} | both
    return {"kind": "curve"} | {key: power_db(values) for key, values in both.items()}


def power_db(channels: NDArray[Any]) -> FloatArray:
    """Power of channels [n_rx, m, k] or [n_rx, m, antennas, k] in dB, mean over antennas, [n_rx, m, k]."""
    power = np.square(np.abs(channels)).reshape(*channels.shape[:2], -1, channels.shape[-1]).mean(axis=2)
    return np.asarray(10 * np.log10(np.where(power > 0, power, np.nan)))


def gaussians_content(
    run: Run, tx_pos_m: FloatArray, options: ViewOptions, on_stage: OnStage
) -> tuple[GaussiansContent | None, list[str]]:
    """The strongest Gaussians of a run for some transmitters [t, 3], and notes; None where it has none."""
    if (obstacle := _no_gaussians(run)) is not None:
        return None, obstacle
    fitted: Any = run.fitted
    clouds = []
    for index, position in enumerate(tx_pos_m):
        on_stage("evaluating Gaussians", index / len(tx_pos_m))
        clouds.append(gaussian_cloud(fitted.predictor.gaussians(position[None])))
    strength = np.stack([cloud.strength_db for cloud in clouds])
    order = np.argsort(-np.mean(10 ** (strength / 10), axis=0), kind="stable")[: options.gaussians]
    names = "scale_m", "rotation_xyzw"
    scale, rotation = (np.stack([getattr(cloud, name)[order] for cloud in clouds]) for name in names)
    if (scale == scale[:1]).all() and (rotation == rotation[:1]).all():
        scale, rotation = scale[:1], rotation[:1]
    log_scale, total, notes = np.log(np.maximum(scale, SMALLEST_M)), strength.shape[1], []
    if len(order) < total:
        text = f"the {len(order)} of {total} of the largest mean power over the stored transmitters"
        notes.append(f"Gaussians: {text} (option --max-gaussians).")
    return GaussiansContent(clouds[0].position_m[order], log_scale, rotation, strength[:, order], total), notes


def _no_gaussians(run: Run) -> list[str] | None:
    """Notes about a run whose Gaussians cannot be shown; None: they can."""
    if not run.metrics.get("gaussians"):
        return []
    if not (run.folder / SPLIT).exists():
        return [f"Gaussians: one field for each fold; view one of them, such as {run.folder / 'fold0'}."]
    if not isinstance(run.fitted, FittedField) or run.fitted.form.features:
        return ["Gaussians: their signals depend on the uplink, not on a transmitter's position."]
    return None


def run_scene(run: Run, frequency_hz: float) -> Any | None:
    """The scene of a run at a carrier in Hz, as its calibration left it; None where it has none."""
    corrected = run.folder / CORRECTED
    return open_scene(corrected, frequency_hz) if corrected.is_dir() else run.problem.open_scene(frequency_hz)


def paths_content(
    run: Run,
    rows: IntArray,
    tx_pos_m: FloatArray,
    scene: Any | None,
    limits: ViewOptions,
    on_stage: OnStage,
    progress: bool,
) -> tuple[PathsContent | None, list[str]]:
    """Paths of some rows at positions [t, 3], stored ones or traced in the run's scene, and notes."""
    if (run.folder / PATHS).exists():
        on_stage("reading paths", 0.0)
        traced, source = load_trace(run.folder / PATHS).of_transmitters(rows), "as stored in the run"
    elif scene is not None:
        on_stage("tracing paths", 0.0)
        # The options that the run's settings state, else those of `wrf_mi.tracing`.
        settings, record = run.config.settings, run.problem.record
        options = getattr(getattr(settings, "traced", settings), "options", None)
        options = options if isinstance(options, TraceOptions) else TraceOptions()
        traced = trace_paths(scene, tx_pos_m, record.receivers, options, progress, tx_antenna=record.tx_antenna)
        depth = traced.options.depth
        source = f"traced for this view in {run.config.scene}, at most {depth} interactions, {traced.rays} rays"
    else:
        return None, []
    layer = path_layer(traced, limits.paths)
    notes = [f"Paths: {source}."]
    if len(layer.tx) < len(traced.paths):
        text = f"the strongest {len(layer.tx)} of {len(traced.paths)}"
        notes.append(f"Paths: {text}, at most {limits.paths} of each transmitter to each receiver.")
    return layer, notes


def path_layer(traced: TraceResult, most: int) -> PathsContent:
    """The strongest ``most`` paths of each transmitter to each receiver."""
    paths = traced.paths
    gain_db = 20 * np.log10(np.maximum(np.abs(paths.gain), WEAKEST_GAIN))
    pair = paths.tx + paths.n_tx * paths.rx
    order = np.lexsort((-gain_db, pair))
    rank = np.arange(len(order)) - np.searchsorted(pair[order], pair[order])
    # Paths of each pair of devices that a page has room for.
    room = PATH_NUMBERS // (3 * (paths.interactions.shape[1] + 2) * max(1, paths.n_tx * paths.n_rx))
    strongest = np.sort(order[rank < min(most, max(1, room))])
    paths, gain_db = paths.select(strongest), gain_db[strongest]
    bounces = paths.bounces
    receivers_m = np.stack([receiver.position_m for receiver in traced.receivers])
    corners = [np.zeros((0, 3))]
    for tx, rx, vertices_m, count in zip(paths.tx, paths.rx, paths.vertices_m, bounces, strict=True):
        corners += [traced.tx_pos_m[[tx]], vertices_m[:count], receivers_m[[rx]]]
    codes, kind = np.unique(paths.interactions, axis=0, return_inverse=True)
    words = tuple(", ".join(KINDS[int(code)] for code in row if code) or "line of sight" for row in codes)
    kinds = kind.reshape(-1), words
    return PathsContent(paths.tx, paths.rx, bounces, *kinds, gain_db, paths.length_m, np.concatenate(corners))
