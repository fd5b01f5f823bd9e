"""What a task is: the form of an observation, its score, its references and the instrument behind it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Container
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Record
from ..core.angles import FloatArray
from ..receivers.instruments import Instrument

UPLINK = "uplink"
"""Key of the reference that copies the uplink."""


class Task(ABC):
    """A kind of observation and all that depends on it.

    A task of another package is a subclass, an instance of which an entry point of the group ``wrf_mi.tasks`` names.

    Attributes:
        name: as in `wrf_mi.core.Record.task`.
        block: key of the score in ``metrics.json``.
        label: of the score, for tables and axes.
        digits: of the score, after the decimal point.
        higher_is_better: whether the score is an accuracy or an error.
        axes: number of axes of one observation, at one receiver and row.
        more_axes: that it may have beside these (antennas); all of them together are one observation.
        image: whether an observation is an image, which pictures show as such; else its level is drawn over positions.
        is_complex: whether observations are complex.
        receiver: name of the receiver model by which a field is trained (`wrf_mi.graph.receivers`).
        receiver_with_scene: of that with which paths of a scene are trained beside it.
        in_decibel: whether observations are powers in decibels, whose level each receiver counts from an origin of its
            own: a propagation law describes them, and offsets are fitted to training rows.
        neighbours: training rows that the reference interpolates between (inverse-distance weighting).
        softening_m: distance that is added to each of theirs, metres.
        from_uplink: words for the second reference, of data with an uplink; "" where the task has none.
        heading: of the task.
        quantity: what is drawn over positions, with its unit.
        note: one sentence for readers of a table.
    """

    name: ClassVar[str]
    block: ClassVar[str]
    label: ClassVar[str]
    digits: ClassVar[int] = 2
    higher_is_better: ClassVar[bool]
    axes: ClassVar[int]
    more_axes: ClassVar[int] = 0
    image: ClassVar[bool] = False
    is_complex: ClassVar[bool] = False
    receiver: ClassVar[str] = ""
    receiver_with_scene: ClassVar[str] = ""
    in_decibel: ClassVar[bool] = False
    neighbours: ClassVar[int] = 4
    softening_m: ClassVar[float] = 0.0
    from_uplink: ClassVar[str] = ""
    heading: ClassVar[str]
    quantity: ClassVar[str]
    note: ClassVar[str] = ""

    @abstractmethod
    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """One value for each observation of ``axes`` axes.

        Args:
            prediction: any shape that ends with an observation's.
            truth: the same shape.
        """

    @abstractmethod
    def instrument(self, record: Record) -> Instrument:
        """The instrument behind a record of this task, for ray tracing.

        Raises:
            InputError: the data do not tell what it takes.
        """

    def check(self, record: Record) -> None:  # noqa: B027 - most tasks have nothing to check
        """Refuse a record whose parts do not fit together.

        Raises:
            InputError: naming what differs.
        """

    @property
    def reference(self) -> str:
        """Key of inverse-distance weighting in ``metrics.json``."""
        return f"idw{self.neighbours}"

    @property
    def references(self) -> dict[str, str]:
        """Words for each reference that the task may have by its key, the first that a run has being its headline."""
        blend = {self.reference: f"blend of {self.neighbours} nearest"}
        return {UPLINK: self.from_uplink} | blend if self.from_uplink else blend

    def headline(self, stored: Container[str]) -> str | None:
        """The reference that stands for all: the first of `references` among those stored; None without any."""
        return next((key for key in self.references if key in stored), None)

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """What training makes small, a Dr.Jit float of one value: the mean absolute difference over what was received.

        Args:
            prediction: flat Dr.Jit floats of a batch, divided by the receiver's `unit`.
            truth: the same; NaN where nothing was received.
            batch: number of observations.
            shape: of one; complex ones with a last axis of real and imaginary part.
            ssim_weight: weight of an image's structure, 0 to 1.
        """
        from .losses import absolute_error

        return absolute_error(prediction, truth)

    def unit(self, observed: NDArray[Any]) -> float:
        """What observations of one receiver [n, ...], NaN where nothing was received, are divided by in the loss."""
        return 1.0

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Scores of observations [n, ...] while a model is trained: those of `of_rows`, by any faster way."""
        return np.asarray(self.of_rows(np.asarray(prediction)[None], np.asarray(truth)[None])[0], float)

    def of_rows(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score of each receiver and row.

        Args:
            prediction: [n_rx, m, ...], see `wrf_mi.core.Record`.
            truth: the same shape.

        Returns:
            Shape [n_rx, m].
        """
        predicted, expected = np.asarray(prediction), np.asarray(truth)
        if self.more_axes and expected.ndim > 2 + self.axes and predicted.shape == expected.shape:
            shape = (*expected.shape[:2], -1)
            predicted, expected = predicted.reshape(shape), expected.reshape(shape)
        return self.score(predicted, expected)


def carrier_hz(record: Record, stated_in: str) -> FloatArray:
    """Frequencies of a record whose transmitters and receivers have known positions, as ray tracing needs.

    Args:
        record: of any task.
        stated_in: key and file that would state the frequency, for the message.

    Raises:
        InputError: a position or the frequency is not known.
    """
    places = [record.tx_pos_m, *(receiver.position_m for receiver in record.receivers)]
    if not all(np.isfinite(place).all() for place in places):
        raise InputError(f"{record.name}: positions unknown, so there is nothing to trace between; use another method")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state {stated_in}")
    return record.frequencies_hz
