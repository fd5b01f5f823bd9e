"""Walls before Gaussians in the traced integrator: what passes them, against Sionna RT."""

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import wrf_mi_plugins
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from test_plugin_integrator import complex_image, film, scene_of
from test_plugin_integrator_rays import columns, gaussians_of
from traced_fields import any_field
from wrf_mi_plugins.sensor import receiver_to_world

from wrf_mi.core import InputError, pixel_directions
from wrf_mi.gaussians import Gaussians

wrf_mi_plugins.register_all()

SIONNA_TOLERANCE = 2e-5
"""Sionna RT computes the same coefficient in float32 from vertices some metres away."""

FREQUENCY_HZ = 2.4e9


BRICK = {"type": "twosided", "id": "mat-itu_brick", "bsdf": {"type": "diffuse"}}


def wall(x: float = 3.0, size: float = 20.0) -> dict[str, Any]:
    """A wall across the x axis, turned by 20 degrees about z; its material is `BRICK`, which the scene must have."""
    turn = mi.ScalarTransform4f().translate([x, 0, 0]).rotate([0, 0, 1], 20).rotate([0, 1, 0], -90).scale(size)
    return {"type": "rectangle", "to_world": turn, "bsdf": {"type": "ref", "id": BRICK["id"]}}


def sionna_wall(folder: Path) -> Any:
    """The same wall as a scene of Sionna RT."""
    from sionna import rt

    (folder / "wall.xml").write_text(
        """<scene version="3.0.0">
            <bsdf type="twosided" id="mat-itu_brick"><bsdf type="diffuse"/></bsdf>
            <shape type="rectangle" id="mesh-wall">
                <transform name="to_world">
                    <scale value="20"/><rotate y="1" angle="-90"/><rotate z="1" angle="20"/><translate x="3"/>
                </transform>
                <ref id="mat-itu_brick" name="bsdf"/>
            </shape>
        </scene>"""
    )
    scene = rt.load_scene(str(folder / "wall.xml"), merge_shapes=False)
    scene.frequency = FREQUENCY_HZ
    return scene


ROWS, COLUMNS = np.array([85, 60, 45, 70]), np.array([0, 30, 300, 180])
# Boresight +x, array's y axis up.
UPRIGHT = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])


def behind_the_wall(distance_m: float = 7.0, turn_deg: float = 0.0) -> tuple[Gaussians, dict[str, Any], np.ndarray]:
    """Four Gaussians in the directions of four pixels, the sensor, and the Gaussians' positions.

    The sensor may be turned about its normal; the Gaussians stay where they are.
    """
    position = distance_m * pixel_directions(90, 360)[ROWS, COLUMNS] @ UPRIGHT.T
    ones = np.ones((4, 1))
    gaussians = Gaussians(
        position=columns(position, mi.Float),
        scale=columns(0.05 * np.ones((4, 3)), mi.Float),
        rotation=columns(np.tile([0.0, 0, 0, 1], (4, 1)), mi.Float),
        signal=columns(np.hstack([ones, 0 * ones]), mi.Float),
        opacity=mi.Float(0.9 * ones.ravel()),
        attenuation=None,
        batch=1,
    )
    turned = Rotation.from_matrix(UPRIGHT) * Rotation.from_euler("z", turn_deg, degrees=True)
    to_world = receiver_to_world(np.zeros(3), turned.as_quat())
    return gaussians, {"type": "wrf_perception_plane", "to_world": to_world, "film": film(90, 360)}, position


def at_pixels(**more: Any) -> np.ndarray:
    gaussians, sensor, _ = behind_the_wall()
    return complex_image(mi.render(scene_of(gaussians, sensor=sensor, **more)))[ROWS, COLUMNS]


