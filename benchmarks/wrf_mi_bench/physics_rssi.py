"""Measured signal strengths in a flat: the physics model beside interpolation, kriging, trees and calibrated ray
tracing."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import InputError, Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.datasets import load, make_splits
from wrf_mi.datasets.registry import locate
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging, log_distance
from wrf_mi.models.interpolation.trees import Trees
from wrf_mi.models.physics.rssi import RssiSettings, fit_rssi
from wrf_mi.runs.api import train
from wrf_mi.runs.paired import agreed, paired_difference
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene
from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import abs_error_db
from wrf_mi.tracing import open_scene

from .calibration import CALIBRATED, HEIGHT_M

SEEDS = (0, 1, 2)
FEW = 64
NORMAL_90 = 1.6449
"""Half the width of the normal distribution's 90 % interval, in standard deviations."""
HYBRID = "physics"
Scored = dict[str, tuple[FloatArray, FloatArray | None]]
"""By method: absolute errors in dB and whether the 90 % interval holds the truth, [n_rx, test rows] each."""


def flat_strengths(
    folder: str | Path, n_train: int | None = None, seeds: Sequence[int] = SEEDS, ray_tracing: bool = True
) -> dict[str, Any]:
    """Fit every method to training rows of the flat-ble data and score it on the official test rows.

    Args:
        folder: the data set, with ``layout.csv``.
        n_train: so many seeded training rows; None: all.
        seeds: of the subset and of what is drawn.
        ray_tracing: whether calibrated ray tracing is among the methods; it takes most of the time.

    Returns:
        ``methods``: by name, for each seed median, mean and 90th percentile of the error in dB and the share of test
        rows in the 90 % interval; ``verdict``: of the physics model against each other method; ``physics``:
        summaries, seconds.
    """
    record = load(folder)
    methods: dict[str, list[dict[str, float]]] = {}
    verdict: dict[str, list[dict[str, Any]]] = {}
    facts = []
    with tempfile.TemporaryDirectory() as work:
        made = make_scene(Path(folder) / "layout.csv", Path(work) / "flat", height_m=HEIGHT_M).folder
        assert record.frequencies_hz is not None
        scene = open_scene(made, float(record.frequencies_hz[0]))
        for seed in seeds:
            (split,) = make_splits(record, "official", seed=seed, n_train=n_train)
            train, test = split.all_train, split.test
            scored = _simple(record, train, test, seed)
            if ray_tracing:
                scored["ray tracing, calibrated"] = (_calibrated(record, split, made, Path(work) / str(seed)), None)
            ours, fact = _physics(record, train, test, scene, seed)
            facts.append(fact)
            scored["physics without mesh"], _ = _physics(record, train, test, None, seed)
            for name, (error, inside) in scored.items():
                compared = paired_difference(ours[0], error, seed, "rssi")
                verdict.setdefault(name, []).append(compared.plain())
                methods.setdefault(name, []).append(_figures(error, inside))
            methods.setdefault(HYBRID, []).append(_figures(*ours))
    return {
        "train": len(train),
        "test": len(test),
        "methods": methods,
        "verdict": verdict,
        "physics": facts,
    }


def _simple(record: Record, train: IntArray, test: IntArray, seed: int) -> Scored:
    """Blend, kriging without and with headings, trees with headings."""
    position, heading = record.tx_pos_m, record.tx_heading_rad
    assert heading is not None
    task = TASKS["rssi"]
    truth = np.asarray(record.observation[:, test], float)
    known = np.asarray(record.observation[:, train], float)
    blend = [
        InverseDistance(task.neighbours, softening_m=task.softening_m).fit(position[train], own).predict(position[test])
        for own in known
    ]
    scored: Scored = {"blend": (abs_error_db(blend, truth), None)}
    estimates: dict[str, list[Any]] = {"kriging": [], "kriging with heading": [], "trees with heading": []}
    for receiver, own in zip(record.receivers, known, strict=True):
        for name, given in (("kriging", None), ("kriging with heading", heading)):
            trend = log_distance(receiver.position_m)
            fitted = Kriging(trend=trend, trend_fit="ols", seed=seed).fit(
                position[train], own, None if given is None else given[train]
            )
            estimates[name].append(fitted.estimate(position[test], None if given is None else given[test]))
        trees = Trees(seed=seed).fit(position[train], own, heading[train])
        estimates["trees with heading"].append(trees.estimate(position[test], heading[test]))
    return scored | {name: _scored(own, truth) for name, own in estimates.items()}


