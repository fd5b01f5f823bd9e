"""The known data sets on this machine give no suspicion; altered copies of them do."""

from __future__ import annotations

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
from PIL import Image

from wrf_mi.checking import check_data
from wrf_mi.core import Record
from wrf_mi.datasets import load
from wrf_mi.datasets.registry import KNOWN, locate

HERE = [dataset.name for dataset in KNOWN if locate(dataset.name)]


@pytest.mark.parametrize("name", HERE)
def test_known_data_have_no_fault_and_give_no_suspicion(name: str) -> None:
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
def test_positions_in_centimetres_and_millimetres(name: str, factor: int) -> None:
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
ZENITH = "image rows count from the zenith: in 100% of the spectra"


@pytest.mark.parametrize(
    ("name", "change", "suspicion", "text"),
    [
        ("rfid-lab", ROWS, "spectrum-axes", ZENITH),
        ("laboratory", ROWS, "spectrum-axes", ZENITH),
        ("traced-room", ROWS, "spectrum-axes", ZENITH),
        ("laboratory", HALF_TURN, "spectrum-axes", "^image columns count from -180 degrees:"),
        ("traced-room", HALF_TURN, "spectrum-axes", "^image columns count from -180 degrees:"),
        ("laboratory", CLOCKWISE, "spectrum-axes", "^image columns count clockwise:"),
        ("traced-room", CLOCKWISE, "spectrum-axes", "^image columns count clockwise:"),
        ("rfid-lab", images(lambda s: s.swapaxes(2, 3)), "spectrum-axes", "images have 360 rows and 90 columns"),
        ("rfid-lab", INVERSE, "orientation", "all transmitters are behind the array of receiver gateway1"),
        ("laboratory", INVERSE, "orientation", "orientations turn the world's frame to the array's:"),
        ("traced-room", INVERSE, "orientation", "orientations turn the world's frame to the array's:"),
        ("laboratory", orientation(lambda q: np.roll(q, 1)), "orientation", "orientations are in the order w, x, y, z"),
        ("laboratory", transmitters(lambda p: p * [1, -1, 1]), "plan", "transmitters are in another plan than rec"),
        ("traced-room", transmitters(lambda p: p[:, [1, 0, 2]]), "walls", r"^22 lines .* cross walls of "),
        (
            "rfid-lab",
            images(lambda s: np.repeat(s[:, :1], 200, axis=1)),
            "constant",
            "receiver gateway1: received the same",
        ),
        (
            "newrf-office",
            transmitters(lambda p: p * [-1, 1, 1]),
            "walls",
            "0 lines between neighbouring transmitters cr",
        ),
        (
            "newrf-office",
            transmitters(lambda p: p[:, [1, 0, 2]]),
            "walls",
            "30 lines between neighbouring transmitters",
        ),
        ("traced-csi-flat", transmitters(lambda p: p * [1, -1, 1]), "walls", r"^0 lines .* cross walls of "),
        ("newrf-conference", images(np.abs), "channels", "all channel coefficients are real"),
        ("traced-csi-flat", images(np.abs), "channels", "all channel coefficients are real"),
    ],
)
def test_altered_spectra_and_channels(name: str, change: Change, suspicion: str, text: str) -> None:
    record = change(known(name))
    observation = record.observation.astype(known(name).observation.dtype)
    found = suspected(replace(record, observation=observation))
    assert re.search(text, found[suspicion])


@pytest.mark.parametrize("name", [dataset.name for dataset in KNOWN])
def test_copies_of_rows(name: str) -> None:
    record = known(name)
    rows = np.arange(len(record))
    rows[[5, 9]] = 3
    heading = None if record.tx_heading_rad is None else record.tx_heading_rad[rows]
    up = None if record.uplink is None else record.uplink[rows]
    carriers = None if record.carriers_hz is None else record.carriers_hz[rows]
    observed = replace(record, observation=record.observation[:, rows], truth=None, carriers_hz=carriers)
    copied = replace(observed, tx_pos_m=record.tx_pos_m[rows], tx_heading_rad=heading, uplink=up)
    found = suspected(copied)
    assert found
    assert set(found) <= {"repeated-rows", "train-test"}
    if record.task != "rssi":
        assert "rows 6, 10;" in suspected(observed)["repeated-observations"]


