"""The file of receivers of signal strengths: ids, positions, orientations, carriers and antennas."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import Antenna, DataFault, Record
from ..core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray
from ..core.antenna import ANTENNA, UPRIGHT, boresight_orientation
from ..core.carriers import FREQUENCY
from .faults import attempt, refuse, stop_at_faults
from .folder_files import ANTENNA_WORDS, TX_ANTENNA_WORDS, CsvTable, read_antenna, shown

logger = logging.getLogger(__name__)

TX = "tx_"
QUATERNION, AZIMUTH, DOWNTILT = ("qx", "qy", "qz", "qw"), "azimuth_deg", "downtilt_deg"
TX_COLUMNS = tuple(TX + word for word in TX_ANTENNA_WORDS)
COLUMNS = ("id", "x", "y", "z", *QUATERNION, AZIMUTH, DOWNTILT, FREQUENCY, *ANTENNA_WORDS, *TX_COLUMNS)
"""Columns of the file of receivers."""
WHOLE = re.compile(r"([+-]?)0*(\d+?)(?:\.0*)?", re.ASCII)
"""A whole number, also as pandas writes it in a column of floats: ``3``, ``3.0``."""


def read_ids(table: CsvTable) -> list[str]:
    """Ids of the anchors in normal form."""
    if unused := [column for column in table.header if column not in COLUMNS]:
        known = ", ".join(COLUMNS)
        logger.warning("%s: columns that are not used: %s (known: %s)", table.path, ", ".join(unused), known)
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
    """Coordinates [rows, axes] in metres; empty fields are NaN if they are allowed."""
    columns = [attempt(table.numbers, axis, may_be_empty) for axis in axes]
    return np.stack([column.value for column in columns], axis=-1)


def read_transmitter(anchors: CsvTable) -> Antenna:
    """The transmitter's antenna, which every row of the anchors states."""
    first, *others = read_antennas(anchors, TX)
    for row, antenna in enumerate(others, start=2):
        if antenna != first:
            text = f"{TX}pattern or {TX}polarization differs from row 1"
            remedy = "there is one transmitter: state the same in every row"
            refuse(DataFault(anchors.path, f"{text}; {remedy}", row=row))
    return first


def read_antennas(table: CsvTable, prefix: str, orientations: Sequence[FloatArray | None] = ()) -> list[Antenna]:
    """The antenna of each row; an empty field or a missing column is the default, with an orientation its frame."""
    words = TX_ANTENNA_WORDS if prefix else ANTENNA_WORDS
    stated = {key: table.texts(prefix + key) for key in words if prefix + key in table.header}
    entries = [
        {key: text for key, texts in stated.items() if (text := texts[row].strip())} for row in range(len(table.rows))
    ]
    for entry, orientation in zip(entries, orientations, strict=False):
        if orientation is not None:
            entry.setdefault("frame", "array")
    antennas = [
        attempt(read_antenna, table.path, f"{prefix}antenna", entry, words, row)
        for row, entry in enumerate(entries, start=1)
    ]
    return [antenna.value for antenna in antennas]


def read_orientations(table: CsvTable) -> list[FloatArray | None]:
    """Orientation [4] of each receiver from its quaternion or azimuth and downtilt; None: its fields are empty."""
    names = [name for name in (*QUATERNION, AZIMUTH, DOWNTILT) if name in table.header]
    columns = {name: table.numbers(name, may_be_empty=True) for name in names}
    orientations: list[FloatArray | None] = []
    for row in range(len(table.rows)):
        stated = {name: float(values[row]) for name, values in columns.items() if not np.isnan(values[row])}
        orientation = None
        if np.isinf(list(stated.values())).any():
            pass  # a damaged row, or a field that is refused already
        elif tuple(stated) == QUATERNION:
            orientation = np.array(list(stated.values()))
            if abs(norm := np.linalg.norm(orientation) - 1) > UNIT_QUATERNION_TOLERANCE:
                text = f"quaternion of norm {norm + 1:.4g}; {','.join(QUATERNION)} must be a unit x, y, z, w"
                refuse(DataFault(table.path, text, row=row + 1))
        elif tuple(stated) in ((AZIMUTH,), (AZIMUTH, DOWNTILT)):
            orientation = boresight_orientation(*np.radians(list(stated.values())))
        elif stated:
            text = f"{', '.join(stated)} alone; give {','.join(QUATERNION)}, or {AZIMUTH} and, if not 0, {DOWNTILT}"
            refuse(DataFault(table.path, text, row=row + 1))
        orientations.append(orientation)
    return orientations


def receiver_columns(record: Record, ids: list[str]) -> dict[str, Any]:
    """Columns of the file of receivers; those of which all are as by default are omitted."""
    receivers = record.receivers
    positions = np.stack([receiver.position_m for receiver in receivers])
    columns: dict[str, Any] = {"id": ids, **dict(zip("xyz", positions.T.tolist(), strict=True))}
    turned = any(receiver.orientation_xyzw.tolist() != list(UPRIGHT) for receiver in receivers)
    if turned:
        orientations = np.stack([receiver.orientation_xyzw for receiver in receivers])
        columns |= dict(zip(QUATERNION, orientations.T.tolist(), strict=True))
    if (carriers_hz := record.receiver_carriers_hz) is not None:
        columns[FREQUENCY] = carriers_hz.tolist()
    antennas = [receiver.antenna for receiver in receivers]
    for prefix, words, group in (("", ANTENNA_WORDS, antennas), (TX, TX_ANTENNA_WORDS, [record.tx_antenna] * len(ids))):
        # Beside an orientation the frame is stated in any case, as its default is then another.
        if (turned and not prefix) or any(antenna != ANTENNA for antenna in group):
            columns |= {prefix + word: [getattr(antenna, word) for antenna in group] for word in words}
    return columns


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
