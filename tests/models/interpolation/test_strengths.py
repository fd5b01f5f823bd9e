"""Kriging of signal strengths: its posterior, its terms, and that it learns what was put into made-up strengths."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.models.interpolation import strengths
from wrf_mi.models.interpolation.strength_fit import PooledProcess, ReceiverObservations, folds, shift_of, widening
from wrf_mi.models.interpolation.strength_terms import Hyperparameters, Measured, Poses, stops_of
from wrf_mi.models.interpolation.strengths import Strengths, StrengthSettings, fit_strengths
from wrf_mi.models.model import Inputs
from wrf_mi.tracing.power_map import trace_map

FREQUENCY_HZ = 2.44e9
AT_1M_DBM = -40.2
"""Free space at 2.44 GHz."""
UP = np.array([0.0, 0.0, 0.0, 1.0])
FAST = StrengthSettings()


def made(rows: int, noise_db: float, seed: int = 0, body_db: float = 0.0) -> Record:
    """Strengths at three receivers in an empty room: exponent 2.5, offsets, a pattern that all share, noise."""
    rng = np.random.default_rng(seed)
    receivers = tuple(
        Receiver(f"r{k}", np.array(at, float), UP) for k, at in enumerate([(0, 0, 2), (6, 1, 2), (2, 5, 2)])
    )
    position = np.column_stack([rng.uniform(0.5, 5.5, (rows, 2)), np.full(rows, 1.3)])
    heading = rng.uniform(-9, 9, rows)
    strength = []
    for receiver, offset in zip(receivers, (-10.0, -12.0, -14.0), strict=True):
        away = receiver.position_m - position
        distance = np.linalg.norm(away, axis=1)
        psi = np.arctan2(away[:, 1], away[:, 0]) - heading
        level = np.hypot(away[:, 0], away[:, 1]) / distance
        strength.append(
            AT_1M_DBM + offset - 25 * np.log10(distance) + body_db * np.cos(psi) * level + rng.normal(0, noise_db, rows)
        )
    return Record(
        name="made",
        task="rssi",
        tx_pos_m=position,
        receivers=receivers,
        observation=np.array(strength, np.float32),
        frequencies_hz=np.array([FREQUENCY_HZ]),
        tx_heading_rad=heading,
    )


def errors(model: Strengths, record: Record, rows: np.ndarray) -> np.ndarray:
    assert record.tx_heading_rad is not None
    predicted = [model.predict(Inputs(record.tx_pos_m[rows], record.tx_heading_rad[rows]), k).mean for k in range(3)]
    return np.array(predicted) - record.observation[:, rows]


@pytest.mark.parametrize("level_db", [-60.0, 30.0])
@pytest.mark.parametrize("rows", [1, 5, 60])
def test_predictions_are_equivariant_to_the_level_of_the_data(level_db: float, rows: int) -> None:
    """Transmitters of 30 dBm, or strengths in other units."""
    record = made(60, noise_db=1.0)
    shifted = replace(record, observation=record.observation + np.float32(level_db))
    plain, moved = (fit_strengths(one, np.arange(rows)) for one in (record, shifted))
    inputs = Inputs(record.tx_pos_m, record.tx_heading_rad)
    for receiver in range(3):
        before, after = (model.predict(inputs, receiver) for model in (plain, moved))
        np.testing.assert_allclose(after.mean, before.mean + level_db, atol=1e-3)  # float32 observations
        np.testing.assert_allclose(after.std, before.std, atol=1e-3)
    known = replace(FAST, transmit_dbm=0.0)
    assert fit_strengths(shifted, np.arange(rows), None, known).field.prior.transmit_dbm == 0


def test_posterior_equals_dense_gaussian_conditioning() -> None:
    """Shared coefficients and independent fields, against one covariance matrix of all receivers' rows."""
    rng = np.random.default_rng(1)
    kernel = Hyperparameters(3.0, 1.5, 1.0, 1.0, 1.0, 0.0, 0.0)
    prior = np.array([5.0, 1.0])
    places = [Poses(rng.uniform(0, 3, (n, 3)), rng.uniform(0, 6, n)) for n in (7, 5)]
    bases = [rng.normal(size=(len(p), 2)) for p in places]
    values = [rng.normal(0, 4, len(p)) for p in places]
    noise = [rng.uniform(1, 3, len(p)) for p in places]
    parts = [ReceiverObservations(*one) for one in zip(places, bases, values, noise, strict=True)]
    process = PooledProcess(parts, kernel.covariance, prior, kernel.variance(True))

    asked, basis = Poses(rng.uniform(0, 3, (4, 3)), rng.uniform(0, 6, 4)), rng.normal(size=(4, 2))
    mean, variance = process.predict(1, asked, basis)

    all_bases = np.concatenate(bases)
    dense = all_bases @ np.diag(prior**2) @ all_bases.T + np.diag(np.concatenate(noise))
    dense[:7, :7] += kernel.covariance(places[0], places[0])
    dense[7:, 7:] += kernel.covariance(places[1], places[1])
    cross = basis @ np.diag(prior**2) @ all_bases.T
    cross[:, 7:] += kernel.covariance(asked, places[1])
    own = np.square(basis) @ prior**2 + kernel.variance(True)
    # Both are float64; the jitter on the diagonal is 1e-8 of the noise.
    np.testing.assert_allclose(mean, cross @ np.linalg.solve(dense, np.concatenate(values)), rtol=1e-6)
    np.testing.assert_allclose(variance, own - (cross @ np.linalg.solve(dense, cross.T)).diagonal(), rtol=1e-6)


