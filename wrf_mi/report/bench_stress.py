"""Numbers under stress: float32 against float64, forwards and backwards, where it is hard.

Each row says how many cases ran and the worst of them.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from skimage.metrics import structural_similarity
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.furnished import write_scene

from ..core import Record
from ..core.angles import FloatArray
from ..field import FIELDS, Encoding, random_gaussians
from ..field.network import Weights
from ..fit.config import TrainConfig, with_settings
from ..fit.trainer import NumericsError, Trainer
from ..loss.ssim import ssim as similarity
from ..measure import make_splits
from ..trace import TraceOptions, open_scene, trace_paths
from .stress_curves import curves, draw
from .stress_fields import BLENDINGS, HARD, RECEIVER, Field, gradient, image, layers, made, reference

SIZE = (30, 60)
SMALL = (8, 16)
"""Pixels where tens of thousands of layers go through NumPy."""
IMAGE = 1e-4
"""Relative L2 error of an image."""
GRADIENT = 1e-3
"""Relative error, in norm, of a derivative in float32."""
EXACT = 1e-5
"""Median relative error of a derivative in float64 against central differences."""
PHASE = 1e-3
"""Radians."""
UNFELT = 1e-3
"""A group whose derivatives, times its parameters, are below this share of the largest group's counts as that large."""
PICTURE = Path("docs/images/numerics.png")
"""Written where the command is called in a checkout of the project, and only there."""
SHORT = (
    *("steps=25", "log_every=25", "validate_every=25", "checkpoint_every=6"),
    *("initial.gaussians=12", "density.every=0", "optimiser.warm_up=0"),
)
SAID = re.compile(r"step \d+: .*not finite: \w+")
RANDOM = "random fields"
Row = dict[str, str]
DOUBLE: Any = dr.float64_array_t(mi.Float)


def images(random: int, of_each: int) -> list[Row]:
    """Images of random and of hard fields against the oracle."""
    rows = [_images(RANDOM, lambda r: made(int(r.integers(1, 100)), r), random, IMAGE)]
    rows += [_images(name, family, of_each, IMAGE) for name, family in HARD.items()]
    return [*rows, _images("50,000 layers", layers, 1, IMAGE, SMALL)]


def _images(
    name: str, family: Callable[[np.random.Generator], Field], count: int, bound: float, size: tuple[int, int] = SIZE
) -> Row:
    worst, edge, pixels = 0.0, 0, 0
    for seed in range(count):
        field = family(np.random.default_rng(seed))
        for blending in BLENDINGS:
            truth, clear = reference(field, blending, size)
            found = image(field, blending, size)
            worst = max(worst, _relative((found - truth)[clear], truth))
            edge, pixels = edge + int((~clear).sum()), pixels + truth.size
    what = f"image, {name}, {2 * count} cases"
    return _row(what, worst, bound, f"; {edge / pixels:.1%} of the pixels lie on an edge and are left out")


def gradients(of_each: int, names: Iterable[str] = (RANDOM, *HARD)) -> list[Row]:
    """Derivatives in float32 against float64, worst group of parameters."""
    families = {RANDOM: _ordinary, **HARD}
    return [_gradients(name, families[name], of_each) for name in names if name != "none"]


def _ordinary(rng: np.random.Generator) -> Field:
    return made(60, rng)


def _gradients(name: str, family: Callable[[np.random.Generator], Field], count: int) -> Row:
    worst, group = 0.0, ""
    for seed in range(count):
        field = family(np.random.default_rng(seed))
        for blending in BLENDINGS:
            single = gradient(field, blending, SIZE, mi.Float, seed)
            double = gradient(field, blending, SIZE, DOUBLE, seed)
            values = field.groups(blending)
            values["position"] = values["position"] - RECEIVER.position_m
            felt = {key: float(np.linalg.norm(double[key] * values[key])) for key in double}
            least = UNFELT * max(felt.values())
            for key in double:
                error = float(np.linalg.norm((single[key] - double[key]) * values[key])) if least else 0.0
                error = error / max(felt[key], least) if error else error
                if not error <= worst:
                    worst, group = error, key
    return _row(f"derivatives, {name}, {2 * count} cases", worst, GRADIENT, f" ({group})" if group else "")


