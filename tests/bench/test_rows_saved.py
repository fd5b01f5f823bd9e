"""Benchmark of training rows saved: rows that a curve needs, one cell measured, table and picture."""

import pytest
from wrf_mi_bench import rows_saved
from wrf_mi_bench.rows_saved import CURVES, IDW, JOINT, ROWS, measure, picture, rows_needed, saved
from wrf_mi_bench.stages import LAB, Cell


@pytest.mark.parametrize(
    ("score", "goal", "rows"), [((1, 2, 3), 2.5, 20 * 2**0.5), ((1, 2, 3), 0.5, 10), ((1, 2, 3), 4, None)]
)
def test_rows_needed_are_where_the_curve_reaches_the_score(score, goal, rows):
    """And the same of a score that is the better the lower."""
    assert rows_needed((10, 20, 40), score, goal, True) == (None if rows is None else pytest.approx(rows))
    lower = [-s for s in score]
    assert rows_needed((10, 20, 40), lower, -goal, False) == (None if rows is None else pytest.approx(rows))


@pytest.mark.slow
def test_a_cell_is_measured_with_all_starts_and_the_paths_alone(tmp_path):
    found = measure(Cell(LAB, "official", 5), 0, tmp_path / "cell", steps=2)
    assert {*CURVES, IDW, "task"} == set(found)
    assert len({found[name] for name in CURVES}) == len(CURVES)
    assert not (tmp_path / "cell").exists()


def test_table_states_the_share_of_the_rows_and_the_picture_has_a_panel_a_data_set():
    found = [
        {"dataset": name, "rows": n, "seed": 0, "task": "spectrum", IDW: 0.1, **dict.fromkeys(CURVES, k), JOINT: k + 1}
        for name, rows in ROWS.items()
        for k, n in enumerate(rows)
    ]
    lines = saved(found)
    assert "joint needs 80 (50%)" in next(one for one in lines if one["what"] == f"{LAB}, 160 rows")["value"]
    assert len(picture(found).axes) == len(ROWS)
    assert len(lines) == sum(map(len, rows_saved.ROWS.values()))
