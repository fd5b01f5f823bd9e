"""Complex channels in two CAD rooms known from simulated scans alone: the physics model beside all that is simpler."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.files import write_arrays
from wrf_mi.core.settings import with_settings
from wrf_mi.core.types import IntArray
from wrf_mi.datasets.newrf import read_newrf
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.models.physics.csi import CsiSettings, fit_csi
from wrf_mi.runs.paired import paired_difference
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.scan import RANGE_NOISE_M, simulate_scan
from wrf_mi.tasks.scores import cea_db
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.training.config import default_config
from wrf_mi.training.trainer import Trainer

from .scene import CLEAR_M, SCANNER_CLEAR_M, SCANNER_HEIGHTS_M, _clearance, spread
from .trace import room_file

SEEDS = (1, 2, 3)
"""Of the scan's noise and of the fits."""
POSES = 6
RAYS = 1 << 20
SCANNED = "scene"
"""Folder of the scene that `scanned_scene` makes."""
STEPS = 1000
LEARNED = (
    "holdout_steps_fraction=0",
    "patience=0",
    "batch=16",
    "initial.gaussians=150",
    "initial.size_deg=10",
    "encoding.position_octaves=6",
    "encoding.tx_octaves=6",
    "encoding.tx_scale_m=4",
    "optimiser.ema_decay=0.99",
)
"""Settings of the learned field alone."""

Complex = NDArray[np.complex128]


def channels(room: str | Path, seeds: Sequence[int] = SEEDS, learned_steps: int = STEPS) -> dict[str, Any]:
    """Channel estimation accuracy on the official held-out receivers of a room, for every method.

    The room's own mesh serves for the simulated scan and nothing else; what is used is the mesh made of the scan. All
    mirrors are perfect, as in the data.

    Args:
        room: ``<room>.npz`` with ``<room>.stl`` beside it (see `wrf_mi.datasets.newrf`).
        seeds: one scan and one fit each.
        learned_steps: of the learned field's fit.

    Returns:
        ``methods``: by name, for each seed quantiles of the accuracy in dB; ``verdict``: of the physics model against
        each other method for each seed; ``physics``: summaries, seconds of a fit, milliseconds of a prediction, how
        many of the errors lie within two standard deviations.
    """
    record = read_newrf(room)
    assert record.official is not None
    train, test = record.official
    truth = record.observation[0, test].astype(complex)
    methods: dict[str, list[FloatArray]] = {}
    facts = []
    constant = _without_scan(record, train, test)
    for seed in seeds:
        predictions = dict(constant)
        predictions["learned field alone"] = learned_field_alone(record, train, test, seed, learned_steps)
        with tempfile.TemporaryDirectory() as work:
            scene = scanned_scene(room, Path(work), seed)
            predictions |= _traced(record, train, test, scene, seed)
            start = time.perf_counter()
            model = fit_csi(record, train, scene, CsiSettings(), seed)
            fitted = time.perf_counter()
        estimate = model.predict(record.tx_pos_m[test], 0)
        predicted = time.perf_counter()
        alone = []
        for position in record.tx_pos_m[test[:20]]:
            once = time.perf_counter()
            model.predict(position, 0)
            alone.append(time.perf_counter() - once)
        predictions["physics"] = estimate.mean
        within = np.abs(estimate.mean - truth) < 2 * estimate.stated_std
        facts.append(
            {
                "fit_seconds": fitted - start,
                "predict_ms_each": 1e3 * (predicted - fitted) / len(test),
                "predict_ms_alone": 1e3 * float(np.median(alone)),
                "within_two_std": float(within.mean()),
                **model.summary(),
            }
        )
        for name, values in predictions.items():
            methods.setdefault(name, []).append(cea_db(values, truth))
    ours = methods["physics"]
    verdict = {
        name: [paired_difference(a, b, seed, "csi").plain() for a, b, seed in zip(ours, scores, seeds, strict=True)]
        for name, scores in methods.items()
        if name != "physics"
    }
    return {
        "room": Path(room).stem,
        "train": len(train),
        "test": len(test),
        "methods": {name: [_quantiles(one) for one in scores] for name, scores in methods.items()},
        "verdict": verdict,
        "physics": facts,
    }


def scanned_scene(room: str | Path, work: Path, seed: int, range_noise_m: float = RANGE_NOISE_M) -> Any:
    """The room as a scene made of a simulated scan from `POSES` places, stored in the folder `SCANNED` of ``work``."""
    file = Path(room)
    record = read_newrf(file)
    assert record.frequencies_hz is not None
    frequency_hz = float(record.frequencies_hz[0])
    original = open_scene(file.with_suffix(".stl"), frequency_hz, material=PERFECT)
    moving = record.tx_pos_m
    high = (moving[:, 2] > SCANNER_HEIGHTS_M[0]) & (moving[:, 2] < SCANNER_HEIGHTS_M[1])
    stands = spread(moving[high & (_clearance(scene_surfaces(original).triangles)(moving) > SCANNER_CLEAR_M)], POSES)
    points = simulate_scan(original.mi_scene, stands, range_noise_m=range_noise_m, seed=seed)
    scan = write_arrays(work / "scan.npz", {"points": points})
    return open_scene(make_scene(scan, work / SCANNED).folder, frequency_hz)


