"""The model ``physics``: planes, materials and kriging, of the data's task, with or without a scene."""

from __future__ import annotations

import logging
from collections.abc import Sequence
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
from .selection import KINDS, PhysicsModel, check_antennas

logger = logging.getLogger(__name__)

NAME = "physics"


class FittedPhysics(Fitted):
    """A fitted physics.

    Attributes:
        own: the model, see `wrf_mi.models.physics.selection.PhysicsModel`.
    """

    def __init__(self, own: PhysicsModel) -> None:
        self.own, self.receivers, self.uses_heading = own, own.receivers, own.uses_heading

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """See `Fitted`; with standard deviations."""
        return self.own.predict(inputs.tx_pos_m, receiver, inputs.tx_heading_rad)

    def arrays(self) -> Arrays:
        """See `Fitted`."""
        return self.own.arrays()

    def facts(self) -> dict[str, Any]:
        """What was fitted, in plain numbers."""
        return {"fitted": self.own.summary()}


def _check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse antennas in solids; warn of those near surfaces, of crossed polarisations and of antennas left out."""
    record, scene = problem.record, problem.opened_scene
    check_antennas(record)
    if scene is None:
        return
    places = np.asarray(record.tx_pos_m, float)
    Prepared(scene).check(places, record.receivers)
    if KINDS[record.task](True).uses_antennas:
        check_polarization(scene, places, record.receivers, record.tx_antenna)
    elif any(one != ANTENNA for one in (record.tx_antenna, *(receiver.antenna for receiver in record.receivers))):
        logger.warning("%s: the physics model for channels takes all antennas to be isotropic", record.name)


@cache
def _of(task: str, with_scene: bool) -> Model:
    kind = KINDS[task](with_scene)

    def fit(problem: Problem, split: Split, session: Session) -> Fitted:
        rows, scene = problem.rows(split), problem.opened_scene
        own = kind.fit(problem.record, rows, scene, problem.settings, problem.seed, session.report)
        return FittedPhysics(own)

    def load(arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        return FittedPhysics(kind.load(arrays, problem.opened_scene))

    ends = fit, load, "docs/joint.md"
    kept: dict[str, Any] = {"scene": "optional", "uses_antennas": kind.uses_antennas, "scene_alone": True}
    return Model(NAME, tuple(KINDS), kind.settings, *ends, **kept, headings=True, check=_check)


def _entry() -> Model:
    from dataclasses import replace

    words = {
        "spectra with --scene": ("spectrum", True),
        "spectra without": ("spectrum", False),
        "signal strengths": ("rssi", True),
        "channel coefficients": ("csi", True),
    }
    settings: Any = {name: _of(*data).settings for name, data in words.items()}
    return replace(_of("rssi", True), settings=settings, by_data=_of)


MODEL = _entry()
