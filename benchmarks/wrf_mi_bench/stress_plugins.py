"""The plugin integrator under stress: ``mi.render`` against the definition in float64, forwards and backwards.

The footprint here is the largest response on a ray; splatting takes the one in the tangent plane
(`wrf_mi.gaussians.ray_response`). Both are the same in the limit of small angles alone, so each is held against its
own definition in NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.core import pixel_directions, rotation_matrix
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians import oracle
from wrf_mi.gaussians.blend_rays import blend_rays
from wrf_mi.gaussians.bundles import all_lists, ray_bundles
from wrf_mi.gaussians.footprint import Pose, depth_order
from wrf_mi.gaussians.footprint_constants import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.ray_response import ray_footprints

from .stress_fields import (
    BLENDINGS,
    HARD,
    ON_THE_EDGE,
    RECEIVER,
    ComplexArray,
    Field,
    felt_values,
    gradient,
    layers,
    made,
    on_device,
)
from .stress_rows import IMAGE, GradientWorst, Row, Worst, relative
from .traced import scene_of

SIZE = (30, 60)
SMALL = (8, 16)
DOUBLE: Any = dr.float64_array_t(mi.Float)
Family = Callable[[np.random.Generator], Field]


def _ordinary(rng: np.random.Generator) -> Field:
    return made(int(rng.integers(1, 100)), rng)


def plugin_images(random: int, of_each: int, many: int = 1) -> list[Row]:
    """Renders of random and of hard fields, of one pixel and of 50,000 layers."""
    rows = [_images("random fields", [_ordinary], random, SIZE)]
    hard = [family for name, family in HARD.items() if name != "none"]
    rows.append(_images(f"{len(hard)} kinds of hard fields", hard, of_each, SIZE, tuple(HARD)))
    rows.append(_images("one pixel", [_ordinary], max(of_each, 5), (1, 1)))
    return [*rows, _images("50,000 layers", [layers], many, SMALL)] if many else rows


def _images(
    what: str, families: Iterable[Family], count: int, size: tuple[int, int], names: tuple[str, ...] = ()
) -> Row:
    worst, edge, pixels, cases = Worst(), 0, 0, 0
    for number, family in enumerate(families):
        for seed in range(count):
            field = family(np.random.default_rng(seed))
            responses, order, clear = _responses(field, size)
            for blending in BLENDINGS:
                truth = _blended(field, blending, responses, order)
                found = rendered(field, blending, size)
                where = names[number] if names else ""
                error = relative((found - truth)[clear], truth) if np.isfinite(found).all() else np.nan
                worst.add(error, where)
                cases, edge, pixels = cases + 1, edge + int((~clear).sum()), pixels + truth.size
    more = f"; {edge / pixels:.1%} of the pixels lie on an edge and are left out"
    return worst.row(f"plugin: image, {what}, {cases} cases", IMAGE, more)


def rendered(field: Field, blending: str, size: tuple[int, int]) -> ComplexArray:
    """By ``mi.render``, [height, width]."""
    scene = scene_of(on_device(field, blending, mi.Float)[0], RECEIVER, *size)
    parts = np.asarray(mi.render(scene).numpy(), float)
    return np.asarray(parts[..., 0] + 1j * parts[..., 1])


def _responses(field: Field, size: tuple[int, int]) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    """By the definition: of each Gaussian, near to far, the largest response on each ray; and rays on no edge."""
    offset = field.position_m - RECEIVER.position_m
    depth = np.linalg.norm(offset, axis=1)
    x, y, z = field.position_m.T
    order = np.lexsort((z, y, x, depth))
    order = order[depth[order] >= NEAR_M]
    rays = pixel_directions(*size) @ RECEIVER.to_world.T
    turn = rotation_matrix(field.rotation)
    responses, clear = np.zeros((len(order), *size)), np.ones(size, bool)
    for row, i in enumerate(order):
        scale = np.sqrt(field.scale_m[i] ** 2 + (LOW_PASS_RAD * depth[i]) ** 2)
        whiten = turn[i].T / scale[:, None]
        centre, along = whiten @ offset[i], rays @ whiten.T
        t = np.maximum((along @ centre) / (along**2).sum(-1), 0)
        square = ((t[..., None] * along - centre) ** 2).sum(-1)
        cosine = rays @ (offset[i] / depth[i])
        responses[row] = np.where((square < CUTOFF**2) & (cosine > MIN_COSINE), np.exp(-square / 2), 0)
        clear &= (np.abs(np.sqrt(square) - CUTOFF) > ON_THE_EDGE * CUTOFF) | (cosine < MIN_COSINE / 2)
        clear &= np.abs(cosine - MIN_COSINE) > ON_THE_EDGE * MIN_COSINE
    return responses, order, clear


def _blended(field: Field, blending: str, responses: FloatArray, order: NDArray[np.int64]) -> ComplexArray:
    if blending == "alpha":
        return oracle.blend_alpha(responses, field.signal[order], field.opacity[order])
    return oracle.blend_product(responses, field.signal[order], field.attenuation[order])


def plugin_gradients(of_each: int, names: Iterable[str] = tuple(HARD)) -> list[Row]:
    """Derivatives through ``mi.render`` against those of the same sum in float64; its forward mode is the reverse's."""
    worst, forward, cases = GradientWorst(), Worst(), 0
    families: dict[str, Family] = {"random": lambda rng: made(60, rng), **{name: HARD[name] for name in names}}
    for name, family in families.items():
        for seed in range(of_each):
            field = family(np.random.default_rng(seed))
            if not len(field.signal):
                continue
            for blending in BLENDINGS:
                cases += 1
                single, apart = _through_render(field, blending, seed)
                worst.add(
                    single, gradient(field, blending, SIZE, DOUBLE, seed, _summed), felt_values(field, blending), name
                )
                forward.add(apart, name)
    return [
        worst.row(f"plugin: derivatives, {cases} cases"),
        forward.row(f"plugin: derivatives forward against backward, {cases} cases", 1e-3),
    ]


