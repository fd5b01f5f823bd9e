"""The perception plane as a Mitsuba sensor: its rays, its poses, and Mitsuba's own integrators through it."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import wrf_mi_plugins
from traced_fields import RECEIVER, plane
from wrf_mi_plugins.sensor import equirectangular_sphere, receiver_to_world

from wrf_mi.core import InputError, azimuth_elevation, pixel_directions

FLOAT32 = 2e-6
"""Unit vectors and metres in float32 after a rotation."""

wrf_mi_plugins.register_all()


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


def test_crop_is_part_of_the_film():
    crop = {"crop_width": 10, "crop_height": 4, "crop_offset_x": 7, "crop_offset_y": 3}
    sensor = mi.load_dict(plane(9, 36, crop))
    expected = pixel_directions(9, 36)[3:7, 7:17]
    np.testing.assert_allclose(rays(sensor, 4, 10), expected @ RECEIVER.to_world.T, atol=FLOAT32)
    np.testing.assert_allclose(np.array(sensor.crop_directions(), float).T.reshape(4, 10, 3), expected, atol=FLOAT32)


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
