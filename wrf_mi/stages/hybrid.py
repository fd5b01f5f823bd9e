"""The model ``hybrid``: one fit in stages, from a scene's paths to interpolation of what they leave.

Stages of the scene (`wrf_mi.stages.scene`, `wrf_mi.stages.paths`) predict from it, the last one interpolates: their
residuals and the observations themselves, weighted by the distance to the nearest training row. One hold-out
(`wrf_mi.training.selection.hold_out`) chooses stages, weights and standard deviations.

parts/  in the run folder: files of the parts
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

from pydantic import Field

from ..core import InputError, Record, Split
from ..core.settings import CheckedSettings, Positive
from ..estimators.checks import check_held_receivers, check_record
from ..estimators.few_rows import with_few_rows
from ..estimators.model import (
    Arrays,
    Fitted,
    HeldOutPrediction,
    Model,
    Problem,
    Session,
    default_settings,
    known_positions,
)
from ..models import MODELS
from ..training.by_distance import GAPS
from ..training.selection import away_as
from .fitted import FIELD_IN_SCENE, PATHS, TRACED, UPLINK_PARTS, FittedMixture, Residuals, training_residuals
from .further import FURTHER_STAGES, first_of, fit_further, load_further
from .mixture import MixtureFit, Part
from .paths import TracedPaths
from .scene import FAST, FIELD, MEAN, RESIDUAL, STAGES, SURFACES, StageReport, inside, stated_reports
from .scene_model import FittedInScene
from .strengths import TracedStrengths

logger = logging.getLogger(__name__)

NAME, FOLDER, KRIGING = "hybrid", "parts", "kriging"


@dataclass(frozen=True)
class HybridSettings(CheckedSettings):
    """Settings of the hybrid."""

    #: stages that may be used, separated by commas, of mean, calibration, correction, surfaces, field and residual, and
    #: of those that installed packages add; null: all that the data allow; without a scene and for signal strengths the
    #: field, which takes minutes and which interpolation surpasses near measurements, is used where it is named
    stages: str | None = None
    #: optimiser steps of the graph of paths and Gaussians, or, without a scene, of the field; null: the default of
    #: `TrainConfig` for the task
    steps: Annotated[int | None, Field(ge=1, description="1 or more")] = None
    #: longest search for reflected paths to all receivers of signal strengths, as estimated for two cores, seconds: in
    #: place of longer ones, power is that of direct paths through walls, and materials are not calibrated; null: any
    search_seconds: Positive | None = None
    deterministic: bool = False  #: bit-identical results from run to run, on one thread of the CPU

    def __post_init__(self) -> None:
        super().__post_init__()
        every = (*STAGES, *FURTHER_STAGES)
        if unknown := [stage for stage in self.wanted if stage not in every]:
            raise InputError(f"stages: {unknown[0]!r} is unknown; choose of {', '.join(every)}")

    @property
    def wanted(self) -> tuple[str, ...]:
        """Stages that may be used, those of installed packages last."""
        if self.stages is None:
            return (*STAGES, *FURTHER_STAGES)
        return tuple(stage.strip() for stage in self.stages.split(","))


def scene_model(record: Record) -> Model:
    """Entry of the scene model; a map of strengths is traced at one carrier."""
    return TracedStrengths() if record.task.kriged_about_paths and record.frequencies_hz is not None else TracedPaths()


def _stages_of(problem: Problem) -> dict[str, str]:
    """Stages that do not apply to a problem's data, and why."""
    record = problem.record
    if record.uplink is not None:
        return dict.fromkeys(set(STAGES) - {MEAN, RESIDUAL}, "data with an uplink have mean and residual alone")
    if problem.scene is None:
        return dict.fromkeys(set(STAGES) - {FIELD, RESIDUAL}, "it is of a scene; give --scene")
    if isinstance(scene_model(record), TracedStrengths):
        return {SURFACES: "strengths are kriged about the local mean of traced power"}
    return {}


