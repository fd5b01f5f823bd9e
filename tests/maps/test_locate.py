"""Positions of transmitters from signal strengths."""

import errno
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, arrays_in, rows_of
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import softmax
from scipy.stats import norm
from scipy.stats import t as student_t
from sklearn.neighbors import KNeighborsRegressor

from wrf_mi.apps.maps import locate_calibration
from wrf_mi.apps.maps.grid import Candidates, candidates_of, grid_over
from wrf_mi.apps.maps.locate import locate
from wrf_mi.apps.maps.locate_calibration import FILE, Located, choose, folds_of, widest
from wrf_mi.apps.maps.locate_file import read_observations
from wrf_mi.apps.maps.locate_likelihood import DEGREES, Likelihood, densest, mass_of, ranks_of, region_of
from wrf_mi.apps.maps.locate_neighbours import Neighbours
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.datasets import write_ble_folder
from wrf_mi.runs.api import train

ROUNDING = 1e-9
SINGLE = 1e-4
"""Rounding of logarithms of densities whose means and standard deviations are stored in single precision."""
CORNERS_M = np.array([[0.0, 0, 2], [6, 0, 2], [0, 6, 2]])
UPRIGHT = np.array([0.0, 0, 0, 1])
QUADRATURE = 2e-3
"""Error of seven nodes for the offset of three residuals of heavy tails."""
STEP_M = 0.25
DRAWS = 400
COVERED = 0.06
"""Four standard errors of the coverage of `DRAWS` regions of 90 %."""


def strengths(positions_m: np.ndarray) -> np.ndarray:
    """Signal strengths [n_rx, n] by the path-loss law -40 dBm - 20 log10(d)."""
    return -40 - 20 * np.log10(np.linalg.norm(positions_m - CORNERS_M[:, None], axis=2))


def room() -> Candidates:
    """Positions of a room of 6 m x 6 m."""
    grid = grid_over(np.zeros(2), np.full(2, 6.0), STEP_M, 1.0)
    return Candidates(grid, np.ones(len(grid.positions_m), bool))


def law(candidates: Candidates, std_db: float) -> np.ndarray:
    mean = strengths(candidates.positions_m)[None].astype(np.float32)
    return np.stack([mean, np.full_like(mean, std_db)])


def record_of(tx_pos_m: np.ndarray, rssi_dbm: np.ndarray, train_rows: int) -> Record:
    receivers = tuple(Receiver(f"anchor{number}", place, UPRIGHT) for number, place in enumerate(CORNERS_M))
    rows = np.arange(len(tx_pos_m))
    record_fields: dict[str, Any] = {
        "frequencies_hz": np.array([2.44e9]),
        "official": (rows[:train_rows], rows[train_rows:]),
    }
    return Record("made-up", "rssi", tx_pos_m, receivers, rssi_dbm.astype(np.float32), **record_fields)


@given(st.integers(0, 23), st.integers(0, 23))
@settings(max_examples=20, deadline=None)
def test_three_receivers_of_known_path_loss_recover_the_position(column: int, row: int) -> None:
    candidates = room()
    truth = row * len(candidates.grid.x_m) + column
    predicted = law(candidates, 0.1)
    log = Likelihood().log(strengths(candidates.positions_m[truth][None])[:, 0], *predicted)
    best, _, inside = region_of(softmax(log), candidates.distance_m, 0.9)
    assert candidates.distance_m[best, truth] < STEP_M
    assert inside[truth]


@pytest.mark.parametrize("form", [Likelihood(), Likelihood(1.3), Likelihood(offset_db=4.0)])
def test_region_covers_as_stated_under_the_noise_of_the_model(form: Likelihood) -> None:
    candidates, rng, inside, near = room(), np.random.default_rng(2), [], []
    predicted = law(candidates, 4.0)
    for truth in rng.integers(len(candidates.positions_m), size=DRAWS):
        noise = 4 * form.scale * rng.standard_t(DEGREES, 3) + form.offset_db * rng.normal()
        value = predicted[0, 0, :, truth] + noise
        best, radius_m, region = region_of(softmax(form.log(value, *predicted)), candidates.distance_m, 0.9)
        inside.append(region[truth])
        near.append(candidates.distance_m[best, truth] <= radius_m)
    # Cells are whole: regions hold a little more than stated.
    assert abs(np.mean(inside) - 0.9) < COVERED
    assert abs(np.mean(near) - 0.9) < COVERED


