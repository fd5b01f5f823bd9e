"""Faults of scenes, meshes and scans (the command ``wrf-mi check``)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from xml.etree.ElementTree import ElementTree

import numpy as np
from wrf_mi_scenes import scenes

from ... import backend
from ...core import InputError, Record
from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.yaml_files import read_yaml
from ...scene.coordinates import (
    FARTHEST_M,
    HIGHEST_M,
    LARGEST_M,
    SMALLEST_M,
    STATING_UP,
    UNITS_M,
    Y_UP,
    Up,
    check_extent,
    extent,
    looks_y_up,
    require_fine,
    turned,
    up_of,
)
from ...scene.folder import FACTS_FILE, scene_file
from ...scene.make import has_faces, is_plan
from ...scene.materials import FILE as MATERIALS_FILE
from ...scene.materials import read_materials, thicknesses
from ...scene.mesh.measured import is_measured
from ...scene.mesh.surfaces import Surface, sampled
from ...scene.scan.las_units import stated_units, units_remedy, units_text
from ...scene.scan.points import read_points
from ...scene.scattering import take_scattering
from ...scene.xml_file import make_files_absolute, parsed_xml
from ...synthetic import load_record
from ...tracing.sionna.materials import BELOW_1_GHZ, CONSTANTS_FROM_HZ, in_itu_range
from ...tracing.sionna.scenes import HIGHEST_M as HIGHEST_SCENE_M
from ...tracing.sionna.scenes import REFUSALS, quiet_mitsuba, reason
from .devices import device_findings
from .plan_check import check_plan
from .scene_findings import Finding, SceneReport, refused
from .scene_geometry import ShapePart, between_parts, mesh_file_parts, part_findings, scene_parts
from .scene_xml_faults import SceneXml, itu_type, read_xml, xml_findings

LIGHT_M_PER_S = 299_792_458.0
PHASE_SHARE = 0.01  # share of a wavelength that rounding may move a surface by: 4 degrees of phase
SLENDER = 4.0  # length or width in heights from which a high scene is a city and not a room in centimetres
SIONNA_HZ = 3.5e9  # carrier of a scene of Sionna RT until another one is set


class Largest(NamedTuple):
    """Bounds of scenes in metres: largest side and height, and the height from which centimetres are suspected."""

    side_m: float
    height_m: float
    usual_height_m: float


class Frame(NamedTuple):
    """Unit of a source's coordinates, and the axis that is up; None: that of its format."""

    units: str
    up: Up | None


BUILDING = Largest(LARGEST_M, HIGHEST_SCENE_M, HIGHEST_M)
SCENE = Largest(np.inf, HIGHEST_SCENE_M, 1.5 * HIGHEST_M)  # cities are kilometres wide


@dataclass(frozen=True)
class Source:
    """What is checked: a scene file with what its folder states, a mesh, a scan or a plan.

    Attributes:
        path: the file.
        thickness_m: slab thickness of materials by name.
        findings: findings about the folder.
    """

    path: Path
    thickness_m: Mapping[str, float] = field(default_factory=dict)
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class Checked:
    """Findings about a source, its scene file if it is one, and its triangles."""

    source: Source
    report: SceneReport
    scene: SceneXml | None
    parts: tuple[ShapePart, ...]


def check_scene(
    source: str | Path,
    *,
    data: str | Path | Record | None = None,
    frequency_hz: float | None = None,
    units: str = "m",
    up: Up | None = None,
) -> SceneReport:
    """Find what keeps a scene from opening in Sionna RT, or makes its paths wrong.

    Args:
        source: name of a scene of the package or of Sionna RT, a scene folder, a Mitsuba XML, a mesh, a scan or a plan.
        data: measurements whose transmitters and receivers have to be outside of solids.
        frequency_hz: carrier at which materials and phases are checked; None: that of the data, if they have one.
        units: unit of a mesh's or scan's coordinates, a key of `wrf_mi.scene.coordinates.UNITS_M`.
        up: axis that is up in a mesh or scan; None: that of its format.

    Returns:
        Findings with file, shape and remedy. Nothing is changed.

    Raises:
        InputError: there is no such source or data set, or an unknown unit.
    """
    return checked(source, Frame(units, up), frequency_hz, data).report


