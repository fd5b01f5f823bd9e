"""Findings of `wrf_mi.apps.checking.check_scene`: kinds with their level, and the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ...core.files import listed, one_line

Level = Literal["fault", "warning", "note"]

KINDS: Mapping[str, tuple[Level, str]] = {
    "xml": ("fault", "scene file that is no XML in UTF-8, or has elements or plugins that no scene has"),
    "parameter": ("fault", "parameter that is missing, stated twice, or left to the caller"),
    "unknown-parameter": ("fault", "parameter that the shape does not have, such as toWorld for to_world"),
    "missing-file": ("fault", "mesh or texture that is not where the scene file names it"),
    "outside-folder": ("fault", "mesh or texture outside the folder of the scene file"),
    "duplicate-id": ("fault", "two elements of one id, or of one name as Sionna RT shortens ids"),
    "no-material": ("fault", "shape without a BSDF"),
    "two-materials": ("fault", "shape with several BSDFs"),
    "unknown-reference": ("fault", "reference to an id that no element has"),
    "not-radio": ("fault", "shape whose BSDF is none of Sionna RT's and is not named after a material of ITU-R P.2040"),
    "unknown-material": ("fault", "material that ITU-R P.2040 does not have, or that is named without itu_"),
    "material-values": ("fault", "constant or parameter that a radio material cannot have"),
    "bsdf-id": ("fault", "BSDF without an id"),
    "no-constants": ("warning", "radio material without a permittivity, which then is that of air"),
    "default-thickness": ("note", "material whose thickness Sionna RT takes for 0.1 m, as the scene file has none"),
    "absorber": ("note", "absorber; plain Sionna RT 2.2 refuses to set a frequency beside one"),
    "shape-type": ("fault", "sphere, cylinder or disk, which has no triangles"),
    "unsupported-shape": ("fault", "shape that Sionna RT does not open, such as an instance"),
    "no-shapes": ("fault", "scene without a shape"),
    "transform": (
        "fault",
        "to_world that is not finite, leaves no volume, or turns about an axis that is no unit vector",
    ),
    "moved": ("note", "to_world, which is applied when the scene is opened: the mesh file has other coordinates"),
    "folder": ("fault", "scene folder whose scene.yml or materials.yml is damaged"),
    "mesh": ("fault", "mesh that cannot be read"),
    "empty-mesh": ("fault", "mesh without faces"),
    "not-finite": ("fault", "vertex or point that is not a finite number"),
    "polygons": ("fault", "polygons that Sionna RT reads as other triangles, or refuses"),
    "zero-area": ("warning", "faces without an area"),
    "duplicate-faces": ("warning", "faces in the place of another one, which some tracers count twice"),
    "mixed-winding": ("warning", "solid or flat sheet whose faces are wound both ways, which misleads diffraction"),
    "double-sheet": ("fault", "sheet so near to another face that paths through both are lost"),
    "party-wall": ("note", "solids so near to each other that paths through both are lost"),
    "far": ("fault", "coordinates so far from the origin that single precision moves surfaces"),
    "coarse-phase": ("warning", "coordinates that single precision rounds by more than a hundredth of a wavelength"),
    "units": ("fault", "extent that looks like millimetres, or that of a scan of more than a building"),
    "doubtful-units": ("warning", "extent that looks like centimetres, or is too small for a room"),
    "stated-units": ("warning", "LAS or LAZ whose header states other units than those that it is read in"),
    "coarse-steps": ("fault", "scan whose coordinates are rounded to steps too coarse for planes"),
    "up-axis": ("warning", "mesh or scan that looks as if y were up"),
    "uneven": ("warning", "mesh of a phone's scan, whose uneven faces have few reflections"),
    "format": ("note", "mesh format that plain Sionna RT does not open"),
    "material-range": ("fault", "material that ITU-R P.2040 does not have at the carrier"),
    "below-range": ("warning", "material below its range, for which this package has constants and Sionna RT none"),
    "device-inside": ("warning", "transmitters or receivers inside a solid"),
    "no-floor": ("warning", "some transmitters or receivers without a floor below"),
    "not-opened": ("fault", "scene that Sionna RT refuses for another reason"),
    "plan": ("note", "plan, of which wrf-mi mesh makes a scene"),
    "unclear-plan": ("fault", "plan that is read only with an option, shows no walls, or is damaged"),
}
"""Kinds of findings: level and description. A fault does not open in Sionna RT, or gives wrong results."""
LEVELS: tuple[Level, ...] = ("fault", "warning", "note")
NAMED = 3  # shapes of a group of findings that are named; the others are counted


@dataclass(frozen=True)
class Finding:
    """Something wrong with a scene, or worth knowing.

    Attributes:
        kind: a key of `KINDS`.
        file: scene file, mesh or scan.
        shape: id of the shape, or its number and type; empty for the file as a whole.
        text: what is wrong.
        remedy: what to do; findings with the same kind, file and remedy are printed once.
    """

    kind: str
    file: Path
    shape: str
    text: str
    remedy: str

    @property
    def level(self) -> Level:
        """How serious it is."""
        return KINDS[self.kind][0]

    def as_dict(self) -> dict[str, str]:
        """Plain values for JSON."""
        return {**vars(self), "file": str(self.file), "level": self.level}


def refused(kind: str, file: Path, error: Exception, shape: str = "") -> Finding:
    """Finding of an error in one line: what is wrong with a file, and behind the last semicolon what to do."""
    text, _, remedy = one_line(error).removeprefix(f"{file}").lstrip(":, ").rpartition("; ")
    return Finding(kind, file, shape, text, remedy)


@dataclass(frozen=True)
class SceneReport:
    """Findings about a scene, mesh or scan, in the order of files and shapes.

    Attributes:
        source: name, folder or file that was checked.
        findings: faults, warnings and notes.
        shapes: number of shapes of a scene, or of parts of a mesh.
        faces: number of their triangles.
        points: number of points of a scan.
    """

    source: str
    findings: tuple[Finding, ...]
    shapes: int = 0
    faces: int = 0
    points: int = 0

    @property
    def ok(self) -> bool:
        """Whether there is no fault."""
        return not self.of_level("fault")

    def of_level(self, level: Level) -> list[Finding]:
        """Findings of a level."""
        return [finding for finding in self.findings if finding.level == level]

    def lines(self) -> list[str]:
        """Findings by file and shape, faults first, equal ones once, and a summary."""
        groups: dict[tuple[str, Path, str], list[Finding]] = {}
        for finding in sorted(self.findings, key=lambda each: LEVELS.index(each.level)):
            is_mesh_of_scene = finding.file.suffix.lower() != ".xml" and self.shapes > 1
            folder = finding.file.parent if is_mesh_of_scene else finding.file
            groups.setdefault((finding.kind, folder, finding.remedy), []).append(finding)
        lines, previous = list[str](), ""
        for (kind, _, remedy), group in groups.items():
            if (files := _files(group)) != previous:
                lines.append(files)
                previous = files
            lines.append(f"  {group[0].level:<8} {kind:<18} {_shapes(group)}{group[0].text}; {remedy}")
        size = f"{self.points} points" if self.points else f"{self.shapes} shapes, {self.faces} triangles"
        counts = ", ".join(_count(len(self.of_level(level)), level) for level in LEVELS)
        return [*lines, f"{self.source}: {counts}; {size}"]

    def as_dict(self) -> dict[str, Any]:
        """Plain values for JSON, with every finding."""
        return {
            "source": self.source,
            "ok": self.ok,
            "shapes": self.shapes,
            "faces": self.faces,
            "points": self.points,
            "findings": [finding.as_dict() for finding in self.findings],
        }


def _files(group: Sequence[Finding]) -> str:
    """Heading of a group of findings: the file, or the first of several."""
    files = list(dict.fromkeys(finding.file for finding in group))
    return f"{files[0]}" if len(files) == 1 else f"{files[0]} and {len(files) - 1} more files"


def _shapes(group: Sequence[Finding]) -> str:
    """Names of the shapes of a group of findings, or their number."""
    names = list(dict.fromkeys(finding.shape for finding in group if finding.shape))
    if not names and len(group) > 1:
        return f"{len(group)} times: "
    return f"{listed(names, NAMED)}: " if names else ""


def _count(number: int, what: str) -> str:
    return f"{number or 'no'} {what}{'' if number == 1 else 's'}"
