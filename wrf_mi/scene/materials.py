"""Radio materials of surfaces, in a file that users may edit.

Rules give each kind of surface a material of ITU-R P.2040, and single surfaces may depart from them; ``perfect`` is a
perfect conductor:

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
from ..datasets.folder_files import read_yaml
from .surfaces import KINDS

FILE = "materials.yml"
THICKNESS_M: Mapping[str, float] = {**ITU_THICKNESS_M, PERFECT: PERFECT_THICKNESS_M}
"""Default slab thickness of every material, metres."""
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
        rules: material ``itu_*`` or ``perfect`` of each kind of surface; by default those of `RULES`.
        surfaces: kind, or material, of each surface by its name.
        thickness_m: slab thickness of each material in metres; by default those of `THICKNESS_M`.
    """

    rules: Mapping[str, str] = field(default_factory=dict)
    surfaces: Mapping[str, str] = field(default_factory=dict)
    thickness_m: Mapping[str, float] = field(default_factory=dict)

    def of(self, name: str, kind: str) -> str:
        """Material of a surface, by its entry or else by its kind's rule."""
        entry = self.surfaces.get(name, kind)
        return entry if entry in THICKNESS_M else {**RULES, **self.rules}[entry]

    def by_surface(self) -> dict[str, str]:
        """Material of each listed surface by its name."""
        return {name: self.of(name, "other") for name in self.surfaces}

    def complete(self, kinds: Mapping[str, str]) -> Materials:
        """Materials with every rule, every surface and the thickness of every used material stated.

        Args:
            kinds: kind of every surface in the scene by its name; an entry in ``surfaces`` overrides it.
        """
        entries = {name: self.surfaces.get(name, kind) for name, kind in kinds.items()}
        full = replace(self, rules={**RULES, **self.rules}, surfaces=entries)
        used = dict.fromkeys([*full.rules.values(), *(full.of(name, "other") for name in entries)])
        return replace(full, thickness_m={m: float(self.thickness_m.get(m, THICKNESS_M[m])) for m in used})


def read_materials(path: str | Path) -> Materials:
    """Read and check a ``materials.yml``, or that of a scene folder.

    Raises:
        InputError: missing, not YAML, an unknown kind or material, or a thickness that is not positive.
    """
    file = Path(path)
    file = file / FILE if file.is_dir() else file
    content = read_yaml(file)
    if content is None or not set(content) <= {"rules", "surfaces", "thickness_m"}:
        raise InputError(f"{file}: give the keys rules, surfaces and thickness_m, no others")
    parts = {key: content.get(key) or {} for key in ("rules", "surfaces", "thickness_m")}
    for key, part in parts.items():
        if not isinstance(part, dict):
            raise InputError(f"{file}: {key} must be a mapping, such as {{wall: itu_brick}}")

    def check(material: Any, where: str, also: Sequence[str] = ()) -> None:
        if material not in (*also, *THICKNESS_M):
            known = ", ".join([*also, *THICKNESS_M])
            raise InputError(f"{file}: {where}: unknown material {material!r}; known are {known}")

    for kind, material in parts["rules"].items():
        if kind not in KINDS:
            raise InputError(f"{file}: rules: no kind {kind!r}; known are {', '.join(KINDS)}")
        check(material, f"rules: {kind}")
    for name, entry in parts["surfaces"].items():
        check(entry, f"surfaces: {name}", KINDS)
    for material, thickness in parts["thickness_m"].items():
        check(material, "thickness_m")
        if isinstance(thickness, bool) or not isinstance(thickness, int | float) or not 0 < thickness < math.inf:
            raise InputError(f"{file}: thickness_m: {material} is {thickness!r}; give metres above 0")
    return Materials(**parts)


def materials_text(materials: Materials) -> str:
    """The text of a ``materials.yml``."""
    head = (
        "# Radio materials of this scene (of ITU-R P.2040, or perfect). rules: of each kind of surface; surfaces: the\n"
        "# kind of each, or a material of its own. Edit, then open the scene with wrf-mi: scene.xml follows.\n"
    )
    facts = {key: dict(part) for key, part in vars(materials).items()}
    return head + yaml.safe_dump(facts, sort_keys=False, width=110)
