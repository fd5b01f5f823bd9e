"""Methods from the uplink: exactness on sparse paths, gain over a copy of the uplink, stored models, refused data."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.constants import speed_of_light
from small_fits import network_settings

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.estimators.model import Inputs, inputs_of
from wrf_mi.estimators.networks import nerf2
from wrf_mi.estimators.networks.nerf2 import Nerf2Settings
from wrf_mi.estimators.networks.nerf2_march import Networks
from wrf_mi.estimators.networks.training import network_adam
from wrf_mi.estimators.uplink import fire, linear, optml, r2f2
from wrf_mi.estimators.uplink.fire import FireSettings
from wrf_mi.estimators.uplink.linear import LinearSettings
from wrf_mi.estimators.uplink.optml import OptMLSettings, Simulation
from wrf_mi.estimators.uplink.r2f2 import PathSettings
from wrf_mi.estimators.uplink.uplink_paths import find_paths
from wrf_mi.estimators.uplink.uplink_waves import Bands, bands_of, waves_of
from wrf_mi.models import Problem
from wrf_mi.tasks.scores import cea_db
from wrf_mi.training.session import FitSession

CARRIER_HZ, SPACING_HZ, HALF = 2.4e9, 312.5e3, 26
OFFSETS = np.concatenate([np.arange(-HALF, 0), np.arange(1, HALF + 1)]) * SPACING_HZ
"""The 52 used subcarriers of 802.11 at 20 MHz, without the carrier."""
HZ = CARRIER_HZ + OFFSETS
EXACT_DB = 60.0
"""Coefficients are stored as complex64, whose 140 dB the step to the next band and single antennas in a fade may cost
some; a wrong path, or one of them missing, gives less than 30."""
METHODS = {"linear": linear.MODEL, "fire": fire.MODEL, "r2f2": r2f2.MODEL, "optml": optml.MODEL, "nerf2": nerf2.MODEL}
UPLINK_ALONE = ("linear", "fire", "r2f2", "optml")
PLANE = {"steps": 5, "batch": 4, "wavefront": "plane"}
SMALL = {
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
    hz = {"frequencies_hz": HZ[HALF:], "uplink_hz": HZ[:HALF]} if known else {}
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
    h = channels(*sparse(5, 4, rng, 1.5 if wavefront == "spherical" else 10), elements, wavefront == "spherical")
    record = record_of(h, elements)
    fitted = r2f2.MODEL.fit(Problem(record, PathSettings(max_paths=5, choice_rows=2), 0), split_of(5), FitSession())
    assert fitted.kind == wavefront, "the kind of wave is found on validation rows"
    assert accuracy_db(fitted, record, np.arange(5), h).min() > EXACT_DB


@pytest.mark.parametrize("known", [True, False])
def test_r2f2_without_elements_is_exact_where_delays_are_apart_and_finds_the_gap_of_unknown_bands(known):
    rng = np.random.default_rng(2)
    delays = np.array([5.0, 60.0]) + rng.uniform(-4, 4, (6, 2)) if known else np.array([[30.0, 80.0]])
    gains = rng.standard_normal((6, 2, 12, 2)) @ np.array([1, 1j])
    waves = np.exp(-2j * np.pi / speed_of_light * delays[..., None] * OFFSETS)
    h = np.einsum("nka,nkf->naf", gains, np.broadcast_to(waves, (6, 2, len(OFFSETS))))
    record = record_of(h, known=known)
    fitted = r2f2.MODEL.fit(Problem(record, PathSettings(), 0), split_of(6), FitSession())
    if known:
        assert fitted.kind == "free"
        assert accuracy_db(fitted, record, np.arange(6), h).min() > EXACT_DB
    else:
        assert fitted.bands.downlink_hz[0] - fitted.bands.uplink_hz[-1] == pytest.approx(2 * SPACING_HZ)


def test_search_finds_as_many_paths_as_there_are_in_noise(elements):
    rng = np.random.default_rng(4)
    h = channels(*sparse(8, 3, rng), elements, spherical=False)
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
    fitted = METHODS[name].fit(Problem(record, settings, 0), split, FitSession())
    assert gain_db(fitted, record, split.test, truth) > least_db


def test_fire_ignores_rows_without_downlink(walk):
    truth, record = walk
    split, settings = split_of(80, 16), FireSettings(steps=75, sample="row", width=32)
    observation = record.observation.copy()
    observation[0, :2] = 0
    every, fewer = (
        gain_db(fire.MODEL.fit(Problem(data, settings, 0), split, FitSession()), record, split.test, truth)
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
    fitted = method.fit(Problem(record, settings, 0), split, FitSession())
    inputs = inputs_of(record, split.test)
    predicted = fitted.predict(inputs, 0).mean
    assert predicted.shape == (5, 6, HALF)
    assert np.isfinite(predicted).all()
    assert np.abs(predicted).min() > 0
    if name in ("linear", "r2f2", "optml"):
        assert np.median(cea_db(predicted, record.observation[0][split.test])) > 15
    again = method.load(fitted.arrays(), Problem(record, None), Path())
    np.testing.assert_array_equal(again.predict(inputs, 0).mean, predicted)


def test_optml_finds_all_paths_with_few_steps(elements):
    rng = np.random.default_rng(6)
    h = channels(*sparse(20, 3, rng), elements, spherical=False)
    record, split = record_of(noisy(h, 25, rng), elements), split_of(20, 8)
    training = PLANE | {"steps": 125, "batch": 8, "optimiser": network_adam(5e-3)}
    simulation = Simulation(channels=150, paths=4)
    settings = OptMLSettings(simulation=simulation, width=16, rounds=2, max_distance_m=60.0, **training)
    fitted = optml.MODEL.fit(Problem(record, settings, 0), split, FitSession())
    cea = accuracy_db(fitted, record, split.test, h[split.test])
    assert np.median(cea) > 25, "as good as the uplink was measured: all paths were seen"


@pytest.mark.parametrize("name", UPLINK_ALONE)
def test_loaded_model_predicts_the_same(name, walk, tmp_path):
    record, split = walk[1], split_of(80, 16)
    fitted = METHODS[name].fit(Problem(record, SMALL[name]), split, FitSession())
    arrays = fitted.arrays()
    assert not any(key.startswith("run/") for key in arrays)
    np.savez(tmp_path / "a.npz", **arrays)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as stored:
        blank = Problem(replace(record, observation=np.zeros_like(record.observation)), None)
        again = METHODS[name].load(dict(stored), blank, Path())
    inputs = inputs_of(record, split.test[:5])
    prediction = fitted.predict(inputs, 0).mean
    assert prediction.shape == (5, 48, HALF)
    assert prediction.dtype == np.complex64
    np.testing.assert_array_equal(again.predict(inputs, 0).mean, prediction)
    if name == "r2f2":
        silent = Inputs(np.full((2, 3), np.nan), uplink=np.zeros((2, 48, 26), np.complex64))
        assert not fitted.predict(silent, 0).mean.any()


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
            METHODS[name].fit(Problem(data, SMALL[name]), split, FitSession())


def test_unknown_words_are_refused_by_the_settings_themselves() -> None:
    for kind, wrong in ((PathSettings, {"wavefront": "cylinder"}), (FireSettings, {"sample": "x"})):
        with pytest.raises(InputError, match="choose from"):
            kind(**wrong)
