"""Positions and headings of tables in metres and radians of one local frame, and rows that share a place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import one_line
from .columns import METRES, shown_names, unit_of
from .files import Table, package

DEGREES = "EPSG:4326"
FAR_M = 10_000.0
"""Largest coordinate without a shift: single precision resolves a millimetre to 16 km."""
ROUND_M, ROUND_DEG = 10.0, 1e-4
"""Origins are rounded to these."""
POSITION_DIGITS = 6
"""Decimals of metres that are written: the mean of equal positions is not exactly theirs."""
WIDEST_DEG, AWAY = 1.0, 20.0
"""Largest extent of a place in degrees, and its least distance from the origin in extents, where x and y are not called
longitude and latitude: a room in metres is not a metre wide and twenty metres away."""
FULL_TURN = 4 * np.pi
"""Largest heading in radians where its unit is not stated; headings may count a turn."""
COMPASS = ("bearing", "azimuth", "course", "compass")
"""Words of headings that run clockwise from north, in degrees."""


@dataclass(frozen=True)
class LocalFrame:
    """How coordinates of a table become metres east and north of a local origin.

    Attributes:
        crs: coordinate reference system of the table, such as EPSG:4326; "": metres of a plan after ``scale_m``.
        scale_m: metres of a unit.
        origin: coordinates of the local origin: metres, or longitude and latitude in degrees with a ``crs``.
        swapped: whether x is the latitude.
    """

    crs: str = ""
    scale_m: float = 1.0
    origin: tuple[float, float] = (0.0, 0.0)
    swapped: bool = False

    @property
    def local_crs(self) -> str:
        """The azimuthal equidistant projection about the origin, in which distances from the origin are exact."""
        return f"+proj=aeqd +lon_0={self.origin[0]:.10g} +lat_0={self.origin[1]:.10g} +datum=WGS84 +units=m"

    def local_m(self, xy: FloatArray) -> FloatArray:
        """Metres [n, 2] from coordinates [n, 2] of the table, NaN where unknown."""
        xy = xy[:, ::-1] if self.swapped else xy
        if not self.crs:
            return np.asarray(xy * self.scale_m - self.origin)
        return _transformed(self.crs, self.local_crs, xy * self.scale_m)

    def facts(self) -> dict[str, Any]:
        """The attributes and the projection, in plain values."""
        return asdict(self) | {"origin": list(self.origin)} | ({"local_crs": self.local_crs} if self.crs else {})


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
    if largest.max() > 180 or largest.min() > 90:
        text = "longitude and latitude are no degrees: taken for metres of a map projection; state it by --crs"
        text += " (EPSG:3857 for web maps), as its metres may be longer than those of the ground"
        return "", False, [text] if geographic else []
    swapped = bool(largest[1] > 90)
    if geographic or unit.startswith("deg"):
        return DEGREES, swapped, []
    if unit not in ("", "m") or not _is_fine(xy):
        return "", False, []
    order = "latitude, longitude" if swapped else "longitude, latitude"
    return DEGREES, swapped, [f"x and y are taken for {order} in degrees; --units m: they are metres"]


def _is_fine(xy: FloatArray) -> bool:
    """Whether coordinates in the range of degrees are those of a place on the globe rather than of a room."""
    extent = float(np.ptp(xy, axis=0).max())
    return 0 < extent <= WIDEST_DEG and bool(np.abs(xy).max() >= AWAY * extent)


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
    names = shown_names(list(table.frame.columns))
    remedy = "name them by --columns x=...,y=... or lon=...,lat=..., or give --positions FILE"
    raise InputError(f"{table.files[0][0]}: no columns of positions among {names}; {remedy}")


def finite_columns(table: Table, names: Sequence[str]) -> FloatArray:
    """Numbers [rows, columns]; an `InputError` for an empty field."""
    values = np.column_stack([table.numbers(name) for name in names])
    if len(empty := np.argwhere(~np.isfinite(values))):
        row, column = (int(index) for index in empty[0])
        raise table.fault(f"{one_line(names[column])} is empty or infinite; give a number, or remove the row", row)
    return values


def floor_numbers(table: Table, column: str) -> FloatArray:
    """Numbers of floors [rows], also of those that are called L2; an `InputError` for a name without a number."""
    if table.is_numeric(column):
        return finite_columns(table, [column])[:, 0]
    numbers = table.frame[column].astype(str).str.extract(r"(-?\d+)")[0].astype(float).to_numpy()
    if (wrong := np.isnan(numbers)).any():
        row = int(np.argmax(wrong))
        text = f"{one_line(column)} is {str(table.frame[column].iloc[row])[:40]!r}; give its number"
        raise table.fault(f"{text}, or leave the column out by --columns floor=-", row)
    return np.asarray(numbers)


def headings_rad(values: FloatArray, name: str, unit: str) -> tuple[FloatArray, str]:
    """Headings from +x towards +y in radians, and what they are taken for.

    ``unit`` is ``deg``, ``rad``, ``compass`` (degrees clockwise from north), or "" to go by the name and the range.
    """
    if not unit:
        in_degrees = unit_of(name).startswith("deg") or bool(np.abs(values).max() > FULL_TURN)
        is_compass = in_degrees and any(word in name.lower() for word in COMPASS)
        unit = "compass" if is_compass else "deg" if in_degrees else "rad"
    words = {"compass": "degrees clockwise from north", "deg": "degrees from x towards y", "rad": "radians"}
    if unit not in words:
        raise InputError(f"--heading {one_line(unit)!r} is unknown; give one of {', '.join(words)}")
    if unit == "compass":
        values = 90 - values
    return (values if unit == "rad" else np.radians(values)), words[unit]


def place_numbers(keys: Mapping[str, Any], xy_m: FloatArray, place_m: float) -> NDArray[np.int64]:
    """Number of the place [n] of rows with equal ``keys`` and position, in the order of first appearance.

    Positions are equal exactly, or with ``place_m`` above 0 if they are in the same square of that side.
    """
    pandas = package("pandas")
    cells = np.round(xy_m / place_m) if place_m > 0 else xy_m + 0.0  # + 0.0: -0 is 0
    frame = pandas.DataFrame({"x": cells[:, 0], "y": cells[:, 1], **keys})
    return np.asarray(frame.groupby(list(frame.columns), sort=False, dropna=False).ngroup(), np.int64)
