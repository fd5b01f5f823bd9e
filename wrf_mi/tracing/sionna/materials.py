"""Radio materials at a frequency, also below the range of Sionna RT's table.

ITU-R P.2040 gives relative permittivity a f^b and conductivity c f^d (f in GHz) within a frequency range per
material, outside of which Sionna RT raises an error. Most building materials begin at 1 GHz, just above the 868 and
915 MHz bands of RFID and IoT.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any

import numpy as np
from wrf_mi_scenes.mitsuba_xml import PERFECT, PERFECT_CONDUCTIVITY, PERFECT_THICKNESS_M, THICKNESS_M

from ...core import InputError
from ...core.files import listed
from ...scene.materials import EXPONENT

logger = logging.getLogger(__name__)

BELOW_1_GHZ: Mapping[str, tuple[float, float]] = {
    "concrete": (5.24, 0.0462),
    "brick": (3.91, 0.0238),
    "plasterboard": (2.73, 0.0085),
    "ceiling_board": (1.48, 0.0011),
    "chipboard": (2.58, 0.0217),
    "plywood": (2.71, 0.33),
    "marble": (7.074, 0.0055),
    "vinyl_tile": (3.62, 0.0051),
    "carpet_tile": (2.08, 0.0009),
    "metal": (1.0, 1e7),
}
"""Relative permittivity and conductivity in S/m for 0.3 to 1 GHz: the values of ITU-R P.2040 at 1 GHz, where its range
begins. Its permittivities do not change with frequency, and its conductivities by 12 % or less down to 0.87 GHz."""

CONSTANTS_XML = (
    '<bsdf type="radio-material" id="{}"><float name="relative_permittivity" value="..."/>'
    '<float name="conductivity" value="..."/></bsdf>'
)
"""A material of Sionna RT with constants; its name must not begin with itu."""

CONSTANTS_FROM_HZ = 0.3e9  # lower end of the constants: below, the conductivity would be off by a factor of three


def perfect_reflector() -> Any:
    """Radio material with reflection coefficients of -1 and +1 to single precision, by a high conductivity."""
    from sionna import rt

    slab = {"thickness": PERFECT_THICKNESS_M, "conductivity": PERFECT_CONDUCTIVITY}
    return rt.RadioMaterial(PERFECT, relative_permittivity=1.0, **slab)


def absorbs(material: Any) -> bool:
    """Whether a radio material neither reflects nor transmits, and so has no constants."""
    from sionna.rt.radio_materials import AbsorberRadioMaterial

    return isinstance(material, AbsorberRadioMaterial)


def is_standard(material: Any) -> bool:
    """Whether a radio material is, but for its thickness, the one that a scene folder knows by its name."""
    if material.name == PERFECT:
        constants = float(material.relative_permittivity[0]), float(material.conductivity[0])
        return constants == (1.0, float(np.float32(PERFECT_CONDUCTIVITY)))
    return bool(material.name == f"itu_{getattr(material, 'itu_type', '')}")


CONSTANTS = ("relative_permittivity", "conductivity", "thickness")  # those in which materials differ
# Attributes of a radio material: its constants by frequency, and those of ITU-R P.2040 where others replace them.
CALLBACK, ITU_LAW = "_frequency_update_callback", "itu_law"


def set_frequency(
    scene: Any,
    frequency_hz: float,
    thickness_m: Mapping[str, float] | None = None,
    laws: Mapping[str, tuple[float, float]] = MappingProxyType({}),
) -> None:
    """Set a Sionna RT scene's frequency, with explicit constants for ITU materials below their range (logged).

    Args:
        scene: a ``sionna.rt.Scene``.
        frequency_hz: carrier frequency.
        thickness_m: new slab thickness of materials by name in the scene (``itu_*``), metres.
        laws: exponent of the conductivity, and carrier in Hz at which it is stated, of materials with constants.

    Raises:
        InputError: a material has neither a range of ITU-R P.2040 nor a constant at this frequency.
    """
    below_range = []
    for name, material in scene.radio_materials.items():
        if thickness_m and name in thickness_m:
            material.thickness = thickness_m[name]
        itu_type = getattr(material, "itu_type", None)
        if itu_type is None:
            if name in laws and not hasattr(material, EXPONENT):
                _follow(material, *laws[name])
        elif not in_itu_range(itu_type, frequency_hz):
            _extend(material, name, frequency_hz)
            below_range.append(itu_type)
        elif hasattr(material, ITU_LAW):  # of a scene that was below the range before
            material._frequency_update_callback = getattr(material, ITU_LAW)
    if below_range:
        text = "%g MHz is below the range of ITU-R P.2040 for %s: constant values of 1 GHz used"
        logger.info(text, frequency_hz / 1e6, listed(sorted(below_range)))
    for material in scene.radio_materials.values():
        if absorbs(material):
            # Sionna RT 2.2 calls this of every material when the frequency is set, and absorbers lack it.
            material.frequency_update = lambda: None
    scene.frequency = frequency_hz
    _share_kernels(scene, frequency_hz)


@contextmanager
def at_frequency(scene: Any, frequency_hz: float) -> Iterator[None]:
    """A Sionna RT scene of `set_frequency` at another carrier frequency, for the duration of a block.

    Raises:
        InputError: as `set_frequency`.
    """
    stated_hz, names = scene._frequency, (*CONSTANTS, CALLBACK)
    if float(stated_hz[0]) == np.float32(frequency_hz):
        yield
        return
    constants = [
        (material, {name: getattr(material, name) for name in names if hasattr(material, name)})
        for material in scene.radio_materials.values()
    ]
    try:
        set_frequency(scene, frequency_hz)
        yield
    finally:
        scene._frequency = stated_hz  # the setter would compute the constants anew
        for material, values in constants:
            for name, value in values.items():
                setattr(material, name, value)


def _extend(material: Any, name: str, frequency_hz: float) -> None:
    """Give an ITU material the constants of `BELOW_1_GHZ`; `InputError` where there are none at a frequency."""
    import mitsuba as mi
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    itu_type = material.itu_type
    if itu_type not in BELOW_1_GHZ or not CONSTANTS_FROM_HZ <= frequency_hz < 1e9:
        ranges_ghz = sorted(ITU_MATERIALS_PROPERTIES[itu_type])
        where = " and ".join(f"{low:g} to {high:g} GHz" for low, high in ranges_ghz)
        text = f"radio material {name}: not known at {frequency_hz / 1e9:g} GHz, ITU-R P.2040 has it for {where}"
        bsdf = CONSTANTS_XML.format(f"mat-my_{itu_type}")
        way = f"in a Mitsuba XML give its shapes a BSDF with explicit constants (S/m): {bsdf}"
        raise InputError(f"{text}; choose another material, or {way}")
    constants = BELOW_1_GHZ[itu_type]
    if not hasattr(material, ITU_LAW):
        setattr(material, ITU_LAW, material.frequency_update_callback)
    material.frequency_update_callback = lambda _: tuple(map(mi.Float, constants))


def _share_kernels(scene: Any, frequency_hz: float) -> None:
    import drjit as dr
    import mitsuba as mi

    # As literals they are part of the compiled code, which LLVM then compiles for each material and carrier anew.
    values = [
        (material, name, float(getattr(material, name)[0]))
        for material in scene.radio_materials.values()
        for name in CONSTANTS
        if hasattr(material, name)
    ]
    scene._frequency = dr.opaque(mi.Float, frequency_hz)  # the setter would evaluate all materials again, in float32
    for material, name, value in values:
        setattr(material, name, dr.opaque(mi.Float, value))


def _follow(material: Any, exponent: float, carrier_hz: float) -> None:
    """Let a material's conductivity, stated at a carrier, follow a power of the frequency."""
    permittivity, conductivity = material.relative_permittivity, material.conductivity
    material.frequency_update_callback = lambda hz: (permittivity, conductivity * (hz / carrier_hz) ** exponent)
    setattr(material, EXPONENT, exponent)


