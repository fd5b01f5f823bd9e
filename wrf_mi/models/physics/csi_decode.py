"""Which paths are there, told from measured channels: a sum over hypotheses.

A channel is the sum of the gains of the paths that are there. Gains differ in amplitude and phase, so of a few
uncertain paths usually one choice alone explains what was measured.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray

FLIPS = (24, 24, 14, 9)
"""Hypotheses: of the so many most uncertain paths of a row, 1, 2, 3, 4 are otherwise than is likeliest beforehand."""
NUMBERS_PER_CHUNK = 1 << 21

Complex = NDArray[np.complex128]


def _flips() -> FloatArray:
    """Which of the most uncertain paths a hypothesis flips [hypotheses, FLIPS[0]]."""
    rows = [np.zeros(FLIPS[0])]
    for count, among in enumerate(FLIPS, start=1):
        for chosen in combinations(range(among), count):
            rows.append(np.zeros(FLIPS[0]))
            rows[-1][list(chosen)] = 1
    return np.stack(rows)


def decode(
    channel: Complex,
    row: IntArray,
    gain: Complex,
    log_odds: FloatArray,
    phase_sd_rad: FloatArray,
    noise: tuple[FloatArray, FloatArray],
) -> tuple[FloatArray, Complex, FloatArray]:
    """Posterior probabilities of paths.

    Args:
        channel: measured [n, subcarriers].
        row: of each path, ascending [p].
        gain: of each path with its phase [p, subcarriers].
        log_odds: of its being there, beforehand [p].
        phase_sd_rad: standard deviation of its phase [p].
        noise: weights and standard deviations of the parts of a mixture of circular Gaussians: what paths leave.

    Returns:
        Probability of each path [p]; the residual of the likeliest hypothesis [n, subcarriers]; the probability of each
        part of the noise [n, parts].
    """
    count, carriers = channel.shape
    flips, (weight, sd) = _flips(), noise
    probability = 1 / (1 + np.exp(-log_odds))
    residual, share = channel.astype(complex), np.zeros((count, len(weight)))
    first = np.searchsorted(row, np.arange(count + 1))
    there = log_odds > 0
    blur = np.square(np.abs(gain)).mean(axis=1) * np.square(phase_sd_rad)
    step = max(1, NUMBERS_PER_CHUNK // (len(flips) * max(carriers, len(sd))))
    order = np.lexsort((np.abs(log_odds), row))
    for start in range(0, count, step):
        rows = np.arange(start, min(start + step, count))
        place = first[rows, None] + np.arange(FLIPS[0])
        known = place < first[rows + 1, None]
        own = order[np.where(known, place, 0)] if len(order) else np.zeros(place.shape, np.int64)
        part = slice(first[rows[0]], first[rows[-1] + 1])
        base, spread = np.zeros((len(rows), carriers), complex), np.zeros(len(rows))
        np.add.at(base, row[part][there[part]] - start, gain[part][there[part]])
        np.add.at(spread, row[part][there[part]] - start, blur[part][there[part]])
        if len(order):
            sign = known * np.where(there[own], -1.0, 1.0)
            change, more = sign[..., None] * gain[own], sign * blur[own]
            prior = np.where(known, -np.abs(log_odds[own]), -1e9) @ flips.T
        else:
            change, more, prior = np.zeros((*own.shape, carriers)), np.zeros(own.shape), -1e9 * flips.sum(axis=1)[None]
        left = (channel[rows] - base)[:, None] - np.einsum("hm,rmf->rhf", flips, change)
        error = np.square(np.abs(left)).sum(axis=2)
        total = np.maximum(spread[:, None] + more @ flips.T, 0)[..., None] + sd * sd
        joint = prior[..., None] + np.log(weight) - carriers * np.log(total) - error[..., None] / total
        joint = np.exp(joint - joint.max(axis=(1, 2), keepdims=True))
        joint /= joint.sum(axis=(1, 2), keepdims=True)
        hypothesis = joint.sum(axis=2)
        flipped = hypothesis @ flips
        probability[own[known]] = np.where(there[own], 1 - flipped, flipped)[known]
        residual[rows] = left[np.arange(len(rows)), hypothesis.argmax(axis=1)]
        share[rows] = joint.sum(axis=1)
    return probability, residual, share
