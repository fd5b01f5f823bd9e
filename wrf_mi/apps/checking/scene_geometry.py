"""Triangles of the shapes of a scene file, in double precision and the scene's frame, and their faults."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import trimesh

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import inside, one_line
from ...core.memory import require_memory
from ...core.types import IntArray
from ...scene.mesh.files import POLYGON_READERS, mesh_parts, triangles_of
from ...scene.mesh.surfaces import bodies, copies, first_copies, without_area
from ...tracing.sionna.scenes import REFUSALS, placed_mesh, reason, same_triangles, triangles_by_mitsuba
from .scene_findings import Finding, refused
from .scene_xml_faults import PARAMETERS, SceneXml, similar_file
from .triangle_faults import double_sheets, sheet_numbers, wound_both_ways

MEMORY = {".obj": 30}  # bytes of memory for each byte of a mesh file; others take `MEMORY_BINARY`
MEMORY_BINARY = 12
SINGULAR = 1e-9  # least ratio of the scales of a transform
UNIT = 1e-3  # largest deviation of rotations from orthonormal matrices
MOST_CORNERS = 2000  # corners of a polygon that is not convex: crossings of its edges grow with the square
RESTORE = "export the mesh anew"


@dataclass(frozen=True, eq=False)
class ShapePart:
    """A shape of a scene, or a part of a mesh, with its triangles.

    Attributes:
        name: id of the shape, or its number and type.
        material: id of its BSDF; empty without one.
        file: file of its triangles.
        corners_m: corners [f, 3, 3] in the scene's frame, metres.
        shape: element of the shape; None for a part of a mesh. Ids may come twice.
    """

    name: str
    material: str
    file: Path
    corners_m: FloatArray
    shape: Element | None = None


def scene_parts(scene: SceneXml) -> Iterator[ShapePart | Finding]:
    """Each shape of a scene as a part, and findings about its file, its polygons and its transform."""
    for name, shape in scene.shapes:
        materials = [identifier for identifier, _ in scene.materials(shape)]
        part = ShapePart(name, materials[0] if materials else "", scene.path, np.empty((0, 3, 3)), shape)
        plugin = shape.get("type", "")
        matrix = to_world(shape) if plugin in PARAMETERS else np.eye(4)
        if isinstance(matrix, str):
            remedy = "correct the transform: scales other than 0, axes of length 1, finite numbers"
            yield Finding("transform", scene.path, name, matrix, remedy)
        elif plugin in ("ply", "obj"):
            yield from _from_file(scene, shape, part, matrix)
        elif plugin in PARAMETERS:
            yield from _analytic(scene, shape, part)


def _from_file(scene: SceneXml, shape: Element, part: ShapePart, matrix: FloatArray) -> Iterator[ShapePart | Finding]:
    """A shape with a mesh file, or with one of the same name elsewhere in the folder, in the scene's frame."""
    plugin, file_name = shape.get("type", ""), scene.file_of(shape) or ""
    try:
        file: Path | None = inside(scene.path.parent, file_name, scene.path)
    except InputError:
        file = None  # named by `xml_findings`
    if file is None or not file.is_file():
        file = similar_file(scene.path.parent, file_name)
    if file is None or file.suffix.lower() != f".{plugin}":
        return
    for result in read_triangles(replace(part, file=file), plugin):
        if isinstance(result, Finding):
            yield result
        else:
            placed = trimesh.transform_points(result.corners_m.reshape(-1, 3), matrix)
            yield replace(result, corners_m=placed.reshape(-1, 3, 3))
    if not np.array_equal(matrix, np.eye(4)):
        yield Finding("moved", file, part.name, "to_world moves the mesh", "nothing to do; --repair applies it")


def _analytic(scene: SceneXml, shape: Element, part: ShapePart) -> Iterator[ShapePart | Finding]:
    """A shape without a file as triangles in the scene's frame."""
    try:
        mesh = placed_mesh(shape, scene.root.get("version", ""))
    except InputError as error:
        yield Finding("transform", scene.path, part.name, one_line(error).partition(";")[0], "correct its parameters")
        return
    if mesh is not None:
        yield replace(part, corners_m=np.asarray(mesh.triangles, float))


