"""Numbers in the texts of fields: units, decimal commas and marks of thousands."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from ...core import DataFault
from ...core.files import listed, one_line
from .programs import Frame

FIELD_UNIT = re.compile(r"([+-]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][+-]?\d+)?)\s*([a-zA-Z]{1,7}|%)")
"""A number with its unit, as in ``-65dBm``, ``2437 MHz`` and ``85%``."""
MINUS = "\u2212"  # of spreadsheets and typesetting
GAPS = r"(?<=\d)['\u2019\s](?=\d{3}(?!\d))"  # blanks and apostrophes that mark thousands
FEWEST_GROUPS = 3  # distinct fields of three digits behind a mark, beside whole numbers, that are no chance


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
    if not (len(marked) and is_whole.any() and marked.str.fullmatch(rf"[+-]?[1-9]\d{{0,2}}(?:\{mark}\d{{3}})+").all()):
        return False
    if marked.str.endswith("0").any() or marked.str.count(rf"\{mark}").max() > 1:
        return True
    return None if marked.nunique() >= FEWEST_GROUPS else False


def thousandths(frame: Frame) -> list[str]:
    """Columns of whole numbers beside fractions that are all thousandths, which may be thousands: 500 and 1.500."""
    names = []
    for name in frame.select_dtypes("float").columns:
        values = frame[name].dropna().to_numpy()
        is_whole, scaled = values == np.round(values), values * 1e3
        if 0 < is_whole.sum() < len(values) and np.allclose(scaled, np.round(scaled), rtol=0, atol=1e-6):
            names.append(name)
    return names


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
