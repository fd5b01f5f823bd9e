"""Radio materials of surfaces, in a file that users may edit.

Rules give each kind of surface a material of ITU-R P.2040, and single surfaces may depart from them; ``perfect`` is a
perfect conductor, ``perfect_absorber`` neither reflects nor transmits:

    rules: {floor: itu_concrete, ceiling: itu_ceiling_board, wall: itu_plasterboard, other: itu_wood}
    surfaces: {floor: floor, wall_01: wall, wall_02: itu_glass}
    thickness_m: {itu_concrete: 0.25, itu_plasterboard: 0.1}

Materials of one's own have constants, which hold at every frequency, and names that do not begin with ``itu``. With
``conductivity_exponent`` d and ``carrier_hz`` f0 the conductivity at a frequency f is that stated times (f / f0)^d,
the law of ITU-R P.2040; a scene file holds it at f0:

    surfaces: {wall_03: panel}
    constants: {panel: {relative_permittivity: 2.9, conductivity: 0.01, thickness: 0.08}}

A wall may have a measured loss in place of constants, in dB at normal incidence and ``carrier_hz`` (2.4 GHz), as
programs for site surveys have it (`absorbing_slab`):

    surfaces: {wall_04: shop_front}
    constants: {shop_front: {loss_db: 4}}

Any material may scatter, with the share of the amplitude, and of the other polarisation's power, and a pattern of
Degli-Esposti et al. (2007), ``lambertian`` by default, ``directive`` (alpha_r) or ``backscattering`` (alpha_r, alpha_i,
lambda_):

    scattering: {itu_brick: {scattering_coefficient: 0.4, scattering_pattern: directive, alpha_r: 4}}
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.constants import epsilon_0, speed_of_light
from scipy.optimize import brentq
from wrf_mi_scenes.mitsuba_xml import ABSORBER, PERFECT, PERFECT_CONSTANTS, PERFECT_THICKNESS_M, Constants
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M as ITU_THICKNESS_M

from ..core import InputError
from ..core.yaml_files import read_yaml
from ..datasets.folder_files import SINGLE_MAX, shown
from .mesh.surfaces import KINDS
from .scattering import check_scattering

FILE = "materials.yml"
KEYS = ("rules", "surfaces", "thickness_m", "constants", "scattering")
EXPONENT, CARRIER = "conductivity_exponent", "carrier_hz"
"""Optional numbers of a material with constants; both or neither."""
STEEPEST = 5.0  # largest exponent; ITU-R P.2040 has 0 to 2.4
LEAST = {"relative_permittivity": 1.0, "conductivity": 0.0, "thickness": 0.0, EXPONENT: -STEEPEST, CARRIER: 0.0}
POSITIVE = ("thickness", CARRIER)  # constants that must be above `LEAST`
LOSS, MOST_LOSS_DB = "loss_db", 60.0
LOSS_CARRIER_HZ, LOSS_THICKNESS_M = 2.4e9, 0.1  # of a material with a loss: default carrier, and thickness of its slab
NAME = re.compile(r"(?!itu)\w+", re.ASCII)
SURFACE_NAME = re.compile(r"[\w.-]+")
THICKEST_M = 1e3
THICKNESS_M: Mapping[str, float] = {**ITU_THICKNESS_M, PERFECT: PERFECT_THICKNESS_M}
"""Default slab thickness of every slab, metres."""
KNOWN = (*THICKNESS_M, ABSORBER)  # materials without constants of the scene's own
RULES: Mapping[str, str] = {
    "floor": "itu_concrete",
    "ceiling": "itu_ceiling_board",
    "wall": "itu_plasterboard",
    "other": "itu_wood",
}
"""Default material of each kind of surface: an office building with partitions."""


@dataclass(frozen=True)
class Materials:
    """Radio materials of a scene.

    Attributes:
        rules: material of `KNOWN` of each kind of surface; by default those of `RULES`.
        surfaces: kind, or material, of each surface by its name.
        thickness_m: slab thickness of each material of `THICKNESS_M` in metres; by default the one there.
        constants: materials of the scene's own.
        scattering: scattering of materials by their names, see `check_scattering`; others do not scatter.
    """

    rules: Mapping[str, str] = field(default_factory=dict)
    surfaces: Mapping[str, str] = field(default_factory=dict)
    thickness_m: Mapping[str, float] = field(default_factory=dict)
    constants: Constants = field(default_factory=dict)
    scattering: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def of(self, name: str, kind: str) -> str:
        """Material of a surface, by its entry or else by its kind's rule."""
        entry = self.surfaces.get(name, kind)
        return entry if entry in KNOWN or entry in self.constants else {**RULES, **self.rules}[entry]

    def by_surface(self) -> dict[str, str]:
        """Material of each listed surface by its name."""
        return {name: self.of(name, "other") for name in self.surfaces}

    @property
    def laws(self) -> dict[str, tuple[float, float]]:
        """Exponent of the conductivity, and the carrier in Hz at which it is stated, of materials with such a law."""
        return {name: (v[EXPONENT], v[CARRIER]) for name, v in self.constants.items() if EXPONENT in v}

    def complete(self, kinds: Mapping[str, str]) -> Materials:
        """Materials with every rule, every surface and the thickness of every used material stated.

        Surfaces have the kinds by name that are given, unless ``surfaces`` states otherwise.
        """
        entries = {name: self.surfaces.get(name, kind) for name, kind in kinds.items()}
        full = replace(self, rules={**RULES, **self.rules}, surfaces=entries)
        used = dict.fromkeys([*full.rules.values(), *(full.of(name, "other") for name in entries)])
        thickness_m = {m: float(self.thickness_m.get(m, THICKNESS_M[m])) for m in used if m in THICKNESS_M}
        return replace(full, thickness_m=thickness_m)


