"""The main job in one call: train WRF-GS+ with a short schedule, score it, draw it."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

from ..core import InputError
from ..fit.config import PRESETS, TrainConfig, with_settings
from ..measure import fetch
from ..measure.registry import locate
from ..trace.laboratory import NAME as LABORATORY
from .compare import compare
from .runs import Listen, Run, train

REAL = "rfid-lab"


def demo_dataset() -> str:
    """Real spectra where they are or can be fetched; else the embedded room, and a line that says so."""
    if locate(REAL) is not None:
        return REAL
    try:
        fetch(REAL)
        return REAL
    except InputError as error:
        print(f"no real spectra ({error}): using the embedded room, traced here by Sionna RT", file=sys.stderr)
        return LABORATORY


def demo(out: Path | None, listen: Listen, stop: Callable[[], bool]) -> tuple[Run, Path]:
    """Train on real spectra, or on a room traced on the spot, and draw the result.

    Args:
        out: run folder; None: a new one in ``runs/``.
        listen: hears of progress.
        stop: True stops at a checkpoint.

    Returns:
        The run and the ``index.html`` with its pictures.
    """
    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    config = with_settings(TrainConfig(), PRESETS["quick"])
    dataset = demo_dataset()
    print(f"training {config.model} on {dataset}; results go to {folder}", file=sys.stderr)
    run = train(dataset, folder, config, listen=listen, stop=stop)
    return run, compare([folder], folder / "compare")