def test_likelihood_is_the_density_of_scipy() -> None:
    rng = np.random.default_rng(1)
    mean, std = rng.normal(-60, 5, (2, 3, 7)).astype(np.float32), rng.uniform(2, 5, (2, 3, 7)).astype(np.float32)
    value = np.array([-58.0, np.nan, -64.0])
    scale = 1.2 * std[:, [0, 2]]
    each = student_t(DEGREES).logpdf((value[[0, 2], None] - mean[:, [0, 2]]) / scale) - np.log(scale)
    expected = np.logaddexp.reduce(each.sum(axis=1), axis=0) - np.log(2)
    np.testing.assert_allclose(Likelihood(1.2).log(value, mean, std), expected, atol=SINGLE)


@pytest.mark.parametrize(("offset_db", "value"), [(2.0, (2.0, -1.0, 3.0)), (30.0, (22.0, 19.0, 23.0))])
def test_common_offset_is_integrated(offset_db: float, value: tuple[float, ...]) -> None:
    mean, std = np.zeros((1, 3, 1), np.float32), np.full((1, 3, 1), 4.0, np.float32)
    heavy = Likelihood(offset_db=offset_db).log(np.array(value), mean, std)[0]

    def density(offset: float) -> float:
        residual = (np.array(value) - offset) / 4
        return float(np.prod(student_t(DEGREES).pdf(residual) / 4) * norm(0, offset_db).pdf(offset))

    assert heavy == pytest.approx(np.log(quad(density, -150, 150, points=[0, np.mean(value)])[0]), abs=QUADRATURE)


@given(st.lists(st.floats(0.01, 1), min_size=1, max_size=30), st.floats(0.05, 0.95))
@settings(deadline=None)
def test_densest_candidates_hold_the_level_and_no_fewer_do(weights: list[float], level: float) -> None:
    probability = np.array(weights) / np.sum(weights)
    inside = densest(probability, level)
    assert probability[inside].sum() >= level - ROUNDING
    assert probability[inside].sum() - probability[inside].min() < level + ROUNDING
    assert inside.all() or probability[inside].min() >= probability[~inside].max()


