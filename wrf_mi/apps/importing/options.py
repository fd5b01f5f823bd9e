"""Options of the import of tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...core import InputError
from ...core.files import one_line
from ...datasets.ble_folder import TAG_HEIGHT_M

AVERAGES = ("db", "mw")
UP = ("", "z", "y", "-y")
NAMES = {"min_heard": "min-rows", "heading": "heading-unit"}


def option_name(attribute: str) -> str:
    """Option of ``wrf-mi data import`` for an attribute of `ImportOptions`."""
    return f"--{NAMES.get(attribute) or attribute.removesuffix('_m').removesuffix('_hz').replace('_', '-')}"


@dataclass(frozen=True)
class ImportOptions:
    """Options of `import_measurements`, by default guessed from the tables.

    Attributes:
        columns: columns by meaning (x, y, z, lat, lon, floor, heading, time, seen, run, split, frequency, id, rssi, or
            cell, whose texts are coordinates, as (3.5, 2.0)), a mapping or text such as ``"x=X,y=Y"``; the name ``-``:
            there is none.
        sheet: name of the sheet of workbooks with several.
        receivers: patterns of the columns of strengths of a wide table, such as ``"AP* RSS(dBm)"``.
        test: files with the test rows.
        positions: files with the positions of the rows, one for each file (test files last) or one for all.
        anchors: file with the positions of the receivers, or None.
        where: texts of columns; rows with other ones are left out.
        not_heard: numbers for what was not heard; None: found.
        average: mean of the readings of a place, ``db`` or ``mw``.
        place_m: side of the squares whose readings are averaged; 0: those of one exact position.
        units: unit of positions, m, mm, cm, km, ft, deg or px; "": by the names of the columns, or metres.
        plan: picture, or YAML of a ROS map, in whose pixels positions are (``units`` px).
        resolution_m: side of its pixels; 0: that of the YAML.
        origin_m: point of the plan, metres from its lower left corner, that becomes the origin, as of ``wrf-mi mesh``.
        register_pairs: file with ``x,y,to_x,to_y``, coordinates of the tables and metres; None: they are not moved.
        up: axis that is up in trajectories of ``positions``: z, y or -y (a camera's frame); "": by their form.
        pitch_m: metres of a step of positions that are indices of a grid; 0: they are none.
        crs: coordinate reference system of the positions, such as EPSG:3857.
        heading: unit of headings: rad, deg, or compass (degrees clockwise from north).
        height_m: height of the moving end without z: one for all tables, or one for each, those of ``test`` last.
        storey_m: height of a storey, where rows have a floor and no z.
        anchor_height_m: height of receivers without z.
        frequency_hz: carrier of all rows; 0: that of the table, or 2.44 GHz.
        min_heard: training rows in which a receiver was heard at least; others are left out.
    """

    columns: Mapping[str, str] | str = field(default_factory=dict)
    sheet: str = ""
    receivers: Sequence[str] = ()
    test: Sequence[str | Path] = ()
    positions: Sequence[str | Path] = ()
    anchors: str | Path | None = None
    where: Mapping[str, str] = field(default_factory=dict)
    not_heard: Sequence[float] | None = None
    average: str = "db"
    place_m: float = 0.0
    units: str = ""
    plan: str | Path | None = None
    resolution_m: float = 0.0
    origin_m: Sequence[float] = ()
    register_pairs: str | Path | None = None
    up: str = ""
    pitch_m: float = 0.0
    crs: str = ""
    heading: str = ""
    height_m: float | Sequence[float] = TAG_HEIGHT_M
    storey_m: float = 3.0
    anchor_height_m: float = 2.5
    frequency_hz: float = 0.0
    min_heard: int = 1

    def __post_init__(self) -> None:
        if self.average not in AVERAGES:
            raise InputError(f"--average {one_line(self.average)!r} is unknown; give one of {', '.join(AVERAGES)}")
        if self.up not in UP:
            raise InputError(
                f"--up {one_line(self.up)!r} is unknown; give --up=z, --up=y or --up=-y (a camera's frame)"
            )
        for name in ("place_m", "pitch_m", "resolution_m", "frequency_hz", "min_heard"):
            if not 0 <= float(getattr(self, name)) < np.inf:
                raise InputError(f"{option_name(name)} {getattr(self, name)}: give a number above 0")
