"""Gaussians that start from traced paths or from a mesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from traced_rooms import HEIGHT, LENGTH, SHOEBOX, WIDTH, inside, receiver, room

from wrf_mi.core import InputError, Paths
from wrf_mi.field import WrfGsPlus
from wrf_mi.field.initial_paths import gaussians_from_mesh, gaussians_from_paths
from wrf_mi.trace import TraceOptions, trace_paths


@pytest.fixture(scope="module")
def traced(tmp_path_factory: pytest.TempPathFactory) -> tuple[Paths, np.ndarray]:
    scene, tx = room(tmp_path_factory.mktemp("scene")), inside(12)
    return trace_paths(
        scene, tx, receiver([3.0, 2.0, 1.0]), TraceOptions(max_depth=1, rays=1 << 12, upright=True)
    ).paths, tx


def test_gaussians_lie_where_waves_come_from(traced: tuple[Paths, np.ndarray]) -> None:
    paths, tx = traced
    start = gaussians_from_paths(paths, tx, (receiver([3.0, 2.0, 1.0]),), 40, np.random.default_rng(0))
    assert start.count == 40
    # Clusters mix points of one wall; in a convex room their means are inside it.
    assert (start.position_m > -0.3).all()
    assert (start.position_m < np.array([LENGTH, WIDTH, HEIGHT]) + 0.3).all()
    on_wall = np.abs(start.position_m[:, :, None] - np.array([[0, LENGTH], [0, WIDTH], [0, HEIGHT]])).min(axis=(1, 2))
    assert (on_wall < 0.1).mean() > 0.4
    assert start.signals is not None
    assert start.opacities is not None
    # What carries most power is a direct path, and starts as the strongest and least transparent.
    strongest = int(np.abs(start.signals).argmax())
    assert np.linalg.norm(tx - start.position_m[strongest], axis=1).min() < 1.0
    assert start.opacities.argmax() == strongest
    assert np.isclose(np.abs(start.signals).max(), 0.3)


def test_maps_from_transmitter_to_image_are_mirrors(traced: tuple[Paths, np.ndarray]) -> None:
    paths, tx = traced
    wall = paths.object_names.index("west")
    own = paths.select(paths.objects[:, 0] == wall)
    start = gaussians_from_paths(own, tx, (receiver([3.0, 2.0, 1.0]),), 1, np.random.default_rng(0))
    assert start.image_map is not None
    image = np.column_stack([tx, np.ones(len(tx))]) @ start.image_map[0].T
    assert np.allclose(image, tx * [-1, 1, 1], atol=1e-4)  # float32 corners of the wall at x = 0


def test_a_field_starts_with_them(traced: tuple[Paths, np.ndarray]) -> None:
    paths, tx = traced
    start = gaussians_from_paths(paths, tx, (receiver([3.0, 2.0, 1.0]),), 20, np.random.default_rng(0))
    weights = WrfGsPlus(layers=2, width=8, skip=1).init(start, np.random.default_rng(0)) | start.static_signal()
    assert weights["opacity"].shape == (1, 20)
    assert weights["signal"].shape == (2, 20)
    assert np.isfinite(weights["opacity"]).all()
    assert np.ptp(weights["opacity"]) > 0


def test_more_gaussians_than_points_are_spread(traced: tuple[Paths, np.ndarray]) -> None:
    paths, tx = traced
    one = paths.select(np.arange(2))
    start = gaussians_from_paths(one, tx, (receiver([3.0, 2.0, 1.0]),), 9, np.random.default_rng(0))
    assert len(np.unique(start.position_m, axis=0)) == 9
    with pytest.raises(InputError, match="no path"):
        gaussians_from_paths(paths.select(np.arange(0)), tx, (receiver([3.0, 2.0, 1.0]),), 4, np.random.default_rng(0))


def test_a_mesh_is_covered_by_area(tmp_path: Path) -> None:
    triangles = np.concatenate([mesh.triangles for _, mesh in SHOEBOX.values()])
    start = gaussians_from_mesh(triangles, 2000, np.random.default_rng(0))
    floor = np.abs(start.position_m[:, 2]) < 1e-9
    share = LENGTH * WIDTH / (2 * (LENGTH * WIDTH + LENGTH * HEIGHT + WIDTH * HEIGHT))
    assert abs(floor.mean() - share) < 4 * np.sqrt(share * (1 - share) / 2000)  # four deviations of a draw
    with pytest.raises(InputError, match="no surface"):
        gaussians_from_mesh(np.zeros((1, 3, 3)), 4, np.random.default_rng(0))
