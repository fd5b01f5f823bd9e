"""The medium: Mitsuba's own volumetric path tracer finds the transmittance that the closed form says."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from plugin_fields import FIELDS, plain, slopes, weights_of
from wrf_mi_plugins import emitter as emitter_plugin
from wrf_mi_plugins import medium as plugin
from wrf_mi_plugins.optical_depth import attenuators, optical_depth

from wrf_mi.backend.device import to_tensor

emitter_plugin.register()
plugin.register()

FLOAT32_TOLERANCE = 1e-4
"""Relative, of an optical depth in single precision."""
GRADIENT_TOLERANCE = 1e-2
"""Relative: central differences of a float32 sum with a step of 2e-4."""
STANDARD_ERRORS = 4.5
"""A Monte Carlo mean is off by more than this once in 150,000 times; each test looks at a few dozen."""

COUNT = 6
SHAPES = {
    "plain": ((0.2, 0.6), (0.2, 0.6), (0.2, 0.6)),
    "needles": ((0.02, 0.02), (0.02, 0.02), (1.0, 1.0)),
    "discs": ((0.03, 0.03), (0.5, 0.5), (1.0, 1.0)),
}


def arrays(kind: str = "plain", opacity: float | None = None) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "centers": rng.uniform(-1, 1, (COUNT, 3)),
        "scales": np.stack([rng.uniform(*ends, COUNT) for ends in SHAPES[kind]], axis=1),
        "quaternions": rng.standard_normal((COUNT, 4)),
        "opacity": rng.uniform(0.2, 0.9, COUNT) if opacity is None else np.full(COUNT, opacity),
    }


def medium_of(values: dict[str, Any], **more: Any) -> dict[str, Any]:
    tensors = {name: v if isinstance(v, str) else to_tensor(v) for name, v in values.items()}
    return {"type": "wrf_gaussian_medium", **tensors, **more}


def scene_of(medium: Any, **entries: Any) -> tuple[Any, Any]:
    """A scene whose sphere is filled with the medium, and the medium."""
    stencil = {"type": "sphere", "radius": 30.0, "bsdf": {"type": "null"}, "interior": {"type": "ref", "id": "air"}}
    filled = {"type": "scene", "integrator": {"type": "volpath"}, "air": medium, "stencil": stencil}
    scene = mi.load_dict(filled | entries)
    return scene, next(s.interior_medium() for s in scene.shapes() if s.interior_medium() is not None)


def unit_vectors(count: int, seed: int) -> np.ndarray:
    direction = np.random.default_rng(seed).standard_normal((count, 3))
    return direction / np.linalg.norm(direction, axis=1)[:, None]


def rays_through(values: dict[str, np.ndarray], count: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays past the centres, from 3 m away and, every other one, from the centre itself."""
    direction, spread_m = unit_vectors(count, 1), min(0.1, 0.5 * values["scales"].min())
    origin = np.resize(values["centers"], (count, 3)) + np.random.default_rng(2).normal(0, spread_m, (count, 3))
    origin[1::2] -= 3 * direction[1::2]
    return origin, direction


def ray_of(origin: np.ndarray, direction: np.ndarray) -> Any:
    return mi.Ray3f(mi.Point3f(origin.T), mi.Vector3f(direction.T))