def test_wall_transmission_matches_sionna_rt(tmp_path):
    """The factor of a wall is that of Sionna RT's path straight through it: oblique, both polarisations mixed."""
    from sionna import rt

    integrator = {"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ, "thickness_itu_brick": 0.16}
    through = at_pixels(brick=BRICK, wall=wall(), integrator=integrator) / at_pixels()
    scene = sionna_wall(tmp_path)
    scene.radio_materials["itu_brick"].thickness = 0.16
    # The same wall with Sionna RT's own material: frequency and thickness are known.
    own = at_pixels(wall=scene.mi_scene.shapes()[0]) / at_pixels()
    np.testing.assert_allclose(own, through, rtol=1e-6)
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Receiver("rx", mi.Point3f(0, 0, 0)))
    for i, place in enumerate(behind_the_wall()[2]):
        scene.add(rt.Transmitter(f"tx-{i}", mi.Point3f(*place.tolist())))
    paths = rt.PathSolver()(scene, max_depth=1, refraction=True, specular_reflection=False)
    gain = (paths.a[0].numpy() + 1j * paths.a[1].numpy())[0, 0, :, 0, 0]
    expected = gain / (speed_of_light / FREQUENCY_HZ / (4 * np.pi * 7.0))
    np.testing.assert_allclose(through, expected, rtol=SIONNA_TOLERANCE, atol=SIONNA_TOLERANCE)


def test_default_polarisation_is_vertical_for_any_sensor_rotation():
    """A stated polarisation turns with the sensor; the default does not."""
    gaussians, sensor, _ = behind_the_wall(turn_deg=90)
    columns_now = (COLUMNS - 90) % 360

    def turned(**stated: Any) -> np.ndarray:
        own = {"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ, **stated}
        scene = scene_of(gaussians, sensor=sensor, brick=BRICK, wall=wall(), integrator=own)
        return complex_image(mi.render(scene))[ROWS, columns_now]

    upright = at_pixels(brick=BRICK, wall=wall(), integrator={"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ})
    np.testing.assert_allclose(turned(), upright, rtol=1e-3, atol=1e-4)  # a rotated sensor in single precision
    assert np.abs(turned(polarization=mi.ScalarVector3f(0, 1, 0)) / upright - 1).max() > 0.05


def test_only_walls_before_a_gaussian_attenuate_it():
    """Two walls multiply; one behind the Gaussians does nothing; ``walls: false`` leaves them out."""
    integrator = {"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ}
    own: dict[str, Any] = {"brick": BRICK, "wall": wall(), "integrator": integrator}
    free, one = at_pixels(), at_pixels(**own)
    two = at_pixels(**own, second=wall(4.0, 60.0))
    np.testing.assert_allclose(two / free, (one / free) ** 2, rtol=1e-4)
    behind = at_pixels(**own, second=wall(30.0, 60.0))
    np.testing.assert_allclose(behind, one, rtol=1e-6)
    border = wall() | {"bsdf": {"type": "null"}}
    np.testing.assert_allclose(at_pixels(**own, border=border), one, rtol=1e-6)
    without = at_pixels(**own | {"integrator": {"type": "wrf_traced", "walls": False}})
    np.testing.assert_array_equal(without, free)


def test_derivative_by_wall_material(tmp_path):
    """Permittivity, conductivity and thickness of a radio material: backward against differences."""
    sionna_scene = sionna_wall(tmp_path)
    gaussians, sensor, _ = behind_the_wall()
    scene = scene_of(gaussians, sensor=sensor, wall=sionna_scene.mi_scene.shapes()[0])
    params = mi.traverse(scene)
    for name in ("eta_r", "sigma", "d"):
        key = next(k for k in params.keys() if k.endswith(f".{name}"))  # noqa: SIM118 - not a mapping
        value = float(params[key][0])

        def power(x: Any, key: str = key) -> Any:
            params[key] = x
            params.update()
            image = mi.render(scene, params)
            return dr.sum(image * image, axis=None).array

        x = mi.Float(value)
        dr.enable_grad(x)
        dr.backward(power(x))
        step = 2e-3 * value
        numeric = (power(mi.Float(value + step))[0] - power(mi.Float(value - step))[0]) / (2 * step)
        params[key] = mi.Float(value)
        assert abs(x.grad[0] - numeric) < 0.01 * abs(numeric), name


CARRIER = {"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ}
PAINT = {"type": "diffuse", "id": "paint"}


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ({"brick": BRICK, "wall": wall()}, "give frequency_hz, or set walls to false"),
        ({"wall": wall() | {"bsdf": PAINT}, "integrator": CARRIER}, "its BSDF paint is no radio material"),
        ({"brick": BRICK, "wall": wall(), "integrator": CARRIER | {"frequency_hz": 1e5}}, "mat-itu_brick at 100000 Hz"),
    ],
)
def test_walls_of_unknown_material_are_refused(more, text):
    scene = scene_of(gaussians_of(any_field(5), "alpha", mi.Float), **more)
    with pytest.raises(InputError, match=text):
        scene.integrator().render(scene)
