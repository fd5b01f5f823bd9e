"""The physics model for spectra with a mesh: paths of known chains, fits, surfaces that the mesh lacks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traced_rooms import PARTITION, SHOEBOX, write_xml
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Antenna, InputError, Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.models import MODELS
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.models.physics import spectrum_rays, spectrum_search
from wrf_mi.models.physics.spectrum import SpectrumPhysics, SpectrumSettings, fit_spectrum, groups
from wrf_mi.models.physics.spectrum_fit import (
    RESIDUALS,
    ResidualField,
    ResidualKriging,
    fit_constants,
    fit_maps,
    gain_slopes,
    map_centres,
    scan_offsets,
)
from wrf_mi.models.physics.spectrum_model import Fit, SpectrumModel, begin
from wrf_mi.models.physics.spectrum_search import KnownPaths, Search
from wrf_mi.models.physics.spectrum_waves import Grid, Spectrometer
from wrf_mi.runs.folder import read_fitted, write_fitted
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

HZ = 920e6
HEIGHT, WIDTH = 30, 60
THICKNESS_M = {"itu_concrete": 0.2, "itu_brick": 0.1, "itu_plasterboard": 0.05, "itu_metal": 0.002}
ARRAY = planar_array(4, 4, 0.16)
# The array looks along -x with its y axis up.
RECEIVER = Receiver("array", np.array([5.2, 2.4, 1.1]), np.array([0.5, -0.5, -0.5, 0.5]), array_m=ARRAY)
NOISE = RESIDUALS[0].noise
INSTRUMENT = Spectrometer(RECEIVER, HZ, HEIGHT, WIDTH)
HOW = SpectrumSettings(reflections=2, passed=1, rays=1 << 14, chains=1000), 1


def places(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([0.4, 0.4, 0.5], [4.6, 4.6, 2.5], (count, 3))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    xml = write_xml(tmp_path_factory.mktemp("shoebox"), {**SHOEBOX, **PARTITION})
    return open_scene(xml, HZ, THICKNESS_M)


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> SpectrumModel:
    return begin(INSTRUMENT, open_scene(write_xml(tmp_path_factory.mktemp("bare"), SHOEBOX), HZ, THICKNESS_M), *HOW)


def record_of(model: SpectrumModel, tx: np.ndarray) -> Record:
    spectra = model.instrument.report(model.signals(model.waves(tx)))
    return Record("made", "spectrum", tx, (RECEIVER,), spectra[None], frequencies_hz=np.array([HZ]))


@pytest.mark.parametrize(
    ("rx", "tx_antenna"),
    [
        (Antenna(), Antenna()),
        (Antenna("hw_dipole", "H"), Antenna("dipole", "H")),
        (Antenna("tr38901", "V", "array"), Antenna("hw_dipole")),
    ],
)
def test_paths_and_gains_are_those_of_the_ray_tracer(scene: Any, rx: Antenna, tx_antenna: Antenna) -> None:
    receiver = replace(RECEIVER, antenna=rx)
    instrument = replace(INSTRUMENT, receiver=receiver, tx_antenna=tx_antenna)
    model, tx = begin(instrument, scene, *HOW), places(20, 0)
    waves = model.waves(tx)
    gain, length = waves.gain(model.constants.slabs), np.linalg.norm(waves.paths.image_m, axis=1)
    options = TraceOptions(transmission=True, max_depth=3, max_reflections=2, rays=1 << 14)
    paths = trace_paths(scene, tx, receiver, options, tx_antenna=tx_antenna).paths
    paths = paths.select((paths.interactions == 4).sum(axis=1) <= 1)
    mine: dict[tuple[int, float], list[complex]] = {}
    for row, far, value in zip(waves.paths.tx, length, gain, strict=True):
        mine.setdefault((int(row), round(float(far), 3)), []).append(complex(value))
    apart, missing = [], 0
    for row, far, value in zip(paths.tx, paths.length_m, paths.gain, strict=True):
        # Vertices of the mesh are float32: a length may fall on the other side of a millimetre.
        near = [one for shift in (-1e-3, 0, 1e-3) for one in mine.get((int(row), round(float(far + shift), 3)), [])]
        if not near:
            missing += 1
            continue
        apart.append(min(abs(one - value) for one in near))
    # Sionna RT computes in float32, whose error grows where a reflection nearly vanishes.
    assert max(apart) < 1e-4 * np.abs(gain).max()
    # Its own rays miss paths that pass within a millimetre of an edge.
    assert missing < 0.01 * len(paths)
    assert 300 < len(waves.paths) < 1.02 * len(paths)


def test_numpy_and_mitsuba_intersections_agree(scene: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model, tx = begin(INSTRUMENT, scene, *HOW), places(15, 10)
    found = []
    for pairs in (0, 1 << 30):
        monkeypatch.setattr(spectrum_rays, "FEW_PAIRS", pairs)
        found.append(model.table(tx))
    assert len(found[0]) == len(found[1]) > 200
    for name in ("tx", "chain", "objects", "plane"):
        assert np.array_equal(getattr(found[0], name), getattr(found[1], name))
    # A normal's sign is that of the face or of the plane: reflections and passages know none.
    assert np.allclose(np.abs(found[0].normal), np.abs(found[1].normal), atol=1e-6)


def test_a_displaced_plane_moves_images_as_a_displaced_mesh_does(bare: SpectrumModel, tmp_path: Path) -> None:
    moved = {**SHOEBOX, "west": ("itu_brick", sheet(0, 0.05, (0.0, 5.0), (0.0, 3.0)))}
    other = begin(INSTRUMENT, open_scene(write_xml(tmp_path, moved), HZ, THICKNESS_M), *HOW)
    surfaces = bare.table.surfaces
    assert surfaces is not None
    offset = np.zeros(len(surfaces.normal))
    index = surfaces.plane[surfaces.first_face[surfaces.names.index("west")]]
    offset[index] = 0.05 * surfaces.normal[index, 0]
    tx = places(5, 1)
    for a, b in ((bare.waves(tx), other.waves(tx)),):
        mine = np.sort(np.linalg.norm(a.image(offset), axis=1))
        assert np.allclose(mine, np.sort(np.linalg.norm(b.paths.image_m, axis=1)), atol=1e-5)  # float32 corners


def test_loss_is_invariant_to_scale_and_phase_and_its_slope_is_exact() -> None:
    grid, rng = INSTRUMENT.grid, np.random.default_rng(0)
    signals = rng.standard_normal((3, 16)) + 1j * rng.standard_normal((3, 16))
    shapes = grid.shapes(INSTRUMENT.report(signals))
    # What is left is the instrument's minimum, which the loss leaves out of account.
    assert grid.loss(signals * 3j, shapes).max() < 1.0
    change = rng.standard_normal((3, 16)) + 1j * rng.standard_normal((3, 16))
    other = signals + 0.3 * change
    step = 1e-6
    up, down = (grid.loss(other + s * step * change, shapes) for s in (1, -1))
    slope = 2 * (grid.loss_and_slope(other, shapes)[1].conj() * change).sum(axis=1).real
    assert np.allclose((up - down) / (2 * step), slope, rtol=1e-5)  # central differences in float64


def test_fit_recovers_displacements(bare: SpectrumModel) -> None:
    offset = np.array([0.02, -0.015, 0.01, 0.0, -0.02, 0.015])
    truth = bare.replaced(constants=replace(bare.constants, offset_m=offset))
    waves, grid = bare.waves(places(60, 2)), INSTRUMENT.grid
    shapes = grid.shapes(INSTRUMENT.report(truth.signals(waves)))
    start = scan_offsets(waves, shapes, bare.constants, 0.03)
    found = fit_constants(waves, shapes, start, bare.constants, 0.03, 25)
    # The prior pulls towards zero, and a wall's thickness changes the same phase: up to a fifth of the error is left.
    assert np.abs(found.offset_m - offset).max() < 0.005
    before, after = (grid.loss(bare.replaced(constants=c).signals(waves), shapes) for c in (bare.constants, found))
    assert np.median(after) < np.median(before) / 5


def test_gain_slopes_equal_finite_differences(bare: SpectrumModel) -> None:
    waves, constants = bare.waves(places(4, 3)), bare.constants
    gain, vector = waves.gain(constants.slabs), constants.vector()
    for index in (0, 4, 7, 13, 20):
        path, slope = gain_slopes(waves, constants, gain)[index]
        step = np.zeros_like(vector)
        step[index] = 1e-5
        both = []
        for sign in (1, -1):
            other = constants.with_vector(vector + sign * step)
            turn = waves.image(other.offset_m), waves.image(constants.offset_m)
            longer = np.subtract(*(np.linalg.norm(image, axis=1) for image in turn))
            both.append(waves.gain(other.slabs) * np.exp(-1j * INSTRUMENT.wavenumber * longer))
        expected = (both[0] - both[1]) / 2e-5
        assert len(path)
        # One-sided differences of 1e-4 in the logarithm of a constant.
        assert np.abs(slope - expected[path]).max() < 3e-3 * np.abs(gain).max()


def test_a_missing_metal_sheet_is_found(bare: SpectrumModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plate = {"plate": ("itu_metal", sheet(1, 4.6, (1.5, 3.2), (0.4, 2.2)))}
    room = begin(INSTRUMENT, open_scene(write_xml(tmp_path, {**SHOEBOX, **plate}), HZ, THICKNESS_M), *HOW)
    tx = places(80, 4)
    shapes = INSTRUMENT.grid.shapes(INSTRUMENT.report(room.signals(room.waves(tx))))
    waves, frames = bare.waves(tx), bare.frames(tx)
    known = KnownPaths.of(bare.table, waves.paths, bare.path_waves(waves), tx)
    search = Search(frames, INSTRUMENT, tx, shapes, known)
    (found,) = search(waves.sum @ known.wave, most=1, least_gain=30.0)
    several = search(waves.sum @ known.wave, most=3, least_gain=10.0)
    monkeypatch.setattr(spectrum_search, "KEPT_NUMBERS", 0)  # every plane anew in each round
    assert Search(frames, INSTRUMENT, tx, shapes, known)(waves.sum @ known.wave, most=3, least_gain=10.0) == several
    corners = found.corners(frames)
    assert found.kind == 0
    assert np.abs(corners[:, 1] - 4.6).max() < 0.02  # a sixteenth of a wavelength
    # Edges show by the transmitters that just see them, 80 in 40 cubic metres.
    assert np.abs(corners.min(axis=0)[[0, 2]] - [1.5, 0.4]).max() < 0.4
    assert np.abs(corners.max(axis=0)[[0, 2]] - [3.2, 2.2]).max() < 0.4
    with_it = bare.with_sheets([found], frames, *HOW)
    before, after = (INSTRUMENT.grid.loss(m.signals(m.waves(tx)), shapes).mean() for m in (bare, with_it))
    assert after < 0.6 * before


def test_amplitudes_learn_a_chain_that_is_too_weak(bare: SpectrumModel) -> None:
    waves, grid = bare.waves(places(80, 5)), INSTRUMENT.grid
    maps = map_centres(waves.paths, bare.table.length, 1.0, 0)
    strong = np.flatnonzero(maps.chain == 0)[:1]  # the constant of the direct path
    weight = np.zeros(len(maps.chain), complex)
    weight[strong] = 0.5
    truth = bare.replaced(maps=replace(maps, weight=weight))
    shapes = grid.shapes(INSTRUMENT.report(truth.signals(waves)))
    found = bare.replaced(maps=fit_maps(waves, shapes, bare.constants, maps, 0.2, 60))
    before, after = (grid.loss(m.signals(waves), shapes).mean() for m in (bare, found))
    assert after < before / 3


def test_learned_amplitudes_and_residuals_are_read_from_a_run(bare: SpectrumModel, tmp_path: Path) -> None:
    waves = bare.waves(places(80, 5))
    model = bare.replaced(maps=map_centres(waves.paths, bare.table.length, 1.0, 0))
    record = record_of(bare, places(40, 6))
    rows = np.arange(30), np.arange(30, 40)
    fit = Fit(INSTRUMENT, record.tx_pos_m, record.observation[0], *rows, SpectrumSettings())
    model = fit.with_residual(model, rows[0], RESIDUALS[0])
    write_fitted(tmp_path, SpectrumPhysics((model,), {}).arrays(), 0.0)
    arrays, _ = read_fitted(tmp_path, MODELS["physics"].serving("spectrum", True))
    again = SpectrumPhysics.from_arrays(arrays).models[0]
    assert again.maps is not None
    assert model.maps is not None
    np.testing.assert_array_equal(again.maps.centre_m, model.maps.centre_m)
    assert np.isnan(again.maps.centre_m).any()


@pytest.fixture(scope="module")
def fitted(bare: SpectrumModel) -> tuple[Record, SpectrumPhysics]:
    offset = np.array([0.02, -0.015, 0.01, 0.0, -0.02, 0.015])
    record = record_of(bare.replaced(constants=replace(bare.constants, offset_m=offset)), places(70, 6))
    settings = SpectrumSettings(surfaces=1, rounds=1, rays=1 << 14, steps=6)
    return record, fit_spectrum(record, np.arange(50), scene_of(bare), settings, seed=0)


def scene_of(model: SpectrumModel) -> Any:
    """The scene that a model was made of: kept by the fixture of the module."""
    return SCENES[0]


SCENES: list[Any] = []


@pytest.fixture(scope="module", autouse=True)
def keep_scene(tmp_path_factory: pytest.TempPathFactory) -> None:
    SCENES.append(open_scene(write_xml(tmp_path_factory.mktemp("kept"), SHOEBOX), HZ, THICKNESS_M))


def test_prediction_in_chunks_equals_prediction_at_once(
    fitted: tuple[Record, SpectrumPhysics], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Sums of some waves in another order; the deviation, the same for all, is held once."""
    record, physics = fitted
    whole = physics.predict(record.tx_pos_m[:20], 0)
    monkeypatch.setattr(SpectrumPhysics, "chunk_size", 7)
    parts = physics.predict(record.tx_pos_m[:20], 0)
    np.testing.assert_allclose(parts.mean, whole.mean, rtol=0, atol=1e-5)
    np.testing.assert_array_equal(parts.std, whole.std)
    assert parts.std.strides[0] == 0
    assert physics.predict(np.zeros((0, 3)), 0).mean.shape == (0, HEIGHT, WIDTH)