def test_mass_of_regions_covers_where_stated_deviations_are_too_large() -> None:
    """Deviations of twice the noise: regions of 90 % of the probability hold nearly all positions."""
    candidates, rng, form = room(), np.random.default_rng(8), Likelihood()
    predicted, ranks = law(candidates, 4.0), list[tuple[float, float]]()
    for truth in rng.integers(len(candidates.positions_m), size=DRAWS):
        probability = softmax(form.log(predicted[0, 0, :, truth] + rng.normal(0, 2, 3), *predicted))
        best = region_of(probability, candidates.distance_m, 0.9)[0]
        ranks.append(ranks_of(probability, candidates.distance_m, best, int(truth)))
        region = densest(probability, 0.7)
        assert region[truth] == (ranks[-1][0] < 0.7)  # a region holds the truth if it holds more than its rank
    for by_density in np.array(ranks).T:
        calibration_draws, further = by_density[: DRAWS // 2], by_density[DRAWS // 2 :]
        assert np.mean(further < 0.9) > 0.97
        # The ranks of a posterior that is right join them: a little more is held than stated.
        assert abs(np.mean(further <= mass_of(calibration_draws, 0.9)) - 0.92) < COVERED


def test_few_ranks_leave_the_mass_near_the_level() -> None:
    assert mass_of([0.2], 0.9) == pytest.approx(0.9, abs=0.02)
    assert mass_of(np.zeros(10_000), 0.9) == 0.0
    assert mass_of(np.ones(10_000), 0.9) == 1.0
    assert mass_of(np.linspace(0, 1, 99), 0.999) == 1.0


@pytest.mark.parametrize("noise_m", [0.5, 50.0])
def test_density_around_the_neighbours_is_used_where_it_tells_more_than_the_field(noise_m: float) -> None:
    candidates, rng = room(), np.random.default_rng(9)
    predicted, truth = law(candidates, 6.0), rng.integers(len(candidates.positions_m), size=120)
    places = candidates.positions_m[truth]
    record = record_of(places, predicted[0, 0][:, truth] + rng.normal(0, 6, (3, 120)), 119)
    near_m = places + rng.normal(0, noise_m, places.shape)
    parts = [Located(predicted, np.arange(3), np.arange(120), candidates.nearest(places), near_m)]
    chosen = choose(record, parts, candidates, lambda share: None)
    assert (chosen.spread_m is not None) == (noise_m < 1)
    if chosen.spread_m is not None:
        assert chosen.error_m < chosen.neighbours_error_m


def test_stretches_of_a_path_are_held_out_where_they_are_harder_to_locate() -> None:
    """Along the path errors are alike; another visit of the same places has others."""
    rng, angle = np.random.default_rng(10), np.linspace(0, 20 * np.pi, 400)
    places = np.column_stack([3 + 2 * np.cos(angle), 3 + 2 * np.sin(0.93 * angle), np.ones(400)])
    drift = np.repeat(rng.normal(0, 8, (3, 40)), 10, axis=1)
    everything, none = np.arange(400), np.zeros(0, np.int64)
    split = Split("all", 0, everything, none, none)
    folds, _, words = folds_of(record_of(places, strengths(places) + drift, 399), split)
    assert "stretches" in words
    held_out = [fold.test for fold in folds]
    assert len(np.unique(np.concatenate(held_out))) == sum(map(len, held_out))  # each row once
    order = rng.permutation(400)
    shuffled = record_of(places[order], (strengths(places) + drift)[:, order], 399)
    assert "far" in folds_of(shuffled, split)[2]


def test_nearest_neighbours_are_those_of_scikit_learn() -> None:
    rng = np.random.default_rng(4)
    places = rng.uniform(0, 6, (40, 3))
    record = record_of(places, strengths(places), 30)
    asked = strengths(rng.uniform(0, 6, (5, 3)))
    expected = KNeighborsRegressor(4).fit(record.observation[:, :30].T, places[:30]).predict(asked.T)
    for metric in ("euclidean", "nan_euclidean"):
        np.testing.assert_allclose(Neighbours(4, metric).locate(record, np.arange(30), asked), expected)
    asked[1] = np.nan
    alone = record.at_receivers([0, 2])
    expected = Neighbours(4).locate(alone, np.arange(30), asked[[0, 2]])
    np.testing.assert_allclose(Neighbours(4, "nan_euclidean").locate(record, np.arange(30), asked), expected)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record]:
    """Run of kriging on 40 rows, and its data."""
    folder, rng = tmp_path_factory.mktemp("locate"), np.random.default_rng(5)
    places = np.column_stack([rng.uniform(0.3, 5.7, (60, 2)), np.ones(60)])
    record = record_of(places, strengths(places) + rng.normal(0, 1, (3, 60)), 40)
    data = write_ble_folder(folder / "data", record)
    return train(data, "kriging", out=folder / "run").folder, record


def observations(path: Path, record: Record) -> Path:
    rows = np.column_stack([record.observation[:, 40:].T, record.tx_pos_m[40:, :2]])
    np.savetxt(path, rows, "%.6f", ",", header="anchor0_dbm,rssi_1,rssi_anchor2,x,y", comments="")
    return path


def test_command_writes_positions_and_picture(fitted: tuple[Path, Record], tmp_path: Path, command: Command) -> None:
    run, record = fitted
    file, out = observations(tmp_path / "in.csv", record), tmp_path / "out.csv"
    located = ["locate", run, "--step", "0.5", "--out"]
    figures = command.json([*located, out, "--observed", file, "--posterior", tmp_path / "p.npz"])
    assert figures["n"] == 20
    assert figures["error_m"]["median"] < 1.0
    assert 0.5 < figures["held_out"]["inside"] <= 1
    rows = rows_of(out)
    assert len(rows) == 20
    row = {name: float(value) for name, value in rows[0].items()}
    assert np.hypot(row["x"] - row["true_x"], row["y"] - row["true_y"]) == pytest.approx(row["error_m"], abs=2e-4)
    assert (tmp_path / "out.png").read_bytes().startswith(b"\x89PNG")
    stored = arrays_in(tmp_path / "p.npz")
    assert stored["probability"].shape == (20, len(stored["y_m"]), len(stored["x_m"]))
    np.testing.assert_allclose(stored["probability"].sum(axis=(1, 2)), 1, atol=SINGLE)
    # The choice is kept, and the test rows of the run are the default.
    before, again = (run / FILE).stat().st_mtime_ns, [*located, tmp_path / "again.csv"]
    assert command.json(again)["error_m"]["median"] == pytest.approx(figures["error_m"]["median"], abs=1e-6)
    assert (run / FILE).stat().st_mtime_ns == before
    assert "nearest neighbours (m)" in command.done(again)


