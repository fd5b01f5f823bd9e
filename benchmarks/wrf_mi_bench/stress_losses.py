"""Losses in float32 against float64, scikit-image and NumPy, values and derivatives."""

from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import on_device, to_float
from wrf_mi.core.angles import FloatArray
from wrf_mi.tasks.losses import LEAST_LIGHT, SSIM_WEIGHT, absolute_error, spectrum_loss

from .stress_fields import SIZE, Rng
from .stress_rows import DOUBLE, EXACT, GRADIENT, IMAGE, UNFELT, GradientWorst, Row, Worst

UNFELT_SLOPE = UNFELT / np.sqrt(SIZE[0] * SIZE[1])
"""Floor of a derivative's norm: a thousandth of the mean absolute error's."""
Pair = tuple[FloatArray, FloatArray]
LARGEST = 1e15  # largest pixel whose fourth power does not overflow float32


def _around(rng: Rng, contrast: float, shift: float = 0.0) -> Pair:
    level = rng.uniform(0.1, 0.9)
    truth = level + contrast * rng.normal(size=SIZE)
    return truth + shift + contrast * rng.normal(size=SIZE), truth


KINDS: Mapping[str, Callable[[Rng], Pair]] = {
    "random": lambda r: (r.uniform(size=SIZE), r.uniform(size=SIZE)),
    "flat": lambda r: (np.full(SIZE, r.uniform()), np.full(SIZE, r.uniform())),
    "flat and the same": lambda r: (np.full(SIZE, 0.7), np.full(SIZE, 0.7)),
    "nearly flat, 1e-4": lambda r: _around(r, 1e-4, 0.1),
    "nearly flat, 1e-6": lambda r: _around(r, 1e-6, 0.1),
    "nearly the same, 1e-4": lambda r: _around(r, 1e-4),
    "nearly the same, 1e-6": lambda r: _around(r, 1e-6),
    "zero": lambda r: (np.zeros(SIZE), np.zeros(SIZE)),
    "zero against random": lambda r: (np.zeros(SIZE), r.uniform(size=SIZE)),
    "of 0 to 1000": lambda r: (1e3 * r.uniform(size=SIZE), 1e3 * r.uniform(size=SIZE)),
    "of 0 to 1e15 against 0 to 1": lambda r: (LARGEST * r.uniform(size=SIZE), r.uniform(size=SIZE)),
}
"""Prediction and truth of each kind of case."""


def losses(count: int) -> list[Row]:
    """Rows of all losses, ``count`` cases of each kind of images."""
    cases = f"{count * len(KINDS)} cases"
    likeness, loss, received = Worst(), Worst(), Worst()
    slope, alone = GradientWorst(), GradientWorst()
    for name, make in KINDS.items():
        for seed in range(count):
            image, other = (v.astype(np.float32).astype(float) for v in make(np.random.default_rng(seed)))
            structure = structural_similarity(other, image, data_range=1)
            error, light = np.abs(image - other), other - other.min()
            by_light = (light * error).sum() / max(light.sum(), LEAST_LIGHT)
            truth = (1 - SSIM_WEIGHT) * (error.mean() + by_light) / 2 + SSIM_WEIGHT * (1 - structure)
            values = {"prediction": np.ones(image.size)}
            results = {kind: _both(kind, image, other, SSIM_WEIGHT) for kind in (mi.Float, DOUBLE)}
            likeness.add(abs(results[mi.Float][1] - structure), name)
            loss.add(abs(results[mi.Float][0] - truth) / max(truth, 1.0), name)
            slope.add(results[mi.Float][2], results[DOUBLE][2], values, name, UNFELT_SLOPE)
            structural = {kind: _both(kind, image, other, 1.0)[2] for kind in (mi.Float, DOUBLE)}
            alone.add(structural[mi.Float], structural[DOUBLE], values, name, UNFELT_SLOPE)
            received.add(_absolute(image, other, np.random.default_rng(seed)), name)
    return [
        likeness.row(f"loss: similarity against scikit-image's, {cases}", IMAGE),
        loss.row(f"loss: of spectra against NumPy, {cases}", IMAGE),
        slope.row(f"loss: derivatives of that of spectra, {cases}"),
        alone.row(f"loss: derivatives of the similarity alone, {cases}"),
        received.row(f"loss: absolute error of what was received, and derivatives, {cases}", GRADIENT),
        _differences(count),
    ]


def _both(kind: Any, image: FloatArray, other: FloatArray, eta: float) -> tuple[float, float, dict[str, FloatArray]]:
    """Loss, similarity and derivative of the loss."""
    prediction = on_device(image, kind)
    dr.enable_grad(prediction)
    value, structure = spectrum_loss(prediction, on_device(other, kind), 1, *SIZE, eta=eta)
    dr.backward(value)
    slope = {"prediction": dr.grad(prediction).numpy().astype(float)}
    return float(dr.detach(value)[0]), float(dr.detach(structure)[0]), slope


def _absolute(image: FloatArray, other: FloatArray, rng: Rng) -> float:
    """Error of the mean absolute error and its derivatives, with a third of the values NaN."""
    known = rng.random(image.size) > 1 / 3
    prediction = to_float(image)
    dr.enable_grad(prediction)
    value = absolute_error(prediction, to_float(np.where(known, other.ravel(), np.nan)))
    dr.backward(value)
    truth = np.abs(image - other).ravel()[known].mean()
    slope = np.where(known, np.sign(image - other).ravel(), 0) / known.sum()
    off = np.linalg.norm(dr.grad(prediction).numpy() - slope) / (np.linalg.norm(slope) or 1.0)
    return max(abs(float(dr.detach(value)[0]) - truth) / max(truth, 1.0), float(off))


def _differences(count: int) -> Row:
    """Derivatives of the similarity in float64 against central differences of scikit-image's."""
    errors, step = [], 1e-5
    for seed in range(count):
        rng = np.random.default_rng(seed)
        image, other = rng.uniform(size=SIZE), rng.uniform(size=SIZE)
        way = rng.normal(size=SIZE)
        slope = float(-_both(DOUBLE, image, other, 1.0)[2]["prediction"] @ way.ravel())
        up, down = (structural_similarity(other, image + s * way, data_range=1) for s in (step, -step))
        difference = (up - down) / (2 * step)
        errors.append(abs(slope - difference) / abs(difference))
    worst = Worst()
    worst.add(np.median(errors))
    return worst.row(f"loss: derivatives of the similarity against scikit-image's differences, {count} cases", EXACT)
