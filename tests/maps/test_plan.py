"""Planned measurements: reductions against conditioning, greedy choices, scenes, files and refusals."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from wrf_mi_bench.planning import OURS, RULES, SIZES, even_weights, farthest_points, row_of, table

import wrf_mi
from wrf_mi import InputError, train
from wrf_mi.apps.commands.main import main
from wrf_mi.apps.maps.grid import STANDING_M
from wrf_mi.apps.maps.plan import error_priors, greedy, plan
from wrf_mi.apps.maps.plan_losses import SURFACE_DB
from wrf_mi.apps.maps.plan_picture import summary
from wrf_mi.estimators.error_prior import ErrorPrior, with_columns
from wrf_mi.estimators.interpolation.kriging import Kriging, UncertainKriged
from wrf_mi.estimators.interpolation.kriging_equations import KrigingSystem, correlation

EXACT = 1e-9  # of variances in double precision


def prior(rows: int = 6, seed: int = 0) -> ErrorPrior:
    """Exponential shadowing of 2 m with an uncertain mean."""
    rng = np.random.default_rng(seed)

    def field(a_m: np.ndarray, b_m: np.ndarray) -> np.ndarray:
        return 9.0 * correlation(a_m / 2, b_m / 2)

    total = with_columns(field, lambda at: np.ones((len(at), 1)), np.array([5.0]))
    return ErrorPrior(total, rng.uniform(0, 6, (rows, 3)), np.full(rows, 4.0), 4.0)


def test_posterior_is_that_of_simple_kriging() -> None:
    process, at = prior(), np.random.default_rng(1).uniform(0, 6, (5, 3))
    rows = process.covariance(process.measured_m, process.measured_m)
    system = KrigingSystem(rows, process.noise)
    expected = system.variance(34.0, process.covariance(at, process.measured_m))
    np.testing.assert_allclose(process.posterior(at).diagonal(), expected, rtol=1e-6)  # jitter
    without = ErrorPrior(process.covariance, np.zeros((0, 3)), np.zeros(0), 4.0)
    np.testing.assert_array_equal(without.posterior(at), process.covariance(at, at))


def test_greedy_variances_are_those_of_measuring_the_choices() -> None:
    """The same as conditioning on all rows and choices at once."""
    process, at = prior(), np.random.default_rng(2).uniform(0, 6, (20, 3))
    chosen, before, after = greedy([process.posterior(at)], [4.0], np.ones((1, 20)), np.ones(20, bool), 4)
    measured = ErrorPrior(process.covariance, np.concatenate([process.measured_m, at[chosen]]), np.full(10, 4.0), 4.0)
    np.testing.assert_allclose(after[-1][0], measured.posterior(at).diagonal(), rtol=1e-6)
    np.testing.assert_allclose(before[0], process.posterior(at).diagonal())
    assert len(set(chosen)) == 4


def test_first_choice_is_the_best_of_all() -> None:
    process, at = prior(), np.random.default_rng(3).uniform(0, 6, (15, 3))
    weights = np.random.default_rng(4).uniform(0, 1, (1, 15))
    chosen, *_ = greedy([process.posterior(at)], [4.0], weights, np.ones(15, bool), 1)
    left = []
    for place in at:
        rows = np.concatenate([process.measured_m, place[None]])
        left.append(weights[0] @ ErrorPrior(process.covariance, rows, np.full(7, 4.0), 4.0).posterior(at).diagonal())
    assert chosen == [int(np.argmin(left))]


def test_error_of_kriging_is_the_deviation_that_it_states() -> None:
    rng = np.random.default_rng(5)
    rows, at = rng.uniform(0, 5, (40, 3)), rng.uniform(0, 5, (8, 3))
    values = rng.normal(0, 3, 40) + rows[:, 0]
    fit = Kriging(length_m=1.5, noise=0.2).fit(rows, values)
    stated = UncertainKriged.of(fit, values).prediction(at).std
    process = fit.error_prior()
    variance = process.posterior(at).diagonal() + process.new_noise
    np.testing.assert_allclose(np.sqrt(variance), stated, rtol=0.01)  # nothing is known of the mean: 10 deviations


def test_farthest_points_fill_a_line() -> None:
    line = np.linspace(0, 8, 9)[:, None] * [1.0, 0, 0]
    assert farthest_points(line, 3, line[:1]).tolist() == [8, 4, 2]


def test_weights_make_sums_over_rows_sums_over_the_area() -> None:
    place = np.random.default_rng(6).uniform(0, 10, (400, 1)) ** 2 / 10 * [1.0, 0, 0]  # denser towards 0
    weights = even_weights(place)
    assert place[:, 0].mean() < 3.6
    assert 4.3 < np.average(place[:, 0], weights=weights) < 5.7


def test_benchmark_states_gains_and_planned_rows_that_equal_random_ones() -> None:
    falling = np.linspace(4, 3, len(SIZES))
    errors = {rule: [(falling - 0.4 * (rule == OURS)).tolist()] * 3 for rule in RULES}
    row = row_of("room", {"errors": errors, "higher_is_better": False})
    assert row["equal"] == 40
    assert row["gain"]["random"] == pytest.approx([0.4] * 3)
    assert table([row]).splitlines()[2].endswith("| 0.400 (0.400 to 0.400) | 0.400 (0.400 to 0.400) | 40 |")


@pytest.fixture(scope="module")
def run(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> wrf_mi.Run:
    """Strengths of which one corner of the flat is not measured."""
    record = wrf_mi.load(flat_folder)
    far = record.tx_pos_m[:, 0] > 3.0
    split = wrf_mi.make_splits(record, "official")[0]
    split = replace(split, train=split.train[~far[split.train]], validation=split.validation[:0])
    return train(record, "kriging", out=tmp_path_factory.mktemp("runs") / "kriging", split=split)


def test_plan_goes_where_nothing_was_measured(run: wrf_mi.Run, tmp_path: Path) -> None:
    planned = plan(run, 4)
    assert planned.tx_pos_m[0, 0] > 3.5
    assert (planned.tx_pos_m[:, 0] > 3.0).sum() >= 2
    assert (np.diff(planned.expected_error) < 0).all()
    assert (planned.std[1] <= planned.std[0] + EXACT).all()
    near = plan(run, 4, walk_m=0.2, start_m=planned.tx_pos_m[0])
    assert near.walked_m.sum() < np.nansum(planned.walked_m)
    assert near.expected_error[-1] >= planned.expected_error[-1]


def test_losses_of_a_corrected_scene_are_terms_of_the_process(flat_folder: Path, room: Path, tmp_path: Path) -> None:
    scene = Path(shutil.copytree(room, tmp_path / "scene"))
    in_scene = train(flat_folder, "hybrid", out=tmp_path / "hybrid", scene=scene, n_train=12)
    at = np.array([[1.0, 1.0, 1.3], [3.0, 2.0, 1.3]])
    stated = error_priors(in_scene, [0], at)[0].covariance(at, at)
    by_stated = plan(in_scene, 3, criterion="material")
    box = in_scene.problem.opened_scene.mi_scene.bbox()
    low, high = (np.array(corner, float).ravel()[:2] for corner in (box.min, box.max))
    assert (by_stated.candidates_m[:, :2] > low + STANDING_M).all()
    assert (by_stated.candidates_m[:, :2] < high - STANDING_M).all()
    least = max(by_stated.surfaces, key=lambda name: by_stated.surfaces[name][0])
    assert f"least certain loss at a surface, {least}: " in summary(by_stated, in_scene)
    assert by_stated.expected_error[-1] < by_stated.expected_error[0] <= SURFACE_DB
    assert max(before for before, _ in by_stated.surfaces.values()) == by_stated.expected_error[0]
    assert all(after <= before for before, after in by_stated.surfaces.values())
    facts = {"materials": [], "data": {"name": "other", "rows": [], "error_ratio": 1.0}}
    (scene / "correction.json").write_text(json.dumps(facts))
    added = error_priors(in_scene, [0], at)[0].covariance(at, at) - stated
    assert (added.diagonal() > 0).all()
    assert np.linalg.eigvalsh(added).min() > -EXACT
    # The rows of a correction count once, in the deviations that it states.
    assert plan(in_scene, 1, criterion="material").expected_error[0] == SURFACE_DB


def test_command_writes_positions_and_a_picture(
    run: wrf_mi.Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "able.csv").write_text("x,y,z\n1,1,1.3\n4,3,1.3\n4,1,1.3\n")
    out = tmp_path / "plan.csv"
    call = ["plan", str(run.folder), "--candidates", str(tmp_path / "able.csv"), "--out", str(out)]
    assert main([*call, "--count", "2"]) == 0
    with out.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["order"] for row in rows] == ["1", "2"]
    assert float(rows[0]["x"]) == 4
    assert out.with_suffix(".png").stat().st_size > 5000
    text = capsys.readouterr().out
    assert re.search(r"root mean square over the map and receivers: [\d.]+ dB now, [\d.]+ dB after 2 more", text)
    assert "    1   4.00" in text
    assert len(rows[0]["expected_error"]) <= 5
    refusals = {
        "count 9": [*call, "--count", "9"],
        "walk -1": [*call, "--count", "1", "--walk", "-1"],
        "give such a name": [*call[:-1], str(tmp_path / "plan.txt")],
        "area [3.0": [*call, "--count", "1", "--area", "3", "1", "2", "4"],
        "criterion error": [*call, "--count", "1", "--threshold", "-60"],
    }
    for message, arguments in refusals.items():
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(InputError, match="candidates: give finite"):
        plan(run, 1, candidates_m=np.array([[1.0, np.nan, 1]]))


def test_coverage_weighs_positions_about_the_threshold(run: wrf_mi.Run) -> None:
    certain = plan(run, 3, criterion="coverage", threshold_dbm=-200.0)
    about = plan(run, 3, criterion="coverage", threshold_dbm=-55.0)
    assert not np.array_equal(certain.tx_pos_m, about.tx_pos_m)
