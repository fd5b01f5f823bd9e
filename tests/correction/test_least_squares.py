"""Least squares with a prior: closed form, outliers, standard deviations; and the common motion of all planes."""

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, stated_scene
from scipy.spatial.transform import Rotation
from scipy.stats import t

from wrf_mi.correction.least_squares import (
    FREEDOM,
    Jacobian,
    Noise,
    Prior,
    left_out_residuals,
    minimised,
    posterior_covariance,
)
from wrf_mi.correction.state import rigid_motion, rigid_motions
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.search.surfaces import scene_surfaces

ROWS, VALUES = 400, 6
RNG = np.random.default_rng(1)
MATRIX = RNG.normal(size=(ROWS, VALUES, 3))
TRUE = np.array([0.5, -1.0, 2.0])


def solve(matrix: np.ndarray, observed: np.ndarray, prior: Prior) -> tuple[np.ndarray, np.ndarray]:
    """Parameters of a linear model, and their covariance."""
    start, every = np.zeros(matrix.shape[-1]), np.arange(matrix.shape[-1])
    vector, residual = minimised(lambda v: matrix @ v - observed, lambda v: first(matrix), start, every, prior, 30)
    return vector, posterior_covariance(first(matrix), residual, prior, Noise.of(residual))


def fitted(observed: np.ndarray, prior: Prior) -> np.ndarray:
    return solve(MATRIX, observed, prior)[0]


def first(matrix: np.ndarray) -> Jacobian:
    """Derivatives of a product with a matrix [rows, values, p]."""
    return Jacobian(np.moveaxis(matrix, -1, 0))


def weak(deviation: float = 100.0) -> Prior:
    return Prior(np.zeros(3), np.eye(3) / deviation**2)


def test_exact_values_are_recovered_in_spite_of_outliers_and_missing_rows():
    np.testing.assert_allclose(fitted(MATRIX @ TRUE, weak()), TRUE, atol=1e-6)
    noisy = MATRIX @ TRUE + np.random.default_rng(4).normal(0, 0.1, (ROWS, VALUES))
    noisy[:60] += 5.0
    np.testing.assert_allclose(fitted(noisy, weak()), TRUE, atol=0.02)
    noisy = MATRIX @ TRUE + np.random.default_rng(5).normal(0, 0.1, (ROWS, VALUES))
    part = fitted(np.where(np.arange(ROWS)[:, None] < 200, noisy, np.nan), weak())
    alone, _ = solve(MATRIX[:200], noisy[:200], weak())
    np.testing.assert_allclose(part, alone, atol=1e-6)


def test_parameters_without_data_stay_at_the_prior():
    blind = MATRIX * [1, 1, 0]
    prior = Prior(np.array([0, 0, 0.7]), np.diag([1e-4, 1e-4, 1 / 0.3**2]))
    noisy = blind @ TRUE + np.random.default_rng(2).normal(0, 0.1, (ROWS, VALUES))
    vector, covariance = solve(blind, noisy, prior)
    assert vector[2] == pytest.approx(0.7)
    assert np.sqrt(covariance[2, 2]) == pytest.approx(0.3)


def test_standard_deviations_are_those_of_repeated_measurements():
    """Within 25 %: 60 repetitions know a standard deviation to 9 %, and weights cost a few per cent more."""
    vectors, deviations = [], []
    for seed in range(60):
        noisy = MATRIX @ TRUE + np.random.default_rng(seed).normal(0, 0.3, (ROWS, VALUES))
        vector, covariance = solve(MATRIX, noisy, weak())
        vectors.append(vector)
        deviations.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(np.std(vectors, axis=0), np.mean(deviations, axis=0), rtol=0.25)


def test_residuals_of_rows_left_out_are_those_of_fits_to_the_others():
    """Of ten rows and three parameters, all with the weights of the fit to all rows; one row was not observed."""
    rng, prior = np.random.default_rng(4), weak(1.0)
    slope, observed = rng.normal(size=(10, 2, 3)), rng.normal(size=(10, 2))
    observed[3] = np.nan
    noise, is_observed = Noise(0.5, 2.0), np.arange(10) != 3

    def fit(weights, rows):
        part, values = slope[rows], observed[rows]
        information = np.einsum("r,rvp,rvq->pq", weights[rows], part, part) + prior.precision
        return np.linalg.solve(information, np.einsum("r,rvp,rv->p", weights[rows], part, values)), information

    weights = noise.weights(observed)
    for _ in range(200):
        vector, information = fit(weights, np.flatnonzero(is_observed))
        weights = noise.weights(slope @ vector - observed)
    residuals = left_out_residuals(first(slope), slope @ vector - observed, np.linalg.inv(information), noise)
    assert np.isnan(residuals[3]).all()
    for row in np.flatnonzero(is_observed):
        without, _ = fit(weights, np.flatnonzero(is_observed & (np.arange(10) != row)))
        np.testing.assert_allclose(residuals[row], slope[row] @ without - observed[row], rtol=1e-6)


