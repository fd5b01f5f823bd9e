"""Where a fit keeps its work, what it reports to, and what stops it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .loop import Progress

OnProgress = Callable[[str, float, "Progress | None"], None]
"""Progress callback: stage, fraction of it that is done (0 to 1), and loss, score and time where steps are taken."""


def quiet(stage: str, share: float, progress: Progress | None = None) -> None:
    """A progress callback that shows nothing."""


class Interrupted(Exception):
    """A fit was stopped; what was fitted is stored."""

    exit_status = 130


@dataclass(frozen=True)
class FitSession:
    """Where a fit keeps its work and what it reports to.

    Attributes:
        folder: for files of this fit; that of one fold where there are several. ``checkpoint.npz`` in it is removed
            when the fitted model is stored. None: nothing is kept.
        run: the run folder, for files that all folds share.
        on_progress: progress callback.
        stop: asked whether to stop, wherever nothing would be lost.
    """

    folder: Path | None = None
    run: Path | None = None
    on_progress: OnProgress = quiet
    stop: Callable[[], bool] = lambda: False

    @property
    def fold(self) -> str:
        """Name of the fold; "" where there is one split."""
        return "" if self.folder is None or self.folder == self.run else self.folder.name

    def tell(self, stage: str, share: float, progress: Progress | None = None) -> None:
        """Report progress of a stage, named after its fold."""
        self.on_progress(f"{self.fold}: {stage}" if self.fold else stage, share, progress)

    def report(self, stage: str, share: float) -> None:
        """Report progress of what is made in one go.

        Raises:
            Interrupted: it is to stop.
        """
        self.tell(stage, share)
        if self.stop():
            raise self.interrupted(f"in {stage}")

    def interrupted(self, where: str) -> Interrupted:
        """The error that ends a fit which was stopped."""
        return Interrupted(f"stopped {where}; go on with: wrf-mi train --resume {self.run}")