def field_functions(models: Iterable[str] = tuple(FIELDS), tries: int = 9) -> list[Row]:
    """Derivatives of the models' own functions in float64 against central differences, by group of parameters."""
    tensor: Any = dr.tensor_t(DOUBLE)
    rows = []
    for model in models:
        rng = np.random.default_rng(0)
        field = FIELDS[model](encoding=Encoding(1, 1e6, 2, 1.0))  # positions' encoding is detached on purpose
        weights = field.init(random_gaussians([RECEIVER], 12, rng, opacity=0.4), rng)
        params = {name: tensor(np.asarray(value, float)) for name, value in weights.items()}
        tx = tensor(rng.normal(size=(3, 2)))
        of = _functional(field, tx, np.random.default_rng(1))
        for value in params.values():
            dr.enable_grad(value)
        dr.backward(of(params))
        slopes = {name: np.asarray(dr.grad(value).numpy(), float) for name, value in params.items()}
        plain = {name: np.asarray(dr.detach(value).numpy(), float) for name, value in params.items()}
        fixed = {name: tensor(value) for name, value in plain.items()}
        worst, group = 0.0, ""
        for name, value in plain.items():
            errors = []
            for _ in range(tries):
                direction = rng.normal(size=value.shape)
                step = 1e-6
                ends = [float(of(fixed | {name: tensor(value + sign * step * direction)})[0]) for sign in (1, -1)]
                numeric, analytic = (ends[0] - ends[1]) / (2 * step), float((slopes[name] * direction).sum())
                scale = max(abs(numeric), abs(analytic))
                errors.append(abs(numeric - analytic) / scale if scale > 1e-6 else 0.0)
            median = float(np.median(errors))
            if not median <= worst:
                worst, group = median, name
        what = f"derivatives of {model} in float64 against differences, {len(plain)} groups, {tries} directions each"
        rows.append(_row(what, worst, EXACT, f" ({group})" if group else ""))
    return rows


def _functional(field: Any, tx: Any, rng: np.random.Generator) -> Callable[[dict[str, Any]], Any]:
    """A random linear functional of all that a field's Gaussians have."""
    weights: list[Any] = []

    def value(params: dict[str, Any]) -> Any:
        g = field.gaussians(params, tx)
        last = [g.opacity] if g.opacity is not None else g.attenuation
        arrays = [*g.position, *g.scale, *g.rotation, *g.signal, *last]
        if not weights:
            weights.extend(type(a)(rng.normal(size=dr.width(a))) for a in arrays)
        total = dr.sum(arrays[0] * weights[0])
        for array, weight in zip(arrays[1:], weights[1:], strict=True):
            total = total + dr.sum(array * weight)
        return total

    return value


def phases() -> list[Row]:
    """Phases of traced paths against mirror images in closed form: halls of metal, up to two reflections."""
    return [_phases(28e9, (100.0, 60.0, 12.0)), _phases(915e6, (10_000.0, 4_000.0, 300.0))]


def _phases(frequency_hz: float, size_m: tuple[float, float, float], count: int = 30) -> Row:
    length, width, height = size_m
    walls = {f"{axis}{at:g}": sheet(axis, at, *spans) for axis, at, spans in (
        (0, 0.0, ((0.0, width), (0.0, height))), (0, length, ((0.0, width), (0.0, height))),
        (1, 0.0, ((0.0, length), (0.0, height))), (1, width, ((0.0, length), (0.0, height))),
        (2, 0.0, ((0.0, length), (0.0, width))), (2, height, ((0.0, length), (0.0, width))),
    )}  # fmt: skip
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform(0.1, 0.9, (count, 3)) * size_m, rng.uniform(0.1, 0.9, 3) * size_m
    with tempfile.TemporaryDirectory() as work:
        xml = write_scene(Path(work), {name: ("itu_metal", wall) for name, wall in walls.items()}, "Hall of metal")
        scene = open_scene(xml, frequency_hz)
        options = TraceOptions(max_depth=2, rays=1 << 14, upright=True)
        paths = trace_paths(scene, tx, replace(RECEIVER, position_m=rx), options).paths
    worst = single = 0.0
    for row, place in enumerate(tx):
        found, exact = np.sort(paths.length_m[paths.tx == row]), _mirror_images(place, rx, np.array(size_m))
        if len(found) != len(exact):
            worst = float("inf")
            continue
        worst = max(worst, float(np.abs(found - exact).max()))
        single = max(single, float(np.abs(found.astype(np.float32) - exact).max()))
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    what = f"phase at {frequency_hz / 1e9:g} GHz in {length:g} m, {len(paths)} paths"
    return _row(what, wavenumber * worst, PHASE, f" rad; with lengths in float32 {wavenumber * single:.0e} rad")