def test_a_fit_predicts_new_places_better_than_the_mesh_as_given(fitted: tuple[Record, SpectrumPhysics]) -> None:
    record, physics = fitted
    test = np.arange(50, 70)
    plain = fit_spectrum(record, np.zeros(0, np.int64), SCENES[0], SpectrumSettings(rays=1 << 14))
    errors = [
        np.abs(m.predict(record.tx_pos_m[test], 0).mean - record.observation[0, test]).mean() for m in (plain, physics)
    ]
    assert errors[1] < errors[0] / 2
    estimate = physics.predict(record.tx_pos_m[test], 0)
    assert estimate.std.shape == estimate.mean.shape == (20, HEIGHT, WIDTH)
    assert physics.summary()["array.chains"] > 10
    assert plain.summary() == {}


def test_model_is_restored_from_arrays(fitted: tuple[Record, SpectrumPhysics], tmp_path: Path) -> None:
    record, physics = fitted
    np.savez(tmp_path / "model.npz", **physics.arrays())  # type: ignore[arg-type]
    with np.load(tmp_path / "model.npz", allow_pickle=False) as stored:
        again = SpectrumPhysics.from_arrays(dict(stored))
    tx = record.tx_pos_m[60:]
    assert np.array_equal(again.predict(tx, 0).mean, physics.predict(tx, 0).mean)
    assert again.summary() == physics.summary()
    with pytest.raises(InputError, match="format"):
        SpectrumPhysics.from_arrays({"format": np.array(99)})


