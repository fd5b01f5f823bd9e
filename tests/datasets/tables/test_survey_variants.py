"""Files whose numbers, headers and objects are written otherwise, and what a refusal proposes."""

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import error_line
from survey_tables import has_note, imported, strengths, written

from wrf_mi import import_measurements
from wrf_mi.core import InputError

pandas = pytest.importorskip("pandas")
pytest.importorskip("pyproj")

A, B = "02:00:00:00:00:01", "02:00:00:00:00:02"
WALK = {A: {(0.5, 0.5): -50.0, (2.5, 1.5): -60.5}, B: {(0.5, 0.5): -71.0, (2.5, 1.5): -65.0}}
FIELDS = [(x, y, name, dbm) for name, places in WALK.items() for (x, y), dbm in places.items()]


def rows(text: str, separator: str = ";", scale: float = 1.0) -> str:
    """Lines of the walk, coordinates and strengths by a format."""
    lines = [[text.format(x * scale), text.format(y * scale), name, f"{dbm:.1f}"] for x, y, name, dbm in FIELDS]
    return "\n".join(separator.join(fields) for fields in lines) + "\n"


def german(text: str) -> str:
    return text.translate(str.maketrans(".,", ",."))


HEADER = "x_mm;y_mm;bssid;rssi\n"
NUMBERS = {
    "point and decimal comma": german(HEADER + rows("{:,.2f}", scale=1000)),
    "comma and decimal point": HEADER + rows("{:,.2f}", scale=1000),
    "comma alone": HEADER + rows("{:,.0f}", scale=1000),
    "point alone": HEADER
    + rows("{:,.0f}", scale=1000).replace(",", ".").replace(".0\n", "\n").replace("-60.5", "-60,5"),
    "apostrophe": HEADER + rows("{:,.2f}", scale=1000).replace(",", "'"),
    "narrow blank": HEADER + german(rows("{:,.2f}", scale=1000)).replace(".", "\u202f"),
    "minus of spreadsheets": HEADER + rows("{:.1f}", scale=1000).replace("-", "\u2212"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_marks_of_thousands_are_no_decimals(case: str, tmp_path: Path) -> None:
    report = imported(tmp_path, written(tmp_path, "t.csv", NUMBERS[case]))
    assert strengths(report.record) == WALK
    assert has_note(report, "separates thousands in") == (case == "point alone")


def test_decimals_of_three_digits_stay_decimals(tmp_path: Path) -> None:
    text = "x,y,bssid,rssi\n" + "".join(f"{x + 0.125:g},{x:g},a,{-50 - x:g}\n" for x in (1.0, 2.0, 2.875, 4.875))
    assert set(strengths(imported(tmp_path, written(tmp_path, "t.csv", text)).record)["a"]) == {
        (1.125, 1.0),
        (2.125, 2.0),
        (3.0, 2.875),
        (5.0, 4.875),
    }


def test_unclear_marks_are_asked_for(tmp_path: Path) -> None:
    text = "x,y,bssid,rssi\n" + "".join(f"{x},0,a,-50\n" for x in ("512", "1.234", "2.345", "3.456"))
    message = "x has whole numbers beside fields such as 512: thousands or decimals"
    error_line(import_measurements, written(tmp_path, "t.csv", text), tmp_path / "data", message)


def test_wide_characters_without_mark_are_read(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_bytes(("x;y;bssid;rssi\n" + german(rows("{:.2f}"))).encode("utf-16-le"))
    assert strengths(imported(tmp_path, tmp_path / "t.csv").record) == WALK


SHEETS: dict[str, list[list[Any]]] = {
    "title": [["Survey of 1 May"], [], ["X", "Y", "BSSID", "RSSI"], *map(list, FIELDS)],
    "texts": [["X", "Y", "BSSID", "RSSI"], *([german(f"{x}"), german(f"{y}"), n, f"{v} dBm"] for x, y, n, v in FIELDS)],
    "two rows": [["Position", None, A, B], ["x", "y", "RSSI", "RSSI"], [0.5, 0.5, -50, -71], [2.5, 1.5, -60.5, -65]],
    "merged": [
        ["X", "Y", "BSSID", "RSSI"],
        [0.5, 0.5, A, -50],
        [None, None, B, -71],
        [2.5, 1.5, A, -60.5],
        [2.5, 1.5, B, -65],
    ],
}


@pytest.mark.parametrize("case", SHEETS)
def test_sheets_have_titles_and_merged_cells(case: str, tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in SHEETS[case]:
        book.active.append(row)
    for cells in {"merged": ("A2:A3", "B2:B3"), "two rows": ("A1:B1",), "title": ("A1:D1",)}.get(case, ()):
        book.active.merge_cells(cells)
    book.save(tmp_path / "t.xlsx")
    assert strengths(imported(tmp_path, tmp_path / "t.xlsx").record) == WALK


def scans(key: str, dbm: str) -> list[dict[str, str | float]]:
    return [{key: name, dbm: places[(0.5, 0.5)], "ssid": "net"} for name, places in WALK.items()]


FIRST = {name: {(0.5, 0.5): places[(0.5, 0.5)]} for name, places in WALK.items()}
AT = {"x": 0.5, "y": 0.5}
DOCUMENTS: dict[str, Any] = {
    "position beside the readings": [{"location": AT, "readings": scans("mac", "signal")}],
    "position within": [{"id": 4, "location": {"coord": AT}, "rssi": scans("accessPointId", "value")}],
    "objects by address": [
        AT | {"aps": {scan["bssid"]: {"level": scan["dbm"], "ssid": "net"} for scan in scans("bssid", "dbm")}}
    ],
    "strengths by address": [AT | {"scan": {scan["bssid"]: scan["dbm"] for scan in scans("bssid", "dbm")}}],
    "strengths by name": [AT | {"rssi": {scan["bssid"]: scan["dbm"] for scan in scans("bssid", "dbm")}}],
    "features": {
        "features": [{"geometry": {"coordinates": [0.5, 0.5]}, "properties": scan} for scan in scans("mac", "rssi")]
    },
}


@pytest.mark.parametrize("case", DOCUMENTS)
def test_objects_of_readings_have_the_position_beside_them(case: str, tmp_path: Path) -> None:
    assert strengths(imported(tmp_path, written(tmp_path, "t.json", json.dumps(DOCUMENTS[case]))).record) == FIRST


def readings(header: str, *beside: str) -> str:
    """Table of the walk with further fields between the position and the address."""
    return header + "\n" + "".join(",".join([str(x), str(y), *beside, n, str(v)]) + "\n" for x, y, n, v in FIELDS)


TABLES = {
    "tags that move": readings("x,y,tag_mac,node,rssi", "de:ad:be:ef:00:01"),
    "network before address": readings("x,y,ssid,hw,rssi", "net"),
    "access point": readings("X,Y,Access Point,Signal (dBm)"),
    "noise in dBm": readings("X,Y,Noise (dBm),BSSID,Signal (dBm)", "-95"),
    "several quantities": readings("X,Y,SIGNAL,High RSSI,BSSID,RSSI", "80", "-30"),
    "empty column of carriers": readings("X,Y,Carrier,BSSID,RSSI", ""),
    "lines above the header": "Survey,of,May\n" + readings("X,Y,BSSID,RSSI"),
}


@pytest.mark.parametrize("case", TABLES)
def test_receivers_are_told_by_addresses(case: str, tmp_path: Path) -> None:
    assert strengths(imported(tmp_path, written(tmp_path, "t.csv", TABLES[case])).record) == WALK


PROPOSED = {
    "names": readings("Pos este,Pos norte,red,potencia"),
    "counts": readings("este p,norte p,punto,red,potencia", "7"),
    "comma in names": readings('"a, b","c, d",red,potencia'),
    "channels": readings("u,v,Channel,Kanal,red,potencia", "6", "1"),
    "no header": readings("").lstrip(),
}


@pytest.mark.parametrize("case", PROPOSED)
def test_proposed_columns_are_those_of_the_table(case: str, tmp_path: Path) -> None:
    file = written(tmp_path, "t.csv", PROPOSED[case])
    with pytest.raises(InputError) as error:
        imported(tmp_path, file)
    words = shlex.split(str(error.value).partition("--columns ")[2])
    assert strengths(imported(tmp_path, file, columns=words[0].rstrip(",")).record) == WALK


REFUSED = {
    "per cent": (
        readings("x,y,bssid,signal").replace("-", ""),
        r"no strength is below 0 dBm \(50 to 71\): per cent, mW",
    ),
    "no table": ("Cell 01 - Address: 02\n  Level is low\n", "no table; write a row for each reading with a header"),
    "text": ("x,y,AP1\n0,0,-50\n1,0,-60\n2,0,weak\n", "row 3: AP1 is 'weak'; give a number"),
    "no positions": (
        "Time Stamp|SSID|BSSID|Strength|Primary Channel|Channel\n1|net|a|-40dBm|6|6\n2|net|a|-41dBm|1|2\n",
        "no columns of positions .*; give --positions FILE",
    ),
    "damaged row": (
        "WigleWifi-1.6,a=b\nMAC,SSID,RSSI,CurrentLatitude,CurrentLongitude\n"
        + f"{A},net,-50,48,11\n" * 3
        + f"{A},a, b,-50,48,11\n",
        r"line 6: 6 fields, but the first line has 5 \(MAC, SSID",
    ),
    "two phones": (
        f"x,y,phone_mac,AP1,AP2\n0,0,{A},-50,-51\n1,0,{B},-60,-61\n",
        r"phone_mac has names, AP1 strengths.*, or --columns run=phone_mac \(what moved\)",
    ),
    "roles": (
        "BSSID,Power,LocalTime,GPSTime,Latitude,Longitude,Type\na,-50,1,1,48,11,AP\nb,-60,1,1,48,11,Client\n",
        "Type is AP .*: these are not pooled; choose one by --where Type=AP",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_read_is_refused_with_its_place(case: str, tmp_path: Path) -> None:
    text, message = REFUSED[case]
    error_line(import_measurements, written(tmp_path, "t.csv", text), tmp_path / "data", message)


@pytest.mark.parametrize(("name", "separator"), [("airodump", ","), ("WiFiAnalyzer", "|")])
def test_networks_have_separators_in_their_names(name: str, separator: str, tmp_path: Path) -> None:
    header = {
        "airodump": "BSSID, First time seen, Power, # beacons, ESSID, x, y",
        "WiFiAnalyzer": "BSSID,Time Stamp,Strength,Primary Frequency,SSID,x,y",
    }[name]
    lines = [header, *(f"{mac},2024-05-01 10:00:00,{dbm:g},2437,Caf,e,{x},{y}" for x, y, mac, dbm in FIELDS)]
    file = written(tmp_path, "t.csv", "\n".join(lines).replace(",", separator))
    assert strengths(imported(tmp_path, file).record) == WALK


def test_stations_of_airodump_are_receivers(tmp_path: Path) -> None:
    lines = ["Station MAC, First time seen, Last time seen, Power, # packets, BSSID, Probed ESSIDs, x, y"]
    lines += [f"{mac}, t, 2024-05-01 10:00:00, {dbm}, 5, (not associated), a,b, {x}, {y}" for x, y, mac, dbm in FIELDS]
    assert strengths(imported(tmp_path, written(tmp_path, "t.csv", "\n".join(lines))).record) == WALK


def test_serving_cells_of_any_program_are_slots(tmp_path: Path) -> None:
    header = "Time,x,y,Serving Cell PCI,Serving Cell RSRP (dBm),Neighbor Cell PCI[1],Neighbor Cell RSRP[1]"
    text = f"{header}\n1,0,0,7,-80,8,-90\n2,1,0,8,-81,7,-91\n3,2,0,,-99,7,-92\n"
    report = imported(tmp_path, written(tmp_path, "t.csv", text))
    assert strengths(report.record) == {
        "anchor7": {(0, 0): -80, (1, 0): -91, (2, 0): -92},
        "anchor8": {(0, 0): -90, (1, 0): -81},
    }
    assert has_note(report, "5 readings of cells by identity; 1 without one are left out")


@pytest.mark.parametrize("frequency", ["", ";2437"])
def test_logs_of_positions_and_scans_in_kinds(frequency: str, tmp_path: Path) -> None:
    lines = ["% POSI;AppTimestamp(s);Counter;Latitude;Longitude;FloorID;BuildingID"]
    lines += ["POSI;0;1;48.0;11.0;1;0", "POSI;2;2;48.0002;11.0;1;0", "ACCE;0.5;1;0;0;9.8;3"]
    lines += [f"WIFI;{time};5;my net;{A}{frequency};{dbm}" for time, dbm in ((0.5, -50), (1.5, -60))]
    record = imported(tmp_path, written(tmp_path, "log.txt", "\n".join(lines))).record
    np.testing.assert_allclose(np.diff(record.tx_pos_m, axis=0), [[0, 11.12, 0]], atol=0.01)
    np.testing.assert_allclose(record.tx_pos_m[:, 2], 4.3)  # one storey up
    assert record.observation.tolist() == [[-50, -60]]


def test_lines_that_run_on_are_two_events(tmp_path: Path) -> None:
    start, log = 1560000000000, ""
    for step in range(3):
        end = "" if step == 1 else "\n"
        log += f"{start + 2000 * step}\tTYPE_WAYPOINT\t{step}\t0\n"
        log += (
            f"{start + 2000 * step + 1000}\tTYPE_WIFI\tnet\t{A}\t{-50 - step}\t2437\t{start + 2000 * step + 1000}{end}"
        )
    report = imported(tmp_path, written(tmp_path, "log.txt", log))
    assert strengths(report.record) == {A: {(0.5, 0): -50, (1.5, 0): -51}}


def test_paths_of_several_devices_are_followed_in_time(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        "path.csv",
        "time,device,x,y\n" + "".join(f"{t}.0,{d},{t * s},0\n" for d, s in (("p", 1), ("q", 3)) for t in (0, 2)),
    )
    text = "time,device,node,rssi\n1,p,hall,-50\n1,q,hall,-60\n"
    record = imported(tmp_path, written(tmp_path, "t.csv", text), positions=[path]).record
    assert strengths(record) == {"hall": {(1, 0): -50, (3, 0): -60}}


def test_times_in_seconds_and_milliseconds_are_one_clock(tmp_path: Path) -> None:
    path = written(tmp_path, "path.csv", "time,x,y\n1714557600.0,0,0\n1714557602.0,2,0\n")
    text = "time,bssid,rssi\n1714557600500,a,-50\n1714557601500,a,-60\n"
    record = imported(tmp_path, written(tmp_path, "t.csv", text), positions=[path]).record
    assert strengths(record) == {"a": {(0.5, 0): -50, (1.5, 0): -60}}


def test_nodes_without_id_are_told_by_their_names(tmp_path: Path) -> None:
    nodes = "nodes:\n- {name: hall, id: hall-1, point: [1, 2, 3]}\n- {name: attic, point: [4, 5, 6]}\n"
    file = written(tmp_path, "t.csv", "x,y,node,rssi\n0,0,hall-1,-50\n0,0,attic,-60\n")
    record = imported(tmp_path, file, anchors=written(tmp_path, "config.yaml", nodes)).record
    assert {receiver.name: receiver.position_m.tolist() for receiver in record.receivers} == {
        "hall-1": [1, 2, 3],
        "attic": [4, 5, 6],
    }