def to_world(shape: Element) -> FloatArray | str:
    """Matrix [4, 4] of a shape's ``to_world`` in double precision, or what is wrong with it."""
    steps = [step for transform in shape.findall("transform") for step in transform]
    try:
        matrix = _matrix(steps)
        turn = _matrix([step for step in steps if step.tag == "rotate"])[:3, :3]
    except REFUSALS as error:
        return f"its transform: {reason(error)}"
    # By axes of another length than 1, Mitsuba's rotations shear.
    if np.abs(turn @ turn.T - np.eye(3)).max() > UNIT:
        return "the axis of <rotate> of its transform is no unit vector, with which Mitsuba shears the mesh"
    scales = np.linalg.svd(matrix[:3, :3], compute_uv=False) if np.isfinite(matrix).all() else np.zeros(3)
    if scales[2] <= SINGULAR * scales[0]:
        return "its transform is not finite or leaves no volume"
    return matrix


def _matrix(steps: Sequence[Element]) -> FloatArray:
    """Matrix [4, 4] of the elements of a transform by Mitsuba's parser, which unlike its shapes has double precision.

    Errors are those of Mitsuba (`REFUSALS`).
    """
    import mitsuba as mi

    if not steps:
        return np.eye(4)
    root = Element("scene", version="3.0.0")
    SubElement(SubElement(root, "shape", type="rectangle"), "transform", name="to_world").extend(steps)
    parsed = mi.parser.parse_string(
        mi.parser.ParserConfig(mi.variant() or ""), ElementTree.tostring(root, encoding="unicode")
    )
    (placement,) = [node.props["to_world"] for node in parsed.nodes if "to_world" in node.props.keys()]  # noqa: SIM118
    return np.array(placement.matrix, float)


def read_triangles(part: ShapePart, plugin: str) -> Iterator[ShapePart | Finding]:
    """A part with the triangles of its PLY or OBJ file in the file's frame, and findings about its polygons."""
    file, name = part.file, part.name
    try:
        require_memory(MEMORY.get(file.suffix.lower(), MEMORY_BINARY) * file.stat().st_size, str(file), "divide it")
        polygons = POLYGON_READERS[file.suffix.lower()](file)
        if len(polygons.sizes) and polygons.sizes.max() > MOST_CORNERS:
            raise ValueError(f"a polygon of {polygons.sizes.max()} corners; {MOST_CORNERS} at most are cut")
        triangles, _ = triangles_of(polygons)
    except Exception as error:  # NumPy raises a dozen kinds on damaged files
        text, _, remedy = one_line(error).removeprefix(f"{file}: ").partition("; ")
        yield Finding("mesh", file, name, f"cannot be read: {text}", remedy or RESTORE)
        return
    if not len(polygons.sizes):
        yield Finding("empty-mesh", file, name, "has no faces", "remove the shape, or restore the file")
        return
    bad = np.flatnonzero(~np.isfinite(polygons.vertices).all(axis=1))
    if len(bad):
        text = f"{len(bad)} vertices are not finite, first vertex {bad[0] + 1}"
        yield Finding("not-finite", file, name, text, "correct the numbers, or export the mesh anew")
        return
    corners = polygons.vertices[triangles]
    by_mitsuba = triangles_by_mitsuba(file, plugin)
    if not same_triangles(np.asarray(corners, np.float32), by_mitsuba):
        many = int((polygons.sizes > 3).sum())
        text = "Sionna RT reads other triangles in it" if len(by_mitsuba) else "Sionna RT refuses the file"
        text += f", {many} faces have more than three corners" if many else ""
        yield Finding("polygons", file, name, text, "cut the faces into triangles (--repair does)")
    yield replace(part, corners_m=corners)


