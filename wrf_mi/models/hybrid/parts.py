"""Parts of the hybrid's prediction, by the data: the scene's side, interpolation, and the downlink from an uplink."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Annotated

from pydantic import Field

from ...core import InputError, Record, Split
from ...core.settings import CheckedSettings
from ...tasks import task_of
from .. import MODELS
from ..checks import check_held_receivers, check_record
from ..few_rows import with_few_rows
from ..model import Model, Problem, default_settings
from .paths import InScene, Paths
from .scene_side import FIELD, RESIDUAL, STAGES, needs_scene
from .strengths import StrengthsInScene, TracedStrengths

logger = logging.getLogger(__name__)

PATHS, KRIGING = "paths", "kriging"
UPLINK_PARTS = ("r2f2", "optml", "fire", "linear")
"""Models of a downlink, the first of which is the mean that others have to improve on."""
TRACED = (PATHS, "r2f2-scene")  # parts that are given the scene


@dataclass(frozen=True)
class HybridSettings(CheckedSettings):
    """Settings of the hybrid.

    Attributes:
        stages: stages that may be used, separated by commas, of mean, calibration, correction, surfaces, field and
            residual; null: all that the data allow; without a scene the field, which takes minutes and which
            interpolation surpasses near measurements, is used where it is named.
        steps: optimiser steps of the graph of paths and Gaussians; null: the default of `TrainConfig` for the task.
        deterministic: bit-identical results from run to run, on one thread of the CPU.
    """

    stages: str | None = None
    steps: Annotated[int | None, Field(ge=1, description="1 or more")] = None
    deterministic: bool = False

    def __post_init__(self) -> None:
        """Refuse unknown stages.

        Raises:
            InputError: a stage that there is not.
        """
        super().__post_init__()
        if unknown := [stage for stage in self.wanted if stage not in STAGES]:
            raise InputError(f"stages: {unknown[0]!r} is unknown; choose of {', '.join(STAGES)}")

    @property
    def wanted(self) -> tuple[str, ...]:
        """Stages that may be used."""
        return STAGES if self.stages is None else tuple(stage.strip() for stage in self.stages.split(","))


def scene_side(record: Record) -> tuple[Model, Model]:
    """Entries of the scene's side with and without its correction; a map of strengths is traced at one carrier."""
    if task_of(record).in_decibel and record.frequencies_hz is not None:
        return TracedStrengths(), StrengthsInScene()
    return Paths(), InScene()


def parts_of(problem: Problem, split: Split) -> dict[str, tuple[Model, Problem]]:
    """Entry and problem of each part that serves the data, the trusted one first.

    Raises:
        InputError: no part serves the data, or a scene that cannot be used.
    """
    settings: HybridSettings = problem.settings
    record, task, wanted = problem.record, task_of(problem.record), settings.wanted
    parts: dict[str, tuple[Model, Problem]] = {}
    if record.uplink is not None:
        names = (("r2f2-scene", True),) if problem.scene is not None else ()
        for name, scene in (*names, *((name, False) for name in UPLINK_PARTS)):
            _add(parts, name, problem, split, scene)
    elif problem.scene is not None and task.receiver_with_scene and needs_scene(wanted):
        _add(parts, PATHS, problem, split, True)
    if problem.scene is None and settings.stages is not None and FIELD in wanted:
        _add(parts, FIELD, problem, split, False)
    if RESIDUAL in wanted or not parts:
        _add(parts, KRIGING, problem, split, False)
    if not parts:
        raise InputError(f"{record.name}: no stage serves these data; choose another model")
    return parts


def stored_parts(problem: Problem, names: list[str]) -> dict[str, tuple[Model, Problem]]:
    """Entry and problem of parts of a fitted hybrid."""
    return {name: _part(problem, name, name in TRACED) for name in names}


def _part(problem: Problem, name: str, scene: bool) -> tuple[Model, Problem]:
    if name == PATHS:
        return scene_side(problem.record)[0], problem
    model = {FIELD: "wrf-gs+", "r2f2-scene": "r2f2"}.get(name, name)
    entry = MODELS[model].serving(problem.record.task, scene)
    arguments = {"model": model, "seed": problem.seed, "deterministic": problem.settings.deterministic}
    inner = replace(problem, dataset=problem.record, settings=default_settings(entry, (), arguments))
    entry = with_few_rows(entry, problem.record.task)
    return entry, inner if scene else replace(inner, scene=None, material=None)


def _add(parts: dict[str, tuple[Model, Problem]], name: str, problem: Problem, split: Split, scene: bool) -> None:
    """Add a part that the data allow; others are left out with a line in the log, but not one with the scene.

    Raises:
        InputError: a scene that cannot be used.
    """
    try:
        entry, inner = _part(problem, name, scene)
        check_record(entry, problem.record)
        check_held_receivers(problem.record, split, entry, MODELS.values())
        entry.check(inner, [split])
    except InputError as error:
        if scene:
            raise
        logger.info("hybrid without %s: %s", name, error)
    else:
        parts[name] = entry, inner
