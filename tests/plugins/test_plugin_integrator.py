"""The traced integrator and the perception plane in Mitsuba: rays, images, derivatives, what is kept, bad scenes."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import traced_fields
import wrf_mi_plugins
from made_fields import off_edges
from traced_fields import RECEIVER, any_field, blended, complex_image, film, gaussians_of, plane, scene_of
from wrf_mi_plugins import integrator as integrator_module
from wrf_mi_plugins.sensor import equirectangular_sphere, receiver_to_world
from wrf_mi_plugins.shape import gaussian_shape, shape_parameters

from wrf_mi.backend.device import to_tensor
from wrf_mi.core import InputError, azimuth_elevation, pixel_directions

pytestmark = pytest.mark.all_threads

wrf_mi_plugins.register_all()

FLOAT32_TOLERANCE = 1e-4
"""Relative L2 error of an image by float32 rounding."""
GRADIENT_TOLERANCE = 1e-3
"""Relative L2 error of a gradient in float32, and rays that fall to the other side of a cut-off."""


@pytest.mark.parametrize("blending", ["alpha", "product"])
@pytest.mark.parametrize("coverage", ["hemisphere", "sphere"])
def test_image_matches_the_definition(blending, coverage):
    """``mi.render`` against float64 NumPy, and the film's channels; Gaussians of all shapes all around."""
    field = any_field(50)
    scene = scene_of(gaussians_of(field, blending, mi.Float), sensor=plane(45, 90, coverage=coverage))
    tensor = mi.render(scene)
    assert tensor.shape == (45, 90, 2)
    image = complex_image(tensor)
    directions = {"hemisphere": pixel_directions, "sphere": equirectangular_sphere}[coverage](45, 90)
    share_off, error = off_edges(image, blended(field, blending, directions))
    assert share_off < 2e-3
    assert error < FLOAT32_TOLERANCE
    developed = scene.sensors()[0].film().develop().numpy()
    np.testing.assert_allclose(developed[..., 0], np.abs(image), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(developed[..., 1:], tensor.numpy())


def test_crop_and_xml():
    """A crop is a part of the image. The integrator of a scene file is found and set."""
    gaussians = gaussians_of(any_field(20), "alpha", mi.Float)
    crop = {"crop_width": 15, "crop_height": 5, "crop_offset_x": 20, "crop_offset_y": 6}
    full, part = (mi.render(scene_of(gaussians, sensor=plane(crop=cropped))).numpy() for cropped in (None, crop))
    np.testing.assert_allclose(part, full[6:11, 20:35], atol=1e-6)
    integrator = '<integrator type="wrf_traced"><float name="frequency_hz" value="9e8"/></integrator>'
    scene = mi.load_string(f'<scene version="3.0.0">{integrator}</scene>')
    assert "frequency_hz = 9e+08" in str(scene.integrator())


def test_perspective_camera():
    """Any sensor that is a point: a camera of one sample a pixel sees what the rays it draws see."""
    field = any_field(40, size=0.1)
    look = mi.ScalarTransform4f().look_at(
        origin=RECEIVER.position_m, target=RECEIVER.position_m + RECEIVER.to_world[:, 2], up=[0, 0, 1]
    )
    sampler = {"type": "independent", "sample_count": 1}
    sensor = {"type": "perspective", "fov": 70, "to_world": look, "film": film(20, 30), "sampler": sampler}
    scene = scene_of(gaussians_of(field, "product", mi.Float), sensor=sensor)
    image = complex_image(mi.render(scene, seed=5))
    camera, integrator = scene.sensors()[0], scene.integrator()
    sampler, _ = integrator.prepare(camera, 5, 1, [])
    ray, _, _ = integrator.sample_rays(scene, camera, sampler)
    directions = np.array(ray.d, float).T @ RECEIVER.to_world
    share_off, error = off_edges(image, blended(field, "product", directions.reshape(20, 30, 3)))
    assert share_off < 0.01
    assert error < FLOAT32_TOLERANCE
    # More samples are averaged as complex numbers.
    assert mi.render(scene, spp=16).shape == (20, 30, 2)


def test_traced_hits_are_cached(monkeypatch):
    """New signals trace nothing; new geometry or a new pose does, and the image is as that of a new scene."""
    calls, traced_lists = [], integrator_module.traced_lists

    def counted(*arguments):
        calls.append(1)
        return traced_lists(*arguments)

    monkeypatch.setattr(integrator_module, "traced_lists", counted)
    scene = scene_of(gaussians_of(any_field(30), "alpha", mi.Float))
    params, first = mi.traverse(scene), mi.render(scene).numpy()
    other = gaussians_of(any_field(30, seed=1), "alpha", mi.Float)
    for name, expected_calls in (("signal", 1), ("opacity", 1), ("data", 2)):
        params.update({f"gaussians.{name}": shape_parameters(other)[name]})
        again = mi.render(scene).numpy()
        assert len(calls) == expected_calls
    assert not np.allclose(first, again)
    np.testing.assert_array_equal(again, mi.render(scene_of(other)).numpy())
    calls.clear()
    pose = mi.AffineTransform4f(params["sensor.to_world"].matrix)
    params.update({"sensor.to_world": pose @ mi.AffineTransform4f().rotate([0, 0, 1], 9.0)})  # one column
    np.testing.assert_allclose(mi.render(scene).numpy(), np.roll(again, -1, axis=1), atol=1e-4)
    assert len(calls) == 1


@pytest.mark.parametrize("blending", ["alpha", "product"])
def test_derivatives_through_render(blending):
    """Backward of ``mi.render`` is that of the plain function in float64; forward agrees with backward."""
    field, rng = any_field(20, seed=3, size=0.2), np.random.default_rng(0)
    scene = scene_of(gaussians_of(field, blending, mi.Float))
    params, blend = mi.traverse(scene), "opacity" if blending == "alpha" else "attenuation"
    values = {name: params[f"gaussians.{name}"].numpy().astype(float) for name in ("data", "signal", blend)}
    steps = {name: rng.standard_normal(v.shape) * 1e-2 for name, v in values.items()}
    weight = rng.standard_normal((12, 40, 2))
    for name in values:
        dr.enable_grad(params[f"gaussians.{name}"])
    params.update()
    dr.backward(dr.sum(mi.render(scene, params) * to_tensor(weight), axis=None))
    gradient = {name: params[f"gaussians.{name}"].grad.numpy().astype(float) for name in values}

    position, scale, rotation = np.split(values["data"].reshape(20, 10), [3, 6], axis=1)
    gaussians = gaussians_of(field | {"position": position, "scale": scale, "rotation": rotation}, blending)
    attached = {
        "data": [*gaussians.position, *gaussians.scale, *gaussians.rotation],
        "signal": gaussians.signal,
        blend: gaussians.attenuation or [gaussians.opacity],
    }
    dr.enable_grad(attached)
    parts = traced_fields.brute(gaussians, traced_fields.pose_of(), traced_fields.bundles_of(pixel_directions(12, 40)))
    dr.backward(sum(dr.sum(p * type(p)(weight[..., k].ravel())) for k, p in enumerate(parts)))
    for name, arrays in attached.items():
        expected = np.stack([dr.grad(a).numpy() for a in arrays], axis=1).ravel()
        assert np.linalg.norm(gradient[name] - expected) < GRADIENT_TOLERANCE * np.linalg.norm(expected), name

    s = dr.opaque(mi.Float, 0.0)
    dr.enable_grad(s)
    for name in values:
        params[f"gaussians.{name}"] = mi.Float(values[name]) + s * mi.Float(steps[name])
    params.update()
    dr.set_grad(s, 1.0)
    slope = dr.forward_to(mi.render(scene, params)).numpy().astype(float)
    backward = sum(float(gradient[name] @ steps[name]) for name in values)
    assert abs(np.sum(slope * weight) - backward) < GRADIENT_TOLERANCE * np.abs(slope * weight).sum()


def test_derivative_by_the_receiver_position():
    """Moving the receiver one way is moving all Gaussians the other way."""
    scene = scene_of(gaussians_of(any_field(20, seed=3, size=0.2), "alpha", mi.Float))
    params = mi.traverse(scene)
    weight = to_tensor(np.random.default_rng(0).standard_normal((12, 40, 2)))
    offset = dr.opaque(mi.Point3f, 0.0)
    dr.enable_grad(offset, params["gaussians.data"])
    pose = mi.AffineTransform4f(params["sensor.to_world"].matrix)
    params.update({"sensor.to_world": mi.AffineTransform4f().translate(offset) @ pose})
    dr.backward(dr.sum(mi.render(scene, params) * weight, axis=None))
    of_positions = params["gaussians.data"].grad.numpy().reshape(20, 10)[:, :3]
    error = np.linalg.norm(offset.grad.numpy().ravel() + of_positions.sum(axis=0))
    assert error < GRADIENT_TOLERANCE * np.abs(of_positions).sum()


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"gaussians": {"type": "sphere"}}, "no ellipsoids shape with a signal attribute"),
        ({"more": gaussian_shape(gaussians_of(any_field(2), "alpha", mi.Float))}, "2 shapes of Gaussians"),
        ({"sensor": {"type": "orthographic", "film": film(4, 4)}}, "do not start at one point"),
    ],
)
def test_invalid_scenes_are_refused(more, text):
    scene = scene_of(gaussians_of(any_field(5), "alpha", mi.Float), **more)
    with pytest.raises(InputError, match=text):
        scene.integrator().render(scene)


