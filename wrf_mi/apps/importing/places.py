"""Positions and headings of a table's rows, also from another table, in metres and radians of one local frame."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import DataFault, InputError
from ...core.angles import FloatArray
from ...core.files import listed, one_line
from ...scene.coordinates import LATITUDE, LONGITUDE, is_geographic, local_projection
from .column_names import METRES, unit_of
from .files import Table, package
from .forms import named_columns, shown_names, suggested_columns

DEGREES = "EPSG:4326"
FAR_M = 10_000.0  # largest coordinate without a shift: single precision resolves a millimetre to 16 km
ROUND_M, ROUND_DEG = 10.0, 1e-4  # origins are rounded to these
POSITION_DIGITS = 6  # decimals of metres that are written: the mean of equal positions is not exactly theirs
FULL_TURN = 4 * np.pi  # largest heading in radians where its unit is not stated; headings may count a turn
COMPASS = ("bearing", "azimuth", "course", "compass")  # words of headings that run clockwise from north, in degrees
MOST_OUTSIDE = 0.5  # share of rows outside the time of the positions above which the times are not in one unit
GROUND, BELOW = ("g", "gf", "ground", "groundfloor", "eg", "rc"), ("b", "lg", "ug", "basement", "basementlevel")
"""Names of the ground floor, and of floors below it, which are counted downwards."""
PAIR = re.compile(
    r"\D{0,2}?([+-]?\d+(?:\.\d*)?)\s*[,;\s]\s*([+-]?\d+(?:\.\d*)?)(?:\s*[,;\s]\s*([+-]?\d+(?:\.\d*)?))?\D{0,2}"
)
"""Coordinates x, y and, if stated, z in one text, as in ``(3.5, -2.0)``."""
DATE = re.compile(r"^(\d{4})\D(\d\d)\D(\d\d)\D(\d\d)\D(\d\d)\D(\d\d)")
"""Dates with any marks, as in ``2018.05.07_18.57.10``."""
TICKS = {1e17: 1e9, 1e14: 1e6, 1e11: 1e3}
"""Ticks in a second of times since 1970, by their least number in this century: ns, us, ms."""
MOST_FLOORS = 20  # numbers of a third column without name from which it is no floor
FILE = "file"  # column of positions with the names of the files that were measured there
PLACES = ("x", "y", "z", "lat", "lon", "floor", "heading")


@dataclass(frozen=True)
class LocalFrame:
    """How coordinates of a table become metres east and north of a local origin.

    Attributes:
        crs: coordinate reference system of the table, such as EPSG:4326; "": metres of a plan after ``scale_m``.
        scale_m: metres of a unit.
        origin: coordinates of the local origin: metres, or longitude and latitude in degrees with a ``crs``.
        swapped: whether x is the latitude.
        affine: rows of the matrix [2, 3] that makes metres of pixels of a plan or of registered coordinates; (): none.
    """

    crs: str = ""
    scale_m: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    swapped: bool = False
    affine: tuple[tuple[float, float, float], ...] = ()

    @property
    def local_crs(self) -> str:
        """The projection to metres east and north of the origin (`wrf_mi.scene.coordinates.local_projection`)."""
        return local_projection(*self.origin)

    def local_m(self, xy: FloatArray) -> FloatArray:
        """Metres [n, 2] from coordinates [n, 2] of the table, NaN where unknown."""
        if self.affine:
            matrix = np.array(self.affine)
            return np.asarray(xy @ matrix[:, :2].T + matrix[:, 2])
        xy = xy[:, ::-1] if self.swapped else xy
        if not self.crs:
            return np.asarray(xy * self.scale_m - self.origin)
        return _transformed(self.crs, self.local_crs, xy * self.scale_m)

    def facts(self) -> dict[str, Any]:
        """The attributes and the projection, in plain values."""
        plain = asdict(self) | {"origin": list(self.origin), "affine": list(map(list, self.affine))}
        return plain | ({"local_crs": self.local_crs} if self.crs else {})

    @staticmethod
    def from_facts(facts: Mapping[str, Any]) -> LocalFrame:
        """The frame that `facts` states."""
        affine = tuple(map(tuple, facts.get("affine", ())))
        return LocalFrame(facts["crs"], facts["scale_m"], tuple(facts["origin"]), facts["swapped"], affine)

    def headings_rad(self, headings_rad: FloatArray) -> FloatArray:
        """Headings [n] in this frame from headings from x towards y in that of the table."""
        if not self.affine:
            return headings_rad
        ahead = np.array(self.affine)[:, :2] @ [np.cos(headings_rad), np.sin(headings_rad)]
        return np.asarray(np.arctan2(ahead[1], ahead[0]))


def _transformed(source: str, target: str, xy: FloatArray) -> FloatArray:
    pyproj = package("pyproj")
    try:
        transformer = pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        text = f"--crs: {one_line(source)!r} is no coordinate reference system ({one_line(error)})"
        raise InputError(f"{text}; give one such as EPSG:3857") from None
    return np.where(np.isfinite(xy), np.column_stack(transformer.transform(*xy.T)), np.nan)


def find_frame(xy: FloatArray, geographic: bool, unit: str, scale_m: float, crs: str) -> tuple[LocalFrame, list[str]]:
    """The frame of coordinates [n, 2], and what was assumed.

    Args:
        xy: coordinates of all rows, x or longitude first.
        geographic: whether the columns are called longitude and latitude.
        unit: unit in their names, ``deg``, or "".
        scale_m: metres of a unit.
        crs: coordinate reference system that was stated, or "".
    """
    swapped, notes = False, list[str]()
    if not crs:
        crs, swapped, notes = _guessed_crs(xy, geographic, unit if scale_m == 1 else "other")
    if crs:
        frame = _projected(xy, crs, scale_m, swapped)
        text = f"positions are projected to metres east and north of {frame.origin[0]:g}, {frame.origin[1]:g} degrees"
        return frame, [*notes, f"{text} (longitude, latitude; azimuthal equidistant)"]
    if np.abs(xy).max() * scale_m <= FAR_M:
        return LocalFrame(scale_m=scale_m), notes
    shift = np.floor(xy.min(axis=0) * scale_m / ROUND_M) * ROUND_M
    frame = LocalFrame(scale_m=scale_m, origin=(float(shift[0]), float(shift[1])))
    return frame, [*notes, f"positions are shifted by {shift[0]:.10g}, {shift[1]:.10g} m, which becomes the origin"]


def _guessed_crs(xy: FloatArray, geographic: bool, unit: str) -> tuple[str, bool, list[str]]:
    """The reference system of degrees or "", whether x is the latitude, and what was assumed."""
    largest = np.abs(xy).max(axis=0)
    if largest.max() > LONGITUDE or largest.min() > LATITUDE:
        text = "longitude and latitude are no degrees: taken for metres of a map projection; state it by --crs"
        text += " (EPSG:3857 for web maps), as its metres may be longer than those of the ground"
        return "", False, [text] if geographic else []
    swapped = bool(largest[1] > LATITUDE)
    if geographic or unit.startswith("deg"):
        return DEGREES, swapped, []
    if unit not in ("", "m") or not is_geographic(xy):
        return "", False, []
    order = "latitude, longitude" if swapped else "longitude, latitude"
    return DEGREES, swapped, [f"x and y are taken for {order} in degrees; --units m: they are metres"]


def _projected(xy: FloatArray, crs: str, scale_m: float, swapped: bool) -> LocalFrame:
    """The local frame about the middle of coordinates of a reference system."""
    middle = np.median(_transformed(crs, DEGREES, (xy[:, ::-1] if swapped else xy) * scale_m), axis=0)
    if not np.isfinite(middle).all():
        raise InputError(f"--crs: coordinates are outside {one_line(crs)}; correct it, or the columns")
    longitude, latitude = (round(round(float(angle) / ROUND_DEG) * ROUND_DEG, 4) for angle in middle)
    return LocalFrame(crs, scale_m, (longitude, latitude), swapped)


def unit_scale(unit: str, what: str) -> float:
    """Metres of a unit's name; 1 for none or degrees."""
    if unit not in METRES and unit not in ("", "deg", "degrees"):
        raise InputError(f"{what} {one_line(unit)!r} is unknown; give one of {', '.join(METRES)} or deg")
    return METRES.get(unit, 1.0)


