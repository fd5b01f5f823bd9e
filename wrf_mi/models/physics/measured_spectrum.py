"""The physics model for spectra of a place without a mesh: the array's physics, without any planes.

Two estimates of a spectrum are mixed:

- *signals*: the element signals of the training spectra, as a Gaussian process whose covariance is that of waves
  leaving within a cone around the line of sight (`wrf_mi.models.physics.signals`), and the spectrum to be expected from
  them: at each direction the beam former's output is a complex Gaussian number, so its magnitude is Rician;
- *nearby*: kriging of the spectra themselves along and across the line of sight
  (`wrf_mi.models.interpolation.kriging_equations`).

Kriging is best over millimetres, as it needs no phase, and the signals over a wavelength; beyond, the mean of the
spectra, to which kriging falls back, is safest. So the signals have the weight v^2 / (v^2 + c^2) (1 - v), v being their
share of unknown variance; c is fitted to training rows predicted from others further away than 0 to 1 wavelengths.

Source: Rice, "Mathematical analysis of random noise" (1944), section 3.10.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist
from scipy.special import i0e, i1e

from ...core import InputError, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray, pixel_directions
from ...core.settings import CheckedSettings, Count, Positive
from ...core.types import IntArray
from ...receivers.array import array_response
from ...receivers.lags import Lags
from ...receivers.retrieve import retrieve_signals, unscale
from ...tasks import require
from ...tasks.scores import REAL_90
from ...training.session import OnProgress, quiet
from ..interpolation.kriging_equations import AnisotropicKriging, fit_anisotropic, line_of_sight
from ..model import Arrays, field_arrays, from_field_arrays
from .selection import PhysicsModel, physics_model
from .signals import ComplexArray, Covariances, Posterior, SignalProcess, departures, fit_signals

GAPS = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Radii in wavelengths around a held-out row within which no row is used while the weights are fitted."""
HELD_OUT = 80
"""Held-out training rows at most."""
INTERVAL = 0.9
"""Share of errors that calibrated intervals cover."""
UNSCALED_PER_CHUNK = 256
"""Spectra whose element signals are retrieved together."""
LEAST_ROWS = 8
"""Least number of spectra for a covariance of signals."""

DRAWS = 64
COARSE = 0.1
"""Spacing of the directions of draws as a share of a lobe's width, wavelength over aperture."""
CLEAR = 100.0
"""Ratio above which the Rician's moments are taken from their series, which has six digits where differences cancel."""

Image = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class MeasuredSpectrumSettings(CheckedSettings):
    """Settings of the physics model for spectra without a mesh.

    Attributes:
        cone_deg: greatest angle between the line of sight and waves that leave the transmitter.
        directions: directions on the whole sphere, of which those in the cone are used.
        longest: greatest length over which a wave stays coherent, in wavelengths.
        shortest: least such length.
        lengths: number of lengths, evenly spaced on a logarithmic scale.
        starts: starts of the phase retrieval of one spectrum, at most.
    """

    cone_deg: Annotated[float, Field(gt=0, le=180, description="more than 0 and at most 180")] = 80.0
    directions: Count = 120
    longest: Positive = 4.6
    shortest: Positive = 0.25
    lengths: Count = 4
    starts: Count = 60

    def __post_init__(self) -> None:
        """Refuse settings out of range (`InputError`)."""
        super().__post_init__()
        if self.shortest > self.longest:
            raise InputError(f"setting shortest: {self.shortest} is out of range, choose at most longest")


