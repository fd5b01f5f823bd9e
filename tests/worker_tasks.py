"""What tests let workers compute, and a scheduler that loses one of its workers half-way."""

import os
import signal
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Self

from wrf_mi.core import InputError
from wrf_mi.parallel import Scheduler


def double(part: int) -> int:
    return 2 * part


def refuse_negative(part: int) -> int:
    if part < 0:
        raise InputError(f"part {part}: negative; give another")
    return part


def fail(part: int) -> int:
    raise ZeroDivisionError("no such number")


def die(part: int) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return part


def opened(folder: Path) -> Path:
    """Leaves a file for each time that something is opened."""
    (folder / f"opened-{os.getpid()}-{len(list(folder.glob('opened-*')))}").touch()
    return folder


def place_of(folder: Path, part: int) -> tuple[int, str, str | None, str]:
    """Where a part is computed."""
    import mitsuba as mi

    return os.getpid(), os.getcwd(), os.environ.get("WRF_MI_DATA"), mi.variant()


def computed(folder: Path) -> Counter[str]:
    """How often each part was begun."""
    return Counter((folder / "begun").read_text().split())


def _begin(folder: Path, deadly: int, function: Callable[..., Any], *arguments: Any) -> Any:
    index, part = arguments[-1]
    with (folder / "begun").open("a") as stream:
        stream.write(f"{index}\n")
    if index == deadly and computed(folder)[str(index)] == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return function(*arguments[:-1], part)


class Lossy:
    """A scheduler whose worker dies when it begins the middle part for the first time.

    Args:
        scheduler: that computes.
        folder: keeps count; for one call of ``map``.
    """

    def __init__(self, scheduler: Scheduler, folder: Path) -> None:
        self._scheduler, self._folder = scheduler, folder
        self.workers = scheduler.workers
        self.parts = 0

    def map(self, function: Callable[..., Any], parts: Sequence[Any], *given: Any, **named: Any) -> list[Any]:
        self.parts = len(parts)
        begin = partial(_begin, self._folder, len(parts) // 2, function)
        return self._scheduler.map(begin, list(enumerate(parts)), *given, **named)

    def assert_one_was_lost(self) -> None:
        """Every part was computed, and the middle one twice, as its worker was lost."""
        counts = computed(self._folder)
        assert sorted(map(int, counts)) == list(range(self.parts))
        assert counts[str(self.parts // 2)] == 2

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        pass
