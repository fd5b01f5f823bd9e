"""Models that a hybrid mixes."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

from ...core import InputError, Split
from ...tasks import task_of
from .. import MODELS
from ..checks import check_held_receivers, check_record
from ..model import Model, Problem, default_settings

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Ingredient:
    """A model of the registry with or without the scene.

    Attributes:
        model: name of the model.
        scene: whether it is given the scene; then it needs one.
        settings: ``key=value`` that differ from its defaults.
        of_spectra: further ones where the data are spectra.
        default: whether it is mixed where `HybridSettings.ingredients` names none.
    """

    model: str
    scene: bool = False
    settings: tuple[str, ...] = ()
    of_spectra: tuple[str, ...] = ()
    default: bool = True


TRANSMISSION = ("transmission=true",)
"""Waves pass the slabs of a scene, furniture among them."""
PHASE_ERROR = "phase_error=1.25"
"""Meshes of scans are off by a share of the wavelength; docs/physics.md has the choice."""
INGREDIENTS = {
    "kriging": Ingredient("kriging"),
    "physics": Ingredient("physics", scene=True),
    "ray-tracing": Ingredient("ray-tracing", scene=True, settings=TRANSMISSION, of_spectra=(PHASE_ERROR,)),
    "surface": Ingredient("ray-tracing", scene=True, settings=("calibration=gain,materials,surface", *TRANSMISSION)),
    "trees": Ingredient("trees"),
    "mri": Ingredient("mri"),
    "idw": Ingredient("idw"),
    "r2f2-scene": Ingredient("r2f2", scene=True),
    **{name: Ingredient(name) for name in ("r2f2", "optml", "fire", "linear")},
    "learned": Ingredient("wrf-gs+", default=False),
    "joint": Ingredient("wrf-gs+", scene=True, default=False),
}
"""Ingredients by name, the first of which is used where held-out rows do not tell them apart; any other name is that of
a model without the scene."""

TRUSTED = ("physics", "kriging")
"""Ingredients to which few rows are left, the first that is present: both have prior knowledge of propagation."""


def most_trusted(names: Sequence[str]) -> int:
    """Number of the ingredient that is used alone unless held-out rows show that a mixture gains."""
    return next((names.index(name) for name in TRUSTED if name in names), 0)


def from_uplink(name: str) -> bool:
    """Whether an ingredient needs the uplink."""
    return MODELS[INGREDIENTS.get(name, Ingredient(name)).model].uplink == "required"


def uses_scene(name: str) -> bool:
    """Whether an ingredient is given the scene."""
    return INGREDIENTS.get(name, Ingredient(name)).scene


def problems(problem: Problem, names: Sequence[str] | None) -> dict[str, tuple[Model, Problem]]:
    """Entry and problem of each ingredient that serves the data.

    Args:
        problem: problem of the hybrid.
        names: names of ingredients; None: all defaults that serve the data.

    Raises:
        InputError: an unknown name, an ingredient that does not serve the data, or none that does.
    """
    found: dict[str, tuple[Model, Problem]] = {}
    for name in names or [name for name, ingredient in INGREDIENTS.items() if ingredient.default]:
        if name not in INGREDIENTS and name not in MODELS:
            known = ", ".join([*INGREDIENTS, *(model for model in MODELS if model not in INGREDIENTS)])
            raise InputError(f"setting ingredients: {name!r} is unknown; choose from {known}")
        try:
            found[name] = _problem(problem, INGREDIENTS.get(name, Ingredient(name)))
        except InputError:
            if names:
                raise
    if not found:
        raise InputError(f"{problem.record.name}: no ingredient of the hybrid serves these data; choose another model")
    return found


def _problem(problem: Problem, ingredient: Ingredient) -> tuple[Model, Problem]:
    record, entry = problem.record, MODELS[ingredient.model]
    check_record(entry, record)
    if ingredient.scene and problem.scene is None:
        raise InputError(f"ingredient {ingredient.model}: needs a scene; give --scene SCENE")
    chosen = entry.serving(record.task, ingredient.scene)
    given = {"model": ingredient.model, "seed": problem.seed}
    stated = (*ingredient.settings, *(ingredient.of_spectra if task_of(record).image else ()))
    settings = default_settings(chosen, stated, given)
    scene = problem.scene if ingredient.scene else None
    material = problem.material if ingredient.scene else None
    return chosen, replace(problem, dataset=record, settings=settings, scene=scene, material=material)


def serving(found: dict[str, tuple[Model, Problem]], split: Split, required: bool) -> dict[str, tuple[Model, Problem]]:
    """Ingredients whose checks pass; others are left out with a line in the log, or refused where they are required.

    Raises:
        InputError: of a required ingredient, or of the last one where none passes.
    """
    kept, refusal = {}, None
    for name, (entry, problem) in found.items():
        try:
            check_held_receivers(problem.record, split, entry, MODELS.values())
            if entry.check is not None:
                entry.check(problem, [split])
        except InputError as error:
            if required:
                raise
            logger.info("hybrid without %s: %s", name, error)
            refusal = error
        else:
            kept[name] = entry, problem
    if not kept and refusal is not None:
        raise refusal
    return kept