def read_materials(path: str | Path) -> Materials:
    """Read and check a ``materials.yml``, or that of a scene folder.

    `InputError`: missing, not YAML, an unknown kind or material, or a thickness or constant out of range.
    """
    file = Path(path)
    file = file / FILE if file.is_dir() else file
    parts = _read_parts(file)
    for name, values in parts["constants"].items():
        _check_constants(file, name, values)
        if LOSS in values:
            parts["constants"][name] = absorbing_slab(**values)
    allowed = (*parts["constants"], *KNOWN)
    for kind, material in parts["rules"].items():
        if kind not in KINDS:
            raise InputError(f"{file}: rules: no kind {kind!r}; known are {', '.join(KINDS)}")
        _check_material(f"{file}: rules: {kind}", material, allowed)
    for name, entry in parts["surfaces"].items():
        if not isinstance(name, str) or not SURFACE_NAME.fullmatch(name):
            raise InputError(f"{file}: surfaces: {shown(name)} names no mesh; use letters, digits, _, - and .")
        _check_material(f"{file}: surfaces: {name}", entry, (*KINDS, *allowed))
    thicknesses(file, parts["thickness_m"])
    for name, facts in parts["scattering"].items():
        _check_material(f"{file}: scattering", name, (*parts["constants"], *THICKNESS_M))
        check_scattering(f"{file}: scattering: {name}", facts)
    return Materials(**parts)


def _read_parts(file: Path) -> dict[str, dict[Any, Any]]:
    """Mapping of each of `KEYS`, empty where the file has none."""
    content = read_yaml(file)
    content.pop("velocities_mps", None)  # in files of earlier versions
    if not set(content) <= set(KEYS):
        raise InputError(f"{file}: give the keys {', '.join(KEYS)}, no others")
    parts = {key: content.get(key) or {} for key in KEYS}
    for key, part in parts.items():
        if not isinstance(part, dict):
            raise InputError(f"{file}: {key} must be a mapping, such as {{wall: itu_brick}}")
    return parts


def _check_material(where: str, material: Any, allowed: Sequence[str]) -> None:
    if material not in allowed:
        raise InputError(f"{where}: unknown material {shown(material)}; known are {', '.join(allowed)}")


def thicknesses(file: Path, values: Any) -> dict[str, float]:
    """Thicknesses in metres of materials by name; `InputError` for anything else in ``stated``, a part of a file."""
    if not isinstance(values, dict):
        raise InputError(f"{file}: thickness_m is {shown(values)}; it must be a mapping, such as {{itu_brick: 0.2}}")
    for material, thickness in values.items():
        if material not in THICKNESS_M:
            allowed = ", ".join(THICKNESS_M)
            raise InputError(f"{file}: thickness_m: unknown material {shown(material)}; known are {allowed}")
        if not _is_number(thickness) or not 0 < thickness <= THICKEST_M:
            text = f"{file}: thickness_m: {material} is {shown(thickness)}"
            raise InputError(f"{text}; give metres above 0, {THICKEST_M:g} at most")
    return dict(values)


