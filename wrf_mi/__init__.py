"""wrf_mi: learned wireless radiation fields and ray tracing in one differentiable program.

The names below are the library in short; everything else is in the packages. They are imported when first
used, so that ``import wrf_mi`` costs nothing and the backend can be chosen before (`wrf_mi.backend.init`).
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from .version import __version__

if TYPE_CHECKING:
    from .apps.checking import check_data
    from .apps.importing import import_measurements
    from .core import BackendError, InputError, Receiver, Record, Split
    from .datasets import fetch, make_splits
    from .models import Model
    from .runs.api import Run, open_run, resume, train
    from .runs.compare import compare
    from .runs.other_models import score_predictions
    from .runs.regressor import WrfRegressor
    from .runs.scenes import Scene
    from .scene.edit import Move
    from .synthetic import load_record as load
    from .tracing import TraceOptions

_HOME = {
    "BackendError": "core",
    "InputError": "core",
    "Model": "models",
    "Move": "scene.edit",
    "Receiver": "core",
    "Record": "datasets:Record",  # with the tasks that it names
    "Run": "runs.api",
    "Scene": "runs.scenes",
    "Split": "core",
    "TraceOptions": "tracing",
    "WrfRegressor": "runs.regressor",
    "check_data": "apps.checking",
    "compare": "runs.compare",
    "fetch": "datasets",
    "import_measurements": "apps.importing",
    "load": "synthetic:load_record",
    "make_splits": "datasets",
    "open_run": "runs.api",
    "resume": "runs.api",
    "score_predictions": "runs.other_models",
    "train": "runs.api",
}

__all__ = list(_HOME)


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _HOME[name].partition(":")
    return getattr(importlib.import_module(f".{module}", __name__), attribute or name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
