"""Files that several layouts share: positions, index files and YAML, with errors that name the line."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from ..core import Antenna, InputError, Record
from ..core.angles import UNIT_QUATERNION_TOLERANCE, FloatArray
from ..core.antenna import ANTENNA
from ..core.carriers import FREQUENCY
from ..core.files import one_line, text_lines
from ..core.types import IntArray

POSITIONS = "tx_pos.csv"
AXES = ("x", "y", "z")
"""Columns of positions, metres."""
INDEX_FILES = ("train_index.txt", "test_index.txt")
ANTENNA_WORDS = ("pattern", "polarization", "frame")
TX_ANTENNA_WORDS = ANTENNA_WORDS[:2]
"""What may be stated of a transmitter's antenna: its frame is always the world, turned with the heading."""
SINGLE_MAX = float(np.finfo(np.float32).max)
"""Largest number that single precision holds, in which everything computes."""
DIGITS = 18
"""Of a whole number at most: more may not fit into 64 bits."""


class _Loader(yaml.SafeLoader):
    """Says where a value stands that looks like a date or a number and cannot be one."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            value = super().construct_object(node, deep)
            if isinstance(value, int):
                float(value)  # hundreds of digits are no quantity, and no array takes them
        except yaml.YAMLError:
            raise
        except Exception as error:  # PyYAML's constructors raise a dozen kinds
            text = f"no {node.tag.rpartition(':')[2]} ({one_line(error)})"
            raise yaml.constructor.ConstructorError(None, None, text, node.start_mark) from None
        return value


def read_yaml(path: Path) -> dict[Any, Any]:
    """The mapping of a YAML file; empty where it holds anything else.

    Raises:
        InputError: missing, not text, not YAML, or with a date or number in it that is none.
    """
    text = "\n".join(text_lines(path))
    try:
        content = yaml.load(text, Loader=_Loader)
    except (yaml.YAMLError, RecursionError) as error:
        raise InputError(f"{path}: not YAML ({one_line(error)}); correct it") from None
    return content if isinstance(content, dict) else {}


def finite_numbers(path: Path, what: str, value: object, count: int) -> FloatArray:
    """A list of ``count`` finite numbers from YAML, shape [count].

    Raises:
        InputError: it is anything else, or single precision does not hold it.
    """
    values = numbers_of(value)
    if values.shape != (count,) or not fits_single(values):
        raise InputError(f"{path}: {one_line(what)} is {shown(value)}; give a list of {count} finite numbers")
    return values


def numbers_of(value: object) -> FloatArray:
    """An array of numbers from YAML or from a call; empty where it is none."""
    try:
        return np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def fits_single(values: FloatArray) -> bool:
    """Whether all are finite, in single precision too."""
    return bool((np.abs(values) <= SINGLE_MAX).all())


def shown(value: object) -> str:
    """A value for a message: on one line and not long."""
    text = one_line(repr(value))
    return text if len(text) <= 60 else f"{text[:60]}..."


def unit_quaternion(path: Path, name: str, value: object) -> FloatArray:
    """An orientation from YAML: a unit quaternion x, y, z, w.

    Raises:
        InputError: it is none.
    """
    orientation = finite_numbers(path, f"{name}: orientation", value, 4)
    norm = float(np.linalg.norm(orientation))
    if abs(norm - 1) > UNIT_QUATERNION_TOLERANCE:
        raise InputError(
            f"{path}: {one_line(name)}: quaternion of norm {norm:.4g}; orientation must be a unit x, y, z, w"
        )
    return orientation


def read_antenna(path: Path, name: str, value: object, words: tuple[str, ...] = ANTENNA_WORDS) -> Antenna:
    """An antenna from YAML: a mapping with some of ``pattern``, ``polarization`` and ``frame``; None: the default.

    Args:
        path: of the file, for messages.
        name: of the entry, for messages.
        value: from the file.
        words: keys that may be given.

    Raises:
        InputError: anything else.
    """
    if value is None:
        return ANTENNA
    if not isinstance(value, dict) or not set(value) <= set(words):
        raise InputError(f"{path}: {one_line(name)} is {shown(value)}; give some of {', '.join(words)}")
    try:
        return Antenna(**value)
    except InputError as error:
        text = str(error).removeprefix("antenna: ")
        raise InputError(f"{path}: {one_line(name)}: {text}") from None


def antenna_entry(antenna: Antenna) -> dict[str, str]:
    """What `read_antenna` reads: all that is not the default."""
    return {key: value for key, value in asdict(antenna).items() if value != getattr(ANTENNA, key)}


def read_positions(path: Path) -> FloatArray:
    """Positions [n, 3] in metres of a CSV file with the header ``x,y,z``.

    Raises:
        InputError: another header, no rows, or a row that is not three finite numbers.
    """
    return _read_columns(path, (AXES,))


def read_positions_and_carriers(path: Path) -> tuple[FloatArray, FloatArray | None]:
    """Positions [n, 3] in metres and carriers [n] in Hz of a CSV file with the header ``x,y,z,frequency_hz``.

    Returns:
        Carriers are None where the header is ``x,y,z``.

    Raises:
        InputError: another header, no rows, a row that is not of finite numbers, or a carrier that is not positive.
    """
    values = _read_columns(path, (AXES, (*AXES, FREQUENCY)))
    return values[:, :3], carriers_of(path, values[:, 3]) if values.shape[1] > 3 else None


def carriers_of(path: Path, carriers_hz: FloatArray) -> FloatArray:
    """Carriers [n] of a file's column `FREQUENCY`, checked.

    Raises:
        InputError: one that is not positive.
    """
    if len(bad := np.flatnonzero(~(carriers_hz > 0))):
        text = f"row {bad[0] + 1}: {FREQUENCY} is {carriers_hz[bad[0]]:g}"
        raise InputError(f"{path}: {text}; give the carrier in Hz, such as 920e6")
    return carriers_hz


def _read_columns(path: Path, headers: tuple[tuple[str, ...], ...]) -> FloatArray:
    """Finite numbers [n, columns] of a CSV file with one of some headers."""
    first, *rows = text_lines(path) or [""]
    header = tuple(column.strip().lower() for column in first.split(","))
    if header not in headers:
        known = " or ".join(",".join(one) for one in headers)
        raise InputError(f"{path}: line 1: header is {first[:40]!r}; it must be {known}")
    if not rows:
        raise InputError(f"{path}: no positions in it; give one row x,y,z in metres per sample")
    values, count = np.empty((len(rows), len(header))), len(header)
    for row, text in enumerate(rows, start=1):
        try:
            # A single number would be taken for all columns.
            values[row - 1] = np.reshape([float(value) for value in text.split(",", count)], count)
        except ValueError:
            numbers = "three numbers x,y,z in metres" if count == 3 else f"{count} numbers {','.join(header)}"
            raise InputError(f"{path}: row {row}: {text[:60]!r}; give {numbers}") from None
    bad = np.flatnonzero(~(np.abs(values) <= SINGLE_MAX).all(axis=1))
    if len(bad):
        what = "is not finite" if not np.isfinite(values[bad[0]]).all() else "is too large for single precision"
        raise InputError(f"{path}: row {bad[0] + 1}: {rows[bad[0]][:60]!r} {what}; correct or remove the row")
    return values


def whole_number(path: Path, line: int, text: str) -> int:
    """A whole number from 0 that stands alone on a line.

    Raises:
        InputError: the line holds anything else.
    """
    digits = text.strip()
    if not (digits.isascii() and digits.isdecimal()):
        raise InputError(f"{path}: line {line}: {text.strip()[:40]!r} is not a whole number; correct it")
    if len(digits) > DIGITS:
        raise InputError(f"{path}: line {line}: {digits[:40]!r} has more than {DIGITS} digits; correct it")
    return int(digits)


def read_official(folder: Path, rows: int, first: int, source: str = POSITIONS) -> tuple[IntArray, IntArray] | None:
    """Training and test rows, from 0, of a folder's index files; None where it has neither.

    Args:
        folder: that may hold them.
        rows: of the data.
        first: number of the first row in these files: 1 where they name images ``00001.png``, 0 where they count.
        source: the file whose rows are meant, for messages.

    Raises:
        InputError: one of the two is missing, or a line is no row, out of range, twice, or in both.
    """
    train_file, test_file = (folder / name for name in INDEX_FILES)
    if not train_file.exists() and not test_file.exists():
        return None
    train, test = (_read_index(path, rows, first, source) for path in (train_file, test_file))
    both = np.intersect1d(train, test)
    if len(both):
        raise InputError(
            f"{test_file}: row {both[0] + first} is in {train_file.name} as well; remove it from one of them"
        )
    return train, test


def _read_index(path: Path, rows: int, first: int, source: str) -> IntArray:
    seen: dict[int, int] = {}
    for line, text in enumerate(text_lines(path), start=1):
        row = whole_number(path, line, text)
        if not first <= row < rows + first:
            known = f"{source} has rows {first} to {rows + first - 1}"
            raise InputError(f"{path}: line {line}: row {row} is out of range; {known}")
        if row in seen:
            raise InputError(f"{path}: line {line}: row {row} stands in line {seen[row]} already; remove one of them")
        seen[row] = line
    if not seen:
        raise InputError(f"{path}: no rows in it; give one row number per line")
    return np.array(list(seen), np.int64) - first


def refuse_unstated(path: str | Path, record: Record, *names: str) -> None:
    """Refuse to write a record with parts of these names, which a layout does not state.

    Raises:
        InputError: naming the first that the record has.
    """
    for name in names:
        if getattr(record, name) is not None:
            remedy = f"set Record.{name} to None, or use another layout"
            raise InputError(f"{path}: {record.name} has {name}, which this layout does not state; {remedy}")


def write_lines(path: Path, lines: list[str]) -> None:
    """Write lines of text, each ended."""
    path.write_text("\n".join([*lines, ""]), encoding="utf-8", newline="\n")


def write_positions(path: Path, positions_m: FloatArray, carriers_hz: FloatArray | None = None) -> None:
    """Write positions [n, 3] and carriers [n] as `read_positions_and_carriers` reads them, to the last digit."""
    header: tuple[str, ...] = AXES
    values = positions_m
    if carriers_hz is not None:
        header, values = (*AXES, FREQUENCY), np.column_stack([positions_m, carriers_hz])
    write_lines(path, [",".join(header), *(",".join(repr(float(v)) for v in row) for row in values)])
