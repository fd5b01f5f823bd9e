"""Separator, decimal mark and header of a table of text, by its first lines."""

from __future__ import annotations

import csv
import re
from collections import Counter

from .fields import FIELD_UNIT

SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas"}
"""In the order of trial: a table with a decimal comma has commas in every line, too."""
SPACES = r"\s+"
FRACTION = re.compile(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?|[+-]?\d+\.")
COMMA_FRACTION = re.compile(r"[+-]?\d+,\d+")
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan", re.IGNORECASE)
MOST_PREAMBLE = 20  # lines above the header that name the program, the device or the survey


def split_line(line: str, separator: str) -> list[str]:
    """Fields of a line, without quotes and surrounding blanks."""
    if separator == SPACES:
        return line.split()
    return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])]


def separator_below(lines: list[str]) -> tuple[str, int]:
    """The separator of a table's first lines, and how many above its header have other numbers of fields."""
    separator, is_certain = separator_of(lines)
    for above in range(1, min(MOST_PREAMBLE, len(lines) - 2) + 1) if not is_certain else ():
        below, is_consistent = separator_of(lines[above:])
        # Where a row begins the others, a row before it is damaged.
        if is_consistent and not is_row(split_line(lines[above], below), "."):
            return below, above
    # A later row is damaged: the header is the first line with as many fields as most lines.
    counts = [len(split_line(line, separator)) for line in lines]
    above = counts.index(Counter(counts).most_common(1)[0][0])
    if not is_certain and 0 < above <= MOST_PREAMBLE and not is_row(split_line(lines[above], separator), "."):
        return separator, above
    return separator, 0


def separator_of(sample: list[str]) -> tuple[str, bool]:
    """The first separator with the same number of fields in all lines, or else that of most fields; and which."""
    most = ("", 1)
    for separator in (*SEPARATORS, SPACES):
        counts = {len(split_line(line, separator)) for line in sample}
        if len(counts) == 1 and counts != {1} and (separator != SPACES or not most[0]):
            return separator, True
        if separator != SPACES and min(counts) > most[1]:
            most = separator, min(counts)
    return most[0] or ",", False


def decimal_mark(rows: list[list[str]]) -> str:
    """The decimal mark of the fields of rows."""
    fields = [field for row in rows for field in row]
    with_comma = any(COMMA_FRACTION.fullmatch(field) for field in fields)
    return "," if with_comma and not any(FRACTION.fullmatch(field) for field in fields) else "."


def is_row(fields: list[str], decimal: str) -> bool:
    """Whether fields are measurements rather than names: all numbers, or one of them negative or with decimals."""
    fields = [field.replace(decimal, ".") for field in fields if field]
    numbers = [field for field in fields if NUMBER.fullmatch(field) or FIELD_UNIT.fullmatch(field)]
    return len(numbers) == len(fields) or any(field[0] == "-" or FRACTION.fullmatch(field) for field in numbers)
