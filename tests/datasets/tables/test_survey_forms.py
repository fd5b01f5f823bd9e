"""Imports of files as survey programs, phones and home automation write them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from changed_folders import error_line
from commands import Command
from survey_tables import has_note, imported, strengths, written

from wrf_mi import import_measurements
from wrf_mi.apps.importing.observed import read_observed

pandas = pytest.importorskip("pandas")
pytest.importorskip("pyproj")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.json", '{"points": [{"a": 1}]}', "no object with a strength .*--columns x=x,y=y,id=bssid,rssi=rssi"),
        ("s.json", '{"a": ' * 900 + "1" + "}" * 900, "no object with a strength|no JSON|without end"),
        ("s.json", "{", "no JSON .*export the survey again"),
        ("t.csv", "x,y,box,v\n1,2,02:00:00:00:00:01,-60\n", "--columns box"),
        ("t.csv", "x,y,station,v\n1,2,hall,-60\n1,2,attic,-70\n", "give --columns id=station,rssi=v, or --receivers"),
        ("t.csv", "u,v,station,q\n1.5,2,hall,-60\n2,3,attic,-70\n", "give --columns x=u,y=v,id=station,rssi=q"),
        ("t.csv", "u,v,bssid,rssi\n1.5,2,a,-60\n2,3,b,-70\n", r"try --columns x=u,y=v \(or lon=,lat="),
        (
            "t.csv",
            "u,v,name,q\n1.5,2,hall,b\n1,3,hall,c\n2,3,attic,d\n",
            "write a row for each reading, with strengths in dBm",
        ),
    ],
)
def test_other_forms_are_refused_with_what_to_try(name: str, text: str, message: str, tmp_path: Path) -> None:
    message = message.replace("--columns box", r"give --columns id=box,rssi=v, or --receivers")
    error_line(import_measurements, written(tmp_path, name, text), tmp_path / "data", message)


WIGLE = (
    "WigleWifi-1.6,appRelease=2.85,model=Phone\n"
    "MAC,SSID,FirstSeen,Frequency,RSSI,CurrentLatitude,CurrentLongitude,AltitudeMeters,Type\n"
    "02:00:00:00:00:01,net,2024-05-01 10:00:00,2437,-43,48.0001,11.0001,512,WIFI\n"
    "02:00:00:00:00:01,net,2024-05-01 10:00:01,2437,-99,0,0,0,WIFI\n"
    "02:00:00:00:00:01,net,2024-05-01 10:00:02,2437,-53,48.0002,11.0001,512,WIFI\n"
)


def test_rows_without_fix_are_left_out_with_a_count(tmp_path: Path) -> None:
    report = imported(tmp_path, written(tmp_path, "wigle.csv", WIGLE))
    assert has_note(report, "1 rows have no fix (0, 0 or empty CurrentLatitude): left out")
    assert sorted(strengths(report.record)["02:00:00:00:00:01"].values()) == [-53, -43]
    assert np.linalg.norm(np.ptp(report.record.tx_pos_m, axis=0)) == pytest.approx(11.12, abs=0.05)  # 1e-4 degrees


AIRODUMP = (
    "\r\nBSSID, First time seen, Last time seen, channel, Speed, Privacy, Cipher, Authentication, Power, # beacons,"
    " # IV, LAN IP, ID-length, ESSID, Key\r\n"
    "02:00:00:00:00:01, 2024-01-01 10:00:00, 2024-01-01 10:05:00,  6,  54, WPA2, CCMP, PSK, {}, 100, 10,"
    "   0.  0.  0.  0,   3, net, \r\n"
    "02:00:00:00:00:02, 2024-01-01 10:00:00, 2024-01-01 10:05:00, 11,  54, WPA2, CCMP, PSK,  -1, 1, 0,"
    "   0.  0.  0.  0,   3, far, \r\n"
    "\r\nStation MAC, First time seen, Last time seen, Power, # packets, BSSID, Probed ESSIDs\r\n\r\n"
    "02:00:00:00:00:99, 2024-01-01 10:00:00, 2024-01-01 10:05:00, -20, 50, 02:00:00:00:00:01, \r\n\r\n"
)


def test_two_tables_of_airodump(tmp_path: Path) -> None:
    files = [written(tmp_path, f"{name}-01.csv", AIRODUMP.format(dbm)) for name, dbm in (("p", -50), ("q", -60))]
    spots = written(tmp_path, "spots.csv", "file,x,y\np-01,0,0\nq-01,3,1\n")
    report = import_measurements(files, tmp_path / "data", positions=[spots])
    assert strengths(report.record)["02:00:00:00:00:01"] == {(0.0, 0.0): -50, (3.0, 1.0): -60}
    assert len(report.record.receivers) == 1  # power -1 is unknown
    assert has_note(report, "left out, by their first column (--sheet): Station MAC (1 rows)")
    message = r"no sheet X with cells \(BSSID \(2 rows\), Station MAC \(1 rows\)\); choose one by --sheet NAME"
    error_line(import_measurements, files, tmp_path / "other", message, positions=[spots], sheet="X")


GNETTRACK = (
    "Timestamp\tLongitude\tLatitude\tCGI\tCellID\tLAC\tLevel\tQual\tPSC\tNCellid1\tNCell1\tNRxLev1\tNCell2\tNRxLev2\n"
    "2018.05.07_18.57.10\t11.0001\t48.0001\t26201\t5\t9\t-80\t-9\t17\t-\t42\t-95\t-\t-\n"
    "2018.05.07_18.57.12\t11.0001\t48.0002\t26201\t6\t9\t-84\t-9\t42\t-\t17\t-88\t3\t-99\n"
)


def test_serving_cell_and_neighbours_of_gnettrack_are_receivers(tmp_path: Path) -> None:
    report = imported(tmp_path, written(tmp_path, "log.txt", GNETTRACK))
    strengths_dbm = {name: sorted(values.values()) for name, values in strengths(report.record).items()}
    assert strengths_dbm == {"anchor17": [-88, -80], "anchor42": [-95, -84], "anchor3": [-99]}
    columns = "id=CellID,rssi=Level"
    serving = strengths(imported(tmp_path, tmp_path / "log.txt", columns=columns).record)
    assert {name: list(values.values()) for name, values in serving.items()} == {"anchor5": [-80], "anchor6": [-84]}


def test_fixes_and_strengths_in_alternate_rows_of_nemo(tmp_path: Path) -> None:
    """The second reading is a quarter of the way from the first fix to the second; the last one is after all fixes."""
    names = ["RSRP (LTE pcell)", "Physical cell identity (LTE pcell)"]
    names += ["RSRP (LTE detected) - 1", "Physical cell identity (LTE detected) - 1"]
    rows = ["2024-05-01 10:00:00.0,48.0,11.0,,,,", "2024-05-01 10:00:01.0,,,-80,7,-90,8"]
    rows += ["2024-05-01 10:00:04.0,48.0004,11.0,,,,", "2024-05-01 10:00:05.0,,,-85,7,,"]
    file = written(tmp_path, "nemo.csv", "\n".join(["Time,Latitude,Longitude," + ",".join(names), *rows]) + "\n")
    report = imported(tmp_path, file)
    assert strengths(report.record).keys() == {"anchor7", "anchor8"}
    assert len(report.record) == 1
    facts = [note for note in report.notes if "rows of their own" in note]
    assert "(2): linear between them in time, at most 4 s apart; 1 readings before or after them" in facts[0]
    assert has_note(report, "11, 48.0001 degrees")  # the origin is the only place


def event_log(*lines: tuple[Any, ...]) -> str:
    return "\n".join(["#\tstartTime:1574572522274", *("\t".join(map(str, line)) for line in lines)]) + "\n"


def wifi(time: int, dbm: int, seen: int) -> tuple[Any, ...]:
    return (time, "TYPE_WIFI", "net", "02:00:00:00:00:01", dbm, 2437, seen)


START = 1574572522274


def test_event_logs_with_waypoints_without_cached_scans(tmp_path: Path) -> None:
    events = [(START, "TYPE_WAYPOINT", 1.0, 2.0), wifi(START + 2500, -50, START + 2000), (START, "TYPE_ACCE", 1, 2, 3)]
    events += [wifi(START + 5000, -99, START + 2000), (START + 8000, "TYPE_WAYPOINT", 9.0, 2.0)]
    events += [wifi(START + 9000, -77, START + 8500)]
    files = [written(tmp_path, f"{name}.txt", event_log(*events)) for name in "ab"]
    report = import_measurements(files, tmp_path / "data")
    # Received two seconds after the first waypoint, a quarter of the way to the second.
    assert strengths(report.record) == {"02:00:00:00:00:01": {(3.0, 2.0): -50}}
    assert list(report.record.runs) == ["a", "b"]
    assert report.record.receiver_carriers_hz is None or set(report.record.receiver_carriers_hz) == {2437e6}
    assert has_note(report, "a.txt: 1 of 3 readings were cached, older than 2 s (last_seen): left out")
    assert has_note(report, "at most 8 s apart; 1 readings before or after them are left out")
    beacon = (START + 4000, "TYPE_BEACON", "F0", 1, 2, -59, -70, 1.5, "6B:11:4C:D1:29:F2", START)
    file = written(tmp_path, "c.txt", event_log(*events, beacon))
    message = r"Type is WIFI \(1\), BLE \(1\): .*--where Type=WIFI"
    error_line(import_measurements, file, tmp_path / "other", message)
    record = import_measurements(file, tmp_path / "ble", where={"Type": "BLE"}).record
    assert strengths(record) == {"F0_1_2": {(5.0, 2.0): -70}}
    short = written(tmp_path, "d.txt", event_log(*events, (START, "TYPE_WIFI", "net")))
    error_line(import_measurements, short, tmp_path / "other", "TYPE_WIFI has 3 fields; remove the line")


def test_logs_of_several_floors_are_not_pooled(tmp_path: Path) -> None:
    events = [(START, "TYPE_WAYPOINT", 1.0, 2.0), wifi(START + 10, -50, START), (START + 90, "TYPE_WAYPOINT", 1.0, 2.0)]
    files = [
        written(tmp_path, f"{floor}.txt", f"#\tFloorId:5\tFloorName:{floor}\n" + event_log(*events))
        for floor in ("B1", "F1")
    ]
    message = r"logs are of the floors B1, F1; give --columns floor=floor_name, or one floor by --where floor_name=B1"
    error_line(import_measurements, files, tmp_path / "data", message)
    record = import_measurements(files, tmp_path / "data", columns="floor=floor_name").record
    np.testing.assert_allclose(record.tx_pos_m[:, 2], [-1.7, 1.3])
    record = import_measurements(files, tmp_path / "one", where={"floor_name": "B1"}).record
    np.testing.assert_allclose(record.tx_pos_m[:, 2], 1.3)


def test_notes_on_many_files_are_printed_for_the_first(tmp_path: Path, command: Command) -> None:
    events = [(START, "TYPE_WAYPOINT", 1.0, 2.0), wifi(START + 10, -50, START), (START + 90, "TYPE_WAYPOINT", 1.0, 2.0)]
    files = [written(tmp_path, f"walk{number}.txt", event_log(*events)) for number in range(8)]
    out = command.done(["data", "import", *files, "--out", tmp_path / "data"])
    assert out.count("readings were cached") == 3
    assert "import.yml has 15 more notes of this kind" in out
    assert (tmp_path / "data" / "import.yml").read_text().count("readings were cached") == 8


def test_cached_scans_are_told_by_dates(tmp_path: Path) -> None:
    rows = ["10:00:05,10:00:04,0,-50", "10:00:05,10:00:01,0,-90", "10:00:09,,1,-60"]
    rows = [",".join(f"2024-05-01 {field}" if ":" in field else field for field in row.split(",")) for row in rows]
    text = "\n".join(["time,last_seen,x,rssi_a,y", *(f"{row},0" for row in rows)]) + "\n"
    report = imported(tmp_path, written(tmp_path, "t.csv", text))
    assert strengths(report.record) == {"a": {(0.0, 0.0): -50, (1.0, 0.0): -60}}


def test_rows_that_received_nothing_are_kept_beside_a_missing_position(tmp_path: Path) -> None:
    text = "time,x,y,rssi_a\n0,0,0,-50\n1,1,0,\n2,2,0,-60\n3,3,0,-61\n"
    report = imported(tmp_path, written(tmp_path, "t.csv", text))
    assert len(report.record) == 4
    file = written(tmp_path, "u.csv", text + "4,,,-62\n")
    error_line(import_measurements, file, tmp_path / "other", "row 5: x is empty or infinite; give a number")


def test_columns_of_a_room_are_no_cell(tmp_path: Path) -> None:
    report = imported(tmp_path, written(tmp_path, "t.csv", "x,y,area,cell,rssi\n0,0,12,a,-50\n1,0,12,b,-60\n"))
    assert [receiver.name for receiver in report.record.receivers] == ["a", "b"]


def test_last_seen_of_another_clock_is_not_used(tmp_path: Path) -> None:
    text = "time,last_seen,x,y,bssid,rssi\n1574572522,17,0,0,a,-50\n1574572530,25,1,0,a,-60\n"
    report = imported(tmp_path, written(tmp_path, "t.csv", text))
    assert has_note(report, "last_seen is of another clock than time: not used")
    assert len(report.record) == 2


OPENCELLID = (
    "LTE,262,1,7937,20161,0,11.001,48.0005,1000,5,1,1459813819,1459813819,0\n"
    "LTE,262,1,7938,20161,0,11.009,48.0009,1000,5,1,1459813819,1459813819,0\n"
    "GSM,262,1,7937,30001,0,11.002,48.0001,1000,5,1,1459813819,1459813819,-90\n"
)


@pytest.mark.parametrize(
    ("header", "ids"),
    [
        ("mcc,mnc,lac,cellid", ["262,01,7937,20161", "262,01,7937,99"]),
        ("lac,cellid", ["7937,20161", "7937,99"]),
        ("MAC", ["26201_7937_20161", "26201_7937_99"]),
    ],
)
def test_cells_of_opencellid_are_anchors(header: str, ids: list[str], tmp_path: Path) -> None:
    rows = [f"{48 + k / 1e4},11.0,{name},-{80 + k}" for k, name in enumerate(ids)]
    file = written(tmp_path, "drive.csv", "\n".join([f"lat,lon,{header},dbm", *rows]) + "\n")
    anchors = written(tmp_path, "262.csv", OPENCELLID)
    report = imported(tmp_path, file, anchors=anchors)
    position_m = {receiver.name: receiver.position_m for receiver in report.record.receivers}
    listed_cells = [name for name in position_m if name.endswith("20161")]
    east_north_m = position_m[listed_cells[0]][:2] - report.record.tx_pos_m[0, :2]
    np.testing.assert_allclose(east_north_m, [74.6, 55.6], atol=0.1)  # 0.001 and 0.0005 degrees at 48 degrees
    assert np.isnan(next(place for name, place in position_m.items() if name.endswith("99"))).all()


def test_cells_of_several_areas_are_told_apart(tmp_path: Path) -> None:
    file = written(tmp_path, "drive.csv", "lat,lon,cellid,dbm\n48.0001,11.0,20161,-80\n48.0002,11.0,5,-81\n")
    anchors = written(tmp_path, "262.csv", OPENCELLID)
    message = "cell 20161 is in several areas; give the measurements columns mcc, mnc, lac and cellid"
    error_line(import_measurements, file, tmp_path / "data", message, anchors=anchors)


def test_tables_and_anchors_are_sheets_of_one_workbook(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    with pandas.ExcelWriter(tmp_path / "s.xlsx") as writer:
        pandas.DataFrame({"x": [0, 1], "y": 0, "bssid": "a", "rssi": [-50, -60]}).to_excel(writer, sheet_name="walk")
        pandas.DataFrame({"id": ["a"], "x": [3], "y": [4]}).to_excel(writer, sheet_name="aps", index=False)
    file, message = tmp_path / "s.xlsx", r"several sheets \(walk \(2 rows\), aps \(1 rows\)\).*--sheet walk"
    error_line(import_measurements, file, tmp_path / "data", message)
    report = imported(tmp_path, file, sheet="walk", anchors=f"{file}#aps")
    np.testing.assert_allclose(report.record.receivers[0].position_m[:2], [3, 4])


def test_messages_of_espresense_have_a_run_for_each_device(tmp_path: Path) -> None:
    lines = []
    for device, offset in (("phone:a", 0), ("tag-b", -8)):
        for time, dbm in ((1000.0, -60), (1004.0, -64)):
            payload = {"mac": "dd8800003777", "id": device, "rssi@1m": -59, "rssi": dbm + offset, "distance": 6.58}
            lines.append(f"{time} espresense/devices/{device}/kitchen {json.dumps(payload)}")
    lines.insert(0, "999.0 espresense/rooms/kitchen/status online")
    file = written(tmp_path, "mqtt.log", "\n".join(lines) + "\n")
    path = written(tmp_path, "path.csv", "time,x,y\n1000,0,0\n1004,4,0\n")
    nodes = "nodes:\n- name: kitchen\n  point: [1, 2, 2.1]\n- name: hall\n  point: [5, 5, 2]\n"
    nodes = f"timeout: 30\nfloors:\n- id: first\n  bounds: [[0, 0, 0], [9, 9, 3]]\n{nodes}"
    anchors = written(tmp_path, "config.yaml", nodes)
    report = imported(tmp_path, file, positions=[path], anchors=anchors)
    assert has_note(report, "4 rows; 1 lines of other topics are left out")
    record = report.record
    np.testing.assert_allclose(record.receivers[0].position_m, [1, 2, 2.1])
    by_run = {run: sorted(record.observation[0, record.runs == run]) for run in set(record.runs)}
    assert by_run == {"phone:a": [-64, -60], "tag-b": [-72, -68]}
    # A node that is carried about past beacons that stay: the ends change their parts.
    moved = imported(tmp_path, file, positions=[path], columns="id=device,rssi=rssi,run=node,time=time").record
    assert [receiver.name for receiver in moved.receivers] == ["phone:a", "tag-b"]


def test_dumps_of_bermuda_are_readings_of_scanners(tmp_path: Path) -> None:
    scanners = ["02:00:00:00:00:0a", "02:00:00:00:00:0b"]
    files = []
    for name, dbm in (("p", -50), ("q", -60)):
        adverts = {
            f"02:00:00:00:00:99__{scanner}": {
                **{"name": f"Proxy {k}", "scanner_address": scanner, "device_address": "02:00:00:00:00:99"},
                **{"rssi": dbm - 10 * k, "rssi_distance": 2.5, "hist_rssi": [dbm, dbm]},
            }
            for k, scanner in enumerate(scanners)
        }
        device = {"name": "phone", "address": "02:00:00:00:00:99", "area_rssi": -40, "adverts": adverts}
        files.append(written(tmp_path, f"{name}.json", json.dumps({"02:00:00:00:00:99": device})))
    spots = written(tmp_path, "spots.csv", "file,x,y\np.json,0,0\nq.json,3,1\n")
    record = import_measurements(files, tmp_path / "data", positions=[spots]).record
    readings = strengths(record)
    assert readings[scanners[0]] == {(0.0, 0.0): -50, (3.0, 1.0): -60}
    assert readings[scanners[1]] == {(0.0, 0.0): -60, (3.0, 1.0): -70}
    assert set(record.runs) == {"02:00:00:00:00:99"}


def test_logs_that_are_located_are_read_as_those_that_are_imported(tmp_path: Path) -> None:
    report = imported(tmp_path, written(tmp_path, "log.txt", GNETTRACK))
    facts = yaml.safe_load((tmp_path / "data" / "import.yml").read_text())
    observed = read_observed(tmp_path / "log.txt", facts)
    assert observed.xy_m is not None
    np.testing.assert_allclose(observed.xy_m, report.record.tx_pos_m[:, :2], atol=1e-5)
    names = [receiver.name.removeprefix("anchor") for receiver in report.record.receivers]
    np.testing.assert_array_equal(observed.dbm[[observed.ids.index(name) for name in names]], report.record.observation)