def parts_of(problem: Problem, split: Split) -> dict[str, tuple[Model, Problem]]:
    """Entry and problem of each part that serves the data, the trusted one first (InputError: none does)."""
    parts: dict[str, tuple[Model, Problem]] = {}
    for name, scene in _means(problem):
        _add(parts, name, problem, split, scene)
    if RESIDUAL in problem.settings.wanted or not parts:
        _add(parts, KRIGING, problem, split, False)
    if not parts:
        raise InputError(f"{problem.record.name}: no stage serves these data; choose another model")
    return parts


def _means(problem: Problem) -> list[tuple[str, bool]]:
    """Names of the parts but for kriging, and whether they are given the scene."""
    settings, with_scene, means = problem.settings, problem.scene is not None, list[tuple[str, bool]]()
    if problem.record.uplink is not None:
        of_uplink = [("r2f2-scene", True)] * with_scene + [(name, False) for name in UPLINK_PARTS]
        means = of_uplink if MEAN in settings.wanted else []
    elif with_scene and problem.record.task.receiver_with_scene and {*settings.wanted} & {*STAGES} - {RESIDUAL}:
        means = [(PATHS, True)]
    if settings.stages is not None and FIELD in settings.wanted:
        # The graph of paths has a field itself; beside kriged strengths it is a part of its own, which takes minutes.
        if not with_scene:
            means.append((FIELD, False))
        elif isinstance(scene_model(problem.record), TracedStrengths):
            means.append((FIELD_IN_SCENE, True))
    return means


def _part(problem: Problem, name: str, scene: bool) -> tuple[Model, Problem]:
    """Entry and problem of a part, with or without the scene."""
    if name == PATHS:
        return scene_model(problem.record), problem
    model = {FIELD: "wrf-gs+", FIELD_IN_SCENE: "wrf-gs+", "r2f2-scene": "r2f2"}.get(name, name)
    entry = MODELS[model].serving(problem.record.task.name, scene)
    arguments = {"model": model, "seed": problem.seed, "deterministic": problem.settings.deterministic}
    # Those of the hybrid are steps of a field that is a part.
    is_field = name in (FIELD, FIELD_IN_SCENE)
    steps = [f"steps={problem.settings.steps}"] if is_field and problem.settings.steps else []
    settings = default_settings(entry, steps, arguments)
    inner = replace(problem, dataset=problem.record, settings=settings, stated=frozenset())
    entry = with_few_rows(entry, problem.record.task.name)
    return entry, inner if scene else replace(inner, scene=None, material=None)


def _add(parts: dict[str, tuple[Model, Problem]], name: str, problem: Problem, split: Split, scene: bool) -> None:
    """Add a part that the data allow; others are left out with a line in the log, but not one with the scene."""
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


def _fitted(problem: Problem, split: Split, session: Session) -> FittedMixture:
    """All parts, mixed by held-out rows."""
    begun, parts = time.perf_counter(), parts_of(problem, split)
    places = {name: inside(session, FOLDER, name) for name in parts}
    fit = MixtureFit(NAME, {name: Part(*parts[name], place) for name, place in places.items()}, problem, split, session)
    reports, residuals = list[StageReport](), None
    for name in parts:
        fit.predict_held_out(name)
        fitted_part = fit.fitted.get(name)
        if isinstance(fitted_part, FittedInScene):
            reports += fitted_part.stages
            begun = time.perf_counter()  # of the stage residual
            if fitted_part.with_residuals is not None and fit.rows is not None:
                fit.predictions[RESIDUAL] = HeldOutPrediction(fitted_part.with_residuals)
                left = training_residuals(fitted_part, problem.record, split)
                residuals = Residuals.of(left, problem.record, split, problem.seed)
    chosen = fit.weights()
    used, scores = fit.used(chosen), fit.scores(chosen)
    # A fit that ends before it is stored goes on from all parts.
    session.discarded.extend(place.folder for name, place in places.items() if name not in used)
    if KRIGING in fit.names and len(fit.names) > 1:
        gained = problem.record.task.kriged_about_paths or not {KRIGING, RESIDUAL}.isdisjoint(used)
        reports.append(StageReport(RESIDUAL, gained, scores.get(NAME), time.perf_counter() - begun))
    facts = {"stages": stated_reports(reports), "form": chosen.form, "held_out": scores}
    fitted = fit.mixture(chosen, residuals, facts)
    weights = zip(map(float, fitted.mixture.distance_m), fitted.mixture.weights.tolist(), strict=True)
    fitted.stated["weights"] = [{"distance_m": at_m, **dict(zip(used, row, strict=True))} for at_m, row in weights]
    options = [{"part": name, **report} for name, part in fit.fitted.items() for report in part.options]
    if options:
        fitted.stated |= {"options": options, "hold_out": away_as(problem.record, split)}
    return fitted


