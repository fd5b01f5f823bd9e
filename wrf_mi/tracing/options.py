"""Options of a trace: kinds of path, depth, rays."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from ..core import InputError

MAX_DEPTH = 12  # most interactions of a path: each costs walls some decibels, and candidates grow with every one
MAX_RAYS = 1 << 24  # most rays from a source, whose hits have to fit into the memory
MAX_DEGREE = 8  # largest degree of trainable antenna patterns, near the limit of Dr.Jit's `sh_eval`
FACTOR, DISC = "surface.factor", "surface.disc"
"""Parameters of Gaussians on surfaces (`wrf_mi.tracing.paths.surface_gaussians`): trained [2, g], logarithmic
amplitudes and phases in rad, and constant [6, g], centres in metres and unit normals."""

Depth = Annotated[int, Field(ge=0, le=MAX_DEPTH, description=f"0 to {MAX_DEPTH}")]
Rays = Annotated[int | Literal["auto"], Field(ge=1, le=MAX_RAYS, description=f"1 to {MAX_RAYS}")]


@dataclass(frozen=True, kw_only=True)
class SpecularOptions:
    """Options of the search for specular paths, which the settings of every model with a scene embed.

    Attributes:
        depth: largest number of interactions per path, transmissions included.
        reflections: largest number of reflections among them; None: ``depth``.
        transmission: whether paths pass straight through surfaces (slabs of the material's thickness).
        rays: number of rays from each source (best a power of two).
    """

    depth: Depth = 3
    reflections: int | None = 3
    transmission: bool = True
    rays: Rays = 1 << 16

    @property
    def options(self) -> TraceOptions:
        """Options of a trace: those that these settings have, and the defaults of all others."""
        names = [field.name for field in fields(TraceOptions) if hasattr(self, field.name)]
        return TraceOptions(**{name: getattr(self, name) for name in names})


@dataclass(frozen=True)
class TraceOptions(SpecularOptions):
    """Settings of `wrf_mi.tracing.trace_paths`; kinds of path that are off cost no time.

    >>> options = TraceOptions(depth=4, reflections=1)
    >>> options.transmission, options.diffraction
    (True, False)

    Attributes:
        line_of_sight: the direct path.
        reflection: specular reflections.
        transmission: transmissions straight through surfaces (slabs of the material's thickness).
        diffraction: one diffraction at an edge.
        scattering: diffuse reflection at surfaces whose materials scatter.
        depth: largest number of interactions per path, transmissions included.
        reflections: largest number of reflections among them, except in paths with scattering or diffraction; None:
            ``depth``.
        rays: number of rays from each source (best a power of two), or ``"auto"``: doubled until the paths of a sample
            of positions converge, see `wrf_mi.tracing.paths.solve.converged_rays`.
        seed: seed of the rays' directions.
        scattering_coefficient: share of the reflected amplitude that every surface scatters, 0..1, if ``scattering`` is
            on; None: that of each material.
        phase_error: standard deviation of the phase that each reflection adds, rad, for errors of a mesh and of its
            materials; spectra are then expectations (`wrf_mi.receivers.instruments.Instrument`).
    """

    line_of_sight: bool = True
    reflection: bool = True
    diffraction: bool = False
    scattering: bool = False
    reflections: int | None = None
    rays: int | Literal["auto"] = 1 << 17
    seed: int = 1
    scattering_coefficient: float | None = None
    phase_error: float = 0.0

    def __post_init__(self) -> None:
        """Check the settings; `InputError` for one that is out of range."""
        is_auto, is_number, share = self.rays == "auto", isinstance(self.rays, int), self.scattering_coefficient
        ranges = {
            "depth": (0 <= self.depth <= MAX_DEPTH, f"0 to {MAX_DEPTH}"),
            "reflections": (self.reflections is None or self.reflections >= 0, "0 or more"),
            "rays": (is_auto or (is_number and 1 <= int(self.rays) <= MAX_RAYS), f'1 to {MAX_RAYS}, or "auto"'),
            "seed": (self.seed >= 0, "0 or more"),
            "scattering_coefficient": (share is None or 0 <= share <= 1, "a number in 0..1"),
            "phase_error": (0 <= self.phase_error < np.inf, "0 or more, rad"),
        }
        for name, (valid, text) in ranges.items():
            if not valid:
                raise InputError(f"{name} {getattr(self, name)}: give {text}")

    @property
    def most_reflections(self) -> int:
        """Largest number of reflections of a specular path."""
        reflections = self.depth if self.reflections is None else self.reflections
        return min(reflections, self.depth) if self.reflection else 0

    @property
    def surfaces_met(self) -> int:
        """Largest number of surfaces that a ray of the search for specular paths meets."""
        return self.depth if self.transmission else self.most_reflections

    @property
    def sampled(self) -> bool:
        """Whether paths are drawn at random (scattering) or along edges, by Sionna RT's search."""
        return (self.diffraction or self.scattering) and self.depth > 0


DEFAULTS = TraceOptions()

FURTHER = ("diffraction", "scattering")  # kinds of path that are traced only where they are asked for

KINDS = ("line-of-sight", "reflection", "transmission", "diffraction", "scattering")  # kinds of path, for the command


def stated_kinds(text: str) -> dict[str, bool]:
    """Fields of `TraceOptions` for the kinds of path in a list separated by commas; `InputError` for unknown ones."""
    asked = [kind.strip() for kind in text.split(",")]
    if unknown := [kind for kind in asked if kind not in KINDS]:
        raise InputError(f"kind of path {unknown[0]!r}: unknown; choose from {', '.join(KINDS)}")
    return {kind.replace("-", "_"): kind in asked for kind in KINDS}


def without_effect(options: TraceOptions) -> dict[str, str]:
    """Names of settings that change no path with the values of the others, with the reason."""
    interacts = any(getattr(options, kind) for kind in ("reflection", "transmission", *FURTHER))
    without_rays = not max(options.most_reflections, options.sampled)
    needs_rays = without_rays, "no reflection, diffraction or scattering is traced"
    most, limit = (options.depth, f"depth is {options.depth}") if options.reflection else (0, "no reflection is traced")
    reasons = {
        # A depth of 0 says what such paths have.
        "depth": (options.depth > 0 and not interacts, "no path has an interaction"),
        "reflections": ((options.reflections or 0) > most, limit),
        "rays": needs_rays,
        "seed": needs_rays,
        **{kind: (getattr(options, kind) and options.depth == 0, "depth is 0") for kind in FURTHER},
        "scattering_coefficient": (not options.scattering, "no scattering is traced"),
        "phase_error": needs_rays,
    }
    return {name: reason for name, (is_idle, reason) in reasons.items() if is_idle}
