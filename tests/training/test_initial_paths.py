"""Gaussians that start from traced paths or from a mesh."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from traced_rooms import FREQUENCY_HZ, HEIGHT, LENGTH, SHOEBOX, WIDTH, inside, receiver, room, write_xml

from wrf_mi.core import InputError, Record
from wrf_mi.core.settings import with_settings
from wrf_mi.gaussians import WrfGsPlus
from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.training.config import InitialConfig, TrainConfig
from wrf_mi.training.initial import gaussians_from_mesh, gaussians_from_paths, initial_gaussians

STATION = receiver([3.0, 2.0, 1.0])


@pytest.fixture(scope="module")
def traced(tmp_path_factory):
    """Paths and positions of transmitters."""
    scene, tx = room(tmp_path_factory.mktemp("scene")), inside(12)
    return trace_paths(scene, tx, STATION, TraceOptions(depth=1, rays=1 << 12)).paths, tx


def start_from(paths, tx, count):
    return gaussians_from_paths(paths, tx, (STATION,), count, np.random.default_rng(0))


def test_gaussians_start_at_sources_of_paths(traced):
    paths, tx = traced
    start = start_from(paths, tx, 40)
    assert start.count == 40
    # Clusters mix points of one wall; in a convex room their means are inside it.
    assert (start.position_m > -0.3).all()
    assert (start.position_m < np.array([LENGTH, WIDTH, HEIGHT]) + 0.3).all()
    on_wall = np.abs(start.position_m[:, :, None] - np.array([[0, LENGTH], [0, WIDTH], [0, HEIGHT]])).min(axis=(1, 2))
    assert (on_wall < 0.1).mean() > 0.4
    # What carries most power is a direct path, and starts as the strongest and least transparent.
    strongest = int(np.abs(start.signals).argmax())
    assert np.linalg.norm(tx - start.position_m[strongest], axis=1).min() < 1.0
    assert start.opacity.argmax() == strongest
    assert np.isclose(np.abs(start.signals).max(), 0.3)


def test_field_starts_with_signals_of_paths(traced):
    paths, tx = traced
    start = start_from(paths, tx, 20)
    weights = WrfGsPlus(layers=2, width=8, skip=1).init(start, np.random.default_rng(0))
    assert weights["opacity"].shape == (1, 20)
    assert np.array_equal(weights["signal"][0] + 1j * weights["signal"][1], start.signals.astype(np.complex64))
    assert np.isfinite(weights["opacity"]).all()
    assert np.ptp(weights["opacity"]) > 0


def test_more_gaussians_than_clusters_are_jittered(traced):
    paths, tx = traced
    assert len(np.unique(start_from(paths.select(np.arange(2)), tx, 9).position_m, axis=0)) == 9
    with pytest.raises(InputError, match="no path"):
        start_from(paths.select(np.arange(0)), tx, 4)


def test_gaussians_on_a_mesh_are_distributed_by_area(tmp_path):
    triangles = np.concatenate([mesh.triangles for _, mesh in SHOEBOX.values()])
    start = gaussians_from_mesh(triangles, 2000, np.random.default_rng(0))
    floor = np.abs(start.position_m[:, 2]) < 1e-9
    share = LENGTH * WIDTH / (2 * (LENGTH * WIDTH + LENGTH * HEIGHT + WIDTH * HEIGHT))
    assert abs(floor.mean() - share) < 4 * np.sqrt(share * (1 - share) / 2000)  # four deviations of a draw
    with pytest.raises(InputError, match="no surface"):
        gaussians_from_mesh(np.zeros((1, 3, 3)), 4, np.random.default_rng(0))


def test_gaussians_start_from_the_source_in_the_settings(tmp_path):
    scene, tx, hz = str(write_xml(tmp_path, SHOEBOX)), inside(40), np.array([FREQUENCY_HZ])
    record = Record("room", "spectrum", tx, (STATION,), np.zeros((1, 40, 2, 4), np.float32), frequencies_hz=hz)
    rows = np.flatnonzero(tx[:, 0] < LENGTH / 2)

    def start(record=record, count=40, **source):
        """Positions, and their distances from a wall."""
        config = InitialConfig(count, **source)
        position = initial_gaussians(config, record, rows, np.random.default_rng(0)).position_m
        return position, np.minimum(np.abs(position), np.abs(position - [LENGTH, WIDTH, HEIGHT])).min(axis=1)

    for mesh in (scene, str(tmp_path / "floor.ply")):  # a mesh without materials has surfaces as well
        assert start(mesh=mesh)[1].max() < 1e-5  # float32 of some metres
    position, from_a_wall = start(count=200, paths=scene)
    # Direct paths begin at transmitters: at those of the training rows, and at none of the others.
    standing = position[from_a_wall > 0.25]
    assert len(standing) > 5
    assert cdist(standing, tx[rows]).min(axis=1).max() < 0.5
    assert standing[:, 0].max() < LENGTH / 2
    with pytest.raises(InputError, match="room states no carrier frequency"):
        start(replace(record, frequencies_hz=None), paths=scene)
    with pytest.raises(InputError, match=r"is a mesh without radio materials; .*wrf-mi mesh room.ply --out DIR"):
        start(paths="room.ply")
    with pytest.raises(InputError, match="Gaussians start from one"):
        with_settings(TrainConfig(), ["initial.mesh=a", "initial.paths=b"])