def checked(
    source: str | Path, frame: Frame, frequency_hz: float | None, data: str | Path | Record | None = None
) -> Checked:
    """`check_scene` with the scene file and the triangles that were checked."""
    backend.init()
    if frame.units not in UNITS_M:
        raise InputError(f"units {frame.units!r}: not known; give one of {', '.join(UNITS_M)}")
    if frequency_hz is not None and not 0 < frequency_hz < 1e15:
        raise InputError(f"frequency {frequency_hz:g} Hz: give a carrier above 0")
    where = locate(source)
    record = data if isinstance(data, Record) or data is None else load_record(data)
    carriers_hz = [frequency_hz] if frequency_hz is not None else _carriers(record)
    if where.path.suffix.lower() == ".xml":
        return _check_xml(where, str(source), frame, record, carriers_hz)
    if not has_faces(where.path):
        if record is not None or frequency_hz is not None:
            text = "a scan or plan; devices and carriers are checked in the scene that wrf-mi mesh makes of it"
            raise InputError(f"{source}: {text}; omit data set and frequency")
        if is_plan(where.path):
            return Checked(where, check_plan(where.path, str(source), frame.units), None, ())
        return Checked(where, _check_scan(where.path, str(source), frame), None, ())
    findings, parts = _placed(mesh_file_parts(where.path), where.path, frame)
    findings += _of_triangles(parts, where.path, frame, record, carriers_hz)
    report = SceneReport(str(source), tuple(findings), len(parts), _faces(parts))
    return Checked(where, report, None, tuple(parts))


def _check_xml(where: Source, name: str, frame: Frame, record: Record | None, carriers_hz: Sequence[float]) -> Checked:
    scene = read_xml(where.path)
    if isinstance(scene, Finding):
        return Checked(where, SceneReport(name, (*where.findings, scene)), None, ())
    about_files, parts = _placed(scene_parts(scene), where.path, frame)
    findings = [*where.findings, *_of_file(scene, where, carriers_hz), *about_files]
    findings += _of_triangles(parts, where.path, frame, record, carriers_hz)
    if not any(finding.level == "fault" for finding in findings):
        findings += opened(where.path)
    report = SceneReport(name, tuple(findings), len(scene.shapes), _faces(parts))
    return Checked(where, report, scene, tuple(parts))


def _placed(results: Iterator[ShapePart | Finding], file: Path, frame: Frame) -> tuple[list[Finding], list[ShapePart]]:
    """Findings, and parts in metres with z up."""
    findings, parts = list[Finding](), list[ShapePart]()
    for result in results:
        if isinstance(result, Finding):
            findings.append(result)
        else:
            corners_m = _upright(result.corners_m, file, frame.up) * UNITS_M[frame.units]
            parts.append(replace(result, corners_m=corners_m))
    return findings, parts


def _faces(parts: Sequence[ShapePart]) -> int:
    return sum(len(part.corners_m) for part in parts)


def _upright(corners: FloatArray, file: Path, up: Up | None) -> FloatArray:
    """Corners with z up; readers of formats with y up have turned them as their specification states."""
    if up_of(file, None) == "y":
        return corners if up in (None, "y") else corners @ Y_UP[:3, :3].T
    return turned(corners, up or "z")


def locate(source: str | Path) -> Source:
    """The file of a name, folder or path; `InputError` where there is none."""
    path = Path(source)
    if path.is_dir():
        return _folder(path)
    if not path.exists():
        if named_scene := scenes().get(str(source)):
            return Source(named_scene.xml, named_scene.thickness_m)
        from sionna.rt import scene as shipped

        if isinstance(file := getattr(shipped, str(source), None), str) and file.endswith(".xml"):
            return Source(Path(file))
    if not path.is_file():
        raise InputError(f"{source}: no such scene, mesh or scan; give a name, a folder or a file")
    return Source(path)


def _folder(folder: Path) -> Source:
    if not (folder / FACTS_FILE).is_file():
        files = sorted(folder.glob("*.xml"))
        if len(files) != 1:
            raise InputError(f"{folder}: {len(files)} files *.xml in it, and no {FACTS_FILE}; give the scene file")
        return Source(files[0])
    try:
        facts = read_yaml(folder / FACTS_FILE)
        xml = scene_file(folder, facts)
        if not xml.is_file():
            raise InputError(f"{xml}: missing; write the scene anew")
    except InputError as error:
        raise InputError(f"{error}; or give the scene file itself") from None
    try:
        if (folder / MATERIALS_FILE).is_file():
            materials = read_materials(folder / MATERIALS_FILE)
            return Source(xml, materials.complete(materials.surfaces).thickness_m)
        return Source(xml, thicknesses(folder / FACTS_FILE, facts.get("thickness_m") or {}))
    except InputError as error:
        return Source(xml, findings=(refused("folder", folder, error),))


