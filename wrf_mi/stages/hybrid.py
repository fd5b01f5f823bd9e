"""The model ``hybrid``: one fit in stages, from a scene's paths to interpolation of what they leave.

Stages of the scene (`wrf_mi.stages.scene`, `wrf_mi.stages.paths`) predict from it, the last one interpolates: their
residuals and the observations themselves, weighted by the distance to the nearest training row. One hold-out
(`wrf_mi.training.selection.hold_out`) chooses stages, weights and standard deviations.

parts/  in the run folder: files of the parts
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from ..core import InputError, Prediction, Record, Split
from ..core.angles import FloatArray
from ..core.array_files import under
from ..core.settings import CheckedSettings
from ..models import MODELS
from ..models.checks import check_held_receivers, check_record
from ..models.few_rows import with_few_rows
from ..models.held_out import fit_model, held_out_predictions, labelled
from ..models.model import (
    Arrays,
    Fitted,
    HeldOutPrediction,
    Model,
    Problem,
    Session,
    default_settings,
    from_field_arrays,
    known_positions,
)
from ..models.reception import Reception
from ..tasks import task_of
from ..training import by_distance
from ..training.by_distance import Intervals, Mixture
from ..training.selection import HeldOut, away_as, hold_out
from .fitted import NEGLIGIBLE, PATHS, PREDICTED, STATED, TRACED, UPLINK_PARTS, FittedHybrid, Residuals, left_over
from .further import FURTHER_STAGES, first_of, fit_further, load_further
from .paths import TracedPaths
from .scene import FAST, FIELD, MEAN, RESIDUAL, STAGES, SURFACES, StageReport, inside, stated_reports
from .side import SceneSide
from .strengths import TracedStrengths

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class HybridSettings(CheckedSettings):
    """Settings of the hybrid."""

    #: stages that may be used, separated by commas, of mean, calibration, correction, surfaces, field and residual, and
    #: of those that installed packages add; null: all that the data allow; without a scene the field, which takes
    #: minutes and which interpolation surpasses near measurements, is used where it is named
    stages: str | None = None
    #: optimiser steps of the graph of paths and Gaussians, or, without a scene, of the field; null: the default of
    #: `TrainConfig` for the task
    steps: Annotated[int | None, Field(ge=1, description="1 or more")] = None
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


def scene_side(record: Record) -> Model:
    """Entry of the scene's side; a map of strengths is traced at one carrier."""
    return TracedStrengths() if task_of(record).in_decibel and record.frequencies_hz is not None else TracedPaths()


def _stages_of(problem: Problem) -> dict[str, str]:
    """Stages that do not apply to a problem's data, and why."""
    record = problem.record
    if record.uplink is not None:
        return dict.fromkeys(set(STAGES) - {MEAN, RESIDUAL}, "data with an uplink have mean and residual alone")
    if problem.scene is None:
        return dict.fromkeys(set(STAGES) - {FIELD, RESIDUAL}, "it is of a scene; give --scene")
    if isinstance(scene_side(record), TracedStrengths):
        return dict.fromkeys((SURFACES, FIELD), "strengths are kriged about the local mean of traced power")
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
    elif with_scene and task_of(problem.record).receiver_with_scene and {*settings.wanted} & {*STAGES} - {RESIDUAL}:
        means = [(PATHS, True)]
    if not with_scene and settings.stages is not None and FIELD in settings.wanted:
        means.append((FIELD, False))
    return means


def _part(problem: Problem, name: str, scene: bool) -> tuple[Model, Problem]:
    """Entry and problem of a part, with or without the scene."""
    if name == PATHS:
        return scene_side(problem.record), problem
    model = {FIELD: "wrf-gs+", "r2f2-scene": "r2f2"}.get(name, name)
    entry = MODELS[model].serving(problem.record.task, scene)
    arguments = {"model": model, "seed": problem.seed, "deterministic": problem.settings.deterministic}
    # Without a scene the hybrid's steps are those of the field.
    steps = [f"steps={problem.settings.steps}"] if name == FIELD and problem.settings.steps else []
    settings = default_settings(entry, steps, arguments)
    inner = replace(problem, dataset=problem.record, settings=settings, stated=frozenset())
    entry = with_few_rows(entry, problem.record.task)
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


FOLDER, KRIGING = "parts", "kriging"
STATED_ROWS = 35
"""Held-out rows that count as much as the deviations that parts state of strengths. The logarithm of the 90 % quantile
of n errors in standard deviations has a standard error of 0.88 / sqrt(n); for stated deviations 0.15 is taken:
(0.88 / 0.15)^2."""


