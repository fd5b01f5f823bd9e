"""Functions that Dr.Jit records once and replays."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr


class Recorded:
    """A function that Dr.Jit records on its first call and replays from then on (`dr.freeze`).

    Python's garbage collector waits meanwhile: an array that it frees while Dr.Jit records, one that wraps
    NumPy's memory for instance, ends the process.

    What was recorded has room for the sums of as many threads as there were then, and more threads write beyond it
    (Dr.Jit 1.5): where there are more now, it is recorded anew.

    Args:
        function: what is recorded.
        state: arrays that the function reads beside its arguments, asked for before each call; None: it reads none.
    """

    def __init__(self, function: Callable[..., Any], state: Callable[[], Any] | None = None) -> None:
        self._frozen: Any = dr.freeze(function, state_fn=None if state is None else lambda *_: state())
        self._threads = 0
        self._dropped = 0

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            self._fit_threads()
            return self._frozen(*arguments)
        finally:
            if collecting:
                gc.enable()

    @property
    def n_recordings(self) -> int:
        """How often the function was recorded."""
        recordings: int = self._dropped + self._frozen.n_recordings
        return recordings

    def _fit_threads(self) -> None:
        """Drop what fewer threads have recorded."""
        threads = dr.thread_count()
        if threads > self._threads:
            self._dropped += self._frozen.n_recordings
            self._frozen.clear()
            self._threads = threads
