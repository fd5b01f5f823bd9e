"""Probabilities of coverage and their reliability."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.stats import norm

from wrf_mi.core import InputError
from wrf_mi.maps.coverage import coverage_probability, reliability, reliability_figure, run_reliability
from wrf_mi.runs.api import train

EXACT = 1e-12
CHANCE = 0.01
"""Of an observed share in 20,000 draws: three standard errors."""


def test_coverage_is_the_normal_distribution_beyond_the_threshold() -> None:
    mean, std = np.linspace(-100, -80, 7), np.linspace(1, 8, 7)
    np.testing.assert_allclose(coverage_probability(mean, std, -90), norm.sf(-90, mean, std), rtol=EXACT)
    assert coverage_probability(-89.0, 0.0, -90.0) == 1
    assert np.isnan(coverage_probability(np.nan, 1.0, -90.0))


def test_levels_drawn_as_predicted_are_reliable_and_narrower_statements_are_not() -> None:
    rng = np.random.default_rng(1)
    mean, std = rng.uniform(-95, -60, 20_000), rng.uniform(2, 9, 20_000)
    measured = rng.normal(mean, std)
    measured[::7] = np.nan
    found = reliability(mean, std, measured)
    assert found.error < CHANCE
    np.testing.assert_allclose(found.observed, found.predicted, atol=3 * CHANCE)
    assert found.count.sum() == 9 * np.isfinite(measured).sum()
    narrow = reliability(mean, std / 4, measured)
    assert narrow.error > 5 * CHANCE
    assert narrow.brier > found.brier
    assert len(reliability_figure({"drawn": found}).axes[0].lines) == 2


def test_reliability_of_a_run_is_that_of_its_test_rows(plain_flat_folder: Path, tmp_path: Path) -> None:
    run = train(plain_flat_folder, tmp_path / "run", "kriging", intervals=True)
    found = run_reliability(run.folder, np.array([-55.0]))
    with np.load(run.folder / "predictions.npz") as stored:
        p = norm.sf(-55, stored["prediction"], stored["std"])
        above = stored["truth"] > -55
    assert found.brier == pytest.approx(np.square(p - above).mean(), rel=1e-5)
    assert found.count.sum() == above.size


def test_a_run_without_standard_deviations_is_refused(plain_flat_folder: Path, tmp_path: Path) -> None:
    run = train(plain_flat_folder, tmp_path / "run", "mri")
    with pytest.raises(InputError, match="states no standard deviation; train with --intervals"):
        run_reliability(run.folder)
