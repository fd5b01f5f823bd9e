"""Times of one backend for `wrf_mi_bench.gpu`: ``python -m wrf_mi_bench.gpu_job FILE BACKEND``."""

import json
import logging
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.backend import init

STEPS_OF = {"wrf-gs": "WRF-GS", "wrf-gs+": "WRF-GS+"}
STEP_SIZES = (270, 3000, 10_000, 30_000)
ROWS = 32
MOST_S, CALL_S = 3.0, 20.0  # seconds of calls of a size, and expected seconds of a call beyond which a size is left out
SIZES = {
    "gaussians-splat": (1000, 10_000, 100_000, 1_000_000),
    "gaussians-integrator": (1000, 10_000, 100_000),
    "gaussians-networks": (1000, 10_000, 100_000),
    "transmitters-field": (1, 256, 4096),
    "transmitters-tracer": (1, 16, 256),
    "triangles-clutter": (1000, 100_000),
}
"""Axes of `wrf_mi_bench.scaling` and their sizes here."""


def job(file: str, backend: str) -> None:
    """Measure all axes with a backend and store them as JSON."""
    known = init(backend)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    from threadpoolctl import threadpool_limits

    from .scaling import AXES, Axis, scale

    axes = [replace(axis, sizes=SIZES[axis.name]) for axis in AXES if axis.name in SIZES]
    axes += [
        Axis(f"step-{model}", f"training step of {title}", "Gaussians", STEP_SIZES, partial(step, model))
        for model, title in STEPS_OF.items()
    ]
    with threadpool_limits(1, "blas"):
        measured = [scale(axis, most_s=MOST_S, call_s=CALL_S) for axis in axes]
    Path(file).write_text(json.dumps({"device": known.device, "axes": measured}))


def step(model: str, gaussians: int) -> Any:
    """A training step on random spectra, with the default batch."""
    from wrf_mi.core.settings import with_settings
    from wrf_mi.datasets import make_splits
    from wrf_mi.training.config import TrainConfig
    from wrf_mi.training.trainer import Trainer

    from .training import QUIET, some_steps
    from .workloads import record, size_deg

    spectra = record(ROWS)
    options = (*QUIET, f"initial.gaussians={gaussians}", f"initial.size_deg={size_deg(gaussians):.3g}", "steps=1000000")
    of = Trainer(spectra, make_splits(spectra, "random")[0], with_settings(TrainConfig(model=model), options))
    return some_steps(of, 1)


if __name__ == "__main__":
    job(*sys.argv[1:])
