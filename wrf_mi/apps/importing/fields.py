"""Fields of tables of text: their separator, and numbers with units, decimal commas and marks of thousands."""

from __future__ import annotations

import csv
import re
from collections import Counter
from pathlib import Path

from ...core import DataFault
from ...core.files import listed, one_line
from .programs import Frame

FIELD_UNIT = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*([a-zA-Z]{1,7}|%)")
"""A number with its unit, as in ``-65dBm``, ``2437 MHz`` and ``85%``."""
SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars", ",": "commas"}
"""In the order of trial: a table with a decimal comma has commas in every line, too."""
SPACES = r"\s+"
FRACTION = re.compile(r"[+-]?\d*\.\d+(?:[eE][+-]?\d+)?|[+-]?\d+\.")
COMMA_FRACTION = re.compile(r"[+-]?\d+,\d+")
NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?|nan", re.IGNORECASE)
MOST_PREAMBLE = 20  # lines above the header that name the program, the device or the survey
MINUS = "\u2212"  # of spreadsheets and typesetting
GAPS = r"(?<=\d)['\u2019\s](?=\d{3}(?!\d))"  # blanks and apostrophes that mark thousands
FEWEST_GROUPS = 3  # distinct fields of three digits behind a mark, beside whole numbers, that are no chance


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


def with_units(frame: Frame) -> Frame:
    """Columns of numbers that all have one unit in their fields as numbers, the unit in their names."""
    import pandas

    names = {}
    for name in frame.columns:
        if frame[name].dtype.kind in "biufM" or not frame[name].notna().any():
            continue
        texts = frame[name].dropna().astype(str).str.strip()
        if FIELD_UNIT.fullmatch(texts.iloc[0]) is None:
            continue
        parts = texts.str.extract(f"^{FIELD_UNIT.pattern}$")
        if parts[1].nunique() == 1 and parts[1].notna().all():
            numbers = pandas.to_numeric(parts[0].str.replace(",", "."))
            frame = frame.assign(**{name: numbers.reindex(frame.index)})
            unit = parts[1].iloc[0]
            names[name] = name if unit.lower() in name.lower() else f"{name} ({unit})"
    return frame.rename(columns=names)


def plain_numbers(texts: Frame) -> Frame:
    """Texts [n] of numbers with a decimal point and without marks of thousands, unchanged where these are not clear.

    Clear are ``1.500,00``, ``1,500.00``, ``1 500,5``, ``1'500.5`` and ``0,5``; ``1,500`` is not (`are_groups`).
    """
    texts = texts.str.replace(MINUS, "-").str.replace(GAPS, "", regex=True)
    for mark, decimal in ((".", ","), (",", ".")):
        is_marked = texts.str.contains(mark, regex=False)
        is_grouped = texts.str.fullmatch(rf"[+-]?\d{{1,3}}(?:\{mark}\d{{3}})+(?:\{decimal}\d+)?")
        is_clear = (texts.str.count(rf"\{mark}") > 1) | texts.str.contains(decimal, regex=False)
        if is_marked.any() and is_grouped[is_marked].all() and (is_clear[is_marked].any() or are_groups(texts, mark)):
            return texts.str.replace(mark, "").str.replace(decimal, ".")
        if mark == "," and not is_grouped.any():
            return texts.str.replace(",", ".")
    return texts


def are_groups(texts: Frame, mark: str) -> bool | None:
    """Whether a mark in texts [n] separates thousands rather than decimals; None where that is not clear.

    A program that writes decimals writes 500.000 beside 1.500, or else 1.5.
    """
    texts = texts.dropna().str.strip()
    is_marked = texts.str.contains(mark, regex=False)
    marked, is_whole = texts[is_marked], texts[~is_marked].str.fullmatch(r"[+-]?[1-9]\d{0,2}")
    is_grouped = marked.str.fullmatch(rf"[+-]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}})+")
    if texts.str.startswith("-").all() or not (len(marked) and is_whole.any() and is_grouped.all()):
        return False  # strengths are all negative
    if marked.str.endswith("0").any() or marked.str.count(rf"\{mark}").max() > 1:
        return True
    return None if marked.nunique() >= FEWEST_GROUPS else False


def thousandths(frame: Frame) -> list[str]:
    """Columns of whole numbers beside fractions that are all thousandths, which may be thousands: 500 and 1.500."""
    scaled = frame.select_dtypes("float") * 1e3
    is_whole = scaled % 1e3 == 0
    are_thousandths = ((scaled - scaled.round()).abs().fillna(0) < 1e-6).all()
    return list(scaled.columns[are_thousandths & is_whole.any() & (scaled.notna() & ~is_whole).any()])


def without_groups(path: Path, frame: Frame, texts: Frame, mark: str) -> tuple[Frame, str]:
    """Columns of numbers in which a mark was read as decimal and separates thousands, read again, and a note.

    Raises:
        InputError: a column of which the mark may separate either.
    """
    verdicts = {name: are_groups(texts[name], mark) for name in texts}
    grouped = [name for name, verdict in verdicts.items() if verdict]
    unclear = [name for name, verdict in verdicts.items() if verdict is None]
    if not grouped and unclear:
        text = f"{one_line(unclear[0])} has whole numbers beside fields such as {texts[unclear[0]].dropna().iloc[0]}"
        raise DataFault(path, f"{text}: thousands or decimals? Write all without marks of thousands")
    names = grouped + unclear
    numbers = {name: texts[name].str.replace(mark, "").astype(float) for name in names}
    note = f"; {mark!r} separates thousands in {one_line(listed(names))}" if names else ""
    return frame.assign(**numbers), note