FLOAT32 = 2e-6
"""Unit vectors and metres in float32 after a rotation."""


def rays(sensor: Any, height: int, width: int) -> np.ndarray:
    """Directions of the rays of random places in every pixel, world frame."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:height, :width]
    x, y = ((k + rng.uniform(0, 0.999, k.shape)).ravel() / size for k, size in ((column, width), (row, height)))
    ray, weight = sensor.sample_ray(0.0, 0.5, mi.Point2f(mi.Float(x), mi.Float(y)), mi.Point2f(0.5))
    np.testing.assert_allclose(np.array(ray.o).T, np.broadcast_to(RECEIVER.position_m, (1, 3)), atol=FLOAT32)
    assert float(mi.unpolarized_spectrum(weight)[0][0]) == 1.0
    return np.array(ray.d, float).T.reshape(height, width, 3)


@pytest.mark.parametrize("coverage", ["hemisphere", "sphere"])
def test_rays_pass_through_pixel_points(coverage):
    """Wherever in a pixel the sample lies: the one direction of `core.angles`, turned by the quaternion."""
    sensor = mi.load_dict(plane(9, 36, coverage=coverage))
    expected = {"hemisphere": pixel_directions, "sphere": equirectangular_sphere}[coverage](9, 36)
    np.testing.assert_allclose(rays(sensor, 9, 36), expected @ RECEIVER.to_world.T, atol=FLOAT32)


def test_rows_of_the_sphere():
    azimuth, elevation = azimuth_elevation(equirectangular_sphere(18, 36))
    np.testing.assert_allclose(np.degrees(elevation[:, 5]), -90 + 10 * np.arange(18), atol=1e-6)
    np.testing.assert_allclose(np.degrees(azimuth[3]), 10 * np.arange(36), atol=1e-6)


def test_parameters():
    """What ``mi.traverse`` lists, and that a new pose and a new size are taken over, with derivatives."""
    sensor = mi.load_dict(plane())
    params = mi.traverse(sensor)
    flags = params.flags("to_world")
    assert flags & mi.ParamFlags.Discontinuous.value
    assert not flags & mi.ParamFlags.NonDifferentiable.value
    height = mi.Float(3.0)
    dr.enable_grad(height)
    params["to_world"] = mi.AffineTransform4f().translate([0, 0, height])
    params.update({"film.size": [20, 5]})
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.0, 0.0), mi.Point2f(0.5))
    dr.backward(ray.o.z * 2)
    assert height.grad == 2
    assert np.array(sensor.world_transform().matrix)[2, 3] == 3
    directions = np.array(sensor.directions(), float).T.reshape(5, 20, 3)
    np.testing.assert_allclose(directions, pixel_directions(5, 20), atol=FLOAT32)


def test_xml_and_depth():
    """From a scene in XML, with Mitsuba's own depth integrator: the distances to a sphere around the origin."""
    scene = mi.load_string(
        """<scene version="3.0.0">
            <integrator type="depth"/>
            <sensor type="wrf_perception_plane">
                <string name="coverage" value="sphere"/>
                <transform name="to_world"><rotate x="1" angle="90"/><translate x="1"/></transform>
                <film type="hdrfilm">
                    <integer name="width" value="24"/><integer name="height" value="12"/>
                    <string name="pixel_format" value="luminance"/><rfilter type="box"/>
                </film>
                <sampler type="independent"><integer name="sample_count" value="2"/></sampler>
            </sensor>
            <shape type="sphere"><float name="radius" value="3"/></shape>
        </scene>"""
    )
    image = mi.render(scene).numpy()[..., 0]
    # |(1, 0, 0) + t d| = 3; x is the axis of rotation, so d_x is as in the receiver's frame.
    x = equirectangular_sphere(12, 24)[..., 0]
    np.testing.assert_allclose(image, -x + np.sqrt(x * x + 8), rtol=1e-5)