def test_reweighting_is_robust_to_outliers() -> None:
    places = Poses(np.zeros((21, 3)), None)
    value = np.concatenate([np.zeros(20), [40.0]])
    part = ReceiverObservations(places, np.ones((21, 1)), value, np.ones(21))
    kernel = Hyperparameters(1e-3, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0)
    plain, robust = (
        PooledProcess([part], kernel.covariance, np.array([10.0]), kernel.variance(False), rounds).beta[0]
        for rounds in (0, 3)
    )
    assert plain == pytest.approx(40 / 21, rel=0.02)
    assert abs(robust) < 0.3


def test_rows_of_one_stop_are_joined() -> None:
    x = np.array([0.0, 0.05, 0.1, 1.0, 1.0, 1.0, 1.0])
    places = Poses(np.column_stack([x, np.zeros((7, 2))]), np.array([3.1, -3.1, 3.1, 0, 0, 2.0, 2.0]))
    value = np.array([[1.0, 2.0, 9.0, np.nan, 4.0, np.nan, np.nan]])
    stops = stops_of(Measured(places, value, np.array([0, 1, 2, 3, 4, 5, 90])), reach_m=0.2, turn_rad=0.5, most=20)
    assert stops.count.tolist() == [[3, 1, 0, 0]]
    np.testing.assert_array_equal(stops.value_dbm, [[2.0, 4.0, np.nan, np.nan]])
    # Headings either side of the seam at pi have their mean at pi, not at 0.
    np.testing.assert_allclose(np.cos(stops.poses.heading_rad), np.cos([np.pi, 0, 2, 2]), atol=1e-3)


def test_precise_rows_of_a_stop_weigh_more() -> None:
    places = Poses(np.zeros((4, 3)), None)
    value, precision = np.array([[1.0, 2.0, np.nan, 9.0], [1.0, 2.0, 3.0, 4.0]]), np.array([[1, 1, 7, 3], [1, 1, 1, 3]])
    stops = stops_of(Measured(places, value, np.arange(4), precision.astype(float)), 0.2, 0.5, 20)
    np.testing.assert_array_equal(stops.count, [[5], [6]])
    # The median of 1, 2, 9, 9, 9, and that of 1, 2, 3, 4, 4, 4.
    np.testing.assert_array_equal(stops.value_dbm, [[9.0], [3.5]])


