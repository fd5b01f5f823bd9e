"""What the physics models of all tasks share: prediction in chunks, stored dataclasses, entry of the registry."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ...core import InputError, Prediction, Receiver, Record, Split
from ...core.angles import FloatArray
from ...core.antenna import ANTENNA
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...tasks import task_of
from ...tracing.polarization import check_polarization
from ...tracing.solve import Prepared
from ...training.session import OnProgress
from ..model import Arrays, Fitted, Inputs, Model, Problem, Session

logger = logging.getLogger(__name__)


class PhysicsModel(ABC):
    """A fitted physics model.

    Attributes:
        chunk_size: transmitters that are predicted together, which bounds the memory.
        receivers: receivers whose observations are predicted, in the record's order.
    """

    chunk_size: ClassVar[int] = 1024
    receivers: tuple[Receiver, ...]

    def predict(self, tx_pos_m: ArrayLike, receiver: int | str = 0) -> Prediction:
        """Observations of one receiver and their standard deviations.

        Args:
            tx_pos_m: transmitters [m, 3], metres, world frame.
            receiver: name, or number from 0.

        Returns:
            Mean and standard deviation [m, ...], shaped as in `wrf_mi.core.Record`; both may be read-only.

        Raises:
            InputError: positions of another shape or not finite, or no such receiver.
        """
        positions, index = np.atleast_2d(np.asarray(tx_pos_m, float)), receiver_index(self.receivers, receiver)
        if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
            raise InputError(f"transmitters: shape {positions.shape}; give finite positions [m, 3] in metres")
        mean, std = np.empty(0), np.empty(0)  # filled chunk by chunk: joined chunks would take the memory twice
        for begin in range(0, max(len(positions), 1), self.chunk_size):
            rows = slice(begin, begin + self.chunk_size)
            values, deviation = self._predict(positions[rows], index)
            shared = deviation.ndim < values.ndim
            if not begin:
                mean = np.empty((len(positions), *values.shape[1:]), values.dtype)
                std = deviation if shared else np.empty((len(positions), *deviation.shape[1:]))
            mean[rows] = values
            if not shared:
                std[rows] = deviation
        return Prediction(mean, np.broadcast_to(std, mean.shape))

    @abstractmethod
    def _predict(self, tx_pos_m: FloatArray, receiver: int) -> tuple[Any, Any]:
        """Mean and standard deviation of one chunk; a deviation without the first axis is that of all transmitters."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Arrays from which ``from_arrays`` restores the model."""

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """Fitted parameters and choices as plain numbers and strings."""


class FittedPhysics(Fitted):
    """A fitted physics model as the registry's interface."""

    uses_heading = False

    def __init__(self, model: PhysicsModel) -> None:
        self.model, self.receivers = model, model.receivers

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Prediction with standard deviations, see `Fitted`."""
        return self.model.predict(inputs.tx_pos_m, receiver)

    def arrays(self) -> Arrays:
        """Arrays of the fitted model, see `Fitted`."""
        return self.model.arrays()

    def facts(self) -> dict[str, Any]:
        """Fitted parameters and choices."""
        return {"fitted": self.model.summary()}


def physics_model(
    task: str,
    settings: type,
    fit: Callable[[Record, IntArray, Any, Any, int, OnProgress], PhysicsModel],
    load: Callable[[Arrays], PhysicsModel],
    uses_antennas: bool = True,
    gaps: tuple[str, ...] = (),
) -> Model:
    """Entry of the physics model for a task.

    Args:
        task: task of the data.
        settings: dataclass of its settings.
        fit: ``fit(record, rows, scene, settings, seed, on_progress)``: a record of the task with frequencies, numbers
            of its training rows, ``sionna.rt.Scene`` at the carrier, settings, seed, progress callback (stage and
            fraction done).
        load: ``load(arrays)``, from `PhysicsModel.arrays`.
        uses_antennas: whether its paths have the antennas' patterns and polarisations; else all are isotropic.
        gaps: arrays that may hold NaN, see `Model.gaps`.
    """

    def fit_problem(problem: Problem, split: Split, session: Session) -> Fitted:
        given = problem.record, problem.rows(split), problem.opened_scene
        return FittedPhysics(fit(*given, problem.settings, problem.seed, session.report))

    return physics_entry(task, settings, fit_problem, lambda arrays: FittedPhysics(load(arrays)), uses_antennas, gaps)


def physics_entry(
    task: str,
    settings: type,
    fit: Callable[[Problem, Split, Session], Fitted],
    load: Callable[[Arrays], Fitted],
    uses_antennas: bool = True,
    gaps: tuple[str, ...] = (),
) -> Model:
    """Entry of the physics model for a task from its ``fit`` and ``load``; arguments as those of `physics_model`."""

    def check(problem: Problem, splits: Sequence[Split]) -> None:
        """Refuse antennas in solids; warn of antennas near surfaces, crossed polarisations and ignored antennas."""
        record, scene = problem.record, problem.opened_scene
        if task_of(record).is_complex and record.observation.ndim != 3:
            text = f"channels of {record.observation.shape[2]} antennas; the physics model serves receivers with one"
            raise InputError(f"{record.name}: {text}")
        positions = np.asarray(record.tx_pos_m, float)
        Prepared(scene).check(positions, record.receivers)
        if uses_antennas:
            check_polarization(scene, positions, record.receivers, record.tx_antenna)
        elif any(antenna != ANTENNA for antenna in (record.tx_antenna, *(one.antenna for one in record.receivers))):
            logger.warning("%s: the physics model for channels takes all antennas to be isotropic", record.name)

    return Model(
        "physics",
        (task,),
        settings,
        fit,
        lambda arrays, problem, folder: load(arrays),
        "docs/joint.md",
        scene="required",
        uses_antennas=uses_antennas,
        scene_alone=True,
        headings=True,
        new_receivers=task == "rssi",
        gaps=gaps,
        check=check,
    )