def _summed(gaussians: Gaussians, pose: Pose) -> list[Any]:
    """Every ray meets every Gaussian: no lists that could lack one."""
    kind: Any = type(gaussians.position[0])
    directions = pixel_directions(*SIZE).reshape(-1, 3)
    bundles = ray_bundles([to_device(column, kind) for column in directions.T], *SIZE)
    footprints = ray_footprints(gaussians, pose)
    lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
    parts = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
    return list(parts)


def _through_render(field: Field, blending: str, seed: int) -> tuple[dict[str, FloatArray], float]:
    """Derivatives by group of parameters, and by how much forward mode along a random step is off.

    The shape's quaternions are of length one; derivatives are by the field's own.
    """
    from wrf_mi_plugins.shape import shape_parameters

    gaussians, parts = on_device(field, blending, mi.Float)
    scene = scene_of(gaussians, RECEIVER, *SIZE)
    params = mi.traverse(scene)
    rng = np.random.default_rng(seed)
    weight = [rng.normal(size=SIZE).astype(np.float32) for _ in range(2)]
    weights = to_tensor(np.stack(weight, axis=-1))

    def render() -> Any:
        for name, values in shape_parameters(gaussians).items():
            params[f"gaussians.{name}"] = values
        params.update()
        return mi.render(scene, params)

    leaves = [a for part in parts.values() for a in part]
    for array in leaves:
        dr.enable_grad(array)
    dr.backward(dr.sum(render() * weights, axis=None))
    slopes = {name: np.stack([dr.grad(a).numpy().astype(float) for a in part], 1) for name, part in parts.items()}

    for array in leaves:
        dr.clear_grad(array)
        # Each parameter by a share of itself: sizes of 1e-6 and 1e3 cannot take one step.
        own = np.abs(dr.detach(array).numpy().astype(float))
        dr.set_grad(array, to_float(own * rng.normal(size=own.shape)))
    steps = {name: np.stack([dr.grad(a).numpy().astype(float) for a in part], 1) for name, part in parts.items()}
    tangent = np.asarray(dr.forward_to(render(), flags=dr.ADFlag.ClearEdges).numpy(), float)
    terms = [float((slopes[name] * steps[name]).sum()) for name in slopes]
    size = max(float(np.linalg.norm(slopes[name] * steps[name])) for name in slopes)
    along = float((tangent * np.stack(weight, axis=-1)).sum())
    if not np.isfinite(tangent).all():
        return slopes, float("nan")
    return slopes, abs(along - sum(terms)) / (size or 1.0)
