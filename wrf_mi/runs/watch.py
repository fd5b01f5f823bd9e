"""Progress on the terminal, and Ctrl-C that loses nothing."""

from __future__ import annotations

import math
import signal
import sys
from types import FrameType, TracebackType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from ..training.loop import Progress as FitProgress


class Watch:
    """Shows the stages of a fit (plain lines where output is not a terminal) and turns Ctrl-C into a stop.

    The first Ctrl-C lets the current step finish and writes a checkpoint; a second one ends at once.
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[text]}"), console=self._console
        )
        self._task: Any = None
        self._stage: str | None = None
        self._score = ""
        self._stop = False

    def __enter__(self) -> Watch:
        """Take over Ctrl-C."""
        self._before = signal.signal(signal.SIGINT, self._interrupt)
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

    def on_progress(self, stage: str, share: float, p: FitProgress | None = None) -> None:
        """Show that ``share`` (0..1) of a stage is done, and how a training goes."""
        new = stage != self._stage
        if new:
            self._stage, self._task, self._score = stage, None, ""
        text = "" if p is None else self._text(p)
        if self._console.is_terminal:
            if self._task is None:
                self._bar.start()  # not before: the tracer has a bar of its own
                self._task = self._bar.add_task(stage, total=1.0, text=text)
            self._bar.update(self._task, completed=share, text=text)
        elif p is not None and p.validation_score is not None:
            print(f"{stage} {p.step}/{round(p.step / share)}  {text}", file=sys.stderr, flush=True)
        elif p is None and new:
            print(stage, file=sys.stderr, flush=True)

    def _text(self, p: FitProgress) -> str:
        if p.validation_score is not None and not math.isnan(p.validation_score):  # it is without validation rows
            rows = "validation rows" if p.held_out else "validation rows, now trained on"
            self._score = f"{p.label} {p.validation_score:.3f} ({rows})"
        gaussians = f"{p.gaussians} Gaussians  " if p.gaussians else ""
        return f"loss {p.loss:.4f}  {self._score}  {gaussians}{_clock(p.left_s)} left"


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
