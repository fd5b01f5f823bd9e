"""Complex channels in two CAD rooms known from simulated scans: the physics model, interpolation, ray tracing and a
learned field."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from wrf_mi.core import Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.files import write_arrays
from wrf_mi.core.settings import with_settings
from wrf_mi.core.types import IntArray
from wrf_mi.datasets.newrf import read_newrf
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.models.physics.csi import CsiSettings, fit_csi
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks.scores import cea_db, summary
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.training.config import default_config
from wrf_mi.training.trainer import Trainer

from .comparison import Row, compared, line, listed, room_file, timed, verdicts
from .scene import clear_of_walls, scanned_points

SEEDS = (1, 2, 3)
"""Seeds of the scan's noise and of the fits."""
POSES = 6
RAYS = 1 << 20
SCANNED = "scene"
"""Folder of the scene that `scanned_scene` makes."""
LEARNED = (
    *("steps=1000", "holdout_steps_fraction=0", "patience=0", "batch=16", "initial.gaussians=150"),
    *("initial.size_deg=10", "encoding.position_octaves=6", "encoding.tx_octaves=6", "encoding.tx_scale_m=4"),
    "optimiser.ema_decay=0.99",
)
"""Settings of the learned field."""

Complex = NDArray[np.complex128]


def channels(name: str) -> dict[str, Any]:
    """Channel estimation accuracy (CEA, dB) of every method on the official held-out receivers of a room.

    The room's own mesh serves for the simulated scan only; methods use the mesh made of the scan. All reflections are
    perfect, as in the data.

    Returns:
        ``rows``; ``methods``: by name, for each seed quantiles of the accuracy in dB; ``verdict``: paired differences
        of the physics model from each other method; ``physics``: summary and times of each fit, and the share of
        errors within two standard deviations.
    """
    room = room_file(name)
    record = read_newrf(room)
    assert record.official is not None
    train, test = record.official
    truth = record.observation[0, test].astype(complex)
    here, there, observed = record.tx_pos_m[train], record.tx_pos_m[test], record.observation[0, train]
    constant = {
        "blend of 4 neighbours": np.asarray(InverseDistance(k=4).fit(here, observed).predict(there), complex),
        "kriging": np.asarray(Kriging().fit(here, observed).predict(there), complex),
        "line of sight and diffuse field": fit_csi(record, train, None).predict(there, 0).mean,
    }
    scores: dict[str, list[FloatArray]] = {}
    facts = []
    for seed in SEEDS:
        predictions = dict(constant)
        predictions["learned field alone"] = _learned(record, train, test, seed)
        with tempfile.TemporaryDirectory() as work:
            scene = scanned_scene(room, Path(work), seed)
            predictions |= _traced(record, train, test, scene, seed)
            model, estimate, times = timed(
                partial(fit_csi, record, train, scene, CsiSettings(), seed),
                lambda model: model.predict(there, 0),
                lambda model, row: model.predict(there[row], 0),
                len(test),
            )
        predictions["physics"] = estimate.mean
        within = np.abs(estimate.mean - truth) < 2 * estimate.stated_std
        facts.append({**times, "within_two_std": float(within.mean()), **model.summary()})
        for method, values in predictions.items():
            scores.setdefault(method, []).append(cea_db(values, truth))
    methods = {method: [_figures(one) for one in each] for method, each in scores.items()}
    others = {method: each for method, each in scores.items() if method != "physics"}
    pairs = {method: compared(scores["physics"], each, SEEDS, "csi") for method, each in others.items()}
    rows: list[Row] = []
    for method, blocks in methods.items():
        value = f"{listed(blocks, 'median', 1)} dB ({listed(blocks, 'p10', 1)} dB)"
        if method in pairs:
            median, mean = verdicts(pairs[method])
            value += f"; the physics model is {median} by the median, {mean} by the mean"
        asked = "3 dB above all others, aim 20 dB" if method == "physics" else "reference"
        rows.append(line(f"{room.stem}, {method}: median CEA, three scans (10th percentile)", value, asked))
    each_ms = ", ".join(f"{one['predict_ms_each']:.1f} ({one['predict_ms_alone']:.1f})" for one in facts)
    rows += [
        line(f"{room.stem}, fit of the physics model", f"{listed(facts, 'fit_seconds', 0)} s", "300 s"),
        line(f"{room.stem}, a position among many (alone)", f"{each_ms} ms", "5 ms"),
    ]
    counts = {"room": room.stem, "train": len(train), "test": len(test)}
    verdict = {method: [pair.plain() for pair in each] for method, each in pairs.items()}
    return {"rows": rows, **counts, "methods": methods, "verdict": verdict, "physics": facts}


conference, office = partial(channels, "conference"), partial(channels, "office")


def scanned_scene(room: Path, work: Path, seed: int) -> Any:
    """The room as a scene made of a simulated scan from `POSES` poses, stored in the folder `SCANNED` of ``work``."""
    points, frequency_hz = scanned_points(room, POSES, seed=seed)
    scan = write_arrays(work / "scan.npz", {"points": points})
    return open_scene(make_scene(scan, work / SCANNED).folder, frequency_hz)


def _learned(record: Record, train: IntArray, test: IntArray, seed: int) -> Complex:
    """Channels of WRF-GS+ without a mesh."""
    config = with_settings(default_config(record.task), [*LEARNED, f"seed={seed}"])
    trainer = Trainer(record, Split("official", seed, train, train[:0], test), config)
    trainer.run()
    return np.asarray(trainer.predictor()(record.tx_pos_m[test]), complex)


def _traced(record: Record, train: IntArray, test: IntArray, scene: Any, seed: int) -> dict[str, Complex]:
    """Ray tracing on the scanned mesh, without and with a complex factor fitted to the training rows."""
    rows, observed = np.concatenate([train, test]), record.observation[0, train]
    # An antenna on a wall may lie behind the noisy wall of the scan.
    position_m = clear_of_walls(record.receivers[0].position_m, record.tx_pos_m, scene_surfaces(scene).triangles)
    image = fit_csi(record, train[:0], scene, CsiSettings(), seed).predict(record.tx_pos_m[rows], 0).mean
    found = {"ray tracing": _tracer(record, rows, scene, position_m, seed), "image method, antenna on its wall": image}
    result: dict[str, Complex] = {}
    for name, values in found.items():
        known, unknown = values[: len(train)], values[len(train) :]
        factor = (known.conj() * observed).sum() / max(float(np.square(np.abs(known)).sum()), 1e-300)
        result |= {name: unknown, f"{name}, complex factor fitted": factor * unknown}
    return result


def _tracer(record: Record, rows: IntArray, scene: Any, position_m: FloatArray, seed: int) -> Complex:
    """Channels by ray tracing with perfect reflections, two at most."""
    assert record.frequencies_hz is not None
    receiver = replace(record.receivers[0], position_m=position_m)
    options = TraceOptions(max_depth=2, rays=RAYS, seed=seed)
    paths = trace_paths(scene, record.tx_pos_m[rows], receiver, options).paths
    k = 2 * np.pi * record.frequencies_hz / speed_of_light
    gain = np.exp(-1j * k * paths.length_m[:, None]) / (2 * k * paths.length_m[:, None])
    channel = np.zeros((len(rows), len(k)), complex)
    np.add.at(channel, paths.tx, gain)
    return channel


def _figures(values: FloatArray) -> dict[str, float]:
    return summary(values) | {f"above_{level}_db": float((values > level).mean()) for level in (10, 20, 30)}
