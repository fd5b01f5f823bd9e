"""The scene's side for signal strengths: kriging about the power traced in the corrected scene.

For a transmitter whose position is known to a decimetre, ray tracing gives the mean over some wavelengths: single
paths, and Gaussians that change them, say nothing of the fading about it. So stages 4 and 5 are not tried, and the mean
is local, unless power at the stated positions themselves predicts held-out rows better.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError, Receiver, Record, Split
from ..core.files import write_atomically
from ..core.types import IntArray
from ..correction.options import STRENGTHS
from ..models.held_out import HeldOutPrediction, held_out_predictions
from ..models.interpolation.strengths import Strengths, StrengthSettings, fit_strengths
from ..models.model import Arrays, Model, Problem, Session
from ..scene.correction_data import read_correction_data
from ..tasks import task_of
from ..tracing.options import TraceOptions
from ..tracing.paths.solve import Prepared
from ..tracing.power_map import PowerMap, TracedPower, Tracer, power_tracer, trace_map
from ..tracing.tracer import check_polarization
from ..training.by_distance import unit_means
from ..training.selection import HeldOut, hold_out
from .kriging import StrengthKriging
from .scene_side import MEAN, SCENE, SceneSide, corrected, in_scene, inside, write_reports

SPACING_M, SMOOTH_M = 0.25, 0.3
"""Spacing of the traced grid, and standard deviation of the Gaussian over which powers are averaged."""
TRACE = TraceOptions(transmission=True, depth=STRENGTHS.depth, reflections=STRENGTHS.reflections)  # as a correction's
DEFAULT = StrengthSettings()
SEARCH_ROWS = 30  # least number of rows by which hyperparameters about an exact mean are searched
HELD, TRIED = "held", "tried"  # folders of the predictions of held-out rows, and of those that choose the mean
NEVER = 2**31  # `StrengthSettings.search_rows` above any number of rows
ExactMean = Callable[[Sequence[Receiver]], TracedPower]
"""Power at positions themselves for some receivers of a problem; fits share what was traced."""


class FittedStrengths(SceneSide):
    """The scene's side for strengths: kriging about traced power."""

    fitted: Strengths
    unseen: HeldOutPrediction | None = None  # predictions of held-out rows

    def in_scene(self, scene: str) -> FittedStrengths:
        """Kriged differences from the power traced in the stated scene, about the power traced in an edited one."""
        problem, field = replace(self.problem, scene=scene, material=None), copy(self.fitted.field)
        exact = field.prior.traced is not None and field.prior.traced.exact
        power = _traced(problem)(problem.record.receivers) if exact else _local_mean(problem)
        # The posterior of the training rows is about the scene in which they were measured.
        field.prior = replace(field.prior, traced=power)
        return FittedStrengths(replace(self.fitted, field=field), problem)

    def refit(self, record: Record, rows: IntArray) -> FittedStrengths:
        """The kriging given some rows, see `Fitted`, about the power traced in the scene that all rows corrected."""
        strengths, data = self.fitted.refit(record, rows), read_correction_data(self.problem.scene)
        if data is not None and data.knows(record.name, rows).any():
            # Errors of the other rows, which the scene knows, are as much too small: deviations stay in proportion.
            strengths = replace(strengths, widen=strengths.widen / data.error_ratio)
        return FittedStrengths(strengths, self.problem)

    def held_out_at(self, held_out: HeldOut) -> HeldOutPrediction | None:
        """Predictions of the rows that were held out, see `SceneSide`."""
        return self.unseen


def _chosen(
    stated: Problem, inner: Problem, split: Split, fold: Split, held_out: HeldOut, session: Session
) -> dict[str, Any]:
    """Scene, mean and hyperparameters, by rows that a fold holds out and, the last, those that it trains on."""
    record, received = stated.record, replace(held_out, every=held_out.every[:0])
    unit = held_out.receiver if split.held_receivers else held_out.row

    def score(problem: Problem, name: str, mean: ExactMean | None = None) -> float:
        # Which mean is better does not depend on a search for hyperparameters.
        model, place = StrengthsInScene(StrengthSettings(search_rows=NEVER), mean), inside(session, TRIED, name)
        means = held_out_predictions(model, problem, fold, received, place, "mean").mean
        of_row = task_of(record).mixtures(means[None], held_out.observed(record))
        return float(unit_means(of_row(np.ones((len(held_out), 1)), np.arange(len(held_out))), unit).mean())

    problem, best = inner, score(inner, "corrected")
    if inner is not stated:
        # The correction has gained as a trace, but may add nothing to kriging, which knows the level around each row.
        before = score(stated, "stated")
        if before >= best:
            problem, best = stated, before
    mean = None
    if record.tx_heading_rad is None and all(receiver.is_surveyed for receiver in record.receivers):
        # Whoever turns carries the antenna beside the stated position; elsewhere, positions may be exact, unless
        # receivers' are estimates, which each hold-out makes anew.
        exact = _traced(problem)
        mean = exact if score(problem, "exact", exact) > best else None
    judged = _Remembering(_searched(mean), mean)
    shutil.rmtree(session.folder / HELD, ignore_errors=True)  # of a stopped fit
    held_out_predictions(judged, problem, fold, held_out, inside(session, HELD), "paths")
    hyperparameters = asdict(judged.last.fitted.field.hyperparameters)
    return {"corrected": problem is not stated, "exact": mean is not None, "hyperparameters": hyperparameters}


