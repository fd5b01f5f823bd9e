"""Planned measurements: farthest positions, walls, files and refusals."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist
from wrf_mi_bench.planning import PLAN, RULES, SIZES, row_of, table

import wrf_mi
from wrf_mi import InputError, train
from wrf_mi.apps.commands.main import main
from wrf_mi.apps.maps.grid import STANDING_M
from wrf_mi.apps.maps.plan import farthest_points, plan
from wrf_mi.apps.maps.plan_picture import plan_figure
from wrf_mi.runs.folder import load_rows

EXACT = 1e-9  # relative, of distances in double precision


def test_each_choice_is_the_farthest_from_measured_and_chosen_positions() -> None:
    rng = np.random.default_rng(0)
    positions_m, measured_m = rng.uniform(0, 6, (40, 3)), rng.uniform(0, 3, (5, 3))
    chosen, distance_m = farthest_points(positions_m, 6, measured_m)
    for count in range(6):
        nearest_m = cdist(positions_m, np.concatenate([measured_m, positions_m[chosen[:count]]])).min(axis=1)
        assert chosen[count] == np.argmax(nearest_m)
        np.testing.assert_allclose(distance_m[count], nearest_m.max(), rtol=EXACT)


def test_measured_positions_are_chosen_once_and_last() -> None:
    positions_m = np.arange(4.0)[:, None] * [1.0, 0, 0]
    chosen, distance_m = farthest_points(positions_m, 4, positions_m[[0, 2]])
    assert sorted(chosen[:2].tolist()) == [1, 3]
    assert sorted(chosen.tolist()) == [0, 1, 2, 3]
    assert distance_m.tolist() == [1, 1, 0, 0, 0]


def test_benchmark_states_gains_and_planned_rows_that_equal_random_ones() -> None:
    falling = np.linspace(4, 3, len(SIZES))
    errors = {rule: [(falling - 0.4 * (rule == PLAN)).tolist()] * 3 for rule in RULES}
    row = row_of("room", {"errors": errors, "higher_is_better": False})
    assert row["equal"] == 40
    assert row["gain"] == pytest.approx([0.4] * 3)
    assert table([row]).splitlines()[2].endswith("| 0.400 (0.400 to 0.400) | 40 |")


@pytest.fixture(scope="module")
def run(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> wrf_mi.Run:
    """Strengths of which one corner of the flat is not measured."""
    record = wrf_mi.load(flat_folder)
    far = record.tx_pos_m[:, 0] > 3.0
    split = wrf_mi.make_splits(record, "official")[0]
    split = replace(split, train=split.train[~far[split.train]], validation=split.validation[:0])
    return train(record, "kriging", out=tmp_path_factory.mktemp("runs") / "kriging", split=split)


def test_plan_goes_where_nothing_was_measured(run: wrf_mi.Run) -> None:
    planned = plan(run, 4)
    record = run.problem.record
    measured_m = record.tx_pos_m[load_rows(run.folder, record).all_train]
    assert cdist(planned.tx_pos_m[:1], measured_m).min() == pytest.approx(planned.distance_m[0])
    assert (planned.tx_pos_m[:, 0] > 3.0).any()
    # Without a scene the map has no margin around the data.
    assert (planned.tx_pos_m >= record.tx_pos_m.min(axis=0) - EXACT).all()
    assert (planned.tx_pos_m <= record.tx_pos_m.max(axis=0) + EXACT).all()
    assert (np.diff(planned.distance_m) <= 0).all()
    assert planned.distance_m[-1] < planned.distance_m[0]
    assert plan(run, 4, area_m=(np.zeros(2), np.full(2, 2.5))).tx_pos_m[:, :2].max() <= 2.5


def test_positions_are_half_a_metre_from_walls_of_the_scene(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    in_scene = train(flat_folder, "hybrid", out=tmp_path / "hybrid", scene=room, n_train=12)
    planned = plan(in_scene, 3)
    box = in_scene.problem.opened_scene.mi_scene.bbox()
    low, high = (np.array(corner, float).ravel()[:2] for corner in (box.min, box.max))
    assert (planned.candidates_m[:, :2] > low + STANDING_M).all()
    assert (planned.candidates_m[:, :2] < high - STANDING_M).all()
    assert plan_figure(planned, in_scene).axes


def test_command_writes_positions_and_a_picture(run, tmp_path, capsys):
    (tmp_path / "able.csv").write_text("x,y,z\n1,1,1.3\n4,3,1.3\n8,3,1.3\n")
    out = tmp_path / "plan.csv"
    call = ["plan", str(run.folder), "--candidates", str(tmp_path / "able.csv"), "--out", str(out)]
    assert main([*call, "--count", "2"]) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["order"] for row in rows] == ["1", "2"]
    assert float(rows[0]["x"]) == 8
    assert out.with_suffix(".png").stat().st_size > 5000
    text = capsys.readouterr().out
    assert " from the nearest measured position: " in text
    assert " after 2 more measurements" in text
    assert "    1   8.00" in text
    assert float(rows[0]["distance_m"]) >= float(rows[1]["distance_m"]) > 0
    refusals = {
        "count 9": [*call, "--count", "9"],
        "give such a name": [*call[:-1], str(tmp_path / "plan.txt")],
        "area [3.0": [*call[:2], *call[4:], "--area", "3", "1", "2", "4"],
        "candidates: area, step": [*call, "--step", "0.5"],
    }
    for message, arguments in refusals.items():
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(InputError, match="candidates: give finite"):
        plan(run, 1, candidates_m=np.array([[1.0, np.nan, 1]]))
