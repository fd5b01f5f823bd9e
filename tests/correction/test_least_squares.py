"""Least squares with a prior: closed form, outliers, and standard deviations that repeated measurements have."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.correction.least_squares import (
    FREEDOM,
    Noise,
    Prior,
    left_out_residuals,
    minimised,
    posterior_covariance,
)

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


def first(matrix: np.ndarray) -> np.ndarray:
    """Derivatives [p, rows, values] of a product with a matrix [rows, values, p]."""
    return np.moveaxis(matrix, -1, 0)


def weak(deviation: float = 100.0) -> Prior:
    return Prior(np.zeros(3), np.eye(3) / deviation**2)


def test_values_without_noise_are_recovered() -> None:
    np.testing.assert_allclose(fitted(MATRIX @ TRUE, weak()), TRUE, atol=1e-6)


def test_parameters_without_data_stay_at_the_prior() -> None:
    blind = MATRIX * [1, 1, 0]
    prior = Prior(np.array([0, 0, 0.7]), np.diag([1e-4, 1e-4, 1 / 0.3**2]))
    noisy = blind @ TRUE + np.random.default_rng(2).normal(0, 0.1, (ROWS, VALUES))
    vector, covariance = solve(blind, noisy, prior)
    assert vector[2] == pytest.approx(0.7)
    assert np.sqrt(covariance[2, 2]) == pytest.approx(0.3)


def test_standard_deviations_are_those_of_repeated_measurements() -> None:
    """Within 25 %: 60 repetitions know a standard deviation to 9 %, and weights cost a few per cent more."""
    vectors, stated = [], []
    for seed in range(60):
        noisy = MATRIX @ TRUE + np.random.default_rng(seed).normal(0, 0.3, (ROWS, VALUES))
        vector, covariance = solve(MATRIX, noisy, weak())
        vectors.append(vector)
        stated.append(np.sqrt(np.diag(covariance)))
    np.testing.assert_allclose(np.std(vectors, axis=0), np.mean(stated, axis=0), rtol=0.25)


def test_residuals_of_rows_left_out_are_those_of_fits_to_the_others() -> None:
    """Of ten rows and three parameters, all with the weights of the fit to all rows; one row was not observed."""
    rng, prior = np.random.default_rng(4), weak(1.0)
    slope, observed = rng.normal(size=(10, 2, 3)), rng.normal(size=(10, 2))
    observed[3] = np.nan
    noise, seen = Noise(0.5, 2.0), np.arange(10) != 3

    def fit(weights: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        part, values = slope[rows], observed[rows]
        information = np.einsum("r,rvp,rvq->pq", weights[rows], part, part) + prior.precision
        return np.linalg.solve(information, np.einsum("r,rvp,rv->p", weights[rows], part, values)), information

    weights = noise.weights(observed)
    for _ in range(200):
        vector, information = fit(weights, np.flatnonzero(seen))
        weights = noise.weights(slope @ vector - observed)
    found = left_out_residuals(first(slope), slope @ vector - observed, np.linalg.inv(information), noise)
    assert np.isnan(found[3]).all()
    for row in np.flatnonzero(seen):
        without, _ = fit(weights, np.flatnonzero(seen & (np.arange(10) != row)))
        np.testing.assert_allclose(found[row], slope[row] @ without - observed[row], rtol=1e-6)


def test_correlated_values_count_once() -> None:
    """Equal values in a row are one measurement: standard deviations do not fall with their number."""
    rng = np.random.default_rng(3)
    one, many = (np.repeat(rng.normal(0, 0.2, (ROWS, 1)), count, axis=1) for count in (1, 50))
    assert Noise.of(many).values == pytest.approx(1, abs=0.05)
    assert Noise.of(rng.normal(size=(4000, 20))).values == pytest.approx(20, rel=0.05)
    slope = np.ones((ROWS, 1, 1))
    prior = Prior(np.zeros(1), np.full((1, 1), 1e-6))
    pairs = (slope, one), (np.repeat(slope, 50, axis=1), many)
    found = [solve(matrix, observed, prior)[1][0, 0] for matrix, observed in pairs]
    assert found[1] == pytest.approx(found[0], rel=0.2)


@pytest.mark.parametrize("rows", [40, 400])
def test_values_are_counted_whatever_the_number_and_size_of_rows(rows: int) -> None:
    """Of white noise all count, where rows are few and a tenth of them has most of the power."""
    rng = np.random.default_rng(6)
    size = np.where(rng.random((rows, 1)) < 0.1, 10.0, 1.0)
    assert Noise.of(size * rng.normal(size=(rows, 16))).values == pytest.approx(16, rel=0.1)
    assert Noise.of(rng.normal(size=(1, 16))).values == 1


def test_rows_that_nothing_explains_hardly_count() -> None:
    noisy = MATRIX @ TRUE + np.random.default_rng(4).normal(0, 0.1, (ROWS, VALUES))
    noisy[:60] += 5.0
    np.testing.assert_allclose(fitted(noisy, weak()), TRUE, atol=0.02)


def test_rows_without_observation_are_left_out() -> None:
    noisy = MATRIX @ TRUE + np.random.default_rng(5).normal(0, 0.1, (ROWS, VALUES))
    part = fitted(np.where(np.arange(ROWS)[:, None] < 200, noisy, np.nan), weak())
    alone, _ = solve(MATRIX[:200], noisy[:200], weak())
    np.testing.assert_allclose(part, alone, atol=1e-6)


def test_cost_is_the_likelihood_of_students_t() -> None:
    """Differences of the cost of one value a row are those of SciPy's distribution."""
    from scipy.stats import t

    noise, values = Noise(0.04, 1.0), np.array([[0.1], [0.5]])
    costs = [noise.cost(values[k : k + 1]) for k in range(2)]
    logarithms = t(FREEDOM, scale=0.2).logpdf(values.ravel())
    assert costs[1] - costs[0] == pytest.approx(logarithms[0] - logarithms[1])
