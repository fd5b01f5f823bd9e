"""Diffuse scattering of radio materials: what a scene states about it, and a coefficient that options state instead.

Degli-Esposti et al., "Measurement and modelling of scattering from buildings" (2007), IEEE Trans. Antennas Propag.
55(1): of the reflected power the share S^2 is scattered by a pattern, and 1 - S^2 stays in the specular reflection.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from threading import RLock
from typing import Any

from ... import backend
from ...scene.scattering import PATTERN, PATTERNS, SHARES
from ..options import TraceOptions

COEFFICIENT = SHARES[0]
DIGITS = 7  # of a number in single precision, which 0.6 is then again


def scattering_coefficients(scene: Any) -> dict[str, float]:
    """Scattering coefficient of each material of a ``sionna.rt.Scene`` by its name; absorbers have none."""
    able = {name: m for name, m in scene.radio_materials.items() if hasattr(m, COEFFICIENT)}
    return {name: _number(getattr(material, COEFFICIENT)) for name, material in able.items()}


def scatters(scene: Any, options: TraceOptions) -> bool:
    """Whether any surface of a ``sionna.rt.Scene`` scatters in a trace with scattering."""
    coefficient = options.scattering_coefficient
    return any(scattering_coefficients(scene).values()) if coefficient is None else coefficient > 0


def scattering_of(material: Any) -> dict[str, Any]:
    """What a radio material of Sionna RT states about scattering; nothing by default.

    As `wrf_mi.scene.scattering.check_scattering` takes it, but for patterns that are none of Sionna RT's, which have
    the names of their classes.
    """
    if not hasattr(material, COEFFICIENT):
        return {}
    facts: dict[str, Any] = {name: _number(getattr(material, name)) for name in SHARES}
    facts = {name: value for name, value in facts.items() if value}
    pattern = material.scattering_pattern
    kind = type(pattern).__name__.removesuffix("Pattern").lower()
    if kind == next(iter(PATTERNS)):
        return facts
    parameters = {name: _number(getattr(pattern, name)) for name in PATTERNS.get(kind, ())}
    return {**facts, PATTERN: kind, **parameters}


def set_scattering(scene: Any, stated: Mapping[str, Mapping[str, Any]]) -> None:
    """Set scattering, as `check_scattering` takes it, of materials of a ``sionna.rt.Scene``; others have no effect."""
    from sionna.rt.radio_materials import scattering_pattern_registry

    for name in stated.keys() & scene.radio_materials.keys():
        material, facts = scene.radio_materials[name], stated[name]
        for share in facts.keys() & SHARES:
            setattr(material, share, facts[share])
        if PATTERN in facts:
            parameters = {key: facts[key] for key in PATTERNS[facts[PATTERN]] if key in facts}
            material.scattering_pattern = scattering_pattern_registry.get(facts[PATTERN])(**parameters)


def _number(value: Any) -> Any:
    return value if isinstance(value, int) else float(f"{value[0]:.{DIGITS}g}")


@contextmanager
def scattering_materials(scene: Any, options: TraceOptions) -> Iterator[None]:
    """Materials of a scene for a trace, as the scene states them or with options' scattering, in one thread at a time.

    A scattering coefficient of the options replaces that of all materials while the block lasts, if scattering is on.
    """
    # Flags of Dr.Jit, by which a GPU divides exactly, are those of a thread. Other threads that trace in the scene
    # wait, as its materials and its carrier change for a trace. Setting a default is atomic.
    backend.init()
    with vars(scene).setdefault("wrf_mi_lock", RLock()):
        replaced = options.scattering and options.scattering_coefficient is not None
        coefficients = scattering_coefficients(scene) if replaced else {}
        for name in coefficients:
            scene.radio_materials[name].scattering_coefficient = options.scattering_coefficient
        try:
            yield
        finally:
            for name, coefficient in coefficients.items():
                scene.radio_materials[name].scattering_coefficient = coefficient
