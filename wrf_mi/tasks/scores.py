"""Scores, the only implementation of each metric, and levels of observations in decibels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy.special import digamma, ndtr, polygamma
from skimage.metrics import structural_similarity

from ..core import InputError, Prediction
from ..core.angles import FloatArray
from ..core.task import MixtureScores
from ..core.types import IntArray

EXACT = np.finfo(float).eps ** 2  # Smallest relative squared error that float64 resolves
WINDOW = 7  # Side of the window of structural similarity in pixels, scikit-image's default
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2  # Stabilising constants of Wang et al. (2004) for a data range of one
SSIM_SAMPLE = WINDOW**2 / (WINDOW**2 - 1)  # Sample variance of a window over its variance
RESAMPLES = 2000
"""Number of bootstrap resamples: ends of a 95 % interval are then exact to a few hundredths of its width."""
BINS = 10  # Bins of predicted probabilities
LEVEL = 0.9  # Probability of prediction intervals and regions
REAL_90, COMPLEX_90 = 1.6449, 1.5174
"""Standard deviations within which a share `LEVEL` of a normal and of a circular complex normal variable lie."""


def ssim(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Structural similarity [...] of predicted spectra [..., H, W] to true ones in 0..1; H and W are 7 at least.

    Raises:
        InputError: shapes that differ, a prediction that is not finite, or an image smaller than the window.

    Source: scikit-image ``structural_similarity(truth, prediction, data_range=1)``, as the WRF-GS+ authors score.
    """
    predicted, expected = np.asarray(prediction, float), np.asarray(truth, float)
    _check(predicted, expected)
    height, width = expected.shape[-2:]
    if min(height, width) < WINDOW:
        raise InputError(f"image of {height} x {width} pixels: SSIM needs at least {WINDOW} x {WINDOW}")
    pairs = zip(expected.reshape(-1, height, width), predicted.reshape(-1, height, width), strict=True)
    return np.array([structural_similarity(t, p, data_range=1.0) for t, p in pairs]).reshape(expected.shape[:-2])


def abs_error_db(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Absolute error of powers in dBm, dB, any shape; NaN where the truth is, as nothing was received.

    Raises:
        InputError: shapes that differ, or no finite prediction where something was received.
    """
    predicted, expected = np.asarray(prediction, float), np.asarray(truth, float)
    _check(predicted, expected)
    result: FloatArray = np.abs(predicted - expected)
    return result


def signed_errors_db(prediction: ArrayLike, truth: ArrayLike) -> dict[str, float]:
    """Bias, standard deviation and root mean square of the errors ``prediction - truth`` of powers in dBm, dB.

    Values have any shape; those that are NaN in the truth are left out. The standard deviation is about the bias, with
    the number of values as its divisor, so that rmse^2 = bias^2 + std^2.

    Returns:
        ``bias`` (mean signed error), ``std`` and ``rmse``.

    >>> signed_errors_db([-60.0, -70.0, -80.0], [-64.0, -70.0, np.nan])
    {'bias': 2.0, 'std': 2.0, 'rmse': 2.8284271247461903}
    """
    error = np.asarray(prediction, float) - np.asarray(truth, float)
    error = error[np.isfinite(error)]
    return {"bias": float(error.mean()), "std": float(error.std()), "rmse": float(np.sqrt(np.square(error).mean()))}


def cea_db(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Channel estimation accuracy in dB, -10 log10(sum |prediction - truth|^2 / sum |truth|^2) over subcarriers.

    Of complex coefficients [..., subcarriers] the accuracies [...], NaN where the truth is zero.

    Raises:
        InputError: shapes that differ, or a prediction that is not finite.

    Source: the signal-to-noise ratio of NeRF2's and WRF-GS's channel prediction.
    """
    predicted, expected = np.asarray(prediction, complex), np.asarray(truth, complex)
    _check(predicted, expected)
    error = np.square(np.abs(predicted - expected)).sum(axis=-1)
    power = np.square(np.abs(expected)).sum(axis=-1)
    # The accuracy of an exact prediction is that of float64.
    ratio = np.maximum(np.divide(error, power, out=np.full(power.shape, np.nan), where=power > 0), EXACT)
    result: FloatArray = -10 * np.log10(ratio)
    return result


def inside_interval(prediction: ArrayLike, std: ArrayLike, truth: ArrayLike) -> float:
    """Share of the known values inside the predicted 90 % intervals.

    Values have any shape and are real or complex, NaN in the truth where nothing was received; errors are taken to be
    normal with the standard deviation ``std``, complex ones circular.
    """
    error = np.abs(np.asarray(prediction) - np.asarray(truth))
    bound = COMPLEX_90 if np.iscomplexobj(truth) else REAL_90
    finite = np.isfinite(error)
    return float((error <= bound * np.asarray(std, float))[finite].mean())


def crps(prediction: ArrayLike, std: ArrayLike, truth: ArrayLike) -> float:
    """Mean continuous ranked probability score of the known values, in their unit; the lower the better.

    Args:
        prediction: mean of a normal distribution, any shape; of a circular one, whose real and imaginary parts are
            scored in turn, where it is complex.
        std: its standard deviation, the same shape; for complex values sqrt(E |h - mean|^2).
        truth: the same shape; NaN where nothing was received.

    Source: Gneiting and Raftery, "Strictly proper scoring rules, prediction, and estimation" (2007), equation 21.
    """
    mean, expected, spread = np.asarray(prediction), np.asarray(truth), np.asarray(std, float)
    if np.iscomplexobj(expected):
        parts = (crps(part(mean), spread / np.sqrt(2), part(expected)) for part in (np.real, np.imag))
        return sum(parts) / 2
    finite = np.isfinite(expected)
    error, spread = (expected - mean)[finite].astype(float), spread[finite]
    z = error / spread
    density = np.exp(-np.square(z) / 2) / np.sqrt(2 * np.pi)
    return float((spread * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))).mean())


