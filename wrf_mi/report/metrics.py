"""The one place where each metric is computed, and what is scored by which."""

from __future__ import annotations

from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from skimage.metrics import structural_similarity

from wrf_mi.baselines.idw import REFERENCE
from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray

UPLINK = "uplink"
"""Key of the reference that copies the uplink."""
EXACT = np.finfo(float).eps ** 2
"""Smallest relative squared error that float64 can show."""
REAL_90, COMPLEX_90 = 1.6449, 1.5174
"""Standard deviations within which 90 % of a normal and of a circular complex normal variable lie."""


def ssim(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Structural similarity of each predicted spectrum.

    Args:
        prediction: grey values, shape [..., H, W], H and W at least 7.
        truth: the same shape, in 0..1.

    Returns:
        Shape [...].

    Raises:
        InputError: shapes that differ, a prediction that is not finite, or an image smaller than the window.

    Source: scikit-image ``structural_similarity(truth, prediction, data_range=1)``, as the WRF-GS+ authors score.
    """
    predicted, expected = np.asarray(prediction, float), np.asarray(truth, float)
    _check(predicted, expected)
    height, width = expected.shape[-2:]
    if min(height, width) < 7:
        raise InputError(f"image of {height} x {width} pixels: SSIM needs at least 7 x 7")
    pairs = zip(expected.reshape(-1, height, width), predicted.reshape(-1, height, width), strict=True)
    return np.array([structural_similarity(t, p, data_range=1.0) for t, p in pairs]).reshape(expected.shape[:-2])


def abs_error_db(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Absolute error of received powers in dB, NaN where nothing was received.

    Args:
        prediction: power in dBm, any shape.
        truth: the same shape; NaN where nothing was received.

    Raises:
        InputError: shapes that differ, or no finite prediction where something was received.
    """
    predicted, expected = np.asarray(prediction, float), np.asarray(truth, float)
    _check(predicted, expected)
    return np.abs(predicted - expected)


def cea_db(prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
    """Channel estimation accuracy in dB, -10 log10(sum |prediction - truth|^2 / sum |truth|^2) over subcarriers.

    Args:
        prediction: complex coefficients, shape [..., subcarriers].
        truth: the same shape; against noise-free values where it is synthetic.

    Returns:
        Shape [...]; NaN where the truth is zero.

    Raises:
        InputError: shapes that differ, or a prediction that is not finite.

    Source: the signal-to-noise ratio of NeRF2's and WRF-GS's channel prediction.
    """
    predicted, expected = np.asarray(prediction, complex), np.asarray(truth, complex)
    _check(predicted, expected)
    error = np.square(np.abs(predicted - expected)).sum(axis=-1)
    power = np.square(np.abs(expected)).sum(axis=-1)
    # A prediction without any error would be infinitely accurate; float64 cannot tell more than this.
    ratio = np.maximum(np.divide(error, power, out=np.full(power.shape, np.nan), where=power > 0), EXACT)
    return -10 * np.log10(ratio)


def inside_interval(prediction: ArrayLike, std: ArrayLike, truth: ArrayLike) -> float:
    """Share of the known values inside the predicted 90 % intervals.

    Args:
        prediction: any shape, real or complex.
        std: predicted standard deviation, the same shape; errors are taken to be normal (complex: circular).
        truth: the same shape; NaN where nothing was received.
    """
    error = np.abs(np.asarray(prediction) - np.asarray(truth))
    bound = COMPLEX_90 if np.iscomplexobj(truth) else REAL_90
    known = np.isfinite(error)
    return float((error <= bound * np.asarray(std, float))[known].mean())


def _check(prediction: NDArray[Any], truth: NDArray[Any]) -> None:
    if prediction.shape != truth.shape:
        raise InputError(f"prediction {prediction.shape} and truth {truth.shape} differ in shape")
    # Without this a method that fails where it is hard would be scored on the rest.
    wrong = int(np.count_nonzero(~np.isfinite(prediction) & ~np.isnan(truth)))
    if wrong:
        raise InputError(f"prediction: {wrong} of {truth.size} values are not finite where the truth is known")


@dataclass(frozen=True)
class TaskScore:
    """How one task is scored and shown.

    Attributes:
        score: ``score(prediction, truth)``, one value for each observation of ``axes`` axes.
        block: key in ``metrics.json``.
        label: of the score, for tables and axes.
        higher_is_better: whether it is an accuracy or an error.
        neighbours: training rows that the reference blends, the method that every run is held against
            (`wrf_mi.baselines.idw.InverseDistance`).
        softening_m: of the same, metres.
        axes: number of axes of one observation, at one receiver and row.
        more_axes: that it may have beside these (antennas); all of them together are one observation.
        from_uplink: words for the second reference, of data with an uplink; "" where the task has none.
        heading: of the task.
        quantity: what is drawn over positions, with its unit.
        note: one sentence for readers of a table.
    """

    score: Callable[[ArrayLike, ArrayLike], FloatArray]
    block: str
    label: str
    higher_is_better: bool
    neighbours: int
    softening_m: float
    axes: int
    heading: str
    quantity: str
    note: str
    more_axes: int = 0
    from_uplink: str = ""

    @property
    def reference(self) -> str:
        """Key of the blend in ``metrics.json``."""
        return f"idw{self.neighbours}"

    @property
    def references(self) -> dict[str, str]:
        """Words for each reference that the task may have by its key, the first that a run has being its headline."""
        blend = {self.reference: f"blend of {self.neighbours} nearest"}
        return {UPLINK: self.from_uplink} | blend if self.from_uplink else blend

    def headline(self, stored: Container[str]) -> str | None:
        """The reference that stands for all: the first of `references` among those stored; None without any."""
        return next((key for key in self.references if key in stored), None)

    def of_rows(self, prediction: ArrayLike, truth: ArrayLike) -> FloatArray:
        """Score of each receiver and row.

        Args:
            prediction: [n_rx, m, ...], see `wrf_mi.core.Record`.
            truth: the same shape.

        Returns:
            Shape [n_rx, m].
        """
        predicted, expected = np.asarray(prediction), np.asarray(truth)
        if self.more_axes and expected.ndim > 2 + self.axes and predicted.shape == expected.shape:
            shape = (*expected.shape[:2], -1)
            predicted, expected = predicted.reshape(shape), expected.reshape(shape)
        return self.score(predicted, expected)


TASKS: Mapping[str, TaskScore] = {
    "spectrum": TaskScore(
        score=ssim,
        block="ssim",
        label="SSIM",
        higher_is_better=True,
        neighbours=REFERENCE["spectrum"][0],
        softening_m=REFERENCE["spectrum"][1],
        axes=2,
        heading="spatial spectra",
        quantity="grey",
        note="SSIM is scikit-image's structural similarity with a data range of one; the blend mixes the four nearest "
        "training spectra by inverse squared distance.",
    ),
    "rssi": TaskScore(
        score=abs_error_db,
        block="abs_error_db",
        label="absolute error (dB)",
        higher_is_better=False,
        neighbours=REFERENCE["rssi"][0],
        softening_m=REFERENCE["rssi"][1],
        axes=0,
        heading="received signal strength",
        quantity="RSSI (dBm)",
        note="The absolute error in dB counts rows that were received; the blend mixes the 100 nearest training rows "
        "that the same receiver received by inverse squared distance, 0.4 m added.",
    ),
    "csi": TaskScore(
        score=cea_db,
        block="cea_db",
        label="CEA (dB)",
        higher_is_better=True,
        neighbours=REFERENCE["csi"][0],
        softening_m=REFERENCE["csi"][1],
        axes=1,
        more_axes=1,
        from_uplink="copy of the uplink",
        heading="channel coefficients",
        quantity="power (dB)",
        note="CEA is the channel estimation accuracy, -10 log10 of the relative squared error over a sample's antennas "
        "and subcarriers; the blend mixes the four nearest training rows by inverse squared distance; the copy of the "
        "uplink takes each antenna's uplink coefficients for the downlink's.",
    ),
}
"""By the task of a record (`wrf_mi.core.Record`)."""


def summary(values: ArrayLike) -> dict[str, float]:
    """Median, mean, 10th and 90th percentile of all values that are not NaN.

    Raises:
        InputError: no values.
    """
    v = np.asarray(values, float).ravel()
    v = v[~np.isnan(v)]
    if not len(v):
        raise InputError("no test rows to score: the split has none")
    p10, median, p90 = np.percentile(v, [10, 50, 90])
    return {"median": float(median), "mean": float(v.mean()), "p10": float(p10), "p90": float(p90)}