def traced(scene: Any, medium: Any, origin: np.ndarray, direction: np.ndarray, samples: int) -> np.ndarray:
    """Radiance that the scene's integrator finds along each ray, the mean of all samples."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, len(origin) * samples)
    ray = mi.RayDifferential3f(ray_of(np.repeat(origin, samples, axis=0), np.repeat(direction, samples, axis=0)))
    radiance, _, _ = scene.integrator().sample(scene, sampler, ray, medium)
    return plain(radiance[0][0][0]).reshape(len(origin), samples).mean(axis=1)


@pytest.mark.parametrize(
    ("kind", "opacity", "rays", "samples"),
    [
        ("plain", None, 24, 8192),
        ("needles", None, 12, 1024),
        ("discs", None, 12, 1024),
        ("plain", 0.999999, 12, 2048),
        ("plain", 0.0, 12, 64),
    ],
)
def test_volpath_agrees_with_the_closed_form(kind, opacity, rays, samples):
    """A known sky behind the Gaussians, seen from outside and from within them."""
    values = arrays(kind, opacity)
    scene, medium = scene_of(medium_of(values), sky={"type": "constant", "radiance": 2.5})
    origin, direction = rays_through(values, rays)
    exact = 2.5 * np.exp(-plain(medium.optical_depth(ray_of(origin, direction))))
    difference = traced(scene, medium, origin, direction, samples) - exact
    # Absorption all or nothing: the variance is known, and an error bar cannot come out too small by chance.
    error = np.sqrt(exact * (2.5 - exact) / samples)
    assert (np.abs(difference) <= STANDARD_ERRORS * error + 1e-6).all()
    assert abs(difference.mean()) <= STANDARD_ERRORS * np.sqrt((error**2).sum()) / rays + 1e-6
    if opacity is None:
        assert np.ptp(exact) > 0.5
        assert error.max() < 0.05
    else:
        assert (exact == 2.5).all() if opacity == 0 else exact.min() < 1e-3


def test_rendered_transmittance_agrees_with_the_closed_form():
    """Through `mi.render`, with an area emitter behind the Gaussians and a sensor that stands among them."""
    centre, towards, radiance, samples = np.array([0.1, -0.2, 0.3]), np.array([6.0, 1.0, 0.5]), 3.0, 1 << 15
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    look = mi.ScalarTransform4f().look_at(towards.tolist(), centre.tolist(), [0, 0, 1])
    lamp = {"type": "rectangle", "to_world": look, "emitter": {"type": "area", "radiance": radiance}}
    line = {"origin": centre.tolist(), "direction": (towards - centre).tolist()}
    eye = {"type": "radiancemeter", "film": film, "medium": {"type": "ref", "id": "air"}} | line
    scene, medium = scene_of(medium_of(arrays()), lamp=lamp, eye=eye)
    length = np.linalg.norm(towards - centre)
    ray = ray_of(centre[None], (towards - centre)[None] / length)
    ray.maxt = mi.Float(length)
    exact = radiance * np.exp(-plain(medium.optical_depth(ray))[0])
    assert 0.1 < exact < 0.9 * radiance
    rendered = mi.render(scene, spp=samples).numpy().item()
    assert abs(rendered - exact) < STANDARD_ERRORS * np.sqrt(exact * (radiance - exact) / samples)


def test_extinction_of_thin_needles_is_found():
    """Needles of 1 mm among round Gaussians: the extinction found where they are, and the bound above it."""
    values = arrays("needles")
    values["scales"][:, :2] = 0.001
    values["scales"][0] = 0.5
    _, medium = scene_of(medium_of(values))
    at_centres = plain(medium.extinction(mi.Point3f(values["centers"].T), mi.Vector3f(1, 0, 0)))
    assert at_centres[1:].min() > 20  # 0.25 of optical depth in some millimetres
    assert (at_centres <= medium.majorant_per_m).all()
    # Through the centre, from 3 m away: all of it, at least.
    direction = unit_vectors(60, 1)
    depth = plain(medium.optical_depth(ray_of(np.resize(values["centers"], (60, 3)) - 3 * direction, direction)))
    assert (depth >= -np.log1p(-np.resize(values["opacity"], 60)) * (1 - 1e-2)).all()


def test_parameters_and_flags():
    params = mi.traverse(scene_of(medium_of(arrays()))[0])
    for name in ("centers", "scales", "quaternions", "opacity", "scale"):
        flags = params.flags(f"air.{name}")
        assert flags & mi.ParamFlags.NonDifferentiable == 0
        assert (flags & mi.ParamFlags.Discontinuous != 0) == (name in ("centers", "scales", "quaternions"))


@pytest.mark.gradcheck
@pytest.mark.parametrize("name", ["centers", "scales", "quaternions", "opacity", "scale"])
@pytest.mark.parametrize("what", ["optical depth", "extinction"])
def test_gradients_reach_the_parameters(name, what):
    values, rng, key = arrays(), np.random.default_rng(3), f"air.{name}"
    scene, medium = scene_of(medium_of(values))
    params, weight = mi.traverse(scene), mi.Float(rng.uniform(0.5, 1.5, 40))
    origin, direction = rays_through(values, 40)
    change = rng.standard_normal(plain(params[key]).shape) * (np.sign(plain(params[key])) if name == "opacity" else 1)

    def loss() -> Any:
        if what == "optical depth":
            return dr.sum(medium.optical_depth(ray_of(origin, direction)) * weight)
        # Near the centres: a step across a cut-off, where extinction jumps, would show in the difference.
        mei = dr.zeros(mi.MediumInteraction3f, 40)
        mei.p, mei.wi = mi.Point3f(origin[::2].repeat(2, axis=0).T), mi.Vector3f(direction.T)
        scattered, null, total = medium.get_scattering_coefficients(mei)
        assert dr.all(scattered[0] == 0)
        assert dr.allclose((null + total)[0], medium.majorant_per_m)
        return dr.sum(total[0] * weight)

    slope, expected = slopes(loss, params, key, change, 2e-4)
    assert slope == pytest.approx(expected, rel=GRADIENT_TOLERANCE)
    assert abs(expected) > 0.1


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+"])
def test_medium_follows_its_emitter(model):
    emitter = emitter_plugin.gaussian_emitter(FIELDS[model], weights_of(model), (0.4, -0.7, 1.1))
    gaussians = {"type": "wrf_gaussians", "transmitter": emitter}
    medium = {"type": "wrf_gaussian_medium", "transmitter": emitter}
    scene, air = scene_of(medium, transmitter=emitter, gaussians=gaussians)
    params, ray = mi.traverse(scene), ray_of(np.zeros((200, 3)), unit_vectors(200, 4))

    def direct(tx: tuple, weights: dict[str, np.ndarray]) -> np.ndarray:
        tensors = {name: to_tensor(values) for name, values in weights.items()}
        of_field = attenuators(FIELDS[model].gaussians(tensors, to_tensor(np.array(tx)[:, None])))
        return plain(optical_depth(of_field, [mi.Float(0)] * 3, list(ray.d), mi.Float(0), mi.Float(np.inf)))

    before = plain(air.optical_depth(ray))
    np.testing.assert_allclose(before, direct((0.4, -0.7, 1.1), weights_of(model)), atol=FLOAT32_TOLERANCE)
    params["transmitter.tx_position"] = mi.Point3f(-2.0, 0.0, 1.0)
    moved = weights_of(model)
    moved["position"] = moved["position"] + np.array([[0.5], [0.0], [3.0]], np.float32)
    params.update({"transmitter.position": to_tensor(moved["position"])})
    after = plain(air.optical_depth(ray))
    np.testing.assert_allclose(after, direct((-2.0, 0.0, 1.0), moved), atol=FLOAT32_TOLERANCE)
    assert np.abs(after - before).max() > 0.02
    # The grid and the bound are new, too.
    centres = plain(params["gaussians.data"]).reshape(-1, 10)[:, :3]
    extinction = plain(air.extinction(mi.Point3f(centres.T), mi.Vector3f(0, 0, 1)))
    assert (extinction > 0).all()
    assert (extinction <= air.majorant_per_m).all()


def test_scale_multiplies_depth_and_phase_has_no_effect():
    """Twice the depth for powers; a phase of delta changes nothing."""
    values = arrays()
    ray = ray_of(*rays_through(values, 30))
    once, twice = (plain(mi.load_dict(medium_of(values, scale=s)).optical_depth(ray)) for s in (1.0, 2.0))
    np.testing.assert_allclose(twice, 2 * once, rtol=FLOAT32_TOLERANCE)
    opacity = values.pop("opacity")
    phase = np.random.default_rng(5).uniform(0, 6, COUNT)
    values["attenuation"] = (1 - opacity)[:, None] * np.stack([np.cos(phase), np.sin(phase)], axis=1)
    turned = plain(mi.load_dict(medium_of(values)).optical_depth(ray))
    np.testing.assert_allclose(turned, once, rtol=FLOAT32_TOLERANCE, atol=FLOAT32_TOLERANCE)


def test_invalid_arrays_are_refused():
    values, column = arrays(), np.arange(COUNT)[:, None]
    wrong: dict[str, dict[str, Any]] = {
        "0 sources": {},
        "2 sources": {**values, "run": "somewhere"},
        "give centers, scales": {"opacity": values["opacity"]},
        "one of opacity and attenuation": {**values, "attenuation": np.ones((COUNT, 2))},
        r"scales, row 2 \(from 0\), is not finite and positive": {
            **values,
            "scales": np.where(column == 2, -9, [1.0] * 3),
        },
        r"centers, row 4 \(from 0\), is not finite": {**values, "centers": np.where(column == 4, np.nan, [1.0] * 3)},
        "opacity, row 0 .from 0., is not within 0 and 1": {**values, "opacity": np.full(COUNT, 1.5)},
        r"scales has shape \[5, 3\]; with these centers give \[6, 3\]": {**values, "scales": np.ones((5, 3))},
    }
    for message, entry in wrong.items():
        with pytest.raises(RuntimeError, match=message):
            mi.load_dict(medium_of(entry))
    assert "6 Gaussians, extinction below" in str(mi.load_dict(medium_of(values)))
