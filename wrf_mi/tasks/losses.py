"""Losses of flat Dr.Jit arrays, NaN in the truth where nothing was received."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr

from .ssim import ssim

SSIM_WEIGHT = 0.2
"""Weight of the structural term, eta of the paper."""


def absolute_error(prediction: Any, truth: Any) -> Any:
    """Mean absolute difference over received observations, a Dr.Jit float of one value; 0 without any."""
    return _mean_error(dr.abs, prediction, truth)


def squared_error(prediction: Any, truth: Any) -> Any:
    """Mean squared difference over received observations, a Dr.Jit float of one value; 0 without any."""
    return _mean_error(dr.square, prediction, truth)


def _mean_error(function: Callable[[Any], Any], prediction: Any, truth: Any) -> Any:
    known = dr.isfinite(truth)
    count = dr.sum(dr.select(known, type(truth)(1), 0))
    error = function(prediction - dr.select(known, truth, 0))
    return dr.sum(dr.select(known, error, 0)) / dr.maximum(count, 1)


def spectrum_loss(
    prediction: Any, truth: Any, batch: int, height: int, width: int, eta: float = SSIM_WEIGHT
) -> tuple[Any, Any]:
    """(1 - eta) L1 + eta (1 - SSIM), averaged over a batch of spectra.

    Args:
        prediction: flat Dr.Jit float array of ``batch * height * width`` grey values.
        truth: array of the same shape and type, in 0..1; taken as constant.
        batch: number of spectra.
        height: rows, at least 7.
        width: columns, at least 7.
        eta: weight of the structural term.

    Returns:
        The loss, a Dr.Jit float of one value, and the structural similarity of each spectrum [batch].

    Raises:
        InputError: an image smaller than the window of SSIM, or arrays of another size or type.

    Source: WRF-GS+, the loss of the spectrum synthesis; SSIM of scikit-image.
    """
    similarity = ssim(prediction, truth, batch, height, width)
    difference = dr.mean(dr.abs(prediction - dr.detach(truth)))
    return (1 - eta) * difference + eta * (1 - dr.mean(similarity)), similarity
