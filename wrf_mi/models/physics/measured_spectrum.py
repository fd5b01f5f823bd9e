"""A physics model for spectra of a place without a mesh: what the array's physics tells, without any planes.

Two estimates of one spectrum, and how far to trust each:

- *signals*: the element signals that the training spectra tell, as a Gaussian process whose covariance is that of waves
  leaving within a cone around the line of sight (`wrf_mi.models.physics.signals`), and the spectrum that they are
  expected to give (`wrf_mi.models.physics.expected_spectrum`);
- *nearby*: kriging of the spectra themselves along and across the line of sight
  (`wrf_mi.models.physics.anisotropic_kriging`).

Interpolation over millimetres is best left to the second, which needs no phase; a wavelength away the first knows more;
where neither knows anything the mean of the spectra, to which the second falls back, is safer than a Gaussian's mean.
So the first has the weight v^2 / (v^2 + c^2) (1 - v), v being its own share of ignorance, and c is fitted to training
rows predicted from others that are further away than 0 to 1 wavelengths.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import speed_of_light
from scipy.spatial.distance import cdist

from ...core import InputError, Prediction, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...receivers.lags import Lags
from ...receivers.retrieve import retrieve_signals, unscale
from ...tasks import require
from .anisotropic_kriging import AnisotropicKriging, fit_nearby, line_of_sight
from .expected_spectrum import ExpectedSpectrum
from .signal_kernels import Covariances, departures
from .signals import Posterior, SignalProcess, fit_signals

GAPS = (0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Radii, in wavelengths, within which no row may help to predict a training row while the weights are fitted."""
HELD_OUT = 80
"""Training rows that are predicted so."""
INTERVAL = 0.9
NORMAL = 1.6449
"""Share of a normal distribution within so many standard deviations."""
PREDICTED_PER_CHUNK = 16
UNSCALED_PER_CHUNK = 256
"""Spectra: several times their own size is needed meanwhile."""
LEAST_ROWS = 8
"""Fewer spectra tell no covariance of signals."""

OnProgress = Callable[[str, float], None]
Image = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class MeasuredSpectrumSettings:
    """Settings of the physics model for spectra without a mesh.

    Attributes:
        cone_deg: waves leave the transmitter at most so far from the line of sight.
        directions: on the whole sphere, of which those in the cone are taken.
        longest: greatest length over which a wave stays coherent, in wavelengths.
        shortest: least such length.
        lengths: how many, evenly on a logarithmic scale.
        starts: of the phase retrieval of one spectrum, at most.
    """

    cone_deg: float = 80.0
    directions: int = 120
    longest: float = 4.6
    shortest: float = 0.25
    lengths: int = 4
    starts: int = 60

    def __post_init__(self) -> None:
        """Reject what no fit can use.

        Raises:
            InputError: naming the setting.
        """
        for name in ("directions", "lengths", "starts"):
            if getattr(self, name) < 1:
                raise InputError(f"setting {name}: {getattr(self, name)}; choose 1 or more")
        if not 0 < self.cone_deg <= 180:
            raise InputError(f"setting cone_deg: {self.cone_deg}; choose more than 0 and at most 180")
        if not 0 < self.shortest <= self.longest < np.inf:
            raise InputError(f"setting shortest: {self.shortest}; choose more than 0 and at most longest")


@dataclass
class Side:
    """What is known of one receiver.

    Attributes:
        signals: the process.
        nearby: the interpolation.
        half: c, the ignorance at which the process counts half.
        spread: factor on predicted standard deviations that makes them fit held-out rows.
    """

    signals: SignalProcess
    nearby: AnisotropicKriging
    half: float
    spread: float


