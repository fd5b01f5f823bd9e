"""Folders and files that are no data set are refused with what they hold and the layout that is wanted."""

from pathlib import Path

import numpy as np
import pytest
from changed_folders import refusal
from commands import Command
from made_flat import write_flat

from wrf_mi.datasets import load
from wrf_mi.datasets.unknown import long_columns

SCANS = """time,x,y,BSSID,RSSI
0,1.5,2.5,aa:01,-60
0,1.5,2.5,aa:02,-70
1,2.5,2.5,aa:01,-61
1,2.5,2.5,aa:01,-63
2,2.5,3.5,aa:02,-75
3,3.5,3.5,aa:01,-64
"""
WANTED = r"columns x,y and rssi_<id> of each receiver, in train\.csv and test\.csv, or in measurements\.csv, beside"


@pytest.mark.parametrize(
    ("asked", "separator"),
    [("file", ","), ("file", ";"), ("folder", ","), ("folder", "\t"), ("folder in the layout", ",")],
)
def test_a_table_of_readings_is_told_its_import(asked: str, separator: str, tmp_path: Path, command: Command) -> None:
    pytest.importorskip("pandas")
    folder = tmp_path / "office"
    folder.mkdir()
    name = "scans.csv"
    if asked == "folder in the layout":
        name = "calibration_df.csv"
        (folder / "anchors.csv").write_text("id,x,y,z\naa:01,0,0,2\naa:02,4,0,2\n")
        (folder / "test_robot_df.csv").write_text("x,y,rssi_aa:01,rssi_aa:02\n1,2,-60,-61\n")
    (folder / name).write_text(SCANS.replace(",", separator))
    dataset = folder / name if asked == "file" else folder
    command.refused(["train", dataset, "--model", "idw", "--out", tmp_path / "run"], WANTED)
    command.refused(["data", "info", dataset], rf"wrf-mi data import {name} --out FOLDER$")
    command.done(["data", "import", folder / name, "--out", tmp_path / "made"])
    expected = np.array([[-60, -62, np.nan, -64], [-70, np.nan, -75, np.nan]], np.float32)
    np.testing.assert_array_equal(load(tmp_path / "made").observation, expected)


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("timestamp,pos_x,pos_y,MAC address,RSSI (dBm)", ("MAC address", "RSSI (dBm)")),
        ("x,y,z,AP,level", ("AP", "level")),
        ("lat,lon,ssid,bssid,signal_dbm,channel", ("bssid", "signal_dbm")),
        ("scan,gateway_id,rsrp", ("gateway_id", "rsrp")),
        ("x,y,rssi_1,rssi_2", None),
        ("X,Y,AP1 RSS(dBm),AP2 RSS(dBm)", None),
        ("x,y,rssi", None),
        ("a,b,c", None),
    ],
)
def test_columns_of_a_table_of_readings(header: str, columns: tuple | None) -> None:
    assert long_columns(header.split(",")) == columns


def test_other_content_is_named_with_what_is_wanted(tmp_path: Path, command: Command) -> None:
    for name in ("empty", "documents", "wide", "parent"):
        (tmp_path / name).mkdir()
    (tmp_path / "documents" / "scans.xlsx").write_bytes(b"PK")
    (tmp_path / "wide" / "all.csv").write_text("X,Y,AP1,AP2\n1,2,-50,-60\n")
    (tmp_path / "wide" / "damaged.csv").write_bytes(b"\xff\xfe\x00")
    write_flat(tmp_path / "parent" / "office")
    for dataset, message in (
        ("empty", r"an empty folder; a data set is a folder with receivers\.csv, train\.csv"),
        ("documents", r"holds scans\.xlsx and is no data set itself; a data set is a folder with receivers\.csv"),
        ("documents/scans.xlsx", r"a file of no known layout; a data set is a folder with receivers\.csv"),
        ("wide", rf"holds all\.csv,damaged\.csv and .*; all\.csv has the columns X,Y,AP1,AP2; .*{WANTED}"),
        ("wide/all.csv", rf"a table, where a folder is wanted; all\.csv has the columns X,Y,AP1,AP2; .*{WANTED}"),
        ("wide/damaged.csv", "a file of no known layout"),
        ("parent", r"holds office and is no data set itself; give .*parent/office$"),
        ("nowhere", "no such folder; give a folder or a known data set's name"),
    ):
        command.refused(["data", "info", tmp_path / dataset], message)


def test_an_incomplete_layout_names_the_missing_file(tmp_path: Path) -> None:
    for name, missing in (("calibration_df.csv", "anchors.csv"), ("tx_pos.csv", "gateway_info.yml")):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text("x,y,z\n1,2,3\n")
        refusal(load, tmp_path / name, f"{missing}: missing")
    # A table with other separators is told so.
    folder = write_flat(tmp_path / "office")
    (folder / "calibration_df.csv").write_text((folder / "calibration_df.csv").read_text().replace(",", ";"))
    refusal(load, folder, "the first line must name each column once, separated by commas")
