"""Functions that Dr.Jit records once and replays; see `wrf_mi.field.recorded`."""

from ..field.recorded import Recorded

__all__ = ["Recorded"]
