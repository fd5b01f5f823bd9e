"""All faults of a data set, and suspicions about data that read well (the command ``wrf-mi data check``)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ...core import DataFault, InputError, Record
from ...datasets.faults import collect_faults
from ...datasets.registry import find, known, locate
from ...estimators.checks import check_parts
from ...synthetic import load_record
from .distances import unlike_units
from .rows import constant_observations, few_rows, not_heard, repeated_rows
from .units import NamedTexts, degrees, far_from_origin, strength_scale

logger = logging.getLogger(__name__)

SUSPICIONS = {
    "not-heard": "numbers for what was not heard among signal strengths, channels and spectra of zeros",
    "few-rows": "receivers with too few training rows to be fitted",
    "strengths": "powers on a linear scale, or without their sign, for dBm",
    "repeated-rows": "rows that repeat an earlier row",
    "train-test": "test rows that are training rows too",
    "constant": "receivers that observe the same in every row, and blank spectra",
    "degrees": "longitudes and latitudes in degrees for metres",
    "unlike-units": "receivers and transmitters in different units, or rows in steps of a grid",
}
"""Names of the suspicions, and what the data are instead."""
Check = Callable[[Record], NamedTexts]
OF_VALUES: tuple[Check, ...] = (not_heard, few_rows, strength_scale, repeated_rows, constant_observations)
"""Suspicions about the values of a record."""
WARNED: tuple[Check, ...] = (not_heard, degrees)
"""Suspicions that a fit warns of: without a warning the scores alone would show them, as errors of some 10 dB."""
MOST_LINES = 10  # faults of one kind in one file that are printed; the others are counted


@dataclass(frozen=True)
class Suspicion:
    """Data that read well but are likely wrong.

    Attributes:
        name: kind of the suspicion, a key of `wrf_mi.apps.checking.SUSPICIONS`.
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
        """A line for each fault (at most some of one kind in one file), suspicion and note, and a summary."""
        lines = list(self._fault_lines(most))
        lines += [f"suspicion {suspicion.name}: {suspicion.text}" for suspicion in self.suspicions]
        lines += [f"note: {text}" for text in self.notes]
        if self.faults:
            summary = f"{_count(len(self.faults), 'fault')}; correct them, then check again for suspicions"
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

        def relative(file: Path) -> str:
            return str(file.relative_to(base)) if base in file.parents else str(file)

        for faults in kinds.values():
            for fault in faults[:most]:
                text = str(fault)
                if isinstance(fault, DataFault):
                    place = f", {fault.place}" if fault.place else ""
                    text = f"{relative(fault.file)}{place}: {fault.text}"
                yield f"fault: {text}"
            if len(faults) > most and isinstance(last := faults[-1], DataFault):
                file, remedy = last.kind
                where = f", up to {last.place}" if last.place else ""
                yield f"fault: {relative(Path(file))}: {len(faults) - most} more of this kind{where}; {remedy}"


def check_data(data: str | Path | Record, ignore: Collection[str] = (), progress: bool = False) -> DataReport:
    """Find every fault of a data set, and data that read well but are likely wrong (``docs/data.md``, "Checks").

    >>> report = check_data("laboratory")
    >>> report.ok, report.suspicions
    (True, ())

    Args:
        data: a folder, a file, or the name of a known data set, as of `wrf_mi.load`; or a record.
        ignore: names of suspicions that are not reported, keys of `SUSPICIONS`.
        progress: show a progress bar on standard error where the data set is made on this machine first.

    Returns:
        Faults and suspicions.

    Raises:
        InputError: there is no such data set, or no such suspicion.
    """
    if unknown := sorted(set(ignore) - set(SUSPICIONS)):
        raise InputError(f"suspicion {unknown[0]!r}: unknown; known are {', '.join(SUSPICIONS)}")
    if isinstance(data, Record):
        name, source = data.name, data.source
    else:
        name, source = str(data), str(_path(data) or "")

    def read() -> Record:
        record = data if isinstance(data, Record) else load_record(data, progress)
        check_parts(record)
        return record

    record, faults = collect_faults(read)
    if record is None:
        return DataReport(name, source, None, tuple(faults), ())
    suspicions = tuple(Suspicion(name, text) for name, text in _suspected(record) if name not in ignore)
    note = far_from_origin(record)
    return DataReport(name, record.source, record, (), suspicions, () if note is None else (note,))


def _suspected(record: Record) -> NamedTexts:
    for check in OF_VALUES:
        yield from check(record)
    yield from list(degrees(record)) or unlike_units(record)  # distances mean nothing in degrees


def warn_of_suspicions(record: Record) -> None:
    """Log what a fit would learn as measured though it is not: numbers for "not heard", and degrees for metres."""
    for check in WARNED:
        for name, text in check(record):
            logger.warning("%s: suspicion %s: %s (wrf-mi data check)", record.name, name, text)


def _path(dataset: str | Path) -> Path | None:
    """The data's folder or file; None if it has yet to be made on this machine; `InputError`: there is no such data
    set.
    """
    is_name = isinstance(dataset, str) and Path(dataset).name == dataset and not Path(dataset).exists()
    if is_name and known(str(dataset)).base_url is None:
        return locate(str(dataset))
    return find(dataset)[0]


def _plain(fault: InputError) -> dict[str, Any]:
    if not isinstance(fault, DataFault):
        return {"file": None, "place": "", "row": None, "text": str(fault)}
    return {"file": str(fault.file), "place": fault.place, "row": fault.row, "text": fault.text}


def _count(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'s' if number > 1 else ''}"
