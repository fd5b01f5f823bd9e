"""Traced paths and spectra against closed forms and against Sionna RT's arrays; the embedded laboratory."""

import logging
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from traced_rooms import write_xml
from wrf_mi_scenes import content_sha256, scenes
from wrf_mi_scenes.build_laboratory import build, sheet

from wrf_mi.core import Antenna, InputError, Receiver, azimuth_elevation, rotation_matrix
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import make_splits, registry
from wrf_mi.receivers import antenna_csi
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.synthetic import laboratory_record, load_record, stored
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tracing import TraceOptions, open_scene, set_frequency, trace_paths
from wrf_mi.tracing.sionna.materials import BELOW_1_GHZ
from wrf_mi.tracing.sionna.path_solver import sionna_orientation

WAVELENGTH_M = speed_of_light / FREQUENCY_HZ
ARRAY_M = planar_array(4, 4, SPACING_M)

SINGLE = 2e-4  # Relative; single precision of Sionna RT's gains, and a metal that is not quite a perfect conductor
LENGTH_M = 1e-5  # Lengths from Sionna RT's single-precision vertices, ten metres away
ANGLE_OF_ELEMENTS = 0.03
"""Relative; Sionna RT reflects at each element's own angle, `antenna_csi` at the array's origin: 0.24 m in 5 m."""
PEAK_DEG = 1.5  # A peak lies on the nearest pixel, and the array sees a spherical wave


