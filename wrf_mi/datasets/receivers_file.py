"""The file of receivers of signal strengths: ids, positions, orientations, carriers and antennas."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import Antenna, DataFault, Receiver, Record
from ..core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray
from ..core.antenna import ANTENNA, UPRIGHT, boresight_orientation
from ..core.carriers import FREQUENCY
from ..core.files import listed
from .faults import attempt, recoverable, refuse, stop_at_faults
from .folder_files import ANTENNA_WORDS, TX_ANTENNA_WORDS, CsvTable, antenna_words, read_antenna, shown

logger = logging.getLogger(__name__)

TX = "tx_"
QUATERNION, AZIMUTH, DOWNTILT = ("qx", "qy", "qz", "qw"), "azimuth_deg", "downtilt_deg"
WORDS = {"": ANTENNA_WORDS, TX: TX_ANTENNA_WORDS}
"""Attributes of the antennas of the receivers and of the transmitter, by the prefix of their columns."""
TX_COLUMNS = tuple(TX + word for word in TX_ANTENNA_WORDS)
COLUMNS = ("id", "x", "y", "z", *QUATERNION, AZIMUTH, DOWNTILT, FREQUENCY, *ANTENNA_WORDS, *TX_COLUMNS)
"""Columns of the file of receivers."""
WHOLE = re.compile(r"([+-]?)0*(\d+?)(?:\.0*)?", re.ASCII)
"""A whole number, also as pandas writes it in a column of floats: ``3``, ``3.0``."""


def read_ids(table: CsvTable) -> list[str]:
    """Ids of the anchors in normal form."""
    if unused := [column for column in table.header if column not in COLUMNS]:
        column_names = ", ".join(COLUMNS)
        logger.warning("%s: columns that are not used: %s (known: %s)", table.path, listed(unused), column_names)
    ids: list[str] = []
    for row, text in enumerate(table.texts("id"), start=1):
        anchor = plain_id(text)
        wrong = None if row - 1 in table.damaged else wrong_id(anchor, ids)
        if wrong:
            remedy = "give each anchor a number or name that no other has"
            refuse(DataFault(table.path, f"id {shown(text)} {wrong}; {remedy}", row=row))
        ids.append(anchor)
    if table.damaged:
        stop_at_faults()  # an anchor without id
    return ids


def read_positions(table: CsvTable, axes: str, may_be_empty: bool = False) -> FloatArray:
    """Coordinates [rows, axes] in metres; empty fields are NaN if they are allowed, x and y together."""
    columns = [attempt(table.numbers, axis, may_be_empty) for axis in axes]
    positions = np.stack([column.value for column in columns], axis=-1)
    empty = np.isnan(positions[:, :2])
    for row in np.flatnonzero(empty[:, 0] != empty[:, 1]):  # a height alone may be unpublished, half a place is a slip
        text = f"{axes[int(np.argmax(empty[row]))]} is empty; give x and y, or neither where they are unknown"
        refuse(DataFault(table.path, text, row=int(row) + 1))
    return positions


def read_transmitter(anchors: CsvTable) -> Antenna:
    """The transmitter's antenna, which every row of the anchors states."""
    first, *others = read_antennas(anchors, TX)
    for row, antenna in enumerate(others, start=2):
        if antenna != first:
            text = f"{TX}pattern or {TX}polarization differs from row 1"
            refuse(DataFault(anchors.path, f"{text}; there is one transmitter: state the same in every row", row=row))
    return first


def read_antennas(table: CsvTable, prefix: str, orientations: Sequence[FloatArray | None] = ()) -> list[Antenna]:
    """The antenna of each row; an empty field or a missing column is the default, with an orientation its frame."""
    entries = _antenna_entries(table, prefix)
    for entry, orientation in zip(entries, orientations, strict=False):
        if orientation is not None:
            entry.setdefault("frame", "array")
    antennas = [
        attempt(read_antenna, table.path, f"{prefix}antenna", entry, WORDS[prefix], row)
        for row, entry in enumerate(entries, start=1)
    ]
    return [antenna.value for antenna in antennas]


def _antenna_entries(table: CsvTable, prefix: str) -> list[dict[str, str]]:
    """Attributes of the antenna of each row whose fields are not empty."""
    columns = {word: table.texts(prefix + word) for word in WORDS[prefix] if prefix + word in table.header}
    rows = range(len(table.rows))
    return [{word: text for word, texts in columns.items() if (text := texts[row].strip())} for row in rows]


