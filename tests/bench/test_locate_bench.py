"""Benchmark of positions: draws of the training rows pooled, and the verdict on them."""

import numpy as np
import pytest
from wrf_mi_bench.locate import CELLS, STRETCH, stretches, summary

ROWS = 10 * STRETCH


def measured(error_m: float, inside: float) -> dict[str, object]:
    """A cell whose errors are those of nearest neighbours less half a metre, in the share ``inside`` of its regions."""
    error = np.full(ROWS, error_m)
    hits = np.arange(ROWS) < inside * ROWS
    return {
        "error_m": error.tolist(),
        "neighbours_error_m": (error + 0.5).tolist(),
        "best_neighbours_error_m": error.tolist(),
        "inside": np.random.default_rng(0).permutation(hits).tolist(),
        "area_m2": [1.0] * ROWS,
        "radius_m": [1.0] * ROWS,
    }


def test_draws_are_pooled_and_judged_together():
    shares = {0: 0.8, 1: 1.0, 2: 0.9}
    found = {cell: measured(1.0 + cell.seed, shares[cell.seed]) for cell in CELLS}
    made = summary(found)
    rows = {row["what"]: row for row in made["rows"]}
    pooled = rows["64 rows, hybrid, knows walls, 3 draws"]
    assert pooled["mean_m"] == pytest.approx(2.0)
    assert pooled["gain_m"] == pytest.approx([0.5] * 3)
    assert pooled["inside"][0] == pytest.approx(0.9)
    assert "all rows, hybrid, knows walls, seed 0" in rows
    assert made["coverage_outside"] == ["all rows, hybrid, knows walls, seed 0"]  # 80 %; of 64 rows 90 % in the mean
    assert made["not_clearly_better"] == []
    assert "failed" in made


def test_stretches_are_means_of_consecutive_rows_over_draws():
    values = np.stack([np.arange(50.0), np.arange(50.0) + 2])
    np.testing.assert_allclose(stretches(values), [np.arange(20).mean() + 1, np.arange(20, 50).mean() + 1])
