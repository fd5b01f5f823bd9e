"""Predictions by the stages of a hybrid up to each, for their scores and times on test rows."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from ...core import Split
from ...correction import default_options
from ...tasks import instrument_of, task_of
from ...tracing import TraceOptions
from ...tracing.tracer import RayTracer, fit_offsets
from ..model import Fitted, Inputs, PredictAll, Problem
from .paths import FittedPaths
from .scene_side import CALIBRATION, CORRECTED, FIELD, MEAN, STAGES, SURFACES, SceneSide

OFFSET_ROWS = 400
"""Most training rows whose traces tell the offset of a receiver."""


def by_stage(problem: Problem, split: Split, side: SceneSide, kept: Collection[str]) -> dict[str, PredictAll]:
    """Predictions of the stages up to each but the last.

    Args:
        problem: problem of the hybrid, with the scene as it is stated.
        split: its training rows fit offsets of traced signal strengths.
        side: the fitted scene's side.
        kept: stages that are used.
    """
    predictions: dict[str, PredictAll] = {}
    earlier = [stage for stage in STAGES if stage in kept][:-1]
    if MEAN in earlier:
        predictions[MEAN] = _traced(problem, split)
    if side.problem.scene != problem.scene:
        predictions |= {stage: _traced(side.problem, split) for stage in (CALIBRATION, CORRECTED) if stage in earlier}
    if isinstance(side, FittedPaths):
        if SURFACES in earlier:
            predictions[SURFACES] = _of_all(side.graph.without_gaussians() if FIELD in kept else side)
        if FIELD in earlier:
            predictions[FIELD] = _of_all(side)
    return predictions


def _of_all(fitted: Fitted) -> PredictAll:
    def predict(inputs: Inputs) -> NDArray[np.generic]:
        assert fitted.receivers is not None
        return np.stack([fitted.predict_mean(inputs, receiver) for receiver in range(len(fitted.receivers))])

    return predict


def _traced(problem: Problem, split: Split) -> PredictAll:
    """Traced reports; strengths with the offset of each receiver that fits its training rows."""
    record, how = problem.record, default_options(problem.record)
    stated = record if record.carriers_hz is None else record.at_carrier(record.carriers_hz[0])
    options = TraceOptions(transmission=True, depth=how.depth, reflections=how.reflections)
    assert problem.scene is not None
    tracer = RayTracer(problem.scene, instrument_of(stated), options, problem.material)
    offsets = None
    if task_of(record).in_decibel:
        every = split.all_train
        rows = every[:: -(-len(every) // OFFSET_ROWS)]
        offsets = fit_offsets(tracer(record.tx_pos_m[rows]), record.seen(split).observation[:, rows])

    def predict(inputs: Inputs) -> NDArray[np.generic]:
        traced = tracer.trace(inputs.tx_pos_m, first_row=inputs.first_row, carriers_hz=inputs.carriers_hz)
        observed = tracer.observe(traced)
        return observed if offsets is None else offsets(observed)

    return predict
