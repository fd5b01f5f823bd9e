"""Sentinels: some thirty stored figures, of each task and family of models, measured again and held to what is stored.

A change that should not move figures is checked by them within three quarters of an hour; the tables take many hours.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError
from ..core.files import one_line
from ..tasks import TASKS
from .bench import BenchFailed
from .table_plan import Row, available, plan
from .tables import FOLDER, measure

STORED = Path("benchmarks/results") / FOLDER
RUNS = Path("runs/bench/sentinels")
SENTINELS = (
    *(f"spectrum-rfid-lab-official-{name}" for name in ("idw", "kriging", "hybrid", "vae", "ray-tracing", "wrf-gs+")),
    *(f"spectrum-rfid-lab-blocked-{name}" for name in ("idw", "kriging", "hybrid", "wrf-gs+")),
    *(f"spectrum-traced-room-official-{name}" for name in ("idw", "kriging", "ray-tracing")),
    *(f"rssi-flat-ble-official-{name}" for name in ("idw", "kriging", "trees", "mri", "hybrid", "ray-tracing")),
    *(f"rssi-flat-ble-official-{name}" for name in ("wrf-gs", "wrf-gs+")),
    *(f"csi-traced-csi-flat-official-{name}" for name in ("linear", "fire", "r2f2", "optml", "wrf-gs")),
    *(f"csi-newrf-conference-official-{name}" for name in ("kriging", "ray-tracing", "hybrid", "wrf-gs+")),
    *(f"csi-newrf-office-official-{name}" for name in ("hybrid", "wrf-gs")),
)
"""Rows of the tables, all training rows and seed 0, that take at most some minutes each."""
NORMAL_95 = 1.96


def median_interval(quantiles: np.ndarray, count: int) -> tuple[float, float]:
    """95 % interval of a median from equally spaced quantiles of n scores.

    Source: order statistics, the normal approximation of the binomial distribution; David and Nagaraja, "Order
    Statistics" (2003), section 7.1.
    """
    half = NORMAL_95 / 2 / np.sqrt(count)
    shares = np.linspace(0, 1, len(quantiles))
    low, high = np.interp([0.5 - half, 0.5 + half], shares, quantiles)
    return float(low), float(high)


def compare_row(stored: Mapping[str, Any], now: Mapping[str, Any], task: str) -> dict[str, Any]:
    """A stored row of the tables and the same measured again.

    Returns:
        ``what``, ``value`` and ``asked`` for a table, and whether the figure is ``held``: inside the interval of the
        stored median, or better.
    """
    scores = np.asarray(stored["quantiles"], float)
    low, high = median_interval(scores, int(stored["n_test"]))
    before, after = float(stored["score"]["median"]), float(now["score"]["median"])
    better = after > before if TASKS[task].higher_is_better else after < before
    return {
        "what": stored["row"],
        "value": f"{after:.3f} ({TASKS[task].label})",
        "asked": f"{before:.3f} ({low:.3f} to {high:.3f}), or better",
        "held": bool(low <= after <= high or better),
    }


def main() -> dict[str, Any]:
    """Measure all sentinels whose data are on this machine.

    Returns:
        ``rows`` for the table.

    Raises:
        BenchFailed: a figure that is neither within its interval nor better, after all were measured.
    """
    planned = {row.name: row for row in plan()}
    rows, lost = [], []
    for name in SENTINELS:
        row: Row = planned[f"{name}-100-seed0"]
        stored = STORED / f"{row.name}.json"
        if not available(row.part) or not stored.exists():
            print(f"sentinels: {row.name}: data or stored row missing; left out", file=sys.stderr)
            continue
        try:
            found = compare_row(json.loads(stored.read_text()), measure(RUNS, row), row.part.task)
        except (InputError, BenchFailed) as error:
            found = {"what": row.name, "value": one_line(error), "asked": "a figure", "held": False}
        rows.append(found)
        print(f"sentinels: {found['what']}: {found['value']}, stored {found['asked']}", file=sys.stderr, flush=True)
        if not found["held"]:
            lost.append(found)
    if lost:
        first = lost[0]
        text = f"{len(lost)} of {len(rows)} figures moved, first {first['what']}: {first['value']}, {first['asked']}"
        raise BenchFailed(f"sentinels: {text}")
    return {"rows": rows}
