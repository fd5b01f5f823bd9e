"""Where Gaussians start: drawn around receivers, or on points of a cloud that is read from a file."""

from typing import cast

import numpy as np
import pytest
import trimesh
from changed_folders import refusal
from scipy.special import expit
from scipy.stats import kstest

from wrf_mi.core import InputError, Receiver, Record, azimuth_elevation, rotation_matrix
from wrf_mi.gaussians import gaussians_from_points, random_gaussians
from wrf_mi.scene.scan.points import read_points
from wrf_mi.training.config import InitialConfig
from wrf_mi.training.initial import initial_gaussians

FLOAT32_EPS = 1e-6
"""Relative rounding of one or two float32 operations, with room."""
SMALLEST_P = 1e-3
"""Level of the tests on drawn samples. The seeds are fixed: a pass stays a pass."""
TILTED = Receiver("a", np.array([5.0, 0.3, 1.0]), np.array([0.5, -0.5, -0.5, 0.5]))
UPSIDE_DOWN = Receiver("b", np.array([-40.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0]))
POINTS = np.array([[0.5, 1.25, -2.0], [3.0, 4.5, 5.0], [6.0, -7.75, 8.0], [0.0, 0.0, 0.25], [1.0, 2.0, 3.0]])


def test_random_gaussians_fill_each_receivers_hemisphere():
    size_deg = 7.0
    start = random_gaussians([TILTED, UPSIDE_DOWN], 4001, np.random.default_rng(0), (1.0, 8.0), size_deg)
    assert start.position_m.shape == (4001, 3)
    shares = np.array_split(np.arange(4001), 2)
    for receiver, share in zip((TILTED, UPSIDE_DOWN), shares, strict=True):
        local = (start.position_m[share] - receiver.position_m) @ receiver.to_world
        (azimuth, elevation), distance = azimuth_elevation(local), np.linalg.norm(local, axis=1)
        assert 1.0 <= distance.min() <= distance.max() <= 8.0
        # Uniform on the sphere: the sine of the elevation is; a margin of one size reaches below the horizon.
        low = -np.sin(np.radians(size_deg))
        for drawn, ends in ((distance, (1, 7)), (azimuth, (0, 2 * np.pi)), (np.sin(elevation), (low, 1 - low))):
            assert kstest(drawn, "uniform", ends).pvalue > SMALLEST_P
        np.testing.assert_allclose(np.degrees(np.arctan(start.scale_m[share] / distance)), size_deg, rtol=1e-9)


def test_fewer_gaussians_than_receivers():
    start = random_gaussians([TILTED, UPSIDE_DOWN], 1, np.random.default_rng(0))
    assert start.count == 1
    assert np.isfinite(start.position_m).all()


def test_initial_geometry():
    start = random_gaussians([TILTED], 9, np.random.default_rng(2), opacity=0.3)
    weights = start.geometry()
    np.testing.assert_allclose(weights["position"].T, start.position_m, rtol=FLOAT32_EPS)
    np.testing.assert_allclose(np.exp(weights["log_scale"]), np.tile(start.scale_m, (3, 1)), rtol=FLOAT32_EPS)
    np.testing.assert_array_equal(rotation_matrix(weights["rotation"].T), np.tile(np.eye(3), (9, 1, 1)))
    np.testing.assert_allclose(expit(start.opacity_logit()), 0.3, rtol=FLOAT32_EPS)


def test_initial_scale_is_the_gap_to_neighbours():
    """A square grid's nearest three points lie one step away (at a corner two, and one across)."""
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(5), [2.0], indexing="ij"), axis=-1).reshape(-1, 3) * 0.5
    start = gaussians_from_points(grid, 25, np.random.default_rng(0))
    order = np.lexsort(start.position_m.T[::-1])
    np.testing.assert_array_equal(start.position_m[order], grid)
    corner = np.isin(grid[:, 0], [0, 2]) & np.isin(grid[:, 1], [0, 2])
    expected = np.where(corner, 0.5 * np.sqrt((1 + 1 + 2) / 3), 0.5)
    np.testing.assert_allclose(start.scale_m[order], expected)


