"""What the names of columns say: words, quantity and unit."""

from __future__ import annotations

import re
from dataclasses import dataclass

from ...datasets.unknown import RECEIVER, SENT, STRENGTH, name_words
from .programs import MAC

METRES = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048, "inch": 0.0254}
HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
PIXELS = ("px", "pixel", "pixels")
UNITS = (*METRES, *PIXELS, *HERTZ, "deg", "degrees", "rad", "dbm", "mw", "s", "ms", "%")
MARKED_UNIT = re.compile(r"[(\[]\s*([A-Za-z]+|%)\s*[)\]]|[_ ]([A-Za-z]+|%)$|^(px|pixels?)[_ ]", re.IGNORECASE)
RANGES = ("rtt", "range", "distance", "dist", "tof")
QUANTITIES = frozenset({*RANGES, "rsrq", "snr", "sinr", "std", "count", "variance", "noise", "quality"})
"""Words of columns that hold another quantity of a receiver, which is kept and not used."""
NEVER_STRENGTHS = frozenset({0.0, 1.0, 100.0, 127.0})
"""Numbers above or at 0 dBm that columns of strengths hold where nothing was heard."""
LOWEST_DBM = -150.0
SERVING = frozenset({"serving", "pcell"})
NEIGHBOURS = frozenset({"neighbor", "neighbour", "neighbors", "neighbours"})
"""Words in the names of columns of the serving cell and its neighbours."""
DIGITS = re.compile(r"\d+")


@dataclass(frozen=True)
class ColumnName:
    """What the name of a column says."""

    text: str

    @property
    def words(self) -> set[str]:
        """Words in small letters."""
        return name_words(self.text)

    @property
    def unit(self) -> str:
        """Unit that the name ends with, as in ``x_mm`` and ``X (m)``."""
        units = ["".join(groups).lower() for groups in MARKED_UNIT.findall(self.text)]
        return next((unit for unit in units if unit in UNITS), "")

    @property
    def without_unit(self) -> str:
        """The name without its unit."""
        return MARKED_UNIT.sub("", self.text).strip() if self.unit else self.text

    @property
    def plain(self) -> str:
        """The name in small letters without unit, blanks and marks."""
        return re.sub("[^a-z0-9]", "", self.without_unit.lower())

    @property
    def is_strength(self) -> bool:
        """Whether the column may hold strengths that were received."""
        return bool(self.words & STRENGTH) and not self.words & {*QUANTITIES, *SENT}

    @property
    def is_identity(self) -> bool:
        """Whether the column may name receivers."""
        return bool(self.words & {*RECEIVER}) and not self.words & {*STRENGTH, *QUANTITIES}

    @property
    def receiver(self) -> str:
        """What the name has beside quantity and unit; "" where nothing is left."""
        words = "|".join({*STRENGTH, *QUANTITIES})
        short = re.sub(r"\(.*?\)|\[.*?\]", " ", self.text)
        short = re.sub(rf"(?<![a-z])(?:{words})(?![a-z])", " ", short, flags=re.IGNORECASE)
        return re.sub(r"\s+", " ", short).strip(" _.-:")

    @property
    def stem(self) -> str:
        """The name without its number; one stem for all hardware addresses."""
        return "MAC address" if MAC.fullmatch(self.text.strip()) else DIGITS.sub("#", self.text)

    @property
    def without_slot(self) -> str:
        """The name without the number of its slot and what surrounds it, its unit in brackets behind it."""
        stem = re.sub(r"[\s_\-.#:()\[\]]+", " ", DIGITS.sub(" ", self.without_unit)).strip()
        beside = SERVING | NEIGHBOURS
        if name_words(stem) & STRENGTH:  # "Cell RSRP" is the RSRP of the cell, whose identity is another column
            beside |= {*RECEIVER}
        stem = " ".join(word for word in stem.split() if word.lower() not in beside)
        return stem + (f" ({self.unit})" if self.unit not in ("", "dbm") else "")


def unit_of(name: str) -> str:
    """Unit that a column's name ends with; "" without."""
    return ColumnName(name).unit
