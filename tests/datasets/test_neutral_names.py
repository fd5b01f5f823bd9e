"""Signal strengths in files with neutral names, and receivers with orientation, carrier and antenna."""

from pathlib import Path

import numpy as np
import pytest
from changed_folders import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from spectrum_records import assert_same

from wrf_mi.core import Antenna, Record
from wrf_mi.core.angles import rotation_matrix
from wrf_mi.core.antenna import DEVICE_TO_ARRAY, UPRIGHT, boresight_orientation
from wrf_mi.datasets import load, make_splits, read_ble_folder, read_record_file, write_ble_folder, write_record_file

ROUNDING = 1e-12
"""Rounding of rotations in double precision."""
RECEIVERS = "id,x,y,z\n3,1.5,2,2.5\n1,0,-1,2\n"
ROWS = "x,y,z,rssi_1,rssi_3\n0,0,1,-40,-50\n1,0,1,-41,-51\n2,0,1,-42,\n"


def folder_of(folder: Path, **files: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in files.items():
        (folder / f"{name}.csv").write_text(content)
    return folder


def with_columns(table: str, columns: str, *fields: str) -> str:
    header, *rows = table.splitlines()
    return "\n".join([f"{header},{columns}", *(f"{row},{field}" for row, field in zip(rows, fields, strict=True))])


def test_neutral_and_historic_names_give_equal_records(tmp_path: Path):
    neutral = read_ble_folder(folder_of(tmp_path / "a", receivers=RECEIVERS, train=ROWS, test=ROWS))
    historic = {"anchors": RECEIVERS, "calibration_df": ROWS, "test_robot_df": ROWS}
    assert_same(read_ble_folder(folder_of(tmp_path / "b", **historic)), neutral, "name")
    assert load(tmp_path / "a").task.name == "rssi"


@pytest.mark.parametrize(
    ("words", "official", "folds"),
    [(("train", " Test", "train"), [[0, 2], [1]], None), (("2", "7", "2"), None, [0, 1, 0]), ((), None, None)],
)
def test_one_file_with_and_without_a_split(words: tuple, official: list | None, folds: list | None, tmp_path: Path):
    files = {"receivers": RECEIVERS, "measurements": with_columns(ROWS, "split", *words) if words else ROWS}
    record = read_ble_folder(folder_of(tmp_path, **files))
    np.testing.assert_array_equal(record.observation, [[-50, -51, np.nan], [-40, -41, -42]])
    np.testing.assert_equal((record.official, record.folds), (official and tuple(map(np.array, official)), folds))
    if folds:
        assert [split.test.tolist() for split in make_splits(record, "blocked")] == [[0, 2], [1]]
    if not official:
        again = write_ble_folder(tmp_path / "again", record)
        assert sorted(file.name for file in again.iterdir()) == ["measurements.csv", "receivers.csv"]
        assert_same(read_ble_folder(again), record, "name")


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"anchors": RECEIVERS, "train": ROWS, "test": ROWS}, r"receivers\.csv and anchors\.csv state the same"),
        ({"train": ROWS, "test": ROWS, "test_robot_df": ROWS}, r"test\.csv and test_robot_df\.csv state the same"),
        ({"measurements": ROWS, "train": ROWS}, r"measurements\.csv and train\.csv state the same; remove one"),
        ({"train": ROWS}, r"test\.csv: missing; give a file that exists"),
        (
            {"measurements": with_columns(ROWS, "split", "train", "val", "test")},
            r"row 2: split is 'val'; give train or test",
        ),
        (
            {"measurements": with_columns(ROWS, "split", "train", "train", "train")},
            "all rows have train in the column split; mark",
        ),
        (
            {"measurements": with_columns(ROWS, "split", "train", "1", "test")},
            "row 2: split is '1'; give train or test, or in all rows",
        ),
    ],
)
def test_ambiguous_files_are_refused(files: dict[str, str], message: str, tmp_path: Path):
    refusal(read_ble_folder, folder_of(tmp_path, **{"receivers": RECEIVERS, **files}), message)


def test_carriers_of_rows_beside_those_of_receivers_are_refused(tmp_path: Path):
    rows = ROWS.replace("x,y,z", "x,y,frequency_hz")
    folder = folder_of(tmp_path, receivers=with_columns(RECEIVERS, "frequency_hz", "1e9", "2e9"), train=rows, test=rows)
    refusal(read_ble_folder, folder, r"train\.csv: line 1: frequency_hz is a column of receivers\.csv, too")


