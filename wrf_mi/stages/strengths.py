"""Scene model of signal strengths: kriging about the power traced in the stated or the calibrated scene.

For a transmitter whose position is known to a decimetre, ray tracing gives the mean over some wavelengths: single
paths, and Gaussians that change them, say nothing of the fading about it. So the stages surfaces and field are not
tried, and the mean is local, unless power at the stated positions themselves predicts held-out rows better.

The direct path through walls has most of what a scene tells of strengths: with 64 training rows of a measured flat it
has four fifths of the gain of paths with up to two reflections, whose search takes 60 times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import numpy as np

from ..core import InputError, Record, Split
from ..core.types import FloatArray, IntArray
from ..correction.options import STRENGTHS
from ..estimators.interpolation.strength_settings import StrengthSettings
from ..estimators.interpolation.strengths import Strengths
from ..estimators.model import Arrays, Model, PredictAll, Problem, Session
from ..scene.correction_data import read_correction_data
from ..tracing.options import MAX_DEPTH, TraceOptions
from ..tracing.paths.solve import Prepared
from ..tracing.power_map import OnShare, Traced, TracedPower, Tracer, power_tracer, trace_map
from ..tracing.search.chains import search_seconds
from ..tracing.tracer import check_polarization, fit_offsets
from .engine import Engine, OptionReport
from .kriging import StrengthKriging
from .residual import StrengthResidual
from .runs import Runs
from .scene import MEAN, SceneStage, StageReport, in_scene, scene_reports
from .scene_model import FittedInScene, some_rows
from .stage import Option, Stage, State

SPACING_M, SMOOTH_M = 0.25, 0.3
"""Spacing of the traced grid, and standard deviation of the Gaussian over which powers are averaged."""
RAYS = 1 << 17  # from each receiver in the search for reflected paths
TRACE = TraceOptions(transmission=True, depth=STRENGTHS.depth, reflections=STRENGTHS.reflections, rays=RAYS)
"""Paths of a local mean, as a correction has them."""
THROUGH = TraceOptions(transmission=True, depth=MAX_DEPTH, reflections=0)  # walls, as many as can be traced
DIRECT, LOCAL, EXACT = "direct", "local", "exact"
"""Options of the mean: local means of direct and of all paths, and power of all paths at positions themselves."""


class FittedStrengths(FittedInScene):
    """Scene model of strengths: kriging about traced power."""

    fitted: Strengths

    def in_scene(self, scene: str) -> FittedStrengths:
        """Kriged differences from the power traced in the stated scene, about the power traced in an edited one."""
        problem, field = replace(self.problem, scene=scene, material=None), copy(self.fitted.field)
        power = self._power(problem)
        # The posterior of the training rows is about the scene in which they were measured.
        field.prior = replace(field.prior, traced=power)
        return FittedStrengths(replace(self.fitted, field=field), problem)

    def traced(self, problem: Problem, split: Split) -> PredictAll:
        """Traced power [n_rx, m] of the kind of the fit's mean, with offsets by some training rows."""
        power, numbers = self._power(problem), range(len(problem.record.receivers))

        def of_all(position_m: FloatArray) -> FloatArray:
            return np.stack([power(position_m, number) for number in numbers])

        record, rows = problem.record, some_rows(split)
        offsets = fit_offsets(of_all(record.tx_pos_m[rows]), record.seen(split).observation[:, rows])
        return lambda inputs: offsets(of_all(inputs.tx_pos_m))

    def _power(self, problem: Problem) -> Traced:
        """Power in a problem's scene, of the kind of the fit's mean."""
        mean = self.fitted.field.prior.traced
        assert mean is not None, "the scene model is about traced power"
        return _mean(problem, EXACT if mean.exact else LOCAL if mean.reflections else DIRECT)

    def refit(self, record: Record, rows: IntArray) -> FittedStrengths:
        """The kriging given some rows, see `Fitted`, about the power traced in the scene that all rows corrected."""
        strengths, data = self.fitted.refit(record, rows), read_correction_data(self.problem.scene)
        if data is not None and data.knows(record.name, rows).any():
            # Errors of the other rows, which the scene knows, are as much too small: deviations stay in proportion.
            strengths = replace(strengths, widen=strengths.widen / data.error_ratio)
        return FittedStrengths(strengths, self.problem)


class Mean(Stage):
    """Traced power as the mean of strengths."""

    name = MEAN

    def options(self, problem: Problem, split: Split) -> Sequence[Option]:
        """Local means of direct and of all paths, and where positions may be exact the power there.

        Whoever turns carries the antenna beside the stated position, and receivers whose places are estimates are
        estimated anew by each hold-out.
        """
        names = [DIRECT]
        if affordable(problem):
            names.append(LOCAL)
            if problem.record.tx_heading_rad is None and all(each.is_surveyed for each in problem.record.receivers):
                names.append(EXACT)
        return [Option(name, partial(self._fit, name)) for name in names]

    def _fit(self, name: str, state: State, split: Split, session: Session) -> State:
        on_share = partial(session.progress, "tracing a map")
        on_share(0.0)
        return replace(state, mean=_mean(state.problem, name, on_share))


def _mean(problem: Problem, name: str, on_share: OnShare = lambda share: None) -> Traced:
    """Traced power of an option by its name."""
    scene, record = problem.opened_scene, problem.record
    local = trace_map(scene, record, SPACING_M, SMOOTH_M, THROUGH if name == DIRECT else TRACE, on_share)
    if name != EXACT:
        return local
    return TracedPower(local, power_tracer(scene, record, TRACE), np.arange(len(record.receivers)), {})


def affordable(problem: Problem) -> bool:
    """Whether a search for reflected paths to all receivers takes no longer than the settings allow."""
    limit_s = problem.settings.search_seconds
    return limit_s is None or search_seconds(TRACE, RAYS, len(problem.record.receivers)) <= limit_s


class TracedStrengths(Model):
    """Scene model of strengths: no name of the registry."""

    name, source, settings = "strengths", StrengthKriging.source, object
    tasks, gaps = ("rssi",), StrengthKriging.gaps
    scene, uplink, headings = "required", "optional", True
    several_carriers, new_receivers = True, True

    def fit(self, problem: Problem, split: Split, session: Session) -> FittedStrengths:
        """Calibrate the scene, trace its mean, and fit kriging about it."""
        # A calibration searches for as many paths as the local mean.
        calibration = [SceneStage()] if affordable(problem) else []
        stages = *calibration, Mean(), Runs(), StrengthResidual(StrengthSettings())
        engine = Engine(self, stages, problem, split, session)
        state = engine.fit()
        strengths = state.fitted
        assert isinstance(strengths, Strengths)
        field, traced = strengths.field, strengths.field.prior.traced
        if traced is not None and traced.exact:
            field.prior = replace(field.prior, traced=traced.of_predictions(field.stops.poses.position_m))
        fitted = FittedStrengths(strengths, state.problem, _stage_reports(engine.reports))
        fitted.unseen, fitted.options = engine.unseen, engine.stated_reports()
        return fitted

    def selects(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """By held-out rows."""
        return True

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


def _stage_reports(options: Sequence[OptionReport]) -> list[StageReport]:
    """Reports of the mean, and of the calibration where it was tried: whether it was taken, and its score."""
    of_mean = [option for option in options if option.stage == MEAN]
    taken_option = next(option for option in of_mean if option.taken)
    seconds = sum(option.seconds or 0.0 for option in of_mean)
    return [StageReport(MEAN, True, taken_option.held_out, seconds), *scene_reports(options, False)[1:]]
