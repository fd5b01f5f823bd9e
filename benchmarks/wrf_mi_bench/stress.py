"""Numerical stress tests: float32 against float64, values and derivatives, on ill-conditioned cases."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from skimage.metrics import structural_similarity

from wrf_mi.backend.device import to_float
from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians import FIELDS, Encoding, random_gaussians
from wrf_mi.gaussians.network import Weights
from wrf_mi.tasks import SPECTRUM
from wrf_mi.tasks.losses import ssim as similarity
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

from . import stress_fields as fields
from .bench import BenchFailed
from .stress_joint import CANCELLING, COPLANAR, joint, phases
from .stress_losses import losses
from .stress_plugins import plugin_gradients, plugin_images
from .stress_receivers import derivatives, of_fields, of_paths
from .stress_rows import DOUBLE, EXACT, FITS, NEITHER, Row, Worst, held, relative

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
    needles = {"image": _medians(ratios, _needles, _image), "derivative": _medians(ratios, _needles, _derivative)}
    return {
        "ratio": {"x": ratios.tolist(), **needles},
        "distance": {"x": distances.tolist(), "image": _medians(distances, _away, _image)},
        "layers": {"x": counts.tolist(), "image": _medians(counts, _layered, _image)},
        # Half a unit in the last digit of a path's length.
        "length": {"x": lengths.tolist()} | phases,
        "contrast": {"x": contrasts.tolist(), "similarity": [_similarity(c) for c in contrasts]},
    }


def _needles(ratio: float, rng: fields.Rng) -> fields.StressField:
    return fields.made(COUNT, rng, scale_m=np.tile([1.0, 1 / ratio, 1 / ratio], (COUNT, 1)))


def _away(distance_m: float, rng: fields.Rng) -> fields.StressField:
    azimuth, elevation = rng.uniform(0, 2 * np.pi, COUNT), rng.uniform(0, 1.5, COUNT)
    position_m = fields.placed(azimuth, elevation, rng, (0.5 * distance_m, 1.5 * distance_m))
    return fields.made(COUNT, rng, position_m=position_m, scale_m=0.1 * distance_m * rng.uniform(0.5, 2, (COUNT, 3)))


def _layered(count: float, rng: fields.Rng) -> fields.StressField:
    return fields.layers(rng, int(count), opacity=np.full(int(count), 3 / count))


def _image(field: fields.StressField, blending: str, seed: int) -> float:
    size = fields.SIZE if len(field.signal) < 1000 else fields.SMALL
    truth, clear = fields.reference(field, blending, size)
    return relative((fields.image(field, blending, size) - truth)[clear], truth)


def _derivative(field: fields.StressField, blending: str, seed: int) -> float:
    single, double = (fields.gradient(field, blending, kind, seed)["position"] for kind in (mi.Float, DOUBLE))
    return relative(single - double, double)


def _medians(
    values: Sequence[float] | FloatArray,
    family: Callable[[float, fields.Rng], fields.StressField],
    error: Callable[[fields.StressField, str, int], float],
) -> list[float]:
    families: list[Any] = [{"": lambda rng, x=x: family(float(x), rng)} for x in values]
    return [
        float(np.median([error(*case[1:]) for case in fields.cases(family_of_x, SEEDS)])) for family_of_x in families
    ]


def _similarity(contrast: float) -> float:
    errors = []
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        first, second = (
            ((1 - contrast) * 0.7 + contrast * rng.uniform(size=fields.SIZE)).astype(np.float32) for _ in range(2)
        )
        truth = structural_similarity(first.astype(float), second.astype(float), data_range=1)
        errors.append(abs(float(similarity(to_float(first), to_float(second), 1, *fields.SIZE)[0]) - truth))
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


PICTURE = Path("docs/images/numerics.png")  # picture of the error curves, written only in a checkout of the project
SHORT = (
    *("steps=25", "log_every=25", "validate_every=25", "checkpoint_every=6"),
    *("initial.gaussians=12", "density.every=0", "optimiser.warm_up=0"),
)
STATED = re.compile(r"step \d+: .*not finite: \w+")
RANDOM = "random fields"


def images(random: int, of_each: int) -> list[Row]:
    rows = [fields.image_row(f"image, {RANDOM}", {RANDOM: fields.ordinary}, random)]
    rows += [fields.image_row(f"image, {name}", {name: family}, of_each) for name, family in fields.HARD.items()]
    return [*rows, fields.image_row("image, 50,000 layers", {"layers": fields.layers}, 1, fields.SMALL)]


def gradients(of_each: int, names: Iterable[str] = (RANDOM, *fields.HARD)) -> list[Row]:
    families = {RANDOM: lambda rng: fields.made(60, rng), **fields.HARD}
    chosen = {name: families[name] for name in names if name != "none"}
    return [fields.gradient_row(f"derivatives, {name}", fields.cases({name: chosen[name]}, of_each)) for name in chosen]


def field_functions(models: Iterable[str] = tuple(FIELDS), tries: int = 9) -> list[Row]:
    """Derivatives of the models' functions in float64 against central differences, by group of parameters."""
    tensor: Any = dr.tensor_t(DOUBLE)
    rows = []
    for model in models:
        rng = np.random.default_rng(0)
        field = FIELDS[model](encoding=Encoding(1, 1e6, 2, 1.0))  # the encoding of positions is detached
        weights = field.init(random_gaussians([fields.RECEIVER], 12, rng, opacity=0.4), rng)
        params = {name: tensor(np.asarray(value, float)) for name, value in weights.items()}
        tx = tensor(rng.normal(size=(3, 2)))
        of = _functional(field, tx, np.random.default_rng(1))
        for value in params.values():
            dr.enable_grad(value)
        dr.backward(of(params))
        slopes = {name: np.asarray(dr.grad(value).numpy(), float) for name, value in params.items()}
        plain = {name: np.asarray(dr.detach(value).numpy(), float) for name, value in params.items()}
        fixed = {name: tensor(value) for name, value in plain.items()}
        worst, step = Worst(), 1e-6
        for name, value in plain.items():
            errors = []
            for _ in range(tries):
                direction = rng.normal(size=value.shape)
                up, down = (float(of(fixed | {name: tensor(value + sign * direction)})[0]) for sign in (step, -step))
                numeric, analytic = (up - down) / (2 * step), float((slopes[name] * direction).sum())
                scale = max(abs(numeric), abs(analytic))
                errors.append(abs(numeric - analytic) / scale if scale > 1e-6 else 0.0)
            worst.add(np.median(errors), name)
        what = f"derivatives of {model} in float64 against differences, {len(plain)} groups, {tries} directions each"
        rows.append(worst.row(what, EXACT))
    return rows