def test_without_a_mesh_there_is_the_direct_path(bare: SpectrumModel) -> None:
    record = record_of(bare, places(10, 7))
    physics = fit_spectrum(record, np.zeros(0, np.int64), None)
    waves = physics.models[0].waves(record.tx_pos_m)
    assert len(waves.paths) == 10
    direct = record.tx_pos_m - RECEIVER.position_m
    assert np.allclose(waves.image(np.zeros(0)), direct)


def test_invalid_arguments_are_refused(bare: SpectrumModel) -> None:
    record = record_of(bare, places(3, 8))
    with pytest.raises(InputError, match="holds rssi; this physics model predicts spectra"):
        fit_spectrum(replace(record, task="rssi"), np.arange(3), None)
    with pytest.raises(InputError, match="array or carrier"):
        fit_spectrum(record.with_array(None), np.arange(3), None)
    physics = fit_spectrum(record, np.zeros(0, np.int64), None)
    for wrong in ([[1.0, 2.0]], [[np.nan, 0, 0]]):
        with pytest.raises(InputError, match="transmitters"):
            physics.predict(wrong, 0)
    for unknown in ("sensor10", 1, -1):
        with pytest.raises(InputError, match=f"no receiver .*; give one of {record.receivers[0].name}, or its number"):
            physics.predict(record.tx_pos_m, unknown)
    named = physics.predict(record.tx_pos_m, record.receivers[0].name).mean
    np.testing.assert_array_equal(named, physics.predict(record.tx_pos_m, 0).mean)
    for setting in ({"steps": -1}, {"scale_m": 0.0}, {"validation": 1.0}):
        with pytest.raises(InputError, match="setting"):
            SpectrumSettings(**setting)


