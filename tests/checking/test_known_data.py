"""The known data sets on this machine give no suspicion; altered copies of them do."""

import csv
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from changed_folders import DATA, needs

from wrf_mi.apps.checking import check_data
from wrf_mi.core import Record
from wrf_mi.datasets import load
from wrf_mi.datasets.registry import KNOWN, locate

HERE = [dataset.name for dataset in KNOWN if locate(dataset.name)]


@pytest.mark.parametrize("name", HERE)
def test_known_data_have_no_fault_and_give_no_suspicion(name):
    report = check_data(name)
    assert report.lines() == [f"{name}: no fault, no suspicion"]


def known(name: str) -> Record:
    if name not in HERE:
        pytest.skip(f"{name} is not on this machine")
    return loaded(name)


@cache
def loaded(name: str) -> Record:
    return load(name)


def suspected(record: Record) -> dict[str, str]:
    report = check_data(record)
    assert report.ok
    return {suspicion.name: suspicion.text for suspicion in report.suspicions}


@pytest.mark.parametrize("name", ["rfid-lab", "newrf-conference"])
def test_receivers_that_observe_the_same_in_every_row(name):
    record = known(name)
    same = np.repeat(record.observation[:, :1], len(record), axis=1)
    assert "received the same" in suspected(replace(record, observation=same))["constant"]


@pytest.mark.parametrize("name", [dataset.name for dataset in KNOWN])
def test_copies_of_rows(name):
    record = known(name)
    rows = np.arange(len(record))
    rows[[5, 9]] = 3
    inputs = record.inputs(rows)
    observed = replace(record, observation=record.observation[:, rows], truth=None, carriers_hz=inputs.carriers_hz)
    suspicions = suspected(
        replace(observed, tx_pos_m=inputs.tx_pos_m, tx_heading_rad=inputs.tx_heading_rad, uplink=inputs.uplink)
    )
    assert suspicions
    assert set(suspicions) <= {"repeated-rows", "train-test"}


def table_changed(folder, changes):
    """Change columns of both tables of flat-ble, named by their beginning."""
    for name in ("calibration_df.csv", "test_robot_df.csv"):
        with (folder / name).open(newline="") as file:
            header, *rows = csv.reader(file)
        for start, change in changes.items():
            for column in (k for k, title in enumerate(header) if title.startswith(start) and title):
                for row in rows:
                    row[column] = str(change(float(row[column]))) if row[column] else ""
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])


FLAT = {
    "milliwatts": ({"rssi": lambda dbm: 10 ** (dbm / 10)}, "strengths", "powers on a linear scale"),
    "no sign": ({"rssi": lambda dbm: -dbm}, "strengths", "or lack a sign"),
}
"""Changes of numbers by the beginning of their columns, the suspicion, and a part of its text."""


@needs("flat-ble")
@pytest.mark.parametrize("case", FLAT)
def test_altered_strengths(case, tmp_path):
    changes, name, text = FLAT[case]
    folder = Path(shutil.copytree(DATA / "flat-ble", tmp_path / "flat"))
    table_changed(folder, changes)
    report = check_data(folder)
    (suspicion,) = report.suspicions
    assert suspicion.name == name
    assert text in suspicion.text


@needs("flat-ble")
def test_copied_rows_of_tables(tmp_path):
    folder = Path(shutil.copytree(DATA / "flat-ble", tmp_path / "flat"))
    train, test = ((folder / name).read_text().splitlines() for name in ("calibration_df.csv", "test_robot_df.csv"))
    (folder / "calibration_df.csv").write_text("\n".join([*train, train[8], train[20]]))
    (folder / "test_robot_df.csv").write_text("\n".join([*test, train[50]]))
    suspicions = {suspicion.name: suspicion.text for suspicion in check_data(folder).suspicions}
    assert set(suspicions) == {"repeated-rows", "train-test"}
    assert "2 of 4826 rows repeat an earlier row, observation included: rows 4105, 4106;" in suspicions["repeated-rows"]
    assert "1 of 720 test rows are training rows too, observation included: row 4826;" in suspicions["train-test"]
