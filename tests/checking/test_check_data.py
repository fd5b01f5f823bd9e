"""The report of a data set: faults by kind, suspicions by name, and data of every form."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked_records import channels, spectra, strengths
from made_flat import write_flat, write_plain_flat
from spectrum_records import make_record

import wrf_mi
from wrf_mi.apps.checking import SUSPICIONS, DataReport, check_data
from wrf_mi.core import DataFault, InputError, Receiver, Record
from wrf_mi.datasets import write_spectrum_folder

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.fixture
def folder(tmp_path):
    return write_spectrum_folder(tmp_path / "made-up", make_record())


def test_correct_data(folder, tmp_path, one_gateway, two_gateways):
    for dataset in (folder, str(folder), write_flat(tmp_path / "a"), write_plain_flat(tmp_path / "b")):
        report = check_data(dataset)
        assert (report.ok, report.faults, report.suspicions) == (True, (), ())
        assert report.record is not None
        assert report.lines() == [f"{dataset}: no fault, no suspicion"]
    for record in (one_gateway, two_gateways, strengths(), channels(), spectra()):
        report = wrf_mi.check_data(record)
        assert (report.suspicions, report.record) == ((), record)


def test_faults_are_named_by_file_and_row_and_counted(folder):
    lines = (folder / "tx_pos.csv").read_text().splitlines()
    (folder / "tx_pos.csv").write_text("\n".join([lines[0], *(f"here,{line}" for line in lines[1:])]))
    (folder / "train_index.txt").write_text("1\n2\nthree\n")
    for row in (3, 4):
        (folder / "spectrum" / f"{row:05d}.png").unlink()
    report = check_data(folder)
    assert (report.ok, report.record, report.suspicions) == (False, None, ())
    assert len(report.faults) == 12 + 2 + 1
    text = "4 fields, but the header has 3; correct or remove the row"
    image = "missing (10 images for 12 rows of tx_pos.csv); add the image or remove the row"
    assert report.lines() == [
        *(f"fault: tx_pos.csv, row {row}: {text}" for row in range(1, 11)),
        "fault: tx_pos.csv: 2 more of this kind, up to row 12; correct or remove the row",
        *(f"fault: spectrum/{row:05d}.png, row {row}: {image}" for row in (3, 4)),
        "fault: train_index.txt, line 3: 'three' is not a whole number; correct it",
        f"{folder}: 15 faults; correct them, then check again for suspicions",
    ]
    assert [len(report.lines(most=most)) for most in (2, 100)] == [2 + 1 + 2 + 1 + 1, 15 + 1]
    plain = report.as_dict()
    assert (plain["ok"], plain["rows"], len(plain["faults"])) == (False, None, 15)
    assert plain["faults"][1] == {"file": str(folder / "tx_pos.csv"), "place": "row 2", "row": 2, "text": text}


def test_images_of_one_kind_are_counted_together(folder):
    for image in (folder / "spectrum").iterdir():
        image.write_bytes(b"no image")
    *lines, summary = check_data(folder).lines()
    assert len(lines) == 11
    assert lines[0].startswith("fault: spectrum/00001.png, row 1: unreadable (")
    assert lines[10] == "fault: spectrum: 2 more of this kind, up to row 12; replace the image"
    assert "12 faults" in summary


def test_faults_of_parts_and_files_are_named_from_the_folder_of_the_data(tmp_path):
    record = strengths()
    report = check_data(replace(record, std=np.ones(3)))
    assert not report.ok
    assert "give one for each receiver and row" in report.lines()[0]
    assert report.as_dict()["faults"][0]["file"] is None
    faults = (DataFault(tmp_path / "a" / "b.csv", "x; y", row=1), DataFault(tmp_path / "c.png", "x; z"))
    lines = DataReport("set", str(tmp_path), None, faults, ()).lines()
    assert lines[:2] == ["fault: a/b.csv, row 1: x; y", "fault: c.png: x; z"]
    (tmp_path / "a").mkdir()
    lines = DataReport("set", str(tmp_path / "a"), None, faults, ()).lines()
    assert lines[1] == f"fault: {tmp_path}/c.png: x; z"


def test_suspicions_have_names_and_can_be_ignored():
    record = strengths()
    observation = -record.observation
    observation[0] = 50
    wrong = replace(record, observation=observation)
    report = check_data(wrong)
    names = ["strengths", "constant"]
    assert (
        [suspicion.name for suspicion in report.suspicions]
        == [suspicion["name"] for suspicion in report.as_dict()["suspicions"]]
        == names
    )
    assert [line.partition(":")[0] for line in report.lines()] == [*(f"suspicion {name}" for name in names), "walk"]
    assert report.lines()[-1] == "walk: no fault, 2 suspicions"
    assert [suspicion.name for suspicion in check_data(wrong, ignore=["strengths"]).suspicions] == ["constant"]
    with pytest.raises(InputError, match=r"suspicion 'strength': unknown; known are not-heard, few-rows, "):
        check_data(wrong, ignore=["strength"])
    text = (CHECKOUT / "docs" / "data.md").read_text(encoding="utf-8")
    section = text.partition("## Checks")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `([a-z-]+)` \|", section, re.MULTILINE) == list(SUSPICIONS)


def odd_records() -> dict[str, Record]:
    """Records at the edges of what readers give."""
    rng = np.random.default_rng(0)
    walk, room, hall = strengths(), channels(), spectra(48)
    nowhere = Receiver("base-station", np.full(3, np.nan), np.array([0.0, 0.0, 0.0, 1.0]))
    silent = walk.observation.copy()
    silent[0] = np.nan
    silent[:, 3] = np.nan
    zero = room.observation.copy()
    zero[:, :5] = 0
    broken = room.observation.copy()
    broken[:, 2] = np.inf
    one_row = replace(walk, tx_pos_m=walk.tx_pos_m[:1], observation=walk.observation[:, :1], official=None)
    return {
        "one row": replace(one_row, tx_heading_rad=np.zeros(1)),
        "silent": replace(walk, observation=silent),
        "unknown positions": replace(room, tx_pos_m=np.full_like(room.tx_pos_m, np.nan), receivers=(nowhere,)),
        "silent channels": replace(room, observation=zero),
        "channels that are not finite": replace(room, observation=broken),
        "blank spectra": replace(hall, observation=np.zeros_like(hall.observation)),
        "noise": replace(hall, observation=rng.random(hall.observation.shape).astype(np.float32)),
        "headings": replace(walk, tx_heading_rad=rng.uniform(-3, 3, len(walk))),
        "still": replace(walk, tx_pos_m=np.repeat(walk.tx_pos_m[:1], len(walk), axis=0)),
        "at the receiver": replace(walk, tx_pos_m=np.repeat(walk.receivers[0].position_m[None], len(walk), axis=0)),
        "on a line": replace(walk, tx_pos_m=walk.tx_pos_m * [1, 0, 0]),
        "no carrier": replace(walk, frequencies_hz=None),
        "far, no carrier": replace(walk, frequencies_hz=None, tx_pos_m=walk.tx_pos_m * 1e6),
    }


@pytest.mark.parametrize("case", odd_records())
def test_odd_data_are_checked_without_an_error(case):
    report = check_data(odd_records()[case])
    assert isinstance(report, DataReport)
    assert {suspicion.name for suspicion in report.suspicions} <= set(SUSPICIONS)
