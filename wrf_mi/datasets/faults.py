"""Faults of data files: the first one ends reading, or all are collected.

Readers raise a `DataFault` at each check. `collect_faults` runs a reader such that reading goes on after the faults
that it can go on after: those raised by `refuse`, in a block of `recoverable`, or in a part that is read by `attempt`.
Without `collect_faults` these three raise at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, Generic, TypeVar, cast

from ..core import InputError

T = TypeVar("T")

_found: ContextVar[list[InputError] | None] = ContextVar("faults", default=None)
"""Faults found so far; None outside `collect_faults`."""


def collect_faults(read: Callable[[], T]) -> tuple[T | None, list[InputError]]:
    """Call a reader and collect the faults of the data in place of raising the first one.

    Returns:
        What the reader returns, None if there is a fault; and the faults in the order in which they were found.
    """
    found: list[InputError] = []
    token = _found.set(found)
    result = None
    try:
        result = read()
    except InputError as error:
        _note(found, error)
    finally:
        _found.reset(token)
    return (None if found else result), found


@contextmanager
def recoverable() -> Iterator[None]:
    """A block that reading can go on after: its fault is collected, or raised outside `collect_faults`."""
    found = _found.get()
    try:
        yield
    except InputError as error:
        if found is None:
            raise
        _note(found, error)


def refuse(fault: InputError) -> None:
    """Collect a fault that reading can go on after, or raise it outside `collect_faults`."""
    with recoverable():
        raise fault


def stop_at_faults() -> None:
    """Raise the first collected fault, before a step that needs everything read so far to be correct."""
    if found := _found.get():
        raise found[0]


class Attempt(Generic[T]):
    """Result of `attempt`."""

    def __init__(self, value: T | None, fault: InputError | None = None) -> None:
        self._value, self._fault = value, fault

    @property
    def value(self) -> T:
        """The value.

        Raises:
            InputError: the fault for which there is none.
        """
        if self._fault is not None:
            raise self._fault
        return cast(T, self._value)


def attempt(read: Callable[..., T], *arguments: Any, whole: bool = False) -> Attempt[T]:
    """Read a part of a data set; its fault is collected, or raised outside `collect_faults`.

    Args:
        read: function that reads the part.
        arguments: arguments of the function. An `Attempt`, also in a list, is replaced by its value; without a value
            the part is not read, and has none.
        whole: there is no value, either, where `read` went on after a fault.
    """
    found = _found.get()
    before = len(found or ())
    try:
        value = read(*map(_value_of, arguments))
    except InputError as error:
        if found is None:
            raise
        _note(found, error)
        return Attempt(None, error)
    if whole and found is not None and len(found) > before:
        return Attempt(None, found[before])
    return Attempt(value)


def _value_of(argument: Any) -> Any:
    if isinstance(argument, list):
        return [_value_of(part) for part in argument]
    return argument.value if isinstance(argument, Attempt) else argument


def _note(found: list[InputError], error: InputError) -> None:
    """Add a fault, unless it is there: parts that need a part without a value raise its fault again."""
    if not any(error is other for other in found):
        found.append(error)
