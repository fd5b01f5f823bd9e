"""Imports of forms of tables that could be read in two ways: slots, units, powers, floors, anchors, positions."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import error_line

from wrf_mi import import_measurements
from wrf_mi.apps.checking import check_data
from wrf_mi.core import Record
from wrf_mi.datasets import read_ble_folder

pandas = pytest.importorskip("pandas")


def imported(tmp_path: Path, frame: Any, **options: Any) -> Record:
    """The record that is read back from the import of a table."""
    frame.to_csv(tmp_path / "table.csv", index=False)
    import_measurements(tmp_path / "table.csv", tmp_path / "data", **options)
    return read_ble_folder(tmp_path / "data")


SLOTS = (
    "x,y,PCI - 1,RSRP - 1,RSRQ - 1,PCI - 2,RSRP - 2,RSRQ - 2\n"
    "0,0,7,-80,-9,12,-90,-11\n1,0,12,-85,-9,7,-88,-12\n2,0,12,-82,-8,,,\n",
    "x,y,Cell1_ID,Cell1_RSRP (dBm),Cell1_RSSI (dBm),Cell2_ID,Cell2_RSRP (dBm),Cell2_RSSI (dBm)\n"
    "0,0,7,-80,-50,12,-90,-50\n1,0,12,-85,-51,7,-88,-51\n2,0,12,-82,-52,,,\n",
)
"""The k-th strongest of two cells, with and without a second quantity."""


@pytest.mark.parametrize("text", SLOTS)
def test_slots_of_the_strongest_cells_are_sorted_by_identity(text: str, tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_text(text)
    record = import_measurements(tmp_path / "drive.csv", tmp_path / "data").record
    strengths = {
        receiver.name: row.tolist() for receiver, row in zip(record.receivers, record.observation, strict=True)
    }
    np.testing.assert_array_equal(strengths["anchor7"], [-80, -88, np.nan])
    np.testing.assert_array_equal(strengths["anchor12"], [-90, -85, -82])


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("x,y,PCI,RSRP,RSSI\n0,0,7,-80,-50\n1,0,9,-85,-52\n", ["anchor7", "anchor9"]),
        ("x,y,RSRP_a,RSSI_a,RSRP_b,RSSI_b\n0,0,-80,-50,-70,-40\n1,0,-85,-52,-71,-44\n", ["a", "b"]),
        ("x,y,bssid,rssi,tx_power\n0,0,u,-80,-8\n1,0,v,-85,0\n", ["u", "v"]),
    ],
)
def test_two_quantities_of_a_receiver_are_not_two_receivers(text: str, names: list[str], tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text(text)
    record = import_measurements(tmp_path / "t.csv", tmp_path / "data").record
    assert [receiver.name for receiver in record.receivers] == names
    assert np.nanmin(record.observation) == -85
    assert np.nanmax(record.observation) <= -70


def readings(**columns: Any) -> Any:
    """Ten places, each with a reading of two receivers."""
    frame = pandas.DataFrame(
        [(i, 0.5, ap, -50.0 - i) for i in range(10) for ap in "uv"], columns=["x", "y", "ap", "rssi"]
    )
    return frame.assign(**columns)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"Type": ["WIFI", "BLE"] * 10}, r"Type is WIFI \(10\), BLE \(10\): .*--where Type=WIFI"),
        ({"rssi": ["85%"] * 20}, r"rssi \(%\) is in per cent; give dBm"),
    ],
)
def test_what_is_not_one_quantity_is_not_pooled(columns: dict[str, Any], message: str, tmp_path: Path) -> None:
    readings(**columns).to_csv(tmp_path / "t.csv", index=False)
    error_line(import_measurements, tmp_path / "t.csv", tmp_path / "data", message)


def test_missing_kinds_of_radio_are_no_kind(tmp_path: Path) -> None:
    assert len(imported(tmp_path, readings(Type=["WIFI", None] * 10)).receivers) == 2


def test_each_beacon_may_send_its_own_power(tmp_path: Path) -> None:
    assert len(imported(tmp_path, readings(TxPower=[-8, 0] * 10)).receivers) == 2


def test_files_named_by_the_power_sent_are_runs(tmp_path: Path) -> None:
    files = [tmp_path / f"scan_{power}dBm.csv" for power in (-8, -4, 0)]
    for file in files:
        readings().to_csv(file, index=False)
    report = import_measurements(files, tmp_path / "data")
    assert sorted(set(report.record.runs)) == ["-4 dBm", "-8 dBm", "0 dBm"]
    assert "files at -8, -4, 0 dBm sent, by their names: a run for each, with its offset" in report.notes


def test_powers_sent_in_turn_are_runs_of_each_walk(tmp_path: Path) -> None:
    table = pandas.concat([readings(TxPower=power, walk=walk) for power, walk in ((-8, "a"), (0, "a"), (None, "b"))])
    record = imported(tmp_path, table.astype({"TxPower": "Int64"}))
    assert sorted(set(record.runs)) == ["a -8 dBm", "a 0 dBm", "b of no stated power"]
    assert len(record.tx_pos_m) == 30


@pytest.mark.parametrize("offset_db", [0.0, 4.0])
def test_a_constant_offset_between_files_is_said(offset_db: float, tmp_path: Path) -> None:
    noise = np.random.default_rng(4).normal(0, 1, (2, 20))
    for name, offset, part in zip("ab", (0.0, offset_db), noise, strict=True):
        readings(rssi=readings().rssi + offset + part).to_csv(tmp_path / f"{name}.csv", index=False)
    notes = import_measurements([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "data").notes
    assert any("dB from those of the other files" in note for note in notes) is (offset_db > 0)


@pytest.mark.parametrize(
    ("names", "heights_m"),
    [
        (["B1", "F1", "F2"], [-3, 0, 3]),
        (["B2", "B1", "G"], [-6, -3, 0]),
        (["Level-1", "Level-2", "Level-0"], [3, 6, 0]),
        (["floor -1", "floor 0", "floor 2"], [-3, 0, 6]),
        (["L2", "L3", "L10"], [6, 9, 30]),
        (["-1", "0", "1"], [-3, 0, 3]),
    ],
)
def test_floors_have_heights_by_their_names(names: list[str], heights_m: list[float], tmp_path: Path) -> None:
    frame = readings()[:6].assign(floor=np.repeat(names, 2))
    record = imported(tmp_path, frame)
    np.testing.assert_allclose(record.tx_pos_m[:, 2] - 1.3, heights_m)


def test_floors_of_unknown_order_are_asked_for(tmp_path: Path) -> None:
    readings()[:4].assign(floor=["P1", "P1", "F1", "F1"]).to_csv(tmp_path / "t.csv", index=False)
    error_line(import_measurements, tmp_path / "t.csv", tmp_path / "data", "floor is 'P1', beside other kinds of names")


def test_anchors_of_other_ids_are_refused(tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text("id,x,y\nroof,1,2\n")
    readings().to_csv(tmp_path / "t.csv", index=False)
    message = r"points\.csv: none of its ids \(roof\) is measured \(u, v\)"
    error_line(import_measurements, tmp_path / "t.csv", tmp_path / "data", message, anchors=tmp_path / "points.csv")


@pytest.mark.parametrize("name", ["02-00-00-00-00-01", "Hall"])
def test_anchors_are_named_by_address_or_network(name: str, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_text(f"id,x,y\n{name},1,2\n")
    (tmp_path / "t.csv").write_text('x,y,"02:00:00:00:00:01;Hall","02:00:00:00:00:02;Attic"\n0,0,-50,-60\n1,0,-51,\n')
    record = import_measurements(tmp_path / "t.csv", tmp_path / "data", anchors=tmp_path / "points.csv").record
    assert [np.isfinite(receiver.position_m).all() for receiver in record.receivers] == [True, False]


def test_positions_in_one_text_keep_sign_and_point(tmp_path: Path) -> None:
    frame = readings().drop(columns=["x", "y"]).assign(place=[f"({i / 2}, -2.0)" for i in range(20)])
    record = imported(tmp_path, frame, columns="cell=place")
    np.testing.assert_allclose(record.tx_pos_m[:, :2], [(i / 2, -2.0) for i in range(20)])


def test_tables_have_heights_of_their_own(tmp_path: Path) -> None:
    readings().assign(y=9).to_csv(tmp_path / "b.csv", index=False)
    record = imported(tmp_path, readings(), test=[tmp_path / "b.csv"], height_m=[1.0, 1.8])
    assert [set(record.tx_pos_m[rows, 2]) for rows in record.official] == [{1.0}, {1.8}]


@pytest.mark.parametrize(
    ("rows_m", "anchors_m", "message"),
    [
        (1.0, 1 / 0.3048, "positions of receivers are .*they are in feet"),
        (1 / 0.6, 1.0, r"positions of rows are 0\.(5|6)\d* m per unit .*steps of a grid"),
        (1.0, 1.0, None),
    ],
)
def test_unlike_units_of_rows_and_anchors_are_suspected(rows_m, anchors_m, message, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    at_m, places_m = rng.uniform(0, 12, (120, 2)), np.array([[1, 1], [11, 2], [6, 9.0]])
    levels = -40 - 25 * np.log10(np.linalg.norm(at_m[None] - places_m[:, None], axis=2)) + rng.normal(0, 3, (3, 120))
    frame = pandas.DataFrame(at_m * rows_m, columns=["x", "y"]).assign(
        **dict(zip(("rssi_a", "rssi_b", "rssi_c"), levels, strict=True))
    )
    anchors = pandas.DataFrame(places_m * anchors_m, columns=["x", "y"]).assign(id=["a", "b", "c"], z=2.5 * anchors_m)
    anchors.to_csv(tmp_path / "points.csv", index=False)
    imported(tmp_path, frame, anchors=tmp_path / "points.csv")
    texts = [
        suspicion.text for suspicion in check_data(tmp_path / "data").suspicions if suspicion.name == "unlike-units"
    ]
    assert len(texts) == (message is not None)
    assert all(re.search(message, text) for text in texts), texts