def read_orientations(table: CsvTable) -> list[FloatArray | None]:
    """Orientation [4] of each receiver from its quaternion or azimuth and downtilt; None: its fields are empty."""
    names = [name for name in (*QUATERNION, AZIMUTH, DOWNTILT) if name in table.header]
    columns = {name: table.numbers(name, may_be_empty=True) for name in names}
    orientations: list[FloatArray | None] = [None] * len(table.rows)
    for row in range(len(table.rows)):
        row_fields = {name: float(values[row]) for name, values in columns.items() if not np.isnan(values[row])}
        if np.isfinite([*row_fields.values()]).all():  # else a damaged row, or a field that is refused already
            with recoverable():
                orientations[row] = _orientation(table, row, row_fields)
    return orientations


def _orientation(table: CsvTable, row: int, row_fields: dict[str, float]) -> FloatArray | None:
    """Orientation [4] of a row from those of its fields that are not empty; None without any."""
    numbers = np.array([*row_fields.values()])
    if not row_fields:
        return None
    if tuple(row_fields) in ((AZIMUTH,), (AZIMUTH, DOWNTILT)):
        return boresight_orientation(*np.radians(numbers))
    text = f"{', '.join(row_fields)} alone; give {','.join(QUATERNION)}, or {AZIMUTH} and, if not 0, {DOWNTILT}"
    if tuple(row_fields) == QUATERNION:
        norm = np.linalg.norm(numbers)
        if abs(norm - 1) <= UNIT_QUATERNION_TOLERANCE:
            return numbers
        text = f"quaternion of norm {norm:.4g}; {','.join(QUATERNION)} must be a unit x, y, z, w"
    raise DataFault(table.path, text, row=row + 1)


def receiver_of(
    anchor: str, position_m: FloatArray, orientation: FloatArray | None, antenna: Antenna, hz: float | None = None
) -> Receiver:
    """The receiver of an id; with None as its orientation it is upright."""
    orientation = np.array(UPRIGHT) if orientation is None else orientation
    return Receiver(receiver_name(anchor), position_m, orientation, antenna, frequency_hz=hz)


def receiver_columns(record: Record, ids: list[str]) -> dict[str, Any]:
    """Columns of the file of receivers; those of which all are as by default are omitted."""
    positions_m = np.stack([receiver.position_m for receiver in record.receivers])
    orientations = np.stack([receiver.orientation_xyzw for receiver in record.receivers])
    columns: dict[str, Any] = {"id": ids, **dict(zip("xyz", positions_m.T.tolist(), strict=True))}
    turned = bool((orientations != UPRIGHT).any())
    if turned:
        columns |= dict(zip(QUATERNION, orientations.T.tolist(), strict=True))
    if (carriers_hz := record.receiver_carriers_hz) is not None:
        columns[FREQUENCY] = carriers_hz.tolist()
    # Beside an orientation the frame is stated in any case, as its default is then another.
    columns |= _antenna_columns("", [receiver.antenna for receiver in record.receivers], turned)
    return columns | _antenna_columns(TX, [record.tx_antenna] * len(ids))


def _antenna_columns(prefix: str, antennas: list[Antenna], always: bool = False) -> dict[str, list[str]]:
    """Columns of antennas; none where all are the default, unless they are ``always`` to be written."""
    if not always and all(antenna == ANTENNA for antenna in antennas):
        return {}
    words = [antenna_words(antenna) for antenna in antennas]
    return {prefix + word: [of_antenna[word] for of_antenna in words] for word in WORDS[prefix]}


def plain_id(text: str) -> str:
    """Normal form of an id: a whole number without leading zeros and decimals, any other text unchanged."""
    number = WHOLE.fullmatch(text.strip())
    return text.strip() if number is None else number[1].replace("+", "") + number[2]


def receiver_name(anchor: str) -> str:
    """Name of the receiver of an id."""
    return f"anchor{anchor}" if WHOLE.fullmatch(anchor) else anchor


def wrong_id(anchor: str, before: list[str]) -> str | None:
    """Reason why an id cannot follow others, or None."""
    if not anchor:
        return "is empty"
    if not anchor.isprintable():
        return "does not go into one line"
    if anchor.lower() == "nan":
        return "is pandas' mark of a missing value"
    names = [receiver_name(other) for other in before]
    if receiver_name(anchor) in names:
        return f"gives the name {receiver_name(anchor)}, as row {names.index(receiver_name(anchor)) + 1} does"
    return None