def test_stated_noise_lowers_the_error() -> None:
    record, rng = made(300, noise_db=0.5), np.random.default_rng(1)
    std = rng.choice([0.5, 9.0], record.observation.shape)
    noisy = replace(record, observation=(record.observation + std * rng.normal(size=std.shape)).astype(np.float32))
    train, test = np.arange(200), np.arange(200, 300)
    plain, weighted = (fit_strengths(one, train, None, FAST) for one in (noisy, replace(noisy, std=std)))
    # Half of the rows have a noise of 9 dB.
    assert np.median(np.abs(errors(weighted, record, test))) < 0.75 * np.median(np.abs(errors(plain, record, test)))


def test_learns_offsets_exponent_and_pattern() -> None:
    record = made(300, noise_db=1.0, body_db=4.0)
    train, test = np.arange(200), np.arange(200, 300)
    model = fit_strengths(record, train, None, FAST)
    # Noise of 1 dB alone has a median of 0.67 dB.
    assert np.median(np.abs(errors(model, record, test))) < 0.95
    blind = fit_strengths(replace(record, tx_heading_rad=None), train, None, FAST)
    without = [blind.predict(Inputs(record.tx_pos_m[test]), k).mean for k in range(3)] - record.observation[:, test]
    assert np.median(np.abs(without)) > 1.5


def test_receivers_share_the_transmitters_pattern() -> None:
    """The third receiver has four rows: the pattern that it shares must come from the other two."""
    record = made(300, noise_db=0.5, body_db=6.0)
    observation = record.observation.copy()
    observation[2, 4:] = np.nan
    model = fit_strengths(replace(record, observation=observation), np.arange(200), None, FAST)
    record_errors = errors(model, record, np.arange(200, 300))[2]
    # The pattern's own spread is 6 / sqrt(2) dB, and a median of 2.9.
    assert np.median(np.abs(record_errors)) < 2.0


def test_interval_covers_90_percent() -> None:
    record = made(400, noise_db=3.0)
    model = fit_strengths(record, np.arange(250), None, FAST)
    test = np.arange(250, 400)
    assert record.tx_heading_rad is not None
    std = np.array([model.predict(Inputs(record.tx_pos_m[test], record.tx_heading_rad[test]), k).std for k in range(3)])
    inside = np.abs(errors(model, record, test)) < 1.645 * std
    # 450 values: the standard deviation of the share is 0.014.
    assert 0.84 < inside.mean() < 0.96


def test_few_rows_fall_back_on_the_law_of_distance() -> None:
    record = made(60, noise_db=1.0)
    model = fit_strengths(record, np.array([3]), None, FAST)
    far = np.array([[40.0, 0.0, 1.3], [80.0, 0.0, 1.3]])
    near, double = model.predict(Inputs(far, np.zeros(2)), 0).mean
    # 10 n log10 2 with n = 2 +- 1 is 6.02 +- 3.01 dB; one row moves n by less than half of that.
    assert near - double == pytest.approx(6.02, abs=1.5)
    assert (model.predict(Inputs(far, np.zeros(2)), 0).std > 5).all()


def test_headings_are_left_out_where_asked() -> None:
    record = made(60, noise_db=0.5, body_db=6.0)
    model = fit_strengths(record, np.arange(60), None, replace(FAST, heading=False))
    assert not model.uses_heading
    inputs = Inputs(record.tx_pos_m, record.tx_heading_rad)
    np.testing.assert_array_equal(model.predict_mean(inputs, 0), model.predict_mean(Inputs(record.tx_pos_m), 0))


