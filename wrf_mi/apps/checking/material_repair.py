"""Radio materials of a repaired scene: those of its scene file, those that names mean, or the one that is asked for."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree.ElementTree import Element, SubElement

from wrf_mi_scenes.mitsuba_xml import THICKNESS_M

from ...scene.folder import plain_name
from ...scene.material_names import ascii_name, meant
from ...scene.scattering import SCATTERING
from ...scene.xml_file import overruled
from ...tracing.sionna.materials import BELOW_1_GHZ, in_itu_range
from .scene_geometry import ShapePart
from .scene_xml_faults import ITU, LEAST, RADIO, SceneXml, bsdf_findings, is_itu, itu_type, short_name
from .triangle_repair import label

ODD = r"[^A-Za-z0-9_.-]"  # characters that ids and file names of a repaired scene do not have
SIONNA_THICKNESS_M = 0.1  # that of Sionna RT where a scene file states none: repair does not change it
COLOURS = ("color", "reflectance", "base_color")


@dataclass
class MaterialRepair:
    """Choice of a radio material for each part.

    Attributes:
        scene: the scene file; None for a mesh.
        thickness_m: slab thickness of materials by name, of the scene's folder.
        default: material of ITU-R P.2040, without ``itu_``, of parts whose names mean none; None: there is none.
        frequency_hz: carrier, for which materials below their range get constants.
        of_shapes: materials of ITU-R P.2040, without ``itu_``, by shape, whatever their names mean.
        bsdfs: BSDFs of the repaired scene, by the ids of the source.
        done: what was done to which part or material.
    """

    scene: SceneXml | None
    thickness_m: Mapping[str, float]
    default: str | None
    frequency_hz: float | None
    of_shapes: Mapping[str, str] = field(default_factory=dict)
    bsdfs: dict[str, Element] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)

    def of(self, part: ShapePart) -> Element | None:
        """BSDF that a part is to have; None where nothing says which material it is."""
        if part.name in self.of_shapes:
            return self._of_itu(part, self.of_shapes[part.name], "")
        bsdfs = {} if self.scene is None or part.shape is None else dict(self.scene.materials(part.shape))
        for identifier, bsdf in bsdfs.items():
            radio = None if bsdf is None else self._radio(bsdf)
            if radio is not None:
                return self._add(identifier or part.name, radio)
        return self._by_name(part, [*bsdfs, part.name or part.file.stem])

    def _by_name(self, part: ShapePart, names: Sequence[str]) -> Element | None:
        """Material that one of some names means, or the default."""
        guessed = next(filter(None, map(meant, names)), None)
        material = guessed or self.default
        return None if material is None else self._of_itu(part, material, " by its name" if guessed else "")

    def _of_itu(self, part: ShapePart, material: str, reason: str) -> Element:
        """Material of ITU-R P.2040 for a part; the same one for all parts of that material."""
        self.done.append(f"{label(part)}: material {material}{reason}")
        same = next((name for name in (f"mat-itu_{material}", f"itu_{material}") if name in self.bsdfs), None)
        bsdf = itu_bsdf(material, THICKNESS_M[f"itu_{material}"], self.frequency_hz)
        return self._add(same or f"itu_{material}", bsdf)

    def _radio(self, bsdf: Element) -> Element | None:
        """A radio material without faults from a BSDF, or from within it."""
        for inner in bsdf.iter("bsdf"):
            candidate = Element("bsdf", {**inner.attrib, "id": inner.get("id") or bsdf.get("id") or "mat-material"})
            candidate.extend(inner)
            if overruled(candidate):
                candidate.set("id", f"mat-my_{short_name(candidate.get('id', ''))}")
            material = itu_type(candidate)
            if material is not None:
                return self._slab(candidate, material)
            is_stated = candidate.get("type") in RADIO[::2] and not is_itu(candidate.get("id", ""))
            if is_stated and self.scene is not None:
                kinds = {finding.kind for finding in bsdf_findings(self.scene, "", candidate)}
                if "material-values" not in kinds:
                    return candidate
        return None

    def _slab(self, bsdf: Element, material: str) -> Element:
        """A material of ITU-R P.2040 with its thickness, colour and scattering."""
        thickness_element = bsdf.find("float[@name='thickness']")
        thickness_m = SIONNA_THICKNESS_M if thickness_element is None else float(thickness_element.get("value", "nan"))
        of_kind = self.thickness_m.get(f"itu_{material}", thickness_m)
        slab = itu_bsdf(material, self.thickness_m.get(short_name(bsdf.get("id", "")), of_kind), self.frequency_hz)
        for colour in [each for each in bsdf.iter("rgb") if each.get("name") in COLOURS][:1]:
            SubElement(slab, "rgb", name="color", value=colour.get("value", ""))
        slab.extend([each for each in bsdf if each.get("name") in SCATTERING])
        return slab

    def _add(self, identifier: str, bsdf: Element) -> Element:
        """A BSDF with a safe id that no other one has; the same one for the same id."""
        if identifier not in self.bsdfs:
            names = {short_name(each.get("id", "")) for each in self.bsdfs.values()}
            wanted = re.sub(ODD, "_", ascii_name(short_name(identifier))) or "material"
            if bsdf.get("type") == "radio-material" and (wanted in ITU or is_itu(wanted)):
                wanted = f"my_{wanted}"  # names of ITU-R P.2040 would make it one of those
            elif wanted in ITU:
                wanted = f"itu_{wanted}"
            name = plain_name(wanted, ODD, names)
            if name != short_name(identifier):
                self.done.append(f"{identifier}: material named {name}")
            bsdf.set("id", f"mat-{name}")
            self.bsdfs[identifier] = bsdf
        return self.bsdfs[identifier]


def itu_bsdf(material: str, thickness_m: float, frequency_hz: float | None = None) -> Element:
    """Radio material of ITU-R P.2040; with its constants where a carrier is below its range."""
    constants = BELOW_1_GHZ.get(material)
    if frequency_hz is None or in_itu_range(material, frequency_hz) or constants is None:
        bsdf = Element("bsdf", type="itu-radio-material")
        SubElement(bsdf, "string", name="type", value=material)
        numbers: Mapping[str, float] = {"thickness": thickness_m}
    else:
        bsdf = Element("bsdf", type="radio-material")
        numbers = dict(zip(LEAST, (*constants, thickness_m), strict=False))
    for name, value in numbers.items():
        SubElement(bsdf, "float", name=name, value=f"{value:.9g}")
    return bsdf
