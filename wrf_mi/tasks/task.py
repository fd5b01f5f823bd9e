"""Tasks: form of an observation, score, references and instrument; spectra, signal strengths, and channels."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Container
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Record
from ..core.angles import FloatArray, solid_angles
from ..core.types import IntArray
from ..receivers.instruments import ChannelInstrument, Instrument, PowerInstrument, SpectrumInstrument
from .scores import MixtureScores, abs_error_db, cea_db, level_of_amplitudes, ssim, ssim_mixtures

UPLINK = "uplink"  # Key of the reference that copies the uplink
LAW = "law"  # Key of the reference at receivers that were held out
CARRIER = "carrier"
"""Key of the reference at carriers without training rows: that of `Task.reference` at the nearest carrier with some."""
SCORED_TOGETHER = 16  # Images whose similarity is computed at a time
MEAN, MEDIAN = "the mean of each receiver's training rows", "the median of each receiver's training rows"
"""Words for constant predictions (`Task.constants`); of arrays value by value."""


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
    heading: ClassVar[str]  #: heading of the task
    quantity: ClassVar[str]  #: quantity that is drawn over positions, with its unit
    note: ClassVar[str] = ""  #: sentence for readers of a table

    @abstractmethod
    def score(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score of each observation, of arrays of any shape that ends with an observation's."""

    @abstractmethod
    def instrument(self, record: Record) -> Instrument:
        """The instrument of a record, for ray tracing (InputError: no positions, carrier or array)."""

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
        """Refuse a record with inconsistent parts; raises InputError."""

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Constant predictions of a receiver's observations [n, ...], all finite, by what they are in words.

        A model is compared with the constant that scores best on the training rows; by default mean and median.
        """
        return {MEAN: np.asarray(observed.mean(axis=0)), MEDIAN: np.asarray(np.median(observed, axis=0))}

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
    """Frequencies of a record, `InputError` if these or positions are unknown; ``stated_in`` names key and file."""
    positions = [record.tx_pos_m, *(receiver.position_m for receiver in record.receivers)]
    if not all(np.isfinite(position_m).all() for position_m in positions):
        raise InputError(f"{record.name}: positions unknown, so there is nothing to trace between; use another method")
    if record.frequencies_hz is None:
        raise InputError(f"{record.name}: carrier frequency unknown; state {stated_in}")
    return record.frequencies_hz


class Spectrum(Task):
    """Observations are spectra [height, width] in 0..1, float32, scored by structural similarity."""

    name = "spectrum"
    block, label, digits, higher_is_better = "ssim", "SSIM", 3, True
    axes, image = 2, True
    receiver, receiver_with_scene = "pixel", "array"
    heading, quantity = "spatial spectra", "grey"
    score, mixtures = staticmethod(ssim), staticmethod(ssim_mixtures)
    level_kind = "relative"
    level_note = (
        "mean of the squared grey values over the solid angle of the upper hemisphere, relative to a spectrum of ones; "
        "spectra are scaled to their own maximum, so this states how much of the sky the signal arrives from, not how "
        "strong it is"
    )
    note = (
        "SSIM is scikit-image's structural similarity with a data range of one; IDW averages the four nearest "
        "training spectra by inverse squared distance."
    )

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Loss of the papers (`wrf_mi.tasks.losses.spectrum_loss`)."""
        from .losses import spectrum_loss

        return spectrum_loss(prediction, truth, batch, shape[0], shape[1], ssim_weight)[0]

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """A black spectrum, which is the most similar to spectra of few narrow lobes, and the mean and median."""
        return {"black": np.zeros(observed.shape[1:], observed.dtype)} | super().constants(observed)

    def level(self, prediction: Prediction) -> Prediction:
        """Mean power over the solid angle: greys are magnitudes of a beam former (`level_of_amplitudes`)."""
        height, width = prediction.mean.shape[1:]
        weight = solid_angles(height, width)
        return level_of_amplitudes(prediction, weight / weight.sum())

    def training_score(self, prediction: NDArray[Any], truth: NDArray[Any]) -> FloatArray:
        """Structural similarity on the device, equal to scikit-image's."""
        from ..backend.device import to_float
        from .losses import ssim as on_device

        count, *shape = np.shape(truth)
        # The moments of an image take forty times its memory, which Dr.Jit then keeps.
        parts = [slice(start, start + SCORED_TOGETHER) for start in range(0, count, SCORED_TOGETHER)]
        scores = [on_device(to_float(prediction[k]), to_float(truth[k]), len(truth[k]), *shape).numpy() for k in parts]
        return np.concatenate([np.zeros(0), *scores])

    def instrument(self, record: Record) -> SpectrumInstrument:
        """An array that reports scaled Bartlett spectra."""
        frequencies = carrier_hz(record, "frequency_hz in its gateway_info.yml")
        if any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antenna array unknown; state array in its gateway_info.yml")
        height, width = record.observation.shape[-2:]
        return SpectrumInstrument(record.receivers, frequencies, record.tx_antenna, (height, width))


