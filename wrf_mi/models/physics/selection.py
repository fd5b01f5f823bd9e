"""The physics model of each task: their common interface, and the choice by what is measured and by scene."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError, Prediction, Receiver, Record
from ...core.angles import FloatArray
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...training.session import OnProgress

Arrays = dict[str, NDArray[Any]]


class PhysicsModel(ABC):
    """A fitted physics model.

    Attributes:
        task: ``"spectrum"``, ``"rssi"`` or ``"csi"``.
        chunk_size: transmitters that are predicted together, which bounds the memory.
        receivers: receivers whose observations are predicted, in the record's order.
    """

    task: ClassVar[str]
    chunk_size: ClassVar[int] = 1024
    receivers: tuple[Receiver, ...]

    @property
    def uses_heading(self) -> bool:
        """Whether predictions depend on the heading of the transmitter."""
        return False

    def predict(
        self, tx_pos_m: ArrayLike, receiver: int | str = 0, tx_heading_rad: ArrayLike | None = None
    ) -> Prediction:
        """Observations of one receiver and their standard deviations.

        Args:
            tx_pos_m: transmitters [m, 3], metres, world frame.
            receiver: name, or number from 0.
            tx_heading_rad: yaw of each transmitter [m]; None: unknown, averaged over where `uses_heading`.

        Returns:
            Mean and standard deviation [m, ...], shaped as in `wrf_mi.core.Record`; both may be read-only.

        Raises:
            InputError: positions or headings of another shape or not finite, or no such receiver.
        """
        positions = np.atleast_2d(np.asarray(tx_pos_m, float))
        if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
            raise InputError(f"transmitters: shape {positions.shape}; give finite positions [m, 3] in metres")
        heading = None
        if self.uses_heading and tx_heading_rad is not None:
            heading = np.atleast_1d(np.asarray(tx_heading_rad, float))
            if heading.shape != (len(positions),) or not np.isfinite(heading).all():
                raise InputError(f"predict: {len(positions)} positions and headings {heading.shape}; give one for each")
        index = receiver_index(self.receivers, receiver)
        mean, std = np.empty(0), np.empty(0)
        for begin in range(0, max(len(positions), 1), self.chunk_size):
            rows = slice(begin, begin + self.chunk_size)
            values, deviation = self._predict(positions[rows], index, None if heading is None else heading[rows])
            shared = deviation.ndim < values.ndim
            if not begin:
                mean = np.empty((len(positions), *values.shape[1:]), values.dtype)
                std = deviation if shared else np.empty((len(positions), *deviation.shape[1:]))
            mean[rows] = values
            if not shared:
                std[rows] = deviation
        return Prediction(mean, std if std.shape == mean.shape else np.broadcast_to(std, mean.shape))

    @abstractmethod
    def _predict(self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None) -> tuple[Any, Any]:
        """Mean and standard deviation of one chunk; a deviation without the first axis is that of all transmitters."""

    @abstractmethod
    def arrays(self) -> Arrays:
        """Arrays from which ``from_arrays`` restores the model."""

    @abstractmethod
    def summary(self) -> dict[str, Any]:
        """Fitted parameters and choices as plain numbers and strings."""


def field_arrays(value: Any, prefix: str) -> Arrays:
    """Fields of a dataclass instance as arrays by ``prefix`` and name."""
    return {f"{prefix}{one.name}": np.asarray(getattr(value, one.name)) for one in fields(value)}


def from_field_arrays(kind: type, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Any:
    """Instance of the dataclass ``kind`` from `field_arrays`; arrays without axes become numbers."""
    stored = (arrays[f"{prefix}{one.name}"] for one in fields(kind))
    return kind(*(value if value.ndim else value.item() for value in stored))


@dataclass(frozen=True)
class PhysicsKind:
    """Entry of one physics model.

    Attributes:
        settings: dataclass of its settings.
        fit: ``fit(record, rows, scene, settings, seed, on_progress)``; ``scene`` as opened by Sionna RT, or None.
        load: ``load(arrays)``, from `PhysicsModel.arrays`.
        uses_antennas: whether its paths have the antennas' patterns and polarisations; else all are isotropic.
    """

    settings: type
    fit: Callable[[Record, IntArray, Any, Any, int, OnProgress], PhysicsModel]
    load: Callable[[Arrays], PhysicsModel]
    uses_antennas: bool = True


MODULES = {"spectrum": ("measured_spectrum", "spectrum"), "rssi": ("rssi", "rssi"), "csi": ("csi", "csi")}
"""Modules of the physics models without and with a scene, by task; each has its `PhysicsKind` as ``KIND``."""


def kind_of(record: Record, with_scene: bool) -> PhysicsKind:
    """The physics model for a record, with or without a mesh of the surroundings.

    Raises:
        InputError: a task without physics model, or channels of receivers with several antennas.
    """
    if record.task not in MODULES:
        raise InputError(f"{record.name}: holds {record.task}; no physics model predicts that")
    check_antennas(record)
    return kind_of_task(record.task, with_scene)


def kind_of_task(task: str, with_scene: bool) -> PhysicsKind:
    """The physics model for a task of `MODULES`."""
    kind: PhysicsKind = import_module(f".{MODULES[task][with_scene]}", __package__).KIND
    return kind


def check_antennas(record: Record) -> None:
    """Refuse channels of receivers with several antennas (`InputError`)."""
    if record.task == "csi" and record.observation.ndim != 3:
        antennas = record.observation.shape[2]
        raise InputError(f"{record.name}: channels of {antennas} antennas; the physics model serves receivers with one")
