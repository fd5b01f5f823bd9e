"""Counts of what an evaluation computed, and of what it left out because the result does not need it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock

Counts = dict[str, dict[str, int]]
EVALUATED, SKIPPED = "evaluated", "skipped"

_open: list[Counts] = []
_lock = Lock()


@contextmanager
def counted() -> Iterator[Counts]:
    """Context whose counts of `count`, ``evaluated`` and ``skipped`` by what is counted, are its value."""
    counts: Counts = {}
    _open.append(counts)
    try:
        yield counts
    finally:
        _open.pop()  # contexts end in the reverse order; equal counts are no reason to remove another one


def counting() -> bool:
    """Whether anything is counted."""
    return bool(_open)


def count(what: str, evaluated: int, skipped: int) -> None:
    """Add to the counts of the innermost `counted`, if there is one, from any thread."""
    if _open:
        with _lock:
            of = _open[-1].setdefault(what, {EVALUATED: 0, SKIPPED: 0})
            of[EVALUATED] += int(evaluated)
            of[SKIPPED] += int(skipped)


def added(parts: list[Counts]) -> Counts:
    """Sum of several counts."""
    with counted() as total:
        for part in parts:
            for what, of in part.items():
                count(what, of[EVALUATED], of[SKIPPED])
    return total
