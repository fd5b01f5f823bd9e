"""Registry of models that are fitted to measurements or predict from a scene alone."""

from __future__ import annotations

from collections.abc import Mapping

from ..core import InputError
from ..core.registry import Registry
from ..training.session import Interrupted
from .method import Inputs, Method
from .model import Fitted, Model, Problem, Session, model_of

ENTRY_POINTS = "wrf_mi.models"
"""Group of the entry points by which other packages add models."""

_OWN: Mapping[str, Model | Method | str] = {
    "wrf-gs": "wrf_mi.models.gaussian.model:WRF_GS",
    "wrf-gs+": "wrf_mi.models.gaussian.model:WRF_GS_PLUS",
    "factorised": "wrf_mi.models.gaussian.model:FACTORISED",
    "physics": "wrf_mi.models.physics.model:MODEL",
    "ray-tracing": "wrf_mi.models.ray_tracing:MODEL",
    "idw": "wrf_mi.models.interpolation.idw:METHOD",
    "kriging": "wrf_mi.models.interpolation.kriging:METHOD",
    "trees": "wrf_mi.models.interpolation.trees:METHOD",
    "mri": "wrf_mi.models.interpolation.mri:METHOD",
    "vae": "wrf_mi.models.networks.vae:METHOD",
    "dcgan": "wrf_mi.models.networks.dcgan:METHOD",
    "nerf2": "wrf_mi.models.networks.nerf2:METHOD",
    "linear": "wrf_mi.models.uplink.linear:METHOD",
    "fire": "wrf_mi.models.uplink.fire:METHOD",
    "r2f2": "wrf_mi.models.uplink.r2f2:METHOD",
    "optml": "wrf_mi.models.uplink.optml:METHOD",
}


class _Models(Registry["Model | Method"]):
    """Registry in which a `Method` becomes a `Model` on first access."""

    def __getitem__(self, name: str) -> Model:
        entry = super().__getitem__(name)
        if isinstance(entry, Method):
            entry = self._known[name] = model_of(entry)
        return entry


_MODELS = _Models("model", ENTRY_POINTS, _OWN)
MODELS: Mapping[str, Model] = _MODELS  # type: ignore[assignment]
"""All models by name, as in ``wrf-mi train --model``."""


def register(model: Model | Method) -> None:
    """Add a model for this process; an installed package names it by an entry point of the group `ENTRY_POINTS`.

    Raises:
        InputError: a name that is taken.
    """
    _MODELS.add(model.name, model)


def known_model(name: str) -> Model:
    """The model of a name.

    Raises:
        InputError: there is none.
    """
    if name not in MODELS:
        raise InputError(f"model {name!r}: no such model; choose from {', '.join(MODELS)}")
    return MODELS[name]


__all__ = [
    "ENTRY_POINTS",
    "MODELS",
    "Fitted",
    "Inputs",
    "Interrupted",
    "Method",
    "Model",
    "Problem",
    "Session",
    "known_model",
    "model_of",
    "register",
]
