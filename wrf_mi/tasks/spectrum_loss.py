"""The loss of the WRF-GS papers on spatial spectra."""

from __future__ import annotations

from typing import Any

import drjit as dr

from .ssim import ssim

SSIM_WEIGHT = 0.2
"""Share of the structural term, eta of the paper."""


def spectrum_loss(
    prediction: Any, truth: Any, batch: int, height: int, width: int, eta: float = SSIM_WEIGHT
) -> tuple[Any, Any]:
    """(1 - eta) L1 + eta (1 - SSIM), averaged over a batch of spectra.

    Args:
        prediction: flat Dr.Jit float array of ``batch * height * width`` grey values.
        truth: the same shape and type, in 0..1; taken as constant.
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
