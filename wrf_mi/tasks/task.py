"""Tasks: form of an observation, score, references and instrument."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Container
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..receivers.instruments import Instrument
from .scores import MixtureScores

UPLINK = "uplink"
"""Key of the reference that copies the uplink."""
LAW = "law"
"""Key of the reference at receivers that were held out."""
CARRIER = "carrier"
"""Key of the reference at carriers without training rows: that of `Task.reference` at the nearest carrier with some."""


class Task(ABC):
    """A kind of observation with its score, loss and instrument.

    A task of another package is an instance of a subclass, which an entry point of the group ``wrf_mi.tasks`` names.
    """

    name: ClassVar[str]  #: name in `wrf_mi.core.Record.task`
    block: ClassVar[str]  #: key of the score in ``metrics.json``
    label: ClassVar[str]  #: label of the score, for tables and axes
    digits: ClassVar[int] = 2  #: digits of the score after the decimal point
    higher_is_better: ClassVar[bool]  #: whether the score is an accuracy or an error
    #: scores beyond which models are not compared any more where a mean over rows chooses among them
    limits: ClassVar[tuple[float, float]] = (-np.inf, np.inf)
    axes: ClassVar[int]  #: number of axes of one observation, at one receiver and row
    more_axes: ClassVar[int] = 0  #: number of optional further axes (antennas) of an observation
    #: whether an observation is shown as an image; else its level is drawn over positions
    image: ClassVar[bool] = False
    #: what `level` states: ``"power"`` received, dBm; ``"gain"`` of the channel, dB; or ``"relative"``, dB without a
    #: common unit
    level_kind: ClassVar[Literal["power", "gain", "relative"]] = "relative"
    level_note: ClassVar[str] = ""  #: what `level` states, in words
    is_complex: ClassVar[bool] = False  #: whether observations are complex
    receiver: ClassVar[str] = ""  #: name of the default receiver model (`wrf_mi.graph.receivers`)
    receiver_with_scene: ClassVar[str] = ""  #: name of the default receiver model beside the paths of a scene
    #: whether observations are powers in decibels with an offset of each receiver: a propagation law describes them,
    #: and offsets are fitted to training rows
    in_decibel: ClassVar[bool] = False
    neighbours: ClassVar[int] = 4  #: training rows of the reference, inverse-distance weighting
    softening_m: ClassVar[float] = 0.0  #: addend of the distances in the reference, metres
    #: words for the second reference, of data with an uplink; "" where the task has none
    from_uplink: ClassVar[str] = ""
    constant_words: ClassVar[str] = "the mean of each receiver's training rows"  #: what `constant` predicts, in words
    heading: ClassVar[str]  #: heading of the task
    quantity: ClassVar[str]  #: quantity that is drawn over positions, with its unit
    note: ClassVar[str] = ""  #: sentence for readers of a table

    @abstractmethod
    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score of each observation, of arrays of any shape that ends with an observation's."""

    @abstractmethod
    def instrument(self, record: Record) -> Instrument:
        """The instrument of a record of this task, for ray tracing.

        Raises:
            InputError: the data lack positions, carrier or array.
        """

    def level(self, prediction: Prediction) -> Prediction:
        """Level of predictions or observations of one receiver, for maps (`level_kind`); a single number is its own.

        Args:
            prediction: mean [m, ...] and, where stated, standard deviation.

        Returns:
            Decibels [m], NaN where nothing was received, and their standard deviation where it is stated.

        Raises:
            InputError: the task defines no level.
        """
        if not self.axes:
            return prediction
        raise InputError(f"task {self.name}: defines no level of an observation, so there is nothing to map")

    def check(self, record: Record) -> None:  # noqa: B027 - most tasks have nothing to check
        """Refuse a record with inconsistent parts.

        Raises:
            InputError: naming what differs.
        """

    def constant(self, observed: NDArray[Any]) -> NDArray[Any]:
        """The best constant prediction of a receiver's observations [n, ...], all finite: by default their mean."""
        return np.asarray(observed.mean(axis=0))

    @property
    def reference(self) -> str:
        """Key of inverse-distance weighting in ``metrics.json``."""
        return f"idw{self.neighbours}"

    @property
    def references(self) -> dict[str, str]:
        """Words for each possible reference by its key; the first that a run has is its headline."""
        known = {self.reference: f"IDW of {self.neighbours} nearest"}
        known |= {LAW: "one path-loss law of all receivers"} if self.in_decibel else {}
        known |= {} if self.is_complex else {CARRIER: "nearest carrier's rows"}
        return {UPLINK: self.from_uplink} | known if self.from_uplink else known

    def headline(self, stored: Container[str]) -> str | None:
        """The first of `references` among the stored ones; None without any."""
        return next((key for key in self.references if key in stored), None)

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Loss of the training, a Dr.Jit float of one value: mean absolute difference over received observations.

        Args:
            prediction: flat Dr.Jit floats of a batch, divided by the receiver's `unit`.
            truth: array of the same shape; NaN where nothing was received.
            batch: number of observations.
            shape: shape of an observation; complex ones have a last axis of real and imaginary part.
            ssim_weight: weight of an image's structural term, 0 to 1.
        """
        from .losses import absolute_error

        return absolute_error(prediction, truth)

    def unit(self, observed: NDArray[Any]) -> float:
        """Unit in the loss of a receiver's observations [n, ...], NaN where nothing was received."""
        return 1.0

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Scores of observations [n, ...] in training: as `of_rows`, by a faster implementation where there is one."""
        return np.asarray(self.of_rows(np.asarray(prediction)[None], np.asarray(truth)[None])[0], float)

    def mixtures(self, predictions: NDArray[Any], truth: NDArray[Any]) -> MixtureScores:
        """Scores of weighted means of predictions [k, m, ...] of finite observations [m, ...] of one receiver.

        They serve the choice of weights: scores are limited (`limits`), and the higher the better.
        """
        sign = 1 if self.higher_is_better else -1

        def scores(weights: FloatArray, rows: IntArray) -> FloatArray:
            mean = np.einsum("mk,km...->m...", weights, predictions[:, rows])
            return np.asarray(sign * np.clip(self.of_rows(mean[None], truth[rows][None])[0], *self.limits))

        return scores

    def of_rows(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score [n_rx, m] of each receiver and row of arrays [n_rx, m, ...], as in `wrf_mi.core.Record`."""
        predicted, expected = np.asarray(prediction), np.asarray(truth)
        if self.more_axes and expected.ndim > 2 + self.axes and predicted.shape == expected.shape:
            shape = (*expected.shape[:2], -1)
            predicted, expected = predicted.reshape(shape), expected.reshape(shape)
        return self.score(predicted, expected)


def carrier_hz(record: Record, stated_in: str) -> FloatArray:
    """Frequencies of a record with known positions, as ray tracing needs; ``stated_in`` names key and file of them.

    Raises:
        InputError: an unknown position or frequency.
    """
    positions = [record.tx_pos_m, *(receiver.position_m for receiver in record.receivers)]
    if not all(np.isfinite(position_m).all() for position_m in positions):
        raise InputError(f"{record.name}: positions unknown, so there is nothing to trace between; use another method")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state {stated_in}")
    return record.frequencies_hz