def test_offset_of_the_power_widens_regions(fitted: tuple[Path, Record]) -> None:
    run, record = fitted
    value = record.observation[:, 40:45]
    narrow, wide = (locate(run, value, offset_db=offset, step_m=0.25) for offset in (0.0, 10.0))
    assert wide.area_m2.mean() > narrow.area_m2.mean()
    moved = locate(run, value + 6, offset_db=10.0, step_m=0.25)
    assert moved.error_m(record.tx_pos_m[40:45]).mean() < 1.5


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("anchor0_dbm,anchor1_dbm\n-50,-60\n", "no strengths of receiver anchor2 among anchor0, anchor1"),
        ("rssi_1,rssi_8,rssi_9\n-6,-7,-8\n", "no strengths of receivers anchor0, anchor2 among 1, 8, 9"),
        ("x,y,BSSID,RSSI\n1,1,8,-50\n1,1,9,-60\n", "no strengths of receivers anchor0, anchor1, anchor2 among 8, 9"),
        ("ap1 rss,ap2 rss,x,y\n-50,-60,1,1\n", "no strengths of receivers anchor0, anchor1, anchor2 among ap1, ap2"),
        ("rssi_0,rssi_1,rssi_2,anchor2_dbm\n-5,-6,-7,-8\n", "two of 0, 1, 2, anchor2 are of one receiver"),
        ("rssi_0,rssi_1,rssi_2\n-5,-6,-7\n,,\n", "row 2: no receiver of the run received anything"),
        ("rssi_0,rssi_1,rssi_2\n-5,loud,-7\n", "row 1: rssi_1 is 'loud'"),
        ("rssi_0,rssi_1,rssi_2\n", "no rows"),
    ],
)
def test_bad_observations_are_refused_in_one_line(fitted, tmp_path, text, words, command):
    file = tmp_path / "in.csv"
    file.write_text(text)
    message = f"{re.escape(str(file))}.*{re.escape(words)}"
    command.refused(["locate", fitted[0], "--observed", file, "--out", tmp_path / "out.csv"], message)
    assert not (tmp_path / "out.csv").exists()


def test_empty_fields_are_receivers_without_a_value(fitted: tuple[Path, Record], tmp_path: Path) -> None:
    file = tmp_path / "in.csv"
    file.write_text("ts,rssi_2,rssi_0,rssi_1\n7,-50,,-60\n")
    strengths_dbm, true_m = read_observations(file, fitted[1].receivers)
    np.testing.assert_array_equal(strengths_dbm, [[np.nan], [-60], [-50]])
    assert true_m is None


def scans(record: Record, rows: range) -> str:
    """A table with a row for each reading, as a scanner writes it, of rows of a record."""
    lines = ["time;X (cm);Y (cm);BSSID;RSSI"]
    for row in rows:
        place = ";".join(f"{100 * value:.6f}" for value in record.tx_pos_m[row, :2])
        lines += [f"{row};{place};{number};{dbm}" for number, dbm in enumerate(record.observation[:, row])]
        lines.append(f"{row};{place};aa:bb:cc:00:00:0{row % 10};-80")
    return "\n".join(lines)


def test_table_of_single_readings_is_read_as_by_the_import(fitted: tuple[Path, Record], tmp_path: Path) -> None:
    _, record = fitted
    (tmp_path / "scans.csv").write_text(scans(record, range(5)))
    strengths_dbm, true_m = read_observations(tmp_path / "scans.csv", record.receivers)
    np.testing.assert_allclose(strengths_dbm, record.observation[:, :5])
    np.testing.assert_allclose(true_m, record.tx_pos_m[:5, :2], atol=SINGLE)


def test_readings_without_positions_are_grouped_by_time(fitted: tuple[Path, Record], tmp_path: Path) -> None:
    receivers = fitted[1].receivers
    (tmp_path / "scans.csv").write_text("time,id,rssi\n7,0,-50\n7,2,-60\n7,0,-52\n8,1,-70\n")
    strengths_dbm, true_m = read_observations(tmp_path / "scans.csv", receivers)
    np.testing.assert_array_equal(strengths_dbm, [[-51, np.nan], [np.nan, -70], [-60, np.nan]])
    assert true_m is None


