"""Meanings of columns, with the headers of public data sets."""

from pathlib import Path

import pytest
from changed_folders import refusal

from wrf_mi.apps.importing.files import read_table
from wrf_mi.apps.importing.forms import Columns, find_columns, parsed_columns, unit_of

pytest.importorskip("pandas")


def columns_of(tmp_path: Path, header: str, row: str, stated: str = "", receivers: tuple[str, ...] = ()) -> Columns:
    (tmp_path / "t.csv").write_text(f"{header}\n{row}\n")
    return find_columns(read_table(tmp_path / "t.csv"), parsed_columns(stated), receivers)


LONG = {
    "time,x,y,BSSID,RSSI": ("0,1,2,aa:bb:cc:00:00:01,-60", "BSSID", "RSSI"),
    "PCI,latitude,longitude,device,rsrp": ("C,36.004,-78.93,Samsung,-124", "PCI", "rsrp"),
    "timestamp,lat,lon,pci,rsrp,rsrq": ("0,51.1,4.4,17,-110,-12", "pci", "rsrp"),
    "bssid,ssid,level,frequency,x,y": ("aa:bb:cc:00:00:01,net,-60,2412,1,2", "bssid", "level"),
    "t,anchorId,RSSI_dBm,posX,posY": ("1,7,-70,1,2", "anchorId", "RSSI_dBm"),
    "time,mac,rssi,x,y": ("1,aa:bb:cc:00:00:01,-70,1,2", "mac", "rssi"),
}


@pytest.mark.parametrize("header", LONG)
def test_tables_with_a_row_per_reading(header: str, tmp_path: Path) -> None:
    row, receiver, strength = LONG[header]
    columns = columns_of(tmp_path, header, row)
    assert (columns.of["id"], columns.of["rssi"], columns.strengths) == (receiver, strength, {})


WIDE = {
    "X,Y,AP1 RTT(mm),AP2 RTT(mm),AP1 RSS(dBm),AP2 RSS(dBm),LOS APs": ("0,1,2204,6069,-51,-200,1 2", ["AP1", "AP2"]),
    "WAP001,WAP002,LONGITUDE,LATITUDE,FLOOR,BUILDINGID": ("100,-97,-7541.2,4864921,2,1", ["WAP001", "WAP002"]),
    "MAC1,MAC2,ECoord,NCoord,FloorID,SampleTimes": ("-60,100,1352.5,3664.5,1,20", ["MAC1", "MAC2"]),
    "'BS 1','BS 2',RX Time,SF,HDOP,Latitude,Longitude": ("-200,-110,2017-11-17,7,0.7,51.2,4.4", ["'BS 1'", "'BS 2'"]),
    "x,y,z,heading,rssi_1,rssi_kitchen,std_1": ("0,1,2,0.5,-60,-70,1.5", ["1", "kitchen"]),
    "x,y,aa:bb:cc:00:00:01,aa:bb:cc:00:00:02": ("0,1,-60,0", ["aa:bb:cc:00:00:01", "aa:bb:cc:00:00:02"]),
    "pos_x,pos_y,RSSI": ("0,1,-60", ["RSSI"]),
}


@pytest.mark.parametrize("header", WIDE)
def test_tables_with_a_column_per_receiver(header: str, tmp_path: Path) -> None:
    row, ids = WIDE[header]
    columns = columns_of(tmp_path, header, row)
    assert list(columns.strengths.values()) == ids
    assert {"x", "y"} <= set(columns.of) or {"lat", "lon"} <= set(columns.of)
    assert "id" not in columns.of


def test_further_quantities_of_receivers_are_kept(tmp_path: Path) -> None:
    header = next(iter(WIDE))
    columns = columns_of(tmp_path, header, WIDE[header][0])
    assert columns.kept == ["AP1 RTT(mm)", "AP2 RTT(mm)", "LOS APs"]


def test_stated_columns_and_patterns_replace_guesses(tmp_path: Path) -> None:
    header, row = "t,u,v,x,beacon,value", "0,1,2,3,b1,-60"
    columns = columns_of(tmp_path, header, row, "x=u,y=v,id=beacon,rssi=value,time=-")
    assert columns.of == {"x": "u", "y": "v", "id": "beacon", "rssi": "value"}
    assert columns.kept == ["t", "x"]
    columns = columns_of(tmp_path, "x,y,A [dBm],B [dBm],noise_dbm", "0,1,-60,-70,-95", receivers=("? [dBm]",))
    assert columns.strengths == {"A [dBm]": "A", "B [dBm]": "B"}


def test_units_stand_at_the_end_of_names() -> None:
    names = {"x_mm": "mm", "X (m)": "m", "AP1 RTT(mm)": "mm", "freq [MHz]": "mhz", "rssi": "", "room": "", "x_true": ""}
    assert {name: unit_of(name) for name in names} == names


@pytest.mark.parametrize(
    ("stated", "receivers", "message"),
    [
        ("x=east", (), r"line 1: no column east \(columns: x, y, p\); correct --columns"),
        ("", ("AP*",), r"no column of signal strengths among x, y, p; name it by"),
        ("", (), r"no column of signal strengths"),
        *((text, (), r"--columns: .* give MEANING=COLUMN") for text in ("place=x", "x", "x=")),
    ],
)
def test_other_columns_are_refused(stated: str, receivers: tuple[str, ...], message: str, tmp_path: Path) -> None:
    refusal(columns_of, tmp_path, "x,y,p", "0,1,55", stated, receivers, message)