def test_volpath_renders_through_it():
    """A purely absorbing medium: Beer's law along each ray."""
    air, samples, expected = {"type": "ref", "id": "air"}, 4096, np.exp(-0.5 * 2.0)
    ball = {"type": "sphere", "center": RECEIVER.position_m.tolist(), "radius": 2.0, "bsdf": {"type": "null"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volpath", "max_depth": 4},
            "sensor": plane(3, 8, medium=air),
            "air": {"type": "homogeneous", "albedo": 0.0, "sigma_t": 0.5, "id": "air"},
            "ball": ball | {"interior": air},
            "light": {"type": "constant", "radiance": 1.0},
        }
    )
    # Analogue tracking: each sample is 0 or 1.
    deviation = np.sqrt(expected * (1 - expected) / samples)
    assert np.abs(mi.render(scene, spp=samples).numpy() - expected).max() < 5 * deviation


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"coverage": "half"}, "coverage 'half' is none of hemisphere, sphere"),
        ({"to_world": mi.ScalarTransform4f().scale(2.0)}, "not a rotation and a translation"),
        ({"to_world": mi.ScalarTransform4f().scale([1.0, 1.0, -1.0])}, "not a rotation and a translation"),
    ],
)
def test_bad_input(more, text):
    with pytest.raises(RuntimeError, match=text):  # Mitsuba wraps a plugin's error
        mi.load_dict(plane(**more))


def test_bad_pose():
    for position, quaternion, text in (
        (RECEIVER.position_m, [0, 0, 0, 2], "unit quaternion"),
        ([0, 0, np.nan], RECEIVER.orientation_xyzw, "three finite coordinates"),
    ):
        with pytest.raises(InputError, match=text):
            receiver_to_world(position, quaternion)
    params = mi.traverse(mi.load_dict(plane()))
    params["to_world"] = mi.AffineTransform4f().scale(3)
    with pytest.raises(InputError, match="not a rotation and a translation"):
        params.update()
