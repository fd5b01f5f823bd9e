"""Paths of a scene: traced, stored, and evaluated with derivatives.

- `solve`: from antennas to paths with gains (`trace_paths`); `result`: the paths, their file, gains anew;
- `field_calculator`: the image method and polarised fields in Dr.Jit, differentiable;
- `scene_parameters`, `instrument_parameters`, `surface_gaussians`: what is trained;
- `traced_field`: paths of one receiver that follow these parameters, at one or several carriers;
- `corrected_scene`: a scene with trained planes and materials, as a folder or for another search.
"""

from ...backend import init

# Dr.Jit loads an LLVM when it is imported, so the choice must be made before.
init()