def _is_number(value: Any) -> bool:
    """Whether a value is a number that is finite in single precision."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= SINGLE_MAX


def _in_range(key: str, value: Any) -> bool:
    return _is_number(value) and (value > 0 if key in POSITIVE else value >= LEAST[key])


def _check_constants(file: Path, name: Any, values: Any) -> None:
    where = f"{file}: constants: {name}"
    if not isinstance(name, str) or not NAME.fullmatch(name) or name in (*KNOWN, *KINDS):
        raise InputError(f"{where}: choose a name of letters, digits and _ that is no kind and does not begin with itu")
    needed = set(PERFECT_CONSTANTS)
    forms = needed, needed | {EXPONENT, CARRIER}, {LOSS}, {LOSS, CARRIER}
    if not isinstance(values, dict) or set(values) not in forms:
        law = f"{EXPONENT} and {CARRIER} for a law of the conductivity"
        raise InputError(f"{where}: give {', '.join(PERFECT_CONSTANTS)}, with {law}; or {LOSS}")
    if LOSS in values and not (_is_number(values[LOSS]) and 0 < values[LOSS] <= MOST_LOSS_DB):
        raise InputError(f"{where}: {LOSS} is {shown(values[LOSS])}; give dB above 0, {MOST_LOSS_DB:g} at most")
    for key, value in values.items():
        if key != LOSS and not _in_range(key, value):
            raise InputError(f"{where}: {key} is {shown(value)}; give a number from {LEAST[key]:g} upwards")
    if abs(values.get(EXPONENT, 0)) > STEEPEST:
        raise InputError(f"{where}: {EXPONENT} is {values[EXPONENT]!r}; give -{STEEPEST:g} to {STEEPEST:g}")


def absorbing_slab(loss_db: float, carrier_hz: float = LOSS_CARRIER_HZ) -> dict[str, float]:
    """Constants of a slab that absorbs a loss in dB at normal incidence.

    Its permittivity is that of air, so that it reflects no more than its loss makes it to: a tenth of the amplitude at
    a loss of 6 dB. The loss of another carrier above differs by less than 0.5 dB up to 12 dB.

    Args:
        loss_db: ratio of incident to transmitted power, dB, above 0.
        carrier_hz: carrier at which it was measured, Hz.

    >>> absorbing_slab(6.0)
    {'relative_permittivity': 1.0, 'conductivity': 0.03732, 'thickness': 0.1}
    """

    def excess_db(conductivity: float) -> float:
        # Transmission of a slab, see `wrf_mi.tracing.slabs.slab_coefficients`, at normal incidence.
        index = np.sqrt(1 - 1j * conductivity / (2 * np.pi * carrier_hz * epsilon_0))
        reflected = (1 - index) / (1 + index)
        passed = np.exp(-2j * np.pi * carrier_hz / speed_of_light * LOSS_THICKNESS_M * index)
        transmitted = (1 - reflected**2) * passed / (1 - (reflected * passed) ** 2)
        return float(-20 * np.log10(np.abs(transmitted))) - loss_db

    # Without reflection a slab absorbs 20 log10(e) / 2 times conductivity, thickness and impedance of free space: this
    # conductivity is the least, and a hundred times it reflects more than the loss.
    least = loss_db * np.log(10) / (10 * LOSS_THICKNESS_M * 377)
    conductivity = float(brentq(excess_db, least / 2, 100 * least))
    return dict(zip(PERFECT_CONSTANTS, (1.0, float(f"{conductivity:.4g}"), LOSS_THICKNESS_M), strict=True))


def materials_text(materials: Materials) -> str:
    """The text of a ``materials.yml``."""
    head = (
        "# Radio materials of this scene (of ITU-R P.2040, perfect, or perfect_absorber). rules: of each kind of\n"
        "# surface; surfaces: the kind of each, or a material of its own; constants: relative permittivity,\n"
        "# conductivity (S/m) and thickness (m) of further materials; scattering: of any material.\n"
        "# Edit, then open the scene with wrf-mi: scene.xml follows.\n"
    )
    facts = {key: dict(part) for key, part in vars(materials).items() if part or key not in KEYS[3:]}
    return head + yaml.safe_dump(facts, sort_keys=False, width=110)
