"""Measured signal strengths in a flat: the physics model, interpolation, trees and ray tracing."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import load, make_splits
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging, log_distance
from wrf_mi.models.interpolation.trees import Trees
from wrf_mi.models.physics.rssi import RssiSettings, fit_rssi
from wrf_mi.runs.api import train
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import abs_error_db, summary
from wrf_mi.tracing import open_scene

from .comparison import Row, compared, data_folder, line, listed, timed, verdicts

SEEDS = (0, 1, 2)
FEW = 64
NORMAL_90 = 1.6449
"""Half width of the normal distribution's 90 % interval, in standard deviations."""
HEIGHT_M = 2.7
"""Height of the ceiling, which is not in the data; one receiver is 2.62 m above the floor."""
PATHS = ("transmission=true", "max_depth=6", "max_reflections=2")
"""A wall of the layout is two surfaces, so three walls are six."""
CALIBRATED = (*PATHS, "calibration=gain,patterns")
Scored = tuple[FloatArray, FloatArray | None]
"""Absolute errors in dB, and 1 where the 90 % interval holds the truth, [n_rx, test rows] each; NaN: not received."""


def flat() -> dict[str, Any]:
    """Ray tracing with one offset per receiver, and calibrated by gradients, on the official test rows."""
    folder = data_folder("flat-ble")
    with tempfile.TemporaryDirectory() as work:
        scene = _scene(folder, work)

        def metrics(name: str, seed: int, settings: Sequence[str]) -> Any:
            run = train(folder, Path(work) / name, "ray-tracing", scene=scene, seed=seed, settings=settings)
            return read_run(run.folder).metrics

        alone = metrics("offsets", 0, PATHS)
        fitted = [metrics(f"calibrated{seed}", seed, CALIBRATED) for seed in SEEDS]
    offsets, calibrated = alone["abs_error_db"], [one["abs_error_db"] for one in fitted]
    what = "median absolute error with one offset per anchor (90th percentile)"
    rows = [
        line(what, f"{offsets['median']:.2f} dB ({offsets['p90']:.1f} dB)", "reference"),
        line("calibrated by gradients, three seeds", f"{listed(calibrated, 'median', 2)} dB", "below 3.8 dB"),
    ]
    seconds = {"trace": alone["trace_seconds"], "fit": float(np.mean([one["train_seconds"] for one in fitted]))}
    found = {"paths": alone["paths"], "offsets_alone_db": offsets, "calibrated_db": calibrated, "seconds": seconds}
    return {"rows": rows, **found}


def strengths(asked: str, n_train: int | None = None) -> dict[str, Any]:
    """Errors of every method on the official test rows, fitted to ``n_train`` seeded training rows (None: all).

    Returns:
        ``rows``; ``methods``: by name, for each seed quantiles of the error in dB and the share of test rows in the
        90 % interval; ``verdict``: paired differences of the physics model from each method; ``physics``: summaries.
    """
    folder = data_folder("flat-ble")
    record = load(folder)
    assert record.frequencies_hz is not None
    scored: dict[str, list[Scored]] = {}
    facts = []
    with tempfile.TemporaryDirectory() as work:
        made = _scene(folder, work)
        scene = open_scene(made, float(record.frequencies_hz[0]))
        for seed in SEEDS:
            (split,) = make_splits(record, "official", seed=seed, n_train=n_train)
            found = _interpolated(record, split)
            out = Path(work) / str(seed)
            train(record, out, "ray-tracing", scene=made, split=split, seed=seed, settings=CALIBRATED)
            found["ray tracing, calibrated"] = (
                abs_error_db(read_run(out).prediction, np.asarray(record.observation[:, split.test], float)),
                None,
            )
            found["physics without mesh"], _ = _physics(record, split, None)
            found["physics"], fact = _physics(record, split, scene)
            facts.append(fact)
            for name, errors in found.items():
                scored.setdefault(name, []).append(errors)
    scores = {name: [error for error, _ in each] for name, each in scored.items()}
    pairs = {name: compared(scores["physics"], each, SEEDS, "rssi") for name, each in scores.items()}
    methods = {name: [_figures(*one) for one in each] for name, each in scored.items()}
    rows: list[Row] = []
    for name, blocks in methods.items():
        value = f"{listed(blocks, 'median', 2)} dB (p90 {np.mean([one['p90'] for one in blocks]):.1f} dB)"
        if "inside_90" in blocks[0]:
            value += f"; {100 * np.mean([one['inside_90'] for one in blocks]):.0f} % in the 90 % interval"
        bound = asked if name == "physics" else f"physics is {verdicts(pairs[name])[0]}"
        rows.append(line(f"{name}, {len(split.all_train)} rows", value, bound))
    del pairs["physics"]
    verdict = {name: [pair.plain() for pair in each] for name, each in pairs.items()}
    counts = {"train": len(split.all_train), "test": len(split.test)}
    return {"rows": rows, **counts, "methods": methods, "verdict": verdict, "physics": facts}


