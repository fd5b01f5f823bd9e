"""Numerical stress test of fields of Gaussians: float32 against float64, values and derivatives, ill-conditioned cases.

Images by splatting and by the Mitsuba plugin are compared with `truth` in NumPy, observations of receivers with those
of the same receivers in float64 for the true field, and derivatives with those of the same code in float64. Pixels on
the edge of a footprint are left out of images, and zero in fields that receivers observe. The error of a single sum
over directions (RSSI, CSI) is relative to the sum of magnitudes, as waves may cancel; that of images and spectra to
their norm. Losses, sums of paths, paths and Gaussians together, and fits from bad starts are stressed in the tests.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from wrf_mi_plugins.blend_rays import blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import ray_footprints

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import pixel_directions
from wrf_mi.core.angles import FloatArray, solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.footprint import depth_order
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver

from .bench import BenchFailed
from .stress_fields import (
    DOUBLE,
    HARD,
    HARDEST,
    RECEIVER,
    SIZE,
    SMALL,
    Family,
    Observe,
    Size,
    StressField,
    cases,
    felt_values,
    gradient,
    layers,
    made,
    on_device,
    ordinary,
    pose,
    truth,
)
from .stress_rows import GRADIENT, IMAGE, Row, Worst, gradient_errors, held, relative
from .traced import scene_of

CARRIER_HZ = 920e6
TONES_HZ = (CARRIER_HZ, 1.02 * CARRIER_HZ)
ELEMENTS_M = planar_array(4, 4, 0.16)
MODELS: dict[str, Any] = {
    "pixels": PixelReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ),
    "spectrum": ArrayReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ),
    "scaled spectrum": ArrayReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ, instrument_scale=True),
    "RSSI": PowerReceiver(*SIZE, TONES_HZ),
    "CSI": CsiReceiver(*SIZE, TONES_HZ),
}
"""Differentiable receiver models."""
FAMILIES: Mapping[str, Family] = {"random": ordinary, **HARD}
MOST_AT_ONCE = 60  # Gaussians of the random fields whose derivatives are compared


def splatted(gaussians: Gaussians, at: Pose, size: Size = SIZE) -> list[Any]:
    """Real and imaginary part of the image by splatting."""
    return list(splat(gaussians, at, perception_plane(*size, _type(gaussians))))


def rendered(gaussians: Gaussians, at: Pose, size: Size = SIZE) -> list[Any]:
    """Real and imaginary part of the image by ``mi.render``, or in float64 as the sum of all Gaussians on each ray."""
    from wrf_mi_plugins.shape import shape_parameters

    if _type(gaussians) == DOUBLE:
        directions = pixel_directions(*size).reshape(-1, 3)
        bundles = ray_bundles([to_device(column, DOUBLE) for column in directions.T], *size)
        footprints = ray_footprints(gaussians, at)
        lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
        return list(blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending))
    with dr.suspend_grad():
        scene = scene_of(gaussians, RECEIVER, *size)
    params = mi.traverse(scene)
    for name, values in shape_parameters(gaussians).items():
        params[f"gaussians.{name}"] = values
    params.update()
    channels = mi.render(scene, params).array
    return [dr.gather(mi.Float, channels, 2 * dr.arange(mi.UInt32, size[0] * size[1]) + k) for k in range(2)]


def _type(gaussians: Gaussians) -> Any:
    return type(gaussians.position[0])


def image(field: StressField, blending: str, size: Size, by: Callable[..., list[Any]] = splatted) -> FloatArray:
    """Complex image [height, width] in float32."""
    re, im = by(on_device(field, blending, mi.Float)[0], pose(mi.Float), size)
    return np.asarray((re.numpy().astype(float) + 1j * im.numpy()).reshape(size))


def image_row(
    what: str, families: Mapping[str, Family], count: int, size: Size = SIZE, by: Callable[..., list[Any]] = splatted
) -> Row:
    """Row of float32 images of ``count`` fields of each family, compared with float64 off the footprints' edges."""
    worst, edge, pixels, number = Worst(), 0, 0, 0
    for name, field, blending, _ in cases(families, count):
        expected, clear = truth(field, blending, size, on_rays=by is rendered)
        worst.add(relative((image(field, blending, size, by) - expected)[clear], expected), name)
        number, edge, pixels = number + 1, edge + int((~clear).sum()), pixels + clear.size
    more = f"; {edge / pixels:.1%} of the pixels lie on an edge and are left out"
    return worst.row(f"{what}, {number} cases", IMAGE, more)


def gradient_row(
    what: str, tried: Iterable[tuple[str, StressField, str, int]], observe: Observe = splatted, least: int = 1
) -> Row:
    """Row of derivatives of an observation in float32, compared with float64; fields of ``least`` Gaussians or more."""
    worst, number = Worst(), 0
    for name, field, blending, seed in tried:
        if len(field.signal) >= least:
            single, double = (gradient(field, blending, kind, seed, observe) for kind in (mi.Float, DOUBLE))
            for group, error in gradient_errors(single, double, felt_values(field, blending)):
                worst.add(error, f"{group}, {name}")
            number += 1
    return worst.row(f"{what}, {number} cases", GRADIENT)


def images(random: int, of_each: int) -> list[Row]:
    """Rows of splatted random fields, of each family of hard fields, and of 50,000 layers."""
    rows = [image_row("image, random fields", {"random": ordinary}, random)]
    rows += [image_row(f"image, {name}", {name: family}, of_each) for name, family in HARD.items()]
    return [*rows, image_row("image, 50,000 layers", {"layers": layers}, 1, SMALL)]


