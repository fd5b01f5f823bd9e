"""Scores of weighted means of several predictions, for many choices of the weights."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ..core.angles import FloatArray
from ..core.types import IntArray
from .scores import SSIM_C1, SSIM_C2, SSIM_SAMPLE, WINDOW

MixtureScores = Callable[[FloatArray, IntArray], FloatArray]
"""From weights [n, k] of sum 1 and numbers [n] of observations to scores [n] of weighted means of k predictions."""


def mixture_scores(
    predictions: NDArray[Any], truth: NDArray[Any], score: Callable[[NDArray[Any], NDArray[Any]], FloatArray]
) -> MixtureScores:
    """Scores by the weighted means themselves.

    Args:
        predictions: [k, m, ...].
        truth: observations [m, ...].
        score: score of each observation, ``score(mean, truth)`` -> [m].
    """

    def scores(weights: FloatArray, rows: IntArray) -> FloatArray:
        return score(np.einsum("mk,km...->m...", weights, predictions[:, rows]), truth[rows])

    return scores


def ssim_mixtures(predictions: NDArray[Any], truth: NDArray[Any], stride: int = WINDOW) -> MixtureScores:
    """Structural similarity on every ``stride``-th window along rows and columns.

    The similarity of a window depends on the weights by its first and second moments alone, which are computed once.

    Args:
        predictions: grey images [k, m, H, W].
        truth: grey images [m, H, W].
        stride: distance of neighbouring windows, pixels; 1: equal to `wrf_mi.tasks.scores.ssim`.
    """
    # Moments of the truth, the predictions, their products with each other and with the truth, by image and window.
    kinds: list[list[FloatArray]] = [[], [], [], []]
    for row in range(len(truth)):
        images = np.concatenate([truth[row][None], predictions[:, row]]).astype(float)
        parts = sliding_window_view(images, (WINDOW, WINDOW), axis=(1, 2))[:, ::stride, ::stride]
        values = parts.reshape(len(images), -1, WINDOW**2)
        mean = values.mean(axis=2)
        centred = values - mean[:, :, None]
        covariance = np.einsum("iwp,jwp->ijw", centred, centred) * SSIM_SAMPLE / WINDOW**2
        for kept, moment in zip(kinds, (mean[0], mean[1:], covariance[0], covariance[1:, 1:]), strict=True):
            kept.append(moment)
    mean_y, mean_x, with_y, among = (np.stack(kept) for kept in kinds)
    var_y, with_y = with_y[:, 0], with_y[:, 1:]

    def scores(weights: FloatArray, rows: IntArray) -> FloatArray:
        mean, expected = np.einsum("mk,mkw->mw", weights, mean_x[rows]), mean_y[rows]
        across = np.einsum("mk,mkw->mw", weights, with_y[rows])
        variance = np.einsum("mk,mj,mkjw->mw", weights, weights, among[rows], optimize=True)
        similarity = (2 * mean * expected + SSIM_C1) / (mean**2 + expected**2 + SSIM_C1)
        similarity *= (2 * across + SSIM_C2) / (variance + var_y[rows] + SSIM_C2)
        return np.asarray(similarity.mean(axis=1))

    return scores
