"""Spectra in a furnished room of which models know the bare walls: the physics model, kriging, ray tracing, WRF-GS+;
and WRF-GS+ from several starts."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.runs.api import train
from wrf_mi.runs.results import Results, read_run
from wrf_mi.synthetic.furnished_room import traced_room
from wrf_mi.synthetic.laboratory import SCAN
from wrf_mi.tasks.scores import ssim, summary
from wrf_mi.training.config import TrainConfig

from .comparison import compared, line, listed, verdicts

SIZES = (100, 400, 1600)
SEEDS = (0, 1, 2)
SCHEDULE = ("steps=6000", "holdout_steps_fraction=0")
"""Settings of WRF-GS+; three times the steps gain 0.016 with 1,280 rows (docs/model.md)."""
LENGTH_M, NOISE = 0.4, 0.1
"""Settings of kriging: about a wavelength, as maximum likelihood over tens of thousands of pixels is too slow."""
START_ROWS = 100
START_SCHEDULE = ("steps=2000", "holdout_steps_fraction=0")
"""Settings of the fits from several starts, few enough steps that their effect is visible."""
NOTHING = "nothing"


def compare(record: Record, scene: Path) -> dict[str, Any]:
    """SSIM of all methods on the official test rows; WRF-GS+ is trained with the first seed only.

    Returns:
        ``traced``: SSIM of the given mesh without training rows; ``sizes``: for each number of training rows quantiles
        of SSIM of each method and seed, verdicts on which all seeds agree, and facts of each fit.
    """
    with tempfile.TemporaryDirectory() as work:

        def run(name: str, model: str, n_train: int, **asked: Any) -> Results:
            return read_run(train(record, Path(work) / name, model, n_train=n_train, **asked).folder, name)

        traced = run("traced", "physics", 0, scene=scene)
        learned = {size: run(f"gs-{size}", "wrf-gs+", size, seed=SEEDS[0], settings=SCHEDULE) for size in SIZES}
        found = []
        for size in SIZES:
            fits = [run(f"physics-{size}-{seed}", "physics", size, scene=scene, seed=seed) for seed in SEEDS]
            scores: dict[str, list[FloatArray]] = {"physics": [fit.score[0] for fit in fits]}
            simple = [_simple(record, size, seed) for seed in SEEDS]
            scores |= {name: [one[name] for one in simple] for name in simple[0]}
            for name, result in (
                ("traced", traced),
                ("wrf-gs+", learned[size]),
                (f"wrf-gs+ of {max(SIZES)} rows", learned[max(SIZES)]),
            ):
                scores[name] = [result.score[0]] * len(SEEDS)
            pairs = {name: compared(scores["physics"], each, SEEDS, "spectrum") for name, each in scores.items()}
            facts = ("train_seconds", "ms_per_sample", "fitted")
            found.append(
                {
                    "rows": size,
                    "ssim": {name: [summary(one) for one in each] for name, each in scores.items()},
                    "against": {name: verdicts(each)[0] for name, each in pairs.items() if name != "physics"},
                    "facts": [{key: fit.metrics[key] for key in facts} for fit in fits],
                }
            )
    return {"traced": summary(traced.score), "sizes": found}


def _simple(record: Record, size: int, seed: int) -> dict[str, FloatArray]:
    """SSIM of interpolation from the training rows of a seed."""
    split = make_splits(record, "official", seed, size)[0]
    rows, test = split.all_train, split.test
    models: dict[str, Any] = {"blend": InverseDistance(), "kriging": Kriging(LENGTH_M, NOISE)}
    return {
        name: ssim(
            model.fit(record.tx_pos_m[rows], record.observation[0][rows]).predict(record.tx_pos_m[test]),
            record.observation[0][test],
        )
        for name, model in models.items()
    }


def main() -> dict[str, Any]:
    """Comparison in the traced room, with rows for the table."""
    record, scene = traced_room()
    figures = compare(record, scene)
    rows = [line("given mesh, traced as it is", f"{figures['traced']['median']:.3f}")]
    for one in figures["sizes"]:
        size = one["rows"]
        medians = listed(one["ssim"]["physics"], "median", 3)
        rows.append(line(f"{size} rows, physics, median SSIM, three seeds", medians, "aim 0.95" if size == 400 else ""))
        for name, verdict in one["against"].items():
            median = np.mean([seed["median"] for seed in one["ssim"][name]])
            asked = "better" if name in ("blend", "wrf-gs+") else ""
            if size == min(SIZES) and name.endswith(f"{max(SIZES)} rows"):
                asked = "as good"
            rows.append(line(f"{size} rows, {name}", f"{median:.3f}: physics {verdict}", asked))
    facts = [fact for one in figures["sizes"] for fact in one["facts"]]
    rows += [
        line("longest fit", f"{max(fact['train_seconds'] for fact in facts):.0f} s", "10 minutes"),
        line("one prediction", f"{max(fact['ms_per_sample'] for fact in facts):.1f} ms", "5 ms"),
    ]
    return {"rows": rows, **figures}


def starts() -> dict[str, Any]:
    """SSIM of WRF-GS+ in the traced room from random Gaussians, a point cloud, a mesh, and traced paths.

    Returns:
        ``rows``; ``starts``: for each start quantiles of SSIM of each seed, and the verdict against a random start.
    """
    record, scene = traced_room()
    given: dict[str, tuple[str, ...]] = {
        NOTHING: (),
        "point cloud": (f"initial.points={Path(record.source) / SCAN}",),
        "mesh": (f"initial.mesh={scene}",),
        "traced paths": (f"initial.paths={scene}",),
    }
    if record.frequencies_hz is not None:
        phase = f"network.phase_hz={float(record.frequencies_hz[0])}"
        given["traced paths, phases from their images"] = (f"initial.paths={scene}", phase)
    scores: dict[str, list[FloatArray]] = {name: [] for name in given}
    with tempfile.TemporaryDirectory() as work:
        for seed in SEEDS:
            for name, start in given.items():
                config = with_settings(TrainConfig(seed=seed), [*START_SCHEDULE, *start])
                run = train(record, Path(work) / f"{name}-{seed}", settings=config, n_train=START_ROWS)
                scores[name].append(read_run(run.folder, name).score[0])
    rows, found = [], {}
    for name, each in scores.items():
        ssims, verdict = [summary(one) for one in each], verdicts(compared(each, scores[NOTHING], SEEDS, "spectrum"))[1]
        found[name] = {"ssim": ssims, "against_nothing": verdict}
        value = ", ".join(f"{one['median']:.3f} ({one['mean']:.3f})" for one in ssims)
        value += "" if name == NOTHING else f"; by means, against a random start: {verdict}"
        rows.append(line(f"start from {name}, median SSIM (mean), three seeds", value))
    return {"rows": rows, "starts": found}