def test_grid_lies_within_the_spectrum() -> None:
    for height, width in ((7, 9), (90, 360), (13, 24)):
        grid = Grid.of(height, width, ARRAY, HZ)
        assert grid.row.max() < height
        assert grid.column.max() < width
        assert grid.steering.shape == (len(grid.row) * len(grid.column), 16)


def test_surfaces_are_added_only_where_validation_rows_gain(bare: SpectrumModel) -> None:
    tx = places(60, 9)
    spectra = INSTRUMENT.report(bare.signals(bare.waves(tx)))
    settings = SpectrumSettings(surfaces=2, steps=5)
    fit = Fit(INSTRUMENT, tx, spectra, np.arange(45), np.arange(45, 60), settings)
    # The mesh explains everything: no surface is needed, and none is taken.
    assert fit.surfaces(bare, HOW[1]).learned == 0


def test_residual_kriging_acts_near_training_rows_only() -> None:
    rng = np.random.default_rng(0)
    tx = rng.uniform(0, 2, (60, 3))
    pattern = rng.standard_normal((2, 9, 12)).astype(np.float32)
    value = np.column_stack([np.sin(tx[:, 0]), np.cos(tx[:, 1])])
    residual = np.tensordot(value, pattern, axes=1).astype(np.float32)
    residual *= np.float32(0.05)  # so that spectra lie within 0..1
    room = np.full_like(residual, 0.5)
    field = ResidualField(1.0, 2.0, NOISE, False)
    kriged = ResidualKriging.of(tx[:50], room[:50] + residual[:50], room[:50], field, 0.5)
    near = kriged(tx[50:], room[50:]) - room[50:]
    assert np.square(near - residual[50:]).mean() < 0.3 * np.square(residual[50:]).mean()
    far = kriged(np.array([[30.0, 0, 0]]), room[:1])
    assert np.abs(far - room[:1]).max() < 1e-6
    # Two patterns are two principal images, and the posterior mean is that of the formula.
    covariance = np.exp(-np.linalg.norm(tx[:50, None] - tx[None, :50], axis=-1)) + NOISE * np.eye(50)
    across = np.exp(-np.linalg.norm(tx[50:, None] - tx[None, :50], axis=-1))
    expected = np.tensordot(across @ np.linalg.inv(covariance), residual[:50], axes=1)
    assert len(kriged.image) == 2
    assert np.allclose(near, expected, atol=1e-4)  # images are float32


