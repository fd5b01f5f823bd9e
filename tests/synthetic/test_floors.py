"""Receivers and walking users on synthetic floors: stored once, right at each antenna and carrier, noisy as stated."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal
from made_rooms import joined
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree
from spectrum_records import assert_same
from trimesh.sample import sample_surface
from wrf_mi_scenes import floor_plans
from wrf_mi_scenes.furnished import measured_parts
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import load, make_splits, read_nerf2_csi
from wrf_mi.receivers import antenna_csi, array_channels
from wrf_mi.receivers.channel import csi, rssi_dbm
from wrf_mi.runs.evaluate import evaluate
from wrf_mi.synthetic import load_record, traced_floor_channels, traced_floor_strengths, walked_channels
from wrf_mi.synthetic.floor_channels import CARRIER_HZ as WALK_HZ
from wrf_mi.synthetic.floor_channels import DOWNLINK_HZ, PLACES, UPLINK_HZ, Walk, users_way, with_noise
from wrf_mi.synthetic.floor_receivers import (
    CARRIER_HZ,
    DEFAULT,
    FloorReceivers,
    floor_devices,
    strengths_of,
    trace_floor,
)
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tasks import instrument_of
from wrf_mi.tasks.scores import cea_db
from wrf_mi.tracing import TraceOptions, TraceResult, open_scene, trace_paths
from wrf_mi.tracing.tracer import RayTracer

SMALL = FloorReceivers(columns=3, rows=2, train=8, test=4, rays=1 << 11, scattered_rays=1 << 6, depth=3, reflections=1)
QUIET = replace(SMALL, noise_db=0.0, offset_db=0.0, sensitivity_dbm=-500.0)
FLOAT32_DB = 1e-3
"""Signal strengths of some tens of dB are stored in float32."""
SINGLE = 1e-5
"""Relative to the largest coefficient: powers and phases of paths are stored in float32."""


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return traced_floor_strengths(tmp_path_factory.mktemp("floor") / "rssi", SMALL)


@pytest.fixture(scope="module")
def scene_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("scene")
    write_scene(work, floor_plans.office().parts, "test")
    return work


@pytest.fixture(scope="module")
def traced(scene_folder: Path) -> TraceResult:
    return trace_floor(scene_folder, floor_plans.office(), SMALL)


def test_record_has_the_stated_rows_and_receivers(record: Record) -> None:
    assert (record.name, record.task.name) == ("traced-floor-receivers", "rssi")
    assert record.observation.shape == (6, 12)
    assert [receiver.name for receiver in record.receivers] == [f"anchor{k}" for k in range(1, 7)]
    np.testing.assert_array_equal(record.frequencies_hz, [CARRIER_HZ])
    assert [part.tolist() for part in record.official] == [list(range(8)), list(range(8, 12))]
    assert np.nanmin(record.observation) >= SMALL.sensitivity_dbm
    assert Path(record.source, SCAN).is_file()
    assert len(open_scene(Path(record.source, "floor"), CARRIER_HZ).objects) == len(floor_plans.office().bare)


def test_data_are_stored_and_reproducible(record: Record, traced: TraceResult) -> None:
    file = Path(record.source, "train.csv")
    before = file.stat().st_mtime_ns
    assert_same(traced_floor_strengths(record.source, SMALL), record)
    assert file.stat().st_mtime_ns == before
    np.testing.assert_array_equal(traced.tx_pos_m, record.tx_pos_m)
    np.testing.assert_array_equal(strengths_of(traced, SMALL).observation, record.observation)


def test_devices_are_spread_outside_of_bodies(scene_folder: Path) -> None:
    scene, plan = open_scene(scene_folder, CARRIER_HZ), floor_plans.office()
    receivers, transmitters = floor_devices(scene, plan, DEFAULT)
    assert not np.array_equal(floor_devices(scene, plan, replace(DEFAULT, seed=2))[1], transmitters)
    places = np.stack([receiver.position_m for receiver in receivers])
    assert (places.shape, transmitters.shape) == ((16, 3), (400, 3))
    np.testing.assert_array_equal(places[:, 2], DEFAULT.mount_m)
    cells = np.floor(places[:, :2] / [18 / 4, 10 / 4]).astype(int)
    assert len(np.unique(cells, axis=0)) == 16
    apart = np.linalg.norm(transmitters[:, None] - places, axis=-1)
    assert apart.min() > DEFAULT.from_receiver_m
    assert ((transmitters[:, 2] >= DEFAULT.low_m) & (transmitters[:, 2] <= DEFAULT.high_m)).all()
    for position in (*transmitters, *places):  # the metal core
        assert not ((position[:2] > [8.6, 2.2]) & (position[:2] < [10.4, 4.0])).all()


def test_strengths_are_the_power_of_all_paths(traced: TraceResult) -> None:
    expected = rssi_dbm(traced.paths) + SMALL.power_dbm  # NaN without a path, as in the record
    np.testing.assert_allclose(strengths_of(traced, QUIET).observation, expected, atol=FLOAT32_DB)
    kinds = set(np.unique(traced.paths.interactions))
    assert {1, 2, 4} < kinds  # reflection, scattering, transmission
    assert 8 not in kinds


def test_offsets_noise_and_sensitivity_are_the_stated_ones(traced: TraceResult) -> None:
    quiet = strengths_of(traced, QUIET).observation
    offset = strengths_of(traced, replace(QUIET, offset_db=3.0)).observation - quiet
    assert (np.nanmax(offset, axis=1) - np.nanmin(offset, axis=1)).max() < FLOAT32_DB
    assert 1 < np.nanmedian(offset, axis=1).std() < 6
    noise = strengths_of(traced, replace(QUIET, noise_db=2.0)).observation - quiet
    assert np.nanstd(noise) == pytest.approx(2, rel=0.3)  # three standard deviations of the estimate from 70 values
    # Strengths below the sensitivity are not received.
    all_received = strengths_of(traced, replace(SMALL, sensitivity_dbm=-500.0)).observation
    ordered = np.sort(all_received[np.isfinite(all_received)])
    limit = float(ordered[len(ordered) // 2 :][:2].mean())
    limited = strengths_of(traced, replace(SMALL, sensitivity_dbm=limit)).observation
    np.testing.assert_array_equal(limited, np.where(all_received < limit, np.nan, all_received))


def test_specular_paths_are_those_of_a_search_without_scattering(traced: TraceResult, scene_folder: Path) -> None:
    options = TraceOptions(transmission=True, depth=3, reflections=1, rays=SMALL.rays, seed=SMALL.seed)
    alone = trace_paths(open_scene(scene_folder, CARRIER_HZ), traced.tx_pos_m, traced.receivers, options).paths
    specular = traced.paths.select(~(traced.paths.interactions == 2).any(axis=1))
    np.testing.assert_array_equal(specular.length_m, alone.length_m)
    # A reflection loses the scattered share of its power.
    reflected = (specular.interactions == 1).sum(axis=1)
    specular_share = np.sqrt(1 - SMALL.scattering**2) ** reflected
    np.testing.assert_allclose(np.abs(specular.gain), np.abs(alone.gain) * specular_share, rtol=1e-4, atol=1e-12)


def test_channels_have_the_same_paths(traced: TraceResult, tmp_path: Path) -> None:
    record = traced_floor_channels(tmp_path, SMALL)
    assert (record.name, record.task.name) == ("traced-floor-receivers-csi", "csi")
    assert record.observation.shape == (6, 12, 16)
    np.testing.assert_allclose(record.frequencies_hz, CARRIER_HZ + np.arange(16) * 1.25e6)
    np.testing.assert_allclose(record.tx_pos_m, traced.tx_pos_m, rtol=1e-6)
    expected = csi(traced.paths, record.frequencies_hz)
    assert np.nanmax(np.abs(record.observation - expected)) < SINGLE * np.abs(expected).max()
    np.testing.assert_array_equal(np.isnan(record.observation), expected == 0)
    assert [len(part) for part in record.official] == [8, 4]
    before = (tmp_path / "params.json").stat().st_mtime_ns
    assert_same(traced_floor_channels(tmp_path, SMALL), record)
    assert (tmp_path / "params.json").stat().st_mtime_ns == before
    assert load(tmp_path).observation.shape == (6, 12, 16)


WALK = Walk(rows=2, columns=3, users=1, places=4, depth=3, reflections=1, rays=1 << 12, scattered_rays=1 << 6)
FLOAT64 = 1e-9
"""Products of 51 turns in place of exponentials, against the largest coefficient."""
MIDDLE = 0.01
"""Reflection coefficients at the array's middle in place of each element's, 0.09 m away: a wall at 3 m is met at angles
that differ by 0.015 rad at most."""


@pytest.fixture(scope="module")
def walked(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return walked_channels("flat", tmp_path_factory.mktemp("walked") / "flat", WALK)


def test_channels_are_stored_and_reproducible(walked: Record, tmp_path: Path) -> None:
    file = Path(walked.source, "csidata.npy")
    before = file.stat().st_mtime_ns
    assert_same(walked_channels("flat", walked.source, WALK), walked)
    assert file.stat().st_mtime_ns == before
    moved = walked_channels("flat", tmp_path / "moved", replace(WALK, seed=2))
    assert not np.array_equal(walked.tx_pos_m, moved.tx_pos_m)
    walked_channels("flat", tmp_path / "moved", WALK)
    assert_same(read_nerf2_csi(tmp_path / "moved"), walked, "name")


def test_record_has_the_stated_shapes_and_splits(walked: Record) -> None:
    rows = len(PLACES["flat"]().routes) * WALK.places
    assert (walked.name, walked.task.name, len(walked)) == ("traced-csi-flat", "csi", rows)
    assert walked.observation.shape == walked.truth.shape == (1, *walked.uplink.shape) == (1, rows, 6, 26)
    assert walked.has_positions
    assert np.abs(walked.truth).max(axis=(0, 2, 3)).min() > 0
    np.testing.assert_array_equal(walked.uplink_hz, UPLINK_HZ)
    np.testing.assert_array_equal(walked.frequencies_hz, DOWNLINK_HZ)
    assert [len(part) for part in walked.official] == [16, 4]
    np.testing.assert_allclose(walked.receivers[0].position_m, PLACES["flat"]().station_m)
    np.testing.assert_allclose(walked.receivers[0].to_world[:, 2], [1, 0, 0], atol=FLOAT64)
    for rule in ("official", "random", "blocked", "trajectory"):
        assert {len(split.all_train) for split in make_splits(walked, rule, n_train=5)} == {5}


def rows_of(reported: Any) -> Callable[[Any, int], Any]:
    return lambda rows, receiver: reported[receiver, rows]


def test_scores_compare_with_the_channel_without_noise(walked: Record) -> None:
    (split,) = make_splits(walked, "official")
    exact, noisy = (evaluate(walked, split, rows_of(reported))[0] for reported in (walked.truth, walked.observation))
    assert exact["cea_db"]["median"] > 100
    # At one antenna, which may receive less than the mean over them.
    assert WALK.snr_db - 6 < noisy["cea_db"]["median"] < WALK.snr_db + 3


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
    return open_scene(folder, WALK_HZ), receiver, planar_array(2, 4, speed_of_light / WALK_HZ / 2), users


def ends_of(users: np.ndarray) -> list[Receiver]:
    return [Receiver(str(row), place, np.array([0.0, 0, 0, 1])) for row, place in enumerate(users)]


OPTIONS = TraceOptions(depth=2, rays=1 << 14)


def test_specular_channels_are_reciprocal(bare_room: tuple) -> None:
    scene, receiver, array_m, users = bare_room
    frequencies = np.concatenate([UPLINK_HZ[::5], DOWNLINK_HZ[::5]])
    forward = trace_paths(scene, users, receiver, OPTIONS).paths
    back = trace_paths(scene, receiver.position_m, ends_of(users), OPTIONS, search_from="transmitters").paths
    expected = np.stack(
        [antenna_csi(forward, receiver, array_m, frequency)[0, ..., 0] for frequency in frequencies], axis=-1
    )
    computed = array_channels(back, receiver, array_m, frequencies)
    assert np.abs(computed - expected).max() < FLOAT64 * np.abs(expected).max()
    parts = np.concatenate([array_channels(back, receiver, array_m[k : k + 1], frequencies) for k in range(8)], axis=1)
    assert np.abs(computed - parts).max() < FLOAT64 * np.abs(computed).max()


def test_channels_are_those_traced_to_each_element(bare_room: tuple) -> None:
    scene, receiver, array_m, users = bare_room
    frequencies = np.array([UPLINK_HZ[0], DOWNLINK_HZ[-1]])
    places = receiver.position_m + array_m @ receiver.to_world.T
    expected = csi(trace_paths(scene, users, ends_of(places), OPTIONS).paths, frequencies).swapaxes(0, 1)
    back = trace_paths(scene, receiver.position_m, ends_of(users), OPTIONS).paths
    computed = array_channels(back, receiver, array_m, frequencies)
    assert np.abs(computed - expected).max() < MIDDLE * np.abs(expected).max()


def test_ray_tracing_of_the_same_floor_explains_most_of_the_channel(walked: Record, tmp_path: Path) -> None:
    """By another way: rays from the other side, waves by their arrival; what it lacks is diffuse reflection."""
    write_scene(tmp_path, PLACES["flat"]().parts, "test")
    options = TraceOptions(transmission=True, depth=WALK.depth, reflections=WALK.reflections, rays=WALK.rays)
    tracer = RayTracer(tmp_path, instrument_of(walked), options)
    reported = tracer(walked.tx_pos_m)
    assert reported.shape == walked.observation.shape
    # 18 dB here; a wrong turn, frequency or side of the array leaves 0.
    assert np.median(cea_db(reported, walked.scored)) > 12
    with pytest.raises(InputError, match="positions unknown, so there is nothing to trace between"):
        instrument_of(replace(walked, tx_pos_m=np.full_like(walked.tx_pos_m, np.nan)))
    refusal(instrument_of, replace(walked, frequencies_hz=None), r"state frequencies_hz in base-station\.yml")


def crossed(scene: Any, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which segments [n] meet a surface."""
    import mitsuba as mi

    origin, way = mi.Point3f(start.T.astype(np.float32)), mi.Vector3f((end - start).T.astype(np.float32))
    ray: Any = mi.Ray3f(origin, way)
    ray.maxt = 1.0
    return np.array(scene.mi_scene.ray_test(ray))


@pytest.mark.parametrize("place", PLACES)
def test_users_walk_in_the_open_and_through_doors(place: str, tmp_path: Path) -> None:
    plan, walk, rng = PLACES[place](), Walk(), np.random.default_rng(0)
    write_scene(tmp_path, plan.parts, "test")
    scene = open_scene(tmp_path, WALK_HZ)
    mesh = joined([mesh for _, mesh in plan.parts.values()])
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
