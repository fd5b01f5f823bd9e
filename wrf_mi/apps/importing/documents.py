"""Readings in nested documents (JSON, YAML), in lines of MQTT and in event logs, as tables."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ...core import DataFault
from ...core.files import one_line
from ...core.yaml_files import read_yaml
from ...datasets.unknown import SENT, STRENGTH, name_words
from .programs import EVENT_LOGS, FLOOR_NAME, MAC, MQTT, EventLog

POINTS = frozenset({"point", "position", "location", "coordinates", "coord", "coords", "xy", "xyz", "pos", "geometry"})
"""Names of lists that hold x, y and, if stated, z, and of objects that name them."""
FIRST_MESSAGES, FIRST_EVENTS = 50, 20_000
"""Lines in which a reading of MQTT is looked for, and a position or reading among those of a phone's other sensors."""
IMAGE = re.compile(r".+\.(?:png|jpe?g|gif|bmp|svg|webp)", re.IGNORECASE)
IMAGE_WORDS = frozenset({"image", "plan", "floorplan", "map", "background", "picture"})
ADDRESS = re.compile(f"{MAC.pattern}.*", re.IGNORECASE)
Row = dict[str, Any]


def read_document(path: Path, text: str) -> tuple[list[Row], str]:
    """Rows of a document, one for each reading, or else for each point, and the picture that it names, or "".

    A row has the fields of its object and those of the objects around it; a name that both have belongs to the inner
    one. Objects in a mapping by name or address have this name as the field ``key``.

    Raises:
        InputError: text that is no JSON or YAML, or without readings and points.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        content: Any = read_yaml(path)
    else:
        try:
            content = json.loads(text)
        except (json.JSONDecodeError, RecursionError) as error:
            lines = [line for line in text.splitlines() if line.strip()]
            try:
                content = [json.loads(line) for line in lines]
            except json.JSONDecodeError:
                raise DataFault(path, f"no JSON ({one_line(error)}); export the survey again") from None
    try:
        rows, image = list(_rows(content, {}, _is_reading)) or list(_rows(content, {}, _is_point)), _image(content)
    except RecursionError:
        raise DataFault(path, "objects within objects without end; export the survey again") from None
    if not rows:
        text = "no object with a strength (rssi, level, dbm) or with x and y"
        remedy = "write its points as a table with a row for each reading and --columns x=x,y=y,id=bssid,rssi=rssi"
        raise DataFault(path, f"{text}; {remedy}")
    return rows, image


def _rows(node: Any, around: Row, is_row: Any) -> Iterator[Row]:
    """Rows of the innermost objects that are ones."""
    if isinstance(node, list):
        for item in node:
            yield from _rows(item, around, is_row)
    if not isinstance(node, dict):
        return
    if node and all(ADDRESS.fullmatch(str(key)) and isinstance(value, int | float) for key, value in node.items()):
        yield from (around | {"bssid": key, "rssi": value} for key, value in node.items())
        return
    if _is_mapping(node):
        for key, value in node.items():
            name = "bssid" if MAC.fullmatch(str(key)) and "bssid" not in around else "key"
            yield from _rows(value, around | {name: key}, is_row)
        return
    node_fields: Row = around | _point(node)
    for name, value in node.items():
        if not isinstance(value, dict | list):
            node_fields[str(name)] = value
    outer = {name: value for name, value in node_fields.items() if not _is_reading({name: value})}
    inner = [row for name, value in node.items() for row in _rows(_named_values(name, value), outer, is_row)]
    yield from inner or ([node_fields] if is_row(node) else [])


def _point(node: Mapping[Any, Any]) -> Row:
    """Coordinates that an object has in a list or an object of their own."""
    fields: Row = {}
    for name, value in node.items():
        if str(name).lower() in POINTS and isinstance(value, list) and _are_numbers(value):
            fields |= dict(zip("xyz", value, strict=False))
        elif str(name).lower() in POINTS and isinstance(value, dict):
            fields |= {str(key): part for key, part in value.items() if isinstance(part, int | float)} | _point(value)
    return fields


def _named_values(name: Any, value: Any) -> Any:
    """Objects with ``rssi`` from a list ``rssi`` of objects with a ``value`` each, or an object of receivers."""
    words = name_words(str(name))
    if not words & STRENGTH or words & SENT:
        return value
    if isinstance(value, dict) and value and all(isinstance(dbm, int | float) for dbm in value.values()):
        return [{"receiver": key, "rssi": dbm} for key, dbm in value.items()]
    if isinstance(value, list) and all(isinstance(item, dict) for item in value):
        return [{("rssi" if key == "value" else key): part for key, part in item.items()} for item in value]
    return value


def _is_mapping(node: Mapping[Any, Any]) -> bool:
    """Whether keys name objects of one kind, rather than parts of one object."""
    values = list(node.values())
    if not values or not all(isinstance(value, dict) for value in values):
        return False
    return any(ADDRESS.fullmatch(str(key)) for key in node) or (
        len(values) > 1 and all(value.keys() == values[0].keys() for value in values)
    )


def _are_numbers(values: Sequence[Any]) -> bool:
    return 2 <= len(values) <= 3 and all(isinstance(value, int | float) for value in values)


def _is_reading(node: Mapping[Any, Any]) -> bool:
    """Whether an object has a strength that was received."""
    words = [name_words(str(name)) for name, value in node.items() if isinstance(value, int | float)]
    return any(parts & STRENGTH and not parts & {*SENT, "area"} for parts in words)


def _is_point(node: Mapping[Any, Any]) -> bool:
    names = {str(name).lower() for name in node}
    return {"x", "y"} <= names or any(
        name.lower() in POINTS and isinstance(node.get(name), list) for name in map(str, node)
    )


def _image(node: Any) -> str:
    """Name of the first picture that a document names as its plan."""
    for name, value in node.items() if isinstance(node, dict) else ():
        if isinstance(value, str) and name_words(str(name)) & IMAGE_WORDS and IMAGE.fullmatch(value):
            return Path(value).name
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return next(filter(None, map(_image, inner)), "")


def read_messages(lines: Sequence[str]) -> list[Row]:
    """Rows of the lines of MQTT that are readings; none where the first lines have none."""
    rows = []
    for line in lines if any(map(MQTT.fullmatch, lines[:FIRST_MESSAGES])) else ():
        with suppress(json.JSONDecodeError):
            if (match := MQTT.fullmatch(line)) is not None:
                named = {name: match[name] for name in ("time", "device", "node") if match[name] is not None}
                rows.append(json.loads(match["payload"]) | named)
    return rows


def event_log_of(lines: Sequence[str]) -> EventLog | None:
    """The form of a log with events of several kinds, by its first lines."""
    for log in EVENT_LOGS:
        for line in lines[:FIRST_EVENTS]:
            parts = line.split(log.separator, log.kind + 1)
            if len(parts) > log.kind and parts[log.kind] in log.fields:
                return log
    return None


def read_events(path: Path, text: str, lines: Sequence[tuple[int, str]], log: EventLog) -> list[Row]:
    """Rows of the positions and readings of an event log, by its numbered ``lines`` without comments; a file is a walk.

    Raises:
        InputError: an event with fewer fields than its kind has.
    """
    rows, floor = [], re.search(log.floor, text)
    named = {"walk": path.stem} | ({FLOOR_NAME: floor[1]} if floor else {})
    runs_on = re.compile(f"(?<=.)(?={log.start})")  # a phone did not end the line before
    for number, line in ((number, part) for number, content in lines for part in runs_on.split(content)):
        parts = line.rstrip(log.separator).split(log.separator)
        fields = log.fields.get(parts[log.kind]) if len(parts) > log.kind else None
        if fields is None:
            continue
        try:
            row = {name: _field(parts, index) for name, index in fields.items()}
        except IndexError:
            what = f"{parts[log.kind]} has {len(parts)} fields; remove the line, or export the log again"
            raise DataFault(path, what, line=number) from None
        radio = {"Type": log.radios[parts[log.kind]]} if parts[log.kind] in log.radios else {}
        rows.append(named | {"time": parts[log.time]} | row | radio)
    return rows


def _field(parts: Sequence[str], index: int | tuple[int, ...]) -> str:
    return parts[index] if isinstance(index, int) else "_".join(parts[number] for number in index)