def test_ids_are_any_text_on_one_line(tmp_path: Path):
    ids = ["00:1a:2B:3c", "AP 1.5", "1.5", "hall/upper", "..", "a,b", 'the "big" one', "Küche", "4e10", "07"]
    quoted = ['"{}"'.format(name.replace('"', '""')) for name in ids]
    receivers = "id,x,y,z\n" + "".join(f"{name},{number},0,2\n" for number, name in enumerate(quoted))
    columns = ",".join('"rssi_{}"'.format(name.replace('"', '""')) for name in reversed(ids))
    rows = f"x,y,z,{columns}\n0,0,1,{','.join(str(-40 - number) for number in reversed(range(len(ids))))}\n"
    record = read_ble_folder(folder_of(tmp_path, receivers=receivers, train=rows, test=rows))
    assert [receiver.name for receiver in record.receivers] == [*ids[:-1], "anchor7"]
    np.testing.assert_array_equal(record.observation[:, 0], -40 - np.arange(len(ids)))
    assert_same(read_ble_folder(write_ble_folder(tmp_path / "again", record)), record, "name")


def read_with(folder: Path, columns: str, *rows: str) -> Record:
    return read_ble_folder(folder_of(folder, receivers=with_columns(RECEIVERS, columns, *rows), train=ROWS, test=ROWS))


@settings(max_examples=50, deadline=None)
@given(st.floats(-360, 360), st.floats(-90, 90))
def test_azimuth_and_downtilt_are_yaw_and_pitch_of_sionna(azimuth: float, downtilt: float):
    yaw, pitch = np.radians([azimuth, downtilt])
    # Sionna RT: R_z(yaw) R_y(pitch) from a device's frame to the world's.
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    tilt = np.array([[np.cos(pitch), 0, np.sin(pitch)], [0, 1, 0], [-np.sin(pitch), 0, np.cos(pitch)]])
    to_world = rotation_matrix(boresight_orientation(yaw, pitch)) @ DEVICE_TO_ARRAY
    np.testing.assert_allclose(to_world, turn @ tilt, atol=ROUNDING)


def test_orientations_carriers_and_antennas_are_read_and_written(tmp_path: Path):
    columns = "azimuth_deg,downtilt_deg,frequency_hz,pattern"
    record = read_with(tmp_path / "a", columns, "90,10,3.56e9,tr38901", ",,3.69e9,")
    first, second = record.receivers
    tilt = np.radians(10)
    np.testing.assert_allclose(first.to_world[:, 2], [0, np.cos(tilt), -np.sin(tilt)], atol=ROUNDING)
    assert (first.antenna, second.antenna) == (Antenna("tr38901", frame="array"), Antenna())
    assert (second.orientation_xyzw.tolist(), first.frequency_hz, second.frequency_hz) == ([*UPRIGHT], 3.56e9, 3.69e9)
    np.testing.assert_array_equal(record.receiver_carriers_hz, [3.56e9, 3.69e9])
    assert_same(read_ble_folder(write_ble_folder(tmp_path / "again", record)), record, "name")
    # A quaternion may take the place of angles.
    half = np.sqrt(0.5)
    record = read_with(tmp_path / "b", "qx,qy,qz,qw,frame", f"0,0,{half},{half},", "0,0,0,1,world")
    np.testing.assert_allclose(record.receivers[0].orientation_xyzw, [0, 0, half, half])
    assert [receiver.antenna.frame for receiver in record.receivers] == ["array", "world"]
    # Equal carriers of receivers are the carrier of the record.
    record = read_with(tmp_path / "c", "frequency_hz", "868e6", "868e6")
    assert record.receiver_carriers_hz is None
    np.testing.assert_array_equal(record.frequencies_hz, [868e6])


@pytest.mark.parametrize(
    ("columns", "rows", "message"),
    [
        ("qx,qy,qz,qw", ("0,0,0,2", ",,,"), "row 1: quaternion of norm 2; qx,qy,qz,qw must be a unit x, y, z, w"),
        ("qx,qy,qz,qw", ("0,0,0,1", "0,0,,1"), "row 2: qx, qy, qw alone; give qx,qy,qz,qw, or azimuth_deg"),
        ("downtilt_deg", ("3", ""), "row 1: downtilt_deg alone; give qx,qy,qz,qw, or azimuth_deg and"),
        ("azimuth_deg", ("north", "3"), "row 1: azimuth_deg is 'north'; give a finite number"),
        ("frequency_hz", ("1e9", ""), "row 2: frequency_hz is ''; give a finite number"),
        ("frequency_hz", ("1e9", "-1"), "row 2: frequency_hz is -1; give the carrier in Hz"),
        ("pattern", ("tr38901", ""), "row 1: antenna: pattern tr38901 has a boresight, .*for anchors azimuth_deg"),
    ],
)
def test_wrong_columns_of_receivers_are_refused(columns: str, rows: tuple[str, str], message: str, tmp_path: Path):
    refusal(lambda folder: read_with(folder, columns, *rows), tmp_path, rf"receivers\.csv: {message}")


@pytest.mark.parametrize("second_hz", [None, "2e9"])
def test_a_record_file_keeps_carriers_of_receivers(second_hz: str | None, tmp_path: Path):
    columns = ("frequency_hz", "1e9", second_hz) if second_hz else ("pattern", "", "")
    record = read_with(tmp_path / "a", *columns)
    assert_same(read_record_file(write_record_file(tmp_path / "a.npz", record)), record)