def test_correlated_values_count_once():
    """Equal values in a row are one measurement: standard deviations do not fall with their number."""
    rng = np.random.default_rng(3)
    single, many = (np.repeat(rng.normal(0, 0.2, (ROWS, 1)), count, axis=1) for count in (1, 50))
    assert Noise.of(many).values == pytest.approx(1, abs=0.05)
    assert Noise.of(rng.normal(size=(4000, 20))).values == pytest.approx(20, rel=0.05)
    slope = np.ones((ROWS, 1, 1))
    prior = Prior(np.zeros(1), np.full((1, 1), 1e-6))
    pairs = (slope, single), (np.repeat(slope, 50, axis=1), many)
    variances = [solve(matrix, observed, prior)[1][0, 0] for matrix, observed in pairs]
    assert variances[1] == pytest.approx(variances[0], rel=0.2)


def test_cost_is_the_likelihood_of_students_t():
    """Differences of the cost of one value a row are those of SciPy's distribution."""
    values = np.array([[0.1], [0.5]])
    costs = [Noise(0.04, 1.0).cost(value[None]) for value in values]
    logarithms = t(FREEDOM, scale=0.2).logpdf(values.ravel())
    assert costs[1] - costs[0] == pytest.approx(logarithms[0] - logarithms[1])


@pytest.mark.parametrize("rows", [40, 400])
def test_values_are_counted_whatever_the_number_and_size_of_rows(rows):
    """Of white noise all count, where rows are few and a tenth of them has most of the power."""
    rng = np.random.default_rng(6)
    size = np.where(rng.random((rows, 1)) < 0.1, 10.0, 1.0)
    assert Noise.of(size * rng.normal(size=(rows, 16))).values == pytest.approx(16, rel=0.1)
    assert Noise.of(rng.normal(size=(1, 16))).values == 1


SECOND_ORDER = 5e-5
"""Metres and rad: a rotation of 1.4 mrad times a displacement of 37 mm, or its square times 5 m."""


@pytest.fixture(scope="module")
def planes(tmp_path_factory):
    return scene_surfaces(open_scene(stated_scene(tmp_path_factory.mktemp("room") / "scene"), CARRIER_HZ))


def test_motions_are_those_of_the_moved_room(planes):
    """Shifted and tilted planes are the planes of the room after a small rotation and translation."""
    motion = np.array([0.01, -0.02, 0.03, 1e-3, -5e-4, 8e-4])
    count, centre = len(planes.normal), planes.plane_centres_m
    change = rigid_motions(planes) @ motion
    normal, offset = planes.moved_planes(change[:count], change[count:].reshape(count, 2))
    turn, middle = Rotation.from_rotvec(motion[3:]), centre.mean(axis=0)
    np.testing.assert_allclose(normal, turn.apply(planes.normal), atol=SECOND_ORDER)
    moved_centre = turn.apply(centre - middle) + middle + motion[:3]
    np.testing.assert_allclose((normal * moved_centre).sum(axis=1), offset, atol=SECOND_ORDER)


def test_motions_are_found_again_with_their_uncertainty(planes):
    motion = np.array([0.01, -0.02, 0.03, 1e-3, -5e-4, 8e-4])
    rng, deviation = np.random.default_rng(0), 1e-3
    change = rigid_motions(planes) @ motion
    precision = np.full(len(change), deviation**-2.0)
    estimates = [rigid_motion(planes, change + rng.normal(0, deviation, len(change)), precision) for _ in range(200)]
    values, motion_sd = np.array([estimate[0] for estimate in estimates]), estimates[0][1]
    np.testing.assert_allclose(values.mean(axis=0), motion, atol=4 * motion_sd.max() / np.sqrt(200))
    np.testing.assert_allclose(values.std(axis=0), motion_sd, rtol=0.25)
    count = len(planes.normal)
    precision = np.zeros(3 * count)
    upright = np.abs(planes.normal[:, 2]) > 0.9
    precision[:count][upright] = 1.0  # floor and ceiling alone
    _, motion_sd = rigid_motion(planes, np.zeros(3 * count), precision)
    assert np.isinf(motion_sd[:2]).all()
    assert np.isfinite(motion_sd[2])
