"""Image sources set right by measured channels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import sheet
from scipy.constants import speed_of_light
from traced_rooms import write_xml

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.models.physics.csi import CsiPhysics, CsiSettings, fit_csi
from wrf_mi.models.physics.csi_fit import decode
from wrf_mi.models.physics.csi_paths import candidate_paths, images_of
from wrf_mi.models.physics.csi_visibility import Learner
from wrf_mi.tasks.scores import cea_db
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.tracing.walls import outline_edges, walls_of

FREQUENCY_HZ = 2.4e9
K = 2 * np.pi * FREQUENCY_HZ / speed_of_light
LENGTH, WIDTH, HEIGHT = 4.0, 5.0, 2.6
ACCESS_POINT = Receiver("access point", np.array([0.6, 1.1, 2.1]), np.array([0.0, 0.0, 0.0, 1.0]))
QUICK = CsiSettings(rays=1 << 14, repair_rounds=6, visibility_rounds=1, folds=2)
MOVED_M = {"west": 0.003, "east": -0.004, "south": 0.002, "north": 0.005, "floor": -0.003, "ceiling": 0.004}
"""By how much the mesh has them wrong: up to a sixth of a wavelength for two reflections and both ways."""


def scene(folder: Path, wrong: dict[str, float], partition_m: float = 1.5) -> Any:
    """A room with a partition from the west wall."""
    at = {"west": 0.0, "east": LENGTH, "south": 0.0, "north": WIDTH, "floor": 0.0, "ceiling": HEIGHT}
    at = {name: value + wrong.get(name, 0.0) for name, value in at.items()}
    x, y, z = (at["west"], at["east"]), (at["south"], at["north"]), (at["floor"], at["ceiling"])
    parts = {
        "west": sheet(0, at["west"], y, z),
        "east": sheet(0, at["east"], y, z),
        "south": sheet(1, at["south"], x, z),
        "north": sheet(1, at["north"], x, z),
        "floor": sheet(2, at["floor"], x, y),
        "ceiling": sheet(2, at["ceiling"], x, y),
        "partition": sheet(1, 2.7, (at["west"], partition_m), z),
    }
    return open_scene(write_xml(folder, {name: ("itu_metal", mesh) for name, mesh in parts.items()}), FREQUENCY_HZ)


def channels(of: Any, positions: np.ndarray) -> np.ndarray:
    """By Sionna RT's paths, all mirrors perfect: what `image_method` of any kind must give."""
    paths = trace_paths(of, positions, ACCESS_POINT, TraceOptions(max_depth=2, rays=1 << 16)).paths
    gain = np.exp(-1j * K * paths.length_m) / (2 * K * paths.length_m)
    return np.bincount(paths.tx, gain.real, len(positions)) + 1j * np.bincount(paths.tx, gain.imag, len(positions))


def record(positions: np.ndarray, channel: np.ndarray) -> Record:
    return Record(
        "made-room",
        "csi",
        positions,
        (ACCESS_POINT,),
        channel[None, :, None].astype(np.complex64),
        frequencies_hz=np.array([FREQUENCY_HZ]),
    )


@pytest.fixture(scope="module")
def places() -> np.ndarray:
    return np.random.default_rng(3).uniform([0.2, 0.2, 0.2], [LENGTH - 0.2, WIDTH - 0.2, HEIGHT - 0.2], (200, 3))


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return scene(tmp_path_factory.mktemp("right"), {})


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return scene(tmp_path_factory.mktemp("wrong"), MOVED_M, partition_m=1.53)


@pytest.fixture(scope="module")
def measured(right: Any, places: np.ndarray) -> Record:
    return record(places, channels(right, places))


@pytest.fixture(scope="module")
def fitted(wrong: Any, measured: Record) -> CsiPhysics:
    return fit_csi(measured, np.arange(140), wrong, QUICK, seed=1)


def test_outline_has_no_inner_edges() -> None:
    # A square of 2 m with a hole of 1 m in its middle, from triangles that do not meet corner to corner.
    def box(x0: float, x1: float, y0: float, y1: float) -> list[list[tuple[float, float]]]:
        return [[(x0, y0), (x1, y0), (x1, y1)], [(x0, y0), (x1, y1), (x0, y1)]]

    triangles = np.array(box(0, 2, 0, 0.5) + box(0, 2, 1.5, 2) + box(0, 0.5, 0.5, 1.5) + box(1.5, 2, 0.5, 1.5), float)
    edges = outline_edges(triangles)
    lengths = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1)
    assert lengths.sum() == pytest.approx(8 + 4, abs=1e-3)


def test_margins_are_distances_to_the_outline(right: Any) -> None:
    walls = walls_of(scene_surfaces(right))
    partition = int(
        np.flatnonzero((np.abs(walls.normal[:, 1]) > 0.9) & (np.abs(np.abs(walls.offset_m) - 2.7) < 1e-6))[0]
    )
    points = np.array([[1.4, 2.7, 1.3], [1.6, 2.7, 1.3], [0.7, 2.7, 0.2]])
    inside, _ = walls.inside_m(np.full(3, partition), walls.flat(np.full(3, partition), points))
    np.testing.assert_allclose(inside, [0.1, -0.1, 0.2], atol=1e-6)  # float32 corners


