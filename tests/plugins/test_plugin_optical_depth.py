"""Optical depth of Gaussians in closed form, their extinction, its cells and its bound, against NumPy and SciPy."""

import itertools
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from made_fields import device_gaussians
from scipy.integrate import quad
from scipy.optimize import minimize
from wrf_mi_plugins.extinction_cells import MARGIN, TIGHT, largest_extinction, make_cells, to_device
from wrf_mi_plugins.optical_depth import CENTRE_LINE, LEAST_PASSED, attenuators, extinction, on_host, optical_depth

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import rotation_matrix
from wrf_mi.gaussians import Gaussians
from wrf_mi.gaussians.footprint import CUTOFF

QUADRATURE_TOLERANCE = 1e-9
"""What SciPy's quadrature is asked for, relative and absolute."""
FLOAT64_TOLERANCE = 1e-12
"""The same arithmetic in another order."""
FLOAT32_TOLERANCE = 1e-4
"""Coordinates of some metres are exact to 2e-7 m, and scales here are 0.01 m or more."""
GRADIENT_TOLERANCE = 1e-6
"""Central differences in float64 with a step of 1e-6 are good to 1e-8 or better."""


def random_values(n: int, rng: np.random.Generator, scale_m: tuple[float, float] = (0.2, 0.8)) -> dict[str, Any]:
    """Gaussians as NumPy arrays, within two metres of the origin."""
    return {
        "position": rng.uniform(-2, 2, (3, n)),
        "scale": np.exp(rng.uniform(np.log(scale_m[0]), np.log(scale_m[1]), (3, n))),
        "rotation": rng.standard_normal((4, n)),
        "opacity": rng.uniform(0.05, 0.95, n),
    }


def gaussians(values: dict[str, Any], float_type: Any = Float64) -> Gaussians:
    """Without what belongs to the rays; an attenuation takes the place of the opacity."""
    blend = "attenuation" if "attenuation" in values else "opacity"
    field_values = {name: values[name] for name in ("position", "scale", "rotation", blend)}
    return device_gaussians(float_type, **field_values, signal=np.zeros(1, complex))


def vectors(v: np.ndarray, float_type: Any = Float64) -> list[Any]:
    return [on_device(x, float_type) for x in np.atleast_2d(v).T]


def depths(of: Any, origin: Any, direction: Any, near: Any = 0.0, far: Any = np.inf, kind: Any = Float64) -> np.ndarray:
    """Of Gaussians, or of their attenuators, along rays."""
    of = attenuators(of) if isinstance(of, Gaussians) else of
    ends = (on_device(np.atleast_1d(end), kind) for end in (near, far))
    return optical_depth(of, vectors(origin, kind), vectors(direction, kind), *ends).numpy()