def gradients(of_each: int, names: Iterable[str] = tuple(HARD)) -> list[Row]:
    """Rows of derivatives of splatted images, of random fields and of families of hard fields."""
    chosen = {"random fields": _random, **{name: HARD[name] for name in names if name != "none"}}
    return [gradient_row(f"derivatives, {name}", cases({name: chosen[name]}, of_each)) for name in chosen]


def _random(rng: np.random.Generator) -> StressField:
    return made(MOST_AT_ONCE, rng)


def receivers(random: int, of_each: int, families: Iterable[str] = tuple(FAMILIES)) -> list[Row]:
    """Rows of the observations of `MODELS` of ``random`` random fields and ``of_each`` fields of each hard family."""
    worst, number = {what: Worst() for what in MODELS}, 0
    for family in families:
        for name, field, blending, _ in cases({family: FAMILIES[family]}, random if family == "random" else of_each):
            number += 1
            complete, clear = truth(field, blending, SIZE, sphere=True)
            expected = np.stack([complete.real, complete.imag]).reshape(2, -1) * clear.reshape(-1)
            plane, mask = perception_plane(*SIZE, mi.Float), to_device(clear.reshape(-1).astype(np.float32), mi.Float)
            field_on_sphere = learned_field(on_device(field, blending, mi.Float)[0], pose(mi.Float), plane, sphere=True)
            waves = float((np.tile(solid_angles(*SIZE), 2) * np.hypot(*expected)).sum()) or 1.0
            for what, model in MODELS.items():
                count = expected.shape[1] // (1 if model.sphere else 2)
                part = dr.arange(mi.UInt32, count)
                single = model(None, tuple(dr.gather(mi.Float, side * mask, part) for side in field_on_sphere))
                double = model(None, tuple(to_device(side[:count].copy(), DOUBLE) for side in expected))
                error = observation_error(model, single.numpy().astype(float), double.numpy(), waves)
                worst[what].add(error, name)
    return [each.row(f"receiver: {what}, {number} cases", IMAGE) for what, each in worst.items()]


def observation_error(model: Any, observation: FloatArray, expected: FloatArray, waves: float) -> float:
    """Error of an observation relative to its norm, or at an antenna to the sum of the waves' magnitudes."""
    if not isinstance(model, CsiReceiver):
        return relative(observation - expected, expected)
    if isinstance(model, PowerReceiver):
        observation, expected = 10 ** (observation / 20), 10 ** (expected / 20)
        waves = max(waves, float(expected.max()))
    return float(np.abs(observation - expected).max()) / waves


def receiver_gradients(
    of_each: int, names: Iterable[str] = tuple(MODELS), families: Iterable[str] = tuple(FAMILIES)
) -> list[Row]:
    """Rows of derivatives of the observations of `MODELS` by the Gaussians, ``of_each`` fields of each family."""
    rows = []
    for name in names:

        def observe(gaussians: Gaussians, at: Pose, model: Any = MODELS[name]) -> list[Any]:
            plane = perception_plane(*SIZE, _type(gaussians))
            return [model(None, learned_field(gaussians, at, plane, model.sphere))]

        # Instrument scaling cancels nearly all derivatives of a single Gaussian; rounding would remain.
        least = 2 if name == "scaled spectrum" else 1
        tried = cases({family: FAMILIES[family] for family in families}, of_each)
        rows.append(gradient_row(f"receiver: derivatives of {name}", tried, observe, least))
    return rows


def plugin(random: int, of_each: int, of_gradients: int, names: Iterable[str] = tuple(HARD)) -> list[Row]:
    """Rows of images through ``mi.render``, of random and hard fields and of one pixel, and of their derivatives."""
    hard = {name: family for name, family in HARD.items() if name != "none"}
    tried = {"random": _random, **{name: HARD[name] for name in names}}
    return [
        image_row("plugin: image, random fields", {"random": ordinary}, random, by=rendered),
        image_row(f"plugin: image, {len(hard)} kinds of hard fields", hard, of_each, by=rendered),
        image_row("plugin: image, one pixel", {"random": ordinary}, max(of_each, 5), (1, 1), rendered),
        gradient_row("plugin: derivatives", cases(tried, of_gradients), rendered),
    ]


PARTS: Sequence[tuple[Callable[..., list[Row]], tuple[Any, ...], tuple[Any, ...]]] = (
    (images, (1000, 25), (5, 1)),
    (gradients, (10,), (1, HARDEST)),
    (receivers, (50, 5), (2, 1)),
    (receiver_gradients, (2,), (1, ("spectrum", "RSSI"), ("random", *HARDEST[:1]))),
    (plugin, (50, 5, 2), (2, 1, 1, HARDEST[:1])),
)
"""Functions that make rows, with their arguments at full size and for few cases within a minute."""


def main() -> dict[str, Any]:
    """All rows at full size."""
    return {"rows": [row for part, full, _ in PARTS for row in part(*full)]}


def quick_rows() -> list[Row]:
    """A few cases of each row."""
    return [row for part, _, few in PARTS for row in part(*few)]


def quick() -> dict[str, Any]:
    """`quick_rows`; `BenchFailed` where a bound is not kept."""
    rows = quick_rows()
    if missed := [f"{row['what']}: {row['value']}, asked {row['asked']}" for row in rows if not held(row)]:
        raise BenchFailed(f"bench stress --quick: {'; '.join(missed)}")
    return {"rows": rows}