def _mirror_images(tx: FloatArray, rx: FloatArray, size: FloatArray, depth: int = 2) -> FloatArray:
    """Lengths of all paths of up to ``depth`` reflections in a box, sorted.

    Source: Allen and Berkley, "Image method for efficiently simulating small-room acoustics" (1979), JASA 65(4).
    """
    numbers = np.array(np.meshgrid(*[np.arange(-depth, depth + 1)] * 3)).reshape(3, -1).T
    numbers = numbers[np.abs(numbers).sum(axis=1) <= depth]
    image = np.where(numbers % 2 == 0, numbers * size + tx, (numbers + 1) * size - tx)
    return np.sort(np.linalg.norm(image - rx, axis=1))


def losses(count: int) -> list[Row]:
    """The differentiable similarity against scikit-image's in float64: random, flat, nearly flat, and out of range."""
    rng = np.random.default_rng(0)
    kinds: dict[str, Callable[[], FloatArray]] = {
        "random": lambda: rng.uniform(size=SIZE),
        "flat": lambda: np.full(SIZE, rng.uniform()),
        "nearly flat": lambda: rng.uniform() + 1e-4 * rng.normal(size=SIZE),
        "of 0 to 1000": lambda: 1e3 * rng.uniform(size=SIZE),
    }
    rows = []
    for name, make in kinds.items():
        worst = 0.0
        for _ in range(count):
            one, other = (make().astype(np.float32) for _ in range(2))
            truth = structural_similarity(one.astype(float), other.astype(float), data_range=1)
            found = float(similarity(mi.Float(one.ravel()), mi.Float(other.ravel()), 1, *SIZE)[0])
            worst = max(worst, abs(found - truth))
        rows.append(_row(f"similarity of images, {name}, {count} cases", worst, IMAGE))
    return rows


def fits(count: int) -> Row:
    """Short fits with bad learning rates and starts: each ends with finite parameters, or says when and where not.

    What is saved on the way has to be finite in any case.
    """
    rng = np.random.default_rng(0)
    record = Record(
        "noise",
        "spectrum",
        rng.uniform(-1, 1, (12, 3)),
        (replace(RECEIVER, position_m=np.zeros(3)),),
        rng.uniform(0, 1, (1, 12, *SMALL)).astype(np.float32),
        official=(np.arange(10), np.arange(10, 12)),
    )
    (rows,) = make_splits(record, "official")
    finished = said = unseen = 0
    for seed in range(count):
        draw = np.random.default_rng(seed)
        groups = ("network", "position", "scale", "rotation", "opacity", "signal")
        settings = [f"optimiser.{group}={10 ** draw.uniform(-3, 38):.3e}" for group in groups if draw.random() < 0.5]
        settings += [
            f"initial.signal={10 ** draw.uniform(-10, 20):.3e}",
            f"initial.size_deg={draw.uniform(0.01, 80):g}",
        ]
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
            told = SAID.match(str(error)) is not None
            said, unseen = said + told, unseen + (not told)
        unseen += not all(np.isfinite(values).all() for params in saved for values in params.values())
    what = f"fits with random bad learning rates and starts, {count} cases"
    value = f"{finished} ended finite, {said} said at which step which group was not, {unseen} did neither"
    return {"what": what, "value": value, "asked": "0 neither"}


def _relative(error: Any, truth: Any) -> float:
    size = float(np.linalg.norm(truth))
    off = float(np.linalg.norm(error))
    return off / size if size else off


def _row(what: str, worst: float, bound: float, more: str = "") -> Row:
    return {"what": what, "value": f"worst {worst:.1e}{more}", "asked": f"at most {bound:g}"}


def main() -> dict[str, Any]:
    """All of it at full size, and errors against what makes them, as a picture."""
    rows = [*images(1000, 25), *gradients(10), *field_functions(), *phases(), *losses(50)]
    found = curves()
    if PICTURE.parent.is_dir():
        draw(found, PICTURE)
    return {"rows": [*rows, fits(100)], "curves": found}


def worst_of(row: Row) -> tuple[float, float]:
    """The worst case of a row and its bound."""
    return float(row["value"].split()[1].rstrip(";")), float(row["asked"].split()[-1])


__all__ = ["field_functions", "fits", "gradients", "images", "losses", "main", "phases", "worst_of"]
