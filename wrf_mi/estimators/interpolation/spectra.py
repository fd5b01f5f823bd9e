"""Kriging of the spectra of a known array: its element signals, mixed with the spectra nearby.

Two estimates of a spectrum are mixed:

- *signals*: the element signals of the training spectra, as a Gaussian process whose covariance is that of waves
  leaving within a cone around the line of sight (`signals`), and the spectrum to be expected from them: at each
  direction the beam former's output is a complex Gaussian number, so its magnitude is Rician;
- *nearby*: kriging of the spectra themselves along and across the line of sight (`kriging_equations`).

Kriging is best over millimetres, as it needs no phase, and the signals over a wavelength; beyond, the mean of the
spectra, to which kriging falls back, is safest. So the signals have the weight v^2 / (v^2 + c^2) (1 - v), v being their
share of unknown variance; c is fitted to training rows predicted from others further away than 0 to 1 wavelengths.

Source: Rice, "Mathematical analysis of random noise" (1944), section 3.10.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist
from scipy.special import i0e, i1e

from ...core import InputError, Prediction, Split
from ...core.angles import FloatArray, pixel_directions
from ...core.settings import Count, names_of
from ...datasets.observations import rows_received
from ...parallel.threads import one_blas_thread
from ...receivers.array import Lags, array_response
from ...receivers.retrieve import retrieve_signals, unscale
from ...tasks.scores import LEVEL, REAL_90
from ...training.session import OnProgress
from ..model import Arrays, Fitted, Problem
from .by_receiver import Probabilistic, ReceiverRows, Single, observed_rows
from .kriging import GenericKriging, KrigingSettings, UncertainKriged, asks_generic, kriged
from .kriging_equations import AnisotropicKriging, fit_anisotropic, line_of_sight
from .signals import ComplexArray, Covariances, Posterior, SignalProcess, departures, fit_signals

logger = logging.getLogger(__name__)

GAPS = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Radii in wavelengths around a held-out row within which no row is used while the weights are fitted."""
HELD_OUT = 80  # held-out training rows at most
UNSCALED_PER_CHUNK = 128  # spectra whose element signals are retrieved together
CHUNK = 16  # transmitters predicted together, which bounds the memory of images with draws
# Covariances between rows over all elements, 2000 rows of 16: their factors and inverses are in memory together, 2 GB.
# Signals of a part of the rows would know less than the spectra nearby, and their weight rests on the contrary.
MOST_COVARIANCES = 6.4e7
STARTS = 60  # starts of the phase retrieval of one spectrum, at most
LONGEST, SHORTEST = 4.6, 0.25  # lengths over which a wave stays coherent, in wavelengths
LEAST_ROWS = 8  # least number of spectra for a covariance of signals

DRAWS = 64  # draws of which the expected minimum and maximum of a spectrum are means
COARSE = 0.1  # spacing of the directions of draws as a share of a lobe's width, wavelength over aperture
CLEAR = 100.0
"""Ratio above which the Rician's moments are taken from their series, which has six digits where differences cancel."""

Image = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class SpectrumKrigingSettings(KrigingSettings):
    """Settings of kriging of spectra.

    Attributes:
        cone_deg: greatest angle between the line of sight and waves that leave the transmitter.
        directions: directions on the whole sphere, of which those in the cone are used.
        lengths: number of lengths of coherence from `SHORTEST` to `LONGEST`, evenly spaced on a logarithmic scale.
    """

    cone_deg: Annotated[float, Field(gt=0, le=180, description="more than 0 and at most 180")] = 80.0
    directions: Count = 120
    lengths: Count = 4
    FIXED: ClassVar[Mapping[str, float]] = {"longest": LONGEST, "shortest": SHORTEST}


OF_SIGNALS = names_of(SpectrumKrigingSettings) - names_of(KrigingSettings)
"""Settings of the process of element signals."""