def learned_field_alone(record: Record, train: IntArray, test: IntArray, seed: int, steps: int = STEPS) -> Complex:
    """What a WRF-GS+ field learns without a mesh."""
    config = with_settings(default_config(record.task), [*LEARNED, f"seed={seed}", f"steps={steps}"])
    trainer = Trainer(record, Split("official", seed, train, train[:0], test), config)
    trainer.run()
    return np.asarray(trainer.predictor()(record.tx_pos_m[test]), complex)


def _without_scan(record: Record, train: IntArray, test: IntArray) -> dict[str, Complex]:
    here, there, observed = record.tx_pos_m[train], record.tx_pos_m[test], record.observation[0, train]
    nothing = fit_csi(record, train, None).predict(there, 0).mean
    return {
        "blend of 4 neighbours": np.asarray(InverseDistance(k=4).fit(here, observed).predict(there), complex),
        "kriging": np.asarray(Kriging().fit(here, observed).predict(there), complex),
        "line of sight and diffuse field": nothing,
    }


def _traced(record: Record, train: IntArray, test: IntArray, scene: Any, seed: int) -> dict[str, Complex]:
    """Ray tracing on the scanned mesh, as it is and with a complex factor fitted to the training rows."""
    everyone = np.concatenate([train, test])
    clear = _clearance(scene_surfaces(scene).triangles)
    place = record.receivers[0].position_m.astype(float)
    while clear(place[None])[0] < CLEAR_M:  # an antenna on a wall may lie behind the noisy one
        inwards = record.tx_pos_m.mean(axis=0) - place
        place = place + 0.02 * inwards / np.linalg.norm(inwards)
    traced = _tracer(record, everyone, scene, place, seed)
    image = fit_csi(record, train[:0], scene, CsiSettings(), seed).predict(record.tx_pos_m[everyone], 0).mean
    found = {"ray tracing": traced, "image method, antenna on its wall": image}
    result = {}
    for name, values in found.items():
        own, observed = values[: len(train)], record.observation[0, train]
        factor = (own.conj() * observed).sum() / max(float(np.square(np.abs(own)).sum()), 1e-300)
        result[name] = values[len(train) :]
        result[f"{name}, complex factor fitted"] = factor * values[len(train) :]
    return result


def _tracer(record: Record, rows: IntArray, scene: Any, place_m: FloatArray, seed: int) -> Complex:
    """Channels by `wrf_mi.tracing`, perfect mirrors, up to two reflections."""
    assert record.frequencies_hz is not None
    receiver: Receiver = replace(record.receivers[0], position_m=place_m)
    options = TraceOptions(max_depth=2, rays=RAYS, seed=seed)
    paths = trace_paths(scene, record.tx_pos_m[rows], receiver, options).paths
    k = 2 * np.pi * record.frequencies_hz / speed_of_light
    gain = np.exp(-1j * k * paths.length_m[:, None]) / (2 * k * paths.length_m[:, None])
    channel = np.zeros((len(rows), len(k)), complex)
    np.add.at(channel, paths.tx, gain)
    return channel


def _quantiles(values: FloatArray) -> dict[str, float]:
    p10, median, p90 = np.percentile(values, [10, 50, 90])
    above = {f"above_{level}_db": float((values > level).mean()) for level in (10, 20, 30)}
    return {"median": float(median), "p10": float(p10), "p90": float(p90), **above}


def _rows(figures: Mapping[str, Any]) -> list[dict[str, str]]:
    """Of the benchmark's table."""
    rows = []
    for name, scores in figures["methods"].items():
        medians = ", ".join(f"{one['median']:.1f}" for one in scores)
        lows = ", ".join(f"{one['p10']:.1f}" for one in scores)
        verdict = ""
        if name in figures["verdict"]:
            median, mean = (_agreed(figures["verdict"][name], key) for key in ("verdict", "mean_verdict"))
            verdict = f"; the physics model is {median} by the median, {mean} by the mean"
        asked = "3 dB above all others, aim 20 dB" if name == "physics" else "reference"
        what = f"{figures['room']}, {name}: median CEA, three scans (10th percentile)"
        rows.append({"what": what, "value": f"{medians} dB ({lows} dB){verdict}", "asked": asked})
    times = ", ".join(f"{one['fit_seconds']:.0f}" for one in figures["physics"])
    each = ", ".join(f"{one['predict_ms_each']:.1f} ({one['predict_ms_alone']:.1f})" for one in figures["physics"])
    rows.append({"what": f"{figures['room']}, fit of the physics model", "value": f"{times} s", "asked": "300 s"})
    what = f"{figures['room']}, a position among many (alone)"
    rows.append({"what": what, "value": f"{each} ms", "asked": "5 ms"})
    return rows


def _agreed(verdicts: Sequence[Mapping[str, Any]], key: str) -> str:
    """What all seeds say, or a tie."""
    kinds = {one[key] for one in verdicts}
    return str(kinds.pop()) if len(kinds) == 1 else "tie"


def conference() -> dict[str, Any]:
    """The conference room, for the benchmark."""
    figures = channels(room_file("conference"))
    return {"rows": _rows(figures), **figures}


def office() -> dict[str, Any]:
    """The office, for the benchmark."""
    figures = channels(room_file("office"))
    return {"rows": _rows(figures), **figures}