def test_initial_positions_are_points_of_the_cloud():
    cloud = np.random.default_rng(3).normal(size=(50, 3))
    first = gaussians_from_points(cloud, 10, np.random.default_rng(4))
    assert len({tuple(p) for p in first.position_m} & {tuple(p) for p in cloud}) == 10
    # The gap is that between chosen points, which is wider than between all.
    apart = np.sort(np.linalg.norm(first.position_m[:, None] - first.position_m, axis=2), axis=1)[:, 1:4]
    np.testing.assert_allclose(first.scale_m, np.sqrt((apart**2).mean(axis=1)))
    # Points on top of each other still have a size.
    assert (gaussians_from_points(np.zeros((6, 3)), 6, np.random.default_rng(0)).scale_m > 0).all()


@pytest.mark.parametrize(
    ("points", "count", "message"),
    [
        (np.zeros((9, 2)), 4, r"expected shape \[m, 3\], got \[9, 2\]"),
        (np.zeros((9, 3)), 10, "9 points for 10 Gaussians"),
        (np.zeros((9, 3)), 3, "9 points for 3 Gaussians"),
        (np.where(np.arange(27).reshape(9, 3) == 13, np.nan, 1.0), 4, "row 5: not a number"),
    ],
)
def test_invalid_point_clouds_are_refused(points, count, message):
    with pytest.raises(InputError, match=message):
        gaussians_from_points(points, count, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.xyz", "cloud.npz"])
def test_points_are_read(name, tmp_path):
    if name == "cloud.npz":
        np.savez(tmp_path / name, points=POINTS)
    else:
        trimesh.PointCloud(POINTS).export(tmp_path / name)
    points = read_points(tmp_path / name)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, POINTS, rtol=FLOAT32_EPS)


def test_points_far_from_the_origin_are_no_start(tmp_path):
    """Their Gaussians would lie on steps of half a metre."""
    np.savez(tmp_path / "utm.npz", points=POINTS + np.array([701_362.56, 4_485_513.72, 0.0]))
    config = InitialConfig(points=str(tmp_path / "utm.npz"))
    record = cast(Record, None)  # points need none
    with pytest.raises(InputError, match=r"utm.npz: coordinates up to 4485518 m"):
        initial_gaussians(config, record, np.arange(1), np.random.default_rng(0))


def test_mesh_vertices_are_read_as_points(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.export(tmp_path / "box.obj")
    points = read_points(tmp_path / "box.obj")
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(box.vertices, axis=0))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("junk.npz", b"no archive"),
        ("junk.ply", b"ply\n\xff\x00junk"),
        ("empty.ply", b""),
        ("words.xyz", b"x y z\none two three\n"),
        ("short.xyz", b"1 2\n3 4\n"),
        ("other.foo", b"1 2 3\n"),
        ("cut.ply", trimesh.PointCloud(POINTS).export(file_type="ply")[:-20]),
    ],
)
def test_files_without_points_are_refused(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert str(tmp_path / name) in refusal(read_points, tmp_path / name, "no points to be read")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vertices": POINTS}, "no array points or xyz_m in it"),
        ({"points": POINTS[:, :2]}, r"expected points of shape \[m, 3\], got \[5, 2\]"),
        ({"points": POINTS[:0]}, "no points in it"),
        ({"points": np.array(["a", "b"])}, "no points to be read"),
        ({"points": np.where(POINTS == -7.75, np.inf, POINTS)}, "point 3: not finite"),
    ],
)
def test_arrays_without_points_are_refused(arrays, message, tmp_path):
    np.savez(tmp_path / "cloud.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / "cloud.npz")


def test_missing_files_and_files_of_several_meshes_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path / "none.ply")
    # A file of several meshes has no vertices of its own.
    trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=0)]).export(tmp_path / "scene.glb")
    with pytest.raises(InputError, match="no points in it"):
        read_points(tmp_path / "scene.glb")
