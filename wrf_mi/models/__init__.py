"""Registry of models that are fitted to measurements or predict from a scene alone."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ..core import InputError
from ..core.registry import Registry

if TYPE_CHECKING:
    from ..estimators.model import Fitted, Inputs, Model, Problem, Session

ENTRY_POINTS = "wrf_mi.models"  # Group of the entry points by which other packages add models

_OWN: Mapping[str, Model | str] = {
    "wrf-gs": "wrf_mi.estimators.gaussian.model:WRF_GS",
    "wrf-gs+": "wrf_mi.estimators.gaussian.model:WRF_GS_PLUS",
    "factorised": "wrf_mi.estimators.gaussian.model:FACTORISED",
    "ray-tracing": "wrf_mi.estimators.ray_tracing:MODEL",
    "hybrid": "wrf_mi.stages.hybrid:MODEL",
    "idw": "wrf_mi.estimators.interpolation.idw:MODEL",
    "kriging": "wrf_mi.stages.kriging:MODEL",
    "trees": "wrf_mi.estimators.interpolation.trees:MODEL",
    "mri": "wrf_mi.estimators.interpolation.mri:MODEL",
    "vae": "wrf_mi.estimators.networks.vae:MODEL",
    "dcgan": "wrf_mi.estimators.networks.dcgan:MODEL",
    "nerf2": "wrf_mi.estimators.networks.nerf2:MODEL",
    "linear": "wrf_mi.estimators.uplink.linear:MODEL",
    "fire": "wrf_mi.estimators.uplink.fire:MODEL",
    "r2f2": "wrf_mi.estimators.uplink.r2f2:MODEL",
    "optml": "wrf_mi.estimators.uplink.optml:MODEL",
}


MODELS: Registry[Model] = Registry("model", ENTRY_POINTS, _OWN)  # All models by name, as in ``wrf-mi train --model``


def register(model: Model) -> None:
    """Add a model for this process; an installed package names it by an entry point of the group `ENTRY_POINTS`.

    Raises:
        InputError: a name that is taken.
    """
    MODELS.add(model.name, model)


def no_model(name: str) -> InputError:
    """Error of a name that no model has."""
    remedy = f"choose from {', '.join(MODELS)}, or add yours by wrf_mi.models.register or an entry point"
    return InputError(f"model {name!r}: no such model; {remedy} (docs/howto/extend.md)")


def known_model(name: str) -> Model:
    """The model of a name (InputError: there is none)."""
    if name not in MODELS:
        raise no_model(name)
    return MODELS[name]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("wrf_mi.estimators.model"), name)  # imported when first used, as the models are


__all__ = [
    "ENTRY_POINTS",
    "MODELS",
    "Fitted",
    "Inputs",
    "Model",
    "Problem",
    "Session",
    "known_model",
    "register",
]