def plane_columns(of: Mapping[str, str], table: Table) -> tuple[str, str, bool]:
    """Columns of x and y, or of longitude and latitude, and whether they are the latter.

    Raises:
        InputError: neither.
    """
    for first, second, geographic in (("x", "y", False), ("lon", "lat", True)):
        if first in of and second in of:
            return of[first], of[second], geographic
    names, pair = shown_names(list(table.frame.columns)), suggested_columns(table, of, ("x", "y"))
    remedy = f"try --columns {pair} (or lon=,lat=), or give --positions FILE"
    if not pair:
        remedy = "give --positions FILE with x,y, or --columns cell=NAME where one text has both"
    raise InputError(f"{table.files[0][0]}: no columns of positions among {names}; {remedy}")


def finite_columns(table: Table, names: Sequence[str]) -> FloatArray:
    """Numbers [rows, columns]; an `InputError` for an empty field."""
    values = np.column_stack([table.numbers(name) for name in names])
    if len(empty := np.argwhere(~np.isfinite(values))):
        row, column = (int(index) for index in empty[0])
        raise table.fault(f"{one_line(names[column])} is empty or infinite; give a number, or remove the row", row)
    return values


def floor_numbers(table: Table, column: str) -> FloatArray:
    """Numbers of floors [rows] from numbers or names: B1 (below the ground), G, F2, L-2, Level 3.

    Where floors below the ground are named and none is 0, the first floor (F1) is the one above B1.

    Raises:
        InputError: a name without a number, or names whose order is not known (F1, P1).
    """
    if table.is_numeric(column):
        return finite_columns(table, [column])[:, 0]
    names = table.frame[column].astype(str).str.strip()
    # A minus between a word and its number joins them (L-2); before a number alone it is a sign (floor -1).
    parts = names.str.extract(r"^([A-Za-z .]*?)[\s_.]*(?:(?<=[A-Za-z])-)?(-?\d*)\.?$").fillna("")
    words = parts[0].str.lower().str.replace(r"[\s.]", "", regex=True)
    is_ground = words.isin(GROUND) & (parts[1] == "")
    is_below = words.isin(BELOW)
    kinds = set(words[~is_ground & ~is_below])
    wrong = (parts[1].isin(("", "-")) & ~is_ground) | (~is_ground & ~is_below if len(kinds) > 1 else False)
    if wrong.any():
        row = int(np.argmax(wrong))
        text = f"{one_line(column)} is {names.iloc[row][:40]!r}" + ", beside other kinds of names" * (len(kinds) > 1)
        raise table.fault(f"{text}; give its number, or leave the column out by --columns floor=-", row)
    numbers = parts[1].where(~is_ground, "0").astype(float).to_numpy(float)
    numbers = np.where(is_below, -np.abs(numbers), numbers)
    if is_below.any() and not (numbers == 0).any():
        numbers = numbers - (numbers > 0)
    return np.asarray(numbers)