class _Fit:
    """A fit of the hybrid: parts, each judged by the rows that the one hold-out leaves to it, and their weights."""

    def __init__(self, problem: Problem, split: Split, session: Session) -> None:
        self.problem, self.split, self.session = problem, split, session
        self.record, self.task, self.begun = problem.record, task_of(problem.record), time.perf_counter()
        self.fold = hold_out(self.record, split)
        self.held_out = None if self.fold is None else HeldOut.of(self.record, self.fold, problem.seed)
        self.parts = parts_of(problem, split)
        self.fitted: dict[str, Fitted] = {}
        self.predictions: dict[str, HeldOutPrediction] = {}
        self.reports: list[StageReport] = []
        self.residuals: Residuals | None = None
        self.scene_seconds = 0.0

    def hybrid(self) -> FittedHybrid:
        """The fitted hybrid, of the parts with a weight."""
        for name in self.parts:
            self._judge(name)
        names = [*self.predictions] or [*self.parts]
        mixture, intervals, chosen = self._mixture(len(names))
        used = _used(names, mixture)
        # A fit that ends before it is stored goes on from all parts.
        self.session.discarded.extend(self.session.folder / FOLDER / name for name in set(self.parts) - set(used))
        if KRIGING in names and len(names) > 1:
            # Strengths are kriged about the scene's in every case.
            gained = self.task.in_decibel or not {KRIGING, RESIDUAL}.isdisjoint(used)
            seconds = time.perf_counter() - self.begun - self.scene_seconds
            self.reports.append(StageReport(RESIDUAL, gained, chosen["held_out"].get("hybrid"), seconds))
        mixture = Mixture(mixture.distance_m, mixture.weights[:, [names.index(name) for name in used]])
        weights = [
            {"distance_m": float(distance), **dict(zip(used, map(float, row), strict=True))}
            for distance, row in zip(mixture.distance_m, mixture.weights, strict=True)
        ]
        stated = {"stages": stated_reports(self.reports), **chosen, "weights": weights}
        options = [{"part": name, **report} for name in self.fitted for report in self.fitted[name].options]
        away = away_as(self.split)
        stated |= {"options": options, "hold_out": away} if options else {}
        parts = {name: self._part(name) for name in used if name != RESIDUAL}
        residuals = self.residuals if RESIDUAL in used else None
        rows = self.problem.rows(self.split)
        hybrid = FittedHybrid(self.problem, rows, parts, mixture, residuals, intervals, stated)
        if intervals is not None and self.fold is not None and self.held_out is not None:
            every = {name: self.predictions[name].every for name in parts}
            pairs = {name: predicted for name, predicted in every.items() if predicted is not None}
            if len(pairs) == len(parts):
                hybrid.fit_reception(self.fold, self.held_out, pairs)
        return hybrid

    def _mixture(self, count: int) -> tuple[Mixture, Intervals | None, dict[str, Any]]:
        """Weights of so many predictions, intervals, and how both were chosen; the first where no rows are held out."""
        if self.held_out is None or not len(self.held_out) or not self.predictions:
            chosen = {"form": "alone", "sizes": PREDICTED, "held_out": dict[str, float]()}
            return by_distance.constant(np.eye(count)[0]), None, chosen
        form, mixture, without, scores = self._weights(self.held_out)
        sizes, intervals = self._intervals(self.held_out, without)
        return mixture, intervals, {"form": form, "sizes": sizes, "held_out": scores}

    def _part(self, name: str) -> Fitted:
        if name not in self.fitted:
            place = inside(self.session, FOLDER, name)
            place.folder.mkdir(parents=True, exist_ok=True)
            self.fitted[name] = fit_model(*self.parts[name], self.split, labelled(place, name))[0]
        return self.fitted[name]

    def _judge(self, name: str) -> None:
        """Predict the held-out rows by a part, and by the residuals of the scene's side."""
        model, problem = self.parts[name]
        unseen: HeldOutPrediction | None = None
        if model.selects(problem, [self.split]):
            unseen = self._part(name).unseen
        side = self.fitted.get(name)
        if isinstance(side, SceneSide):
            self.scene_seconds = time.perf_counter() - self.begun
            self.reports += side.stages
        if self.fold is None or self.held_out is None:
            return
        if unseen is None:
            place = inside(self.session, FOLDER, name, "held")
            unseen = held_out_predictions(model, problem, self.fold, self.held_out, place, name)
        self.predictions[name] = unseen
        if isinstance(side, SceneSide) and side.with_residuals is not None:
            self.predictions[RESIDUAL] = HeldOutPrediction(side.with_residuals)
            left = left_over(side, self.record, self.split)
            self.residuals = Residuals.of(left, self.record, self.split, self.problem.seed)

    def _weights(self, held_out: HeldOut) -> tuple[str, Mixture, FloatArray, dict[str, float]]:
        """Form of the weights, the weights, those of held-out rows by the others, and mean held-out scores."""
        means = np.stack([prediction.mean for prediction in self.predictions.values()])
        score, every = self.task.mixtures(means, held_out.observed(self.record)), np.arange(len(held_out))
        # Errors are independent between rows, or where receivers are held out, between these.
        unit = held_out.receiver if self.split.held_receivers else held_out.row
        scores_of = by_distance.HeldOutScores(score, held_out.distance_m, unit, len(means))
        form, mixture, without = by_distance.choose_weights(
            scores_of, held_out.group, partial(self.session.report, "choosing weights"), trusted=0
        )
        sign = 1 if self.task.higher_is_better else -1
        scores = {
            name: sign * float(score(np.broadcast_to(alone, (len(held_out), len(means))), every).mean())
            for name, alone in zip(self.predictions, np.eye(len(means)), strict=True)
        }
        scores["hybrid"] = sign * float(score(mixture(held_out.distance_m), every).mean())
        return form, mixture, without, scores

    def _intervals(self, held_out: HeldOut, weights: FloatArray) -> tuple[str, Intervals]:
        """What the sizes of expected errors are (`STATED` or `PREDICTED`), and intervals calibrated by them.

        ``weights`` [q, k] are those that each held-out row has not chosen: intervals are cross-fitted over the groups.
        """
        observed = held_out.observed(self.record)
        mean = np.einsum("qk,kq...->q...", weights, np.stack([each.mean for each in self.predictions.values()]))
        stds = [each.std for each in self.predictions.values() if each.std is not None]
        sizes, size, unit = PREDICTED, by_distance.expected_size(self.task, Prediction(mean)), np.ones((), np.float32)
        if len(stds) == len(self.predictions):
            std = np.einsum("qk,kq...->q...", weights, np.stack(stds))
            if (std > 0).all():  # kriging of two or three rows may pass through all of them
                # Few rows tell a factor of stated deviations, not how errors depend on them.
                sizes, size, unit = STATED, np.ones(mean.shape), std
        of_rows = held_out.distance_m, held_out.row, held_out.group
        intervals = by_distance.fit_intervals(mean / unit, observed / unit, size, *of_rows)
        if sizes == STATED and self.task.in_decibel:
            # Strengths calibrate what they state by rows that they hold out: few more rows change little of it.
            rows = len(np.unique(held_out.row))
            trust = rows / (rows + STATED_ROWS)
            intervals = replace(intervals, std=intervals.std**trust, factor=intervals.factor**trust)
        return sizes, intervals


