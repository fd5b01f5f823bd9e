"""Channels between a base station and walking users: made once, right at each antenna and frequency, noisy as told."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from changed_folders import refusal
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree
from spectrum_records import assert_same
from trimesh.sample import sample_surface
from wrf_mi_scenes.furnished import measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import make_splits, read_nerf2_csi
from wrf_mi.receivers import antenna_csi, array_channels, csi
from wrf_mi.runs.evaluate import evaluate
from wrf_mi.synthetic import load_record, walked_channels
from wrf_mi.synthetic.floor_channels import CARRIER_HZ, DOWNLINK_HZ, PLACES, UPLINK_HZ, Walk, users_way, with_noise
from wrf_mi.tasks import instrument_of
from wrf_mi.tasks.scores import cea_db
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.tracer import RayTracer

SMALL = Walk(rows=2, columns=3, users=1, places=4, depth=3, reflections=1, rays=1 << 12, scattered_rays=1 << 6)
FLOAT64 = 1e-9
"""Products of 51 turns in place of exponentials, against the largest coefficient."""
MIDDLE = 0.01
"""Reflection coefficients at the array's middle in place of each element's, 0.09 m away: a wall at 3 m is met at angles
that differ by 0.015 rad at most."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return walked_channels("flat", tmp_path_factory.mktemp("walked") / "flat", SMALL)


def test_data_are_stored_and_reproducible(record: Record, tmp_path: Path) -> None:
    file = Path(record.source, "csidata.npy")
    before = file.stat().st_mtime_ns
    assert_same(walked_channels("flat", record.source, SMALL), record)
    assert file.stat().st_mtime_ns == before
    moved = walked_channels("flat", tmp_path / "moved", replace(SMALL, seed=2))
    assert not np.array_equal(record.tx_pos_m, moved.tx_pos_m)
    walked_channels("flat", tmp_path / "moved", SMALL)
    assert_same(read_nerf2_csi(tmp_path / "moved"), record, "name")


def test_record_has_the_stated_shapes_and_splits(record: Record) -> None:
    rows = len(PLACES["flat"]().routes) * SMALL.places
    assert (record.name, record.task.name, len(record)) == ("traced-csi-flat", "csi", rows)
    assert record.observation.shape == record.truth.shape == (1, *record.uplink.shape) == (1, rows, 6, 26)
    assert record.has_positions
    assert np.abs(record.truth).max(axis=(0, 2, 3)).min() > 0
    np.testing.assert_array_equal(record.uplink_hz, UPLINK_HZ)
    np.testing.assert_array_equal(record.frequencies_hz, DOWNLINK_HZ)
    assert [len(part) for part in record.official] == [16, 4]
    np.testing.assert_allclose(record.receivers[0].position_m, PLACES["flat"]().station_m)
    np.testing.assert_allclose(record.receivers[0].to_world[:, 2], [1, 0, 0], atol=FLOAT64)
    for rule in ("official", "random", "blocked", "trajectory"):
        assert {len(split.all_train) for split in make_splits(record, rule, n_train=5)} == {5}


def test_scores_compare_with_the_channel_without_noise(record: Record) -> None:
    (split,) = make_splits(record, "official")
    exact, noisy = (
        evaluate(record, split, lambda rows, receiver, reported=reported: reported[receiver, rows])[0]
        for reported in (record.truth, record.observation)
    )
    assert exact["cea_db"]["median"] > 100
    # At one antenna, which may receive less than the mean over them.
    assert SMALL.snr_db - 6 < noisy["cea_db"]["median"] < SMALL.snr_db + 3


def test_noise_has_the_stated_snr() -> None:
    rng = np.random.default_rng(3)
    channel = (rng.standard_normal((2, 100, 100)) + 1j) * np.array([1.0, 1e-5])[:, None, None]
    noise = with_noise(channel, 25.0, rng) - channel
    power = (np.abs(noise) ** 2).mean(axis=(1, 2)) / (np.abs(channel) ** 2).mean(axis=(1, 2))
    # 10,000 values: 1 % of the power, 0.04 dB, is one standard deviation.
    np.testing.assert_allclose(-10 * np.log10(power), 25, atol=0.25)
    real, imaginary = noise[0].real, noise[0].imag
    assert abs(real.var() / imaginary.var() - 1) < 0.1
    assert abs((real * imaginary).mean()) < 0.1 * real.var()


@pytest.fixture(scope="module")
def bare_room(tmp_path_factory: pytest.TempPathFactory) -> tuple[object, Receiver, np.ndarray, np.ndarray]:
    """An empty room with an array, its elements, and users in it."""
    folder = tmp_path_factory.mktemp("bare")
    write_scene(folder, measured_parts(0.0, 0), "test")
    receiver = Receiver("array", np.array([1.5, 3.2, 1.7]), np.array([0.5, 0.5, 0.5, 0.5]))
    users = np.array([[4.2, 3.0, 1.2], [4.5, 1.6, 1.7], [3.0, 5.0, 1.0]])
    return open_scene(folder, CARRIER_HZ), receiver, planar_array(2, 4, speed_of_light / CARRIER_HZ / 2), users