class MeasuredSpectrumPhysics:
    """Spectra predicted from measured ones and the array's physics; see the module.

    Args:
        receivers: whose spectra they are.
        sides: one for each.
        frequency_hz: of the carrier.
        shape: height and width of a spectrum.
    """

    task = "spectrum"
    uses_heading = False

    def __init__(
        self,
        receivers: tuple[Receiver, ...],
        sides: tuple[Side, ...],
        frequency_hz: float,
        shape: tuple[int, int],
    ) -> None:
        self.receivers, self.sides = receivers, sides
        self.frequency_hz, self.shape = frequency_hz, shape
        arrays = (one.array_m for one in receivers)
        self._reports = [ExpectedSpectrum(own, frequency_hz, *shape) for own in arrays if own is not None]

    def predict(
        self, tx_pos_m: ArrayLike, receiver: int | str = 0, tx_heading_rad: ArrayLike | None = None
    ) -> Prediction:
        """Expected spectra at positions [q, 3], metres, and their standard deviation, [q, height, width].

        Args:
            tx_pos_m: metres, world frame.
            receiver: name, or number from 0.
            tx_heading_rad: not used: a spectrum has no scale that the transmitter's pattern could change.

        Raises:
            InputError: positions of another shape or not finite, or no such receiver.
        """
        positions = np.atleast_2d(np.asarray(tx_pos_m, float))
        if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
            raise InputError(f"transmitters: shape {positions.shape}; give finite positions [m, 3] in metres")
        mean = np.zeros((len(positions), *self.shape), np.float32)
        std = np.zeros_like(mean)
        index = receiver_index(self.receivers, receiver)
        side, report = self.sides[index], self._reports[index]
        for start in range(0, len(positions), PREDICTED_PER_CHUNK):
            part = slice(start, start + PREDICTED_PER_CHUNK)
            posterior = side.signals.predict(positions[part])
            mean[part], std[part] = _mixed(
                posterior, report, side.nearby.predict(positions[part]), side.nearby.std(positions[part]), side
            )
        return Prediction(np.clip(mean, 0, 1), (side.spread * std).astype(float))

    def summary(self) -> dict[str, Any]:
        """What was fitted, of the first receiver."""
        side = self.sides[0]
        share = side.signals.weight.sum(axis=0).reshape(len(side.signals.covariances.lengths_m), -1)
        along, across, up = side.nearby.length_m
        return {
            "parts": "signals, nearby",
            "coherent_m": _rounded(side.signals.covariances.lengths_m),
            "coherent_share": _rounded(share.sum(axis=1) / share.sum()),
            "turned_share": float(share[:, 1:].sum() / share.sum()),
            "correlation_m": {"along": float(along), "across": float(across), "up": float(up)},
            "half_ignorance": side.half,
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All that `from_arrays` needs."""
        stored: dict[str, NDArray[Any]] = {
            "kind": np.array("measured-spectrum"),
            "frequency_hz": np.array(self.frequency_hz),
            "shape": np.array(self.shape),
            **receiver_arrays(self.receivers),
        }
        for number, side in enumerate(self.sides):
            stored |= {f"{number}/signals/{key}": value for key, value in side.signals.arrays().items()}
            stored |= {f"{number}/nearby/{key}": value for key, value in side.nearby.arrays().items()}
            stored[f"{number}/weights"] = np.array([side.half, side.spread])
        return stored

    @classmethod
    def from_arrays(cls, arrays: dict[str, NDArray[Any]], scene: Any | None = None) -> MeasuredSpectrumPhysics:
        """A physics model as `arrays` gave it; ``scene`` is not used."""
        receivers = stored_receivers(arrays)

        def below(prefix: str) -> dict[str, NDArray[Any]]:
            return {key.removeprefix(prefix): value for key, value in arrays.items() if key.startswith(prefix)}

        sides = []
        for number in range(len(receivers)):
            half, spread = arrays[f"{number}/weights"]
            process = SignalProcess.from_arrays(below(f"{number}/signals/"))
            nearby = AnisotropicKriging.from_arrays(below(f"{number}/nearby/"))
            sides.append(Side(process, nearby, float(half), float(spread)))
        height, width = (int(v) for v in arrays["shape"])
        return cls(receivers, tuple(sides), float(arrays["frequency_hz"]), (height, width))


def fit_measured_spectrum(
    record: Record,
    rows: IntArray,
    settings: MeasuredSpectrumSettings = MeasuredSpectrumSettings(),
    seed: int = 0,
    on_progress: OnProgress = lambda what, share: None,
) -> MeasuredSpectrumPhysics:
    """Fit the physics model to training rows.

    Args:
        record: of spectra, with the array and the carrier's frequency stated.
        rows: training rows [n].
        settings: see `MeasuredSpectrumSettings`.
        seed: of starts and of the rows that weights are fitted to.
        on_progress: hears what is being done and the share that is done.

    Raises:
        InputError: no spectra, no array, or too few rows.
    """
    require(record, "spectrum", why="this physics model predicts spectra")
    if any(one.array_m is None for one in record.receivers) or record.frequencies_hz is None:
        raise InputError(f"{record.name}: its array or frequency is not known; state both in its gateway_info.yml")
    if len(rows) < LEAST_ROWS:
        raise InputError(_too_few(record.name, len(rows)))
    frequency_hz = float(record.frequencies_hz[0])
    height, width = record.observation.shape[2:]
    sides = tuple(
        _fit_side(record, r, rows, settings, frequency_hz, seed, on_progress) for r in range(len(record.receivers))
    )
    return MeasuredSpectrumPhysics(record.receivers, sides, frequency_hz, (height, width))


def _fit_side(
    record: Record,
    number: int,
    rows: IntArray,
    settings: MeasuredSpectrumSettings,
    frequency_hz: float,
    seed: int,
    on_progress: OnProgress,
) -> Side:
    receiver = record.receivers[number]
    assert receiver.array_m is not None, "see `fit_measured_spectrum`"
    height, width = record.observation.shape[2:]
    lags = Lags(receiver.array_m, frequency_hz, height, width)
    report = ExpectedSpectrum(receiver.array_m, frequency_hz, height, width)
    observed = np.asarray(record.observation[number, rows], np.float32)
    received = np.isfinite(observed).all(axis=(1, 2))
    observed, positions = observed[received], record.tx_pos_m[rows][received]
    if len(observed) < LEAST_ROWS:
        raise InputError(_too_few(f"{record.name}, receiver {receiver.name}", len(observed)))
    parts = []
    for start in range(0, len(observed), UNSCALED_PER_CHUNK):
        on_progress(f"{receiver.name}: element signals of spectra", start / len(observed))
        unscaled = unscale(observed[start : start + UNSCALED_PER_CHUNK], lags)
        parts.append(retrieve_signals(unscaled, lags, seed, settings.starts).signals)
    signals = np.concatenate(parts)
    wavelength = speed_of_light / frequency_hz
    towards = line_of_sight(positions, receiver.position_m)
    covariances = Covariances(
        np.geomspace(settings.longest, settings.shortest, settings.lengths) * wavelength,
        departures(towards, 2 * np.pi / wavelength, settings.cone_deg, settings.directions),
    )
    process = fit_signals(
        signals,
        positions,
        receiver.array_m,
        covariances,
        seed,
        lambda done: on_progress(f"{receiver.name}: signals", done),
    )
    nearby = fit_nearby(positions, observed, receiver.position_m, wavelength, seed)
    side = Side(process, nearby, 1.0, 1.0)
    _weigh(side, observed, report, wavelength, seed, lambda done: on_progress(f"{receiver.name}: weights", done))
    return side


def _too_few(what: str, count: int) -> str:
    return f"{what}: {count} training rows without a mesh; give {LEAST_ROWS} or more, or a scene"


def _mixed(
    posterior: Posterior, report: ExpectedSpectrum, nearby: Image, nearby_std: Image, side: Side
) -> tuple[Image, Image]:
    """Mean and standard deviation of the two estimates weighed, [q, height, width]."""
    expected, deviation = report(posterior)
    weight = _weight(posterior.ignorance, side.half)[:, None, None]
    difference = expected - nearby
    variance = weight * deviation**2 + (1 - weight) * nearby_std**2 + weight * (1 - weight) * difference**2
    return nearby + weight * difference, np.sqrt(variance)


def _weight(ignorance: FloatArray, half: float) -> FloatArray:
    return ignorance**2 / (ignorance**2 + half**2) * (1 - ignorance)


def _weigh(
    side: Side,
    observed: NDArray[np.float32],
    report: ExpectedSpectrum,
    wavelength: float,
    seed: int,
    on_progress: Callable[[float], None],
) -> None:
    """Fit c, then the factor on standard deviations, to training rows predicted across gaps.

    Where the rows lie so close that none is left beyond any gap, both stay as they are.
    """
    drawn = np.sort(np.random.default_rng([seed, 2]).permutation(len(observed))[:HELD_OUT])
    farthest = cdist(side.nearby.tx_pos_m[drawn], side.nearby.tx_pos_m).max(axis=1)
    kept: list[tuple[Image, Posterior, Image, Image]] = []
    terms: list[tuple[Any, Any, Any]] = []
    for number, gap in enumerate(GAPS):
        rows = drawn[farthest > gap * wavelength]
        if not len(rows):
            break
        truth, posterior = observed[rows], side.signals.held_out(gap * wavelength, rows)
        nearby, nearby_std = side.nearby.held_out(gap * wavelength, rows)
        difference = report(posterior)[0] - nearby
        missing = truth - nearby
        terms.append((posterior.ignorance, _inner(difference, difference), _inner(difference, missing)))
        kept.append((truth, posterior, nearby, nearby_std))
        on_progress((number + 1) / (2 * len(GAPS)))
    if not kept:
        return
    ignorance, square, product = (np.concatenate(part) for part in zip(*terms, strict=True))
    grid = np.geomspace(0.01, 3.0, 60)
    # What mixing leaves: sum of w^2 |d|^2 - 2 w d . m. Without the factor 1 - v: training rows lie between others, so
    # they do not tell how little to believe a process outside of them.
    shares = ignorance**2 / (ignorance**2 + grid[:, None] ** 2)
    side.half = float(grid[((shares**2 * square) - 2 * shares * product).sum(axis=1).argmin()])
    ratios = []
    for truth, posterior, nearby, nearby_std in kept:
        mean, std = _mixed(posterior, report, nearby, nearby_std, side)
        ratios.append((np.abs(truth - mean) / np.maximum(std, 1e-6))[:, ::5, ::5].ravel())
        on_progress(0.5 + len(ratios) / (2 * len(kept)))
    side.spread = float(np.quantile(np.concatenate(ratios), INTERVAL) / NORMAL)


def _inner(a: Image, b: Image) -> Image:
    return np.asarray(np.einsum("nhw,nhw->n", a, b))


def _rounded(values: Image) -> list[float]:
    return [round(float(v), 4) for v in values]
