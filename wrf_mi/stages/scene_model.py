"""Scene model of a fit in stages, fitted in the scene that the measurements have edited."""

from __future__ import annotations

from collections.abc import Collection
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Prediction, Split
from ..core.types import IntArray
from ..correction import default_options
from ..estimators.gaussian.model import FittedField
from ..estimators.model import Arrays, Decomposition, Fitted, Inputs, PredictAll, Problem
from ..tasks import instrument_of
from ..tracing import TraceOptions
from ..tracing.tracer import RayTracer, fit_offsets
from .scene import CALIBRATION, CORRECTED, FIELD, MEAN, STAGES, SURFACES, StageReport

OFFSET_ROWS = 400  # most training rows whose traces tell the offset of a receiver


class FittedInScene(Fitted):
    """A part of the hybrid that predicts from the scene, by a model fitted in it.

    ``problem`` is the hybrid's with that scene, ``stages`` are reports of those that were tried, none after loading;
    ``with_residuals`` [q, ...] are predictions of the held-out rows with what the scene model leaves of the others,
    None where none were asked for.
    """

    with_residuals: NDArray[Any] | None = None

    def __init__(self, fitted: Fitted, problem: Problem, stages: Collection[StageReport] = ()) -> None:
        self.fitted, self.problem, self.stages = fitted, problem, tuple(stages)
        self.receivers, self.uses_heading, self.carriers_hz = fitted.receivers, fitted.uses_heading, fitted.carriers_hz
        self.run_sd_db, self.traces = fitted.run_sd_db, fitted.traces

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...]."""
        return self.fitted.predict(inputs, receiver)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, of strengths in a fraction of its time."""
        return self.fitted.predict_mean(inputs, receiver)

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """Observations, and the paths' and the Gaussians' share of them where there are both."""
        return self.fitted.decompose(inputs, receiver, std)

    def tracing_once(self) -> FittedInScene:
        """As of the fitted model."""
        shared = copy(self)
        shared.fitted = self.fitted.tracing_once()
        return shared

    def in_scene(self, scene: str) -> FittedInScene:
        """The fitted model in an edited copy of the scene that it was fitted in."""
        return type(self)(self.fitted.in_scene(scene), replace(self.problem, scene=scene, material=None))

    def traced(self, problem: Problem, split: Split) -> PredictAll:
        """Observations [n_rx, m, ...] traced in a problem's scene, of strengths with offsets by some training rows."""
        record, how = problem.record, default_options(problem.record)
        single_carrier = record if record.carriers_hz is None else record.at_carrier(record.carriers_hz[0])
        options = TraceOptions(transmission=True, depth=how.depth, reflections=how.reflections)
        assert problem.scene is not None
        tracer = RayTracer(problem.scene, instrument_of(single_carrier), options, problem.material)
        offsets = None
        if record.task.has_offsets:
            rows = some_rows(split)
            offsets = fit_offsets(tracer(record.tx_pos_m[rows]), record.seen(split).observation[:, rows])

        def predict(inputs: Inputs) -> NDArray[np.generic]:
            traced = tracer.trace(inputs.tx_pos_m, first_row=inputs.first_row, carriers_hz=inputs.carriers_hz)
            observed = tracer.observe(traced)
            return observed if offsets is None else offsets(observed)

        return predict

    def arrays(self) -> Arrays:
        """Arrays of the fitted model."""
        return self.fitted.arrays()


def by_stage(
    problem: Problem, split: Split, scene_model: FittedInScene, used: Collection[str]
) -> dict[str, PredictAll]:
    """Predictions of the stages up to each but the last, of the ``used`` ones of a fitted scene model.

    The problem has the scene as it is stated; training rows of the split fit offsets of traced signal strengths.
    """
    predictions: dict[str, PredictAll] = {}
    earlier = [stage for stage in STAGES if stage in used][:-1]
    if MEAN in earlier:
        predictions[MEAN] = scene_model.traced(problem, split)
    if scene_model.problem.scene != problem.scene:
        stages = [stage for stage in (CALIBRATION, CORRECTED) if stage in earlier]
        predictions |= {stage: scene_model.traced(scene_model.problem, split) for stage in stages}
    field, count = scene_model.fitted, len(problem.record.receivers)
    if isinstance(field, FittedField):
        if SURFACES in earlier:
            fitted = field.without_gaussians() if FIELD in used else scene_model
            predictions[SURFACES] = partial(at_all_receivers, fitted, count)
        if FIELD in earlier:
            predictions[FIELD] = partial(at_all_receivers, scene_model, count)
    return predictions


def at_all_receivers(fitted: Fitted, count: int, inputs: Inputs) -> NDArray[Any]:
    """Means of ``count`` receivers [n_rx, m, ...]."""
    return np.stack([fitted.predict_mean(inputs, receiver) for receiver in range(count)])


def some_rows(split: Split) -> IntArray:
    """Training rows whose traces tell offsets, evenly spaced: `OFFSET_ROWS` at most."""
    return split.all_train[:: -(-len(split.all_train) // OFFSET_ROWS)]