class Rssi(Task):
    """Observations are powers in dBm, float32, NaN where nothing was received, scored by the absolute error."""

    name = "rssi"
    block, label, higher_is_better = "abs_error_db", "absolute error (dB)", False
    score = staticmethod(abs_error_db)
    axes, in_decibel = 0, True
    receiver = receiver_with_scene = "power"
    # Best of 0 to 1.6 m in a tenfold cross-validation, in the order of time, on flat-ble's training run.
    neighbours, softening_m = 100, 0.4
    heading, quantity = "received signal strength", "RSSI (dBm)"
    level_kind, level_note = "power", "received power as the receiver reports it"
    note = (
        "The absolute error in dB counts rows that were received; IDW averages the 100 nearest training rows "
        "that the same receiver received by inverse squared distance, 0.4 m added."
    )

    def unit(self, observed: NDArray[Any]) -> float:
        """Ten decibels: errors are then of the size that the learning rates expect."""
        return 10.0

    def instrument(self, record: Record) -> PowerInstrument:
        """Single antennas that report received power."""
        frequencies = carrier_hz(record, "frequency_hz in its gateway_info.yml")
        return PowerInstrument(record.receivers, frequencies, record.tx_antenna)


class Csi(Task):
    """Observations are channels [subcarriers] or [antennas, subcarriers], complex64, scored by estimation accuracy."""

    name = "csi"
    block, label, higher_is_better = "cea_db", "CEA (dB)", True
    score = staticmethod(cea_db)
    limits = -10.0, 40.0
    axes, more_axes, is_complex = 1, 1, True
    receiver = receiver_with_scene = "csi"
    from_uplink = "copy of the uplink"
    heading, quantity = "channel coefficients", "power (dB)"
    level_kind, level_note = "gain", "mean of |h|^2 over antennas and subcarriers, in the unit of the data"
    note = (
        "CEA is the channel estimation accuracy, -10 log10 of the relative squared error over a sample's antennas "
        "and subcarriers; IDW averages the four nearest training rows by inverse squared distance; the copy of the "
        "uplink takes each antenna's uplink coefficients for the downlink's."
    )

    def constants(self, observed: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Zero, whose accuracy is 0 dB."""
        # Over some wavelengths of positions the phase takes every value: the mean of few training rows is chance.
        return {"zero": np.zeros(observed.shape[1:], observed.dtype)}

    def loss(self, prediction: Any, truth: Any, batch: int, *shape: int, ssim_weight: float) -> Any:
        """Mean squared difference over received observations."""
        from .losses import squared_error

        return squared_error(prediction, truth)

    def level(self, prediction: Prediction) -> Prediction:
        """Channel gain: mean power of the coefficients over antennas and subcarriers (`level_of_amplitudes`)."""
        shape = prediction.mean.shape[1:]
        return level_of_amplitudes(prediction, np.full(shape, 1 / max(int(np.prod(shape)), 1)))

    def unit(self, observed: NDArray[Any]) -> float:
        """Root mean square of a receiver's channels: far and near receivers then have equal weight."""
        size = np.square(np.abs(np.asarray(observed, complex)))
        power = float(np.nanmean(size)) if np.isfinite(size).any() else 0.0
        return power**0.5 if power > 0 else 1.0

    def instrument(self, record: Record) -> ChannelInstrument:
        """Antennas, one or several at each receiver, that report channel coefficients."""
        frequencies = carrier_hz(record, "frequencies_hz in base-station.yml")
        several = record.observation.ndim > 3
        if several and any(receiver.array_m is None for receiver in record.receivers):
            raise InputError(f"{record.name}: antennas' positions unknown; state base_station in base-station.yml")
        single = record if several else record.with_array(None)
        return ChannelInstrument(single.receivers, frequencies, record.tx_antenna)

    def check(self, record: Record) -> None:
        """Refuse inconsistent numbers of rows, antennas, subcarriers and frequencies."""
        source, shape = record.source or record.name, record.observation.shape
        if len(shape) not in (3, 4):
            text = "expected [receivers, rows, subcarriers] or [receivers, rows, antennas, subcarriers]"
            raise InputError(f"{source}: channel coefficients {list(shape)}; {text}")
        counts = [("", shape[-1], record.frequencies_hz, {1, shape[-1]})]
        if record.uplink is not None:
            uplink, antennas = record.uplink.shape, math.prod(shape[2:-1])
            if len(uplink) != 3 or uplink[:2] != (shape[1], antennas):
                text = f"a downlink of {shape[1]} rows and {antennas} antennas; give both for the same ones"
                raise InputError(f"{source}: uplink {list(uplink)} beside {text}")
            counts.append(("uplink ", uplink[2], record.uplink_hz, {uplink[2]}))
        for link, subcarriers, stated_hz, allowed in counts:
            if stated_hz is not None and len(stated_hz) not in allowed:
                text = f"{subcarriers} {link}subcarriers and {len(stated_hz)} frequencies; give one for each"
                raise InputError(f"{source}: {text}")