all_rows = partial(strengths, "at most 3.1 dB; 80 to 95 %")
few_rows = partial(strengths, "at most 3.5 dB; 80 to 95 %", FEW)


def _scene(folder: Path, work: str) -> Path:
    return make_scene(folder / "layout.csv", Path(work) / "flat", height_m=HEIGHT_M).folder


def _interpolated(record: Record, split: Split) -> dict[str, Scored]:
    """Errors of the blend, of kriging without and with headings, and of trees with headings."""
    train, test, seed, task = split.all_train, split.test, split.seed, TASKS["rssi"]
    position, heading = record.tx_pos_m, record.tx_heading_rad
    assert heading is not None
    truth = np.asarray(record.observation[:, test], float)
    blend: list[Any] = []
    estimates: dict[str, list[Any]] = {"kriging": [], "kriging with heading": [], "trees with heading": []}
    for receiver, known in zip(record.receivers, np.asarray(record.observation[:, train], float), strict=True):
        idw = InverseDistance(task.neighbours, softening_m=task.softening_m)
        blend.append(idw.fit(position[train], known).predict(position[test]))
        trend = log_distance(receiver.position_m)
        kriging = Kriging(trend=trend, trend_fit="ols", seed=seed).fit(position[train], known)
        estimates["kriging"].append(kriging.estimate(position[test]))
        for name, model in (
            ("kriging with heading", Kriging(trend=trend, trend_fit="ols", seed=seed)),
            ("trees with heading", Trees(seed=seed)),
        ):
            fitted = model.fit(position[train], known, heading[train])
            estimates[name].append(fitted.estimate(position[test], heading[test]))
    return {"blend": (abs_error_db(blend, truth), None)} | {name: _scored(e, truth) for name, e in estimates.items()}


def _scored(estimates: Sequence[Any], truth: FloatArray) -> Scored:
    error = abs_error_db([one.mean for one in estimates], truth)
    std = np.array([one.std for one in estimates])
    return error, np.where(np.isnan(error), np.nan, error <= NORMAL_90 * std)


def _physics(record: Record, split: Split, scene: Any | None) -> tuple[Scored, dict[str, Any]]:
    assert record.tx_heading_rad is not None
    position, heading = record.tx_pos_m[split.test], record.tx_heading_rad[split.test]
    receivers = range(len(record.receivers))
    model, estimates, times = timed(
        lambda: fit_rssi(record, split.all_train, scene, RssiSettings(), split.seed),
        lambda model: [model.predict(position, receiver, heading) for receiver in receivers],
        lambda model, row: model.predict(position[row], 0, heading[row : row + 1]),
        len(position) * len(receivers),
    )
    return _scored(estimates, np.asarray(record.observation[:, split.test], float)), times | model.summary()


def _figures(error: FloatArray, inside: FloatArray | None) -> Mapping[str, float]:
    return summary(error) | ({} if inside is None else {"inside_90": float(np.nanmean(inside))})
