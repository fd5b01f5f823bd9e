"""The one place where each metric is computed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from skimage.metrics import structural_similarity

from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray


def ssim(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Structural similarity of each predicted spectrum.

    Args:
        prediction: grey values, shape [..., H, W], H and W at least 7.
        truth: the same shape, in 0..1.

    Returns:
        Shape [...].

    Raises:
        InputError: shapes that differ, or an image smaller than the window.

    Source: scikit-image ``structural_similarity(truth, prediction, data_range=1)``, as the WRF-GS+ authors score.
    """
    predicted, expected = np.asarray(prediction, float), np.asarray(truth, float)
    if predicted.shape != expected.shape:
        raise InputError(f"prediction {predicted.shape} and truth {expected.shape} differ in shape")
    height, width = expected.shape[-2:]
    if min(height, width) < 7:
        raise InputError(f"image of {height} x {width} pixels: SSIM needs at least 7 x 7")
    pairs = zip(expected.reshape(-1, height, width), predicted.reshape(-1, height, width), strict=True)
    return np.array([structural_similarity(t, p, data_range=1.0) for t, p in pairs]).reshape(expected.shape[:-2])


def summary(values: ArrayLike) -> dict[str, float]:
    """Median, mean, 10th and 90th percentile of all values.

    Raises:
        InputError: no values.
    """
    v = np.asarray(values, float).ravel()
    if not len(v):
        raise InputError("no test rows to score: the split has none")
    p10, median, p90 = np.percentile(v, [10, 50, 90])
    return {"median": float(median), "mean": float(v.mean()), "p10": float(p10), "p90": float(p90)}
