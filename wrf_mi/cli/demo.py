"""The main job in one call: train WRF-GS+ with a short schedule, trace a room, score both, draw them."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core import InputError
from ..datasets import fetch
from ..datasets.registry import locate
from ..runs.api import Run, train
from ..runs.compare import compare
from ..scene.make import make_scene
from ..synthetic import load_record
from ..synthetic.laboratory import NAME as LABORATORY
from ..synthetic.laboratory import SCAN
from ..training.config import PRESETS
from ..training.session import OnProgress

REAL = "rfid-lab"
FLAT = "flat-ble"
FLAT_PLAN = "layout.csv"
FLAT_HEIGHT_M = 2.7
"""Usual height of a room; the plan does not tell it."""


def here(name: str) -> Path | None:
    """The folder of a real data set where it is or can be fetched; else None, and a line that says so."""
    if (found := locate(name)) is not None:
        return found
    try:
        return fetch(name)
    except InputError as error:
        print(f"no {name} ({error})", file=sys.stderr)
        return None


def demo(out: Path | None, on_progress: OnProgress, stop: Callable[[], bool]) -> tuple[Run, Path]:
    """Train on real spectra, trace real signal strengths, and draw both; or all in a room made up for it.

    Without real spectra, spectra of the embedded room take their place, traced in its true mesh; the ray tracer is
    then given the mesh that a LiDAR scan of the room makes.

    Args:
        out: run folder; None: a new one in ``runs/``. The traced run lies in ``traced/`` in it.
        on_progress: progress callback.
        stop: True stops at a checkpoint.

    Returns:
        The run of the field and the ``index.html`` with all pictures.
    """
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    real = here(REAL) is not None
    if not real:
        print(f"using the embedded room {LABORATORY}, traced here by Sionna RT, in its place", file=sys.stderr)
    dataset = REAL if real else LABORATORY
    print(f"training wrf-gs+ on {dataset}; results go to {folder}", file=sys.stderr)
    run = train(dataset, folder, settings=PRESETS["quick"], on_progress=on_progress, stop=stop)
    traced = _trace_flat(folder) if real else _trace_scan(folder)
    runs = [folder] if traced is None else [folder, traced]
    return run, compare(runs, folder / "compare")


def _trace_flat(folder: Path) -> Path | None:
    """Signal strengths in a flat whose plan is known; None where the data cannot be had."""
    data = here(FLAT)
    if data is None:
        return None
    print(f"tracing {FLAT} in the walls of its plan", file=sys.stderr)
    scene = make_scene(data / FLAT_PLAN, folder / "scene", height_m=FLAT_HEIGHT_M)
    settings = ("transmission=true", "max_depth=6", "max_reflections=2")
    asked: dict[str, Any] = {"scene": scene.folder, "settings": settings, "progress": sys.stderr.isatty()}
    return train(FLAT, folder / "traced", "ray-tracing", **asked).folder


def _trace_scan(folder: Path) -> Path:
    """The embedded room's spectra, from the mesh of its scan."""
    print(f"tracing {LABORATORY} in the mesh of its scan", file=sys.stderr)
    points = Path(load_record(LABORATORY).source) / SCAN
    scene = make_scene(points, folder / "scene")
    asked: dict[str, Any] = {"scene": scene.folder, "progress": sys.stderr.isatty()}
    return train(LABORATORY, folder / "traced", "ray-tracing", **asked).folder