def upright(turn_deg, position):
    """An array whose y axis is the world's z and whose boresight points from +x by an angle towards +y."""
    standing = Rotation.from_matrix([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    turned = Rotation.from_euler("z", turn_deg, degrees=True) * standing
    return Receiver("gateway1", np.array(position), turned.as_quat())


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    """A large sheet of metal at z = 0."""
    parts = {"ground": ("itu_metal", sheet(2, 0.0, (-100.0, 100.0), (-100.0, 100.0)))}
    return open_scene(write_xml(tmp_path_factory.mktemp("ground"), parts), FREQUENCY_HZ, {"itu_metal": 0.1})


@pytest.fixture(scope="module")
def laboratory(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cache") / "laboratory"
    return laboratory_record(folder), folder


def spherical(distance_m):
    """Gain of a wave with its phase."""
    return WAVELENGTH_M / (4 * np.pi * distance_m) * np.exp(-2j * np.pi * distance_m / WAVELENGTH_M)


def assert_peak(image, direction, off_deg):
    """The largest pixel of a hemisphere lies in a direction of the array's frame."""
    azimuth, elevation = np.degrees(azimuth_elevation(direction))
    row, column = np.unravel_index(image.argmax(), image.shape)
    assert abs(row - elevation) < off_deg
    assert abs(column - azimuth) * np.cos(np.radians(elevation)) < off_deg


@pytest.mark.parametrize("turn_deg", [0, 37, 200])
def test_signals_and_spectra_in_free_space(turn_deg):
    from sionna import rt

    empty, receiver, towards = rt.load_scene(), upright(turn_deg, (1.0, 2.0, 3.0)), np.array([0.2, 0.1, 1.0])
    empty.frequency = FREQUENCY_HZ
    positions = receiver.position_m + np.array([4.0, 40.0])[:, None] * (receiver.to_world @ towards)
    paths = trace_paths(empty, positions, receiver).paths
    elements = receiver.position_m + ARRAY_M @ receiver.to_world.T
    expected = spherical(np.linalg.norm(positions[:, None] - elements, axis=-1))
    np.testing.assert_allclose(antenna_csi(paths, receiver, ARRAY_M, FREQUENCY_HZ)[0, ..., 0], expected, rtol=SINGLE)
    instrument = Instrument("array", (replace(receiver, array_m=ARRAY_M),), np.array([FREQUENCY_HZ]))
    spectrum = instrument.observe(paths)[0]
    assert (spectrum.dtype, spectrum.shape) == (np.float32, (2, 90, 360))
    for image in spectrum:
        assert (image.min(), image.max()) == (0, 1)
        assert_peak(image, towards, PEAK_DEG)


def test_signals_over_a_metal_floor_are_those_of_two_paths(ground):
    """The reflected wave comes from the image below the floor; a vertical field keeps its sign."""
    receiver, source = upright(10, (0.0, 0.0, 1.5)), np.array([6.0, 1.0, 1.1])
    paths = trace_paths(ground, source[None], receiver, TraceOptions(depth=2)).paths
    assert paths.bounces.tolist() == [0, 1]
    elements = receiver.position_m + ARRAY_M @ receiver.to_world.T
    expected = np.zeros(16, complex)
    for place, length in zip((source, source * [1, 1, -1]), paths.length_m, strict=True):
        assert length == pytest.approx(np.linalg.norm(place - receiver.position_m), abs=LENGTH_M)
        expected += spherical(np.linalg.norm(place - elements, axis=-1))
    signals = antenna_csi(paths, receiver, ARRAY_M, FREQUENCY_HZ)[0, 0, :, 0]
    np.testing.assert_allclose(signals, expected, atol=10 * SINGLE * np.abs(expected).max())


def test_signals_of_a_transmitter_without_a_path_are_zero(ground):
    paths = trace_paths(
        ground, [[3.0, 0, -1], [3.0, 0, 1]], upright(0, (0.0, 0, 1)), TraceOptions(transmission=False)
    ).paths
    assert set(paths.tx.tolist()) == {1}
    signals = antenna_csi(paths, upright(0, (0.0, 0, 1)), ARRAY_M, FREQUENCY_HZ)[0, ..., 0]
    assert (signals[0] == 0).all()
    assert (signals[1] != 0).all()


def test_signals_agree_with_an_array_traced_by_sionna_rt(tmp_path):
    """In a bare room every element sees every path, so that Sionna RT's sum for each element is a reference."""
    import mitsuba as mi
    from sionna import rt

    walls = {"floor": ("itu_concrete", sheet(2, 0.0, (0.0, 6.0), (0.0, 5.0)))}
    walls |= {"west": ("itu_brick", sheet(0, 0.0, (0.0, 5.0), (0.0, 3.0)))}
    walls |= {"south": ("itu_glass", sheet(1, 0.0, (0.0, 6.0), (0.0, 3.0)))}
    scene, source = open_scene(write_xml(tmp_path, walls), FREQUENCY_HZ), np.array([1.3, 2.9, 1.6])
    receiver = replace(upright(195, (5.0, 2.4, 1.2)), antenna=Antenna(frame="array"))
    paths = trace_paths(scene, source[None], receiver).paths
    assert len(paths.gain) == 8  # up to one reflection at each of three mutually perpendicular mirrors
    signals = antenna_csi(paths, receiver, ARRAY_M, FREQUENCY_HZ)[0, 0, :, 0]

    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    x, y, z = (ARRAY_M / WAVELENGTH_M).T.astype(np.float32)
    scene.rx_array = rt.AntennaArray(scene.rx_array.antenna_pattern, mi.Point3f(z, x, y))
    angles = mi.Point3f(sionna_orientation(receiver.antenna.to_world(receiver.orientation_xyzw)))
    scene.add(rt.Receiver("array", mi.Point3f(receiver.position_m.tolist()), angles))
    scene.add(rt.Transmitter("source", mi.Point3f(source.tolist())))
    traced = rt.PathSolver(deterministic=True)(scene, synthetic_array=False, refraction=False, samples_per_src=10_000)
    reference = traced.cir(normalize_delays=False, out_type="numpy")[0][0, :, 0, 0, :, 0].sum(axis=-1)
    np.testing.assert_allclose(signals, reference, atol=ANGLE_OF_ELEMENTS * np.abs(reference).max())


@pytest.mark.parametrize("quaternion", [*np.random.default_rng(0).normal(size=(5, 4)), [0, 0, 0, 1.0], [1.0, 0, 0, 0]])
def test_orientation_turns_a_device_as_the_quaternion_turns_the_array(quaternion):
    """The last two have many equivalent angles."""
    import mitsuba as mi
    from sionna.rt.utils import rotation_matrix as sionna_rotation

    turned = Antenna(frame="array").to_world(quaternion)
    device = sionna_rotation(mi.Point3f(sionna_orientation(turned))).numpy()[:, :, 0]
    array = rotation_matrix(quaternion)
    # Boresight, and the array's x and y: Sionna RT has them on its x, y and z.
    np.testing.assert_allclose(device, array[:, [2, 0, 1]], atol=1e-6)  # single precision


def test_materials_below_their_range_have_constants(tmp_path, caplog):
    from sionna.rt.radio_materials.itu import itu_material

    for name, constants in BELOW_1_GHZ.items():
        np.testing.assert_allclose([float(np.ravel(v)[0]) for v in itu_material(name, 1e9)], constants, rtol=1e-6)
    brick_and_wood = enumerate(("itu_brick", "itu_wood"))
    xml = write_xml(tmp_path, {f"p{z}": (kind, sheet(2, z, (0.0, 1.0), (0.0, 1.0))) for z, kind in brick_and_wood})
    with caplog.at_level(logging.INFO, "wrf_mi.tracing.sionna.materials"):
        scene = open_scene(xml, 915e6, {"itu_brick": 0.2})
        assert caplog.messages == [
            "915 MHz is below the range of ITU-R P.2040 for brick: constant values of 1 GHz used"
        ]
        caplog.clear()
        at_2_4 = open_scene(xml, 2.4e9)
    assert caplog.messages == []
    brick, wood = scene.radio_materials["itu_brick"], scene.radio_materials["itu_wood"]
    for name, value in (("relative_permittivity", 3.91), ("conductivity", 0.0238), ("thickness", 0.2)):
        assert float(getattr(brick, name)[0]) == pytest.approx(value)
    assert float(wood.conductivity[0]) == pytest.approx(0.0047 * 0.915**1.0718, rel=1e-5)
    assert float(at_2_4.radio_materials["itu_brick"].conductivity[0]) == pytest.approx(0.0238 * 2.4**0.16, rel=1e-5)
    with pytest.raises(InputError, match=r"itu_brick: not known at 0\.1 GHz"):
        set_frequency(scene, 100e6)


def test_laboratory_spectra_peak_at_the_transmitter(laboratory):
    record, _ = laboratory
    assert record.observation.shape == (1, 200, 90, 360)
    spectra = record.observation[0]
    assert (spectra.min(axis=(1, 2)) == 0).all()
    assert (spectra.max(axis=(1, 2)) == 1).all()
    assert record.official is not None
    assert [len(part) for part in record.official] == [160, 40]
    assert make_splits(record, "official")[0].test.tolist() == sorted(record.official[1].tolist())
    np.testing.assert_array_equal(record.tx_pos_m, transmitter_path())
    assert (np.ptp(record.tx_pos_m, axis=0) <= [0.501, 1.001, 0.201]).all()
    # Reflections shift the peaks of single spectra; the mean peaks in the line of sight.
    sight = (record.tx_pos_m - record.receivers[0].position_m) @ record.receivers[0].to_world
    assert_peak(spectra.mean(axis=0), sight.mean(axis=0), 3)


def test_laboratory_is_cached_and_reproducible(laboratory, monkeypatch, tmp_path):
    record, folder = laboratory
    np.testing.assert_array_equal(laboratory_record(tmp_path / "again").observation, record.observation)
    assert {path.name for path in folder.parent.iterdir()} == {"laboratory"}
    monkeypatch.setattr("wrf_mi.synthetic.laboratory.RayTracer", lambda *_, **__: pytest.fail("traced anew"))
    monkeypatch.delenv("WRF_MI_DATA", raising=False)
    for module in (registry, stored):
        monkeypatch.setattr(module, "user_cache", lambda: folder.parent)
    np.testing.assert_array_equal(load_record("laboratory").observation, record.observation)
    assert load_record(folder).name == "laboratory"
    recipe = folder / "traced.yml"
    recipe_text = recipe.read_text()
    recipe.write_text(recipe_text.replace("depth: 3", "depth: 2"))
    with pytest.raises(pytest.fail.Exception, match="traced anew"):
        laboratory_record(folder)
    recipe.write_text(recipe_text)


def test_embedded_scene_is_intact_and_rebuilt_alike(tmp_path):
    info = scenes()["laboratory"]
    assert info.is_intact()
    assert (info.licence, info.units) == ("MIT", "m")
    build(tmp_path)
    assert content_sha256(tmp_path, info.xml.name) == info.sha256, "run python -m wrf_mi_scenes.build_laboratory"
    (tmp_path / "meshes" / "door.ply").unlink()
    assert content_sha256(tmp_path, info.xml.name) != info.sha256


def test_mitsuba_and_sionna_rt_open_the_laboratory():
    import mitsuba as mi

    info = scenes()["laboratory"]
    meshes = {path.stem: trimesh.load_mesh(path) for path in (info.folder / "meshes").glob("*.ply")}
    plain = mi.load_file(str(info.xml), optimize=False)  # else it merges shapes
    sionna = open_scene(info.xml, FREQUENCY_HZ, info.thickness_m)
    assert {shape.id().removeprefix("mesh-") for shape in plain.shapes()} == set(meshes) == set(sionna.objects)
    thickness_m = {name: float(material.thickness[0]) for name, material in sionna.radio_materials.items()}
    assert thickness_m == pytest.approx(info.thickness_m)
    bounds = plain.bbox()
    np.testing.assert_allclose([bounds.min, bounds.max], [[0, 0, 0], [9, 7, 3]], atol=1e-6)
    # Antennas are in air.
    for place in (*transmitter_path()[::20], RECEIVER.position_m):
        assert not any(mesh.is_watertight and mesh.contains([place])[0] for mesh in meshes.values())
