"""Methods from the uplink: exactness, gain over a copy of the uplink, stored models, penalties, refused data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.constants import speed_of_light
from small_fits import network_settings

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.estimators.model import Inputs, Session, inputs_of
from wrf_mi.estimators.networks import nerf2
from wrf_mi.estimators.networks.nerf2 import Nerf2Settings
from wrf_mi.estimators.networks.nerf2_march import Networks
from wrf_mi.estimators.networks.training import network_adam
from wrf_mi.estimators.uplink import fire, linear, optml, r2f2
from wrf_mi.estimators.uplink.fire import FireSettings
from wrf_mi.estimators.uplink.linear import MODEL, PENALTIES, LinearMap, LinearSettings, choose
from wrf_mi.estimators.uplink.optml import OptMLSettings, Simulation
from wrf_mi.estimators.uplink.r2f2 import PathSettings
from wrf_mi.estimators.uplink.uplink_paths import find_paths
from wrf_mi.estimators.uplink.uplink_waves import Bands, bands_of, relative_error, waves_of
from wrf_mi.models import Problem
from wrf_mi.tasks.conditions import normalised_uplink
from wrf_mi.tasks.scores import cea_db
from wrf_mi.training.session import quiet

CARRIER_HZ, SPACING_HZ, HALF = 2.4e9, 312.5e3, 26
OFFSETS = np.concatenate([np.arange(-HALF, 0), np.arange(1, HALF + 1)]) * SPACING_HZ
"""The 52 used subcarriers of 802.11 at 20 MHz, without the carrier."""
HZ = CARRIER_HZ + OFFSETS
EXACT_DB = 60.0
"""Coefficients are stored as complex64, whose 140 dB the step to the next band and single antennas in a fade may cost
some; a wrong path, or one of them missing, gives less than 30."""
METHODS = {"linear": linear.MODEL, "fire": fire.MODEL, "r2f2": r2f2.MODEL, "optml": optml.MODEL, "nerf2": nerf2.MODEL}
UPLINK_ALONE = ("linear", "fire", "r2f2", "optml")
PLANE: dict[str, Any] = {"steps": 5, "batch": 4, "wavefront": "plane"}
SMALL: dict[str, Any] = {
    "linear": LinearSettings(),
    "fire": FireSettings(steps=50, batch=32, validate_every=20, sample="antenna", width=16, latent=4),
    "r2f2": PathSettings(max_paths=3, choice_rows=2),
    "optml": OptMLSettings(
        simulation=Simulation(channels=12, paths=2), width=4, rounds=1, max_distance_m=30.0, **PLANE
    ),
    "nerf2": Nerf2Settings(12, 8, networks=Networks(layers=2, width=8), sphere_rays=8, samples=2),
}


def channels(gains, theta, elements, spherical):
    """Coefficients [n, antennas, 52] of paths: gains [n, k], distances and cosines [n, k, 3]."""
    d, along = theta[..., :1], theta[..., 1:] @ elements[:, :2].T
    s = np.sqrt(d * d - 2 * d * along + np.square(elements).sum(axis=1)) if spherical else d - along
    amplitude = d / s if spherical else np.ones_like(s)
    return np.einsum("nk,nka,nkaf->naf", gains, amplitude, np.exp(-2j * np.pi / speed_of_light * s[..., None] * HZ))


def record_of(h, elements=None, known=True):
    """A record of coefficients [n, antennas, 52]."""
    receiver, nowhere = Receiver("bs", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])), np.full((len(h), 3), np.nan)
    uplink, downlink = (part.astype(np.complex64) for part in np.split(h, 2, axis=-1))
    hz: dict[str, Any] = {"frequencies_hz": HZ[HALF:], "uplink_hz": HZ[:HALF]} if known else {}
    return Record("made", "csi", nowhere, (receiver,), downlink[None], uplink=uplink, **hz).with_array(elements)


def split_of(n, test=0):
    """First rows train, the next fifth validates, the last ``test`` test."""
    rows = np.arange(n)
    cut = (n - test) - (n - test) // 5
    return Split("made", 0, rows[:cut], rows[cut : n - test], rows[n - test :])


def accuracy_db(fitted, record, rows, truth):
    """Accuracy [n] of predictions from the uplinks of some rows, against coefficients [n, antennas, 52]."""
    return cea_db(fitted.predict(inputs_of(record, rows), 0).mean, truth[:, :, HALF:])


def gain_db(fitted, record, rows, truth):
    """Median accuracy over that of a copy of the uplink."""
    copied = cea_db(record.uplink[rows], truth[rows][:, :, HALF:])
    return np.median(accuracy_db(fitted, record, rows, truth[rows])) - np.median(copied)


def noisy(h, snr_db, rng):
    """With white noise so far below each row's mean power."""
    deviation = np.sqrt(np.square(np.abs(h)).mean(axis=(1, 2), keepdims=True) * 10 ** (-snr_db / 10) / 2)
    return h + deviation * (rng.standard_normal((*h.shape, 2)) @ np.array([1, 1j]))


