"""Session of a fit: its folder, its progress callback and its stop condition."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from .loop import Progress


class OnProgress(Protocol):
    """Progress callback: stage, fraction of it that is done (0 to 1), and loss, score and time of optimiser steps."""

    def __call__(self, stage: str, share: float, progress: Progress | None = None, /) -> None:
        """Report progress."""


def quiet(stage: str, share: float, progress: Progress | None = None, /) -> None:
    """Progress callback that shows nothing."""


class Interrupted(Exception):
    """A fit was stopped; its state is stored."""

    exit_status = 130


@dataclass(frozen=True)
class FitSession:
    """Folder, progress callback and stop condition of a fit."""

    # folder for files of this fit (of one fold where there are several). ``checkpoint.npz`` in it is removed when the
    # fitted model is stored. None: no files are written
    folder: Path | None = None
    run: Path | None = None  # the run folder, for files that all folds share
    on_progress: OnProgress = quiet  # progress callback
    stop: Callable[[], bool] = lambda: False  # stop condition, called wherever nothing would be lost

    @property
    def fold(self) -> str:
        """Name of the fold; "" where there is one split."""
        return "" if self.folder is None or self.folder == self.run else self.folder.name

    def tell(self, stage: str, share: float, progress: Progress | None = None) -> None:
        """Report progress of a stage, named after its fold."""
        self.on_progress(f"{self.fold}: {stage}" if self.fold else stage, share, progress)

    def report(self, stage: str, share: float, progress: Progress | None = None, /) -> None:
        """Report progress of a fit without checkpoints (Interrupted: the stop condition holds)."""
        self.tell(stage, share, progress)
        if self.stop():
            raise self.interrupted(f"in {stage}")

    def interrupted(self, where: str) -> Interrupted:
        """The error that ends a fit which was stopped."""
        return Interrupted(f"stopped {where}; go on with: wrf-mi train --resume {self.run}")
