"""Numbers under stress: float32 against float64, forwards and backwards, where it is hard.

Each row says how many cases ran and the worst of them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.core import Record
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.gaussians import FIELDS, Encoding, random_gaussians
from wrf_mi.gaussians.network import Weights
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.trainer import Trainer

from .bench import BenchFailed
from .stress_curves import curves, draw
from .stress_fields import BLENDINGS, HARD, RECEIVER, Field, felt_values, gradient, image, layers, made, reference
from .stress_joint import CANCELLING, COPLANAR, joint
from .stress_losses import losses
from .stress_plugins import plugin_gradients, plugin_images
from .stress_receivers import derivatives, of_fields, of_paths
from .stress_rows import EXACT, IMAGE, GradientWorst, Row, Worst, relative, row, worst_of
from .stress_traced import phases, traced_gradients

SIZE = (30, 60)
SMALL = (8, 16)
"""Pixels where tens of thousands of layers go through NumPy."""
PICTURE = Path("docs/images/numerics.png")
"""Written where the command is called in a checkout of the project, and only there."""
SHORT = (
    *("steps=25", "log_every=25", "validate_every=25", "checkpoint_every=6"),
    *("initial.gaussians=12", "density.every=0", "optimiser.warm_up=0"),
)
SAID = re.compile(r"step \d+: .*not finite: \w+")
RANDOM = "random fields"
NEITHER = "0 neither"
HARDEST = ("each axis of 1e-6 to 1e3 m", "needles, 1e6 to 1", "exact ties in depth", "opacity 0, 1 and 1 - 1e-7")
"""Families whose derivatives the quick form takes."""
DOUBLE: Any = dr.float64_array_t(mi.Float)


def images(random: int, of_each: int) -> list[Row]:
    """Images of random and of hard fields against the oracle."""
    rows = [_images(RANDOM, lambda r: made(int(r.integers(1, 100)), r), random, IMAGE)]
    rows += [_images(name, family, of_each, IMAGE) for name, family in HARD.items()]
    return [*rows, _images("50,000 layers", layers, 1, IMAGE, SMALL)]


def _images(
    name: str, family: Callable[[np.random.Generator], Field], count: int, bound: float, size: tuple[int, int] = SIZE
) -> Row:
    worst, edge, pixels = Worst(), 0, 0
    for seed in range(count):
        field = family(np.random.default_rng(seed))
        for blending in BLENDINGS:
            truth, clear = reference(field, blending, size)
            found = image(field, blending, size)
            worst.add(relative((found - truth)[clear], truth) if np.isfinite(found).all() else np.nan)
            edge, pixels = edge + int((~clear).sum()), pixels + truth.size
    what = f"image, {name}, {2 * count} cases"
    return worst.row(what, bound, f"; {edge / pixels:.1%} of the pixels lie on an edge and are left out")


def gradients(of_each: int, names: Iterable[str] = (RANDOM, *HARD)) -> list[Row]:
    """Derivatives in float32 against float64, worst group of parameters."""
    families = {RANDOM: _ordinary, **HARD}
    return [_gradients(name, families[name], of_each) for name in names if name != "none"]


def _ordinary(rng: np.random.Generator) -> Field:
    return made(60, rng)


def _gradients(name: str, family: Callable[[np.random.Generator], Field], count: int) -> Row:
    worst = GradientWorst()
    for seed in range(count):
        field = family(np.random.default_rng(seed))
        for blending in BLENDINGS:
            single, double = (gradient(field, blending, SIZE, kind, seed) for kind in (mi.Float, DOUBLE))
            worst.add(single, double, felt_values(field, blending))
    return worst.row(f"derivatives, {name}, {2 * count} cases")


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
        rows.append(row(what, worst, EXACT, f" ({group})" if group else ""))
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
    return {"what": what, "value": value, "asked": NEITHER}


def main() -> dict[str, Any]:
    """All of it at full size, and errors against what makes them, as a picture."""
    rows = [
        *images(1000, 25),
        *gradients(10),
        *field_functions(),
        *of_fields(50, 5),
        *derivatives(2),
        of_paths(25),
        *losses(10),
        *phases(),
        *traced_gradients(),
        *joint(),
        *plugin_images(50, 5),
        *plugin_gradients(2),
        fits(100),
    ]
    found = curves()
    if PICTURE.parent.is_dir():
        draw(found, PICTURE)
    return {"rows": rows, "curves": found}


QUICK: Sequence[Callable[[], list[Row]]] = (
    lambda: images(5, 1),
    lambda: gradients(1, HARDEST),
    lambda: field_functions(tries=3),
    lambda: of_fields(2, 1),
    lambda: derivatives(1, ("spectrum", "RSSI"), ("random", *HARDEST[:1])),
    lambda: [of_paths(1)],
    lambda: losses(1),
    lambda: phases(5),
    lambda: traced_gradients(2),
    lambda: joint(1, (COPLANAR, CANCELLING), ("RSSI",)),
    lambda: plugin_images(2, 1, 0),
    lambda: plugin_gradients(1, HARDEST[:1]),
    lambda: [fits(4)],
)
"""The same with few cases of each; for a minute."""


def quick() -> dict[str, Any]:
    """A few cases of each row.

    Raises:
        BenchFailed: a bound is not held.
    """
    rows = [one for part in QUICK for one in part()]
    if missed := [f"{one['what']}: {one['value']}, asked {one['asked']}" for one in rows if not held(one)]:
        raise BenchFailed(f"bench stress --quick: {'; '.join(missed)}")
    return {"rows": rows}


def held(row: Row) -> bool:
    """Whether a row's bound is held."""
    if row["asked"] == NEITHER:
        return row["value"].endswith(" 0 did neither")
    worst, bound = worst_of(row)
    return worst <= bound


__all__ = ["field_functions", "fits", "gradients", "held", "images", "main", "phases", "quick", "worst_of"]