def calibration_bins(probability: FloatArray, happened: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray, IntArray]:
    """Mean predicted probability, observed share and number of events [n] in bins of the probability.

    Means of empty bins are NaN.
    """
    place = np.minimum((probability * BINS).astype(int), BINS - 1)
    count = np.bincount(place, minlength=BINS)
    with np.errstate(invalid="ignore"):
        predicted, observed = (np.bincount(place, values, BINS) / count for values in (probability, happened))
    return predicted, observed, count


def probability_scores(probability: FloatArray, happened: NDArray[np.bool_]) -> dict[str, float]:
    """Scores of predicted probabilities of events [n], the lower the better.

    ``log_loss`` in nats and ``brier`` are proper scores (Gneiting and Raftery, "Strictly proper scoring rules,
    prediction, and estimation" (2007), JASA 102); ``calibration_error`` is the mean distance of the observed shares
    from the predicted probabilities in `calibration_bins`, which a constant may have small.

    >>> scores = probability_scores(np.array([0.25, 0.25, 0.25, 0.25]), np.array([True, False, False, False]))
    >>> {name: round(value, 4) for name, value in scores.items()}
    {'log_loss': 0.5623, 'brier': 0.1875, 'calibration_error': 0.0}
    """
    predicted, observed, count = calibration_bins(probability, happened)
    with np.errstate(divide="ignore"):  # infinite where something certain does not happen
        log_loss = -np.log(np.where(happened, probability, 1 - probability)).mean()
    error = np.nansum(np.abs(observed - predicted) * count) / count.sum()
    return {
        "log_loss": float(log_loss),
        "brier": float(np.square(probability - happened).mean()),
        "calibration_error": float(error),
    }


def _check(prediction: NDArray[Any], truth: NDArray[Any]) -> None:
    if prediction.shape != truth.shape:
        raise InputError(f"prediction {prediction.shape} and truth {truth.shape} differ in shape")
    # A model may not skip rows.
    wrong = int(np.count_nonzero(~np.isfinite(prediction) & ~np.isnan(truth)))
    if wrong:
        raise InputError(f"prediction: {wrong} of {truth.size} values are not finite where the truth is known")


def ssim_mixtures(predictions: NDArray[Any], truth: NDArray[Any], stride: int = WINDOW) -> MixtureScores:
    """Structural similarity of means of grey images [k, m, H, W] to true ones [m, H, W] on some windows.

    The similarity of a window depends on the weights by its first and second moments alone, which are computed once.
    Windows are ``stride`` pixels apart along rows and columns; 1: equal to `ssim`.
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
        for moments, moment in zip(kinds, (mean[0], mean[1:], covariance[0], covariance[1:, 1:]), strict=True):
            moments.append(moment)
    mean_y, mean_x, with_y, among = map(np.stack, kinds)
    var_y, with_y = with_y[:, 0], with_y[:, 1:]

    def scores(weights: FloatArray, rows: IntArray) -> FloatArray:
        mean, expected = np.einsum("mk,mkw->mw", weights, mean_x[rows]), mean_y[rows]
        across = np.einsum("mk,mkw->mw", weights, with_y[rows])
        variance = np.einsum("mk,mj,mkjw->mw", weights, weights, among[rows], optimize=True)
        similarity = (2 * mean * expected + SSIM_C1) / (mean**2 + expected**2 + SSIM_C1)
        similarity *= (2 * across + SSIM_C2) / (variance + var_y[rows] + SSIM_C2)
        return np.asarray(similarity.mean(axis=1))

    return scores


def summary(values: ArrayLike) -> dict[str, float]:
    """Median, mean, 10th and 90th percentile of all values that are not NaN (InputError: no values)."""
    v = np.asarray(values, float).ravel()
    v = v[~np.isnan(v)]
    if not len(v):
        raise InputError("no test rows to score: the split has none")
    p10, median, p90 = np.percentile(v, [10, 50, 90])
    return {"median": float(median), "mean": float(v.mean()), "p10": float(p10), "p90": float(p90)}


@dataclass(frozen=True)
class Interval:
    """A statistic with the limits of its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