def test_unknown_heading_is_averaged_over() -> None:
    record = made(300, noise_db=0.5, body_db=6.0)
    model = fit_strengths(record, np.arange(300), None, FAST)
    place = record.tx_pos_m[:3]
    turns = [model.predict(Inputs(place, np.full(3, h)), 0) for h in 2 * np.pi * np.arange(32) / 32]
    average = model.predict(Inputs(place), 0)
    np.testing.assert_allclose(average.mean, np.mean([one.mean for one in turns], axis=0), atol=0.1)
    assert (average.std > turns[0].std + 1).all()


@pytest.mark.parametrize("repeated", [True, False])
def test_mean_alone_equals_that_with_deviations(repeated: bool) -> None:
    record = made(200, noise_db=1.0, body_db=6.0)
    model = fit_strengths(record, np.arange(200), None, FAST)
    assert record.tx_heading_rad is not None
    position, heading = record.tx_pos_m[:40], record.tx_heading_rad[:40]
    if repeated:
        position, heading = np.repeat(position, 4, axis=0), np.tile(heading[:4], 40)
    for turn in (heading, None):
        inputs = Inputs(position, turn)
        np.testing.assert_allclose(model.predict_mean(inputs, 1), model.predict(inputs, 1).mean)


def test_model_is_restored_from_arrays() -> None:
    record = made(80, noise_db=2.0)
    record.observation[1, ::3] = np.nan
    model = fit_strengths(record, np.arange(70), None, FAST)
    again = Strengths.from_arrays(model.arrays())
    assert record.tx_heading_rad is not None
    for k in range(3):
        ours, theirs = (m.predict(Inputs(record.tx_pos_m, record.tx_heading_rad), k) for m in (model, again))
        np.testing.assert_array_equal(ours.mean, theirs.mean)
        np.testing.assert_array_equal(ours.std, theirs.std)
    assert again.facts() == model.facts()


def test_search_lowers_the_held_out_error() -> None:
    record = made(120, noise_db=1.0, body_db=3.0)
    wrong = replace(FAST, shadow_db=12.0, shadow_m=0.2)
    searched = replace(wrong, search_rows=50)
    before, after = (fit_strengths(record, np.arange(120), None, one).facts()["fitted"] for one in (wrong, searched))
    assert after["held_out_db"] < before["held_out_db"] - 0.1
    assert after["shadow_db"] < 12


def test_an_antenna_ahead_of_its_stated_position_is_found() -> None:
    record = made(120, noise_db=0.5)
    assert record.tx_heading_rad is not None
    ahead = Poses(record.tx_pos_m, record.tx_heading_rad).moved(0.4).position_m
    turn = record.tx_heading_rad[:, None]
    np.testing.assert_allclose(ahead - record.tx_pos_m, 0.4 * np.hstack([np.cos(turn), np.sin(turn), 0 * turn]))
    stated = replace(record, tx_pos_m=2 * record.tx_pos_m - ahead)  # the antenna is 0.4 m ahead of that
    model = fit_strengths(stated, np.arange(120), None, replace(FAST, search_rows=50, noise_db=1.0))
    assert model.facts()["fitted"]["lever_m"] == pytest.approx(0.4, abs=0.15)  # steps of the search


def test_stops_are_thinned_where_factors_would_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    record = made(200, noise_db=1.0, body_db=4.0)
    monkeypatch.setattr(strengths, "MOST_COVARIANCES", 3 * 50**2)
    model = fit_strengths(record, np.arange(150), None, FAST)
    assert len(model.field.stops.poses) == 50
    assert np.median(np.abs(errors(model, record, np.arange(150, 200)))) < 1.5


def test_folds_exclude_neighbours_in_time() -> None:
    count = 700
    held = np.zeros(count, int)
    for train, out in folds(count):
        held[out] += 1
        nearest = np.abs(train[:, None] - out[None]).min()
        assert nearest > 12  # a quarter of a stretch of 50
    assert (held == 1).all()


