"""Receivers with fewer training rows than `min_rows` are left out: runs are as if they had not been in the data."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import stored, strength_commands
from commands import Command
from made_building import FITS, PLACES_M, TRAINED, WITH_INTERVALS, building, fitted, silent_in

from wrf_mi.core import InputError, Split
from wrf_mi.datasets import load, write_ble_folder
from wrf_mi.datasets.observations import fitted_receivers
from wrf_mi.runs.api import open_run, train
from wrf_mi.scene.make import make_scene

NAMES = list(PLACES_M)
ROUNDING_DB = 1e-3
"""Difference of two equal fits of few steps: threads add gradients in any order, in single precision."""
NONE = np.zeros(0, np.int64)


def test_receivers_with_fewer_than_two_training_rows_are_found() -> None:
    record = building(attic=(3, 45), cellar=())
    split = Split("mine", 0, np.arange(TRAINED - 4), np.arange(TRAINED - 4, TRAINED), np.arange(TRAINED, len(record)))
    numbers, left_out = fitted_receivers(record, [split])
    assert (numbers.tolist(), left_out) == ([0, 1, 2], {"attic": 1, "cellar": 0})
    numbers, left_out = fitted_receivers(building(attic=(3, 39)), [split])
    assert (numbers.tolist(), left_out) == ([0, 1, 2, 3], {})


def test_rows_count_at_the_carrier_that_has_most() -> None:
    """Some models are fitted to each carrier alone."""
    record = building(attic=(2, 3), cellar=(2, 4))
    record = replace(record, frequencies_hz=None, carriers_hz=np.where(np.arange(len(record)) % 2, 9e8, 2.4e9))
    assert record.official is not None
    split = Split("mine", 0, record.official[0], NONE, record.official[1])
    assert fitted_receivers(record, [split])[1] == {"attic": 1}


def test_where_no_receiver_has_two_rows_one_is_enough() -> None:
    """IDW copies it."""
    record = building(attic=())
    split = Split("mine", 0, np.array([4]), NONE, np.array([5]))
    numbers, left_out = fitted_receivers(record, [split])
    assert (numbers.tolist(), left_out) == ([0, 1, 2], {"attic": 0})
    with pytest.raises(InputError, match=r"building: nothing was received in the training rows by any receiver \(hall"):
        fitted_receivers(silent_in(record, [4], *NAMES), [split])


@pytest.mark.parametrize("model", FITS)
def test_a_run_is_as_without_the_receivers(model: str, tmp_path: Path) -> None:
    options: dict[str, Any] = {"settings": FITS[model], "intervals": model in WITH_INTERVALS, "min_rows": 2}
    with_them = train(building(attic=(3, 45, 46), cellar=()), model, out=tmp_path / "run", **options)
    without = fitted(model)
    assert with_them.metrics["receivers_left_out"] == {"attic": 1, "cellar": 0}
    assert with_them.metrics.keys() - {"receivers_left_out"} == without.metrics.keys()
    assert list(with_them.metrics["receivers"]) == NAMES
    arrays = stored(without.folder)
    assert stored(with_them.folder).keys() == arrays.keys()
    for name in arrays.keys() - {"receiver_name"}:
        np.testing.assert_allclose(stored(with_them.folder)[name], arrays[name], rtol=0, atol=ROUNDING_DB)
    again = open_run(with_them.folder, building(attic=(3, 45, 46), cellar=()))
    assert [receiver.name for receiver in again.receivers] == NAMES
    predicted, expected = (run.predict([[1, 2, 1.3]], "lab").mean for run in (again, without))
    np.testing.assert_allclose(predicted, expected, rtol=0, atol=ROUNDING_DB)


@pytest.mark.parametrize("split", ["blocked", "random", "receiver", "receiver+2", "trajectory"])
def test_every_split_leaves_them_out(split: str, tmp_path: Path) -> None:
    record = building(attic=(3,), cellar=(44,))
    run = train(record, "mri", out=tmp_path / "run", split=split, min_rows=2)
    expected = train(building(), "mri", out=tmp_path / "clean", split=split)
    assert set(run.metrics["receivers_left_out"]) == {"attic", "cellar"}
    assert run.metrics["abs_error_db"] == expected.metrics["abs_error_db"]
    assert list(run.metrics["receivers"]) == NAMES


def test_rows_that_only_they_received_are_in_no_split(tmp_path: Path) -> None:
    record = silent_in(building(attic=(3,), cellar=(44,)), [3, 44], *NAMES)
    metrics = train(record, "idw", out=tmp_path / "run", min_rows=2).metrics
    assert (metrics["n_train"], metrics["n_test"]) == (39, 11)


def test_held_out_receivers_of_a_given_split_keep_their_place(tmp_path: Path) -> None:
    record, left = building(attic=(3,)).at_receivers([3, 0, 1, 2]), np.array([[2, 0], [2, 9]])
    split = Split("mine", 0, np.arange(40), NONE, np.arange(40, 52), held_receivers=(2,), left=left)
    run = train(record, "mri", out=tmp_path / "run", split=split, min_rows=2)
    assert list(run.metrics["receivers_left_out"]) == ["attic"]
    assert run.metrics["receivers"]["stairs"]["n_test"] == 12
    assert run.metrics["receivers"]["hall"]["n_test"] == 0


@pytest.mark.parametrize("model", ["kriging", "mri", "trees"])
def test_two_and_three_training_rows_are_enough_also_for_intervals(model: str, tmp_path: Path) -> None:
    """Parts of the training rows that are held out leave the receivers one row or none, and them out."""
    record = building(attic=(3, 7, 45), cellar=(5, 6, 9))
    run = train(record, model, out=tmp_path / "run", intervals=True, settings=FITS[model])
    assert "receivers_left_out" not in run.metrics
    assert run.metrics["receivers"]["attic"]["n_test"] == 1
    assert np.isfinite(run.predict([[1, 2, 1.3]], "cellar").stated_std).all()


def test_a_receiver_whose_rows_are_at_one_distance_takes_the_exponent_of_all(tmp_path: Path) -> None:
    record = building(attic=(3, 4, 5, 6, 7))
    record.tx_pos_m[4:8] = record.tx_pos_m[3]
    run = train(record, "mri", out=tmp_path / "run")
    level_dbm = run.predict(record.tx_pos_m[[3]], "attic").mean
    assert level_dbm == pytest.approx(record.observation[3, 3:8].mean(), abs=1e-4)  # single precision


def test_kriging_of_a_trend_through_every_row_is_the_trend(tmp_path: Path) -> None:
    """Residuals of two rows from a level and a slope are zero, which leaves nothing to interpolate."""
    record = building()
    split = Split("two", 0, np.array([3, 4]), NONE, np.arange(40, 52))
    run = train(record, "kriging", out=tmp_path / "run", split=split, settings=("generic=true",))
    observed = record.observation[0, 3:5]
    np.testing.assert_allclose(run.predict(record.tx_pos_m[3:5], "hall").mean, observed, atol=1e-3)  # float32


def test_a_receiver_with_few_rows_at_one_carrier_is_interpolated_between_its_other_carriers(tmp_path: Path) -> None:
    record = building(attic=(*range(1, 52, 2), 4))
    record = replace(record, frequencies_hz=None, carriers_hz=np.where(np.arange(len(record)) % 2, 9e8, 2.4e9))
    run = train(record, "kriging", out=tmp_path / "run", settings=("generic=true",))
    assert "receivers_left_out" not in run.metrics
    hz = (9e8, 2.4e9)
    low, high = (open_run(run.folder, record).predict([[1, 2, 1.3]], "attic", carriers_hz=[f]).mean for f in hz)
    np.testing.assert_array_equal(low, high)
    low, high = (run.predict([[1, 2, 1.3]], "hall", carriers_hz=[f]).mean for f in hz)
    assert not np.array_equal(low, high)


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Path:
    record = building(attic=(3, 45, 46), cellar=())
    return write_ble_folder(tmp_path_factory.mktemp("data") / "office", record)


@pytest.mark.usefixtures("undrawn")
def test_commands_take_a_run_without_them(office: Path, tmp_path: Path, command: Command) -> None:
    run = tmp_path / "run"
    metrics = command.json(["train", office, "--model", "kriging", "--min-rows", "2", "--out", run])
    assert metrics["receivers_left_out"] == {"attic": 1, "cellar": 0}
    heard = {"hall": "-60", "stairs": "-70", "lab": "-65", "attic": "-80", "cellar": ""}
    for words in [["evaluate", run, "--split", "random"], *strength_commands(run, tmp_path, heard)]:
        command.done(words)
    columns = (tmp_path / "powers.csv").read_text().splitlines()[0].split(",")
    assert [column for column in columns if column.endswith("_dbm")] == [f"{name}_dbm" for name in NAMES]


def test_a_receiver_without_any_row_is_read(office: Path) -> None:
    record = load(office)
    assert [receiver.name for receiver in record.receivers][-1] == "cellar"
    assert np.isnan(record.observation[-1]).all()


@pytest.mark.parametrize("model", ["ray-tracing", "hybrid"])
def test_paths_that_folds_share_serve_other_receivers(model: str, tmp_path: Path) -> None:
    """Folds of the training rows leave out the cellar, whose paths the other folds and the run need."""
    plan = tmp_path / "plan.csv"
    plan.write_text("x,y\n-1,-1\n13,-1\n13,9\n-1,9\n-1,-1\n")
    room = make_scene(plan, tmp_path / "room", height_m=2.7).folder
    record = building(cellar=(1, 2, 50))
    settings = ["stages=mean"] if model == "hybrid" else ["depth=1", "reflection=false"]
    run = train(record, model, out=tmp_path / "run", scene=room, settings=settings, intervals=model == "ray-tracing")
    assert "receivers_left_out" not in run.metrics
    assert run.metrics["receivers"]["cellar"]["n_test"] == 1
    assert np.isfinite(run.predict([[1, 2, 1.3]], "cellar").stated_std).all()
