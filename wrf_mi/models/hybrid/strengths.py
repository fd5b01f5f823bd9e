"""The scene's side for signal strengths: kriging about the local mean of the power traced in the corrected scene.

For a transmitter whose position is known to a decimetre, ray tracing gives the mean over some wavelengths: single
paths, and Gaussians that change them, say nothing of the fading about it. So stages 4 and 5 are not tried.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction, Split
from ...core.angles import FloatArray
from ...correction.options import STRENGTHS
from ...tasks import task_of
from ...tracing.polarization import check_polarization
from ...tracing.power_map import trace_map
from ...tracing.solve import Prepared
from ...training.reach import improves
from .. import MODELS
from ..held_out import HeldOut, held_out_predictions, hold_out
from ..interpolation.strengths import Strengths, StrengthSettings, fit_strengths
from ..model import Arrays, Inputs, Model, Problem, Session
from .scene_side import MEAN, SCENE, SceneSide, StageReport, corrected, in_scene, write_reports

SPACING_M, SMOOTH_M = 0.25, 0.3
"""Spacing of the traced grid, and standard deviation of the Gaussian over which powers are averaged."""
DEFAULT = StrengthSettings()


class FittedStrengths(SceneSide):
    """Kriging of signal strengths about traced power.

    Args:
        strengths: the fitted kriging.
        problem: problem of the hybrid with the scene that was traced.
        stages: reports of the stages that were tried.
    """

    def __init__(self, strengths: Strengths, problem: Problem, stages: Sequence[StageReport] = ()) -> None:
        self.strengths, self.problem, self.stages = strengths, problem, tuple(stages)
        self.receivers, self.uses_heading = strengths.receivers, strengths.uses_heading

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Strengths at the receiver of that index, dBm [m]."""
        return self.strengths.predict(inputs, receiver)

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, which takes a fraction of its time."""
        return self.strengths.predict_mean(inputs, receiver)

    def arrays(self) -> Arrays:
        """Arrays of the kriging, the map among them."""
        return self.strengths.arrays()


def fit(problem: Problem, split: Split, session: Session) -> FittedStrengths:
    """Correct the scene, trace a map in it, and fit kriging about it."""
    inner, reports = corrected(problem, split, session)
    if inner is not problem and not _gains(problem, inner, split, session):
        # A trace that gains may have nothing to add to kriging, which knows the level around each row.
        inner, reports = problem, [replace(one, kept=one.stage == MEAN) for one in reports]
        write_reports(session.folder, reports)  # for a resumed fit, which no longer finds the scene
        shutil.rmtree(session.folder / SCENE)
    fitted = fit_in_scene(inner, split, session)
    fitted.stages = tuple(reports)
    return fitted


def _gains(stated: Problem, inner: Problem, split: Split, session: Session) -> bool:
    """Whether kriging about the power of the corrected scene predicts held-out rows clearly better."""
    record = stated.record
    if (fold := hold_out(record, split)) is None:
        return False
    held, scores = HeldOut.of(record, fold, stated.seed), list[FloatArray]()
    for name, problem in (("stated", stated), ("corrected", inner)):
        place = replace(session, folder=session.folder / name, run=session.folder / name)
        means = held_out_predictions(AT_START, problem, fold, held, place, f"{name} scene").mean
        shutil.rmtree(place.folder)
        each = task_of(record).mixtures(means[None], held.observed(record))
        unit = held.receiver if split.held_receivers else held.row
        _, number = np.unique(unit, return_inverse=True)
        values = each(np.ones((len(held), 1)), np.arange(len(held)))
        scores.append(np.bincount(number, values) / np.bincount(number))
    return improves(scores[1], scores[0], True)


def fit_in_scene(
    problem: Problem, split: Split, session: Session, settings: StrengthSettings = DEFAULT
) -> FittedStrengths:
    """`fit` without the correction."""
    session.report("tracing a map", 0.0)
    reach = STRENGTHS.depth, STRENGTHS.reflections
    power_map = trace_map(problem.opened_scene, problem.record, SPACING_M, SMOOTH_M, *reach)
    rows = problem.rows(split)
    return FittedStrengths(fit_strengths(problem.record, rows, power_map, settings, session.report), problem)


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedStrengths:
    """The kriging that `FittedStrengths.arrays` described."""
    return FittedStrengths(Strengths.from_arrays(arrays), in_scene(problem, folder))


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse data without a single, known carrier, and antennas inside solids.

    Raises:
        InputError: naming them.
    """
    record = problem.record
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown, or several; a map is traced at one")
    Prepared(problem.opened_scene).check(record.tx_pos_m, record.receivers)
    check_polarization(problem.opened_scene, record.tx_pos_m, record.receivers, record.tx_antenna)


TRACED_STRENGTHS = replace(
    MODELS["kriging"].serving("rssi", False),
    name="strengths",
    fit=fit,
    load=load,
    scene="required",
    check=check,
    by_data=None,
)
"""The scene's side for strengths as an entry, which no name of the registry has."""
IN_SCENE: Model = replace(TRACED_STRENGTHS, fit=fit_in_scene)
"""The same in a scene that is corrected already."""
AT_START = replace(IN_SCENE, fit=partial(fit_in_scene, settings=StrengthSettings(search_rows=2**31)))
"""The same with hyperparameters as they are stated: which scene is better does not depend on their search."""
