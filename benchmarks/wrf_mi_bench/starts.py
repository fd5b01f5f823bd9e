"""How much a start from physics helps a field: Gaussians from nothing, a point cloud, a mesh, traced paths."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wrf_mi.core import Record
from wrf_mi.core.settings import with_settings
from wrf_mi.runs.api import train
from wrf_mi.runs.paired import agreed, paired_difference
from wrf_mi.runs.results import read_run
from wrf_mi.synthetic.furnished_room import traced_room
from wrf_mi.synthetic.laboratory import SCAN
from wrf_mi.tasks.scores import summary
from wrf_mi.training.config import TrainConfig

ROWS = 100
SEEDS = (0, 1, 2)
SHORT = ("steps=2000", "holdout_steps_fraction=0")
"""Few steps: what a start is worth shows before the field has forgotten it."""
NOTHING = "nothing"


def starts(
    record: Record,
    scan: Path,
    scene: Path,
    rows: int = ROWS,
    seeds: Sequence[int] = SEEDS,
    schedule: Sequence[str] = SHORT,
) -> dict[str, Any]:
    """SSIM of WRF-GS+ on the official test rows for each start.

    Args:
        record: of spectra, with an official split.
        scan: point cloud of the place.
        scene: its mesh, with materials.
        rows: of training.
        seeds: of subset and fit.
        schedule: settings of the fit.

    Returns:
        By start: quantiles of SSIM for each seed, and the paired comparison of the means with a random start.
    """
    given: dict[str, tuple[str, ...]] = {
        NOTHING: (),
        "point cloud": (f"initial.points={scan}",),
        "mesh": (f"initial.mesh={scene}",),
        "traced paths": (f"initial.paths={scene}",),
    }
    if record.frequencies_hz is not None:
        phase = f"network.phase_hz={float(record.frequencies_hz[0])}"
        given["traced paths, phases from their images"] = (f"initial.paths={scene}", phase)
    scores: dict[str, list[Any]] = {name: [] for name in given}
    with tempfile.TemporaryDirectory() as work:
        for seed in seeds:
            for name, own in given.items():
                config = with_settings(TrainConfig(seed=seed), [*schedule, *own])
                run = train(record, Path(work) / f"{name}-{seed}", settings=config, n_train=rows)
                scores[name].append(read_run(run.folder, name).score)
    return {
        name: {
            "ssim": [summary(one) for one in own],
            "against_nothing": agreed(
                paired_difference(one[0], bare[0], seed, "spectrum").mean_verdict
                for one, bare, seed in zip(own, scores[NOTHING], seeds, strict=True)
            ),
        }
        for name, own in scores.items()
    }


def main() -> dict[str, Any]:
    """The comparison in the traced room, with rows for the table."""
    record, scene = traced_room()
    found = starts(record, Path(record.source) / SCAN, scene)
    rows = []
    for name, one in found.items():
        figures = ", ".join(f"{seed['median']:.3f} ({seed['mean']:.3f})" for seed in one["ssim"])
        said = "" if name == NOTHING else f"; by means, against a random start: {one['against_nothing']}"
        rows.append(
            {"what": f"start from {name}, median SSIM (mean), three seeds", "value": figures + said, "asked": ""}
        )
    return {"rows": rows, "starts": found}