def test_imported_table_is_located_in_the_frame_of_the_import(tmp_path: Path, command: Command) -> None:
    """Positions of a map projection and networks that were never heard do not keep the file from being read."""
    rng = np.random.default_rng(3)
    positions_m = rng.uniform(0.5, 5.5, (40, 2))
    dbm = strengths(np.column_stack([positions_m, np.full(40, 1.3)])) + rng.normal(0, 1, (3, 40))
    table = np.column_stack([positions_m + np.array([691_000, 5_335_000]), dbm.T])
    lines = [",".join(f"{value:.3f}" for value in row) + "," for row in table]
    file, data = tmp_path / "walk.csv", tmp_path / "data"
    file.write_text("\n".join(["x,y,rssi_1,rssi_2,rssi_3,rssi_4", *lines]))
    command.done(["data", "import", file, "--out", data])
    command.done(["train", data, "--model", "kriging", "--out", tmp_path / "run"])
    figures = command.json(["locate", tmp_path / "run", "--observed", file, "--out", tmp_path / "out.csv"])
    assert figures["n"] == 40
    assert figures["error_m"]["median"] < 2


def test_bad_arguments_are_refused(fitted: tuple[Path, Record], tmp_path: Path, command: Command) -> None:
    run, record = fitted
    value = record.observation[:, :2]
    without_std = train(write_ble_folder(tmp_path / "data", record), "idw", out=tmp_path / "run").folder
    cases: tuple[tuple[Path, Any, dict[str, Any], str], ...] = (
        (run, value[:2], {}, r"give strengths \[3, m\]"),
        (run, np.full((3, 1), np.nan), {}, "no receiver received transmitter 0"),
        (run, value, {"level": 90}, "probability between 0 and 1"),
        (run, value, {"step_m": -1}, "positive number of metres"),
        (run, value, {"offset_db": -1}, "standard deviation of 0 or more"),
        (without_std, value, {}, "train it with --intervals"),
    )
    for folder, strengths_dbm, options, message in cases:
        with pytest.raises(InputError, match=message):
            locate(folder, strengths_dbm, **options)
    command.refused(["locate", run, "--out", tmp_path / "out.txt"], "written as .csv")


def test_fold_that_was_stopped_goes_on_from_its_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where its predictions could not be stored, as on a full disk."""
    places = np.random.default_rng(0).uniform(0.5, 5.5, (60, 3)) * [1, 1, 0] + [0, 0, 1]
    record = record_of(places, strengths(places), 50)
    run = train(record, "kriging", out=tmp_path / "run")
    fit, begun = locate_calibration.fit_fold, list[list[str]]()

    def noting(entry: Any, problem: Any, fold: Any, session: Any) -> Any:
        begun.append([path.name for path in session.folder.iterdir()])
        (session.folder / "checkpoint.npz").touch()
        return fit(entry, problem, fold, session)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(locate_calibration, "fit_fold", noting)
    monkeypatch.setattr(type(run.fitted), "refit", lambda *_: None)  # as of models that are fitted anew to each fold
    with monkeypatch.context() as patched:
        patched.setattr(locate_calibration, "write_arrays", full)
        with pytest.raises(OSError, match="No space left"):
            locate(run, np.full((3, 1), -50.0), step_m=0.5)
    locate(run, np.full((3, 1), -50.0), step_m=0.5)
    # The checkpoint, and predictions by the options that were judged before.
    assert [sorted(names) for names in begun[:2]] == [[], ["checkpoint.npz", "options"]]
    assert not (run.folder / locate_calibration.FOLDER).exists()


def test_widest_scale_within_a_standard_error_is_chosen() -> None:
    scales, noise = (0.7, 1.0, 1.4), np.random.default_rng(6).normal(size=(2, 100))
    alike = [np.zeros(100), -0.01 + 0.5 * noise[0], -1 + 0.5 * noise[1]]
    assert widest(scales, alike) == 1.0
    assert widest(scales, [np.zeros(100), np.full(100, -0.01), np.full(100, -1.0)]) == 0.7


def test_candidates_do_not_depend_on_test_rows(tmp_path: Path) -> None:
    at = np.column_stack([np.random.default_rng(5).uniform(0.5, 5.5, (40, 2)), np.ones(40)])
    moved = np.concatenate([at[:30], np.full((10, 3), [50.0, -50.0, 9.0])])
    first, second = (
        candidates_of(train(record_of(places, strengths(places), 30), "kriging", out=tmp_path / name))
        for name, places in (("first", at), ("second", moved))
    )
    np.testing.assert_array_equal(first.positions_m, second.positions_m)
    assert first.grid.height_m == 1.0
