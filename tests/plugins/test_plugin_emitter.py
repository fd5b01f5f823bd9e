"""The emitter: what the shape holds follows the field, gradients flow, and stock integrators see powers."""

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from plugin_fields import FIELDS, plain, slopes, weights_of
from wrf_mi_plugins import emitter as plugin
from wrf_mi_plugins.shape import shape_parameters

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import rotation_matrix
from wrf_mi.gaussians.fields import GEOMETRY

plugin.register()

FLOAT32_TOLERANCE = 1e-5
"""Relative: the same network in the same precision, in kernels of another shape."""
RESPONSE_TOLERANCE = 1e-2
"""Relative: Mitsuba moves a ray by 4e-4 m sideways where it passes a null surface; squares change by up to 18 per m."""
GRADIENT_TOLERANCE = 2e-2
"""Relative: central differences of a float32 network with kinks, with a step of 1e-3 along one direction."""

TX = (0.4, -0.7, 1.1)
MODELS = ["wrf-gs", "wrf-gs+"]
INDEPENDENT = {"type": "independent"}


def emitter_of(model: str) -> Any:
    return plugin.gaussian_emitter(FIELDS[model], weights_of(model), TX)


def scene_of(emitter: Any, **entries: Any) -> Any:
    gaussians = {"type": "wrf_gaussians", "transmitter": emitter}
    return mi.load_dict({"type": "scene", "transmitter": emitter, "gaussians": gaussians} | entries)


def expected_parameters(model: str, tx: tuple = TX, **changed: np.ndarray) -> dict[str, np.ndarray]:
    """What the shape should hold, straight from the field."""
    params = {name: to_tensor(values) for name, values in (weights_of(model) | changed).items()}
    gaussians = FIELDS[model].gaussians(params, to_tensor(np.array(tx)[:, None]))
    return {name: plain(values) for name, values in shape_parameters(gaussians).items()}


def assert_shape_holds(scene: Any, expected: dict[str, np.ndarray]) -> None:
    close, params = partial(np.testing.assert_allclose, rtol=FLOAT32_TOLERANCE), mi.traverse(scene)
    for name, values in expected.items():
        close(plain(params[f"gaussians.{name}"]), values, atol=FLOAT32_TOLERANCE)


def ray_through(origin: np.ndarray, direction: np.ndarray) -> Any:
    return mi.Ray3f(mi.Point3f(np.atleast_2d(origin).T), mi.Vector3f(np.atleast_2d(direction).T))


@pytest.mark.parametrize("model", MODELS)
def test_shape_follows_transmitter_and_weights(model):
    scene = scene_of(emitter_of(model))
    before = expected_parameters(model)
    assert_shape_holds(scene, before)
    params, new_tx = mi.traverse(scene), (-1.0, 0.3, 0.2)
    params.update({"transmitter.tx_position": mi.Point3f(*new_tx)})
    moved = expected_parameters(model, new_tx)
    assert np.abs(moved["signal"] - before["signal"]).max() > 0.01
    assert_shape_holds(scene, moved)
    name = "signal.out.bias" if model == "wrf-gs" else "deform.signal.bias"
    bias = weights_of(model)[name] + 0.5
    params.update({f"transmitter.{name.replace('.', '_')}": to_tensor(bias)})
    changed = expected_parameters(model, new_tx, **{name: bias})
    np.testing.assert_allclose(changed["signal"], moved["signal"] + 0.5, atol=1e-4)
    assert_shape_holds(scene, changed)


def test_unchanged_geometry_is_not_updated():
    """Under WRF-GS the transmitter changes signals alone, so what was traced still holds."""
    params = mi.traverse(scene_of(emitter_of("wrf-gs")))
    before = {name: params[f"gaussians.{name}"].index for name in ("data", "attenuation", "signal")}
    params.update({"transmitter.tx_position": mi.Point3f(1.0, 2.0, 0.5)})
    after = {name: params[f"gaussians.{name}"].index for name in before}
    assert [name for name in before if before[name] != after[name]] == ["signal"]


