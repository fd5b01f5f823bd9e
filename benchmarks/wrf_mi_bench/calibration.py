"""What calibration gains on measured signal strengths: a flat's walls, six receivers, a robot-borne transmitter."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wrf_mi.core import InputError
from wrf_mi.datasets.registry import locate
from wrf_mi.runs.api import train
from wrf_mi.runs.results import read_run
from wrf_mi.scene.make import make_scene

HEIGHT_M = 2.7
"""The ceiling is not in the data; one receiver is 2.62 m above the floor."""
PATHS = ("transmission=true", "max_depth=6", "max_reflections=2")
"""The layout has two lines for a wall, so three walls are six surfaces."""
CALIBRATED = (*PATHS, "calibration=gain,patterns")


def flat_calibration(folder: str | Path, work: str | Path, seeds: Sequence[int] = (0, 1, 2)) -> dict[str, Any]:
    """Ray tracing of the flat-ble data with offsets alone and calibrated, scored on the official test rows.

    Args:
        folder: the data set, with ``layout.csv``.
        work: folder to make the scene and the runs in.
        seeds: of the calibration.

    Returns:
        Errors in dB: median and 90th percentile over all receivers and test rows; number of paths; seconds of tracing
        and of a calibration.

    Raises:
        InputError: data or scene that cannot be used.
    """
    scene = make_scene(Path(folder) / "layout.csv", Path(work) / "flat", height_m=HEIGHT_M).folder

    def metrics(name: str, seed: int, settings: Sequence[str]) -> Any:
        run = train(folder, Path(work) / name, "ray-tracing", scene=scene, seed=seed, settings=settings)
        return read_run(run.folder).metrics

    alone = metrics("offsets", 0, PATHS)
    fitted = [metrics(f"calibrated{seed}", seed, CALIBRATED) for seed in seeds]
    return {
        "paths": alone["paths"],
        "offsets_alone_db": _quantiles(alone),
        "calibrated_db": [_quantiles(one) for one in fitted],
        "seconds": {
            "trace": alone["trace_seconds"],
            "fit": sum(one["train_seconds"] for one in fitted) / len(fitted),
        },
    }


def _quantiles(metrics: Any) -> dict[str, float]:
    return {name: metrics["abs_error_db"][name] for name in ("median", "p90")}


def flat() -> dict[str, Any]:
    """The same for the benchmark, with rows for its table.

    Raises:
        InputError: the data are not on this machine.
    """
    folder = locate("flat-ble")
    if folder is None:
        raise InputError("flat-ble: not on this machine; run `wrf-mi data fetch flat-ble`")
    with tempfile.TemporaryDirectory() as work:
        figures = flat_calibration(folder, work)
    alone, fitted = figures["offsets_alone_db"], figures["calibrated_db"]
    medians = ", ".join(f"{one['median']:.2f}" for one in fitted)
    what = "median absolute error with one offset per anchor (90th percentile)"
    rows = [
        {"what": what, "value": f"{alone['median']:.2f} dB ({alone['p90']:.1f} dB)", "asked": "reference"},
        {"what": "calibrated by gradients, three seeds", "value": f"{medians} dB", "asked": "below 3.8 dB"},
    ]
    return {"rows": rows, **figures}
