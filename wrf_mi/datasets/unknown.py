"""Errors about folders and files that are no data set: what they hold, and the layout that is wanted."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..core import DataFault, InputError
from ..core.files import listed, one_line, text_lines

WANTED = (
    "a data set is a folder with receivers.csv, train.csv and test.csv (signal strengths), with "
    "gateway_info.yml, tx_pos.csv and spectrum/ (spectra), with csidata.npy and base-station.yml (channels), or of "
    "another layout of docs/data.md"
)
TABLE = (
    "signal strengths are a row for each position with the columns x,y and rssi_<id> of each receiver, in "
    "train.csv and test.csv, or in measurements.csv, beside receivers.csv with id,x,y,z of each receiver "
    "(docs/howto/own-data.md)"
)
TABLES = (".csv", ".tsv", ".txt")
SEPARATORS = ",;\t|"
STRENGTHS = ("rsrp", "rssi", "rss", "dbm", "signal", "strength", "level", "power")
"""Words in the names of columns that hold strengths, in the order of preference where a reading has several."""
STRENGTH = frozenset(STRENGTHS)
SENT = frozenset({"tx", "txpower", "sent", "transmit", "transmitted", "eirp"})
"""Words in the names of columns that hold the power that is sent."""
BESIDE = frozenset({"db", "received", "rx", "mean", "average", "avg", "median", "value", "measured"})
"""Words beside those of strengths in the name of a column that belongs to no particular receiver."""
RECEIVER = (
    *("bssid", "mac", "address", "uuid", "receiver", "rx", "anchor", "gateway", "ap", "access", "beacon", "cell"),
    *("cellid", "station", "pci", "node", "device", "ssid", "id", "name"),
)
"""Words in the names of columns that tell receivers apart, the most particular first."""


@dataclass(frozen=True)
class Table:
    """Name of a table and names of its columns."""

    name: str
    header: tuple[str, ...]


def unknown_data(path: Path, inner: Sequence[Path] = ()) -> InputError:
    """The error about a folder or file that no layout describes; ``inner`` are folders in it that are data sets."""
    if path.is_file():
        table = _read_header(path)
        if table is None:
            return DataFault(path, f"a file of no known layout; {WANTED}")
        return DataFault(path, f"a table, where a folder is wanted; {table_text(table)}")
    content = sorted(path.iterdir())
    if not content:
        return DataFault(path, f"an empty folder; {WANTED}")
    names = one_line(listed([file.name for file in content], mark=","))
    holding = f"holds {names} and is no data set itself"
    if inner:
        return DataFault(path, f"{holding}; give {one_line(inner[0])}")
    tables = [table for table in map(_read_header, content) if table is not None]
    tables.sort(key=lambda table: long_columns(table.header) is None)  # tables of single readings first
    return DataFault(path, f"{holding}; {table_text(tables[0]) if tables else WANTED}")


def table_text(table: Table) -> str:
    """What a table lacks as signal strengths, and the command that makes a data set of it."""
    kind = "" if long_columns(table.header) is None else ", a row for each reading"
    remedy = f"make a data set of it by wrf-mi data import {one_line(table.name)} --out FOLDER"
    columns = one_line(listed(table.header, mark=","))
    return f"{table.name} has the columns {columns}{kind}; {TABLE}: {remedy}"


def name_words(name: str) -> set[str]:
    """Words of a column's name in small letters, also those of ``anchorId``."""
    return {*re.findall("[a-z]+", name.lower()), *map(str.lower, re.findall("[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name))}


def long_columns(header: Sequence[str]) -> tuple[str, str] | None:
    """Columns of receivers and of strengths in a table with a row for each reading, or None."""
    words = {column: name_words(column) for column in header}
    strengths = [column for column, parts in words.items() if parts & STRENGTH and not parts & SENT]
    receivers = (name for word in RECEIVER for name in header if word in words[name] and name not in strengths)
    # RSRP and RSSI of one reading are two quantities; columns with a number or a name are of a receiver each.
    if len(strengths) > 1 and all(
        words[name] <= STRENGTH | BESIDE and not re.search(r"\d", name) for name in strengths
    ):
        strengths = preferred(strengths)[:1]
    return next(zip(receivers, strengths, strict=False), None) if len(strengths) == 1 else None


def preferred(names: Sequence[str]) -> list[str]:
    """Columns of strengths by the preference of their quantities in `STRENGTHS`."""
    words = {name: name_words(name) & STRENGTH for name in names}
    return sorted(names, key=lambda name: min(map(STRENGTHS.index, words[name]), default=len(STRENGTHS)))


def _read_header(file: Path) -> Table | None:
    """The first line of a table; None of another file."""
    if file.suffix.lower() not in TABLES:
        return None
    try:
        first = next(iter(text_lines(file)), "")
        separator = max(SEPARATORS, key=first.count)
        header = [name.strip() for name in next(csv.reader([first], delimiter=separator), [])]
    except (InputError, csv.Error):
        return None
    return Table(file.name, tuple(header)) if len(header) > 1 else None