class Hybrid(Model):
    """The hybrid for any task, or for data of one."""

    name, source, settings = NAME, "docs/hybrid.md", HybridSettings
    summary = "one fit in stages: paths of a scene, its correction, Gaussians, interpolation of the rest"
    scene_summary = ""
    scene, uplink, headings = "optional", "optional", True
    several_carriers, new_receivers = True, True
    train_arguments = ("deterministic",)
    presets = MappingProxyType({"fast": (f"stages={','.join(FAST)}", "search_seconds=20"), "default": ()})

    def __init__(self, gaps: tuple[str, ...] = ()) -> None:
        self.gaps = gaps

    def serving(self, task: str, with_scene: bool) -> Hybrid:
        """The hybrid, whose arrays have the gaps of its parts' arrays."""
        parts = [MODELS[name] for name in (KRIGING, "wrf-gs+", *UPLINK_PARTS) if MODELS[name].serves(task)]
        gaps = {name for part in parts for name in part.serving(task, with_scene).gaps}
        return Hybrid((*GAPS, *sorted(gaps)))

    def pools_receivers(self, problem: Problem) -> bool:
        """Whether no part is the graph of a scene's paths, which is fitted to the rows of each receiver."""
        return problem.scene is None or problem.record.frequencies_hz is not None

    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Fit all parts, and choose weights and standard deviations by held-out rows.

        Raises:
            InputError: unknown positions, or no part that can be fitted.
            Interrupted: stopped; finished parts are kept.
        """
        known_positions(problem.record, problem.rows(split), self.name)
        names = [name for name in problem.settings.wanted if name in FURTHER_STAGES]
        names = [name for name in names if FURTHER_STAGES[name].options(problem, split)]
        if not names:
            return _fitted(problem, split, session)
        fitted, reports, options = fit_further(self, _fitted, names, problem, split, session)
        facts = first_of(fitted).stated
        facts["stages"] = [*facts["stages"], *reports]
        facts["options"] = [*facts.get("options", []), *options]
        return fitted

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The hybrid that `FittedMixture.arrays` described, and stages of other packages after it."""

        def load(name: str, of_part: Arrays) -> Fitted:
            entry, inner = _part(problem, name, name in TRACED)
            return entry.load(of_part, inner, folder / FOLDER / name)

        return load_further(arrays, FittedMixture.from_arrays(self.name, arrays, problem, load))

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Steps where no stage trains step by step, and a limit of searches where there are none."""
        idle, unused = _stages_of(problem), dict[str, str]()
        means = _means(problem)
        trained = [name for name, _ in means if name != PATHS or SURFACES not in idle]
        if not {*trained} & {PATHS, FIELD, FIELD_IN_SCENE}:
            unused["steps"] = "no stage is trained step by step"
        if (PATHS, True) not in means or not isinstance(scene_model(problem.record), TracedStrengths):
            unused["search_seconds"] = "no signal strengths are traced in a scene"
        return unused

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse unknown positions, and data that no part can be fitted to."""
        settings, idle = problem.settings, _stages_of(problem)
        if "stages" in problem.stated_settings:
            for stage in settings.wanted:
                if stage in idle:
                    raise InputError(f"--stages {settings.stages}: {stage} has no effect: {idle[stage]}; omit it")
            if problem.scene is not None and {*settings.wanted} & {*STAGES} == {RESIDUAL}:
                raise InputError(f"--scene {problem.scene}: not used by --stages {RESIDUAL}; omit one of them")
        for split in splits:
            known_positions(problem.record, split.all_train, self.name)
            parts_of(problem, split)


MODEL = Hybrid()
