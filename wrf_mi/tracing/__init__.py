"""Ray tracing with Sionna RT: scenes, paths, spectra, and paths with derivatives.

Imports run upwards in this list:

- top level: `tracer` (observations of traced paths), `convergence` (choice of depth and rays), `power_map`, `deepmimo`;
- `paths`: traced paths, and their gains with derivatives in materials, planes, poses and patterns;
- `sionna`: adapter to Sionna RT, which opens scenes, computes gains, and searches for diffraction and scattering;
- `search`: chains of surfaces that can connect two antennas, the image method, and what obstructs a path;
- `options`: kinds of path, depth and rays of a trace.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .deepmimo import write_deepmimo
    from .options import TraceOptions
    from .paths.result import TraceResult, load_trace, recompute, save_trace
    from .paths.solve import trace_paths
    from .sionna.materials import set_frequency
    from .sionna.scenes import open_scene
    from .tracer import RayTracer

# Imported when first used: the command shows its help, and readers open files, without Sionna RT and trimesh.
__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "deepmimo": ["write_deepmimo"],
        "options": ["TraceOptions"],
        "paths.result": ["TraceResult", "load_trace", "recompute", "save_trace"],
        "paths.solve": ["trace_paths"],
        "sionna.materials": ["set_frequency"],
        "sionna.scenes": ["open_scene"],
        "tracer": ["RayTracer"],
    },
)

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
