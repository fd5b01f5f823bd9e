"""Progress on the terminal, and Ctrl-C that loses nothing."""

from __future__ import annotations

import math
import signal
import sys
from types import FrameType, TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from ..fit.trainer import Progress as FitProgress


class Watch:
    """Shows a progress bar (plain lines where output is not a terminal) and turns Ctrl-C into a stop.

    The first Ctrl-C lets the current step finish and writes a checkpoint; a second one ends at once.
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"), console=self._console
        )
        self._task: Any = None
        self._fold: str | None = None
        self._score = ""
        self._stop = False

    def __enter__(self) -> Watch:
        """Take over Ctrl-C and start the bar."""
        self._before = signal.signal(signal.SIGINT, self._interrupt)
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give back Ctrl-C and stop the bar."""
        if self._console.is_terminal:
            self._bar.stop()
        signal.signal(signal.SIGINT, self._before)

    def _interrupt(self, number: int, frame: FrameType | None) -> None:
        if self._stop:
            raise KeyboardInterrupt
        self._stop = True
        print("stopping after this step; Ctrl-C again ends at once", file=sys.stderr)

    def stop(self) -> bool:
        """Whether Ctrl-C was pressed."""
        return self._stop

    def listen(self, fold: str, steps: int, p: FitProgress) -> None:
        """Show one progress report."""
        if fold != self._fold:
            self._fold, self._task, self._score = fold, None, ""
        if p.validation_ssim is not None and not math.isnan(p.validation_ssim):  # it is without validation rows
            rows = "validation rows" if p.held_out else "validation rows, now trained on"
            self._score = f"SSIM {p.validation_ssim:.3f} ({rows})"
        text = f"loss {p.loss:.4f}  {self._score}  {p.gaussians} Gaussians  {_clock(p.left_s)} left"
        if self._console.is_terminal:
            if self._task is None:
                self._task = self._bar.add_task(fold or "training", total=steps, text=text)
            self._bar.update(self._task, completed=p.step, text=text)
        elif p.validation_ssim is not None:
            print(f"{fold or 'training'} {p.step}/{steps}  {text}", file=sys.stderr, flush=True)


class Stages:
    """Shows the stages of a fit that is not made of steps, each with the share of it that is done."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bar = Progress(TextColumn("{task.description}"), BarColumn(), console=self._console)
        self._what: str | None = None
        self._task: Any = None

    def __enter__(self) -> Stages:
        """Start the bar."""
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop the bar."""
        if self._console.is_terminal:
            self._bar.stop()

    def listen(self, what: str, share: float) -> None:
        """Show that ``share`` (0..1) of a stage is done."""
        if what != self._what:
            self._what = what
            if self._console.is_terminal:
                self._task = self._bar.add_task(what, total=1.0)
            else:
                print(what, file=sys.stderr, flush=True)
        if self._console.is_terminal:
            self._bar.update(self._task, completed=share)


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