def headings_rad(values: FloatArray, name: str, unit: str) -> tuple[FloatArray, str]:
    """Headings from +x towards +y in radians, and what they are taken for.

    ``unit`` is ``deg``, ``rad``, ``compass`` (degrees clockwise from north), or "" to go by the name and the range.
    """
    unit = unit or ("rad" if unit_of(name) == "rad" else _heading_unit(values, name))
    words = {"compass": "degrees clockwise from north", "deg": "degrees from x towards y", "rad": "radians"}
    if unit not in words:
        raise InputError(f"--heading-unit {one_line(unit)!r} is unknown; give one of {', '.join(words)}")
    if unit == "compass":
        values = 90 - values
    return (values if unit == "rad" else np.radians(values)), words[unit]


def _heading_unit(values: FloatArray, name: str) -> str:
    if not unit_of(name).startswith("deg") and np.abs(values).max() <= FULL_TURN:
        return "rad"
    return "compass" if any(word in name.lower() for word in COMPASS) else "deg"


def place_numbers(keys: Mapping[str, Any], xy_m: FloatArray, place_m: float) -> NDArray[np.int64]:
    """Number of the place [n] of rows with equal ``keys`` and position, in the order of first appearance.

    Positions are equal exactly, or with ``place_m`` above 0 if they are in the same square of that side.
    """
    pandas = package("pandas")
    cells = np.round(xy_m / place_m) if place_m > 0 else xy_m + 0.0  # + 0.0: -0 is 0
    frame = pandas.DataFrame({"x": cells[:, 0], "y": cells[:, 1], **keys})
    return np.asarray(frame.groupby(list(frame.columns), sort=False, dropna=False).ngroup(), np.int64)


