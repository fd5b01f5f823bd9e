"""What signal strengths and channels have in common: a few numbers, received over the full sphere."""

from __future__ import annotations

import math
from typing import Any

ALONE = (
    "batch=16",
    "steps=18000",
    "initial.gaussians=60",
    "initial.size_deg=15",
    "network.width=64",
    "network.layers=4",
    "density.every=0",
    "validate_every=500",
    "patience=8",
)
"""Settings of a field that differ from a field of spectra: few numbers result."""
JOINT = (*ALONE, "traced.alone=0.05", "traced.materials=surface")
"""Settings of Gaussians beside the paths of a scene: the few parameters of paths converge soon."""


def sums_of_rays(parts: tuple[Any, Any], rays: int) -> tuple[Any, Any]:
    """Sums of real and imaginary parts [n * rays] over ``rays`` of equal solid angle, [n]."""
    import drjit as dr

    # The root makes the size of incoherent sums independent of the number of rays.
    re, im = (dr.block_sum(part, rays) * (1 / math.sqrt(rays)) for part in parts)
    return re, im