def _of_file(scene: SceneXml, where: Source, carriers_hz: Sequence[float]) -> Iterator[Finding]:
    """Findings about a scene file, but for thicknesses that its folder states, and its materials at the carriers."""
    with_thickness = {f"<bsdf> mat-{material}" for material in where.thickness_m}
    for finding in xml_findings(scene):
        if finding.kind != "default-thickness" or finding.shape not in with_thickness:
            yield finding
    yield from _ranges(scene, carriers_hz)


def opened(path: Path) -> Iterator[Finding]:
    """Sionna RT's reason to refuse a scene file in which no fault was found, but for patterns of scattering."""
    from sionna import rt

    root = parsed_xml(path)
    make_files_absolute(root, path)
    take_scattering(root, path)
    with TemporaryDirectory() as folder:
        ElementTree(root).write(file := Path(folder) / path.name)
        for merged in (True, False):
            try:
                with quiet_mitsuba():  # films of cameras warn of the monochrome variant
                    rt.load_scene(str(file), merge_shapes=merged)
            except (*REFUSALS, OSError) as error:
                text = f"Sionna RT: {reason(error) if isinstance(error, REFUSALS) else one_line(error)}"
                yield Finding("not-opened", path, "", text, "correct the scene")
                return


def _carriers(record: Record | None) -> list[float]:
    """Carriers of data in Hz; none where they state none."""
    if record is None:
        return []
    carriers_hz = record.carriers_hz if record.carriers_hz is not None else record.frequencies_hz
    return (
        [] if carriers_hz is None or not len(carriers_hz) else [float(np.min(carriers_hz)), float(np.max(carriers_hz))]
    )


def _ranges(scene: SceneXml, carriers_hz: Sequence[float]) -> Iterator[Finding]:
    """Materials of ITU-R P.2040 that are not known at the carriers, by shape."""
    for name, shape in scene.shapes:
        itu_types = {itu_type(bsdf) for _, bsdf in scene.materials(shape) if bsdf is not None}
        for material in filter(None, itu_types):
            kind, hz = _range(material, carriers_hz or [SIONNA_HZ])
            if kind:
                text = f"{material} is not known at {hz / 1e9:g} GHz"
                remedy = "choose another material, or give constants (relative_permittivity, conductivity)"
                yield Finding(kind, scene.path, name, text, remedy)


def _range(material: str, carriers_hz: Sequence[float]) -> tuple[str, float]:
    """Kind of the finding about a material, and the first carrier outside of its range; empty if there is none."""
    outside = [hz for hz in carriers_hz if not in_itu_range(material, hz)]
    if not outside:
        return "", 0.0
    extended = material in BELOW_1_GHZ and all(CONSTANTS_FROM_HZ <= hz < 1e9 for hz in outside)
    return "below-range" if extended else "material-range", outside[0]


def _of_triangles(
    parts: list[ShapePart], path: Path, frame: Frame, record: Record | None, carriers_hz: Sequence[float]
) -> Iterator[Finding]:
    """Findings about triangles, coordinates, and devices inside solids."""
    for part in parts:
        yield from part_findings(part)
    yield from between_parts(parts)
    if filled := [part for part in parts if len(part.corners_m)]:
        yield from _coordinates(filled, path, frame, carriers_hz)
    if record is not None:
        yield from device_findings(filled, path, record)