def units(n: int, rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal((n, 3))
    return v / np.linalg.norm(v, axis=1)[:, None]


def oracle_extinction(values: dict[str, Any], x: np.ndarray, d: np.ndarray) -> float:
    """The definition, with precision matrices."""
    turn = rotation_matrix(values["rotation"].T)
    precision = turn @ (np.swapaxes(turn, 1, 2) / values["scale"].T[:, :, None] ** 2)
    offset = x - values["position"].T
    square = np.einsum("ni,nij,nj->n", offset, precision, offset)
    weight = -np.log1p(-values["opacity"]) * np.sqrt(d @ precision @ d) / np.sqrt(2 * np.pi) / CENTRE_LINE
    return float(np.where(square < CUTOFF**2, weight * np.exp(-square / 2), 0).sum())


def cut_offs(values: dict[str, Any], o: np.ndarray, d: np.ndarray) -> list[float]:
    """Distances at which a line enters or leaves a Gaussian's cut-off."""
    whiten = np.swapaxes(rotation_matrix(values["rotation"].T), 1, 2) / values["scale"].T[:, :, None]
    p, q = np.einsum("nij,nj->ni", whiten, o - values["position"].T), whiten @ d
    b, c = (p * q).sum(1) / (q * q).sum(1), ((p * p).sum(1) - CUTOFF**2) / (q * q).sum(1)
    root = np.sqrt((b * b - c)[b * b > c])
    return [*(-b[b * b > c] - root), *(-b[b * b > c] + root)]


def test_closed_form_matches_the_integral():
    """From outside and inside, short and endless pieces, several Gaussians at a time."""
    rng = np.random.default_rng(0)
    values = random_values(4, rng)
    origin = rng.uniform(-2.5, 2.5, (12, 3))
    aim = values["position"].T[np.arange(12) % 4] + rng.normal(0, 0.3, (12, 3))
    direction = (aim - origin) / np.linalg.norm(aim - origin, axis=1)[:, None]
    near, far = rng.uniform(0, 1, 12), rng.uniform(1.5, 6, 12)
    far[::3] = np.inf
    closed = depths(gaussians(values), origin, direction, near, far)
    asked = {"epsabs": QUADRATURE_TOLERANCE, "epsrel": QUADRATURE_TOLERANCE}
    for o, d, a, b, depth in zip(origin, direction, near, far, closed, strict=True):
        end = min(b, 20.0)
        edges = sorted({a, end, *(t for t in cut_offs(values, o, d) if a < t < end)})
        integral = sum(
            quad(lambda t, o=o, d=d: oracle_extinction(values, o + t * d, d), *piece, **asked)[0]
            for piece in itertools.pairwise(edges)
        )
        assert depth == pytest.approx(integral, abs=10 * QUADRATURE_TOLERANCE)
    assert (closed > 0.01).sum() > 6


@pytest.mark.parametrize("scale", [(0.3, 0.3, 0.3), (0.005, 0.005, 2.0), (0.001, 1.0, 3.0)])
@pytest.mark.parametrize("opacity", [0.0, 0.3, 0.999999])
@pytest.mark.parametrize("single", [True, False])
def test_depth_through_the_centre_follows_from_opacity(scale, opacity, single):
    """1 - alpha = exp(-optical depth), from every direction and for every shape; half of it from the centre on."""
    rng = np.random.default_rng(1)
    values = random_values(1, rng) | {"scale": np.array(scale)[:, None], "opacity": np.array([opacity])}
    direction, kind = units(50, rng), mi.Float if single else Float64
    # An alpha next to one is 1 - 1e-6 to 6 % in float32, and a centre 4 m away is a hundredth of 1 mm off.
    tolerance = (0.06 if opacity > 0.9 else 1e-3) if single else 1e-9
    for distance_m, share in ((4, 1.0), (0, 0.5)):
        origin = values["position"].T - distance_m * direction
        depth = depths(gaussians(values, kind), origin, direction, kind=kind)
        np.testing.assert_allclose(depth, -share * np.log1p(-opacity), atol=tolerance)


def test_depth_is_additive_and_reciprocal():
    rng = np.random.default_rng(3)
    of = gaussians(random_values(8, rng))
    origin, direction = rng.uniform(-2, 2, (30, 3)), units(30, rng)
    depth = depths(of, origin, direction, 0, 5)
    in_two = depths(of, origin, direction, 0, 1.3) + depths(of, origin, direction, 1.3, 5)
    for other in (in_two, depths(of, origin + 5 * direction, -direction, 0, 5)):
        np.testing.assert_allclose(depth, other, atol=FLOAT64_TOLERANCE)


def test_single_precision():
    """Needles and discs of 1 cm among others, and logarithms where the transmittance underflows."""
    rng = np.random.default_rng(4)
    values = random_values(300, rng, scale_m=(0.01, 1.0))
    values["scale"][:, :150] = 0.8
    # Opacities next to one are themselves not exact in float32: 5 % of 1e-6.
    values["opacity"][:150] = 0.999999
    values["opacity"] = values["opacity"].astype(np.float32).astype(float)
    direction = units(500, rng)
    single, double = (
        depths(gaussians(values, kind), np.full((1, 3), 0.3), direction, kind=kind) for kind in (mi.Float, Float64)
    )
    assert double.max() > 200  # exp(-200) is 0 in float32
    np.testing.assert_allclose(single, double, rtol=FLOAT32_TOLERANCE, atol=FLOAT32_TOLERANCE)


@pytest.mark.gradcheck
@pytest.mark.parametrize("product", [False, True])
def test_gradients(product):
    """Backwards and forwards with respect to everything, against central differences."""
    rng = np.random.default_rng(5)
    values = random_values(6, rng)
    if product:
        values["attenuation"] = rng.uniform(0.2, 0.8, 6) * np.exp(1j * rng.uniform(0, 6, 6))
        del values["opacity"]
    values |= {"origin": rng.uniform(-3, 3, (3, 15)), "far": rng.uniform(1, 6, 15)}
    endless = Float64(np.where(np.arange(15) % 3 == 0, np.inf, 0))
    direction, weight = vectors(units(15, rng)), Float64(rng.standard_normal(15))

    def leaves_of(v: dict[str, Any]) -> tuple[Gaussians, list[Any]]:
        g = gaussians(v)
        blend = g.attenuation or [g.opacity]
        return g, [*g.position, *g.scale, *g.rotation, *blend, *vectors(v["origin"].T), Float64(v["far"])]

    def loss(v: dict[str, Any], grad: bool = False) -> tuple[Any, list[Any]]:
        g, leaves = leaves_of(v)
        if grad:
            dr.enable_grad(leaves)
        depth = optical_depth(attenuators(g), leaves[-4:-1], direction, Float64(0), leaves[-1] + endless)
        return dr.sum(depth * weight), leaves

    change = {
        key: rng.standard_normal(v.shape) + (1j * rng.standard_normal(v.shape) if np.iscomplexobj(v) else 0)
        for key, v in values.items()
    }
    ends = [loss({key: v + step * change[key] for key, v in values.items()})[0][0] for step in (1e-6, -1e-6)]
    expected, (_, tangents) = (ends[0] - ends[1]) / 2e-6, leaves_of(change)
    value, leaves = loss(values, grad=True)
    dr.backward(value)
    backward = sum(dr.sum(leaf.grad * tangent)[0] for leaf, tangent in zip(leaves, tangents, strict=True))
    value, leaves = loss(values, grad=True)
    for leaf, tangent in zip(leaves, tangents, strict=True):
        dr.set_grad(leaf, tangent)
    for slope in (backward, dr.forward_to(value)[0]):
        assert slope == pytest.approx(expected, rel=GRADIENT_TOLERANCE)
    assert abs(expected) > 0.1


@pytest.mark.gradcheck
@pytest.mark.parametrize("name", ["position", "scale", "opacity", "origin"])
def test_forward_gradients_of_single_parameters(name):
    """With 5 Gaussians, 20 rays and all else constant: widths in the loop stay apart."""
    rng = np.random.default_rng(10)
    values = random_values(5, rng) | {"origin": rng.uniform(-1, 1, (3, 20))}
    direction, change = vectors(units(20, rng)), rng.standard_normal(values[name].shape)

    def depth(step: float, grad: bool = False) -> Any:
        moved = values | {name: values[name] + step * change}
        g, origin = gaussians(moved), vectors(moved["origin"].T)
        parts = {"position": g.position, "scale": g.scale, "opacity": [g.opacity], "origin": origin}[name]
        if grad:
            dr.enable_grad(parts)
            for part, tangent in zip(parts, np.atleast_2d(change), strict=True):
                dr.set_grad(part, Float64(tangent))
        return optical_depth(attenuators(g), origin, direction, Float64(0), Float64(np.inf))

    slope = dr.forward_to(depth(0.0, grad=True)).numpy()
    difference = (depth(1e-6).numpy() - depth(-1e-6).numpy()) / 2e-6
    np.testing.assert_allclose(slope, difference, rtol=GRADIENT_TOLERANCE, atol=1e-7)
    assert np.abs(slope).max() > 0.1


def test_opaque_beyond_float32_stays_finite():
    opacity = mi.Float([0.0, 1.0, 1.0 - 1e-8])
    g = gaussians(random_values(3, np.random.default_rng(6)), mi.Float)
    g.opacity = opacity
    dr.enable_grad(opacity)
    of = attenuators(g)
    np.testing.assert_allclose(of.depth.numpy(), [0, -np.log(LEAST_PASSED), -np.log(LEAST_PASSED)], rtol=1e-6)
    dr.backward(dr.sum(of.depth))
    assert np.isfinite(opacity.grad.numpy()).all()
    assert opacity.grad[0] == 1


@pytest.mark.parametrize("scale_m", [(0.2, 0.8), (0.005, 1.5)])
def test_cells_list_every_gaussian(scale_m):
    """Extinction from each cell's list is the definition, at the centres, between them, and outside."""
    rng = np.random.default_rng(7)
    values = random_values(40, rng, scale_m)
    of = attenuators(gaussians(values))
    cells = make_cells(on_host(of))
    assert np.diff(cells.first).mean() < 0.8 * 40  # a list is no list of all
    near = values["position"].T.repeat(10, axis=0)
    near = near + rng.standard_normal(near.shape) * values["scale"].mean(axis=0).repeat(10)[:, None]
    points = np.concatenate([near, values["position"].T, rng.uniform(-9, 9, (50, 3))])
    direction = units(len(points), rng)
    listed = extinction(of, to_device(cells, Float64), vectors(points), vectors(direction)).numpy()
    expected = [oracle_extinction(values, x, d) for x, d in zip(points, direction, strict=True)]
    np.testing.assert_allclose(listed, expected, rtol=1e-9, atol=FLOAT64_TOLERANCE)
    assert np.count_nonzero(listed) > 200


@pytest.mark.parametrize(("n", "scale_m"), [(1, (0.5, 0.5)), (60, (0.3, 0.3)), (60, (0.005, 1.5))])
def test_extinction_bound_is_valid_and_tight(n, scale_m):
    """No local maximum exceeds the bound; for round Gaussians it is within the stated factor."""
    rng = np.random.default_rng(8)
    values = random_values(n, rng, scale_m)
    if scale_m[0] == scale_m[1]:
        values["scale"][:] = rng.uniform(0.5, 1.5, n) * scale_m[0]
    host = on_host(attenuators(gaussians(values)))
    bound = largest_extinction(host, make_cells(host))

    def peaks(x: np.ndarray) -> float:
        return float(host.extinction(np.arange(n), np.broadcast_to(x, (n, 3))).sum())

    highest = 0.0
    for start in values["position"].T:
        end = minimize(lambda x: -peaks(x), start, method="Nelder-Mead", options={"maxiter": 200})
        highest = max(highest, peaks(start), -float(end.fun))
    assert highest <= bound
    assert all(oracle_extinction(values, x, d) <= bound for x in values["position"].T for d in units(4, rng))
    if scale_m[0] == scale_m[1]:
        assert bound <= highest * TIGHT * (1 + 2 * MARGIN)
    assert bound < 0.9 * host.peak.sum() or n == 1


def test_several_transmitters_are_refused():
    g = gaussians(random_values(2, np.random.default_rng(9)))
    g.batch = 2
    with pytest.raises(ValueError, match="2 transmitters"):
        attenuators(g)