def with_positions(values: Table, positions: Table, stated: Mapping[str, str]) -> tuple[Table, str]:
    """A table with the columns of another one that has the positions of its rows, and how they were matched.

    Rows are matched by a column that both tables have (a point's number) or ``file``, the name of their file, by time,
    between whose entries positions are linear, or else by their order, in tables of equal length.

    Raises:
        InputError: the rows cannot be matched.
    """
    positions = _with_names(positions, stated)
    if FILE in positions.frame and FILE not in values.frame:  # a place for each file
        path = values.files[0][0]
        file_names = positions.frame[FILE].astype(str).str.strip()
        named = path.name if (file_names == path.name).any() else path.stem
        if not (file_names == named).any():
            text = f"no row has {FILE} {one_line(path.name)} ({one_line(listed(file_names))})"
            raise DataFault(positions.files[0][0], f"{text}; give a row for each file")
        values = replace(values, frame=values.frame.assign(**{FILE: named}))
    in_values, in_positions = list(values.frame.columns), list(positions.frame.columns)
    of = named_columns(in_positions, {key: name for key, name in stated.items() if name in in_positions})
    new = list(filter(None, map(of.get, PLACES)))
    time, other_time = named_columns(in_values, {}).get("time"), of.get("time")
    if not {"x", "y"} <= of.keys() and not {"lon", "lat"} <= of.keys():
        plane_columns(of, positions)
    shared = sorted(set(in_positions) & set(in_values) - {*new, time, other_time}, key=in_positions.index)
    shared = shared if values.has_header and positions.has_header else []
    is_path = time and other_time and shared and positions.frame[shared[0]].duplicated().any()
    if shared and not is_path:
        return _looked_up(values, positions, shared[0], new), f"by the column {one_line(shared[0])}"
    if not time or not other_time:
        return _row_by_row(values, positions, new), "row by row"
    if not is_path:
        return _interpolated(values, time, positions, other_time, new)
    # Paths of several devices: each at its own times.
    key = shared[0]
    if lacking := set(values.frame[key]) - set(positions.frame[key]):
        raise DataFault(positions.files[0][0], f"no row has {one_line(key)} {one_line(lacking.pop())}; give its path")
    paths = positions.frame.groupby(key)
    pairs = [(rows, paths.get_group(name)) for (name,), rows in values.frame.groupby([key])]
    frames = [
        _interpolated(replace(values, frame=rows), time, replace(positions, frame=path), other_time, new)[0].frame
        for rows, path in pairs
    ]
    frame = package("pandas").concat(frames).sort_index(kind="stable")
    return replace(values, frame=frame), f"by time, linear between positions of one {one_line(key)}"


def _row_by_row(values: Table, positions: Table, new: Sequence[str]) -> Table:
    if len(values) != len(positions):
        text = f"{len(positions)} rows for {len(values)} of {values.files[0][0].name}, and no column that both have"
        remedy = "give a position for each row, or a column time or point in both (KITTI: times.txt beside the poses)"
        raise DataFault(positions.files[0][0], f"{text}; {remedy}")
    free = values.frame.rename(columns={name: f"value_{name}" for name in values.frame if name in new})
    return replace(values, frame=package("pandas").concat([free, positions.frame[new]], axis=1))


