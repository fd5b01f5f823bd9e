"""Faults and suspicions of a data set, as lines and as plain values."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..core import DataFault, InputError, Record

MOST_LINES = 10
"""Faults of one kind in one file that are printed; the others are counted."""


@dataclass(frozen=True)
class Suspicion:
    """Data that read well but are likely wrong.

    Attributes:
        name: kind of the suspicion, a key of `wrf_mi.checking.SUSPICIONS`.
        text: evidence, what the data are instead, and the remedy.
    """

    name: str
    text: str


@dataclass(frozen=True)
class DataReport:
    """What `check_data` found.

    Attributes:
        dataset: name or folder that was checked.
        source: path of the data's folder or file; empty where it is not known.
        record: the data, None if there is a fault.
        faults: what the reader refuses, in the order in which it was found.
        suspicions: data that are likely wrong; only looked for where there is no fault.
        notes: properties of the data that are no mistake, but count for some models.
    """

    dataset: str
    source: str
    record: Record | None
    faults: tuple[InputError, ...]
    suspicions: tuple[Suspicion, ...]
    notes: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether the data set can be read."""
        return not self.faults

    def lines(self, most: int = MOST_LINES) -> list[str]:
        """A line for each fault, suspicion and note, and a summary.

        Args:
            most: largest number of lines for faults of one kind in one file.
        """
        lines = list(self._fault_lines(most))
        lines += [f"suspicion {suspicion.name}: {suspicion.text}" for suspicion in self.suspicions]
        lines += [f"note: {text}" for text in self.notes]
        if self.faults:
            summary = f"{_count(len(self.faults), 'fault')}; suspicions are looked for when there is none"
        else:
            summary = f"no fault, {_count(len(self.suspicions), 'suspicion')}"
        return [*lines, f"{self.dataset}: {summary}"]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with every fault."""
        record = self.record
        return {
            "dataset": self.dataset,
            "ok": self.ok,
            "source": self.source,
            "task": None if record is None else record.task,
            "rows": None if record is None else len(record),
            "faults": [_plain(fault) for fault in self.faults],
            "suspicions": [asdict(suspicion) for suspicion in self.suspicions],
            "notes": list(self.notes),
        }

    def _fault_lines(self, most: int) -> Iterator[str]:
        kinds: dict[object, list[InputError]] = {}
        for fault in self.faults:
            kinds.setdefault(fault.kind if isinstance(fault, DataFault) else fault, []).append(fault)
        source = Path(self.source)
        base = source if source.is_dir() else source.parent  # files are named in the folder of the data
        for faults in kinds.values():
            for fault in faults[:most]:
                yield f"fault: {_line(fault, base)}"
            if len(faults) > most and isinstance(last := faults[-1], DataFault):
                file, remedy = Path(last.kind[0]), last.kind[1]
                where = f", up to {last.place}" if last.place else ""
                yield f"fault: {_relative(file, base)}: {len(faults) - most} more of this kind{where}; {remedy}"


def _line(fault: InputError, base: Path) -> str:
    """A fault as ``FILE, row N: what; remedy``."""
    if not isinstance(fault, DataFault):
        return str(fault)
    file = _relative(fault.file, base)
    return f"{file}, {fault.place}: {fault.text}" if fault.place else f"{file}: {fault.text}"


def _plain(fault: InputError) -> dict[str, Any]:
    if not isinstance(fault, DataFault):
        return {"file": None, "place": "", "row": None, "text": str(fault)}
    return {"file": str(fault.file), "place": fault.place, "row": fault.row, "text": fault.text}


def _relative(file: Path, base: Path) -> str:
    return str(file.relative_to(base)) if base in file.parents else str(file)


def _count(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'s' if number > 1 else ''}"