def _scored(estimates: Sequence[Any], truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Absolute errors, and 1 where the 90 % interval holds the truth, 0 where not, NaN where nothing was received."""
    error = abs_error_db([one.mean for one in estimates], truth)
    std = np.array([one.std for one in estimates])
    return error, np.where(np.isnan(error), np.nan, error <= NORMAL_90 * std)


def _physics(
    record: Record, train: IntArray, test: IntArray, scene: Any | None, seed: int
) -> tuple[tuple[FloatArray, FloatArray], dict[str, Any]]:
    assert record.tx_heading_rad is not None
    start = time.perf_counter()
    model = fit_rssi(record, train, scene, RssiSettings(), seed)
    fitted = time.perf_counter()
    position, heading = record.tx_pos_m[test], record.tx_heading_rad[test]
    estimates = [model.predict(position, receiver, heading) for receiver in range(len(record.receivers))]
    predicted = time.perf_counter()
    alone = []
    for row in range(min(20, len(test))):
        once = time.perf_counter()
        model.predict(position[row], 0, heading[row : row + 1])
        alone.append(time.perf_counter() - once)
    seconds = {
        "fit_seconds": fitted - start,
        "predict_ms_each": 1e3 * (predicted - fitted) / len(test) / len(record.receivers),
        "predict_ms_alone": 1e3 * float(np.median(alone)),
    }
    return _scored(estimates, np.asarray(record.observation[:, test], float)), {**seconds, **model.summary()}


def _calibrated(record: Record, split: Split, scene: Path, out: Path) -> FloatArray:
    """Errors of ray tracing with gains and patterns fitted, as in `bench_calibration`."""
    own: dict[str, Any] = {"scene": scene, "split": split, "seed": split.seed, "settings": CALIBRATED}
    train(record, out, "ray-tracing", **own)
    return abs_error_db(read_run(out).prediction, np.asarray(record.observation[:, split.test], float))


def _figures(error: FloatArray, inside: FloatArray | None) -> dict[str, float]:
    median, p90 = np.nanpercentile(error, [50, 90])
    figures = {"median": float(median), "mean": float(np.nanmean(error)), "p90": float(p90)}
    return figures if inside is None else figures | {"inside_90": float(np.nanmean(inside))}


def _table(figures: Mapping[str, Any], asked: str) -> list[dict[str, str]]:
    rows = []
    for name, seeds in figures["methods"].items():
        value = ", ".join(f"{one['median']:.2f}" for one in seeds) + " dB"
        value += f" (p90 {np.mean([one['p90'] for one in seeds]):.1f} dB)"
        if "inside_90" in seeds[0]:
            value += f"; {100 * np.mean([one['inside_90'] for one in seeds]):.0f} % in the 90 % interval"
        held = asked
        if name != HYBRID:
            held = f"physics is {agreed(one['verdict'] for one in figures['verdict'][name])}"
        rows.append({"what": f"{name}, {figures['train']} rows", "value": value, "asked": held})
    return rows


def _measure(n_train: int | None, asked: str) -> dict[str, Any]:
    folder = locate("flat-ble")
    if folder is None:
        raise InputError("flat-ble: not on this machine; run `wrf-mi data fetch flat-ble`")
    figures = flat_strengths(folder, n_train)
    return {"rows": _table(figures, asked), **figures}


def all_rows() -> dict[str, Any]:
    """Median absolute error from all training rows, three seeds.

    Raises:
        InputError: the data are not on this machine.
    """
    return _measure(None, "at most 3.1 dB; 80 to 95 %")


def few_rows() -> dict[str, Any]:
    """The same from 64 of them.

    Raises:
        InputError: the data are not on this machine.
    """
    return _measure(FEW, "at most 3.5 dB; 80 to 95 %")