def _with_names(positions: Table, column_of: Mapping[str, str]) -> Table:
    """Columns of a file without header that are not stated: x, y, and a third one that is the floor or z."""
    columns = list(positions.frame.columns)
    if positions.has_header or len(columns) not in (2, 3) or set(columns) & set(column_of.values()):
        return positions
    names = ["x", "y"]
    if len(columns) == 3:
        third = positions.numbers("3")
        is_floor = bool((third == np.round(third)).all()) and len(np.unique(third)) <= MOST_FLOORS
        names.append("floor" if is_floor else "z")
    return replace(positions, frame=positions.frame.set_axis(names, axis=1), has_header=True)


def _looked_up(values: Table, positions: Table, key: str, new: Sequence[str]) -> Table:
    table = positions.frame[[key, *new]].drop_duplicates()
    if len(twice := table[table[key].duplicated()]):
        text = f"{one_line(key)} {one_line(twice[key].iloc[0])} has two positions; give one row for each"
        raise DataFault(positions.files[0][0], text)
    frame = values.frame.drop(columns=[name for name in new if name in values.frame]).merge(table, "left", on=key)
    return replace(values, frame=frame)


def _interpolated(values: Table, time: str, positions: Table, other: str, new: Sequence[str]) -> tuple[Table, str]:
    at, position_times = (times / ticks(times) for times in (seconds(values, time), seconds(positions, other)))
    within = (at >= np.nanmin(position_times)) & (at <= np.nanmax(position_times))
    outside = len(at) - np.count_nonzero(within)
    if outside > MOST_OUTSIDE * len(at):
        what = f"its time is outside those of {positions.files[0][0].name}, as those of {outside} rows are"
        raise values.fault(f"{what}; give both in one unit and time zone", int(np.argmin(within)))
    order = np.argsort(position_times, kind="stable")
    columns = {name: np.interp(at, position_times[order], positions.numbers(name)[order]) for name in new}
    text = f"; {outside} rows before or after them are left out" if outside else ""
    return replace(values, frame=values.frame.assign(**columns)[within]), f"by time, linear between positions{text}"


def ticks(times: FloatArray) -> float:
    """Ticks in a second of times [n]."""
    largest = float(np.nanmax(np.abs(times), initial=0.0))
    return next((count for least, count in TICKS.items() if largest > least), 1.0)


def with_cells(table: Table, column: str) -> Table:
    """A table with the columns x, y, and z if stated, from the coordinates in a column's texts, ``(3.5, -2.0)``."""
    if column not in table.frame:
        raise DataFault(table.files[0][0], f"no column {one_line(column)}; correct --columns", line=1)
    texts = table.frame[column].astype(str).str.strip()
    parts = texts.str.extract(f"^{PAIR.pattern}$").astype(float)
    if (wrong := parts[1].isna().to_numpy()).any():
        row = int(np.argmax(wrong))
        raise table.fault(f"{one_line(column)} is {texts.iloc[row][:40]!r}; give a text such as (3.5, 2.0)", row)
    names = ["x", "y", "z"][: 3 if parts[2].notna().all() else 2]
    return replace(table, frame=table.frame.assign(**{name: parts[k] for k, name in enumerate(names)}))


def seconds(table: Table, column: str, may_be_empty: bool = False) -> FloatArray:
    """Times of a column in its unit, or in seconds where they are dates; NaN where they are empty and may be so."""
    if table.is_numeric(column):
        return table.numbers(column)
    pandas = package("pandas")
    texts = table.frame[column].astype("string").str.replace(DATE, r"\1-\2-\3 \4:\5:\6", regex=True)
    times = pandas.to_datetime(texts, errors="coerce", format="mixed", utc=True)
    empty = texts.isna().to_numpy(bool)
    if len(wrong := np.flatnonzero(times.isna().to_numpy() & ~(empty & may_be_empty))):
        text = f"{one_line(column)} is {str(table.frame[column].iloc[wrong[0]])[:40]!r}"
        raise table.fault(f"{text}; give a time as a number or an ISO date", int(wrong[0]))
    return np.asarray((times - pandas.Timestamp(0, tz="UTC")).dt.total_seconds().to_numpy(float))
