"""Run time against error from the tables' rows: points, fronts, text and picture."""

from typing import Any

import pytest
from wrf_mi_bench.table_pages import LEAST, Points, front, fronts, pareto_figure, points_of, read_points
from wrf_mi_bench.table_plan import PARTS, Row

from wrf_mi.core import InputError

PART = next(part for part in PARTS if part.dataset == "rfid-lab" and part.split == "official")
POINTS: Points = {
    "slow": {"score": 0.99, "ms_per_sample": 10, "train_seconds": 0},
    "fast": {"score": 0.70, "ms_per_sample": 1, "train_seconds": 9},
    "middle": {"score": 0.90, "ms_per_sample": 3, "train_seconds": 5},
    "beaten": {"score": 0.80, "ms_per_sample": 5, "train_seconds": 7},
}


def test_front_holds_the_pareto_optimal_methods_from_cheap_to_costly():
    assert front(POINTS, "ms_per_sample", True) == ["fast", "middle", "slow"]
    assert front(POINTS, "train_seconds", True) == ["slow"]
    assert front(POINTS, "ms_per_sample", False) == ["fast"]
    # As good in one and better in the other is better.
    even = {name: {"score": score, "ms": ms} for name, score, ms in (("a", 0.2, 1), ("b", 0.1, 1), ("c", 0.1, 2))}
    assert front(even, "ms", False) == ["b"]


def test_points_are_means_of_medians_over_seeds_of_all_training_rows():
    rows = [Row(PART, "vae", 1.0, 0), Row(PART, "vae", 1.0, 1), Row(PART, "vae", 1.0, 2), Row(PART, "kriging", 0.1, 0)]
    stored: dict[str, Any] = {
        row.name: {"score": {"median": 0.1 * k}, "ms_per_sample": 10.0**k, "train_seconds": 2.0 * k}
        for k, row in enumerate(rows)
    }
    assert points_of(PART, stored) == {
        "vae": {"score": pytest.approx(0.1), "ms_per_sample": 10.0, "train_seconds": 2.0}
    }


def test_text_and_picture_show_both_fronts():
    rows = fronts({PART: POINTS})
    assert [row["what"] for row in rows] == ["rfid-lab, SSIM, prediction of a sample", "rfid-lab, SSIM, training"]
    assert rows[0]["value"] == "fast 0.700 in 1 ms, middle 0.900 in 3 ms, slow 0.990 in 10 ms"
    assert rows[1]["value"] == "slow 0.990 in 0 s"
    figure = pareto_figure({PART: POINTS, PARTS[1]: POINTS})
    assert len(figure.axes) == 4
    assert {axes.get_xscale() for axes in figure.axes} == {"log"}
    assert [text.get_text() for text in figure.legends[0].texts] == list(POINTS)
    (step,) = figure.axes[0].lines
    assert (step.get_xdata()[-1], step.get_ydata()[-1]) == (10, 0.99)
    # A method without training lies at the left end.
    assert figure.axes[1].lines[0].get_xdata()[0] == LEAST


def test_missing_rows_are_reported(tmp_path):
    with pytest.raises(InputError, match="no stored rows; call it in a checkout that has them, or run wrf-mi bench"):
        read_points(tmp_path)
