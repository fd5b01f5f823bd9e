"""Errors of float32 against the quantity that causes them: axis ratio, layers, distance, path length and contrast."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import to_float
from wrf_mi.core.angles import FloatArray
from wrf_mi.tasks.losses import ssim as similarity

from .stress_fields import SIZE, SMALL, Field, Rng, cases, gradient, image, layers, made, placed, reference
from .stress_rows import DOUBLE, relative

SEEDS = 5
COUNT = 30
FREQUENCIES_HZ = (915e6, 28e9)
Curves = dict[str, dict[str, list[float]]]


def curves() -> Curves:
    """Abscissa ``x`` and median error over seeds and blendings of each stage, by name."""
    ratios, distances, counts = np.logspace(0, 6, 7), np.logspace(0, 5, 6), np.logspace(1, 4, 4)
    lengths, contrasts = np.logspace(0, 5, 11), np.logspace(-6, 0, 7)
    phases = {
        f"{hz / 1e9:g} GHz, {name}": [float(np.pi * hz / speed_of_light * np.spacing(kind(x))) for x in lengths]
        for hz in FREQUENCIES_HZ
        for name, kind in (("float32", np.float32), ("float64", np.float64))
    }
    return {
        "ratio": {
            "x": ratios.tolist(),
            "image": _medians(ratios, _needles, _image),
            "derivative": _medians(ratios, _needles, _derivative),
        },
        "distance": {"x": distances.tolist(), "image": _medians(distances, _away, _image)},
        "layers": {"x": counts.tolist(), "image": _medians(counts, _layered, _image)},
        # Half a unit in the last digit of a path's length.
        "length": {"x": lengths.tolist()} | phases,
        "contrast": {"x": contrasts.tolist(), "similarity": [_similarity(c) for c in contrasts]},
    }


def _needles(ratio: float, rng: Rng) -> Field:
    return made(COUNT, rng, scale_m=np.tile([1.0, 1 / ratio, 1 / ratio], (COUNT, 1)))


def _away(distance_m: float, rng: Rng) -> Field:
    azimuth, elevation = rng.uniform(0, 2 * np.pi, COUNT), rng.uniform(0, 1.5, COUNT)
    position_m = placed(azimuth, elevation, rng, (0.5 * distance_m, 1.5 * distance_m))
    return made(COUNT, rng, position_m=position_m, scale_m=0.1 * distance_m * rng.uniform(0.5, 2, (COUNT, 3)))


def _layered(count: float, rng: Rng) -> Field:
    return layers(rng, int(count), opacity=np.full(int(count), 3 / count))


def _image(field: Field, blending: str, seed: int) -> float:
    size = SIZE if len(field.signal) < 1000 else SMALL
    truth, clear = reference(field, blending, size)
    return relative((image(field, blending, size) - truth)[clear], truth)


def _derivative(field: Field, blending: str, seed: int) -> float:
    single, double = (gradient(field, blending, kind, seed)["position"] for kind in (mi.Float, DOUBLE))
    return relative(single - double, double)


def _medians(
    values: Sequence[float] | FloatArray,
    family: Callable[[float, Rng], Field],
    error: Callable[[Field, str, int], float],
) -> list[float]:
    families: list[Any] = [{"": lambda rng, x=x: family(float(x), rng)} for x in values]
    return [float(np.median([error(*case[1:]) for case in cases(family_of_x, SEEDS)])) for family_of_x in families]


def _similarity(contrast: float) -> float:
    errors = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        one, other = (((1 - contrast) * 0.7 + contrast * rng.uniform(size=SIZE)).astype(np.float32) for _ in range(2))
        truth = structural_similarity(one.astype(float), other.astype(float), data_range=1)
        errors.append(abs(float(similarity(to_float(one), to_float(other), 1, *SIZE)[0]) - truth))
    return float(np.median(errors))


def draw(by_stage: Curves, out: Path) -> None:
    """Write a picture with a panel for each stage and its bound as a dashed line."""
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
        for label, values in by_stage[name].items():
            if label != "x":
                axes.loglog(by_stage[name]["x"], np.maximum(values, 1e-13), "o-", markersize=3, label=label)
        axes.axhline(bound, color="0.5", linestyle="--", linewidth=1)
        axes.set(xlabel=across, ylabel=up)
        axes.legend(fontsize=7)
        axes.grid(alpha=0.3)
    figure.savefig(out, dpi=120)
