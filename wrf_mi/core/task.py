"""Tasks: kinds of observation. All that depends on the kind is an attribute or a method of its task.

`wrf_mi.tasks` registers spectra, signal strengths and channels, other packages register theirs. A record refers to its
task by name (`wrf_mi.core.Record.task`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .angles import FloatArray, IntArray
from .errors import InputError
from .prediction import Prediction
from .registry import Registry

MixtureScores = Callable[[FloatArray, IntArray], FloatArray]
"""From weights [n, k] of sum 1 and numbers [n] of observations to scores [n] of weighted means of k predictions."""
UPLINK = "uplink"  # Key of the reference that copies the uplink
LAW = "law"  # Key of the reference at receivers that were held out
IDW = "idw"  # Key of the reference by inverse-distance weighting
NEIGHBOURS = "neighbours"  # Key of the numbers of neighbours in its block of ``metrics.json``
CARRIER = "carrier"
"""Key of the reference at carriers without training rows: that of `IDW` at the nearest carrier with some."""
MEAN, MEDIAN = "the mean of each receiver's training rows", "the median of each receiver's training rows"
"""Words for constant predictions (`Task.constants`); of arrays value by value."""
Loss = Callable[..., Any]
"""``loss(prediction, truth, batch, *shape)``: arguments and result of `Task.loss`, a Dr.Jit float of one value."""


class Task(ABC):
    """A kind of observation: its form, score, loss and receiver models, and what else depends on the kind.

    A task is an instance of a subclass. An entry point of the group ``wrf_mi.tasks`` names that of another package.
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
    #: dimensions of an observation by its number of axes, for data with named dimensions
    dimensions: ClassVar[Mapping[int, tuple[str, ...]]] = {
        0: (),
        1: ("subcarrier",),
        2: ("antenna", "subcarrier"),
    }
    #: dimension of a record's frequencies: ``"carrier"``, or ``"subcarrier"`` of observations with one value for each
    frequency_dimension: ClassVar[str] = "carrier"
    #: unit of observations and of their standard deviations, for data with named dimensions
    units: ClassVar[tuple[str, str]] = "", ""
    #: whether an observation is shown as an image; else its level is drawn over positions
    image: ClassVar[bool] = False
    #: what `level` states: ``"power"`` received, dBm; ``"gain"`` of the channel, dB; or ``"relative"``, dB without a
    #: common unit
    level_kind: ClassVar[Literal["power", "gain", "relative"]] = "relative"
    level_note: ClassVar[str] = ""  #: what `level` states, in words
    is_complex: ClassVar[bool] = False  #: whether observations are complex
    receiver: ClassVar[str] = ""  #: name of the default receiver model (`wrf_mi.receivers.registry`)
    receiver_with_scene: ClassVar[str] = ""  #: name of the default receiver model of paths of a scene
    carrier_stated_in: ClassVar[str] = "frequency_hz in its gateway_info.yml"  #: key and file, for messages
    in_decibel: ClassVar[bool] = False  #: whether observations are powers in decibels
    #: whether observations of traced paths differ from measured ones by an offset of each receiver, which is fitted to
    #: its training rows
    has_offsets: ClassVar[bool] = False
    #: whether a gain of the receiver changes its observations; False: they are scaled to their extremes
    has_gain: ClassVar[bool] = True
    #: whether observations tell phases of paths, and so planes that are a few centimetres off
    tells_phases: ClassVar[bool] = True
    #: whether observations of paths with uncertain phases are expectations over the phases
    averages_phases: ClassVar[bool] = False
    #: whether a law of distance that receivers share describes observations: it predicts for receivers with few
    #: training rows or none, and tells unknown places of receivers
    shares_law: ClassVar[bool] = False
    #: whether a receiver may have received none of the rows, so that what is predicted includes whether it receives
    may_be_silent: ClassVar[bool] = False
    #: whether a training step needs the observation of every receiver in each row
    complete: ClassVar[bool] = False
    #: whether observations are means of readings, whose number or deviation a record may state, and receivers their
    #: carriers
    has_readings: ClassVar[bool] = False
    #: whether rows of a record may have several carriers
    several_carriers: ClassVar[bool] = True
    #: whether the body that carries the transmitter shadows it, so that observations depend on its heading alone
    follows_heading: ClassVar[bool] = False
    #: whether the hybrid interpolates residuals about the traced map in every case, and not only where this gains
    kriged_about_paths: ClassVar[bool] = False
    #: whether standard deviations that some of the mixed models state serve without those of the others, and are
    #: trusted more the fewer rows calibrate them
    trusts_stated_std: ClassVar[bool] = False
    #: settings of the training of Gaussians that differ from the defaults, as ``--set`` takes them
    settings: ClassVar[tuple[str, ...]] = ()
    #: settings of the training of Gaussians beside the paths of a scene that differ from the defaults
    settings_with_scene: ClassVar[tuple[str, ...]] = ()
    #: settings of the training of paths alone that differ from the defaults of such a training
    settings_of_paths: ClassVar[tuple[str, ...]] = ()
    loss_unit: ClassVar[float] = 1.0  #: unit of an observation in which errors are about as large as those of spectra
    #: training rows of the reference, inverse-distance weighting, where no rows can be held out to choose their number
    neighbours: ClassVar[int] = 4
    softening_m: ClassVar[float] = 0.0  #: addend of the distances in the reference, metres
    #: words for the second reference, of data with an uplink; "" where the task has none
    from_uplink: ClassVar[str] = ""
    heading: ClassVar[str]  #: heading of the task
    quantity: ClassVar[str]  #: quantity that is drawn over positions, with its unit
    note: ClassVar[str] = ""  #: sentence for readers of a table

    def __repr__(self) -> str:
        return self.name

    @abstractmethod
    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score of each observation, of arrays of any shape that ends with an observation's."""

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

    def image_size(self, shape: tuple[int, ...]) -> tuple[int, int] | tuple[()]:
        """Height and width of an observation of a shape that is an image over directions; () of other tasks."""
        return ()

    def outputs(self, shape: tuple[int, ...]) -> tuple[int, ...]:
        """Shape of a channel: subcarriers, or antennas and subcarriers; () of other tasks."""
        return ()

    def floor_db(self, observed: NDArray[Any]) -> float:
        """Power in dB of what was measured where no path arrives, of observations of all receivers; NaN: none."""
        return np.nan

    def limited(self, values: NDArray[Any], most: bool = True) -> NDArray[Any]:
        """Predictions within the range of observations; ``most`` False: they may exceed its upper end."""
        return values

    def error_size(self, mean: NDArray[Any]) -> FloatArray:
        """Expected size of errors of predictions, up to a factor, where no model states their standard deviation."""
        return np.asarray(np.abs(mean), float)

    def of_rays(self, parts: tuple[Any, Any], shape: tuple[int, int, int], offset: Any, receiver: Any) -> Any:
        """Observations of the signals of rays of equal solid angle, a tensor [batch, values].

        Args:
            parts: real and imaginary parts, flat Dr.Jit floats [outputs * batch * rays].
            shape: numbers of outputs, transmitters (batch) and rays.
            offset: tensor of each receiver's offset in dB, of whose type the result is.
            receiver: number of the receiver.
        """
        raise NotImplementedError(f"task {self.name}: no observation of rays")

    def with_arrays(self, record: Any) -> Any:
        """The record (`wrf_mi.core.Record`) with the arrays that its observations have; `InputError`: unknown."""
        return record

    def check(self, record: Any) -> None:  # noqa: B027 - most tasks have nothing to check
        """Refuse a record (`wrf_mi.core.Record`) with inconsistent parts; raises InputError."""

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Constant predictions of a receiver's observations [n, ...], all finite, by what they are in words.

        A model is compared with the constant that scores best on the training rows; by default mean and median.
        """
        return {MEAN: np.asarray(observed.mean(axis=0)), MEDIAN: np.asarray(np.median(observed, axis=0))}

    @property
    def references(self) -> dict[str, str]:
        """Words for each possible reference by its key."""
        words = {IDW: "IDW"}
        words |= {LAW: "one path-loss law of all receivers"} if self.shares_law else {}
        words |= {CARRIER: "nearest carrier's rows"} if self.several_carriers else {}
        return {UPLINK: self.from_uplink} | words if self.from_uplink else words

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Loss of the training, a Dr.Jit float of one value: mean absolute difference over received observations.

        Args:
            prediction: flat Dr.Jit floats of a batch, divided by the receiver's `unit`.
            truth: array of the same shape; NaN where nothing was received.
            batch: number of observations.
            shape: shape of an observation; complex ones have a last axis of real and imaginary part.
            ssim_weight: weight of an image's structural term, 0 to 1.
        """
        return LOSSES["absolute-error"](prediction, truth, batch, *shape)

    def unit(self, observed: NDArray[Any]) -> float:
        """Unit in the loss of a receiver's observations [n, ...], NaN where nothing was received."""
        return self.loss_unit

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


TASKS: Registry[Task] = Registry("task", "wrf_mi.tasks")
"""Every task by its name."""
LOSSES: Registry[Loss] = Registry("loss", "wrf_mi.losses")
"""Losses by name beside those of the tasks, as in ``wrf-mi train --set loss.name=squared-error``."""
CONVERSIONS: Registry[Callable[[Any], Any]] = Registry("conversion", "wrf_mi.conversions")
"""Functions of a record that return its data in the form of another library, by the name of the library."""


def task_named(name: str, place: str) -> Task:
    """The task of a name; ``place`` begins the message of the `InputError` of an unknown one."""
    if name not in TASKS:
        raise InputError(
            f"{place}: task {name!r}; known are {', '.join(TASKS) or 'none before wrf_mi.tasks is imported'}"
        )
    return TASKS[name]
