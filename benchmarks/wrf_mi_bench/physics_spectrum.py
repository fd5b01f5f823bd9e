"""Measured spectra without a mesh: the physics model beside interpolation, kriging and the best training row in
hindsight."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import load, make_splits
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.runs.api import train
from wrf_mi.runs.paired import agreed, paired_difference
from wrf_mi.runs.results import Results, read_run
from wrf_mi.tasks.scores import ssim, summary

SEEDS = (0, 1, 2)
LENGTH_M, NOISE = 0.1, 0.02
"""Of the kriging that was measured first on these data; what the likelihood chooses scores within 0.005."""
ALIKE = 7
"""Every so many pixels count where the most similar training row is looked for; SSIM then decides among the best."""
CLOSEST = 12

Scores = Mapping[str, FloatArray]


def spectra(record: Record, split: str, seeds: Sequence[int] = SEEDS) -> dict[str, Any]:
    """Scores of the physics model and of what is simpler on the test rows of a split, all folds pooled.

    Args:
        record: of spectra.
        split: see `wrf_mi.datasets.make_splits`.
        seeds: of the physics model's fit.

    Returns:
        ``methods``: quantiles of SSIM by name; ``physics``: one for each seed, with coverage, seconds and milliseconds;
        ``against``: by method the paired comparisons, and the verdicts on which all seeds agree.
    """
    simple = _simple(record, split)
    runs = []
    for seed in seeds:
        with tempfile.TemporaryDirectory() as work:
            run = train(record, Path(work) / "run", "physics", split=split, seed=seed)
            runs.append(read_run(run.folder, "physics"))
    row = runs[0].row
    methods = {name: values[row] for name, values in simple.items()}
    methods["blend of 4 nearest"] = runs[0].reference_score[0]
    against = {}
    for name, values in methods.items():
        pairs = [paired_difference(r.score[0], values, seed, "spectrum") for r, seed in zip(runs, seeds, strict=True)]
        against[name] = {
            "pairs": [pair.plain() for pair in pairs],
            "medians": agreed(pair.verdict for pair in pairs),
            "means": agreed(pair.mean_verdict for pair in pairs),
        }
    return {
        "split": split,
        "methods": {name: summary(values) for name, values in methods.items()},
        "physics": [_facts(run) for run in runs],
        "against": against,
    }


def _facts(run: Results) -> dict[str, Any]:
    kept = ("inside_90", "train_seconds", "ms_per_sample", "peak_memory_mb", "fitted")
    return {"ssim": summary(run.score), **{key: run.metrics[key] for key in kept}}


def _simple(record: Record, split: str) -> Scores:
    """SSIM of each row of a record by methods without a model of waves; NaN where a row is in no test set."""
    spectra = record.observation[0]
    names = ("kriging", "mean of the training rows", "best training row in hindsight")
    found = {name: np.full(len(record), np.nan) for name in names}
    for rows in make_splits(record, split, 0):
        known, test = rows.all_train, rows.test
        kriging = Kriging(LENGTH_M, NOISE).fit(record.tx_pos_m[known], spectra[known]).predict(record.tx_pos_m[test])
        found["kriging"][test] = ssim(kriging, spectra[test])
        mean = np.broadcast_to(spectra[known].mean(axis=0), spectra[test].shape)
        found["mean of the training rows"][test] = ssim(mean, spectra[test])
        found["best training row in hindsight"][test] = [_best(spectra[known], spectra[row]) for row in test]
    return found


def _best(known: Any, truth: Any) -> float:
    """SSIM of the training row that is most like the answer: a bound for copying, not a method."""
    apart = np.square((known - truth)[:, ::ALIKE, ::ALIKE]).sum(axis=(1, 2))
    closest = known[np.argsort(apart)[:CLOSEST]]
    return float(ssim(closest, np.broadcast_to(truth, closest.shape)).max())


def rfid_lab() -> dict[str, Any]:
    """The comparison on rfid-lab, with rows for the table.

    Raises:
        InputError: the data are not on this machine.
    """
    record = load("rfid-lab")
    official, blocked = (spectra(record, split) for split in ("official", "blocked"))
    rows = []
    asked = {"official": "better than the blend, or a tie; aim 0.985", "blocked": "better than all, 0.69; aim 0.78"}
    for figures in (official, blocked):
        medians = ", ".join(f"{one['ssim']['median']:.3f}" for one in figures["physics"])
        means = ", ".join(f"{one['ssim']['mean']:.3f}" for one in figures["physics"])
        name = figures["split"]
        rows.append({"what": f"{name}, median SSIM (mean)", "value": f"{medians} ({means})", "asked": asked[name]})
        for other, score in figures["methods"].items():
            verdicts = figures["against"][other]
            text = f"{score['median']:.3f} ({score['mean']:.3f}): physics {verdicts['medians']} by medians"
            rows.append({"what": f"{name}, {other}", "value": f"{text}, {verdicts['means']} by means", "asked": ""})
    inside = ", ".join(f"{one['inside_90']:.0%}" for f in (official, blocked) for one in f["physics"])
    slowest = max(one["ms_per_sample"] for f in (official, blocked) for one in f["physics"])
    longest = max(one["train_seconds"] for one in official["physics"])
    rows += [
        {"what": "pixels inside the predicted 90 % interval", "value": inside, "asked": "80 to 95 %"},
        {"what": "one prediction", "value": f"{slowest:.1f} ms", "asked": "5 ms"},
        {"what": "fit on 160 spectra", "value": f"{longest:.0f} s", "asked": "10 minutes"},
    ]
    return {"rows": rows, "splits": [official, blocked]}
