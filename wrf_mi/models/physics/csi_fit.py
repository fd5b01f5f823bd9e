"""The fit of a CSI physics model: paths, planes and visibility in turn."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from ...core import InputError
from ...core.angles import FloatArray
from ...core.types import IntArray
from .csi_decode import decode
from .csi_paths import Seen, seen_from
from .csi_repair import Explained, Model, refit
from .csi_visibility import Learner, Visibility, prior_odds

Complex = NDArray[np.complex128]

SCALES = np.array([1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0])
"""Standard deviations of the noise's parts, of the median path's amplitude."""
FLOOR = 0.03
"""Share of the noise that is spread over all parts, so that none dies out."""
TRUSTED = 0.2
"""Parts of the noise up to this one mean that the paths explain the row."""
WIDEST_RAD = 0.6
"""A phase less certain than that is as good as unknown; the fit has to begin somewhere."""
LIKELY = 0.01
"""Paths less likely than that do not take part in the repair."""
SHARPNESS = (1.0, 2.0, 4.0, 16.0)
"""Factors of the log odds: from the mean over what may be there to what is likeliest."""


@dataclass(frozen=True)
class CsiSettings:
    """How a CSI physics model is fitted.

    Attributes:
        reflections: of a path at most.
        rays: that search for chains of planes from each receiver.
        reflection: what a plane reflects of the amplitude before anything is measured; negative turns the phase round.
        reflection_sd: standard deviation of its logarithm, and of its phase in rad, from plane to plane; 0 holds it.
        shift_sd_m: standard deviation of a plane's offset from the scan's, metres, and of its edges' by tilting.
        outline_sd_m: standard deviation of an outline, metres.
        ridge: penalty of what is learned about visibility.
        repair_rounds: of planes and paths in turn.
        visibility_rounds: of visibility, paths and planes in turn.
        folds: of the training rows, by which visibility is predicted without a row's own measurement.
        fit_gain: fit one complex factor for each receiver; False: channels are calibrated.
    """

    reflections: int = 2
    rays: int = 1 << 18
    reflection: float = 1.0
    reflection_sd: float = 0.05
    shift_sd_m: float = 0.004
    outline_sd_m: float = 0.02
    ridge: float = 1.0
    repair_rounds: int = 8
    visibility_rounds: int = 6
    folds: int = 5
    fit_gain: bool = False

    def __post_init__(self) -> None:
        """Reject what cannot be fitted.

        Raises:
            InputError: naming the setting.
        """
        whole = {"reflections": 0, "rays": 1, "repair_rounds": 0, "visibility_rounds": 0, "folds": 2}
        for name, least in whole.items():
            if getattr(self, name) < least:
                raise InputError(f"{name} {getattr(self, name)}: give {least} or more")
        for name in ("shift_sd_m", "outline_sd_m", "ridge"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} {getattr(self, name)}: give a positive number")
        if self.reflection == 0 or self.reflection_sd < 0:
            text = f"reflection {self.reflection}, reflection_sd {self.reflection_sd}"
            raise InputError(f"{text}: give a reflection other than 0 and a standard deviation of 0 or more")


@dataclass(frozen=True)
class Rows:
    """Measurements, or places to predict for, of all receivers, one after the other; m in all.

    Attributes:
        channel: [m, subcarriers]; no subcarriers where nothing was measured.
        position_m: of the moving end [m, 3].
        source: number of the receiver [m].
    """

    channel: Complex
    position_m: FloatArray
    source: IntArray


def seen_by_rows(model: Model, rows: Rows) -> Seen:
    """Paths of all rows, each to its own receiver; sorted by row."""
    parts = []
    for index in range(len(model.source_m)):
        chains, own = np.flatnonzero(model.source == index), np.flatnonzero(rows.source == index)
        if not len(own):
            continue
        every = model.images
        images = replace(every, plane=every.plane[chains], image_m=every.image_m[chains], slope=every.slope[chains])
        seen = seen_from(model.walls, images, rows.position_m[own])
        parts.append(replace(seen, row=own[seen.row], chain=chains[seen.chain]))
    if len(parts) == 1:
        return parts[0]
    return Seen(*(np.concatenate([getattr(part, name) for part in parts]) for name in Seen.__dataclass_fields__))


def mixed(
    model: Model, rows: Rows, seen: Seen, odds: FloatArray, sharpness: float, covariance: FloatArray
) -> tuple[Complex, FloatArray]:
    """Mean over paths that may be there, and the mean square of its error [m, subcarriers]."""
    count, carriers = len(rows.position_m), len(model.k)
    position = rows.position_m[seen.row]
    gain = model.path_gain(seen.chain, position)
    p, taken = expit(odds), expit(np.clip(sharpness * odds, -500, 500))
    mean, bias = np.zeros((2, count, carriers), complex)
    variance = np.zeros((count, carriers))
    np.add.at(mean, seen.row, taken[:, None] * gain)
    np.add.at(bias, seen.row, (p - taken)[:, None] * gain)
    phase = model.phase_sd(seen.chain, position, covariance)
    each = p * (1 - p) + p * np.square(np.minimum(phase, 1))
    np.add.at(variance, seen.row, each[:, None] * np.square(np.abs(gain)))
    return mean, variance + np.square(np.abs(bias))


def prior_sd(model: Model, settings: CsiSettings) -> FloatArray:
    """Standard deviations of each plane's parameters [q, NUMBERS]."""
    count = len(model.scan)
    extent = np.maximum((model.scan.high_m - model.scan.low_m) / 2, 0.2)
    shift = np.full(count, settings.shift_sd_m)
    reflection = np.full((2, count), settings.reflection_sd)
    return np.stack([shift, *(settings.shift_sd_m / extent.T), *reflection], axis=1)