def test_kriging_with_share_zero_ignores_the_room() -> None:
    """Share 0, by the formula of ordinary kriging; a room that predicts anything else changes nothing."""
    rng = np.random.default_rng(1)
    tx, spectra = rng.uniform(0, 2, (12, 3)), rng.uniform(0.3, 0.7, (12, 5, 6)).astype(np.float32)
    room = rng.uniform(0, 1, (12, 5, 6)).astype(np.float32)
    kriged = ResidualKriging.of(tx[:9], spectra[:9], room[:9], ResidualField(0.0, 3.0, 0.1, True), 0.5)
    covariance = np.exp(-np.linalg.norm(tx[:9, None] - tx[None, :9], axis=-1) / 1.5) + 0.1 * np.eye(9)
    across = np.exp(-np.linalg.norm(tx[9:, None] - tx[None, :9], axis=-1) / 1.5)
    # Unknown mean: the weights of the rows add up to one.
    system = np.block([[covariance, np.ones((9, 1))], [np.ones((1, 9)), np.zeros((1, 1))]])
    weight = np.linalg.solve(system, np.vstack([across.T, np.ones((1, 3))]))[:9]
    expected = np.tensordot(weight.T, spectra[:9], axes=1)
    assert np.allclose(kriged(tx[9:], room[9:]), expected, atol=1e-5)  # images are float32