def test_image_slopes_equal_finite_differences(right: Any) -> None:
    walls = walls_of(scene_surfaces(right))
    plane = np.array([[0, -1], [2, 5], [4, 1], [3, 2]])
    images = images_of(walls, ACCESS_POINT.position_m, plane)
    change = np.random.default_rng(0).normal(size=(len(walls), 3)) * 1e-6
    moved = images_of(walls.moved(change), ACCESS_POINT.position_m, plane).image_m[:, -1] - images.image_m[:, -1]
    used = (plane >= 0)[..., None]
    expected = np.einsum("clkd,clk->cd", images.slope, np.where(used, change[plane], 0))
    np.testing.assert_allclose(moved, expected, atol=1e-10)  # second order: 1e-12 times metres


def test_paths_are_those_of_the_tracer(right: Any, places: np.ndarray) -> None:
    paths = trace_paths(right, places, ACCESS_POINT, TraceOptions(max_depth=2, rays=1 << 16)).paths
    walls = walls_of(scene_surfaces(right))
    chains = [(-1, -1)] + [(i, j) for i in range(len(walls)) for j in range(-1, len(walls)) if i != j]
    seen = candidate_paths(walls, images_of(walls, ACCESS_POINT.position_m, np.array(chains)), places)
    there = (seen.inside_m > 0) & (seen.clear_m > 0)
    # A path through the very edge of a surface may be decided either way; Sionna RT drops segments below 1 cm.
    doubtful = np.minimum(np.abs(seen.inside_m), np.abs(seen.clear_m)) < 1e-4
    segments = np.linalg.norm(np.diff(seen.point_m, axis=1), axis=2)
    doubtful |= there & ((segments > 0) & (segments < 0.012)).any(axis=1)
    rows = np.setdiff1d(np.arange(len(places)), seen.row[doubtful])
    assert len(rows) > 150
    for row in rows:
        ours = np.sort(seen.length_m[there & (seen.row == row)])
        np.testing.assert_allclose(ours, np.sort(paths.length_m[paths.tx == row]), atol=1e-6)


def test_decoding_infers_existing_paths() -> None:
    rng = np.random.default_rng(5)
    rows, each = 40, 16
    row = np.repeat(np.arange(rows), each)
    length = rng.uniform(2, 12, len(row))
    gain = (np.exp(-1j * K * length) / length)[:, None]
    odds = rng.choice([-2.0, 2.0, 4.0], len(row))
    there = odds > 0
    wrong = rng.integers(each, size=(rows, 2)) + np.arange(rows)[:, None] * each
    there[wrong] ^= True
    channel = np.zeros((rows, 1), complex)
    np.add.at(channel, row, there[:, None] * gain)
    noise = np.array([0.9, 0.1]), np.array([1e-3, 1.0])
    probability, _ = decode(channel, row, gain, odds, np.zeros(len(row)), noise)
    assert ((odds > 0) != there).mean() > 0.1
    assert ((probability > 0.5) != there).mean() < 0.01


def test_learner_predicts_hidden_paths_of_held_out_rows(right: Any) -> None:
    """A ball that the scene lacks hides paths; held-out rows are predicted better by the others than by the scene."""
    rng = np.random.default_rng(4)
    positions = rng.uniform([0.2, 0.2, 0.2], [LENGTH - 0.2, WIDTH - 0.2, HEIGHT - 0.2], (250, 3))
    walls = walls_of(scene_surfaces(right))
    chains = [(-1, -1)] + [(i, j) for i in range(len(walls)) for j in range(-1, len(walls)) if i != j]
    images = images_of(walls, ACCESS_POINT.position_m, np.array(chains))
    seen = candidate_paths(walls, images, positions)
    share = np.linspace(0, 1, 60)[:, None]
    through = np.zeros(len(seen), bool)
    for start, end in zip(seen.point_m[:, :-1].swapaxes(0, 1), seen.point_m[:, 1:].swapaxes(0, 1), strict=True):
        way = start[:, None] + (end - start)[:, None] * share
        through |= (np.linalg.norm(way - [2.6, 2.2, 1.3], axis=2) < 0.5).any(axis=1)
    scene_says = (seen.inside_m > 0) & (seen.clear_m > 0)
    there = scene_says & ~through
    learner = Learner(walls, images, seen, sd_m=0.02, ridge=1.0, seed=0, folds=2)
    _, odds = learner.fit(there.astype(float), np.ones(len(seen)))
    wrong_before, wrong_after = (scene_says != there).sum(), ((odds > 0) != there).sum()
    assert wrong_before > 100
    assert wrong_after < 0.6 * wrong_before  # what no other path crosses cannot be known


