"""wrf_mi: learned wireless radiation fields and ray tracing in one differentiable program.

The names below are the library in short; everything else is in the packages. They are imported when first
used, so that ``import wrf_mi`` costs nothing and the backend can be chosen before (`wrf_mi.backend.init`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .checking import check_data
    from .core import BackendError, InputError, Receiver, Record, Split
    from .core.settings import with_settings
    from .datasets import fetch, import_measurements, make_splits
    from .maps.api import radio_map
    from .maps.coverage import run_reliability
    from .maps.dataset import write_map
    from .maps.locate import locate
    from .maps.plan import plan
    from .runs.api import Run, evaluate_run, open_run, predict_to_file, resume, train
    from .runs.compare import compare
    from .runs.figures import spectrum_table
    from .runs.other_models import score_predictions
    from .runs.scene_view import scene_view
    from .scene.edit import edit_scene
    from .scene.make import make_scene
    from .synthetic import load_record as load
    from .tracing import TraceOptions
    from .training.config import TrainConfig
    from .training.trainer import Trainer
    from .viewer.view import view

_HOME = {
    "BackendError": "core",
    "InputError": "core",
    "Receiver": "core",
    "Record": "core",
    "Run": "runs.api",
    "Split": "core",
    "TraceOptions": "tracing",
    "TrainConfig": "training.config",
    "Trainer": "training.trainer",
    "check_data": "checking",
    "compare": "runs.compare",
    "edit_scene": "scene.edit",
    "evaluate_run": "runs.api",
    "fetch": "datasets",
    "import_measurements": "datasets",
    "load": "synthetic:load_record",
    "locate": "maps.locate:locate",
    "make_scene": "scene.make",
    "make_splits": "datasets",
    "open_run": "runs.api",
    "plan": "maps.plan:plan",
    "predict_to_file": "runs.api",
    "radio_map": "maps.api",
    "resume": "runs.api",
    "run_reliability": "maps.coverage",
    "scene_view": "runs.scene_view",
    "score_predictions": "runs.other_models",
    "spectrum_table": "runs.figures",
    "train": "runs.api",
    "view": "viewer.view",
    "with_settings": "core.settings",
    "write_map": "maps.dataset",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    return getattr(importlib.import_module(f".{module}", __name__), attribute or name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
