"""Files of survey programs: columns and lines by which they are recognised, and their meaning.

A further program is an entry in `PROGRAMS`, `EVENT_LOGS` or `HEADERLESS`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

Frame = Any  # pandas.DataFrame, which is imported where it is used

MAC = re.compile(r"(?:[0-9a-f]{2}[:_-]){5}[0-9a-f]{2}", re.IGNORECASE)
RADIOS = frozenset({"wifi", "ble", "bt", "bluetooth", "gsm", "cdma", "wcdma", "umts", "tdscdma", "lte", "nr", "5g"})
"""Values of a column of kinds of radio, in small letters."""
ROLES = frozenset({"ap", "client", "station", "probe"})
"""Values of a column of what sent in Wi-Fi."""
CELL_PARTS = {"mcc": "mcc", "net": "net|mnc", "area": "area|lac|tac", "cell": "cell|cellid|cid|ci|eci"}
"""Names of the columns that identify a cell together: country, network, area and number."""
FLOOR_NAME = "floor_name"  # column of the floor that the head of a log states
CELL = "network-area-cell"  # column of the identity that `CELL_PARTS` make
UNIT_LENGTH = 1e-3  # largest deviation of quaternions and rotations from length 1: files round to six decimals


@dataclass(frozen=True)
class Program:
    """Table of a survey program.

    Attributes:
        name: name of the program.
        has: names of columns that tell its tables, in small letters without blanks and marks.
        columns: columns by meaning, where their names do not tell it.
        renamed: new names of columns by a pattern of the former ones; a number is that of the slot of a cell.
        unknown: number that stands for an unknown strength, by column.
        free: column of texts that may have the separator in them, without quotes.
    """

    name: str
    has: str
    columns: Mapping[str, str] = field(default_factory=dict)
    renamed: Mapping[str, str] = field(default_factory=dict)
    unknown: Mapping[str, float] = field(default_factory=dict)
    free: str = ""

    def new_name(self, name: str) -> str:
        """Name of a column after `renamed`."""
        for pattern, new in self.renamed.items():
            if match := re.fullmatch(pattern, name, re.IGNORECASE):
                return match.expand(new)
        return name


SLOTS = {"id": "PCI", "rssi": "RSRP"}
GNETTRACK = {r"PSC|PCI": "PCI 0", "Level": "RSRP 0", r"NRxLev(\d)": r"RSRP \1"}
"""The serving cell is slot 0. Its physical identity is what neighbours have, too, which state no other one in LTE."""
PROGRAMS = (
    Program("G-NetTrack", "level ncell1 nrxlev1", SLOTS, GNETTRACK | {r"NCell(\d)": r"PCI \1"}),
    Program("G-NetTrack", "level ncellid1 nrxlev1", SLOTS, GNETTRACK | {r"NCellid(\d)": r"PCI \1"}),
    Program(
        "Nemo",
        "rsrpltedetected1 physicalcellidentityltedetected1",
        {"id": "Physical cell identity", "rssi": "RSRP"},
        {r"(.+) \(LTE pcell\)": r"\1 - 0", r"(.+) \(LTE detected\) - (\d+)": r"\1 - \2"},
    ),
    Program(
        "airodump-ng",
        "bssid power firsttimeseen beacons",
        {"id": "BSSID", "rssi": "Power", "time": "Last time seen"},
        unknown={"Power": -1},
        free="ESSID",
    ),
    Program(
        "airodump-ng",
        "stationmac power firsttimeseen probedessids",
        {"id": "Station MAC", "rssi": "Power", "time": "Last time seen"},
        unknown={"Power": -1},
        free="Probed ESSIDs",
    ),
    Program("airodump-ng", "bssid power localtime gpstime", {"time": "GPSTime"}, unknown={"Power": -1}, free="ESSID"),
    Program("WiFiAnalyzer", "timestamp ssid bssid strength primaryfrequency", free="SSID"),
    Program("Vistumbler", "bssid signal rssi highrssi", {"id": "BSSID", "rssi": "RSSI"}),
    Program(
        "Bermuda",
        "scanneraddress rssi deviceaddress",
        {"id": "scanner_address", "rssi": "rssi", "run": "device_address"},
    ),
    Program("wifi-heatmapper", "bssid rssi signalstrength", {"id": "bssid", "rssi": "rssi"}),
    Program("ESPresense", "node device rssi", {"id": "node", "rssi": "rssi", "run": "device"}),
)
"""In the order of trial."""


def plain_name(name: str) -> str:
    """A name in small letters without blanks and marks."""
    return re.sub("[^a-z0-9]", "", name.lower())


def program_of(names: list[str]) -> Program | None:
    """The program whose columns are among these."""
    plain = set(map(plain_name, names))
    return next((program for program in PROGRAMS if set(program.has.split()) <= plain), None)


def cell_parts(names: list[str]) -> list[str]:
    """Columns that identify a cell together; none without an area of a network and a cell."""
    parts = {
        part: next((name for name in names if plain_name(name) in words.split("|")), None)
        for part, words in CELL_PARTS.items()
    }
    of_network = parts["area"] and (parts["net"] or plain_name(parts["area"]) != "area")
    return [name for name in parts.values() if name] if of_network and parts["cell"] else []


@dataclass(frozen=True)
class Headerless:
    """Table without header.

    Attributes:
        name: name of the form.
        columns: names of its columns.
        fits: whether the fields [rows, columns] are of this form.
    """

    name: str
    columns: tuple[str, ...]
    fits: Callable[[Frame], bool]


def _is_pose(frame: Frame) -> bool:
    return bool(np.allclose(np.linalg.norm(frame.iloc[:, 4:].to_numpy(float), axis=1), 1, atol=UNIT_LENGTH))


def _is_matrix(frame: Frame) -> bool:
    rotations = frame.to_numpy(float).reshape(-1, 3, 4)[:, :, :3]
    return bool(np.allclose(rotations @ rotations.transpose(0, 2, 1), np.eye(3), atol=UNIT_LENGTH))


QUATERNION = ("qx", "qy", "qz", "qw")
MATRIX = tuple(f"r{row}{column}" for row in range(3) for column in range(3))
HEADERLESS = (
    Headerless(
        "OpenCellID",
        (
            *("radio", "mcc", "net", "area", "cell", "unit", "lon", "lat", "range", "samples", "changeable", "created"),
            *("updated", "averageSignal"),
        ),
        lambda frame: set(frame.iloc[:, 0].astype(str).str.lower()) <= RADIOS,
    ),
    Headerless("TUM", ("time", "x", "y", "z", *QUATERNION), _is_pose),
    Headerless("KITTI", (*MATRIX[:3], "x", *MATRIX[3:6], "y", *MATRIX[6:], "z"), _is_matrix),
)
"""Trajectories of TUM: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats; of KITTI: rows of the matrix
[3, 4] of the left camera's pose."""
POSE_NAMES = {"timestamp": "time", "tx": "x", "ty": "y", "tz": "z"}
"""Names in the comment above a trajectory of TUM."""


