"""Errors of float32 against what makes them: how long, how deep, how far, how flat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import to_float
from wrf_mi.core.angles import FloatArray
from wrf_mi.tasks.ssim import ssim as similarity

from .stress_fields import BLENDINGS, RECEIVER, Field, gradient, image, made, placed, reference

SEEDS = range(5)
SIZE = (30, 60)
COUNT = 30
FREQUENCIES_HZ = (915e6, 28e9)
Curves = dict[str, dict[str, list[float]]]


def curves() -> Curves:
    """By stage: ``x`` and the median error of some seeds and both blendings, by name."""
    ratios, distances = np.logspace(0, 6, 7), np.logspace(0, 5, 6)
    lengths, contrasts = np.logspace(0, 5, 11), np.logspace(-6, 0, 7)
    found: Curves = {
        "ratio": {"x": ratios.tolist()},
        "distance": {"x": distances.tolist(), "image": _medians(distances, _away, _image)},
        "layers": {"x": [10.0, 100.0, 1000.0, 10_000.0]},
        "length": {"x": lengths.tolist()},
        "contrast": {"x": contrasts.tolist(), "similarity": [_similarity(c) for c in contrasts]},
    }
    for name, error in (("image", _image), ("derivative", _derivative)):
        found["ratio"][name] = _medians(ratios, _needles, error)
    found["layers"]["image"] = _medians(found["layers"]["x"], _layered, _image)
    for frequency in FREQUENCIES_HZ:
        found["length"][f"{frequency / 1e9:g} GHz, float32"] = [_phase(x, frequency, np.float32) for x in lengths]
        found["length"][f"{frequency / 1e9:g} GHz, float64"] = [_phase(x, frequency, np.float64) for x in lengths]
    return found


def _needles(ratio: float, rng: np.random.Generator) -> Field:
    return made(COUNT, rng, scale_m=np.tile([1.0, 1 / ratio, 1 / ratio], (COUNT, 1)))


def _away(distance_m: float, rng: np.random.Generator) -> Field:
    place = placed(
        rng.uniform(0, 2 * np.pi, COUNT), rng.uniform(0, 1.5, COUNT), rng, (0.5 * distance_m, 1.5 * distance_m)
    )
    return made(COUNT, rng, position_m=place, scale_m=0.1 * distance_m * rng.uniform(0.5, 2, (COUNT, 3)))


def _layered(count: float, rng: np.random.Generator) -> Field:
    n = int(count)
    place = placed(rng.normal(1, 0.005, n), rng.normal(0.7, 0.005, n), rng)
    distance = np.linalg.norm(place - RECEIVER.position_m, axis=1)
    return made(n, rng, position_m=place, scale_m=np.tile(0.1 * distance[:, None], 3), opacity=np.full(n, 3 / n))


def _image(field: Field, blending: str, seed: int) -> float:
    size = SIZE if len(field.signal) < 1000 else (8, 16)
    truth, clear = reference(field, blending, size)
    return float(np.linalg.norm((image(field, blending, size) - truth)[clear]) / np.linalg.norm(truth))


def _derivative(field: Field, blending: str, seed: int) -> float:
    single = gradient(field, blending, SIZE, mi.Float, seed)["position"]
    double = gradient(field, blending, SIZE, dr.float64_array_t(mi.Float), seed)["position"]
    return float(np.linalg.norm(single - double) / np.linalg.norm(double))


def _medians(
    values: Sequence[float] | FloatArray,
    family: Callable[[float, np.random.Generator], Field],
    error: Callable[[Field, str, int], float],
) -> list[float]:
    return [
        float(
            np.median(
                [
                    error(family(float(x), np.random.default_rng(seed)), blend, seed)
                    for seed in SEEDS
                    for blend in BLENDINGS
                ]
            )
        )
        for x in values
    ]


def _phase(length_m: float, frequency_hz: float, kind: Any) -> float:
    """Largest error of a phase whose length is stored as ``kind``, rad: half a unit in its last digit."""
    return float(np.pi * frequency_hz / speed_of_light * np.spacing(kind(length_m)))


def _similarity(contrast: float) -> float:
    errors = []
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        one, other = (((1 - contrast) * 0.7 + contrast * rng.uniform(size=SIZE)).astype(np.float32) for _ in range(2))
        truth = structural_similarity(one.astype(float), other.astype(float), data_range=1)
        errors.append(abs(float(similarity(to_float(one), to_float(other), 1, *SIZE)[0]) - truth))
    return float(np.median(errors))


def draw(found: Curves, out: Path) -> None:
    """One panel a stage, with its bound as a dashed line."""
    from matplotlib.figure import Figure

    panels = (
        ("ratio", "longest over shortest axis of a Gaussian", "relative error", 1e-4),
        ("layers", "Gaussians behind each other", "relative error", 1e-4),
        ("distance", "distance, m", "relative error", 1e-4),
        ("length", "length of a path, m", "phase, rad", 1e-3),
        ("contrast", "contrast of an image", "error of the similarity", 1e-4),
    )
    figure = Figure(figsize=(15, 3.4), layout="constrained")
    for axes, (name, across, up, bound) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        for label, values in found[name].items():
            if label != "x":
                axes.loglog(found[name]["x"], np.maximum(values, 1e-13), "o-", markersize=3, label=label)
        axes.axhline(bound, color="0.5", linestyle="--", linewidth=1)
        axes.set(xlabel=across, ylabel=up)
        axes.legend(fontsize=7)
        axes.grid(alpha=0.3)
    figure.savefig(out, dpi=120)