def test_number_of_gaussians_may_change():
    scene = scene_of(emitter_of("wrf-gs+"))
    params = mi.traverse(scene)
    for name, values in weights_of("wrf-gs+").items():
        if name in FIELDS["wrf-gs+"].per_gaussian:
            params[f"transmitter.{name}"] = to_tensor(values[:, :4])
    params.update()
    few = expected_parameters("wrf-gs+")
    assert_shape_holds(scene, {name: values.reshape(6, -1)[:4].ravel() for name, values in few.items()})
    below = few["data"].reshape(6, 10)[:, :3] - [0, 0, 50]
    hits = scene.ray_intersect(ray_through(below, np.tile([0, 0, 1.0], (6, 1))))
    met = set(hits.prim_index.numpy()[hits.is_valid().numpy()].tolist())
    assert met <= {0, 1, 2, 3}
    assert len(met) > 1


def test_moved_gaussians_are_traced_again():
    scene = scene_of(emitter_of("wrf-gs+"))
    params = mi.traverse(scene)
    params["transmitter.position"] = to_tensor(params["transmitter.position"].numpy() + np.array([[0], [0], [100]]))
    params.update()
    centre = plain(params["gaussians.data"]).reshape(-1, 10)[0, :3]
    assert centre[2] > 90
    rays = ray_through(centre + np.array([[-50, 0, 0], [-50, 0, -100]]), np.tile([1.0, 0, 0], (2, 1)))
    assert scene.ray_intersect(rays).is_valid().numpy().tolist() == [True, False]


@pytest.mark.parametrize("model", MODELS)
def test_parameters_and_flags(model):
    params = mi.traverse(scene_of(emitter_of(model)))
    names = {key.removeprefix("transmitter.") for key, _ in params if key.startswith("transmitter.")}
    expected = {"tx_position", *(name.replace(".", "_") for name in weights_of(model))}
    assert names == expected | {"sampling_weight"}
    for name in expected:
        flags = params.flags(f"transmitter.{name}")
        assert flags & mi.ParamFlags.NonDifferentiable == 0, name
        assert (flags & mi.ParamFlags.Discontinuous != 0) == (name in GEOMETRY), name
    assert params.flags("transmitter.sampling_weight") & mi.ParamFlags.NonDifferentiable != 0


@pytest.mark.gradcheck
@pytest.mark.parametrize("name", ["tx_position", "position", "signal"])
@pytest.mark.parametrize("model", MODELS)
def test_gradients_reach_the_parameters(model, name):
    """From the shape's attributes, as an integrator reads them, back to what the emitter holds."""
    if (model, name) == ("wrf-gs", "signal"):
        name = "signal_out_bias"
    params, rng = mi.traverse(scene_of(emitter_of(model))), np.random.default_rng(1)
    outputs = [n for n in ("data", "signal", "attenuation", "opacity") if f"gaussians.{n}" in params]
    weight = {n: rng.standard_normal(dr.width(params[f"gaussians.{n}"])) for n in outputs}
    change = rng.standard_normal(params[f"transmitter.{name}"].numpy().shape)

    def loss() -> Any:
        return sum(dr.sum(params[f"gaussians.{n}"] * mi.Float(weight[n])) for n in outputs)

    slope, expected = slopes(loss, params, f"transmitter.{name}", change, 1e-3)
    # Network inputs are detached centres: moving a Gaussian changes what the network says, which has no derivative.
    if name == "position":
        expected = np.sum(weight["data"].reshape(-1, 10)[:, :3].T * change)
    assert slope == pytest.approx(expected, rel=GRADIENT_TOLERANCE, abs=1e-3)
    assert abs(expected) > 0.05