def bootstrap(*samples: ArrayLike, statistic: Callable[..., Any] = np.median, seed: int = 0) -> Interval:
    """Statistic of independent samples with its 95 % percentile interval.

    Args:
        samples: sets of samples [n] each, which are resampled independently; one sample at least in each.
        statistic: function of an array for each set and ``axis``.
        seed: seed of the resamples.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), section 13.3; `scipy.stats.bootstrap`.
    """
    from scipy.stats import bootstrap as resampled  # a quarter of the time that a short fit takes to begin

    sets = [np.asarray(values, float) for values in samples]
    if wrong := [values.shape for values in sets if values.ndim != 1 or not len(values)]:
        raise ValueError(f"bootstrap: samples of shape {wrong[0]}; give [n], one at least")
    # SciPy asks for two samples; a single one twice has the same quantiles.
    sets = [np.resize(values, max(2, len(values))) for values in sets]
    draws: dict[str, Any] = {"n_resamples": RESAMPLES, "confidence_level": 0.95, "rng": seed}
    low, high = resampled(sets, statistic, method="percentile", vectorized=True, **draws).confidence_interval
    return Interval(float(statistic(*sets, axis=-1)), float(low), float(high))


def block_bootstrap(values: ArrayLike, block: ArrayLike, seed: int = 0) -> Interval:
    """Mean of values [n] with its 95 % percentile interval from resamples of whole blocks.

    Values of a block may depend on each other; a resample has as many blocks as there are, and its mean is over all
    their values.

    Args:
        values: finite values [n], one at least.
        block: number of the block of each value [n].
        seed: seed of the resamples.

    Source: bootstrap of clusters, Davison and Hinkley, "Bootstrap Methods and their Application" (1997), section 3.8;
    with blocks of positions, Lahiri, "Resampling Methods for Dependent Data" (2003), chapter 12.
    """
    values, (_, which) = np.asarray(values, float), np.unique(block, return_inverse=True)
    total, count = np.bincount(which, values), np.bincount(which)
    drawn = np.random.default_rng(seed).integers(len(count), size=(RESAMPLES, len(count)))
    low, high = np.percentile(total[drawn].sum(axis=1) / count[drawn].sum(axis=1), [2.5, 97.5])
    return Interval(float(values.mean()), float(low), float(high))


DB = 10 / np.log(10)  # Decibels of a factor e
CERTAIN = 1e8  # Largest parameter of the distribution: a standard deviation of 4e-4 dB, below any that is stated


def decibels(power: NDArray[Any]) -> FloatArray:
    """10 log10 of powers, any shape; NaN where nothing arrives.

    >>> decibels(np.array([100.0, 0.0]))
    array([20., nan])
    """
    return np.asarray(10 * np.log10(np.where(power > 0, power, np.nan)), float)


def level_of_amplitudes(prediction: Prediction, weight: FloatArray) -> Prediction:
    """Level of the weighted mean of the powers of amplitudes.

    The power of a quantity of mean m and standard deviation s is |m|^2 + s^2 on average. Predicted powers are taken to
    be gamma distributed, which is Nakagami's distribution of amplitudes with parameter E(P)^2 / var(P): exact for a
    complex normal quantity of mean zero (Rayleigh fading), within 0.6 dB of Rice's for any other. Expectation and
    standard deviation of 10 log10 P are then digamma and trigamma functions. Errors of one observation's amplitudes are
    taken to be in common, which bounds the standard deviation of a mean from above.

    Args:
        prediction: complex coefficients or magnitudes [m, ...], with standard deviations or without.
        weight: weight of each amplitude, of sum 1, in the shape of an observation.

    Returns:
        Expectation of 10 log10 of the power [m] and, if stated, its standard deviation, dB; NaN where nothing arrives.

    Source: Nakagami, "The m-distribution, a general formula of intensity distribution of rapid fading" (1960).
    """
    count, weights = len(prediction.mean), weight.ravel()
    signal = np.square(np.abs(prediction.mean)).reshape(count, -1)
    if prediction.std is None:
        return Prediction(decibels(signal @ weights))
    noise = np.square(prediction.std).reshape(count, -1)
    # Of a complex normal quantity var |h|^2 = s^4 + 2 |m|^2 s^2, of a real one twice that.
    factor = 1 if np.iscomplexobj(prediction.mean) else 2
    mean = (signal + noise) @ weights
    std = np.sqrt(factor * noise * (noise + 2 * signal)) @ weights
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = np.minimum(np.square(mean / std), CERTAIN)
    return Prediction(decibels(mean) + DB * (digamma(shape) - np.log(shape)), DB * np.sqrt(polygamma(1, shape)))
