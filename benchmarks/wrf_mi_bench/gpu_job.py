"""Times of one backend for `wrf_mi_bench.gpu`: ``python -m wrf_mi_bench.gpu_job FILE BACKEND THREADS``."""

import json
import logging
import sys
import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from wrf_mi.backend import init

STEPS_OF = {"wrf-gs": "WRF-GS", "wrf-gs+": "WRF-GS+"}
STEP_SIZES = (270, 3000, 10_000, 30_000)
ROWS = 32
MOST_S, CALL_S = 1.0, 5.0  # seconds of calls of a size, and expected seconds of a call beyond which a size is left out
SIZES = {
    "gaussians-splat": (1000, 10_000, 100_000, 1_000_000),
    "gaussians-integrator": (1000, 10_000, 100_000),
    "gaussians-networks": (1000, 10_000, 100_000),
    "transmitters-field": (1, 256, 4096),
    "transmitters-tracer": (1, 16, 256),
    "triangles-clutter": (1000, 100_000),
}
"""Axes of `wrf_mi_bench.scaling` and their sizes here."""
PREDICTED = {"factorised": (1, 64, 4096), "wrf-gs": (1, 64, 4096), "joint": (1, 64, 256)}
"""Models whose predictions are timed, and numbers of transmitters in a call."""
FEW_STEPS = "steps=60"  # of the models that predict: speed does not depend on how well they fit


def job(file: str, backend: str, threads: str = "0") -> None:
    """Measure axes, predictions and kernels of steps with a backend, on threads of the CPU (0: all); write JSON."""
    backend_info = init(backend, threads=int(threads) or None)
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
        kernels = {title: kernels_of(step(model, STEP_SIZES[0])) for model, title in STEPS_OF.items()}
    result = {"device": backend_info.device, "axes": measured, "kernels": kernels, "predictions": predictions()}
    Path(file).write_text(json.dumps(result))


def step(model: str, gaussians: int) -> Any:
    """A training step on random spectra, with the default batch."""
    from .quick import endless_trainer
    from .workloads import record, size_deg

    options = f"initial.gaussians={gaussians}", f"initial.size_deg={size_deg(gaussians):.3g}"
    trainer = endless_trainer(record(ROWS), model, *options)
    return lambda: trainer.run(stop=lambda: True)  # asked after each step: one is taken


def kernels_of(call: Any) -> dict[str, float]:
    """Launches of a call, its time, and the share of that in which no kernel runs."""
    from .timing import history_of

    call()
    total_ms, history = history_of(call)
    running = sum(entry["execution_time"] for entry in history)
    return {"launches": len(history), "ms": total_ms, "idle": max(0.0, 1 - running / total_ms)}


def predictions() -> dict[str, dict[int, float]]:
    """Spectra a second of the laboratory by model and number of transmitters in a call."""
    import wrf_mi
    from wrf_mi.synthetic.laboratory import NAME, transmitter_path
    from wrf_mi.synthetic.stored import SCAN

    record = wrf_mi.load(NAME)
    per_second: dict[str, dict[int, float]] = {}
    with tempfile.TemporaryDirectory() as work:
        from wrf_mi.scene.make import make_scene

        scene = make_scene(Path(record.source) / SCAN, Path(work) / "scene").folder
        for model, sizes in PREDICTED.items():
            joint = model == "joint"
            name, where = ("wrf-gs+", scene) if joint else (model, None)
            run = wrf_mi.train(record, name, out=Path(work) / model, scene=where, settings=[FEW_STEPS])
            per_second[model] = {}
            for size in sizes:
                run.predict(transmitter_path(size))  # kernels and operator are made here
                start, done = time.perf_counter(), 0
                while done == 0 or time.perf_counter() - start < MOST_S:
                    run.predict(transmitter_path(size))
                    done += size
                per_second[model][size] = done / (time.perf_counter() - start)
    return per_second


if __name__ == "__main__":
    job(*sys.argv[1:])
