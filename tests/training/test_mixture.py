"""Weights by distance, on scores with a known best choice."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.core.angles import FloatArray
from wrf_mi.core.types import IntArray
from wrf_mi.training.by_distance import FORMS, HeldOutScores, Mixture, RowScores, choose_weights

ROWS = 200
RNG = np.random.default_rng(0)
DISTANCE = RNG.uniform(0, 1, ROWS)
FOLD = np.arange(ROWS) % 5
EACH = np.arange(ROWS)


def errors_of(errors: FloatArray) -> RowScores:
    """Minus the absolute weighted error of predictions with errors [k, q]."""

    def score(weights: FloatArray, rows: IntArray) -> FloatArray:
        return -np.abs(np.einsum("qk,kq->q", weights, errors[:, rows]))

    return score


def chosen_of(
    errors: FloatArray, distance_m: FloatArray, fold: IntArray, unit: IntArray, trusted: int | None = None
) -> tuple[str, Mixture]:
    scores = HeldOutScores(errors_of(errors), distance_m, unit, len(errors))
    return choose_weights(scores, fold, lambda share: None, trusted)


def chosen(errors: FloatArray) -> tuple[str, Mixture]:
    return chosen_of(errors, DISTANCE, FOLD, EACH)


def test_prediction_that_is_best_everywhere_has_all_the_weight():
    noise = RNG.normal(size=(3, ROWS))
    _, mixture = chosen(np.stack([noise[0], 0.01 * noise[1], noise[2]]))
    assert mixture(np.array([0.0, 0.5, 9.0])) == pytest.approx(np.tile([0.0, 1.0, 0.0], (3, 1)))


def test_independent_errors_of_equal_size_are_averaged():
    _, mixture = chosen(RNG.normal(size=(2, ROWS)))
    assert mixture(np.array([0.5]))[0] == pytest.approx([0.5, 0.5], abs=0.2)


def test_equal_weights_hedge_where_few_rows_tell_predictions_apart_by_chance():
    """Over many draws of five held-out rows, weights that start equal are better on other rows than the best single."""
    better = []
    for seed in range(40):
        errors = np.random.default_rng(seed).normal(size=(3, 105))
        score, rows = errors_of(errors), np.arange(105)
        _, mixture = chosen_of(errors[:, :5], np.zeros(5), rows[:5], rows[:5])
        single = np.eye(3)[np.argmin(np.abs(errors[:, :5]).mean(axis=1))]
        others = score(mixture(np.zeros(100)), rows[5:]).mean()
        better.append(others - score(np.broadcast_to(single, (100, 3)), rows[5:]).mean())
    assert np.mean(better) > 0.15  # 0.2; the mean of three has 0.34 less error than each


def test_clearly_worse_predictions_have_no_share_in_a_mean():
    """Two predictions of equal errors among five of ten times these: held-out rows tell which to average."""
    errors = np.random.default_rng(4).normal(size=(7, 40)) * np.repeat([1.0, 10.0], [2, 5])[:, None]
    every = np.arange(40)
    weights = HeldOutScores(errors_of(errors), np.zeros(40), every, 7).averaged(every).weights[0]
    assert weights[2:].max() == 0
    assert weights[:2] == pytest.approx([0.5, 0.5], abs=0.25)


def test_a_trusted_prediction_is_left_where_rows_show_a_gain():
    """A common error hides in five rows that the trusted prediction is the best; two hundred show which is."""
    common, own = np.random.default_rng(1).normal(size=(2, 3, ROWS))
    errors = 3 * common[:1] + own * np.array([[0.1], [1.0], [1.0]])
    five = np.arange(5)
    few = [chosen_of(errors[:, k : k + 5], np.zeros(5), five, five, 0) for k in range(100)]
    assert sum(form == "single" for form, _ in few) > 50
    assert all(mixture(np.zeros(1))[0, 0] == 1 for form, mixture in few if form == "single")
    form, mixture = chosen_of(errors, DISTANCE, FOLD, EACH, 1)
    assert form != "single"
    assert mixture(np.array([0.5]))[0, 1] < 0.2


def test_copies_of_a_row_are_no_evidence():
    """Six receivers of each of five rows share its error: thirty observations are as good as five."""
    errors = np.random.default_rng(8).normal(size=(2, 5)) + np.array([[0.0], [0.3]])
    copied, rows = np.repeat(errors, 6, axis=1), np.repeat(np.arange(5), 6)
    once = chosen_of(errors, np.zeros(5), np.arange(5), np.arange(5), 1)
    again = chosen_of(copied, np.zeros(30), rows, rows, 1)
    assert once[0] == again[0] == "single"
    assert chosen_of(copied, np.zeros(30), rows, np.arange(30), 1)[0] != "single"


def test_weights_follow_the_distance():
    noise = RNG.normal(size=(2, ROWS))
    near, far = noise[0] * 5 * DISTANCE**2, noise[1]
    form, mixture = chosen(np.stack([near, far]))
    assert form == "by distance"
    assert mixture(np.array([0.0]))[0, 0] > 0.9
    assert mixture(np.array([1.0, np.inf]))[:, 1] == pytest.approx([1.0, 1.0], abs=0.3)
    assert mixture(DISTANCE).sum(axis=1) == pytest.approx(np.ones(ROWS))


def test_more_freedom_without_evidence_is_refused():
    rows = np.arange(4)
    errors = np.array([[1.0, 1.0, 1.0, 1.0], [0.9, 1.3, 0.9, 1.3]])
    form, mixture = chosen_of(errors, np.arange(4.0), rows, rows)
    assert form == "averaged"
    assert mixture(np.zeros(1))[0] == pytest.approx([1.0, 0.0], abs=0.1)


@pytest.mark.parametrize("form", FORMS)
def test_no_form_is_below_the_best_single_prediction_on_its_rows(form: str):
    errors = np.random.default_rng(3).normal(size=(4, ROWS)) * np.array([[1.0], [2.0], [1.5], [0.8]])
    score, every = errors_of(errors), np.arange(ROWS)
    mixture = FORMS[form](HeldOutScores(score, DISTANCE, every, 4), every)
    best = max(score(np.broadcast_to(one, (ROWS, 4)), every).mean() for one in np.eye(4))
    assert score(mixture(DISTANCE), every).mean() >= best - 1e-3