def sparse(n, paths, rng, near=10.0, far=60.0):
    """Gains and parameters of paths whose directions lie in different quarters of the sky."""
    centres = np.array([[-0.5, -0.4], [0.5, -0.4], [-0.5, 0.4], [0.5, 0.4]])[:paths]
    cosines = centres + rng.uniform(-0.15, 0.15, (n, paths, 2))
    theta = np.concatenate([rng.uniform(near, far, (n, paths, 1)), cosines], axis=2)
    return rng.uniform(0.4, 1, (n, paths)) * np.exp(2j * np.pi * rng.random((n, paths))), theta


@pytest.fixture(scope="module")
def elements():
    return planar_array(6, 8, speed_of_light / CARRIER_HZ / 2)


@pytest.fixture(scope="module")
def walk(elements):
    """80 rows of a user who walks past six image sources, noise-free, and the record at 25 dB."""
    rng = np.random.default_rng(0)
    gains, theta = sparse(1, 4, rng, 3.0, 25.0)
    along = np.linspace(0, 1, 80)[:, None]
    moved = np.repeat(theta, 80, axis=0)
    moved[..., 0] += along * rng.uniform(-1.5, 1.5, 4)
    moved[..., 1:] += along[..., None] * rng.uniform(-0.2, 0.2, (4, 2))
    truth = channels(np.repeat(gains, 80, axis=0), moved, elements, spherical=True)
    return truth, record_of(noisy(truth, 25, rng), elements)


@pytest.mark.parametrize("wavefront", ["plane", "spherical"])
def test_r2f2_is_exact_on_noise_free_sparse_paths(elements, wavefront):
    rng = np.random.default_rng(1)
    gains, theta = sparse(5, 4, rng, 1.5 if wavefront == "spherical" else 10)
    h = channels(gains, theta, elements, wavefront == "spherical")
    record = record_of(h, elements)
    fitted = r2f2.MODEL.fit(
        Problem(record, PathSettings(max_paths=5, choice_rows=2), 0), split_of(5), Session(None, None)
    )
    assert fitted.kind == wavefront, "the kind of wave is found on validation rows"
    assert accuracy_db(fitted, record, np.arange(5), h).min() > EXACT_DB
    silent = inputs_of(record, np.arange(2))
    silent.uplink[0] = 0  # beside one that is not
    predicted = fitted.predict(silent, 0).mean
    assert not predicted[0].any()
    assert predicted[1].all()


@pytest.mark.parametrize("known", [True, False])
def test_r2f2_without_elements_is_exact_where_delays_are_apart_and_finds_the_gap_of_unknown_bands(known):
    rng = np.random.default_rng(2)
    delays = np.array([5.0, 60.0]) + rng.uniform(-4, 4, (6, 2)) if known else np.array([[30.0, 80.0]])
    gains = rng.standard_normal((6, 2, 12, 2)) @ np.array([1, 1j])
    waves = np.exp(-2j * np.pi / speed_of_light * delays[..., None] * OFFSETS)
    h = np.einsum("nka,nkf->naf", gains, np.broadcast_to(waves, (6, 2, len(OFFSETS))))
    record = record_of(h, known=known)
    fitted = r2f2.MODEL.fit(Problem(record, PathSettings(), 0), split_of(6), Session(None, None))
    if known:
        assert fitted.kind == "free"
        assert accuracy_db(fitted, record, np.arange(6), h).min() > EXACT_DB
    else:
        assert fitted.bands.downlink_hz[0] - fitted.bands.uplink_hz[-1] == pytest.approx(2 * SPACING_HZ)


def test_search_finds_as_many_paths_as_there_are_in_noise(elements):
    rng = np.random.default_rng(4)
    gains, theta = sparse(8, 3, rng)
    h = channels(gains, theta, elements, spherical=False)
    record = record_of(noisy(h, 25, rng), elements)
    bands = bands_of(record, SPACING_HZ)
    waves = waves_of("plane", bands, 100.0)
    paths = find_paths(waves, record.uplink.astype(complex), 10, 2, 10)
    assert (paths.present.sum(axis=1) == 3).all(), "no path is missed, none fits noise"
    cea = cea_db(waves.evaluate(paths.theta, paths.gains, bands.downlink_hz), h[:, :, HALF:])
    # 15 real numbers from 1,248 noisy coefficients: noise falls by 22 dB, of which the next band costs about 10.
    assert np.median(cea) > 30