class Fit:
    """A fit in progress.

    Args:
        model: to begin with.
        rows: what was measured; one at least.
        settings: see `CsiSettings`.
        seed: of folds and cells.

    Attributes:
        model: as it is now.
        visibility: the same.
        covariance: of all planes' parameters.
        facts: what there is to say about it, in numbers.
    """

    def __init__(self, model: Model, rows: Rows, settings: CsiSettings, seed: int) -> None:
        self.model, self._rows, self._settings, self._seed = model, rows, settings, seed
        self.visibility = Visibility.of_scene(len(model.scan.edge_m), settings.outline_sd_m, seed)
        self.covariance = np.diag(np.square(prior_sd(model, settings)).reshape(-1))
        self.facts: dict[str, float] = {}
        self._seen = seen_by_rows(model, rows)
        self._odds = prior_odds(self._seen, settings.outline_sd_m)
        self._learner: Learner | None = None
        self._precision = np.ones(len(rows.channel))
        gain = np.abs(model.path_gain(self._seen.chain, rows.position_m[self._seen.row]))
        self._noise = np.full(len(SCALES), 1 / len(SCALES)), SCALES * (np.median(gain) if len(gain) else 1.0)
        if settings.fit_gain:
            self._match(self._explained(expit(self._odds), np.ones(len(rows.channel)), np.ones(len(self._seen), bool)))
            self._noise = self._noise[0], self._noise[1] * np.abs(self.model.gain).mean()

    def repair(self) -> None:
        """Tell which paths are there, and set the planes right."""
        self._seen, self._learner = seen_by_rows(self.model, self._rows), None
        self._odds = prior_odds(self._seen, self._settings.outline_sd_m)
        self._solve()

    def learn(self) -> None:
        """Learn what is seen, tell which paths are there, set the planes right."""
        there, trust = self._decode()
        if self._learner is None:
            self._learner = Learner(
                self.model.walls,
                self.model.images,
                self._seen,
                outline_sd_m=self._settings.outline_sd_m,
                ridge=self._settings.ridge,
                seed=self._seed,
                folds=self._settings.folds,
            )
        self.visibility, self._odds = self._learner.fit(there, trust[self._seen.row])
        # Planes move by little now: the same paths are kept, so that the odds go with them.
        self._solve()

    def finish(self) -> tuple[float, Complex]:
        """The sharpness that predicts rows left out best, and what the paths leave of each row."""
        rows, truth = self._rows, self._rows.channel
        power = np.maximum(np.square(np.abs(truth)).sum(axis=1), 1e-300)
        error = []
        for sharpness in SHARPNESS:
            mean, _ = mixed(self.model, rows, self._seen, self._odds, sharpness, self.covariance)
            error.append(float(np.median(np.square(np.abs(mean - truth)).sum(axis=1) / power)))
        best = int(np.argmin(error))
        there, trust = self._decode()
        everyone = np.ones(len(self._seen), bool)
        left = self._explained(there, np.ones(len(truth)), everyone).residual(self.model)
        self.facts["explained_rows"] = float(trust.mean())
        self.facts["left_out_cea_db"] = float(-10 * np.log10(max(error[best], 1e-30)))
        return SHARPNESS[best], left

    def _explained(self, there: FloatArray, precision: FloatArray, keep: NDArray[np.bool_]) -> Explained:
        row = self._seen.row[keep]
        position = self._rows.position_m[row]
        return Explained(self._rows.channel, row, self._seen.chain[keep], position, there[keep], precision)

    def _decode(self) -> tuple[FloatArray, FloatArray]:
        """Probability of each path, and whether each row is explained; the noise's shares follow."""
        seen, rows = self._seen, self._rows
        position = rows.position_m[seen.row]
        phase = np.minimum(self.model.phase_sd(seen.chain, position, self.covariance), WIDEST_RAD)
        gain = self.model.path_gain(seen.chain, position)
        there, _, share = decode(rows.channel, seen.row, gain, self._odds, phase, self._noise)
        self._noise = (1 - FLOOR) * share.mean(axis=0) + FLOOR / len(SCALES), self._noise[1]
        unsure = np.bincount(seen.row, np.square(np.abs(gain)).mean(axis=1) * there * (1 - there), len(rows.channel))
        self._precision = (share / (self._noise[1] ** 2 + unsure[:, None])).sum(axis=1)
        return there, share[:, SCALES < TRUSTED].sum(axis=1)

    def _solve(self) -> None:
        there, _ = self._decode()
        explained = self._explained(there, self._precision, there > LIKELY)
        if self._settings.fit_gain:
            self._match(explained)
        if len(self.model.scan):
            self.model, self.covariance = refit(self.model, explained, prior_sd(self.model, self._settings))

    def _match(self, explained: Explained) -> None:
        """Set each receiver's complex factor by least squares."""
        rows = self._rows
        predicted = rows.channel - explained.residual(self.model)
        gain = self.model.gain.copy()
        for index in range(len(gain)):
            own = rows.source == index
            weight = explained.precision[own, None]
            power = (weight * np.square(np.abs(predicted[own]))).sum()
            if power > 0:
                gain[index] *= (weight * predicted[own].conj() * rows.channel[own]).sum() / power
        self.model = replace(self.model, gain=gain)
