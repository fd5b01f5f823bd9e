"""Ray tracing by Sionna RT: scenes, paths, spectra, and paths with derivatives."""

from __future__ import annotations

from .deepmimo import write_deepmimo
from .options import TraceOptions
from .paths.result import TraceResult, load_trace, recompute, save_trace
from .paths.solve import trace_paths
from .sionna.materials import set_frequency
from .sionna.scenes import open_scene
from .tracer import RayTracer

__all__ = [
    "RayTracer",
    "TraceOptions",
    "TraceResult",
    "load_trace",
    "open_scene",
    "recompute",
    "save_trace",
    "set_frequency",
    "trace_paths",
    "write_deepmimo",
]