def rician(mean: NDArray[Any], variance: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of abs(z), z complex Gaussian with E z = mean, E |z - mean|^2 = variance."""
    # In double precision: the spread is the difference of two squares that may be 2 CLEAR times as large.
    mean, variance, kind = mean.astype(complex), variance.astype(float), variance.dtype
    # E|z| = sqrt(pi v) / 2 exp(-h) ((1 + 2 h) I0(h) + 2 h I1(h)), h = |m|^2 / (2 v); i0e and i1e hold the exponential.
    power = np.abs(mean) ** 2
    # Without variance the ratio is large; without mean and variance it is 0.
    half = power / np.maximum(2 * variance, 1e-9 * power + np.finfo(power.dtype).tiny)
    near = np.minimum(half, CLEAR)
    expected = np.sqrt(np.pi * variance) / 2 * ((1 + 2 * near) * i0e(near) + 2 * near * i1e(near))
    spread = np.maximum(power + variance - expected**2, 0)
    series = 1 / (8 * np.maximum(half, CLEAR))
    far = half >= CLEAR
    expected = np.where(far, np.sqrt(power + variance / 2 * (1 + series)), expected)
    deviation = np.sqrt(np.where(far, variance / 2 * (1 - series), spread))
    return expected.astype(kind), deviation.astype(kind)


@dataclass(eq=False)
class ExpectedSpectrum:
    """Maps uncertain element signals of an array [m, 3] to the expected spectrum [height, width].

    The instrument scales each spectrum to its minimum and maximum, whose expectations are means over a few draws on a
    coarse grid, the same draws for every position.
    """

    elements_m: FloatArray
    frequency_hz: float
    height: int
    width: int

    def __post_init__(self) -> None:
        elements_m, frequency_hz, (height, width) = self.elements_m, self.frequency_hz, self.shape
        grid = pixel_directions(height, width)
        aperture = max(float(np.ptp(elements_m, axis=0).max()), np.finfo(float).tiny)
        apart = COARSE * speed_of_light / frequency_hz / aperture  # rad
        rows, columns = (max(round(apart * size), 1) for size in (height / (np.pi / 2), width / (2 * np.pi)))
        coarse = grid[::rows, ::columns].reshape(-1, 3)
        self._fine: NDArray[np.complex64] = (
            array_response(elements_m, grid.reshape(-1, 3), frequency_hz).conj().astype(np.complex64)
        )
        self._basis: ComplexArray | None = None
        self._coarse = array_response(elements_m, coarse, frequency_hz).conj()
        rng = np.random.default_rng(0)
        pair = rng.normal(size=(2, DRAWS, len(elements_m))) / np.sqrt(2)
        self._draws: ComplexArray = pair[0] + 1j * pair[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width

    def __call__(self, posterior: Posterior) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the scaled spectra, [q, height, width]."""
        images = self._fine @ posterior.mean.T.astype(np.complex64)
        if self._basis is not posterior.basis:  # computed once for each process, as it dominates the time
            self._basis, self._seen = posterior.basis, np.abs(self._fine @ posterior.basis.astype(np.complex64)) ** 2
        spread = self._seen @ posterior.variance.T.astype(np.float32)
        expected, deviation = rician(images.T, spread.T)
        noise = self._draws[None] * np.sqrt(posterior.variance)[:, None, :]
        drawn = np.abs((posterior.mean[:, None] + noise @ posterior.basis.T) @ self._coarse.T)
        lowest, highest = drawn.min(axis=2).mean(axis=1), drawn.max(axis=2).mean(axis=1)
        span = (highest - lowest)[:, None]
        grey = np.clip((expected - lowest[:, None]) / span, 0, 1)
        return grey.reshape(-1, *self.shape), (deviation / span).reshape(-1, *self.shape)


@dataclass
class KrigedSpectra(Probabilistic):
    """Fitted model of one receiver.

    Attributes:
        signals, nearby, report: process of the signals, kriging of the spectra, and expected spectrum of signals.
        half: c, the share of unknown variance at which the signals have half of the weight.
        spread: factor on predicted standard deviations that fits held-out rows.
    """

    signals: SignalProcess
    nearby: AnisotropicKriging
    report: ExpectedSpectrum
    half: float = 1.0
    spread: float = 1.0

    def mixed(
        self, of_signals: tuple[Image, Image], ignorance: FloatArray, nearby: Image, nearby_std: Image | None
    ) -> tuple[Image, Image | None]:
        """Mean and standard deviation of both estimates, [q, height, width], weighted; None for a mean alone.

        ``of_signals`` are spectra expected from signals and their deviations, ``ignorance`` that of the signals [q].
        """
        expected, deviation = of_signals
        weight = signal_weight(ignorance, self.half)[:, None, None]
        difference = expected - nearby
        mean = nearby + weight * difference
        if nearby_std is None:
            return mean, None
        # Variance of a mixture of two distributions: that within both, and that between their means.
        variance = weight * deviation**2 + (1 - weight) * nearby_std**2 + weight * (1 - weight) * difference**2
        return mean, np.sqrt(variance)

    def predict(self, tx_pos: FloatArray, tx_heading_rad: FloatArray | None = None) -> NDArray[np.float32]:
        """Spectra [m, height, width] at positions [m, 3], metres; headings are not used."""
        return self._estimated(tx_pos, None)

    def prediction(self, tx_pos: FloatArray) -> Prediction:
        """Spectra and standard deviations at positions [m, 3], metres."""
        std = np.empty((len(tx_pos), *self.report.shape))
        mean = self._estimated(tx_pos, std)
        std *= self.spread
        return Prediction(mean, std)

    def _estimated(self, tx_pos: FloatArray, std: Image | None) -> NDArray[np.float32]:
        """Spectra [m, height, width] and, written into ``std``, standard deviations before `spread`."""
        # Filled chunk by chunk: joined chunks would take the memory twice.
        mean = np.empty((len(tx_pos), *self.report.shape), np.float32)
        with one_blas_thread():
            for begin in range(0, len(tx_pos), CHUNK):
                rows, at = slice(begin, begin + CHUNK), tx_pos[begin : begin + CHUNK]
                nearby_std = None if std is None else self.nearby.std(at)
                posterior, nearby = self.signals.predict(at), self.nearby.predict(at)
                mean[rows], deviation = self.mixed(self.report(posterior), posterior.ignorance, nearby, nearby_std)
                if std is not None:
                    std[rows] = deviation
        return np.clip(mean, 0, 1)

    def facts(self) -> dict[str, Any]:
        """Lengths, shares and weights."""
        lengths_m = self.signals.covariances.lengths_m
        share = self.signals.weight.sum(axis=0).reshape(len(lengths_m), -1)
        along, across, up = map(float, self.nearby.length_m)
        return {
            "parts": "signals, nearby",
            "coherent_m": [round(float(v), 4) for v in lengths_m],
            "coherent_share": [round(float(v), 4) for v in share.sum(axis=1) / share.sum()],
            "turned_share": float(share[:, 1:].sum() / share.sum()),
            "correlation_m": {"along": along, "across": across, "up": up},
            "half_ignorance": self.half,
        }


def signal_weight(ignorance: FloatArray, half: float) -> FloatArray:
    """Weight of the signals [q] for their shares of unknown variance [q] and c."""
    return ignorance**2 / (ignorance**2 + half**2) * (1 - ignorance)


def _retrieved(observed: NDArray[Any], lags: Lags, seed: int, on_progress: OnProgress) -> ComplexArray:
    """Element signals [n, elements] of spectra, each with any phase and scale."""
    chunks = []
    for begin in range(0, len(observed), UNSCALED_PER_CHUNK):
        on_progress("element signals of spectra", begin / len(observed))
        unscaled = unscale(observed[begin : begin + UNSCALED_PER_CHUNK], lags)
        chunks.append(retrieve_signals(unscaled, lags, seed, STARTS).signals)
    return np.concatenate(chunks)


def _fit_signals_and_nearby(
    signals: ComplexArray,
    position_m: FloatArray,
    observed: NDArray[Any],
    rows: ReceiverRows,
    array_m: FloatArray,
    frequency_hz: float,
) -> KrigedSpectra:
    """Fit both estimates and their weights to element signals and spectra of rows at positions [n, 3], metres."""
    settings, seed = rows.problem.settings, rows.problem.seed
    wavelength, observed = speed_of_light / frequency_hz, np.asarray(observed, np.float32)
    receiver_m = rows.receiver.position_m
    towards = line_of_sight(position_m, receiver_m)
    covariances = Covariances(
        np.geomspace(LONGEST, SHORTEST, settings.lengths) * wavelength,
        departures(towards, 2 * np.pi / wavelength, settings.cone_deg, settings.directions),
    )

    def part(stage: str) -> Callable[[float], None]:
        return lambda share: rows.on_progress(stage, share)

    process = fit_signals(signals, position_m, array_m, covariances, seed, part("signals"))
    nearby = fit_anisotropic(position_m, observed, receiver_m, wavelength, seed)
    kriged = KrigedSpectra(process, nearby, ExpectedSpectrum(array_m, frequency_hz, *observed.shape[1:]))
    _fit_weights(kriged, observed, wavelength, seed, part("weights"))
    process.forget_precision()
    return kriged


def _fit_weights(
    kriged: KrigedSpectra,
    observed: NDArray[np.float32],
    wavelength: float,
    seed: int,
    on_progress: Callable[[float], None],
) -> None:
    """Fit c, then the factor on standard deviations, to training rows predicted across gaps.

    Where rows lie so close that none is beyond any gap, both keep their values.
    """
    drawn = np.sort(np.random.default_rng([seed, 2]).permutation(len(observed))[:HELD_OUT])
    # A row that has no row beyond the gap would be predicted by the mean of all.
    farthest = cdist(kriged.nearby.tx_pos_m[drawn], kriged.nearby.tx_pos_m).max(axis=1)
    predictions: list[tuple[Image, tuple[Image, Image], FloatArray, Image, Image]] = []
    terms: list[tuple[Any, Any, Any]] = []
    for number, gap in enumerate(GAPS):
        held_out = drawn[farthest > gap * wavelength]
        if not len(held_out):
            break
        truth, posterior = observed[held_out], kriged.signals.held_out(gap * wavelength, held_out)
        nearby, nearby_std = kriged.nearby.held_out(gap * wavelength, held_out)
        expected, deviation = (image.astype(np.float32) for image in kriged.report(posterior))
        difference = expected - nearby
        products = (np.einsum("nhw,nhw->n", difference, other) for other in (difference, truth - nearby))
        terms.append((posterior.ignorance, *products))
        predictions.append((truth, (expected, deviation), posterior.ignorance, nearby, nearby_std))
        on_progress((number + 1) / (2 * len(GAPS)))
    if not predictions:
        return
    ignorance, square, product = (np.concatenate(part) for part in zip(*terms, strict=True))
    grid = np.geomspace(0.01, 3.0, 60)
    # The squared error less its constant, sum of w^2 |d|^2 - 2 w d . m. Without the factor 1 - v, as training rows lie
    # between others and do not show the error of a process outside of them.
    shares = ignorance**2 / (ignorance**2 + grid[:, None] ** 2)
    kriged.half = float(grid[((shares**2 * square) - 2 * shares * product).sum(axis=1).argmin()])
    # Every fifth pixel along either side: neighbours within a lobe's width have the same error.
    ratios = []
    for truth, of_signals, unknown, nearby, nearby_std in predictions:
        mean, std = kriged.mixed(of_signals, unknown, nearby, nearby_std)
        assert std is not None
        ratios.append((np.abs(truth - mean) / np.maximum(std, 1e-6))[:, ::5, ::5].ravel())
        on_progress(0.5 + len(ratios) / (2 * len(predictions)))
    kriged.spread = float(np.quantile(np.concatenate(ratios), LEVEL) / REAL_90)


class SpectrumKriging(GenericKriging):
    """Kriging of spectra: element signals mixed with the spectra nearby where the array is known, else generic."""

    settings = SpectrumKrigingSettings
    headings = False  # a spectrum has no scale on which the transmitter's pattern could act

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of element signals where the spectra themselves are kriged."""
        record, unused = problem.record, super().unused_settings(problem, splits)
        arrays = any(receiver.array_m is not None for receiver in record.receivers)
        few = max(rows_received(record, split.all_train).max() for split in splits) < LEAST_ROWS
        if asks_generic(problem) or not arrays or record.frequencies_hz is None or few:
            why = "the spectra themselves are kriged, not signals of an array's elements"
            return {**unused, **dict.fromkeys(OF_SIGNALS, why)}
        return unused

    def fit_single(self, rows: ReceiverRows) -> Single:
        """Kriging of the spectra of one receiver.

        Signals are used where array and single carrier are known, the array's spectra determine its signals, and their
        covariances fit into the memory. Generic kriging states standard deviations where array and carrier are known.

        Raises:
            InputError: no row that was received.
        """
        record, receiver, frequencies_hz = rows.problem.record, rows.receiver, rows.problem.record.frequencies_hz
        if asks_generic(rows.problem) or receiver.array_m is None or frequencies_hz is None:
            return kriged(rows)
        position_m, observed, _ = observed_rows(rows.tx_pos_m, rows.observation)
        frequency_hz = float(frequencies_hz[0])
        with one_blas_thread():
            if len(observed) >= LEAST_ROWS:
                try:
                    lags = Lags(receiver.array_m, frequency_hz, *observed.shape[1:])
                    if len(receiver.array_m) * len(observed) ** 2 > MOST_COVARIANCES:
                        raise InputError(f"{len(observed)} rows are too many for a process of element signals")
                    signals = _retrieved(observed, lags, rows.problem.seed, rows.on_progress)
                except InputError as error:  # or a line of elements, or elements too far apart for lags
                    if unused_settings := OF_SIGNALS & rows.problem.stated_settings:
                        raise InputError(f"setting {min(unused_settings)}: no effect, as {error}; omit it") from None
                    what = f"{record.name}, receiver {receiver.name}"
                    logger.warning("%s: the spectra themselves are kriged: %s", what, error)
                else:
                    return _fit_signals_and_nearby(signals, position_m, observed, rows, receiver.array_m, frequency_hz)
            return UncertainKriged.of(kriged(rows), observed)

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The models of all receivers, whose factors are to the last digit those of the fit."""
        with one_blas_thread():
            return super().load(arrays, problem, folder)
