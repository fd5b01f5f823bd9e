"""Units that the coordinate system in the header of a LAS or LAZ file states."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...core import InputError
from ..coordinates import extra_package

MODEL_KEY, GEOGRAPHIC = 1024, 2
UNIT_KEYS = (3076, 4099)
"""Keys of GeoTIFF (OGC 19-008r4) for the kind of coordinates, and the units of easting and of height."""
LINEAR = {9001: "m", 9002: "ft", 9003: "ft"}
"""Codes of EPSG for the metre, the international foot, and the US survey foot, which is longer by 2 millionths."""
UNITS = {"metre": "m", "degree": "degrees", "foot": "ft", "US survey foot": "ft"}  # by their names in EPSG


def stated_units(file: Path) -> list[str]:
    """Units that a scan's header states: m, ft or degrees, that of easting before that of height.

    Empty for other formats than LAS and LAZ, and for files without a coordinate system.
    """
    if file.suffix.lower() not in (".las", ".laz"):
        return []
    with extra_package("laspy").open(file) as source:
        records = [*source.header.vlrs, *(source.header.evlrs or [])]
    for record in records:  # where a file has both, writers of LAS 1.4 keep the keys for older readers
        if units := list(dict.fromkeys(_key_units(record))) or list(dict.fromkeys(_system_units(record))):
            return units
    return []


def _key_units(record: object) -> Iterator[str]:
    """Units of the keys of GeoTIFF in a record of a header."""
    keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", ()) if key.tiff_tag_location == 0}
    if keys.get(MODEL_KEY) == GEOGRAPHIC:
        yield "degrees"
    yield from (LINEAR[keys[key]] for key in UNIT_KEYS if keys.get(key) in LINEAR)


def _system_units(record: Any) -> Iterator[str]:
    """Units of the axes of a coordinate system, in well-known text or by its code, in a record of a header."""
    if not hasattr(record, "parse_crs"):
        return
    with suppress(extra_package("pyproj").exceptions.CRSError):
        system = record.parse_crs()
        yield from (UNITS[axis.unit_name] for axis in (system.axis_info if system else ()) if axis.unit_name in UNITS)


def require_stated_metres(files: Sequence[Path], units: str | None) -> None:
    """Refuse (`InputError`) scans for which no units are given and whose headers state others than metres."""
    for file in files if units is None else ():
        if (file_units := stated_units(file)) and file_units != ["m"]:
            raise InputError(f"{file}: {units_text(file_units)}; {units_remedy(file_units)}")


def units_text(units: list[str]) -> str:
    """Statement of a header in words."""
    return f"its coordinate system is in {' and heights in '.join(units)}"


def units_remedy(units: list[str]) -> str:
    """What to do about units that are not those of the reader."""
    if len(units) == 1 and units[0] != "degrees":
        return f"state --units {units[0]}, or the right one"
    return "export it in a projected coordinate system in metres, or state its --units if the header is wrong"
