"""wrf_mi: learned wireless radiation fields and ray tracing in one differentiable program.

The names below are the library in short; everything else is in the packages. They are imported when first
used, so that ``import wrf_mi`` costs nothing and the backend can be chosen before (`wrf_mi.backend.init`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .core import BackendError, InputError, Receiver, Record, Split
    from .core.settings import with_settings
    from .fit.config import TrainConfig
    from .fit.trainer import Trainer
    from .measure import fetch, make_splits
    from .report.compare import compare
    from .report.figures import spectrum_table
    from .report.runs import Run, evaluate_run, open_run, predict_to_file, resume, train
    from .report.view import scene_view
    from .scene.make import make_scene
    from .trace import TraceOptions
    from .trace import load_record as load

__version__ = "0.2.0"

_HOME = {
    "BackendError": "core",
    "InputError": "core",
    "Receiver": "core",
    "Record": "core",
    "Run": "report.runs",
    "Split": "core",
    "TraceOptions": "trace",
    "TrainConfig": "fit.config",
    "Trainer": "fit.trainer",
    "compare": "report.compare",
    "evaluate_run": "report.runs",
    "fetch": "measure",
    "load": "trace:load_record",
    "make_scene": "scene.make",
    "make_splits": "measure",
    "open_run": "report.runs",
    "predict_to_file": "report.runs",
    "resume": "report.runs",
    "scene_view": "report.view",
    "spectrum_table": "report.figures",
    "train": "report.runs",
    "with_settings": "core.settings",
}

__all__ = [
    "BackendError",
    "InputError",
    "Receiver",
    "Record",
    "Run",
    "Split",
    "TraceOptions",
    "TrainConfig",
    "Trainer",
    "compare",
    "evaluate_run",
    "fetch",
    "load",
    "make_scene",
    "make_splits",
    "open_run",
    "predict_to_file",
    "resume",
    "scene_view",
    "spectrum_table",
    "train",
    "with_settings",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    return getattr(importlib.import_module(f".{module}", __name__), attribute or name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
