"""Units that the coordinate system in the header of a LAS or LAZ file states."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from ...core import InputError
from ..coordinates import extra_package

MODEL_KEY, GEOGRAPHIC = 1024, 2
UNIT_KEYS = (3076, 4099)
"""Keys of GeoTIFF (OGC 19-008r4) for the kind of coordinates, and the units of easting and of height."""
LINEAR = {9001: "m", 9002: "ft", 9003: "ft"}
"""Codes of EPSG for the metre, the international foot, and the US survey foot, which is longer by 2 millionths."""
WKT_UNIT = re.compile(r'(?:LENGTHUNIT|\bUNIT)\s*\[\s*"([^"]*)"', re.IGNORECASE)
WKT_HEIGHT = re.compile(r"\bVERT(?:_?CS|CRS|ICALCRS)\s*\[", re.IGNORECASE)
WKT_PROJECTED = re.compile(r"\b(?:PROJCS|PROJCRS|PROJECTEDCRS)\s*\[", re.IGNORECASE)
WKT_GEOGRAPHIC = re.compile(r"\b(?:GEOGCS|GEOGCRS|GEODCRS)\s*\[", re.IGNORECASE)


def stated_units(file: Path) -> list[str]:
    """Units that a scan's header states: m, ft or degrees, that of easting before that of height.

    Empty for other formats than LAS and LAZ, and for files without a coordinate system or with that of a bare code.
    """
    if file.suffix.lower() not in (".las", ".laz"):
        return []
    with extra_package("laspy").open(file) as source:
        records = [*source.header.vlrs, *(source.header.evlrs or [])]
    for record in records:  # where a file has both, writers of LAS 1.4 keep the keys for older readers
        if units := list(dict.fromkeys(_key_units(record))) or list(dict.fromkeys(_wkt_units(record))):
            return units
    return []


def _key_units(record: object) -> Iterator[str]:
    """Units of the keys of GeoTIFF in a record of a header."""
    keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", ()) if key.tiff_tag_location == 0}
    if keys.get(MODEL_KEY) == GEOGRAPHIC:
        yield "degrees"
    yield from (LINEAR[keys[key]] for key in UNIT_KEYS if keys.get(key) in LINEAR)


def _wkt_units(record: object) -> Iterator[str]:
    """Units of a coordinate system in well-known text (OGC 01-009, 18-010r7), each the last one of its part."""
    text = str(getattr(record, "string", ""))
    for part in WKT_HEIGHT.split(text, maxsplit=1):
        if WKT_GEOGRAPHIC.search(part) and not WKT_PROJECTED.search(part):
            yield "degrees"
            continue
        names = [name.lower() for name in WKT_UNIT.findall(part)]
        lengths = ["ft" if "f" in name else "m" for name in names if re.search(r"met(?:re|er)|foot|feet|ft", name)]
        yield from lengths[-1:]


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
