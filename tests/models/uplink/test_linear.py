"""The linear map from uplink to downlink: exactness, weights of rows and choice of the penalty."""

from dataclasses import replace

import numpy as np
import pytest

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.estimators.model import Inputs, inputs_of
from wrf_mi.estimators.uplink.linear import MODEL, PENALTIES, LinearMap, LinearSettings, choose
from wrf_mi.estimators.uplink.uplink_waves import relative_error
from wrf_mi.models import Problem
from wrf_mi.tasks.conditions import normalised_uplink
from wrf_mi.training.session import FitSession

ROWS, ANTENNAS, UP, DOWN = 40, 3, 6, 5
EXACT = 1e-5  # coefficients are stored in single precision; the least penalty is 1e-10 of the uplink's energy
ROUNDING = 1e-9  # of float64, squared by the normal equations


def complex_normal(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rng.standard_normal((*shape, 2)) @ np.array([1, 1j]) / np.sqrt(2)


def record_of(uplink: np.ndarray, downlink: np.ndarray) -> Record:
    receiver = Receiver("base-station", np.full(3, np.nan), np.array([0.0, 0.0, 0.0, 1.0]))
    uplink, downlink = uplink.astype(np.complex64), downlink[None].astype(np.complex64)
    return Record("made", "csi", np.full((len(uplink), 3), np.nan), (receiver,), downlink, uplink=uplink)


def linear_record(noise: float = 0.0) -> tuple[Record, np.ndarray]:
    """A downlink that is a linear map of the uplink, rows of very different size, and the map [UP, DOWN]."""
    rng = np.random.default_rng(0)
    matrix = complex_normal(rng, UP, DOWN)
    uplink = complex_normal(rng, ROWS, ANTENNAS, UP) * 10 ** rng.uniform(-6, -3, (ROWS, 1, 1))
    size = np.sqrt(np.square(np.abs(uplink)).mean(axis=(1, 2), keepdims=True))
    return record_of(uplink, uplink @ matrix + noise * size * complex_normal(rng, ROWS, ANTENNAS, DOWN)), matrix


def split_of(train: int = 24, validation: int = 6) -> Split:
    rows = np.arange(ROWS)
    return Split("made", 0, rows[:train], rows[train : train + validation], rows[train + validation :])


def fit(record: Record, split: Split, **settings: float) -> LinearMap:
    return MODEL.fit(Problem(record, LinearSettings(**settings), 0), split, FitSession())


def test_exact_on_a_noise_free_linear_relation_and_zero_for_zeros() -> None:
    record, matrix = linear_record()
    split = split_of()
    fitted = fit(record, split)
    assert fitted.penalty == PENALTIES[0]
    np.testing.assert_allclose(fitted.matrix, matrix, atol=EXACT)
    found, truth = fitted.predict(inputs_of(record, split.test), 0).mean, record.observation[0, split.test]
    assert found.dtype == np.complex64
    assert relative_error(found, truth).max() < EXACT**2
    record, _ = linear_record()
    uplink = np.ones((2, ANTENNAS, UP), np.complex64)
    uplink[1, 2] = 0
    found = fit(record, split_of()).predict(Inputs(np.full((2, 3), np.nan), uplink=uplink), 0).mean
    assert not found[1, 2].any()
    assert found[1, 1].all()


def test_penalty_is_chosen_on_validation_rows_and_fitted_to_all_training_rows() -> None:
    """Against least squares with rows for the penalty below, antenna by antenna as they are in the docstring."""
    record, _ = linear_record(noise=1.5)
    split = split_of(8, 12)
    shares: list[float] = []
    session = FitSession(on_progress=lambda stage, share, progress: shares.append(share))
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
        found = record.uplink[split.validation] @ solved(split.train, penalty)
        return float(np.median(relative_error(found.reshape(len(truth), -1), truth.reshape(len(truth), -1))))

    assert fitted.penalty == min(PENALTIES, key=error)
    assert PENALTIES[0] < fitted.penalty < PENALTIES[-1], "something is chosen"
    np.testing.assert_allclose(fitted.matrix, solved(split.all_train, fitted.penalty), rtol=ROUNDING, atol=ROUNDING)
    assert fit(record, split, penalty=0.5).penalty == 0.5


def test_errors_are_relative_to_the_energy_of_rows() -> None:
    """Scaled rows do not change the map, and a row without downlink energy, or of NaN, is ignored."""
    record, _ = linear_record(noise=0.3)
    split, size = split_of(), np.float32(10) ** np.arange(ROWS)[:, None, None].clip(0, 5)
    larger = replace(record, observation=record.observation * size, uplink=record.uplink * size)
    expected = fit(record, split).matrix
    np.testing.assert_allclose(fit(larger, split).matrix, expected, rtol=EXACT, atol=EXACT)
    silent = record.observation.copy()
    silent[0, 3] = 0
    fewer = replace(split, train=np.delete(split.train, 3))
    lost = np.where(silent == 0, np.complex64(np.nan), silent)
    np.testing.assert_array_equal(fit(replace(record, observation=lost), split).matrix, fit(record, fewer).matrix)
    muted = fit(replace(record, observation=silent), split, penalty=0.1).matrix
    np.testing.assert_allclose(muted, fit(record, fewer, penalty=0.1).matrix, rtol=ROUNDING, atol=ROUNDING)


def test_without_validation_rows_every_fifth_training_row_chooses() -> None:
    record, _ = linear_record(noise=1.5)
    rows = np.arange(20)
    split = Split("made", 0, rows, rows[:0], np.arange(20, ROWS))
    expected = choose(record, np.setdiff1d(rows, rows[::5]), rows[::5], lambda what, share: None)
    assert fit(record, split).penalty == expected
    two = fit(record, replace(split, train=rows[:2]))
    assert np.isfinite(two.matrix).all()


def test_penalties_out_of_range_and_rows_without_energy_are_refused() -> None:
    record, _ = linear_record()
    for penalty in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="choose more than 0"):
            LinearSettings(penalty=penalty)
    with pytest.raises(InputError, match="made: no training row's downlink has any energy"):
        fit(replace(record, observation=np.zeros_like(record.observation)), split_of())
