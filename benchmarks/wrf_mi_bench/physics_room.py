"""The traced room: spectra of transmitters anywhere in a furnished room, by a model that is given bare walls.

Beside the physics model stand what interpolates (the blend, kriging), what knows physics alone (the given mesh traced
as it is), and what learns without physics (WRF-GS+). Test rows are the same for all.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.datasets import make_splits
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.runs.api import train
from wrf_mi.runs.paired import agreed, paired_difference
from wrf_mi.runs.results import Results, read_run
from wrf_mi.synthetic.furnished_room import traced_room
from wrf_mi.tasks.scores import ssim, summary

SIZES = (100, 400, 1600)
SEEDS = (0, 1, 2)
SHORT = ("steps=6000", "holdout_steps_fraction=0")
"""Schedule of WRF-GS+; three times the steps gain 0.016 with 1,280 rows (docs/model.md)."""
LENGTH_M, NOISE = 0.4, 0.1
"""Of the kriging, a wavelength or so: likelihood over tens of thousands of pixels takes longer than all the rest."""

Scores = dict[str, FloatArray]


def compare(
    record: Record, scene: str | Path, sizes: Sequence[int] = SIZES, seeds: Sequence[int] = SEEDS
) -> dict[str, Any]:
    """Score all methods on the official test rows.

    Args:
        record: of spectra, with an official split.
        scene: the mesh that a model is given.
        sizes: numbers of training rows; subsets are nested for each seed.
        seeds: of subset and fit. WRF-GS+ is trained with the first of them alone, and compared to each.

    Returns:
        ``traced``: SSIM of the mesh as it is; ``sizes``: for each number of rows quantiles of SSIM of each method
        and seed, verdicts on which all seeds agree, and what a fit took.
    """
    with tempfile.TemporaryDirectory() as work:
        place = Path(work)
        traced = read_run(train(record, place / "traced", "physics", scene=scene, n_train=0).folder, "traced")
        learned = {
            size: read_run(
                train(record, place / f"gs-{size}", seed=seeds[0], settings=SHORT, n_train=size).folder,
                "wrf-gs+",
            )
            for size in sizes
        }
        found = [_of_size(record, scene, place, size, seeds, traced, learned) for size in sizes]
    return {"traced": summary(traced.score), "sizes": found}


def _of_size(
    record: Record,
    scene: str | Path,
    place: Path,
    size: int,
    seeds: Sequence[int],
    traced: Results,
    learned: dict[int, Results],
) -> dict[str, Any]:
    quantiles: dict[str, list[dict[str, float]]] = {}
    verdicts: dict[str, list[str]] = {}
    facts = []
    for seed in seeds:
        own: dict[str, Any] = {"scene": scene, "n_train": size, "seed": seed}
        run = read_run(train(record, place / f"physics-{size}-{seed}", "physics", **own).folder, "physics")
        methods = _simple(record, size, seed)
        methods |= {"traced": traced.score[0], "wrf-gs+": learned[size].score[0]}
        methods[f"wrf-gs+ of {max(learned)} rows"] = learned[max(learned)].score[0]
        quantiles.setdefault("physics", []).append(summary(run.score))
        for name, scores in methods.items():
            quantiles.setdefault(name, []).append(summary(scores))
            pair = paired_difference(run.score[0], scores, seed, "spectrum")
            verdicts.setdefault(name, []).append(pair.verdict)
        facts.append({key: run.metrics[key] for key in ("train_seconds", "ms_per_sample", "fitted")})
    return {
        "rows": size,
        "ssim": quantiles,
        "against": {name: agreed(said) for name, said in verdicts.items()},
        "facts": facts,
    }


def _simple(record: Record, size: int, seed: int) -> Scores:
    """SSIM of what interpolates, with the same training rows as the physics model of that seed."""
    split = make_splits(record, "official", seed, size)[0]
    train_rows, test = split.all_train, split.test
    tx, spectra = record.tx_pos_m, record.observation[0]
    blend = InverseDistance().fit(tx[train_rows], spectra[train_rows]).predict(tx[test])
    kriging = Kriging(LENGTH_M, NOISE).fit(tx[train_rows], spectra[train_rows]).predict(tx[test])
    return {"blend": ssim(blend, spectra[test]), "kriging": ssim(kriging, spectra[test])}


def main() -> dict[str, Any]:
    """The comparison in the traced room as it comes, with rows for the table."""
    record, scene = traced_room()
    figures = compare(record, scene)
    rows = [{"what": "given mesh, traced as it is", "value": f"{figures['traced']['median']:.3f}", "asked": ""}]
    for one in figures["sizes"]:
        size, physics = one["rows"], one["ssim"]["physics"]
        asked = "aim 0.95" if size == 400 else ""
        medians = ", ".join(f"{seed['median']:.3f}" for seed in physics)
        rows.append({"what": f"{size} rows, physics, median SSIM, three seeds", "value": medians, "asked": asked})
        for name, verdict in one["against"].items():
            median = np.mean([seed["median"] for seed in one["ssim"][name]])
            wanted = "better" if name in ("blend", "wrf-gs+") else ""
            if size == min(SIZES) and name.endswith(f"{max(SIZES)} rows"):
                wanted = "as good"
            rows.append({"what": f"{size} rows, {name}", "value": f"{median:.3f}: physics {verdict}", "asked": wanted})
    longest = max(fact["train_seconds"] for one in figures["sizes"] for fact in one["facts"])
    slowest = max(fact["ms_per_sample"] for one in figures["sizes"] for fact in one["facts"])
    rows += [
        {"what": "longest fit", "value": f"{longest:.0f} s", "asked": "10 minutes"},
        {"what": "one prediction", "value": f"{slowest:.1f} ms", "asked": "5 ms"},
    ]
    return {"rows": rows, **figures}
