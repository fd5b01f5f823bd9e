"""Session of a fit: its folder, its progress callback and its stop condition."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

if TYPE_CHECKING:
    from .loop import Progress


class OnProgress(Protocol):
    """Progress callback: stage, fraction of it that is done (0 to 1), and loss, score and time of optimiser steps."""

    def __call__(self, stage: str, share: float, progress: Progress | None = None, /) -> None:
        """Show progress."""


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
    # folders that are removed once the fitted model is stored; an error before leaves them to a resumed fit
    discarded: list[Path] = field(default_factory=list, kw_only=True)
    # the run folder that ``train --resume`` goes on with, where ``run`` is the folder of a part; None: ``run``
    root: Path | None = field(default=None, kw_only=True)

    def of_part(self, folder: Path, folders: Sequence[Path]) -> Self:
        """Session of one of the folders of a run: of a fold, or of the fit to all rows, named in its progress."""
        if len(folders) == 1:
            return replace(self, folder=folder, root=self.run)
        count = len(folders) - (self.run in folders)
        name = "all rows" if folder == self.run else f"fold {folders.index(folder) + 1} of {count}"
        on_progress, named = self.on_progress, replace(self, folder=folder, root=self.run)
        return replace(named, on_progress=lambda stage, *more: on_progress(f"{name}: {stage}", *more))

    def progress(self, stage: str, share: float, progress: Progress | None = None, /) -> None:
        """Call the progress callback in a fit without checkpoints (Interrupted: the stop condition holds)."""
        self.on_progress(stage, share, progress)
        if self.stop():
            raise self.interrupted(f"in {stage}")

    def interrupted(self, where: str) -> Interrupted:
        """The error that ends a fit which was stopped."""
        return Interrupted(f"stopped {where}; go on with: wrf-mi train --resume {self.root or self.run}")