def _coordinates(
    filled: Sequence[ShapePart], path: Path, frame: Frame, carriers_hz: Sequence[float]
) -> Iterator[Finding]:
    """Findings about units, the axis that is up, and distances from the origin."""
    yield from _distances(filled, carriers_hz)
    corners = np.concatenate([part.corners_m for part in filled])
    if not np.ptp(corners.reshape(-1, 3), axis=0).max() > 0:
        return
    # A mesh may be cut out of a larger one and have strays; a scene file was made to be traced.
    wrong = list(_units(corners.reshape(-1, 3), path, BUILDING if path.suffix.lower() != ".xml" else SCENE))
    yield from wrong or ([] if frame.up else _up(sampled(corners), path))
    mesh = Surface("", "other", corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    if path.suffix.lower() != ".xml" and not path.is_dir() and is_measured([mesh]):
        states_up = frame.up or path.suffix.lower() in STATING_UP
        up = f" --up {frame.up}" if frame.up else "" if states_up else " --up y, or --up z"
        command = f"wrf-mi mesh {path} --out SCENE{up}"
        text = "faces are uneven as those of a phone's scan, and have few reflections"
        yield Finding("uneven", path, "", text, f"make planes of them: {command}")


def _distances(parts: Sequence[ShapePart], carriers_hz: Sequence[float]) -> Iterator[Finding]:
    """Parts whose coordinates single precision rounds too much."""
    shortest_m = LIGHT_M_PER_S / max(carriers_hz) if carriers_hz else np.inf
    for part in parts:
        far = float(np.abs(part.corners_m).max())
        step = float(np.spacing(np.float32(min(far, 3e38))))
        text = f"coordinates up to {far:.0f} m, where those of single precision are {step:.2g} m apart"
        remedy = "subtract an origin, from the positions of the measurements, too (--repair does)"
        if far >= FARTHEST_M:
            yield Finding("far", part.file, part.name, text, remedy)
        elif step > PHASE_SHARE * shortest_m:
            yield Finding("coarse-phase", part.file, part.name, f"{text}; wavelength {shortest_m:.3g} m", remedy)


def _units(points: FloatArray, path: Path, largest: Largest) -> Iterator[Finding]:
    """Units of points [n, 3] that look like others than metres."""
    size = np.ptp(extent(points), axis=0)
    text = f"extent {' x '.join(f'{side:.4g}' for side in size)} m"
    if size[2] > largest.height_m or size.max() > largest.side_m:
        yield Finding("units", path, "", text, "millimetres are stated by --units mm (or cut out one building)")
    elif size[2] > largest.usual_height_m and max(size[:2]) < SLENDER * size[2]:
        yield Finding("doubtful-units", path, "", text, "centimetres are stated by --units cm")
    elif size.max() < SMALLEST_M:
        yield Finding("doubtful-units", path, "", f"{text}, small for a room", "other units are stated by --units")


def _up(points: FloatArray, path: Path) -> Iterator[Finding]:
    if looks_y_up(points):
        _, along_y, along_z = np.ptp(extent(points), axis=0)
        text = f"looks as if y were up ({along_y:.3g} m along y, {along_z:.3g} m along z)"
        yield Finding("up-axis", path, "", text, "state it by --up y, or --up z if that is right")


def _check_scan(path: Path, name: str, frame: Frame) -> SceneReport:
    try:
        points = read_points(path, frame.units, frame.up)
    except InputError as error:
        text = str(error)
        kind = "not-finite" if "not finite" in text else "empty-mesh" if "no points" in text else "mesh"
        return SceneReport(name, (refused(kind, path, error),))
    return SceneReport(name, tuple(_of_points(points, path, frame)), points=len(points))


def _of_points(points: FloatArray, path: Path, frame: Frame) -> Iterator[Finding]:
    """Findings about units, the axis that is up, and steps of points [n, 3]; with all for which a scene is refused."""
    units = stated_units(path)
    if other := set(units) - {frame.units}:
        text = f"{units_text(units)}, and is read in {frame.units}"
        yield Finding("stated-units", path, "", text, units_remedy(units))
    doubts = list(_units(points, path, BUILDING))
    if not doubts or "units" not in {doubt.kind for doubt in doubts}:
        doubts = [*_refused(check_extent, "units", points, path)] or doubts
    if not other:  # the extent follows from them
        yield from doubts
    yield from _refused(require_fine, "coarse-steps", points, path)
    if not (doubts or frame.up):
        yield from _up(points, path)


def _refused(
    require: Callable[[FloatArray, Path], None], kind: str, points: FloatArray, path: Path
) -> Iterator[Finding]:
    """Finding about points [n, 3] that the making of a scene refuses."""
    try:
        require(points, path)
    except InputError as error:
        yield refused(kind, path, error)
