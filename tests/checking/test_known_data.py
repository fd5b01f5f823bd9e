"""The known data sets on this machine give no suspicion; altered copies of them do."""

import csv
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import DATA, needs
from checked_records import with_images, with_orientations

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
    return {one.name: one.text for one in report.suspicions}


def scaled(record: Record, factor: float, tx: bool = True, rx: bool = True) -> Record:
    receivers = tuple(replace(one, position_m=factor * one.position_m) for one in record.receivers)
    positions = factor * record.tx_pos_m if tx else record.tx_pos_m
    return replace(record, tx_pos_m=positions, receivers=receivers if rx else record.receivers)


@pytest.mark.parametrize("name", [dataset.name for dataset in KNOWN])
@pytest.mark.parametrize("factor", [100, 1000])
def test_positions_in_centimetres_and_millimetres(name, factor):
    record = known(name)
    for tx, rx in ((True, True), (True, False), (False, True)):
        found = suspected(scaled(record, factor, tx, rx))
        assert set(found) == {"positions"}
        assert "millimetres" in found["positions"]


Change = Callable[[Any], Any]


def images(change: Change) -> Callable[[Record], Record]:
    return lambda record: with_images(record, change)


def orientation(change: Change) -> Callable[[Record], Record]:
    return lambda record: with_orientations(record, change)


def transmitters(change: Change) -> Callable[[Record], Record]:
    return lambda record: replace(record, tx_pos_m=change(record.tx_pos_m))