def _functional(field: Any, tx: Any, rng: np.random.Generator) -> Callable[[dict[str, Any]], Any]:
    """Random linear functional of all arrays of a field's Gaussians."""
    weights: list[Any] = []

    def value(params: dict[str, Any]) -> Any:
        g = field.gaussians(params, tx)
        last = [g.opacity] if g.opacity is not None else g.attenuation
        arrays = [*g.position, *g.scale, *g.rotation, *g.signal, *last]
        if not weights:
            weights.extend(type(a)(rng.normal(size=dr.width(a))) for a in arrays)
        return sum(dr.sum(array * weight) for array, weight in zip(arrays, weights, strict=True))

    return value


def fits(count: int) -> list[Row]:
    """Short fits with bad learning rates and starts: each ends with finite parameters or names step and group.

    All saved parameters have to be finite.
    """
    rng = np.random.default_rng(0)
    record = Record(
        "noise",
        SPECTRUM,
        rng.uniform(-1, 1, (12, 3)),
        (replace(fields.RECEIVER, position_m=np.zeros(3)),),
        rng.uniform(0, 1, (1, 12, *fields.SMALL)).astype(np.float32),
        official=(np.arange(10), np.arange(10, 12)),
    )
    (rows,) = make_splits(record, "official")
    finished = stated = unseen = 0
    for seed in range(count):
        draw = np.random.default_rng(seed)
        groups = ("network", "position", "scale", "rotation", "opacity", "signal")
        settings = [f"optimiser.{group}={10 ** draw.uniform(-3, 38):.3e}" for group in groups if draw.random() < 0.5]
        settings.append(f"initial.signal={10 ** draw.uniform(-10, 20):.3e}")
        settings.append(f"initial.size_deg={draw.uniform(0.01, 80):g}")
        model = str(draw.choice(list(FIELDS)))
        config = with_settings(TrainConfig(model=model, seed=seed), [*SHORT, *settings])
        trainer = Trainer(record, rows, config)
        saved: list[Weights] = []

        def save(of: Trainer = trainer, to: list[Weights] = saved) -> None:
            to.append(of.state.params())

        try:
            trainer.run(save=save)
            finished += 1
            saved.append(trainer.state.mean_params())
        except NumericsError as error:
            matched = STATED.match(str(error)) is not None
            stated, unseen = stated + matched, unseen + (not matched)
        unseen += not all(np.isfinite(values).all() for params in saved for values in params.values())
    what = f"{FITS} learning rates and starts, {count} cases"
    value = f"{finished} ended finite, {stated} stopped, naming step and parameter group, {unseen} did neither"
    return [{"what": what, "value": value, "asked": NEITHER}]


PARTS: Sequence[tuple[Callable[..., list[Row]], tuple[Any, ...], tuple[Any, ...]]] = (
    (images, (1000, 25), (5, 1)),
    (gradients, (10,), (1, fields.HARDEST)),
    (field_functions, (), (tuple(FIELDS), 3)),
    (of_fields, (50, 5), (2, 1)),
    (derivatives, (2,), (1, ("spectrum", "RSSI"), ("random", *fields.HARDEST[:1]))),
    (of_paths, (25,), (1,)),
    (losses, (10,), (2,)),
    (phases, (), (5,)),
    (joint, (), (1, (COPLANAR, CANCELLING), ("RSSI",))),
    (plugin_images, (50, 5), (2, 1, 0)),
    (plugin_gradients, (2,), (1, fields.HARDEST[:1])),
    (fits, (100,), (4,)),
)
"""Functions that make rows, with their arguments at full size and for few cases within a minute."""


def main() -> dict[str, Any]:
    """All rows at full size, and a picture of error curves."""
    rows = [row for part, full, _ in PARTS for row in part(*full)]
    errors = curves()
    if PICTURE.parent.is_dir():
        draw(errors, PICTURE)
    return {"rows": rows, "curves": errors}


def quick_rows() -> list[Row]:
    """A few cases of each row."""
    return [row for part, _, few in PARTS for row in part(*few)]


def quick() -> dict[str, Any]:
    """`quick_rows`; `BenchFailed` where a bound is not kept."""
    rows = quick_rows()
    if missed := [f"{row['what']}: {row['value']}, asked {row['asked']}" for row in rows if not held(row)]:
        raise BenchFailed(f"bench stress --quick: {'; '.join(missed)}")
    return {"rows": rows}
