"""The traced evaluation as a plain function: responses, lists, blending and derivatives."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from made_fields import off_edges
from traced_fields import RECEIVER, any_field, blended, brute, bundles_of, gaussians_of, pose_of, seen
from wrf_mi_plugins.acceleration import traced_lists
from wrf_mi_plugins.blend_rays import Walls, blend_rays
from wrf_mi_plugins.ray_response import hulls, ray_footprints
from wrf_mi_plugins.sensor import equirectangular_sphere

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64, Pose
from wrf_mi.core import pixel_directions, rotation_matrix
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.footprint import NEAR_M, depth_order
from wrf_mi.gaussians.tiles import perception_plane

BLENDINGS = ["alpha", "product"]
FLOAT64_TOLERANCE = 1e-12
"""The same value by other arithmetic."""
FLOAT32_TOLERANCE = 1e-4
"""As for splatting: float32 rounding of some ten operations."""
STEP = 1e-7
"""Of central differences in float64: no ray crosses a cut-off or a wall, where the field jumps."""
GRADIENT_TOLERANCE = 1e-7
"""Error of a derivative along a direction of standard normal numbers, relative to the gradient's norm: the standard
deviation of such derivatives. Rounding of differences is a tenth of it."""


def image(parts: tuple[Any, Any]) -> np.ndarray:
    return parts[0].numpy().astype(float) + 1j * parts[1].numpy()


def rows(parts: list[Any]) -> np.ndarray:
    return np.stack([part.numpy().astype(float) for part in parts], axis=1)


def assert_close(actual: np.ndarray, expected: np.ndarray, tolerance: float = FLOAT64_TOLERANCE) -> None:
    assert np.abs(actual - expected).max() < tolerance * np.abs(expected).max()


@pytest.mark.parametrize("blending", BLENDINGS)
@pytest.mark.parametrize("directions", [pixel_directions(90, 360)[::7, ::11], equirectangular_sphere(90, 360)[::9]])
def test_response_is_the_maximum_along_the_ray(blending, directions):
    """Against the definition: needles, discs, Gaussians behind and around the receiver; one and many rays a bundle."""
    field = any_field(60)
    traced = image(brute(gaussians_of(field, blending), pose_of(), bundles_of(directions)))
    assert_close(traced, blended(field, blending, directions).ravel())


@pytest.mark.parametrize("blending", BLENDINGS)
def test_response_without_lean_and_depth_equals_splatting(blending):
    """With k1 = k2 = 1 / L^2 = 0 the traced sum is the splatted one: same cut-off, low-pass and order."""
    gaussians, pose = gaussians_of(any_field(80, size=0.1), blending), pose_of()
    footprints, zeros = ray_footprints(gaussians, pose), dr.zeros(Float64, gaussians.count)
    footprints.depth_extent, footprints.lean = zeros, (zeros, zeros)
    traced = image(brute(gaussians, pose, bundles_of(pixel_directions(30, 120)), footprints=footprints))
    assert_close(traced, image(splat(gaussians, pose, perception_plane(30, 120, Float64))), 1e3 * FLOAT64_TOLERANCE)


@pytest.mark.parametrize(("size", "shape"), [(0.02, (90, 360)), (0.3, (90, 360)), (0.1, (12, 31))])
def test_traced_lists_are_complete(size, shape):
    """Lists from the BVH give bit for bit what lists of all Gaussians give; no entry comes twice."""
    field = any_field(1500, 1, size)
    # Coincident Gaussians: each entry and exit is shared.
    for name in ("position", "scale", "rotation"):
        field[name][100:105] = field[name][100]
    gaussians, pose = gaussians_of(field, "product", mi.Float), pose_of(mi.Float)
    bundles = bundles_of(pixel_directions(*shape), mi.Float)
    footprints = ray_footprints(gaussians, pose)
    lists = traced_lists(gaussians, footprints, pose, bundles)
    traced = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
    np.testing.assert_array_equal(image(traced), image(brute(gaussians, pose, bundles)))
    begin, end, index = lists.begin.numpy(), lists.end.numpy(), lists.index.numpy()
    rank = np.empty(1500, int)
    rank[depth_order(footprints.depth, gaussians.position).numpy()] = np.arange(1500)
    assert begin[0] == 0
    assert end[-1] == len(index)
    np.testing.assert_array_equal(begin[1:], end[:-1])
    assert all((np.diff(rank[index[a:b]]) > 0).all() for a, b in zip(begin, end, strict=True))
    if size == 0.02:  # and they leave out most of the others
        assert len(index) < 0.2 * 1500 * len(begin)


def test_traced_lists_of_overlapping_gaussians_are_complete():
    """Tens of thousands of hits: some share their entry with another, and only the way back finds them."""
    field = any_field(2000)
    gaussians, pose = gaussians_of(field, "alpha", mi.Float), pose_of(mi.Float)
    bundles = bundles_of(pixel_directions(90, 360), mi.Float)
    lists = traced_lists(gaussians, ray_footprints(gaussians, pose), pose, bundles)
    count = len(lists.begin.numpy())
    listed = np.zeros((count, 2000), bool)
    listed[np.repeat(np.arange(count), (lists.end - lists.begin).numpy().astype(int)), lists.index.numpy()] = True
    # The distance of each bundle's axis from each ellipsoid's centre, in its semi-axes.
    ellipsoids, axis = hulls(gaussians, pose, bundles.margin_rad), rows(bundles.axis) @ RECEIVER.to_world.T
    whiten = np.swapaxes(rotation_matrix(rows(ellipsoids.rotation)), 1, 2) / rows(ellipsoids.radius)[:, :, None]
    towards, along = np.einsum("nij,nj->ni", whiten, rows(ellipsoids.centre)), np.einsum("nij,bj->bni", whiten, axis)
    t = np.maximum((towards * along).sum(-1) / (along**2).sum(-1), 0)
    far = np.linalg.norm(field["position"] - RECEIVER.position_m, axis=1) >= NEAR_M  # nearer ones are invisible
    met = (((towards - t[..., None] * along) ** 2).sum(-1) < 1) & far
    assert met.sum() > 50_000
    assert listed[met].all()


def test_float32_matches_float64():
    field, directions = any_field(200, 2, 0.05), pixel_directions(45, 180)
    single, double = (
        image(brute(gaussians_of(field, "alpha", f), pose_of(f), bundles_of(directions, f)))
        for f in (mi.Float, Float64)
    )
    share_off, error = off_edges(single, double)
    assert share_off < 1e-3
    assert error < FLOAT32_TOLERANCE


def test_gaussians_nearer_than_the_limit_are_invisible():
    field = {name: values[:1].copy() for name, values in any_field(2).items()}
    field["position"][0] = RECEIVER.position_m + np.array([0.02, 0, 0])
    gaussians, pose = gaussians_of(field, "alpha", mi.Float), pose_of(mi.Float)
    bundles, footprints = bundles_of(pixel_directions(90, 360), mi.Float), ray_footprints(gaussians, pose)
    lists = traced_lists(gaussians, footprints, pose, bundles)
    assert not image(blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)).any()


@pytest.mark.gradcheck
@pytest.mark.parametrize("blending", BLENDINGS)
@pytest.mark.parametrize("with_walls", [False, True])
def test_derivatives(blending, with_walls):
    """Backward and forward against central differences in float64, for each parameter, the pose and the walls."""
    rng, directions, rays = np.random.default_rng(3), pixel_directions(16, 48), 16 * 48
    bundles, field = bundles_of(directions), any_field(30, 4)
    del field["opacity" if blending == "product" else "attenuation"]
    crossings = np.sort(rng.uniform(0.5, 8, (rays, 3)), axis=1).ravel()
    walls = {name: rng.normal(0, 0.6, (rays * 4, 1)) for name in ("factor_re", "factor_im")} if with_walls else {}
    pose = {"place": RECEIVER.position_m[None], "turn": RECEIVER.to_world.reshape(1, 9)}
    values = {**field, **pose, **walls}
    weight = [Float64(rng.standard_normal(rays)) for _ in range(2)]

    def on_columns(arrays: dict[str, np.ndarray]) -> dict[str, list[Any]]:
        # Aligned, and opaque where they are single numbers: one kernel serves all values.
        columns = {name: [on_device(column, Float64) for column in array.T] for name, array in arrays.items()}
        dr.make_opaque(columns)
        return columns

    def loss(p: dict[str, list[Any]]) -> Any:
        of_gaussians = {name: p[name] for name in ("position", "scale", "rotation", "signal")}
        opacity = p["opacity"][0] if "opacity" in p else None
        gaussians = Gaussians(**of_gaussians, opacity=opacity, attenuation=p.get("attenuation"), batch=1)
        behind = Walls(Float64(crossings), p["factor_re"][0], p["factor_im"][0], 3) if with_walls else None
        re, im = brute(gaussians, Pose(p["place"], [p["turn"][i : i + 3] for i in (0, 3, 6)]), bundles, behind)
        return dr.sum(re * weight[0] + im * weight[1])

    attached = on_columns(values)
    dr.enable_grad(attached)
    dr.backward(loss(attached))
    gradient = {
        name: np.stack([np.broadcast_to(dr.grad(a).numpy(), dr.width(a)) for a in arrays], axis=1)
        for name, arrays in attached.items()
    }
    errors = {}
    for name, array in values.items():
        step = rng.standard_normal(array.shape)
        ends = [loss(on_columns({**values, name: array + s * STEP * step}))[0] for s in (1, -1)]
        numeric, analytic = (ends[0] - ends[1]) / (2 * STEP), (gradient[name] * step).sum()
        errors[name] = abs(numeric - analytic) / np.linalg.norm(gradient[name])
    assert max(errors.values()) < GRADIENT_TOLERANCE, errors

    # Forward, along all parameters at once.
    steps, attached = {name: rng.standard_normal(array.shape) for name, array in values.items()}, on_columns(values)
    dr.enable_grad(attached)
    for name, slopes in on_columns(steps).items():
        for array, slope in zip(attached[name], slopes, strict=True):
            dr.set_grad(array, slope)
    result = loss(attached)
    dr.forward_to(result)
    expected = sum((gradient[name] * step).sum() for name, step in steps.items())
    assert abs(float(dr.grad(result)[0]) - expected) < 1e3 * FLOAT64_TOLERANCE * abs(expected)


@pytest.mark.parametrize("blending", BLENDINGS)
def test_walls_attenuate_gaussians_behind_them(blending):
    """One crossing a ray: Gaussians whose strongest point lies behind it are multiplied, the others are not."""
    field, directions, rays, rng = any_field(40, 5, 0.1), pixel_directions(18, 40), 18 * 40, np.random.default_rng(6)
    distance, factor = rng.uniform(0.5, 5, rays), rng.standard_normal((rays, 2)) @ [1, 1j]
    table = np.stack([np.ones(rays), factor], axis=1).ravel()
    walls = Walls(Float64(distance), Float64(table.real.copy()), Float64(table.imag.copy()), 1)
    traced = image(brute(gaussians_of(field, blending), pose_of(), bundles_of(directions), walls))
    order, responses, peaks = seen(field, directions.reshape(-1, 3))
    signal, delta = (field[name][order] @ [1, 1j] for name in ("signal", "attenuation"))
    expected, passed = np.zeros(rays, complex), np.ones(rays, complex)
    for i, (g, w) in enumerate(zip(responses, np.where(peaks > distance, factor, 1), strict=True)):
        alpha, product = field["opacity"][order[i], 0] * g, blending == "product"
        expected = expected + (g if product else alpha) * signal[i] * w * passed
        passed = passed * ((1 - g * (1 - delta[i])) if product else 1 - alpha)
    assert_close(traced, expected)