ROWS = images(lambda s: s[:, :, ::-1])
HALF_TURN = images(lambda s: np.roll(s, s.shape[-1] // 2, axis=-1))
CLOCKWISE = images(lambda s: np.roll(s[..., ::-1], 1, axis=-1))
INVERSE = orientation(lambda q: q * [-1, -1, -1, 1])
CONSTANT = images(lambda s: np.repeat(s[:, :1], 200, axis=1))
ZENITH = "image rows count from the zenith: in 100% of the spectra"


LABORATORY, TRACED = "laboratory", "traced-room"
COLUMNS, CHANNELS = "^image columns count", "all channel coefficients are real"
FRAME = "orientations turn the world's frame to the array's:"
MIRRORED_X, MIRRORED_Y = (transmitters(lambda p, sign=sign: p * sign) for sign in ([-1, 1, 1], [1, -1, 1]))
SWAPPED = transmitters(lambda p: p[:, [1, 0, 2]])
REAL = images(np.abs)


@pytest.mark.parametrize(
    ("name", "change", "suspicion", "text"),
    [
        *((name, ROWS, "spectrum-axes", ZENITH) for name in ("rfid-lab", LABORATORY, TRACED)),
        *((name, HALF_TURN, "spectrum-axes", f"{COLUMNS} from -180 degrees:") for name in (LABORATORY, TRACED)),
        *((name, CLOCKWISE, "spectrum-axes", f"{COLUMNS} clockwise:") for name in (LABORATORY, TRACED)),
        ("rfid-lab", images(lambda s: s.swapaxes(2, 3)), "spectrum-axes", "images have 360 rows and 90 columns"),
        ("rfid-lab", INVERSE, "orientation", "all transmitters are behind the array of receiver gateway1"),
        *((name, INVERSE, "orientation", FRAME) for name in (LABORATORY, TRACED)),
        (LABORATORY, orientation(lambda q: np.roll(q, 1)), "orientation", "orientations are in the order w, x, y, z"),
        (LABORATORY, MIRRORED_Y, "plan", "transmitters are in another plan than rec"),
        (TRACED, SWAPPED, "walls", r"^22 lines .* cross walls of "),
        ("rfid-lab", CONSTANT, "constant", "receiver gateway1: received the same"),
        ("newrf-office", MIRRORED_X, "walls", "0 lines between neighbouring transmitters cr"),
        ("newrf-office", SWAPPED, "walls", "30 lines between neighbouring transmitters"),
        ("traced-csi-flat", MIRRORED_Y, "walls", r"^0 lines .* cross walls of "),
        *((name, REAL, "channels", CHANNELS) for name in ("newrf-conference", "traced-csi-flat")),
    ],
)
def test_altered_spectra_and_channels(name, change, suspicion, text):
    record = change(known(name))
    observation = record.observation.astype(known(name).observation.dtype)
    assert re.search(text, suspected(replace(record, observation=observation))[suspicion])


@pytest.mark.parametrize("name", [dataset.name for dataset in KNOWN])
def test_copies_of_rows(name):
    record = known(name)
    rows = np.arange(len(record))
    rows[[5, 9]] = 3
    parts = (record.tx_heading_rad, record.uplink, record.carriers_hz)
    heading, up, carriers = (None if values is None else values[rows] for values in parts)
    observed = replace(record, observation=record.observation[:, rows], truth=None, carriers_hz=carriers)
    found = suspected(replace(observed, tx_pos_m=record.tx_pos_m[rows], tx_heading_rad=heading, uplink=up))
    assert found
    assert set(found) <= {"repeated-rows", "train-test"}
    if record.task.name != "rssi":
        assert "rows 6, 10;" in suspected(observed)["repeated-observations"]


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


COMPASS = "they are degrees and run clockwise, as of a compass"
SIGN = "distance then explains 29% of the variance of the signal strengths, as stated 4%; use x = x, y = -y"
PLANS = {"walls", "headings", "plan"}
FLAT = {
    "degrees": (
        {"heading": lambda h: np.degrees(h) % 360},
        {"headings"},
        "they are degrees; multiply them by pi / 180",
    ),
    "compass": ({"heading": lambda h: (90 - np.degrees(h)) % 360}, {"headings"}, COMPASS),
    "milliwatts": ({"rssi": lambda dbm: 10 ** (dbm / 10)}, {"strengths"}, "powers on a linear scale; give dBm"),
    "no sign": ({"rssi": lambda dbm: -dbm}, {"strengths"}, "the minus sign is missing"),
    "a mirrored plan": ({"x": lambda x: 9.07 - x}, PLANS, "if x is mirrored; use x = 9.07 - x, y = y"),
    "a sign": ({"y": lambda y: -y}, PLANS, SIGN),
    "millimetres": (dict.fromkeys("xy", lambda x: 1000 * x), {"positions"}, "positions are in millimetres"),
}
"""Changes of numbers by the beginning of their columns, the suspicions, and the text of one."""


@needs("flat-ble")
@pytest.mark.parametrize("case", FLAT)
def test_altered_strengths(case, tmp_path):
    changes, names, text = FLAT[case]
    folder = Path(shutil.copytree(DATA / "flat-ble", tmp_path / "flat"))
    table_changed(folder, changes)
    report = check_data(folder)
    assert {one.name for one in report.suspicions} == names
    assert any(text in one.text for one in report.suspicions), report.lines()


@needs("flat-ble")
def test_altered_anchors_and_rows(tmp_path):
    folder = Path(shutil.copytree(DATA / "flat-ble", tmp_path / "flat"))
    anchors = (folder / "anchors.csv").read_text().splitlines()
    assert anchors[2].startswith("2,")
    anchors[2] = "2,2.64,5.0,2.62"  # inside the wall between two rooms
    (folder / "anchors.csv").write_text("\n".join(anchors))
    train, test = ((folder / name).read_text().splitlines() for name in ("calibration_df.csv", "test_robot_df.csv"))
    (folder / "calibration_df.csv").write_text("\n".join([*train, train[8], train[20]]))
    (folder / "test_robot_df.csv").write_text("\n".join([*test, train[50]]))
    found = {one.name: one.text for one in check_data(folder).suspicions}
    assert set(found) == {"inside-solids", "repeated-rows", "train-test"}
    assert "1 of 6 receivers lie inside walls or solids of layout.csv: anchor2;" in found["inside-solids"]
    assert "2 of 4826 rows repeat an earlier row, observation included: rows 4105, 4106;" in found["repeated-rows"]
    assert "1 of 720 test rows are training rows too, observation included: row 4826;" in found["train-test"]


def test_flat_in_another_frame_than_its_plan():
    """A shift, which no mirror image undoes."""
    record = known("flat-ble")
    shift = np.array([3.0, 0.0, 0.0])
    receivers = tuple(replace(one, position_m=one.position_m + shift) for one in record.receivers)
    found = suspected(replace(record, tx_pos_m=record.tx_pos_m + shift, receivers=receivers))
    assert set(found) == {"walls"}
    assert found["walls"].endswith("; give positions and building in one frame")