@pytest.mark.parametrize("kind", ["plane", "spherical", "free"])
def test_gradient_of_the_projected_residual_equals_finite_differences(kind, elements):
    """Variable projection: derivative of the residual's energy with the gains at their best."""
    rng = np.random.default_rng(5)
    bands = Bands(HZ[:HALF], HZ[HALF:], len(elements), True, elements[:, :2])
    waves = waves_of(kind, bands, 100.0)
    h = rng.standard_normal((2, len(elements), HALF, 2)) @ np.array([1, 1j])
    theta = np.concatenate([rng.uniform(2, 20, (2, 3, 1)), rng.uniform(-0.5, 0.5, (2, 3, 2))], axis=2)
    theta = theta[..., :1] if kind == "free" else theta
    present = np.array([[True, True, True], [True, False, True]])
    right = waves.normal(theta, waves.solve(theta, present, h))[1]
    step, numbers = 1e-5, theta.shape[1] * theta.shape[2]
    for number in range(numbers):
        moved = np.zeros(numbers)
        moved[number] = step
        up, down = (waves.solve(theta + s * moved.reshape(theta.shape[1:]), present, h).energy for s in (1, -1))
        # Curvatures of up to 1e6 times the step, squared, and rounding of energies of 2,500.
        np.testing.assert_allclose(-2 * right[:, number], (up - down) / (2 * step), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("kind", ["plane", "spherical"])
def test_no_row_has_no_atoms(kind, elements):
    """As where no row to predict has an uplink."""
    bands = Bands(HZ[:HALF], HZ[HALF:], len(elements), True, elements[:, :2])
    waves: Any = waves_of(kind, bands, 100.0)
    atoms = waves.atoms(np.zeros((0, 3, 3)), bands.downlink_hz)
    assert atoms.shape == (0, 3, len(elements), HALF)


@pytest.mark.parametrize(
    ("name", "settings", "least_db"),
    [
        # Noise of 25 dB is not what limits a network of 300 steps; a wrong unit gives 0 dB.
        ("fire", network_settings(FireSettings, 375, 128, 2e-3, 100, sample="antenna", width=64, latent=16), 6),
        # Its phase alone, put right, gives 2 dB.
        ("linear", LinearSettings(), 10),
    ],
)
def test_methods_beat_copying_the_uplink(walk, name, settings, least_db):
    truth, record = walk
    split = split_of(80, 16)
    fitted = METHODS[name].fit(Problem(record, settings, 0), split, Session(None, None))
    assert gain_db(fitted, record, split.test, truth) > least_db


def test_fire_ignores_rows_without_downlink(walk):
    truth, record = walk
    split, settings = split_of(80, 16), FireSettings(steps=75, sample="row", width=32)
    observation = record.observation.copy()
    observation[0, :2] = 0
    every, fewer = (
        gain_db(fire.MODEL.fit(Problem(data, settings, 0), split, Session(None, None)), record, split.test, truth)
        for data in (record, replace(record, observation=observation))
    )
    assert fewer > every - 0.5, "2 of 80 rows are silent; a weight of their own makes all rows so"


@pytest.mark.parametrize(
    ("name", "known"),
    # Fields alone use poses.
    [(name, "nothing") for name in SMALL] + [("nerf2", "its position"), ("nerf2", "its orientation")],
)
def test_captures_without_a_pose_are_fitted_and_predicted(name, known, walk):
    """As in Argos' captures, the base station's position, elements and frequencies are unknown.
    Networks of ten steps predict no better than zeros; the other methods reach a median CEA of 15 dB.
    """
    truth, _ = walk
    place = np.array([1.0, 2.0, 3.0]) if known == "its position" else np.full(3, np.nan)
    turned = np.array([0.5, 0.5, 0.5, 0.5]) if known == "its orientation" else np.full(4, np.nan)
    record = replace(record_of(truth[:30, :6], known=False), receivers=(Receiver("base-station", place, turned),))
    settings = replace(SMALL[name], wavefront="auto") if name == "optml" else SMALL[name]
    method, split = METHODS[name], split_of(30, 5)
    fitted = method.fit(Problem(record, settings, 0), split, Session(None, None))
    inputs = inputs_of(record, split.test)
    predicted = fitted.predict(inputs, 0).mean
    assert (predicted.shape, predicted.dtype) == ((5, 6, HALF), np.complex64)
    assert np.isfinite(predicted).all()
    assert np.abs(predicted).min() > 0
    if name in ("linear", "r2f2", "optml"):
        assert np.median(cea_db(predicted, record.observation[0][split.test])) > 15
    blank = Problem(replace(record, observation=np.zeros_like(record.observation)), None)
    again = method.load(fitted.arrays(), blank, Path())
    np.testing.assert_array_equal(again.predict(inputs, 0).mean, predicted)


def test_optml_finds_all_paths_with_few_steps(elements):
    rng = np.random.default_rng(6)
    gains, theta = sparse(20, 3, rng)
    h = channels(gains, theta, elements, spherical=False)
    record, split = record_of(noisy(h, 25, rng), elements), split_of(20, 8)
    training: dict[str, Any] = PLANE | {"steps": 125, "batch": 8, "optimiser": network_adam(5e-3)}
    simulation = Simulation(channels=150, paths=4)
    settings = OptMLSettings(simulation=simulation, width=16, rounds=2, max_distance_m=60.0, **training)
    fitted = optml.MODEL.fit(Problem(record, settings, 0), split, Session(None, None))
    cea = accuracy_db(fitted, record, split.test, h[split.test])
    assert np.median(cea) > 25, "as good as the uplink was measured: all paths were seen"


@pytest.mark.parametrize("name", UPLINK_ALONE)
def test_single_rows_and_records_of_two_receivers_or_of_another_array_are_refused(name, walk):
    """All other checks of a record are those of `train` (test_uplink_runs.py)."""
    record, nothing = walk[1], np.zeros(0, np.int64)
    doubled = replace(record, receivers=record.receivers * 2, observation=np.repeat(record.observation, 2, axis=0))
    fewer = record.with_array(record.receivers[0].array_m[:-1])
    for data, split, message in (
        (doubled, split_of(80), "needs one receiver"),
        (fewer, split_of(80), "47, 3"),
        (record, Split("made", 0, np.array([0]), nothing, nothing), "1 training row"),
    ):
        if data is fewer and name == "linear":  # which does not use the array
            continue
        with pytest.raises(InputError, match=message):
            METHODS[name].fit(Problem(data, SMALL[name]), split, Session(None, None))


def test_unknown_words_are_refused_by_the_settings_themselves() -> None:
    kind: Any
    for kind, wrong in ((PathSettings, {"wavefront": "cylinder"}), (FireSettings, {"sample": "x"})):
        with pytest.raises(InputError, match="choose from"):
            kind(**wrong)


ROWS, ANTENNAS, UP, DOWN = 40, 3, 6, 5
EXACT = 1e-5  # coefficients are stored in single precision; the least penalty is 1e-10 of the uplink's energy
ROUNDING = 1e-9  # of float64, squared by the normal equations


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.standard_normal((*shape, 2)) @ np.array([1, 1j]) / np.sqrt(2)


def unplaced_record(uplink: np.ndarray, downlink: np.ndarray) -> Record:
    receiver = Receiver("base-station", np.full(3, np.nan), np.array([0.0, 0.0, 0.0, 1.0]))
    uplink, downlink = uplink.astype(np.complex64), downlink[None].astype(np.complex64)
    return Record("made", "csi", np.full((len(uplink), 3), np.nan), (receiver,), downlink, uplink=uplink)


def linear_record(noise: float = 0.0) -> tuple[Record, np.ndarray]:
    """A downlink that is a linear map of the uplink, rows of very different size, and the map [UP, DOWN]."""
    rng = np.random.default_rng(0)
    matrix = complex_normal(rng, UP, DOWN)
    uplink = complex_normal(rng, ROWS, ANTENNAS, UP) * 10 ** rng.uniform(-6, -3, (ROWS, 1, 1))
    size = np.sqrt(np.square(np.abs(uplink)).mean(axis=(1, 2), keepdims=True))
    return unplaced_record(uplink, uplink @ matrix + noise * size * complex_normal(rng, ROWS, ANTENNAS, DOWN)), matrix


def split_made(train: int = 24, validation: int = 6) -> Split:
    rows = np.arange(ROWS)
    return Split("made", 0, rows[:train], rows[train : train + validation], rows[train + validation :])


def fit_linear(record: Record, split: Split, **settings: float) -> LinearMap:
    return MODEL.fit(Problem(record, LinearSettings(**settings), 0), split, Session(None, None))


def test_exact_on_a_noise_free_linear_relation_and_zero_for_zeros() -> None:
    record, matrix = linear_record()
    split = split_made()
    fitted = fit_linear(record, split)
    assert fitted.penalty == PENALTIES[0]
    np.testing.assert_allclose(fitted.matrix, matrix, atol=EXACT)
    predicted, truth = fitted.predict(inputs_of(record, split.test), 0).mean, record.observation[0, split.test]
    assert predicted.dtype == np.complex64
    assert relative_error(predicted, truth).max() < EXACT**2
    record, _ = linear_record()
    uplink = np.ones((2, ANTENNAS, UP), np.complex64)
    uplink[1, 2] = 0
    predicted = fit_linear(record, split_made()).predict(Inputs(np.full((2, 3), np.nan), uplink=uplink), 0).mean
    assert not predicted[1, 2].any()
    assert predicted[1, 1].all()


def test_penalty_is_chosen_on_validation_rows_and_fitted_to_all_training_rows() -> None:
    """Against least squares with rows for the penalty below, antenna by antenna as they are in the docstring."""
    record, _ = linear_record(noise=1.5)
    split = split_made(8, 12)
    shares: list[float] = []
    session = Session(None, None, lambda stage, share, *_: shares.append(share))
    fitted = MODEL.fit(Problem(record, LinearSettings(), 0), split, session)
    assert shares[-1] == 1
    assert shares == sorted(shares)

    def solved(rows: np.ndarray, penalty: float) -> np.ndarray:
        u, d = record.uplink[rows].astype(complex), record.observation[0, rows].astype(complex)
        divisor = normalised_uplink(u)[1][..., None]
        weight = np.abs(divisor) / np.sqrt(np.square(np.abs(d)).sum(axis=(1, 2), keepdims=True))
        x, y = (weight * u / divisor).reshape(-1, UP), (weight * d / divisor).reshape(-1, DOWN)
        damping = np.sqrt(penalty * np.square(np.abs(x)).sum() / UP)
        x, y = np.vstack([x, damping * np.eye(UP)]), np.vstack([y, np.zeros((UP, DOWN))])
        return np.asarray(np.linalg.lstsq(x, y, rcond=None)[0])

    def error(penalty: float) -> float:
        truth = record.observation[0, split.validation]
        predicted = record.uplink[split.validation] @ solved(split.train, penalty)
        return float(np.median(relative_error(predicted.reshape(len(truth), -1), truth.reshape(len(truth), -1))))

    assert fitted.penalty == min(PENALTIES, key=error)
    assert PENALTIES[0] < fitted.penalty < PENALTIES[-1], "something is chosen"
    np.testing.assert_allclose(fitted.matrix, solved(split.all_train, fitted.penalty), rtol=ROUNDING, atol=ROUNDING)
    assert fit_linear(record, split, penalty=0.5).penalty == 0.5


def test_errors_are_relative_to_the_energy_of_rows() -> None:
    """Scaled rows do not change the map, and a row without downlink energy, or of NaN, is ignored."""
    record, _ = linear_record(noise=0.3)
    split, size = split_made(), np.float32(10) ** np.arange(ROWS)[:, None, None].clip(0, 5)
    larger = replace(record, observation=record.observation * size, uplink=record.uplink * size)
    expected = fit_linear(record, split).matrix
    np.testing.assert_allclose(fit_linear(larger, split).matrix, expected, rtol=EXACT, atol=EXACT)
    silent = record.observation.copy()
    silent[0, 3] = 0
    fewer = replace(split, train=np.delete(split.train, 3))
    lost = np.where(silent == 0, np.complex64(np.nan), silent)
    np.testing.assert_array_equal(
        fit_linear(replace(record, observation=lost), split).matrix, fit_linear(record, fewer).matrix
    )
    muted = fit_linear(replace(record, observation=silent), split, penalty=0.1).matrix
    np.testing.assert_allclose(muted, fit_linear(record, fewer, penalty=0.1).matrix, rtol=ROUNDING, atol=ROUNDING)


def test_without_validation_rows_every_fifth_training_row_chooses() -> None:
    record, _ = linear_record(noise=1.5)
    rows = np.arange(20)
    split = Split("made", 0, rows, rows[:0], np.arange(20, ROWS))
    expected = choose(record, np.setdiff1d(rows, rows[::5]), rows[::5], quiet)
    assert fit_linear(record, split).penalty == expected
    two = fit_linear(record, replace(split, train=rows[:2]))
    assert np.isfinite(two.matrix).all()


def test_penalties_out_of_range_and_rows_without_energy_are_refused() -> None:
    record, _ = linear_record()
    for penalty in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="choose more than 0"):
            LinearSettings(penalty=penalty)
    with pytest.raises(InputError, match="made: no training row's downlink has any energy"):
        fit_linear(replace(record, observation=np.zeros_like(record.observation)), split_made())