def test_skewed_residuals_shift_and_widen() -> None:
    rng = np.random.default_rng(0)
    fades = 10 * np.log10(rng.exponential(size=40000))  # Rayleigh fading: mode 0 dB, mean -2.5 dB, median -1.6 dB
    shift = shift_of(fades - fades.mean())
    assert 1.2 < shift < 2.6
    assert shift_of(np.zeros(1), 0.4) == 0.4
    wide = widening(rng.normal(0, 6, (1, 4000)), np.full((1, 4000), 3.0))
    assert wide[0] == pytest.approx(2, rel=0.06)


@pytest.mark.parametrize(
    ("change", "message"),
    [({"shadow_m": 0.0}, "shadow_m"), ({"noise_db": -1.0}, "noise_db"), ({"body_db": np.nan}, "body_db")],
)
def test_settings_are_checked(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        StrengthSettings(**change)  # type: ignore[arg-type]


def test_invalid_arguments_are_refused() -> None:
    record = made(10, noise_db=1.0)
    with pytest.raises(InputError, match="nor a scene"):
        fit_strengths(record, np.array([], int), None)
    with pytest.raises(InputError, match="holds csi"):
        fit_strengths(replace(record, task="csi"), np.arange(5), None)
    with pytest.raises(InputError, match="carrier frequency unknown"):
        fit_strengths(replace(record, frequencies_hz=None), np.arange(5))
    model = fit_strengths(record, np.arange(10), None, FAST)
    for predict in (model.predict, model.predict_mean):
        with pytest.raises(InputError, match="give finite x, y, z"):
            predict(Inputs(np.array([[0.0, np.nan, 0.0]])), 0)


def test_mesh_alone_predicts_the_shadow_of_a_wall(tmp_path) -> None:  # type: ignore[no-untyped-def]
    """A room with a metal wall across it: without measurements less power is predicted behind it."""
    from wrf_mi.tracing import TraceOptions, open_scene

    wall = trimesh.creation.box((0.1, 6.0, 3.0), trimesh.transformations.translation_matrix((3.0, 3.0, 1.5)))
    floor = trimesh.creation.box((8.0, 8.0, 0.1), trimesh.transformations.translation_matrix((3.0, 3.0, -0.05)))
    trimesh.util.concatenate([wall, floor]).export(tmp_path / "room.ply")
    scene = open_scene(tmp_path / "room.ply", FREQUENCY_HZ, material="concrete")
    record = made(20, noise_db=1.0)
    options = TraceOptions(transmission=True, depth=2, reflections=1)
    model = fit_strengths(record, np.array([], int), trace_map(scene, record, 0.5, 0.3, options), FAST)
    # Equally far from the receiver at the origin, before the wall and behind it.
    seen, hidden = model.predict(Inputs(np.array([[0.0, 5.0, 1.3], [5.0, 0.7, 1.3]])), 0).mean
    assert seen > hidden + 5
    inputs = Inputs(record.tx_pos_m)
    std = model.predict(inputs, 0).std
    assert (std > 8).all()
    again = Strengths.from_arrays(model.arrays())
    np.testing.assert_array_equal(again.predict(inputs, 0).mean, model.predict(inputs, 0).mean)


@pytest.mark.skipif("WRF_MI_DATA" not in os.environ, reason="needs the measured flat")
def test_beats_the_law_of_distance_in_a_real_flat() -> None:
    """Validation rows of the training run, none of the test run: 3.2 dB measured, 4.2 dB for the law alone."""
    from wrf_mi.datasets import load, make_splits

    record = load("flat-ble")
    (split,) = make_splits(record, "official", seed=1, n_train=64)
    assert record.official is not None
    assert record.tx_heading_rad is not None
    out = np.setdiff1d(record.official[0], split.all_train)[::4]
    model = fit_strengths(record, split.all_train, None)
    miss = [
        model.predict(Inputs(record.tx_pos_m[out], record.tx_heading_rad[out]), k).mean - record.observation[k, out]
        for k in range(len(record.receivers))
    ]
    assert np.nanmedian(np.abs(miss)) < 3.5