FEW = SpectrumSettings(reflections=1, rays=1 << 12, steps=4)


def mean_error(predicted: np.ndarray, truth: np.ndarray) -> float:
    return float(np.sqrt(np.square(predicted - truth).mean()))


@pytest.mark.parametrize("right", [True, False])
def test_few_rows_predict_no_worse_than_the_mesh_or_kriging_alone(bare: SpectrumModel, right: bool) -> None:
    """In a room whose planes are off by centimetres, and in one that the mesh is not of."""
    rng = np.random.default_rng(11)
    tx = np.array([1.2, 2.0, 1.2]) + rng.uniform(-0.3, 0.3, (32, 3)) * [1, 1, 0.5]
    if right:
        offset = np.array([0.02, -0.015, 0.01, 0.0, -0.02, 0.015])
        record = record_of(bare.replaced(constants=replace(bare.constants, offset_m=offset)), tx)
    else:
        record = replace(record_of(bare, tx + np.array([2.4, -1.4, 0.9])), tx_pos_m=tx)
    rows, test, truth = np.arange(12), np.arange(12, 32), record.observation[0, 12:]
    physics = fit_spectrum(record, rows, SCENES[0], FEW)
    mesh = fit_spectrum(record, rows[:0], SCENES[0], FEW)
    kriged = Kriging().fit(tx[rows], record.observation[0, rows]).predict(tx[test])
    estimate = physics.predict(tx[test], 0)
    found, given = mean_error(estimate.mean, truth), mean_error(mesh.predict(tx[test], 0).mean, truth)
    best = min(given, mean_error(kriged, truth))
    assert found < (0.9 if right else 1.1) * best
    chosen = physics.summary()["array.chosen"]
    assert chosen != "kriging of spectra" if right else chosen.startswith("kriging")
    # The stated deviation is that of rows held out.
    assert 0.5 * found < np.sqrt(np.square(estimate.std).mean()) < 2 * found
    again = SpectrumPhysics.from_arrays(physics.arrays())
    assert np.array_equal(again.predict(tx[test], 0).mean, estimate.mean)


def test_too_few_positions_leave_the_room_as_given_and_warn(
    bare: SpectrumModel, caplog: pytest.LogCaptureFixture
) -> None:
    """Three rows, or twenty at one place."""
    tx = np.concatenate([places(3, 12), places(1, 13) + np.random.default_rng(0).uniform(-1e-3, 1e-3, (20, 3))])
    record = record_of(bare, tx)
    mesh = fit_spectrum(record, np.zeros(0, np.int64), SCENES[0], FEW).predict(tx, 0).mean
    assert not caplog.records
    for rows in (np.arange(3), np.arange(3, 23)):
        physics = fit_spectrum(record, rows, SCENES[0], FEW)
        assert np.array_equal(physics.predict(tx, 0).mean, mesh)
        assert f"array: {len(rows)} training rows at fewer than 4 places" in caplog.messages[-1]
        assert caplog.messages[-1].endswith("the room is traced as given")


def test_rows_at_one_position_are_held_out_together() -> None:
    tx = np.repeat(places(7, 14), 3, axis=0) + np.random.default_rng(0).uniform(-2e-3, 2e-3, (21, 3))
    group = groups(tx, 0.3, 0).reshape(7, 3)
    assert (group == group[:, :1]).all()
    assert set(group[:, 0]) == set(range(5))
