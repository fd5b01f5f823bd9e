"""Fit of a CSI physics model: paths, planes and visibility in turn.

Which paths exist is inferred from a channel, the sum of their gains, by a sum over hypotheses: gains differ in
amplitude and phase, so usually only one choice of a few uncertain paths explains the measured channel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cache
from itertools import combinations
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.special import expit

from ...core import InputError
from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Count, Finite, Positive
from ...core.types import IntArray
from .csi_paths import CandidatePaths, Complex, Explained, Model, candidate_paths, refit
from .csi_visibility import MARGINS_M, Learner, Visibility, prior_odds

FLIPS = (24, 24, 14, 9)
"""Hypotheses flip 1, 2, 3 or 4 of so many most uncertain paths of a row against their likelier prior state."""
NUMBERS_PER_CHUNK = 1 << 21
SCALES = np.array([1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0, 3.0])
"""Standard deviations of the noise's components in units of the median path's amplitude."""
FLOOR = 0.03
"""Share of the noise that is spread over all components, so that none vanishes."""
TRUSTED = 0.2
"""The paths explain a row whose noise is of a component below this scale."""
WIDEST_RAD = 0.6
"""Upper limit of phases' standard deviations, from which the fit starts."""
LIKELY = 0.01
"""Least probability of paths that take part in the repair."""
SHARPNESS = (1.0, 2.0, 4.0, 16.0)
"""Candidate factors of the log odds: from the mean over possible paths to the likeliest choice."""


@dataclass(frozen=True)
class CsiSettings(CheckedSettings):
    """Settings of the fit of a CSI physics model.

    Attributes:
        reflections: largest number of reflections of a path.
        rays: rays from each receiver that search for chains of planes.
        reflection: amplitude reflection coefficient of planes a priori; negative: with a phase of pi.
        reflection_sd: standard deviation of its logarithm and of its phase (rad) from plane to plane; 0 fixes it.
        shift_sd_m: standard deviation of a plane's offset from the scan's, and of its edges' by tilting, metres.
        outline_sd_m: standard deviation of an outline, metres.
        ridge: penalty of the learned weights of visibility.
        repair_rounds: rounds of planes and paths.
        visibility_rounds: rounds of visibility, paths and planes.
        folds: folds of the training rows, which predict each row's visibility without its measurement.
        fit_gain: fit a complex factor for each receiver; False: channels are calibrated.
    """

    reflections: int = 2
    rays: Count = 1 << 18
    reflection: Finite = 1.0
    reflection_sd: float = 0.05
    shift_sd_m: Positive = 0.004
    outline_sd_m: Positive = 0.02
    ridge: Positive = 1.0
    repair_rounds: int = 8
    visibility_rounds: int = 6
    folds: Annotated[int, Field(ge=2, description="2 or more")] = 5
    fit_gain: bool = False

    def __post_init__(self) -> None:
        """Refuse settings out of range (`InputError`)."""
        super().__post_init__()
        if self.reflection == 0:
            raise InputError("setting reflection: 0 is out of range, choose another number")


@dataclass(frozen=True)
class Rows:
    """Channels [m, subcarriers] (none where nothing was measured) from positions [m, 3] to receivers [m]."""

    channel: Complex
    position_m: FloatArray
    source: IntArray


def paths_of_rows(model: Model, rows: Rows) -> CandidatePaths:
    """Candidate paths of all rows, each to its receiver; sorted by row."""
    parts = []
    for index in range(len(model.source_m)):
        chains, chosen = np.flatnonzero(model.source == index), np.flatnonzero(rows.source == index)
        every = model.images
        images = replace(every, plane=every.plane[chains], image_m=every.image_m[chains], slope=every.slope[chains])
        paths = candidate_paths(model.walls, images, rows.position_m[chosen])
        parts.append(replace(paths, row=chosen[paths.row], chain=chains[paths.chain]))
    columns = ([getattr(part, field.name) for part in parts] for field in fields(CandidatePaths))
    return CandidatePaths(*(np.concatenate(column) for column in columns))


def mixed(
    model: Model, rows: Rows, paths: CandidatePaths, odds: FloatArray, sharpness: float, covariance: FloatArray
) -> tuple[Complex, FloatArray]:
    """Mean over paths that may exist, and the mean square of its error [m, subcarriers]."""
    position = rows.position_m[paths.row]
    gain = model.path_gain(paths.chain, position)
    p, taken = expit(odds), expit(np.clip(sharpness * odds, -500, 500))
    mean, bias = np.zeros((2, len(rows.position_m), len(model.k)), complex)
    variance = np.zeros(mean.shape)
    np.add.at(mean, paths.row, taken[:, None] * gain)
    np.add.at(bias, paths.row, (p - taken)[:, None] * gain)
    phase = model.phase_sd(paths.chain, position, covariance)
    each = p * (1 - p) + p * np.square(np.minimum(phase, 1))
    np.add.at(variance, paths.row, each[:, None] * np.square(np.abs(gain)))
    return mean, variance + np.square(np.abs(bias))