def _searched(mean: ExactMean | None) -> StrengthSettings:
    """Settings of a search: it starts from hyperparameters of fading, which an exact mean has not."""
    return DEFAULT if mean is None else StrengthSettings(search_rows=SEARCH_ROWS)


def _traced(problem: Problem) -> ExactMean:
    trace, names = power_tracer(problem.opened_scene, problem.record, TRACE), _names(problem.record.receivers)
    power = TracedPower(_local_mean(problem), trace, np.arange(len(names)), {})
    return lambda receivers: power.at(np.array([names.index(name) for name in _names(receivers)]))


def _names(receivers: Sequence[Receiver]) -> list[str]:
    return [receiver.name for receiver in receivers]


def _local_mean(problem: Problem) -> PowerMap:
    return trace_map(problem.opened_scene, problem.record, SPACING_M, SMOOTH_M, TRACE)


class StrengthsInScene(Model):
    """Kriging about power traced in a scene that is corrected already: no name of the registry.

    Args:
        search: settings of the kriging.
        mean: mean of all receivers; None: the local mean.
    """

    name, source, settings = "strengths", StrengthKriging.source, object
    tasks, gaps = ("rssi",), StrengthKriging.gaps
    scene, uplink, headings = "required", "optional", True
    several_carriers, new_receivers = True, True

    def __init__(self, search: StrengthSettings = DEFAULT, mean: ExactMean | None = None) -> None:
        self.search, self.mean = search, mean

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedStrengths:
        """Trace a map, and fit kriging about it."""
        session.report("tracing a map", 0.0)
        record = problem.record
        power = _local_mean(problem) if self.mean is None else self.mean(record.receivers)
        fitted = fit_strengths(record, problem.rows(split), power, self.search, session.report, stated=())
        if power.exact:
            field = fitted.field
            field.prior = replace(field.prior, traced=power.of_predictions(field.stops.poses.position_m))
        return FittedStrengths(fitted, problem)

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> FittedStrengths:
        """The kriging that `FittedStrengths.arrays` described."""
        inner = in_scene(problem, folder)

        @cache
        def tracer() -> Tracer:  # the scene is opened where something is traced
            return power_tracer(inner.opened_scene, inner.record, TRACE)

        strengths = Strengths.from_arrays(arrays, lambda position_m, places: tracer()(position_m, places))
        return FittedStrengths(strengths, inner)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse data without a single, known carrier, and antennas inside solids.

        Raises:
            InputError: naming them.
        """
        record = problem.record
        if record.frequencies_hz is None:
            raise InputError(f"{record.name}: carrier frequency unknown, or several; a map is traced at one")
        Prepared(problem.opened_scene).check(record.tx_pos_m, record.receivers)
        check_polarization(problem.opened_scene, record.tx_pos_m, record.receivers, record.tx_antenna)


class _Remembering(StrengthsInScene):
    """Keeps its last fit, whose hyperparameters the final one starts from."""

    last: FittedStrengths

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedStrengths:
        self.last = super().fit(problem, split, session)
        return self.last


class TracedStrengths(StrengthsInScene):
    """The scene's side for strengths."""

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedStrengths:
        """Correct the scene, trace a map in it, and fit kriging about it."""
        inner, reports = corrected(problem, split, session)
        fold = hold_out(problem.record, split)
        if fold is None:
            fitted = StrengthsInScene().fit(inner, split, session)
        else:
            held_out, path = HeldOut.of(problem.record, fold, problem.seed), session.folder / "mean.json"
            if not path.exists():
                write_atomically(path, json.dumps(_chosen(problem, inner, split, fold, held_out, session)) + "\n")
            session.discarded.append(session.folder / TRIED)
            choice = json.loads(path.read_text())
            if inner is not problem and not choice["corrected"]:
                inner, reports = problem, [replace(report, kept=report.stage == MEAN) for report in reports]
                write_reports(session.folder, reports)  # for a resumed fit, which no longer finds the scene
                shutil.rmtree(session.folder / SCENE)
            mean = _traced(inner) if choice["exact"] else None
            # The search goes on from what was found without the held-out rows.
            settings = replace(_searched(mean), **choice["hyperparameters"])
            fitted = StrengthsInScene(settings, mean).fit(inner, split, session)
            place = inside(session, HELD)  # where the choice left these predictions
            fitted.unseen = held_out_predictions(StrengthsInScene(), inner, fold, held_out, place, "paths")
        fitted.stages = tuple(reports)
        return fitted