def oracle_power(shape: dict[str, np.ndarray], origin: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """|a S|^2 of each Gaussian along rays from outside all of them, shape [rays, n]."""
    data = shape["data"].reshape(-1, 10)
    out = np.zeros((len(direction), len(data)))
    for i, row in enumerate(data):
        w = rotation_matrix(row[6:]).T / row[3:6, None]
        p, q = (origin - row[:3]) @ w.T, direction @ w.T
        t = -(p * q).sum(axis=1) / (q * q).sum(axis=1)
        squared = ((p + t[:, None] * q) ** 2).sum(axis=1)
        alpha = shape["opacity"][i] if "opacity" in shape else 1.0
        power = (alpha * np.exp(-squared / 2)) ** 2 * np.sum(shape["signal"].reshape(-1, 2)[i] ** 2)
        out[:, i] = np.where((t > 0) & (squared < 9), power, 0)
    return out


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("integrator", ["path", "volpath"])
def test_stock_integrators_add_powers(model, integrator):
    # Mitsuba's path tracer drops rays that end on null surfaces alone.
    black = {"type": "diffuse", "reflectance": 0.0}
    sky = {"type": "sphere", "radius": 200.0, "bsdf": {"type": "twosided", "inside": black}}
    scene = scene_of(emitter_of(model), sky=sky, integrator={"type": integrator, "rr_depth": 1000})
    shape, rng = expected_parameters(model), np.random.default_rng(2)
    aim = shape["data"].reshape(-1, 10)[np.arange(40) % 6, :3] + rng.normal(0, 0.2, (40, 3))
    origin = 12 * rng.standard_normal((40, 3))
    direction = (aim - origin) / np.linalg.norm(aim - origin, axis=1)[:, None]
    sampler = mi.load_dict(INDEPENDENT)
    sampler.seed(0, 40)
    rays = mi.RayDifferential3f(ray_through(origin, direction))
    radiance, _, _ = scene.integrator().sample(scene, sampler, rays)
    powers = oracle_power(shape, origin, direction)
    assert (powers > 0).sum(axis=1).max() > 1  # some rays meet several
    np.testing.assert_allclose(plain(radiance[0][0][0]), powers.sum(axis=1), rtol=RESPONSE_TOLERANCE, atol=1e-7)
    others = [radiance[row][column][0] for row in range(4) for column in range(4) if row or column]
    assert all(dr.all(element == 0) for element in others)  # unpolarised


def test_light_on_a_wall_is_found_without_sampling_the_emitter():
    """Power that a diffuse wall reflects: the integral over its hemisphere, though the emitter is never sampled."""
    emitter = emitter_of("wrf-gs+")
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3]).scale(0.1)}
    scene = scene_of(emitter, wall=wall, integrator={"type": "path", "rr_depth": 1000})
    it = dr.zeros(mi.Interaction3f)
    assert emitter.pdf_direction(it, dr.zeros(mi.DirectionSample3f))[0] == 0
    sample, weight = emitter.sample_direction(it, mi.Point2f(0.5))
    assert sample.pdf[0] == 0
    assert dr.all(weight[0][0][0] == 0)
    count, sampler = 200_000, mi.load_dict(INDEPENDENT)
    sampler.seed(0, count)
    towards: Any = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0, 0, -2.9), dr.repeat(mi.Vector3f(0, 0, -1), count)))
    towards.maxt = 1.0
    radiance = plain(scene.integrator().sample(scene, sampler, towards)[0][0][0][0])
    # Reflectance 0.5 of a Lambertian wall: 0.5 / pi times the irradiance.
    u = np.random.default_rng(3).random((20_000, 2))
    radius, angle = np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    up = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u[:, 0])], axis=1)
    expected = 0.5 * oracle_power(expected_parameters("wrf-gs+"), np.array([[0, 0, -3.0]]), up).sum(axis=1)
    error = np.hypot(radiance.std() / np.sqrt(count), expected.std() / np.sqrt(len(expected)))
    assert abs(radiance.mean() - expected.mean()) < 4 * error
    assert error < 0.05 * expected.mean()


def test_emitter_belongs_to_one_shape():
    emitter = emitter_of("wrf-gs+")
    assert "WrfGsPlus, 6 Gaussians, transmitter at (0.4, -0.7, 1.1) m" in str(emitter)
    shape = scene_of(emitter).shapes()[0]
    assert emitter.get_shape() is shape
    assert shape.is_emitter()
    assert emitter.bbox() == shape.bbox()
    for entry, message in (
        ({"type": "wrf_gaussians", "transmitter": emitter}, "single shape"),
        ({"type": "wrf_gaussians"}, "0 wrf_gaussian_emitter in it; give one"),
        ({"type": "wrf_gaussian_emitter", "tx_position": [0, 0, 0]}, "no run; give a run folder"),
    ):
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict(entry)
    with pytest.raises(ValueError, match="three finite coordinates"):
        plugin.gaussian_emitter(FIELDS["wrf-gs+"], weights_of("wrf-gs+"), (0.0, np.nan, 1.0))
