"""Which radio material each surface is of, kept in one file that a person may edit.

A scan tells geometry, not what a wall is made of. Rules give each kind of surface a material of ITU-R P.2040, and
single surfaces may depart from them; ``perfect`` is a perfect conductor:

    rules: {floor: itu_concrete, ceiling: itu_ceiling_board, wall: itu_plasterboard, other: itu_wood}
    surfaces: {floor: floor, wall_01: wall, wall_02: itu_glass}
    thickness_m: {itu_concrete: 0.25, itu_plasterboard: 0.1}
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml
from wrf_mi_scenes.mitsuba_xml import PERFECT, PERFECT_THICKNESS_M
from wrf_mi_scenes.mitsuba_xml import THICKNESS_M as ITU_THICKNESS_M

from ..core import InputError
from ..core.files import one_line, text_lines
from .surfaces import KINDS

FILE = "materials.yml"
THICKNESS_M: Mapping[str, float] = {**ITU_THICKNESS_M, PERFECT: PERFECT_THICKNESS_M}
"""Slab thickness of every material that a surface may be of, metres, where the file gives none."""
RULES: Mapping[str, str] = {
    "floor": "itu_concrete",
    "ceiling": "itu_ceiling_board",
    "wall": "itu_plasterboard",
    "other": "itu_wood",
}
"""Material of each kind of surface where nothing else is said: an office building with partitions."""


@dataclass(frozen=True)
class Materials:
    """Radio materials of a scene.

    Attributes:
        rules: kind of surface -> material ``itu_*`` or ``perfect``; kinds left out take those of `RULES`.
        surfaces: name of a surface -> its kind, or a material of its own.
        thickness_m: material -> slab thickness in metres; those left out take ordinary building practice.
    """

    rules: Mapping[str, str] = field(default_factory=dict)
    surfaces: Mapping[str, str] = field(default_factory=dict)
    thickness_m: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str, kind: str) -> str:
        """Material of a surface, by its own entry or else by its kind's rule."""
        entry = self.surfaces.get(name, kind)
        return entry if entry in THICKNESS_M else {**RULES, **self.rules}[entry]

    def complete(self, kinds: Mapping[str, str]) -> Materials:
        """The same with every rule, every surface and the thickness of every material in use spelt out.

        Args:
            kinds: of every surface in the scene, by its name; an entry in ``surfaces`` goes before it.
        """
        entries = {name: self.surfaces.get(name, kind) for name, kind in kinds.items()}
        full = replace(self, rules={**RULES, **self.rules}, surfaces=entries)
        used = dict.fromkeys([*full.rules.values(), *(full.of(name, "other") for name in entries)])
        return replace(full, thickness_m={m: float(self.thickness_m.get(m, THICKNESS_M[m])) for m in used})


def read_materials(path: str | Path) -> Materials:
    """Read and check a ``materials.yml``, or the one in a scene folder.

    Raises:
        InputError: missing, not YAML, a kind or material that is not known, or a thickness that is not positive.
    """
    file = Path(path)
    file = file / FILE if file.is_dir() else file
    try:
        content = yaml.safe_load("\n".join(text_lines(file)))
    except yaml.YAMLError as error:
        raise InputError(f"{file}: not YAML ({one_line(error)})") from None
    if not isinstance(content, dict) or not set(content) <= {"rules", "surfaces", "thickness_m"}:
        raise InputError(f"{file}: give the keys rules, surfaces and thickness_m, no others")
    parts = {key: content.get(key) or {} for key in ("rules", "surfaces", "thickness_m")}
    for key, part in parts.items():
        if not isinstance(part, dict):
            raise InputError(f"{file}: {key} must be a mapping, such as {{wall: itu_brick}}")
    for kind, material in parts["rules"].items():
        if kind not in KINDS:
            raise InputError(f"{file}: rules: no kind {kind!r}; known are {', '.join(KINDS)}")
        check_material(material, f"{file}: rules: {kind}")
    for name, entry in parts["surfaces"].items():
        if entry not in KINDS:
            check_material(entry, f"{file}: surfaces: {name}", also=KINDS)
    for material, thickness in parts["thickness_m"].items():
        check_material(material, f"{file}: thickness_m")
        if isinstance(thickness, bool) or not isinstance(thickness, int | float) or not 0 < thickness < math.inf:
            raise InputError(f"{file}: thickness_m: {material} is {thickness!r}; give metres above 0")
    return Materials(**parts)


def check_material(name: Any, where: str, also: Sequence[str] = ()) -> str:
    """A material's name, if it is one of ITU-R P.2040 that Sionna RT knows, or the perfect conductor.

    Raises:
        InputError: it is not; the message begins with ``where`` and lists the known ones.
    """
    if name not in THICKNESS_M:
        raise InputError(f"{where}: unknown material {name!r}; known are {', '.join([*also, *THICKNESS_M])}")
    return str(name)


def materials_text(materials: Materials) -> str:
    """The text of a ``materials.yml``."""
    facts = {
        "rules": dict(materials.rules),
        "surfaces": dict(materials.surfaces),
        "thickness_m": dict(materials.thickness_m),
    }
    head = (
        "# Radio materials of this scene (of ITU-R P.2040, or perfect). rules: of each kind of surface; surfaces: the\n"
        "# kind of each, or a material of its own. Edit, then open the scene with wrf-mi: scene.xml follows.\n"
    )
    return head + yaml.safe_dump(facts, sort_keys=False, width=110)
