"""The traced evaluation as a plain function: responses, lists, blending and derivatives."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from traced_fields import RECEIVER, any_field, blended, seen
from wrf_mi_plugins.acceleration import traced_lists
from wrf_mi_plugins.blend_rays import Walls, blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import hulls, ray_footprints
from wrf_mi_plugins.sensor import equirectangular_sphere

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Pose
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
DIRECTIONS = 3

Float64 = dr.float64_array_t(mi.Float)


def columns(values: np.ndarray, float_type: Any) -> list[Any]:
    return [on_device(c, float_type) for c in values.reshape(-1, values.shape[-1]).T]


def gaussians_of(field: dict[str, np.ndarray], blending: str, float_type: Any = Float64) -> Gaussians:
    own = {name: columns(values, float_type) for name, values in field.items()}
    product = blending == "product"
    return Gaussians(
        position=own["position"],
        scale=own["scale"],
        rotation=own["rotation"],
        signal=own["signal"],
        opacity=None if product else own["opacity"][0],
        attenuation=own["attenuation"] if product else None,
        batch=1,
    )


def pose_of(float_type: Any = Float64) -> Pose:
    return Pose(
        [dr.opaque(float_type, float(x)) for x in RECEIVER.position_m],
        [[dr.opaque(float_type, float(x)) for x in row] for row in RECEIVER.to_world],
    )


def bundles_of(directions: np.ndarray, float_type: Any = Float64) -> Any:
    return ray_bundles(columns(directions, float_type), *directions.shape[:2])


def brute(gaussians: Gaussians, pose: Pose, bundles: Any, walls: Walls | None = None) -> tuple[Any, Any]:
    """With lists that hold every Gaussian."""
    footprints = ray_footprints(gaussians, pose)
    lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
    return blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending, walls)


def image(parts: tuple[Any, Any]) -> np.ndarray:
    return parts[0].numpy().astype(float) + 1j * parts[1].numpy()


@pytest.mark.parametrize("blending", BLENDINGS)
@pytest.mark.parametrize("directions", [pixel_directions(90, 360)[::7, ::11], equirectangular_sphere(90, 360)[::9]])
def test_response_is_the_maximum_along_the_ray(blending, directions):
    """Against the definition: needles, discs, Gaussians behind and around the receiver; one and many rays a bundle."""
    field = any_field(60)
    found = image(brute(gaussians_of(field, blending), pose_of(), bundles_of(directions)))
    expected = blended(field, blending, directions).ravel()
    assert np.abs(found - expected).max() < FLOAT64_TOLERANCE * np.abs(expected).max()


@pytest.mark.parametrize("blending", BLENDINGS)
def test_response_without_lean_and_depth_equals_splatting(blending):
    """With k1 = k2 = 1 / L^2 = 0 the traced sum is the splatted one: same cut-off, low-pass and order."""
    field = any_field(80, size=0.1)
    gaussians, pose = gaussians_of(field, blending), pose_of()
    directions = pixel_directions(30, 120)
    footprints = ray_footprints(gaussians, pose)
    footprints.depth_extent = dr.zeros(Float64, gaussians.count)
    footprints.lean = tuple(dr.zeros(Float64, gaussians.count) for _ in range(2))
    bundles = bundles_of(directions)
    lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
    found = image(blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending))
    expected = image(splat(gaussians, pose, perception_plane(30, 120, Float64)))
    assert np.abs(found - expected).max() < 1e3 * FLOAT64_TOLERANCE * np.abs(expected).max()


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
    found = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
    np.testing.assert_array_equal(image(found), image(brute(gaussians, pose, bundles)))
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
    own = hulls(gaussians, pose, bundles.margin_rad)
    centre, radius, quaternion = (
        np.stack([c.numpy().astype(float) for c in part], 1) for part in (own.centre, own.radius, own.rotation)
    )
    axis = np.stack([c.numpy().astype(float) for c in bundles.axis], axis=1) @ RECEIVER.to_world.T
    whiten = np.swapaxes(rotation_matrix(quaternion), 1, 2) / radius[:, :, None]
    towards, along = np.einsum("nij,nj->ni", whiten, centre), np.einsum("nij,bj->bni", whiten, axis)
    t = np.maximum((towards * along).sum(-1) / (along**2).sum(-1), 0)
    far = np.linalg.norm(field["position"] - RECEIVER.position_m, axis=1) >= NEAR_M  # nearer ones are invisible
    met = (((towards - t[..., None] * along) ** 2).sum(-1) < 1) & far
    assert met.sum() > 50_000
    assert listed[met].all()


def test_float32_matches_float64():
    field = any_field(200, 2, 0.05)
    directions = pixel_directions(45, 180)
    single, double = (
        image(brute(gaussians_of(field, "alpha", f), pose_of(f), bundles_of(directions, f)))
        for f in (mi.Float, Float64)
    )
    # A ray on a cut-off may fall to either side in float32.
    off = np.abs(single - double) > 1e-3 * np.abs(double).max()
    assert off.mean() < 1e-3
    assert np.linalg.norm((single - double)[~off]) < FLOAT32_TOLERANCE * np.linalg.norm(double)


def test_invisible_and_faint_gaussians():
    """Only a Gaussian nearer than 5 cm: dark. One behind the receiver that contains it: exp(-L^2 / 2) in front."""
    directions = pixel_directions(90, 360)
    field = {name: values[:1].copy() for name, values in any_field(2).items()}
    field["position"][0] = RECEIVER.position_m + np.array([0.02, 0, 0])
    gaussians, pose, bundles = (
        gaussians_of(field, "alpha", mi.Float),
        pose_of(mi.Float),
        bundles_of(directions, mi.Float),
    )
    footprints = ray_footprints(gaussians, pose)
    lists = traced_lists(gaussians, footprints, pose, bundles)
    found = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
    assert not image(found).any()


@pytest.mark.gradcheck
@pytest.mark.parametrize("blending", BLENDINGS)
@pytest.mark.parametrize("with_walls", [False, True])
def test_derivatives(blending, with_walls):
    """Backward and forward against central differences in float64, for each parameter, the pose and the walls."""
    rng = np.random.default_rng(3)
    directions = pixel_directions(16, 48)
    bundles, rays = bundles_of(directions), 16 * 48
    field = {name: values for name, values in any_field(30, 4).items()}
    del field["opacity" if blending == "product" else "attenuation"]
    crossings = np.sort(rng.uniform(0.5, 8, (rays, 3)), axis=1).ravel()
    walls = {name: rng.normal(0, 0.6, rays * 4) for name in ("factor_re", "factor_im")} if with_walls else {}
    values = {**field, "place": RECEIVER.position_m.copy(), "turn": RECEIVER.to_world.copy(), **walls}
    weight = [Float64(rng.standard_normal(rays)) for _ in range(2)]

    def device(arrays: dict[str, np.ndarray]) -> dict[str, list[Any]]:
        flat = ("place", "turn", "factor_re", "factor_im")
        own = {n: columns(a, Float64) if n not in flat else [] for n, a in arrays.items()}
        own |= {n: [dr.opaque(Float64, float(x)) for x in arrays[n].ravel()] for n in ("place", "turn")}
        return own | {n: [Float64(arrays[n])] for n in walls}

    def loss(p: dict[str, list[Any]]) -> Any:
        gaussians = Gaussians(
            position=p["position"],
            scale=p["scale"],
            rotation=p["rotation"],
            signal=p["signal"],
            opacity=p["opacity"][0] if "opacity" in p else None,
            attenuation=p.get("attenuation"),
            batch=1,
        )
        own = Walls(Float64(crossings), p["factor_re"][0], p["factor_im"][0], 3) if with_walls else None
        re, im = brute(gaussians, Pose(p["place"], [p["turn"][i : i + 3] for i in (0, 3, 6)]), bundles, own)
        return dr.sum(re * weight[0] + im * weight[1])

    attached = device(values)
    dr.enable_grad(attached)
    dr.backward(loss(attached))
    gradient = {n: [np.broadcast_to(dr.grad(a).numpy(), dr.width(a)) for a in own] for n, own in attached.items()}

    def backward(step: dict[str, list[Any]]) -> float:
        return sum(float(g @ a.numpy()) for n in step for g, a in zip(gradient[n], step[n], strict=True))

    errors = {}
    for name, own in values.items():
        norm = np.sqrt(sum((g**2).sum() for g in gradient[name]))
        for k in range(DIRECTIONS):
            step = rng.standard_normal(own.shape)
            ends = [loss(device({**values, name: own + s * STEP * step}))[0] for s in (1, -1)]
            numeric, analytic = (ends[0] - ends[1]) / (2 * STEP), backward({name: device({**values, name: step})[name]})
            errors[name, k] = abs(numeric - analytic) / norm
    assert max(errors.values()) < GRADIENT_TOLERANCE, errors

    # Forward, along all parameters at once.
    steps, moved = device({n: rng.standard_normal(v.shape) for n, v in values.items()}), device(values)
    for name, arrays in moved.items():
        for array, slope in zip(arrays, steps[name], strict=True):
            dr.enable_grad(array)
            dr.set_grad(array, slope)
    result = loss(moved)
    dr.forward_to(result)
    expected = backward(steps)
    assert abs(float(dr.grad(result)[0]) - expected) < 1e3 * FLOAT64_TOLERANCE * abs(expected)


@pytest.mark.parametrize("blending", BLENDINGS)
def test_walls_attenuate_gaussians_behind_them(blending):
    """One crossing a ray: Gaussians whose strongest point lies behind it are multiplied, the others are not."""
    field = any_field(40, 5, 0.1)
    directions = pixel_directions(18, 40)
    rng = np.random.default_rng(6)
    rays = 18 * 40
    distance, factor = rng.uniform(0.5, 5, rays), rng.standard_normal((rays, 2)) @ [1, 1j]
    table = np.stack([np.ones(rays), factor], axis=1).ravel()
    walls = Walls(Float64(distance), Float64(table.real.copy()), Float64(table.imag.copy()), 1)
    found = image(brute(gaussians_of(field, blending), pose_of(), bundles_of(directions), walls))
    order, responses, peaks = seen(field, directions.reshape(-1, 3))
    through = np.where(peaks > distance, factor, 1)
    signal, delta = (field[name][order] @ [1, 1j] for name in ("signal", "attenuation"))
    expected, passed = 0, np.ones(rays, complex)
    for i, (g, w) in enumerate(zip(responses, through, strict=True)):
        alpha = field["opacity"][order[i], 0] * g
        product = blending == "product"
        expected = expected + (g if product else alpha) * signal[i] * w * passed
        passed = passed * ((1 - g * (1 - delta[i])) if product else 1 - alpha)
    assert np.abs(found - expected).max() < FLOAT64_TOLERANCE * np.abs(expected).max()


def test_gradients_match_splatting_for_small_gaussians():
    """Gradients of both ways agree as their images do: Gaussians of 1 degree, axes up to 2 : 1."""
    rng = np.random.default_rng(7)
    field = any_field(120, 8, 0.0)
    depth = np.linalg.norm(field["position"] - RECEIVER.position_m, axis=1)
    field["scale"] = np.maximum(np.radians(1.0) * depth[:, None] * rng.uniform(0.5, 1, (120, 3)), 1e-3)
    pose = pose_of()
    bundles, plane = bundles_of(pixel_directions(90, 360)), perception_plane(90, 360, Float64)
    weight = [Float64(rng.standard_normal(90 * 360)) for _ in range(2)]
    gradients = []
    for evaluate in (lambda g: brute(g, pose, bundles), lambda g: splat(g, pose, plane)):
        gaussians = gaussians_of(field, "alpha")
        own = [*gaussians.position, *gaussians.scale, *gaussians.signal, gaussians.opacity]
        dr.enable_grad(own)
        re, im = evaluate(gaussians)
        dr.backward(dr.sum(re * weight[0] + im * weight[1]))
        gradients.append([dr.grad(a).numpy() for a in own])
    for traced, splatted in zip(*gradients, strict=True):
        assert np.linalg.norm(traced - splatted) < SPLAT_GRADIENT_TOLERANCE * np.linalg.norm(splatted)


SPLAT_GRADIENT_TOLERANCE = 0.1
"""The slope of a footprint is off by as much as its size in angle, some per cent; that of its edge is left out."""