def conductivity_exponent(material: Any, frequency_hz: float) -> float:
    """Exponent d of a material's conductivity, which is proportional to f^d about a frequency; 0 without a law."""
    if (itu_type := getattr(material, "itu_type", None)) is None:
        return float(getattr(material, EXPONENT, 0.0))
    return itu_exponent(itu_type, frequency_hz)


def itu_exponent(name: str, frequency_hz: float) -> float:
    """`conductivity_exponent` of a material of ITU-R P.2040; 0 outside its range."""
    return next((float(values[3]) for values in _itu_constants_at(name, frequency_hz)), 0.0)


def in_itu_range(name: str, frequency_hz: float) -> bool:
    """Whether ITU-R P.2040 has a material, e.g. ``"concrete"``, at a frequency, so that Sionna RT knows it."""
    return bool(_itu_constants_at(name, frequency_hz))


def _itu_constants_at(name: str, frequency_hz: float) -> list[tuple[float, ...]]:
    """Constants a, b, c and d of a material in the ranges that hold a frequency."""
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES

    ranges = ITU_MATERIALS_PROPERTIES[name].items()
    return [values for (low, high), values in ranges if low <= frequency_hz / 1e9 <= high]


def itu_constants(frequency_hz: float) -> dict[str, tuple[float, float, float]]:
    """Relative permittivity, conductivity (S/m) and default thickness (m) of materials of ITU-R P.2040 by name.

    Materials that are not known at the frequency are left out; below 1 GHz see `BELOW_1_GHZ`.
    """
    from sionna.rt.radio_materials.itu import ITU_MATERIALS_PROPERTIES, itu_material

    constants = {}
    for name in ITU_MATERIALS_PROPERTIES:
        if in_itu_range(name, frequency_hz):
            permittivity, conductivity = (float(np.ravel(value)[0]) for value in itu_material(name, frequency_hz))
        elif name in BELOW_1_GHZ and CONSTANTS_FROM_HZ <= frequency_hz < 1e9:
            permittivity, conductivity = BELOW_1_GHZ[name]
        else:
            continue
        constants[name] = permittivity, conductivity, THICKNESS_M[f"itu_{name}"]
    return constants
