"""Plugin integrator: ``mi.render`` compared with its definition in float64, values and derivatives.

The footprint here is the largest response on a ray; splatting takes the response in the tangent plane
(`wrf_mi_plugins.ray_response`). Both agree in the limit of small angles only, so each has a definition in NumPy.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from wrf_mi_plugins.blend_rays import blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import ray_footprints

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import pixel_directions, rotation_matrix
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M, depth_order
from wrf_mi.gaussians.parameters import Gaussians

from . import field_oracle
from . import stress_fields as fields
from .stress_rows import Row, Worst
from .traced import scene_of

FORWARD = 1e-3  # bound on the relative difference of forward from reverse mode


def plugin_images(random: int, of_each: int, many: int = 1) -> list[Row]:
    """Renders of random and of ill-conditioned fields, of one pixel and of 50,000 layers."""
    hard = {name: family for name, family in fields.HARD.items() if name != "none"}
    rows = [
        plugin_row("random fields", {"random": fields.ordinary}, random),
        plugin_row(f"{len(hard)} kinds of hard fields", hard, of_each),
        plugin_row("one pixel", {"random": fields.ordinary}, max(of_each, 5), (1, 1)),
    ]
    return [*rows, plugin_row("50,000 layers", {"layers": fields.layers}, many, fields.SMALL)] if many else rows


def plugin_row(what: str, families: Mapping[str, fields.Family], count: int, size: fields.Size = fields.SIZE) -> Row:
    """Row of renders of ``count`` fields of each family."""
    return fields.image_row(f"plugin: image, {what}", families, count, size, rendered, defined)


def rendered(field: fields.StressField, blending: str, size: fields.Size) -> fields.ComplexArray:
    """Image [height, width] by ``mi.render``."""
    scene = scene_of(fields.on_device(field, blending, mi.Float)[0], fields.RECEIVER, *size)
    parts = np.asarray(mi.render(scene).numpy(), float)
    return np.asarray(parts[..., 0] + 1j * parts[..., 1])


def defined(
    field: fields.StressField, blending: str, size: fields.Size
) -> tuple[fields.ComplexArray, NDArray[np.bool_]]:
    """Image [height, width] of each Gaussian's largest response on a ray, and a mask of rays off all edges."""
    offset = field.position_m - fields.RECEIVER.position_m
    depth = np.linalg.norm(offset, axis=1)
    x, y, z = field.position_m.T
    order = np.lexsort((z, y, x, depth))
    order = order[depth[order] >= NEAR_M]
    rays = pixel_directions(*size) @ fields.RECEIVER.to_world.T
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
        clear &= fields.off_edges(square, cosine)
    if blending == "alpha":
        return field_oracle.blend_alpha(responses, field.signal[order], field.opacity[order]), clear
    return field_oracle.blend_product(responses, field.signal[order], field.attenuation[order]), clear


def plugin_gradients(of_each: int, names: Iterable[str] = tuple(fields.HARD)) -> list[Row]:
    """Derivatives through ``mi.render`` compared with the same sum in float64, and forward with reverse mode."""
    families: dict[str, fields.Family] = {
        "random": lambda rng: fields.made(60, rng),
        **{name: fields.HARD[name] for name in names},
    }
    forward = Worst()

    def single(field: fields.StressField, blending: str, seed: int) -> dict[str, FloatArray]:
        slopes, error = _through_render(field, blending, seed)
        forward.add(error)
        return slopes

    row = fields.gradient_row("plugin: derivatives", fields.cases(families, of_each), _summed, single)
    count = row["what"].rpartition(", ")[2]
    return [row, forward.row(f"plugin: derivatives forward against backward, {count}", FORWARD)]


def _summed(gaussians: Gaussians, pose: Pose) -> list[Any]:
    """Image as the sum of all Gaussians on each ray, without lists."""
    kind: Any = type(gaussians.position[0])
    directions = pixel_directions(*fields.SIZE).reshape(-1, 3)
    bundles = ray_bundles([to_device(column, kind) for column in directions.T], *fields.SIZE)
    footprints = ray_footprints(gaussians, pose)
    lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
    parts = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
    return list(parts)


def _through_render(field: fields.StressField, blending: str, seed: int) -> tuple[dict[str, FloatArray], float]:
    """Derivatives by group of parameters, and the relative error of forward mode along a random step."""
    from wrf_mi_plugins.shape import shape_parameters

    gaussians, parts = fields.on_device(field, blending, mi.Float)
    scene = scene_of(gaussians, fields.RECEIVER, *fields.SIZE)
    params = mi.traverse(scene)
    rng = np.random.default_rng(seed)
    weight = [rng.normal(size=fields.SIZE).astype(np.float32) for _ in range(2)]
    weights = to_tensor(np.stack(weight, axis=-1))

    def render() -> Any:
        for name, values in shape_parameters(gaussians).items():
            params[f"gaussians.{name}"] = values
        params.update()
        return mi.render(scene, params)

    def gradients() -> dict[str, FloatArray]:
        return {name: np.stack([dr.grad(a).numpy().astype(float) for a in part], 1) for name, part in parts.items()}

    leaves = [a for part in parts.values() for a in part]
    for array in leaves:
        dr.enable_grad(array)
    dr.backward(dr.sum(render() * weights, axis=None))
    slopes = gradients()

    for array in leaves:
        dr.clear_grad(array)
        # Steps are relative, as sizes span nine decades.
        size = np.abs(dr.detach(array).numpy().astype(float))
        dr.set_grad(array, to_float(size * rng.normal(size=size.shape)))
    steps = gradients()
    tangent = np.asarray(dr.forward_to(render(), flags=dr.ADFlag.ClearEdges).numpy(), float)
    terms = [float((slopes[name] * steps[name]).sum()) for name in slopes]
    largest = max(float(np.linalg.norm(slopes[name] * steps[name])) for name in slopes)
    along = float((tangent * np.stack(weight, axis=-1)).sum())
    if not np.isfinite(tangent).all():
        return slopes, float("nan")
    return slopes, abs(along - sum(terms)) / (largest or 1.0)
