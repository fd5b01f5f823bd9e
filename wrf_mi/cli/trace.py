"""``wrf-mi trace``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import InputError
from .options import DATASET, Arguments, add_command, add_n_train, add_scheduler, add_tracing
from .train import RAY_TRACING, run_training, training_arguments


def add_parser(commands: Any) -> None:
    """Add ``trace`` to the commands."""
    text = "predict by ray tracing and score it like a learned field"
    parser = add_command(commands, "trace", trace_command, text)
    parser.set_defaults(model=RAY_TRACING, receiver=None, evaluation=None, preset=None, set=[])
    parser.set_defaults(deterministic=False, intervals=False)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="name of a scene, scene folder, Mitsuba XML, or mesh file")
    add("dataset", metavar="DATASET", help=DATASET)
    add("--out", metavar="RUN", required=True, help="run folder to make")
    add_tracing(parser)
    target = "choose depth, rays, diffraction and scattering until power and spectra are converged to DB decibels"
    add("--target-error", type=float, metavar="DB", help=target)
    text = "write the traced paths as a scenario of DeepMIMO, which deepmimo.load opens (docs/data.md)"
    add("--deepmimo", metavar="FOLDER", help=text)
    add("--split", help="as for train (default: official)")
    add_n_train(parser)
    add("--seed", type=int, metavar="N", help="seed of split and rays (default: 0)")
    add_scheduler(parser)


def trace_command(a: Arguments) -> int:
    """Predict by ray tracing alone."""
    from ..parallel import open_scheduler

    training_arguments(a)  # refused before workers start
    if a.calibrate is not None and a.scheduler is not None:
        raise InputError("trace: --calibrate trains in one process; omit --scheduler")
    if a.deepmimo is not None:
        _check_deepmimo(a)
    with open_scheduler(a.scheduler) as scheduler:
        status = run_training(a, scheduler=scheduler if a.scheduler else None)
    if a.deepmimo is not None:
        from ..models.ray_tracing import PATHS
        from ..tracing import load_trace, write_deepmimo

        write_deepmimo(a.deepmimo, load_trace(Path(a.out) / PATHS))
    return status


def _check_deepmimo(a: Arguments) -> None:
    from ..tracing.deepmimo import check_deepmimo_folder

    if a.calibrate is not None:
        raise InputError("trace: --calibrate trains paths and stores none; omit it, or --deepmimo")
    check_deepmimo_folder(a.deepmimo)
