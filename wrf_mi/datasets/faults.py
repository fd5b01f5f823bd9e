"""Faults of data files: the first one ends reading, or all are collected.

Readers raise a `DataFault` at each check. `collect_faults` runs a reader such that reading goes on after the faults
that it can go on after: those raised by `refuse`, in a block of `recoverable`, or in a part that is read by `attempt`.
Without `collect_faults` these three raise at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

from ..core import InputError

T = TypeVar("T")

_collected: ContextVar[list[InputError] | None] = ContextVar("faults", default=None)
"""Faults so far; None outside `collect_faults`."""


def collect_faults(read: Callable[[], T]) -> tuple[T | None, list[InputError]]:
    """What a reader returns, None if there is a fault, and the faults of the data in the order of reading."""
    collected: list[InputError] = []
    token = _collected.set(collected)
    result = None
    try:
        with recoverable():
            result = read()
    finally:
        _collected.reset(token)
    return (None if collected else result), collected


@contextmanager
def recoverable() -> Iterator[None]:
    """A block that reading can go on after: its fault is collected, or raised outside `collect_faults`."""
    collected = _collected.get()
    try:
        yield
    except InputError as error:
        if collected is None:
            raise
        # A part that needs another part without a value raises that part's fault again.
        if not any(error is other for other in collected):
            collected.append(error)


def refuse(fault: InputError) -> None:
    """Collect a fault that reading can go on after, or raise it outside `collect_faults`."""
    with recoverable():
        raise fault


def stop_at_faults() -> None:
    """Raise the first collected fault, before a step that needs everything read so far to be correct."""
    if collected := _collected.get():
        raise collected[0]


@dataclass
class Attempt(Generic[T]):
    """Result of `attempt`: its ``value``, or the fault that is raised where the value is needed."""

    result: T | None = None
    fault: InputError | None = None

    @property
    def value(self) -> T:
        """The value.

        Raises:
            InputError: the fault for which there is none.
        """
        if self.fault is not None:
            raise self.fault
        return cast(T, self.result)


def attempt(read: Callable[..., T], *arguments: Any, complete: bool = False) -> Attempt[T]:
    """Read a part of a data set; its fault is collected, or raised outside `collect_faults`.

    Args:
        read: function that reads the part.
        arguments: arguments of the function. An `Attempt`, also in a list, is replaced by its value; without a value
            the part is not read, and has none.
        complete: there is no value, either, where `read` went on after a fault.
    """
    before, part = len(_collected.get() or ()), Attempt[T]()
    with recoverable():
        try:
            part.result = read(*map(_value_of, arguments))
        except InputError as error:
            part.fault = error
            raise
    if complete and (later := (_collected.get() or [])[before:]):
        part.fault = later[0]
    return part


def _value_of(argument: Any) -> Any:
    if isinstance(argument, list):
        return [_value_of(part) for part in argument]
    return argument.value if isinstance(argument, Attempt) else argument