def ends_of(users: np.ndarray) -> list[Receiver]:
    return [Receiver(str(row), place, np.array([0.0, 0, 0, 1])) for row, place in enumerate(users)]


OPTIONS = TraceOptions(depth=2, rays=1 << 14)


def test_specular_channels_are_reciprocal(bare_room: tuple) -> None:
    scene, receiver, array_m, users = bare_room
    frequencies = np.concatenate([UPLINK_HZ[::5], DOWNLINK_HZ[::5]])
    there = trace_paths(scene, users, receiver, OPTIONS).paths
    back = trace_paths(scene, receiver.position_m, ends_of(users), OPTIONS, search_from="transmitters").paths
    expected = np.stack([antenna_csi(there, receiver, array_m, one)[0, ..., 0] for one in frequencies], axis=-1)
    found = array_channels(back, receiver, array_m, frequencies)
    assert np.abs(found - expected).max() < FLOAT64 * np.abs(expected).max()
    parts = np.concatenate([array_channels(back, receiver, array_m[k : k + 1], frequencies) for k in range(8)], axis=1)
    assert np.abs(found - parts).max() < FLOAT64 * np.abs(found).max()


def test_channels_are_those_traced_to_each_element(bare_room: tuple) -> None:
    scene, receiver, array_m, users = bare_room
    frequencies = np.array([UPLINK_HZ[0], DOWNLINK_HZ[-1]])
    places = receiver.position_m + array_m @ receiver.to_world.T
    expected = csi(trace_paths(scene, users, ends_of(places), OPTIONS).paths, frequencies).swapaxes(0, 1)
    back = trace_paths(scene, receiver.position_m, ends_of(users), OPTIONS).paths
    found = array_channels(back, receiver, array_m, frequencies)
    assert np.abs(found - expected).max() < MIDDLE * np.abs(expected).max()


def test_ray_tracing_of_the_same_floor_explains_most_of_the_channel(record: Record, tmp_path: Path) -> None:
    """By another way: rays from the other side, waves by their arrival; what it lacks is diffuse reflection."""
    write_scene(tmp_path, PLACES["flat"]().parts, "test")
    options = TraceOptions(transmission=True, depth=SMALL.depth, reflections=SMALL.reflections, rays=SMALL.rays)
    tracer = RayTracer(tmp_path, instrument_of(record), options)
    reported = tracer(record.tx_pos_m)
    assert reported.shape == record.observation.shape
    # 18 dB here; a wrong turn, frequency or side of the array leaves 0.
    assert np.median(cea_db(reported, record.scored)) > 12
    with pytest.raises(InputError, match="positions unknown, so there is nothing to trace between"):
        instrument_of(replace(record, tx_pos_m=np.full_like(record.tx_pos_m, np.nan)))
    refusal(instrument_of, replace(record, frequencies_hz=None), r"state frequencies_hz in base-station\.yml")


def crossed(scene: Any, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which segments [n] meet a surface."""
    import mitsuba as mi

    origin, way = mi.Point3f(start.T.astype(np.float32)), mi.Vector3f((end - start).T.astype(np.float32))
    return np.array(scene.mi_scene.ray_test(mi.Ray3f(origin, way, 1.0, 0.0, [])))


@pytest.mark.parametrize("place", PLACES)
def test_users_walk_in_the_open_and_through_doors(place: str, tmp_path: Path) -> None:
    plan, walk, rng = PLACES[place](), Walk(), np.random.default_rng(0)
    write_scene(tmp_path, plan.parts, "test")
    scene = open_scene(tmp_path, CARRIER_HZ)
    mesh = trimesh.util.concatenate([mesh for _, mesh in plan.parts.values()])
    tree = cKDTree(sample_surface(mesh, int(mesh.area / 1e-3), seed=1)[0])
    for route in plan.routes:
        way = users_way(route, walk, rng)
        assert way.shape == (walk.places, 3)
        assert tree.query(way)[0].min() > 0.15  # a person's half width
        assert not crossed(scene, way, np.roll(way, -1, axis=0)).any()
        steps = np.linalg.norm(way - np.roll(way, 1, axis=0), axis=1)
        assert steps.max() < 2 * np.median(steps)
    assert crossed(scene, np.array([[1.0, 1.0, 1.2]]), np.array([[1.0, -1.0, 1.2]])).all()  # a wall
    assert tree.query([plan.station_m])[0] > 0.15


NAMES = {
    "traced-csi-flat": ("walked_channels", ("flat",)),
    "traced-csi-office": ("walked_channels", ("office",)),
    "traced-floor-receivers": ("traced_floor_strengths", ()),
    "traced-floor-receivers-csi": ("traced_floor_channels", ()),
    "traced-room-bands": ("traced_room_bands", ()),
}


@pytest.mark.parametrize("name", NAMES)
def test_names_of_synthetic_data_are_known(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    function, arguments = NAMES[name]
    asked = []
    monkeypatch.setattr(f"wrf_mi.synthetic.{function}", lambda *place, progress: asked.append((place, progress)))
    load_record(name, progress=True)
    assert asked == [(arguments, True)]


def test_unknown_places_are_refused(tmp_path: Path) -> None:
    refusal(walked_channels, "garden", tmp_path, "place 'garden': unknown; give one of flat, office")
