"""What calibration gains on measured signal strengths: a flat's walls, six receivers, a robot-borne transmitter."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..measure import load
from ..measure.registry import locate
from ..scene.make import make_scene
from ..trace import TraceOptions, open_scene, recompute, trace_paths
from ..trace.calibrate import OFFSETS_ALONE, CalibrationOptions, absolute_error_db, calibrate, choose_calibration

HEIGHT_M = 2.7
"""The ceiling is not in the data; one receiver is 2.62 m above the floor."""
OPTIONS = TraceOptions(transmission=True, max_depth=6, max_reflections=2)
"""The layout has two lines for a wall, so three walls are six surfaces."""
WALLS_M: Mapping[str, Sequence[float]] = {"itu_plasterboard": (0.02, 0.05, 0.1)}
"""Thickness of one of a wall's two lines; the better one on held-out places is taken."""
CANDIDATES = (
    CalibrationOptions(materials=False),
    CalibrationOptions(steps=100, batch=400, weakest_db=15.0),
)
"""Patterns alone, and materials too: a step of these takes fifty times as long."""


def flat_calibration(
    folder: str | Path, work: str | Path, seeds: Sequence[int] = (0, 1, 2), progress: bool = False
) -> dict[str, Any]:
    """Trace the flat-ble data and score offsets alone and the calibration on the official test rows.

    Everything is chosen on training rows, held out by place (`wrf_mi.trace.calibrate.choose_calibration`).

    Args:
        folder: the data set, with ``layout.csv``.
        work: folder to make the scene in.
        seeds: of the final fit.
        progress: show progress bars on standard error.

    Returns:
        Errors in dB: median and 90th percentile over all receivers and test rows; what was chosen; seconds.

    Raises:
        InputError: data or scene that cannot be used.
    """
    record = load(folder)
    assert record.official is not None
    train, test = record.official
    assert record.frequencies_hz is not None
    scene_folder = make_scene(Path(folder) / "layout.csv", Path(work) / "flat", height_m=HEIGHT_M).folder
    scene = open_scene(scene_folder, float(record.frequencies_hz[0]))
    start = time.perf_counter()
    traced = trace_paths(scene, record.tx_pos_m, record.receivers, OPTIONS, progress)
    seconds = {"trace": time.perf_counter() - start}
    start = time.perf_counter()
    wall_errors = {}
    for material, choices in WALLS_M.items():
        for thickness in choices:
            scene.radio_materials[material].thickness = thickness
            again = recompute(traced, scene)
            _, (error,) = choose_calibration(again, scene, record, train, [OFFSETS_ALONE])
            wall_errors[material, thickness] = error
        best = min(choices, key=lambda one, of=material: wall_errors[of, one])  # type: ignore[misc]
        scene.radio_materials[material].thickness = best
    traced = recompute(traced, scene)
    options, errors = choose_calibration(traced, scene, record, train, CANDIDATES, progress=progress)
    seconds["choice"] = time.perf_counter() - start
    offsets = calibrate(traced, scene, record, train, OFFSETS_ALONE)
    start = time.perf_counter()
    fitted = [
        calibrate(traced, scene, record, train, CalibrationOptions(**{**vars(options), "seed": seed}), progress)
        for seed in seeds
    ]
    seconds["fit"] = (time.perf_counter() - start) / len(seeds)
    return {
        "paths": len(traced.paths),
        "wall_thickness_db": {f"{name} {thickness} m": error for (name, thickness), error in wall_errors.items()},
        "held_out_db": {"patterns": errors[0], "patterns and materials": errors[1]},
        "chosen": vars(options),
        "offsets_alone_db": _quantiles(absolute_error_db(offsets, traced, scene, record, test)),
        "calibrated_db": [_quantiles(absolute_error_db(one, traced, scene, record, test)) for one in fitted],
        "materials": dict(fitted[0].materials),
        "seconds": seconds,
    }


def _quantiles(errors: FloatArray) -> dict[str, float]:
    median, p90 = np.nanpercentile(errors, [50, 90])
    return {"median": float(median), "p90": float(p90)}


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
        {"what": what, "value": f"{alone['median']:.2f} dB ({alone['p90']:.1f} dB)", "asked": "an honest figure"},
        {"what": "calibrated by gradients, three seeds", "value": f"{medians} dB", "asked": "below 3.8 dB"},
    ]
    return {"rows": rows, **figures}