def table_changed(folder: Path, changes: dict[str, Callable[[str], object]]) -> None:
    """Change columns of both tables of flat-ble, named by their beginning."""
    for name in ("calibration_df.csv", "test_robot_df.csv"):
        with (folder / name).open(newline="") as file:
            header, *rows = csv.reader(file)
        for start, change in changes.items():
            for column in (k for k, title in enumerate(header) if title.startswith(start) and title):
                for row in rows:
                    row[column] = str(change(row[column])) if row[column] else ""
        with (folder / name).open("w", newline="") as file:
            csv.writer(file).writerows([header, *rows])


FLAT: dict[str, tuple[dict[str, Callable[[str], object]], set[str], str]] = {
    "headings in degrees": (
        {"heading": lambda text: np.degrees(float(text)) % 360},
        {"headings"},
        "they are degrees; multiply them by pi / 180",
    ),
    "headings of a compass": (
        {"heading": lambda text: (90 - np.degrees(float(text))) % 360},
        {"headings"},
        "they are degrees and run clockwise, as of a compass",
    ),
    "milliwatts": (
        {"rssi": lambda text: 10 ** (float(text) / 10)},
        {"strengths"},
        "powers on a linear scale; give dBm",
    ),
    "no sign": ({"rssi": lambda text: -float(text)}, {"strengths"}, "the minus sign is missing"),
    "a mirrored plan": (
        {"x": lambda text: 9.07 - float(text)},
        {"walls", "headings", "plan"},
        "if x is mirrored; use x = 9.07 - x, y = y",
    ),
    "a sign": (
        {"y": lambda text: -float(text)},
        {"walls", "headings", "plan"},
        "distance then explains 29% of the variance of the signal strengths, as stated 4%; use x = x, y = -y",
    ),
    "millimetres": (
        {"x": lambda text: 1000 * float(text), "y": lambda text: 1000 * float(text)},
        {"positions"},
        "positions are in millimetres",
    ),
}


@needs("flat-ble")
@pytest.mark.parametrize("case", FLAT)
def test_altered_strengths(case: str, tmp_path: Path) -> None:
    changes, names, text = FLAT[case]
    folder = Path(shutil.copytree(DATA / "flat-ble", tmp_path / "flat"))
    table_changed(folder, changes)
    report = check_data(folder)
    assert {one.name for one in report.suspicions} == names
    assert any(text in one.text for one in report.suspicions), report.lines()


@needs("flat-ble")
def test_altered_anchors_and_rows(tmp_path: Path) -> None:
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


@needs("rfid-lab")
def test_altered_files_of_spectra(tmp_path: Path) -> None:
    folder = Path(shutil.copytree(DATA / "rfid-lab", tmp_path / "rfid"))
    for image in (folder / "spectrum").iterdir():
        grey = np.asarray(Image.open(image))
        Image.fromarray(np.ascontiguousarray(grey[::-1])).save(image)
    assert [one.name for one in check_data(folder).suspicions] == ["spectrum-axes"]
    positions = (folder / "tx_pos.csv").read_text().splitlines()
    positions[4], positions[100] = "nan,0,0", "1,2"
    (folder / "tx_pos.csv").write_text("\n".join(positions))
    (folder / "spectrum" / "00007.png").write_bytes(b"")
    lines = check_data(folder).lines()
    assert [line.partition(": ")[2].partition(":")[0] for line in lines[:-1]] == [
        "tx_pos.csv, row 100",
        "tx_pos.csv, row 4",
        "spectrum/00007.png, row 7",
    ]


def test_flat_in_another_frame_than_its_plan() -> None:
    """A shift, which no mirror image undoes."""
    record = known("flat-ble")
    shift = np.array([3.0, 0.0, 0.0])
    receivers = tuple(replace(one, position_m=one.position_m + shift) for one in record.receivers)
    found = suspected(replace(record, tx_pos_m=record.tx_pos_m + shift, receivers=receivers))
    assert set(found) == {"walls"}
    assert found["walls"].endswith("; give positions and building in one frame")
