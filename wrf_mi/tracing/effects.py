"""Settings of a trace that change nothing beside the others."""

from __future__ import annotations

from dataclasses import fields

from .options import DEFAULTS, TraceOptions

FURTHER = ("transmission", "diffraction", "scattering")
"""Kinds of path that are traced only where they are asked for."""


def without_effect(options: TraceOptions) -> dict[str, str]:
    """Names of settings that differ from their defaults and change no path, with the reason."""
    reflects, interacts = options.reflections > 0, options.reflection or any(getattr(options, kind) for kind in FURTHER)
    by_rays, needs_rays = reflects or options.sampled, "no reflection, diffraction or scattering is traced"
    reasons = {
        # A depth of 0 says what such paths have.
        "max_depth": (options.max_depth > 0 and not interacts, "no path has an interaction"),
        "max_reflections": (bool(options.max_reflections) and not options.reflection, "no reflection is traced"),
        "rays": (not by_rays, needs_rays),
        "seed": (not by_rays, needs_rays),
        **{kind: (options.max_depth == 0, "max_depth is 0") for kind in FURTHER},
        "scattering_coefficient": (not options.scattering, "no scattering is traced"),
        "phase_error": (not by_rays, needs_rays),
    }
    if options.max_reflections is not None and options.reflection and options.max_reflections > options.max_depth:
        reasons["max_reflections"] = True, f"max_depth is {options.max_depth}"
    changed = {field.name for field in fields(options) if getattr(options, field.name) != getattr(DEFAULTS, field.name)}
    return {name: reason for name, (idle, reason) in reasons.items() if idle and name in changed}
