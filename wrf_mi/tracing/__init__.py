"""Ray tracing by Sionna RT: scenes, paths, spectra."""

from __future__ import annotations

from .materials import set_frequency
from .options import TraceOptions
from .result import TraceResult, load_trace, recompute, save_trace
from .scenes import open_scene
from .solve import trace_paths
from .spectra import trace_spectra

__all__ = [
    "TraceOptions",
    "TraceResult",
    "load_trace",
    "open_scene",
    "recompute",
    "save_trace",
    "set_frequency",
    "trace_paths",
    "trace_spectra",
]
