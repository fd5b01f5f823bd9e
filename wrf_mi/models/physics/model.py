"""The model ``physics``: planes, materials and kriging, by the task of the data and with or without a scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from ...core import Prediction, Split
from ...core.antenna import ANTENNA
from ...tracing.polarization import check_polarization
from ...tracing.solve import Prepared
from ..method import Inputs
from ..model import Arrays, Fitted, Model, Problem, Session
from .selection import MODULES, PhysicsModel, check_antennas, kind_of_task

logger = logging.getLogger(__name__)

SETTINGS = {
    "spectra with --scene": ("spectrum", True),
    "spectra without": ("spectrum", False),
    "signal strengths": ("rssi", True),
    "channel coefficients": ("csi", True),
}
"""Headings of the settings in the help, with task and whether there is a scene."""


class FittedPhysics(Fitted):
    """A fitted physics model as the registry's interface.

    Args:
        model: fitted physics model.
    """

    def __init__(self, model: PhysicsModel) -> None:
        self.model, self.receivers, self.uses_heading = model, model.receivers, model.uses_heading

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Prediction with standard deviations, see `Fitted`."""
        return self.model.predict(inputs.tx_pos_m, receiver, inputs.tx_heading_rad)

    def arrays(self) -> Arrays:
        """Arrays of the fitted model, see `Fitted`."""
        return self.model.arrays()

    def facts(self) -> dict[str, Any]:
        """Fitted parameters and choices."""
        return {"fitted": self.model.summary()}


def _check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse antennas in solids; warn of antennas near surfaces, crossed polarisations and ignored antennas."""
    record, scene = problem.record, problem.opened_scene
    check_antennas(record)
    if scene is None:
        return
    positions = np.asarray(record.tx_pos_m, float)
    Prepared(scene).check(positions, record.receivers)
    if kind_of_task(record.task, True).uses_antennas:
        check_polarization(scene, positions, record.receivers, record.tx_antenna)
    elif any(antenna != ANTENNA for antenna in (record.tx_antenna, *(one.antenna for one in record.receivers))):
        logger.warning("%s: the physics model for channels takes all antennas to be isotropic", record.name)


@cache
def _model(task: str, with_scene: bool) -> Model:
    kind = kind_of_task(task, with_scene)

    def fit(problem: Problem, split: Split, session: Session) -> Fitted:
        given = problem.record, problem.rows(split), problem.opened_scene
        return FittedPhysics(kind.fit(*given, problem.settings, problem.seed, session.report))

    def load(arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        return FittedPhysics(kind.load(arrays))

    return Model(
        "physics",
        tuple(MODULES),
        kind.settings,
        fit,
        load,
        "docs/joint.md",
        scene="optional",
        uses_antennas=kind.uses_antennas,
        scene_alone=True,
        headings=True,
        check=_check,
    )


_settings = {name: kind_of_task(*data).settings for name, data in SETTINGS.items()}
MODEL = replace(_model("rssi", True), settings=_settings, by_data=_model)
