"""How much of many parts is done, on standard error."""

from __future__ import annotations

import sys
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

LINES = 10
"""Lines in all where standard error is a file."""


class Parts:
    """A bar on a terminal; elsewhere a line at each tenth.

    Args:
        what: is done.
        total: rows in all parts.
        lines: whether to print these lines.
    """

    def __init__(self, what: str, total: int, lines: bool) -> None:
        self._lines = lines
        self._what, self._total, self._done, self._shown, self._waits = what, total, 0, 0, False
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._task = self._bar.add_task(what, total=total)

    def __enter__(self) -> Parts:
        """Start the bar."""
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the bar."""
        self._bar.stop()

    def advance(self, rows: int, workers: int) -> None:
        """So many more rows are done, and so many workers are there."""
        self._done, self._waits = self._done + rows, False
        by = f"{workers} worker{'s' * (workers != 1)}"
        self._bar.update(self._task, completed=self._done, description=f"{self._what}, {by}")
        if self._lines and self._bar.disable and self._done * LINES // self._total > self._shown:
            self._shown = self._done * LINES // self._total
            print(f"{self._what}: {self._done} of {self._total}, {by}", file=sys.stderr, flush=True)

    def waiting(self) -> None:
        """There is no worker at the moment."""
        self._bar.update(self._task, description=f"{self._what}, waiting for a worker")
        if self._bar.disable and not self._waits:
            print(f"{self._what}: waiting for a worker to connect to the scheduler", file=sys.stderr, flush=True)
        self._waits = True