@cache
def _flips() -> FloatArray:
    """Flips of the most uncertain paths [hypotheses, FLIPS[0]]."""
    chosen = [()] + [flip for count, among in enumerate(FLIPS, start=1) for flip in combinations(range(among), count)]
    return np.stack([np.isin(np.arange(FLIPS[0]), flip) for flip in chosen]).astype(float)


def decode(
    channel: Complex,
    row: IntArray,
    gain: Complex,
    log_odds: FloatArray,
    phase_sd_rad: FloatArray,
    noise: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, FloatArray]:
    """Posterior probabilities of p paths in measured channels [n, subcarriers].

    ``row`` (ascending), ``gain`` [p, subcarriers], prior ``log_odds`` and ``phase_sd_rad`` are those of each path [p];
    ``noise`` holds weights and standard deviations of a mixture of circular Gaussians.

    Returns:
        Probability of each path [p], and of each component of the noise [n, components].
    """
    count, carriers = channel.shape
    flips, (weight, sd) = _flips(), noise
    probability = 1 / (1 + np.exp(-log_odds))
    share = np.zeros((count, len(weight)))
    if not len(row):
        log = np.log(weight) - carriers * np.log(sd * sd) - np.square(np.abs(channel)).sum(axis=1)[:, None] / (sd * sd)
        share = np.exp(log - log.max(axis=1, keepdims=True))
        return probability, share / share.sum(axis=1, keepdims=True)
    first = np.searchsorted(row, np.arange(count + 1))
    likely = log_odds > 0
    blur = np.square(np.abs(gain)).mean(axis=1) * np.square(phase_sd_rad)
    step = max(1, NUMBERS_PER_CHUNK // (len(flips) * max(carriers, len(sd))))
    order = np.lexsort((np.abs(log_odds), row))
    for start in range(0, count, step):
        rows = np.arange(start, min(start + step, count))
        entry = first[rows, None] + np.arange(FLIPS[0])
        known = entry < first[rows + 1, None]
        path = order[np.where(known, entry, 0)]
        chunk = slice(first[rows[0]], first[rows[-1] + 1])
        base, spread = np.zeros((len(rows), carriers), complex), np.zeros(len(rows))
        np.add.at(base, row[chunk][likely[chunk]] - start, gain[chunk][likely[chunk]])
        np.add.at(spread, row[chunk][likely[chunk]] - start, blur[chunk][likely[chunk]])
        sign = known * np.where(likely[path], -1.0, 1.0)
        change, more = sign[..., None] * gain[path], sign * blur[path]
        prior = np.where(known, -np.abs(log_odds[path]), -1e9) @ flips.T
        left = (channel[rows] - base)[:, None] - np.einsum("hm,rmf->rhf", flips, change)
        error = np.square(np.abs(left)).sum(axis=2)
        total = np.maximum(spread[:, None] + more @ flips.T, 0)[..., None] + sd * sd
        joint = prior[..., None] + np.log(weight) - carriers * np.log(total) - error[..., None] / total
        joint = np.exp(joint - joint.max(axis=(1, 2), keepdims=True))
        joint /= joint.sum(axis=(1, 2), keepdims=True)
        hypothesis = joint.sum(axis=2)
        flipped = hypothesis @ flips
        probability[path[known]] = np.where(likely[path], 1 - flipped, flipped)[known]
        share[rows] = joint.sum(axis=1)
    return probability, share


def prior_sd(model: Model, settings: CsiSettings) -> FloatArray:
    """Standard deviations of each plane's parameters [q, NUMBERS]."""
    count = len(model.scan)
    extent = np.maximum((model.scan.high_m - model.scan.low_m) / 2, 0.2)
    shift = np.full(count, settings.shift_sd_m)
    reflection = np.full((2, count), settings.reflection_sd)
    return np.stack([shift, *(settings.shift_sd_m / extent.T), *reflection], axis=1)


class Fit:
    """A fit in progress to measured rows, at least one.

    Attributes:
        model, visibility, covariance: present model, visibility, and covariance of all planes' parameters.
        facts: figures of the fit by name.
    """

    def __init__(self, model: Model, rows: Rows, settings: CsiSettings, seed: int) -> None:
        self.model, self._rows, self._settings, self._seed = model, rows, settings, seed
        unlearned = np.zeros(1 + 2 * len(MARGINS_M)), np.zeros(0, np.int64), np.zeros(0)
        self.visibility = Visibility(np.zeros(len(model.scan.edge_m)), *unlearned, settings.outline_sd_m, seed)
        self.covariance = np.diag(np.square(prior_sd(model, settings)).reshape(-1))
        self.facts = {"rows": float(len(rows.channel))}
        self._paths = paths_of_rows(model, rows)
        self._odds = prior_odds(self._paths, settings.outline_sd_m)
        self._learner: Learner | None = None
        self._precision = np.ones(len(rows.channel))
        gain = np.abs(model.path_gain(self._paths.chain, rows.position_m[self._paths.row]))
        self._noise = np.full(len(SCALES), 1 / len(SCALES)), SCALES * (np.median(gain) if len(gain) else 1.0)
        if settings.fit_gain:
            self._match_gain(self._explained(expit(self._odds)))
            self._noise = self._noise[0], self._noise[1] * np.abs(self.model.gain).mean()

    def repair(self) -> None:
        """Infer which paths exist, and correct the planes."""
        self._paths, self._learner = paths_of_rows(self.model, self._rows), None
        self._odds = prior_odds(self._paths, self._settings.outline_sd_m)
        self._solve()

    def learn(self) -> None:
        """Learn visibility, infer which paths exist, and correct the planes."""
        probability, trust = self._decode()
        if self._learner is None:
            model, s = self.model, self._settings
            how = s.outline_sd_m, s.ridge, self._seed, s.folds
            self._learner = Learner(model.walls, model.images, self._paths, *how)
        self.visibility, self._odds = self._learner.fit(probability, trust[self._paths.row])
        # Planes move by little now: the same paths are kept, so that the odds stay theirs.
        self._solve()

    def finish(self) -> tuple[float, Complex]:
        """The sharpness that predicts held-out rows best, and each row's residual."""
        truth = self._rows.channel
        power = np.maximum(np.square(np.abs(truth)).sum(axis=1), 1e-300)
        error = []
        for sharpness in SHARPNESS:
            mean, _ = mixed(self.model, self._rows, self._paths, self._odds, sharpness, self.covariance)
            error.append(float(np.median(np.square(np.abs(mean - truth)).sum(axis=1) / power)))
        best = int(np.argmin(error))
        probability, trust = self._decode()
        self.facts["explained_rows"] = float(trust.mean())
        self.facts["left_out_cea_db"] = float(-10 * np.log10(max(error[best], 1e-30)))
        return SHARPNESS[best], self._explained(probability).residual(self.model)

    def _explained(self, probability: FloatArray, least: float = -1.0) -> Explained:
        """Rows with the paths more probable than ``least``."""
        kept = probability > least
        row = self._paths.row[kept]
        position = self._rows.position_m[row]
        return Explained(self._rows.channel, row, self._paths.chain[kept], position, probability[kept], self._precision)

    def _decode(self) -> tuple[FloatArray, FloatArray]:
        """Probability of each path, and that the paths explain each row; updates the noise's weights."""
        paths, rows = self._paths, self._rows
        position = rows.position_m[paths.row]
        phase = np.minimum(self.model.phase_sd(paths.chain, position, self.covariance), WIDEST_RAD)
        gain = self.model.path_gain(paths.chain, position)
        probability, share = decode(rows.channel, paths.row, gain, self._odds, phase, self._noise)
        self._noise = (1 - FLOOR) * share.mean(axis=0) + FLOOR / len(SCALES), self._noise[1]
        unsure = np.square(np.abs(gain)).mean(axis=1) * probability * (1 - probability)
        unsure = np.bincount(paths.row, unsure, len(rows.channel))
        self._precision = (share / (self._noise[1] ** 2 + unsure[:, None])).sum(axis=1)
        return probability, share[:, SCALES < TRUSTED].sum(axis=1)

    def _solve(self) -> None:
        """Correct gains and planes."""
        explained = self._explained(self._decode()[0], LIKELY)
        if self._settings.fit_gain:
            self._match_gain(explained)
        if len(self.model.scan):
            self.model, self.covariance = refit(self.model, explained, prior_sd(self.model, self._settings))

    def _match_gain(self, explained: Explained) -> None:
        """Set each receiver's complex factor by least squares."""
        channel = self._rows.channel
        predicted = channel - explained.residual(self.model)
        gain = self.model.gain.copy()
        for index in range(len(gain)):
            rows = self._rows.source == index
            weight = explained.precision[rows, None]
            power = (weight * np.square(np.abs(predicted[rows]))).sum()
            if power > 0:
                gain[index] *= (weight * predicted[rows].conj() * channel[rows]).sum() / power
        self.model = replace(self.model, gain=gain)
