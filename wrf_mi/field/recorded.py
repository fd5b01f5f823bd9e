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

    Args:
        function: what is recorded.
        state: arrays that the function reads beside its arguments, asked for before each call; None: it reads none.
    """

    def __init__(self, function: Callable[..., Any], state: Callable[[], Any] | None = None) -> None:
        self._frozen: Any = dr.freeze(function, state_fn=None if state is None else lambda *_: state())

    def __call__(self, *arguments: Any) -> Any:
        """Call the function."""
        collecting = gc.isenabled()
        gc.disable()
        try:
            return self._frozen(*arguments)
        finally:
            if collecting:
                gc.enable()

    @property
    def n_recordings(self) -> int:
        """How often the function was recorded."""
        return self._frozen.n_recordings
