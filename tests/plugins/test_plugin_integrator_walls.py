"""Walls before Gaussians in the traced integrator: what passes them, against Sionna RT, and what they hide."""

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import wrf_mi_plugins
from made_fields import device_gaussians
from plugin_fields import plain, slopes
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from traced_fields import any_field, complex_image, film, gaussians_of, scene_of
from wrf_mi_plugins.sensor import receiver_to_world

from wrf_mi.core import InputError, pixel_directions

wrf_mi_plugins.register_all()

SIONNA_TOLERANCE = 2e-5
"""Sionna RT computes the same coefficient in float32 from vertices some metres away."""
FREQUENCY_HZ = 2.4e9
PAINT = {"type": "diffuse", "id": "paint"}
CARRIER = {"type": "wrf_traced", "frequency_hz": FREQUENCY_HZ}
BRICK: dict[str, Any] = {"type": "twosided", "id": "mat-itu_brick", "bsdf": {"type": "diffuse"}}
ROWS, COLUMNS = np.array([85, 60, 45, 70]), np.array([0, 30, 300, 180])
UPRIGHT = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Boresight +x, array's y axis up."""
POSITIONS_M = 7.0 * pixel_directions(90, 360)[ROWS, COLUMNS] @ UPRIGHT.T
"""Of Gaussians in the directions of four pixels."""


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


def scene_at_wall(turn_deg: int = 0, **more: Any) -> Any:
    """Four Gaussians before a sensor, which is turned about its normal; the Gaussians are not."""
    geometry: dict[str, Any] = {
        "scale": np.full((3, 4), 0.05),
        "rotation": np.eye(4)[:, 3:].repeat(4, axis=1),
        "opacity": np.full(4, 0.9),
    }
    gaussians = device_gaussians(mi.Float, position=POSITIONS_M.T, signal=np.ones(4, complex), **geometry)
    turned = Rotation.from_matrix(UPRIGHT) * Rotation.from_euler("z", turn_deg, degrees=True)
    to_world = receiver_to_world(np.zeros(3), turned.as_quat())
    sensor = {"type": "wrf_perception_plane", "to_world": to_world, "film": film(90, 360)}
    return scene_of(gaussians, sensor=sensor, **more)


def images_at_pixels(turn_deg: int = 0, **more: Any) -> np.ndarray:
    return complex_image(mi.render(scene_at_wall(turn_deg, **more)))[ROWS, (COLUMNS - turn_deg) % 360]


def test_wall_transmission_matches_sionna_rt(tmp_path):
    """The factor of a wall is that of Sionna RT's path straight through it: oblique, both polarisations mixed."""
    from sionna import rt

    integrator = CARRIER | {"thickness_itu_brick": 0.16}
    through = images_at_pixels(brick=BRICK, wall=wall(), integrator=integrator) / images_at_pixels()
    scene = sionna_wall(tmp_path)
    scene.radio_materials["itu_brick"].thickness = 0.16
    # The same wall with Sionna RT's own material: frequency and thickness are known.
    of_material = images_at_pixels(wall=scene.mi_scene.shapes()[0]) / images_at_pixels()
    np.testing.assert_allclose(of_material, through, rtol=1e-6)
    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Receiver("rx", mi.Point3f(0, 0, 0)))
    for i, position in enumerate(POSITIONS_M):
        scene.add(rt.Transmitter(f"tx-{i}", mi.Point3f(*position.tolist())))
    paths = rt.PathSolver()(scene, max_depth=1, refraction=True, specular_reflection=False)
    gain = (paths.a[0].numpy() + 1j * paths.a[1].numpy())[0, 0, :, 0, 0]
    expected = gain / (speed_of_light / FREQUENCY_HZ / (4 * np.pi * 7.0))
    np.testing.assert_allclose(through, expected, rtol=SIONNA_TOLERANCE, atol=SIONNA_TOLERANCE)


def test_default_polarisation_is_vertical_for_any_sensor_rotation():
    """A stated polarisation turns with the sensor; the default does not."""
    polarized = CARRIER | {"polarization": mi.ScalarVector3f(0, 1, 0)}
    upright, turned, turned_with_sensor = (
        images_at_pixels(turn_deg, brick=BRICK, wall=wall(), integrator=integrator)
        for turn_deg, integrator in ((0, CARRIER), (90, CARRIER), (90, polarized))
    )
    np.testing.assert_allclose(turned, upright, rtol=1e-3, atol=1e-4)  # a rotated sensor in single precision
    assert np.abs(turned_with_sensor / upright - 1).max() > 0.05


def test_only_walls_before_a_gaussian_attenuate_it():
    """Two walls multiply; one behind the Gaussians does nothing; ``walls: false`` leaves them out."""
    entries: dict[str, Any] = {"brick": BRICK, "wall": wall(), "integrator": CARRIER}
    free, one_wall = images_at_pixels(), images_at_pixels(**entries)
    two_walls = images_at_pixels(**entries, second=wall(4.0, 60.0))
    np.testing.assert_allclose(two_walls / free, (one_wall / free) ** 2, rtol=1e-4)
    for other in (wall(30.0, 60.0), wall() | {"bsdf": {"type": "null"}}):
        np.testing.assert_allclose(images_at_pixels(**entries, other=other), one_wall, rtol=1e-6)
    without = images_at_pixels(**entries | {"integrator": {"type": "wrf_traced", "walls": False}})
    np.testing.assert_array_equal(without, free)


def test_derivative_by_wall_material(tmp_path):
    """Permittivity, conductivity and thickness of a radio material: backward against differences."""
    sionna_scene = sionna_wall(tmp_path)  # its materials live as long as it does
    scene = scene_at_wall(wall=sionna_scene.mi_scene.shapes()[0])
    params = mi.traverse(scene)

    def power() -> Any:
        return dr.sum(dr.square(mi.render(scene, params)), axis=None).array

    for name in ("eta_r", "sigma", "d"):
        key = next(key for key, _ in params if key.endswith(f".{name}"))
        backward, numeric = slopes(power, params, key, plain(params[key]), 2e-3)
        assert backward == pytest.approx(numeric, rel=0.01), name


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