def rician(mean: NDArray[Any], variance: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
    """Mean and standard deviation of abs(z), z complex Gaussian with E z = mean, E |z - mean|^2 = variance."""
    power = np.abs(mean) ** 2
    # Without variance the ratio is large; without mean and variance it is 0.
    half = power / np.maximum(2 * variance, 1e-9 * power + np.finfo(power.dtype).tiny)
    near = np.minimum(half, CLEAR)
    expected = np.sqrt(np.pi * variance) / 2 * ((1 + 2 * near) * i0e(near) + 2 * near * i1e(near))
    spread = np.maximum(power + variance - expected**2, 0)
    series = 1 / (8 * np.maximum(half, CLEAR))
    far = half >= CLEAR
    expected = np.where(far, np.sqrt(power + variance / 2 * (1 + series)), expected)
    return expected, np.sqrt(np.where(far, variance / 2 * (1 - series), spread))


class ExpectedSpectrum:
    """Maps uncertain element signals of an array [m, 3] to the expected spectrum [height, width].

    The instrument scales each spectrum to its minimum and maximum, whose expectations are means over a few draws on a
    coarse grid, the same draws for every position.
    """

    def __init__(self, elements_m: FloatArray, frequency_hz: float, height: int, width: int) -> None:
        self.shape = height, width
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
class Side:
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

    def mixed(self, posterior: Posterior, nearby: Image, nearby_std: Image) -> tuple[Image, Image]:
        """Mean and standard deviation of the weighted estimates, [q, height, width]."""
        expected, deviation = self.report(posterior)
        weight = signal_weight(posterior.ignorance, self.half)[:, None, None]
        difference = expected - nearby
        variance = weight * deviation**2 + (1 - weight) * nearby_std**2 + weight * (1 - weight) * difference**2
        return nearby + weight * difference, np.sqrt(variance)


def signal_weight(ignorance: FloatArray, half: float) -> FloatArray:
    """Weight of the signals [q] for their shares of unknown variance [q] and c."""
    return ignorance**2 / (ignorance**2 + half**2) * (1 - ignorance)


@dataclass(eq=False, repr=False)
class MeasuredSpectrumPhysics(PhysicsModel):
    """Spectra predicted from measured ones and the array's physics; see the module.

    A spectrum has no scale on which the transmitter's pattern could act, so headings change nothing.

    Attributes:
        receivers: receivers of the spectra.
        sides: fitted model of each.
        frequency_hz: carrier frequency.
        shape: height and width of a spectrum.
    """

    receivers: tuple[Receiver, ...]
    sides: tuple[Side, ...]
    frequency_hz: float
    shape: tuple[int, int]
    chunk_size: ClassVar[int] = 16

    def _predict(self, tx_pos_m: FloatArray, receiver: int, heading_rad: FloatArray | None) -> tuple[Any, Any]:
        side = self.sides[receiver]
        posterior = side.signals.predict(tx_pos_m)
        mean, std = side.mixed(posterior, side.nearby.predict(tx_pos_m), side.nearby.std(tx_pos_m))
        std = side.spread * std.astype(np.float32)
        return np.clip(mean.astype(np.float32), 0, 1), std.astype(float)

    def summary(self) -> dict[str, Any]:
        """Lengths, shares and weights of the first receiver."""
        side = self.sides[0]
        lengths_m = side.signals.covariances.lengths_m
        share = side.signals.weight.sum(axis=0).reshape(len(lengths_m), -1)
        along, across, up = map(float, side.nearby.length_m)
        return {
            "parts": "signals, nearby",
            "coherent_m": [round(float(v), 4) for v in lengths_m],
            "coherent_share": [round(float(v), 4) for v in share.sum(axis=1) / share.sum()],
            "turned_share": float(share[:, 1:].sum() / share.sum()),
            "correlation_m": {"along": along, "across": across, "up": up},
            "half_ignorance": side.half,
        }

    def arrays(self) -> Arrays:
        """Arrays for `from_arrays`."""
        stored: Arrays = {
            "kind": np.array("measured-spectrum"),
            "frequency_hz": np.array(self.frequency_hz),
            "shape": np.array(self.shape),
            **receiver_arrays(self.receivers),
        }
        for number, side in enumerate(self.sides):
            stored |= side.signals.arrays(f"{number}/signals/")
            stored |= field_arrays(side.nearby, f"{number}/nearby/")
            stored[f"{number}/weights"] = np.array([side.half, side.spread])
        return stored

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> MeasuredSpectrumPhysics:
        """The model that `arrays` stored."""
        receivers, sides = stored_receivers(arrays), []
        frequency_hz = float(arrays["frequency_hz"])
        height, width = (int(v) for v in arrays["shape"])

        for number, receiver in enumerate(receivers):
            assert receiver.array_m is not None, "see `fit_measured_spectrum`"
            process = SignalProcess.from_arrays(arrays, f"{number}/signals/")
            nearby = from_field_arrays(AnisotropicKriging, arrays, f"{number}/nearby/")
            report = ExpectedSpectrum(receiver.array_m, frequency_hz, height, width)
            sides.append(Side(process, nearby, report, *map(float, arrays[f"{number}/weights"])))
        return cls(receivers, tuple(sides), frequency_hz, (height, width))


def fit_measured_spectrum(
    record: Record,
    rows: IntArray,
    settings: MeasuredSpectrumSettings = MeasuredSpectrumSettings(),
    seed: int = 0,
    on_progress: OnProgress = quiet,
) -> MeasuredSpectrumPhysics:
    """Fit the physics model to ``rows`` of spectra; arguments as ``fit`` of `physics_model`, without a scene.

    ``seed`` is that of starts and of the held-out rows.

    Raises:
        InputError: no spectra, no array, or too few rows.
    """
    require(record, "spectrum", why="this physics model predicts spectra")
    if any(receiver.array_m is None for receiver in record.receivers) or record.frequencies_hz is None:
        raise InputError(f"{record.name}: its array or frequency is not known; state both in its gateway_info.yml")
    if len(rows) < LEAST_ROWS:
        raise InputError(_too_few(record.name, len(rows)))
    frequency_hz = float(record.frequencies_hz[0])
    wavelength = speed_of_light / frequency_hz
    height, width = record.observation.shape[2:]
    sides = []
    for receiver, every in zip(record.receivers, record.observation, strict=True):
        assert receiver.array_m is not None
        instrument = receiver.array_m, frequency_hz, height, width
        lags, report = Lags(*instrument), ExpectedSpectrum(*instrument)
        observed = np.asarray(every[rows], np.float32)
        received = np.isfinite(observed).all(axis=(1, 2))
        observed, positions = observed[received], record.tx_pos_m[rows][received]
        if len(observed) < LEAST_ROWS:
            raise InputError(_too_few(f"{record.name}, receiver {receiver.name}", len(observed)))
        chunks = []
        for start in range(0, len(observed), UNSCALED_PER_CHUNK):
            on_progress(f"{receiver.name}: element signals of spectra", start / len(observed))
            unscaled = unscale(observed[start : start + UNSCALED_PER_CHUNK], lags)
            chunks.append(retrieve_signals(unscaled, lags, seed, settings.starts).signals)
        towards = line_of_sight(positions, receiver.position_m)
        covariances = Covariances(
            np.geomspace(settings.longest, settings.shortest, settings.lengths) * wavelength,
            departures(towards, 2 * np.pi / wavelength, settings.cone_deg, settings.directions),
        )
        progress = partial(on_progress, f"{receiver.name}: signals")
        process = fit_signals(np.concatenate(chunks), positions, receiver.array_m, covariances, seed, progress)
        side = Side(process, fit_anisotropic(positions, observed, receiver.position_m, wavelength, seed), report)
        _fit_weights(side, observed, wavelength, seed, partial(on_progress, f"{receiver.name}: weights"))
        sides.append(side)
    return MeasuredSpectrumPhysics(record.receivers, tuple(sides), frequency_hz, (height, width))


MODEL = physics_model(
    "spectrum",
    MeasuredSpectrumSettings,
    lambda record, rows, scene, *how: fit_measured_spectrum(record, rows, *how),
    MeasuredSpectrumPhysics.from_arrays,
)


def _too_few(name: str, count: int) -> str:
    return f"{name}: {count} training rows without a mesh; give {LEAST_ROWS} or more, or a scene"


def _fit_weights(
    side: Side, observed: NDArray[np.float32], wavelength: float, seed: int, on_progress: Callable[[float], None]
) -> None:
    """Fit c, then the factor on standard deviations, to training rows predicted across gaps.

    Where rows lie so close that none is beyond any gap, both keep their values.
    """
    drawn = np.sort(np.random.default_rng([seed, 2]).permutation(len(observed))[:HELD_OUT])
    farthest = cdist(side.nearby.tx_pos_m[drawn], side.nearby.tx_pos_m).max(axis=1)
    predictions: list[tuple[Image, Posterior, Image, Image]] = []
    terms: list[tuple[Any, Any, Any]] = []
    for number, gap in enumerate(GAPS):
        rows = drawn[farthest > gap * wavelength]
        if not len(rows):
            break
        truth, posterior = observed[rows], side.signals.held_out(gap * wavelength, rows)
        nearby, nearby_std = side.nearby.held_out(gap * wavelength, rows)
        difference = side.report(posterior)[0] - nearby
        products = (np.einsum("nhw,nhw->n", difference, other) for other in (difference, truth - nearby))
        terms.append((posterior.ignorance, *products))
        predictions.append((truth, posterior, nearby, nearby_std))
        on_progress((number + 1) / (2 * len(GAPS)))
    if not predictions:
        return
    ignorance, square, product = (np.concatenate(part) for part in zip(*terms, strict=True))
    grid = np.geomspace(0.01, 3.0, 60)
    # The squared error less its constant, sum of w^2 |d|^2 - 2 w d . m. Without the factor 1 - v, as training rows lie
    # between others and do not show the error of a process outside of them.
    shares = ignorance**2 / (ignorance**2 + grid[:, None] ** 2)
    side.half = float(grid[((shares**2 * square) - 2 * shares * product).sum(axis=1).argmin()])
    ratios = []
    for truth, posterior, nearby, nearby_std in predictions:
        mean, std = side.mixed(posterior, nearby, nearby_std)
        ratios.append((np.abs(truth - mean) / np.maximum(std, 1e-6))[:, ::5, ::5].ravel())
        on_progress(0.5 + len(ratios) / (2 * len(predictions)))
    side.spread = float(np.quantile(np.concatenate(ratios), INTERVAL) / REAL_90)
