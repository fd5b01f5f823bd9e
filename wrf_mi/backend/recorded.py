"""Functions that Dr.Jit records once and replays."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import drjit as dr


class Recorded:
    """A function that Dr.Jit records on its first call and replays from then on (`dr.freeze`).

    Python's garbage collector is off meanwhile: freeing an array while Dr.Jit records, such as one that wraps NumPy's
    memory, ends the process. A recording has room for the sums of the threads at that time, and more threads write
    beyond it (Dr.Jit 1.5): with more threads the function is recorded anew.

    Args:
        function: function to record.
        state: returns arrays that the function reads beside its arguments, called before each call; None: no arrays.
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
            threads = dr.thread_count()
            if threads > self._threads:
                self._dropped += self._frozen.n_recordings
                self._frozen.clear()
                self._threads = threads
            return self._frozen(*arguments)
        finally:
            if collecting:
                gc.enable()

    @property
    def n_recordings(self) -> int:
        """Number of recordings of the function."""
        recordings: int = self._dropped + self._frozen.n_recordings
        return recordings