def _used(names: Sequence[str], mixture: Mixture) -> list[str]:
    """Names of parts with a weight, the residuals as the last and with the scene's side, which they are about."""
    used = [name for name, most in zip(names, mixture.weights.max(axis=0), strict=True) if most >= NEGLIGIBLE]
    if RESIDUAL in used:
        used.remove(RESIDUAL)
        used = [*(() if PATHS in used else (PATHS,)), *used, RESIDUAL]
    return used


def _fitted(problem: Problem, split: Split, session: Session) -> FittedHybrid:
    return _Fit(problem, split, session).hybrid()


class Hybrid(Model):
    """The hybrid for any task, or for data of one."""

    name, source, settings = "hybrid", "docs/hybrid.md", HybridSettings
    summary = "one fit in stages: paths of a scene, its correction, Gaussians, interpolation of the rest"
    scene_summary = ""
    scene, uplink, headings = "optional", "optional", True
    several_carriers, new_receivers = True, True
    train_arguments = ("deterministic",)
    presets = MappingProxyType({"fast": (f"stages={','.join(FAST)}",), "default": ()})

    def __init__(self, gaps: tuple[str, ...] = ()) -> None:
        self.gaps = gaps

    def serving(self, task: str, with_scene: bool) -> Hybrid:
        """The hybrid, whose arrays have the gaps of its parts' arrays."""
        parts = [MODELS[name] for name in (KRIGING, "wrf-gs+", *UPLINK_PARTS) if MODELS[name].serves(task)]
        gaps = {name for part in parts for name in part.serving(task, with_scene).gaps}
        return Hybrid((*by_distance.GAPS, *sorted(gaps)))

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
        stated = first_of(fitted).stated
        stated["stages"] = [*stated["stages"], *reports]
        stated["options"] = [*stated.get("options", []), *options]
        return fitted

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The hybrid that `FittedHybrid.arrays` described, and stages of other packages after it."""
        facts = json.loads(str(arrays["facts"]))
        if "sizes" not in facts:
            raise InputError(f"{folder}: a hybrid of an earlier version, which mixed other models; train the run anew")
        parts: dict[str, Fitted] = {}
        for name in map(str, arrays["names"]):
            entry, inner = _part(problem, name, name in TRACED)
            parts[name] = entry.load(under(f"{name}/", arrays), inner, folder / FOLDER / name)
        mixture = from_field_arrays(Mixture, under("mixture/", arrays))
        stored, left = under("intervals/", arrays), under("residuals/", arrays)
        residuals = Residuals.from_arrays(left, problem.record) if left else None
        intervals = from_field_arrays(Intervals, stored) if stored else None
        reception = Reception.from_arrays(arrays, problem.record)
        hybrid = FittedHybrid(problem, arrays["known"], parts, mixture, residuals, intervals, facts, reception)
        return load_further(arrays, hybrid)

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Steps where no stage trains step by step."""
        idle = _stages_of(problem)
        trained = [name for name, _ in _means(problem) if name == FIELD or (name == PATHS and FIELD not in idle)]
        return {} if trained else {"steps": "no stage is trained step by step"}

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
