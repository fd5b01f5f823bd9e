"""Scores of weighted means of predictions, against the scores of the means themselves."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.tasks import TASKS
from wrf_mi.tasks.scores import ssim_mixtures

EXACT = 1e-9
"""Moments of windows are differences of float64 sums of 49 values below one."""


def test_window_moments_give_scikit_images_ssim_of_the_mean():
    rng = np.random.default_rng(0)
    predictions, truth = rng.random((3, 5, 12, 20)), rng.random((5, 12, 20))
    weights, rows = rng.dirichlet(np.ones(3), 4), np.array([4, 0, 2, 2])
    means = np.einsum("mk,km...->m...", weights, predictions[:, rows])
    expected = TASKS["spectrum"].score(means, truth[rows])
    assert ssim_mixtures(predictions, truth, stride=1)(weights, rows) == pytest.approx(expected, abs=EXACT)


def test_mixtures_of_channels_are_scored_within_limits():
    task, rng = TASKS["csi"], np.random.default_rng(1)
    truth = rng.normal(size=(4, 8)) + 1j * rng.normal(size=(4, 8))
    predictions = np.stack([truth, -30 * truth])
    scores = task.mixtures(predictions, truth)
    rows = np.arange(4)
    assert scores(np.tile([1.0, 0.0], (4, 1)), rows) == pytest.approx(np.full(4, task.limits[1]))
    assert scores(np.tile([0.0, 1.0], (4, 1)), rows) == pytest.approx(np.full(4, task.limits[0]))
    # Half the truth minus fifteen times itself: the error is 15.5 times the truth.
    assert scores(np.tile([0.5, 0.5], (4, 1)), rows) == pytest.approx(np.full(4, task.limits[0]))
    weights = np.tile([30.5 / 31, 0.5 / 31], (4, 1))
    assert scores(weights, rows) == pytest.approx(np.full(4, -20 * np.log10(0.5)))


def test_mixtures_of_errors_are_the_better_the_smaller():
    task = TASKS["rssi"]
    scores = task.mixtures(np.array([[-60.0], [-70.0]]), np.array([-64.0]))
    found = [scores(np.array([[share, 1 - share]]), np.array([0]))[0] for share in (1.0, 0.5, 0.6)]
    assert found == pytest.approx([-4.0, -1.0, 0.0])