def mesh_file_parts(file: Path) -> Iterator[ShapePart | Finding]:
    """Parts of a mesh file, and findings about it."""
    if (suffix := file.suffix.lower()) in POLYGON_READERS:
        yield from read_triangles(ShapePart("", "", file, np.empty((0, 3, 3))), suffix.removeprefix("."))
        return
    yield Finding("format", file, "", f"plain Sionna RT opens no {suffix}", "wrf-mi does, and --repair writes PLY")
    try:
        require_memory(MEMORY_BINARY * file.stat().st_size, str(file), "divide it")
        meshes = mesh_parts(file)
    except InputError as error:
        yield refused("not-finite" if "not finite" in str(error) else "mesh", file, error)
        return
    if not meshes:
        yield Finding("empty-mesh", file, "", "has no faces", "give a mesh with faces, or a scan as PLY")
    for index, mesh in enumerate(meshes, start=1):
        name = f"part {index}" if len(meshes) > 1 else ""
        yield ShapePart(name, "", file, np.asarray(mesh.vertices, float)[mesh.faces])


def part_findings(part: ShapePart) -> Iterator[Finding]:
    """Findings about the triangles of a part."""
    empty = without_area(part.corners_m)
    corners = part.corners_m[~empty]
    drop = "leave them out (--repair does)"
    if count := int(empty.sum()):
        yield Finding("zero-area", part.file, part.name, f"{count} of {len(empty)} faces have no area", drop)
    if not len(corners):
        yield Finding("empty-mesh", part.file, part.name, "has no face with an area", "remove the shape")
        return
    doubled = copies(corners)
    if count := int(doubled.sum()):
        yield Finding("duplicate-faces", part.file, part.name, f"{count} of {len(empty)} faces are copies", drop)
    solids = bodies(corners[~doubled])
    if count := sum(map(wound_both_ways, solids)):
        text = f"{count} of {len(solids)} bodies have faces wound both ways"
        yield Finding("mixed-winding", part.file, part.name, text, "recalculate the normals (--repair does)")


def between_parts(parts: list[ShapePart]) -> Iterator[Finding]:
    """Findings about faces of different parts, and of different bodies of a part: copies, and sheets too near."""
    if not parts:
        return
    owner = np.repeat(np.arange(len(parts)), [len(part.corners_m) for part in parts])
    corners = np.concatenate([part.corners_m for part in parts])
    valid = np.flatnonzero(~without_area(corners))
    # Of copies within a part `part_findings` are.
    is_copy = owner[valid][first_copies(corners[valid])] < owner[valid]
    for k, count in zip(*np.unique(owner[valid][is_copy], return_counts=True), strict=True):
        text = f"{count} faces are copies of those of a shape before it"
        yield Finding("duplicate-faces", parts[k].file, parts[k].name, text, "remove one of both (--repair does)")
    yield from _near_sheets(parts, corners, owner)


def _near_sheets(parts: list[ShapePart], corners: FloatArray, owner: IntArray) -> Iterator[Finding]:
    """Pairs of parts with faces too near to each other, as sheets or as walls of two solids."""
    pairs = double_sheets(corners, materials_of(parts)[owner])
    involved = np.unique(owner[pairs])
    flat = np.zeros(len(corners), bool)
    for k in involved:
        flat[owner == k] = sheet_numbers(parts[k].corners_m) >= 0
    for i, j in np.unique(owner[pairs], axis=0):
        kind = "double-sheet" if flat[pairs[(owner[pairs] == (i, j)).all(axis=1)]].any() else "party-wall"
        other = "" if i == j else f" of {parts[i].name or 'the mesh'}"
        text = f"faces within 3 mm of faces{other} of the same material"
        remedy = "leave one of both, or put them apart by a centimetre"
        yield Finding(kind, parts[j].file, parts[j].name, text, remedy)


def materials_of(parts: Sequence[ShapePart]) -> IntArray:
    """Number of each part's material [n]."""
    return np.unique([part.material for part in parts], return_inverse=True)[1].reshape(-1)