def headerless_form(frame: Frame) -> Headerless | None:
    """The form without header that a table of numbers and words has."""
    for form in HEADERLESS:
        if len(form.columns) == frame.shape[1]:
            try:
                fits = form.fits(frame)
            except ValueError:  # words where the form has numbers
                fits = False
            if fits:
                return form
    return None


@dataclass(frozen=True)
class EventLog:
    """Log whose lines are events of several kinds, positions and readings among them.

    Attributes:
        separator: separator of the fields.
        kind: number of the field with the kind, from 0.
        time: number of the field with the time.
        radios: kind of radio of the kinds of readings.
        fields: fields by column, of each kind; a tuple of fields is one identity.
        floor: pattern of the name of the floor in the comments.
        start: pattern of the start of a line, which some phones write without ending the line before.
    """

    separator: str
    kind: int
    time: int
    radios: Mapping[str, str]
    fields: Mapping[str, Mapping[str, int | tuple[int, ...]]]
    floor: str = "(?!)"
    start: str = "(?!)"


EVENT_LOGS = (
    EventLog(
        "\t",
        kind=1,
        time=0,
        radios={"TYPE_WIFI": "WIFI", "TYPE_BEACON": "BLE"},
        fields={
            "TYPE_WAYPOINT": {"x": 2, "y": 3},
            "TYPE_WIFI": {"ssid": 2, "bssid": 3, "rssi": 4, "frequency_mhz": 5, "last_seen": 6},
            "TYPE_BEACON": {"bssid": (2, 3, 4), "rssi": 6},
        },
        floor=r"FloorName:(\S+)",
        start=r"\d{13}\tTYPE_",
    ),
    EventLog(
        ";",
        kind=0,
        time=1,
        radios={"WIFI": "WIFI"},
        fields={"POSI": {"lat": 3, "lon": 4, "floor": 5}, "WIFI": {"ssid": 3, "bssid": 4, "rssi": -1}},
    ),
)
"""Logs of the Indoor Location Competition 2.0, and of the IPIN competitions, whose WIFI has a frequency or not."""
MQTT = re.compile(r"(?:(?P<time>\S+)\s+)?espresense/devices/(?P<device>[^/\s]+)/(?P<node>\S+)\s+(?P<payload>\{.*\})\s*")
"""A line of ``mosquitto_sub -F '%U %t %p' -t 'espresense/devices/#'``: time, topic and payload."""
