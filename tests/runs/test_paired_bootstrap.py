"""The paired bootstrap against a plain loop, against cases that are clear, and its rate of false claims."""

from __future__ import annotations

import numpy as np
import pytest

from wrf_mi.core import InputError
from wrf_mi.runs.paired_bootstrap import agreed, paired_difference

ROUNDING = 1e-12
"""Sums of a few hundred numbers of size one in float64."""


def test_intervals_are_those_of_a_plain_bootstrap():
    """Same draws by repetition of rows and `np.nanmedian`: two receivers, gaps, ties, an odd and an even number."""
    rng = np.random.default_rng(3)
    for rows in (12, 15):
        a, b = rng.normal(size=(2, 2, rows)).round(1)
        a[0, 2], b[1, 5], a[:, 7] = np.nan, np.nan, np.nan
        found = paired_difference(a, b, seed=4, task="spectrum", resamples=150)
        keep = np.arange(rows) != 7
        gap = np.isnan(a) | np.isnan(b)
        a, b = (np.where(gap, np.nan, x)[:, keep] for x in (a, b))
        drawn = np.random.default_rng(4).integers(0, rows - 1, (150, rows - 1))
        median = [np.nanmedian(a[:, i]) - np.nanmedian(b[:, i]) for i in drawn]
        mean = [np.nanmean(a[:, i]) - np.nanmean(b[:, i]) for i in drawn]
        expected = [*np.percentile(median, [2.5, 97.5]), *np.percentile(mean, [2.5, 97.5])]
        actual = [found.median_low, found.median_high, found.mean_low, found.mean_high]
        np.testing.assert_allclose(actual, expected, atol=ROUNDING)
        assert found.median == pytest.approx(np.nanmedian(a) - np.nanmedian(b), abs=ROUNDING)
        assert found.mean == pytest.approx(np.nanmean(a) - np.nanmean(b), abs=ROUNDING)
        assert found.rows == rows - 1


def test_what_is_better_depends_on_the_score():
    """A steady lead of 0.3 over scores that scatter by 1: pairs see it. An accuracy and an error turn it round."""
    b = np.random.default_rng(0).normal(size=200)
    for task, verdict in (("spectrum", "better"), ("csi", "better"), ("rssi", "worse")):
        found = paired_difference(b + 0.3, b, 1, task)
        assert (found.verdict, found.mean_verdict) == (verdict, verdict)
        assert found.mean == pytest.approx(0.3 if verdict == "better" else -0.3)
    turned = paired_difference(b, b + 0.3, 1, "spectrum")
    assert turned.verdict == "worse"
    assert turned.plain()["mean_high"] == pytest.approx(-0.3)
    assert paired_difference(b, b, 1, "rssi").verdict == "tie"


def test_equal_methods_are_rarely_called_different():
    """Two methods of one distribution, 200 pairs of 60 rows: each side of a 95 % interval errs in 2.5 %.

    Five deviations of a binomial with 200 draws and 5 % are 15; percentile intervals of few rows are a little narrow.
    """
    rng = np.random.default_rng(7)
    wrong = 0
    for trial in range(200):
        a, b = rng.normal(size=(2, 60))
        wrong += paired_difference(a, b, trial, "csi", resamples=300).mean_verdict != "tie"
    assert wrong < 10 + 15


def test_all_seeds_must_agree():
    assert agreed(["better"] * 3) == "better"
    assert agreed(["worse", "worse"]) == "worse"
    assert agreed(["better", "tie", "better"]) == "tie"
    assert agreed(["better", "worse"]) == "tie"
    with pytest.raises(InputError, match="no verdicts"):
        agreed([])


def test_bad_scores_are_refused():
    with pytest.raises(InputError, match="differ in shape"):
        paired_difference([1.0, 2], [1.0], 0, "rssi")
    with pytest.raises(InputError, match="no test row"):
        paired_difference([np.nan, 2], [1.0, np.nan], 0, "rssi")
    with pytest.raises(InputError, match="'power': unknown"):
        paired_difference([1.0], [1.0], 0, "power")
    with pytest.raises(InputError, match="5 resamples"):
        paired_difference([1.0], [1.0], 0, "csi", 5)


def test_seed_decides_the_draws():
    a, b = np.random.default_rng(1).normal(size=(2, 50))
    assert paired_difference(a, b, 3, "csi") == paired_difference(a, b, 3, "csi")
    assert paired_difference(a, b, 3, "csi") != paired_difference(a, b, 4, "csi")
