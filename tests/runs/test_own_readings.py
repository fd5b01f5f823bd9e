"""Predictions, maps and positions for a device whose own readings tell its offset."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
from commands import Command, rows_of
from made_walks import STEPS, walked

from wrf_mi.core import InputError
from wrf_mi.datasets import write_ble_folder
from wrf_mi.runs.api import train
from wrf_mi.runs.run import Run
from wrf_mi.tasks.scores import probability_scores

OFFSET_DB, WEAK_DBM = -9.0, -68.0
OFFSETS = dict(zip("abcdefgh", (3.0, -3.0, 2.0, -2.0, 1.0, -1.0, OFFSET_DB, OFFSET_DB), strict=True))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("own")
    return train(write_ble_folder(folder / "data", walked(OFFSETS)), "hybrid", split="official", out=folder / "run")


def own(run: Run, count: int) -> Run:
    """The run for the phone of the first test walk, by some of its readings."""
    record = run.problem.record
    rows = np.linspace(6 * STEPS, 7 * STEPS - 1, count).astype(int)
    return run.with_readings(record.tx_pos_m[rows], record.observation[:, rows])


def test_offset_is_told_by_more_and_more_readings(run: Run) -> None:
    few, many = own(run, 2).device, own(run, 30).device
    assert run.device.mean_db == 0
    assert run.device.std_db > few.std_db > many.std_db
    assert abs(many.mean_db - OFFSET_DB) < abs(few.mean_db - OFFSET_DB) < abs(OFFSET_DB)
    assert many.mean_db == pytest.approx(OFFSET_DB, abs=2.5)
    assert many.readings == 30 * 8


def test_predictions_are_shifted_and_more_certain(run: Run) -> None:
    record, test = run.problem.record, np.arange(7 * STEPS, 8 * STEPS)
    before, after = run.predict(record.tx_pos_m[test]), own(run, 30).predict(record.tx_pos_m[test])
    error = [np.abs(each.mean - record.observation[:, test]).mean() for each in (before, after)]
    assert error[1] < 0.7 * error[0]
    assert before.std is not None
    assert after.std is not None
    assert (after.std < before.std).all()
    mapped, shifted = (each.map(step_m=5)["power_dbm"].to_numpy() for each in (run, own(run, 30)))
    np.testing.assert_allclose(shifted - mapped, own(run, 30).device.mean_db, atol=1e-3)


def test_command_reads_own_readings(run: Run, tmp_path: Path, command: Command) -> None:
    record, rows = run.problem.record, np.arange(6 * STEPS, 7 * STEPS, 3)
    table = pandas.DataFrame(record.tx_pos_m[rows, :2], columns=["x", "y"])
    for receiver, values in zip(record.receivers, record.observation[:, rows], strict=True):
        table[f"{receiver.name}_dbm"] = values
    table.loc[3, [f"{receiver.name}_dbm" for receiver in record.receivers]] = np.nan  # heard nothing there
    table.to_csv(tmp_path / "own.csv", index=False)
    words = ["predict", run.folder, "--tx", "10,10,1.3", "--out", tmp_path / "p.csv"]
    command.done(words)
    (before,) = rows_of(tmp_path / "p.csv")
    assert "this device: " in command.done([*words, "--own", tmp_path / "own.csv"])
    (after,) = rows_of(tmp_path / "p.csv")
    assert float(after["anchor0_dbm"]) - float(before["anchor0_dbm"]) == pytest.approx(OFFSET_DB, abs=3)
    test = record.official[1] if record.official else rows
    located = {}
    for name, more in {"without": [], "with": ["--own", tmp_path / "own.csv"]}.items():
        out = tmp_path / f"{name}.csv"
        command.done(["locate", run.folder, "--out", out, "--step", "2", *more])
        positions_m = np.array([[float(row["x"]), float(row["y"])] for row in rows_of(out)])
        located[name] = np.linalg.norm(positions_m - record.tx_pos_m[test, :2], axis=1).mean()
    assert located["with"] < located["without"] + 0.5


@pytest.mark.parametrize("loses_weak", [True, False])
def test_reception_is_shifted_where_own_readings_lack_weak_signals(loses_weak: bool, tmp_path: Path) -> None:
    """Phones with worse antennas lose weak signals; those that merely state less receive what others do."""
    record = walked(OFFSETS)
    offset_db = np.repeat(list(OFFSETS.values()), STEPS)
    arriving_dbm = record.observation - (0 if loses_weak else offset_db)
    lossy = replace(record, observation=np.where(arriving_dbm < WEAK_DBM, np.nan, record.observation))
    run = train(lossy, "hybrid", split="official", out=tmp_path / "run")
    rows, test = np.arange(6 * STEPS, 7 * STEPS, 4), np.arange(7 * STEPS, 8 * STEPS)
    test = test[np.isfinite(lossy.observation[:, test]).any(axis=0)]  # others are in no split
    adapted = run.with_readings(lossy.tx_pos_m[rows], lossy.observation[:, rows])
    assert adapted.device.loses_weak == loses_weak
    before, after = (each.predict(lossy.tx_pos_m[test]) for each in (run, adapted))
    assert before.reception is not None
    assert after.reception is not None
    if not loses_weak:
        np.testing.assert_array_equal(after.reception, before.reception)
        return
    assert after.reception.mean() < before.reception.mean()
    received = np.isfinite(lossy.observation[:, test])
    losses = [probability_scores(each.reception.ravel(), received.ravel())["log_loss"] for each in (before, after)]
    assert losses[1] < losses[0]
    # Scores of reception by run, and of held-out rows.
    block = run.metrics["reception"]
    assert set(block["runs"]) == {"g", "h"}
    assert block["runs"]["h"]["received"] == pytest.approx(received.mean())
    assert block["runs"]["h"]["log_loss"] == pytest.approx(losses[0], rel=1e-4)
    assert sum(count for *_, count in block["runs"]["h"]["bins"]) == received.size
    held_out = run.metrics["sensitivity"]["held_out"]
    assert held_out["mixture"]["log_loss"] < held_out["rate"]["log_loss"]


def test_readings_that_tell_nothing_are_refused(run: Run, tmp_path: Path, command: Command) -> None:
    names = [f"{receiver.name}_dbm" for receiver in run.receivers]
    silent = pandas.DataFrame([[1.0, 1.0, *[np.nan] * 8]], columns=["x", "y", *names])
    placeless = pandas.DataFrame([[-60.0] * 8], columns=names)
    for table, text in ((silent, "no receiver of the run received anything"), (placeless, "without positions")):
        table.to_csv(tmp_path / "own.csv", index=False)
        words = ["predict", run.folder, "--tx", "1,1,1", "--out", tmp_path / "p.csv", "--own", tmp_path / "own.csv"]
        command.refused(words, text)
    with pytest.raises(InputError, match=r"give positions \[m, 3\] and strengths \[8, m\]"):
        run.with_readings(np.zeros((2, 3)), np.zeros((3, 2)))


def test_models_without_deviations_cannot_be_calibrated(run: Run, tmp_path: Path) -> None:
    plain = train(run.problem.record, "idw", split="official", out=tmp_path / "run")
    with pytest.raises(InputError, match="states no standard deviations; train it with --intervals"):
        own(plain, 2).predict([[1.0, 1.0, 1.3]])