def test_fit_corrects_displaced_planes(fitted: CsiPhysics, wrong: Any, measured: Record) -> None:
    test = np.arange(140, 200)
    truth = measured.observation[0, test]
    physics = fit_csi(measured, test[:0], wrong, QUICK).predict(measured.tx_pos_m[test], 0)
    before, after = cea_db(physics.mean, truth), cea_db(fitted.predict(measured.tx_pos_m[test], 0).mean, truth)
    assert np.median(before) < 12  # some millimetres are half a radian
    assert np.median(after) > 45  # 0.1 mm is 0.01 rad for a path with two reflections, 40 dB
    west = int(np.argmin(np.abs(np.abs(fitted.model.scan.normal[:, 0]) - 1) + np.abs(fitted.model.scan.centre_m[:, 0])))
    assert abs(fitted.model.scan.offset_m[west]) == pytest.approx(0.003, abs=1e-6)
    assert fitted.model.walls.offset_m[west] == pytest.approx(0, abs=2e-4)


def test_errors_match_the_standard_deviations(fitted: CsiPhysics, measured: Record) -> None:
    test = np.arange(140, 200)
    estimate = fitted.predict(measured.tx_pos_m[test], 0)
    error = np.abs(estimate.mean - measured.observation[0, test])
    assert (error < 3 * estimate.std).mean() > 0.85
    assert (estimate.std > 0).all()


def test_prediction_in_chunks_equals_prediction_at_once(
    fitted: CsiPhysics, measured: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = fitted.predict(measured.tx_pos_m[:30], 0)
    monkeypatch.setattr(CsiPhysics, "chunk_size", 7)
    parts = fitted.predict(measured.tx_pos_m[:30], 0)
    for one, other in ((parts.mean, whole.mean), (parts.std, whole.std)):
        np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-9 * np.abs(other).max())


def test_model_is_restored_from_arrays(fitted: CsiPhysics, measured: Record, tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", **fitted.arrays())
    with np.load(tmp_path / "model.npz", allow_pickle=False) as stored:
        again = CsiPhysics.from_arrays(dict(stored))
    for name in ("mean", "std"):
        one, other = (getattr(model.predict(measured.tx_pos_m[:30], 0), name) for model in (fitted, again))
        np.testing.assert_array_equal(one, other)
    assert again.summary() == fitted.summary()


def test_model_without_rows_is_the_image_method(right: Any, measured: Record) -> None:
    model = fit_csi(measured, np.zeros(0, np.int64), right, QUICK)
    accuracy = cea_db(model.predict(measured.tx_pos_m, 0).mean, measured.observation[0])
    assert np.median(accuracy) > 60  # single-precision corners of the mesh and channels


def test_several_receivers_and_subcarriers(right: Any, wrong: Any, places: np.ndarray) -> None:
    frequencies = FREQUENCY_HZ + np.array([-10e6, 0.0, 10e6])
    other = replace(ACCESS_POINT, name="other", position_m=np.array([3.2, 4.1, 1.9]))
    k = 2 * np.pi * frequencies / speed_of_light
    observed = np.zeros((2, len(places), 3), complex)
    for number, access_point in enumerate((ACCESS_POINT, other)):
        paths = trace_paths(right, places, access_point, TraceOptions(max_depth=2, rays=1 << 16)).paths
        gain = np.exp(-1j * k * paths.length_m[:, None]) / (2 * k * paths.length_m[:, None])
        np.add.at(observed[number], paths.tx, gain)
    both = replace(
        record(places, observed[0, :, 1]),
        receivers=(ACCESS_POINT, other),
        observation=observed.astype(np.complex64),
        frequencies_hz=frequencies,
    )
    test = np.arange(140, 200)
    model = fit_csi(both, np.arange(80), wrong, replace(QUICK, repair_rounds=4), seed=1)
    for number in range(2):
        estimate = model.predict(places[test], number)
        assert estimate.mean.shape == estimate.std.shape == (60, 3)
        assert np.median(cea_db(estimate.mean, observed[number, test])) > 40  # as with one of both
    again = CsiPhysics.from_arrays(model.arrays())
    np.testing.assert_array_equal(again.predict(places[test], 1).mean, model.predict(places[test], 1).mean)


def test_an_unknown_factor_of_the_instrument_is_found(right: Any, measured: Record) -> None:
    factor = 3.0 * np.exp(0.7j)
    scaled = replace(measured, observation=(measured.observation * factor).astype(np.complex64))
    model = fit_csi(scaled, np.arange(100), right, replace(QUICK, fit_gain=True))
    assert model.model.gain[0] == pytest.approx(factor, rel=1e-3)


def test_invalid_arguments_are_refused(right: Any, measured: Record, fitted: CsiPhysics) -> None:
    with pytest.raises(InputError, match="holds rssi; this physics model predicts channels"):
        fit_csi(replace(measured, task="rssi"), np.arange(5), right)
    with pytest.raises(InputError, match="no receiver 1"):
        fitted.predict(measured.tx_pos_m, 1)
    few, name = measured.tx_pos_m[:2], measured.receivers[0].name
    np.testing.assert_array_equal(fitted.predict(few, name).mean, fitted.predict(few, 0).mean)
    with pytest.raises(InputError, match="give finite"):
        fitted.predict([[0.0, np.nan, 0.0]], 0)
    with pytest.raises(InputError, match="ridge"):
        CsiSettings(ridge=0)
