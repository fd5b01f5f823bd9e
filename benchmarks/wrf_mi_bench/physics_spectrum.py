"""Measured spectra without a mesh: the physics model, interpolation, and the best training row in hindsight."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import load, make_splits
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.runs.api import train
from wrf_mi.runs.results import read_run
from wrf_mi.tasks.scores import ssim, summary

from .comparison import compared, line, listed, verdicts

SEEDS = (0, 1, 2)
LENGTH_M, NOISE = 0.1, 0.02
"""Settings of kriging; maximum likelihood scores within 0.005."""
ALIKE = 7
"""Stride of the pixels by which the most similar training rows are found; SSIM decides among the `CLOSEST`."""
CLOSEST = 12
KEPT = ("inside_90", "train_seconds", "ms_per_sample", "peak_memory_mb", "fitted")
ASKED = {"official": "better than the blend, or a tie; aim 0.985", "blocked": "better than all, 0.69; aim 0.78"}


def spectra(record: Record, split: str) -> dict[str, Any]:
    """SSIM of the physics model and of simpler methods on the test rows of a split, all folds pooled.

    Returns:
        ``methods``: quantiles of SSIM by name; ``physics``: for each seed quantiles, coverage and times; ``against``:
        by method the paired differences, and the verdicts on which all seeds agree.
    """
    runs = []
    for seed in SEEDS:
        with tempfile.TemporaryDirectory() as work:
            run = train(record, Path(work) / "run", "physics", split=split, seed=seed)
            runs.append(read_run(run.folder, "physics"))
    methods = {name: values[runs[0].row] for name, values in _simple(record, split).items()}
    methods["blend of 4 nearest"] = runs[0].reference_score[0]
    against = {}
    for name, values in methods.items():
        pairs = compared([run.score[0] for run in runs], [values] * len(runs), SEEDS, "spectrum")
        medians, means = verdicts(pairs)
        against[name] = {"pairs": [pair.plain() for pair in pairs], "medians": medians, "means": means}
    return {
        "split": split,
        "methods": {name: summary(values) for name, values in methods.items()},
        "physics": [{"ssim": summary(run.score), **{key: run.metrics[key] for key in KEPT}} for run in runs],
        "against": against,
    }


def _simple(record: Record, split: str) -> Mapping[str, FloatArray]:
    """SSIM of each row of a record by methods without a model of waves; NaN for rows in no test set."""
    spectra = record.observation[0]
    names = ("kriging", "mean of the training rows", "best training row in hindsight")
    found = {name: np.full(len(record), np.nan) for name in names}
    for rows in make_splits(record, split, 0):
        known, test = rows.all_train, rows.test
        kriging = Kriging(LENGTH_M, NOISE).fit(record.tx_pos_m[known], spectra[known]).predict(record.tx_pos_m[test])
        mean = np.broadcast_to(spectra[known].mean(axis=0), spectra[test].shape)
        best = [_best(spectra[known], spectra[row]) for row in test]
        for name, scores in zip(names, (ssim(kriging, spectra[test]), ssim(mean, spectra[test]), best), strict=True):
            found[name][test] = scores
    return found


def _best(known: Any, truth: Any) -> float:
    """SSIM of the training row most similar to the truth: an upper bound for copying a training row."""
    apart = np.square((known - truth)[:, ::ALIKE, ::ALIKE]).sum(axis=(1, 2))
    closest = known[np.argsort(apart)[:CLOSEST]]
    return float(ssim(closest, np.broadcast_to(truth, closest.shape)).max())


def rfid_lab() -> dict[str, Any]:
    """Comparison on both splits of rfid-lab, with rows for the table."""
    record = load("rfid-lab")
    splits = [spectra(record, split) for split in ASKED]
    rows, runs = [], [one for figures in splits for one in figures["physics"]]
    for figures in splits:
        name, scores = figures["split"], [one["ssim"] for one in figures["physics"]]
        value = f"{listed(scores, 'median', 3)} ({listed(scores, 'mean', 3)})"
        rows.append(line(f"{name}, median SSIM (mean)", value, ASKED[name]))
        for other, score in figures["methods"].items():
            against = figures["against"][other]
            text = f"{score['median']:.3f} ({score['mean']:.3f}): physics {against['medians']} by medians"
            rows.append(line(f"{name}, {other}", f"{text}, {against['means']} by means"))
    inside = ", ".join(f"{one['inside_90']:.0%}" for one in runs)
    longest = max(one["train_seconds"] for one in splits[0]["physics"])
    rows += [
        line("pixels inside the predicted 90 % interval", inside, "80 to 95 %"),
        line("one prediction", f"{max(one['ms_per_sample'] for one in runs):.1f} ms", "5 ms"),
        line("fit on 160 spectra", f"{longest:.0f} s", "10 minutes"),
    ]
    return {"rows": rows, "splits": splits}
