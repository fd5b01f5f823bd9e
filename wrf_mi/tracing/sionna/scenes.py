"""Opening of Sionna RT scenes from a name, a scene folder, a Mitsuba XML or a bare mesh.

Sionna RT traces meshes of triangles only. Mitsuba fans polygons from their first corner, which covers more than a
concave polygon, or refuses them, and its rectangles, disks, spheres and cylinders have no triangles.
"""

from __future__ import annotations

import logging
import re
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, cast
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
import trimesh
from numpy.typing import NDArray
from wrf_mi_scenes import scenes
from wrf_mi_scenes.mitsuba_xml import PERFECT, THICKNESS_M

from ... import backend
from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import listed, one_line
from ...core.yaml_files import read_yaml
from ...scene.coordinates import require_near, warn_of_up
from ...scene.folder import FACTS_FILE, read_scene_folder, scene_file
from ...scene.materials import FILE as MATERIALS_FILE
from ...scene.materials import Materials, thicknesses
from ...scene.mesh.files import mesh_parts
from ...scene.mesh.surfaces import sampled
from ...scene.scattering import take_scattering
from ...scene.xml_file import FILES, OVERRULED, make_files_absolute, named_shapes, overruled, read_scene_xml
from .materials import CONSTANTS, perfect_reflector, set_frequency
from .scattering import set_scattering

logger = logging.getLogger(__name__)

MESH_PLUGINS = ("ply", "obj")  # Mitsuba's shapes that are files of vertices and faces
MESHES = (".stl", ".ply", ".obj", ".glb")
HIGHEST_M = 500.0  # height above which a scene counts as one in millimetres
SEGMENTS = 32  # of a full circle of a curved shape, whose corners lie on it: its outline is 0.5 % of the radius off
CHECKED_FILES = 4096  # files whose triangles are remembered: a scene is opened once for each carrier and fold
REFUSALS = (RuntimeError, ValueError, SyntaxError, TypeError)  # errors of Mitsuba and Sionna RT about a scene file
PLACE = re.compile(r"^\[[\w.]+:\d+\] (((Error while|While) loading|At) string \(line \d+, col \d+\): )?")
"""Begin of Mitsuba's messages: its source line, and a place in a text that is not the file."""
PROPERTIES = (*CONSTANTS, "scattering_coefficient", "xpd_coefficient", "color")  # of a radio material
VALUES = ("float", "integer", "boolean", "string", "point", "vector", "transform")  # parameters of a shape


def _unit_shape(plugin: str) -> trimesh.Trimesh | None:
    """Mesh of a Mitsuba plugin in its own frame, as its ``to_world`` places it; None for another plugin."""
    if plugin == "rectangle":
        return trimesh.Trimesh([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], [[0, 1, 2], [0, 2, 3]], process=False)
    angle = np.linspace(-np.pi / 2, np.pi / 2, SEGMENTS // 2 + 1)
    # Radius and height along a line that is turned about z; on the axis it is 0, not its rounding, to close the mesh.
    lines: dict[str, FloatArray] = {
        "disk": np.array([[0, 0], [1, 0]]),
        "cylinder": np.array([[1, 0], [1, 1]]),
        "sphere": np.column_stack([np.cos(angle) * (np.abs(angle) < np.pi / 2), np.sin(angle)]),
    }
    if plugin not in lines:
        return None
    return trimesh.creation.revolve(lines[plugin], sections=SEGMENTS)


def replace_shapes(root: Element, path: Path, folder: Path) -> None:
    """Replace, in place, shapes that Mitsuba does not read as our triangles, and make names of files absolute.

    Rectangles become two triangles; disks, spheres and cylinders become inscribed meshes of `SEGMENTS` segments
    (logged). A mesh file whose polygons Mitsuba reads as other triangles than `mesh_parts` does, or not at all, becomes
    a file of those triangles in ``folder``, which the scene needs until it is loaded. All other shapes stay as they
    are.

    Raises:
        InputError: naming the file, the shape, and the remedy: a shape without triangles or with a parameter that
            Mitsuba does not know, or a mesh that cannot be read.
    """
    make_files_absolute(root, path)
    for number, (name, shape) in enumerate(named_shapes(root)):
        plugin = shape.get("type", "")
        try:
            content = _content(shape, root.get("version", ""), f"{path}: {name}")
        except InputError as error:
            raise InputError(f"{path}: {name}: {one_line(error)}") from None
        if content is None:
            continue
        # Mitsuba describes a shape by the name of its file, by which messages name the object.
        file_element = next((text for text in shape.findall("string") if text.get("name") in FILES), None)
        text = SubElement(shape, "string", name="filename", value=plugin) if file_element is None else file_element
        place = folder / str(number) / Path(text.get("value", "")).name
        place.parent.mkdir()
        place.write_bytes(content)
        text.set("value", str(place))
        shape.set("type", "ply")


def _mesh_content(shape: Element) -> bytes | None:
    """PLY of a mesh file's triangles; None where Mitsuba reads the same ones."""
    files = [text.get("value", "") for text in shape.findall("string") if text.get("name") in FILES]
    if len(files) != 1:
        raise InputError(f'has {len(files)} file names; give one: <string name="filename" value="..."/>')
    file = Path(files[0])
    stat = file.stat() if file.exists() else None
    return _own_triangles(file, shape.get("type", ""), stat and (stat.st_ino, stat.st_size, stat.st_mtime_ns))


@lru_cache(CHECKED_FILES)
def _own_triangles(file: Path, plugin: str, state: tuple[int, int, int] | None) -> bytes | None:
    """`_mesh_content` of a file, which is read again if its state (inode, bytes, time of change) is another one."""
    # Faces of vertices that are not there are refused first: Mitsuba follows them, and ends the process.
    parts = mesh_parts(file)
    if not parts:
        raise InputError(f"{file}: holds no triangles; remove the shape or restore the file")
    mesh = cast(trimesh.Trimesh, trimesh.util.concatenate(parts))
    corners = np.asarray(mesh.vertices, np.float32)[mesh.faces]
    if not np.isfinite(corners).all():
        raise InputError(f"{file}: an invalid vertex position, not a finite number; correct it")
    if same_triangles(corners, triangles_by_mitsuba(file, plugin)):
        return None
    logger.info("%s: read as %d triangles, which Mitsuba reads otherwise or not at all", file, len(corners))
    return plain_ply(mesh)


def triangles_by_mitsuba(file: Path, plugin: str) -> NDArray[np.float32]:
    """Corners [f, 3, 3] of a mesh file as Mitsuba reads it; none where it refuses the file."""
    import mitsuba as mi

    try:
        with quiet_mitsuba():
            # Normals of vertices are not needed, and cannot be computed for every file.
            mesh: Any = mi.load_dict({"type": plugin, "filename": str(file), "face_normals": True})
    except (RuntimeError, UnicodeDecodeError):  # the latter of a message that quotes bytes of the file
        return np.zeros((0, 3, 3), np.float32)
    corners = mesh.vertex_positions_buffer().numpy().reshape(-1, 3)
    return cast(NDArray[np.float32], corners[mesh.faces_buffer().numpy().reshape(-1, 3)])


@contextmanager
def quiet_mitsuba() -> Iterator[None]:
    """Without warnings, which loading of the scene repeats where they concern it."""
    import mitsuba as mi

    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Error)
    try:
        yield
    finally:
        mi.set_log_level(level)


def same_triangles(first: NDArray[np.float32], second: NDArray[np.float32]) -> bool:
    """Whether triangles [f, 3, 3] are the same, in any order and with any order of their corners."""
    if first.shape != second.shape or np.array_equal(first, second):
        return first.shape == second.shape
    _, corner = np.unique(np.concatenate([first, second]).reshape(-1, 3), axis=0, return_inverse=True)
    rows = np.sort(corner.reshape(2, -1, 3), axis=2)
    return all(np.array_equal(*(part[np.lexsort(part.T)][:, k] for part in rows)) for k in range(3))


def placed_mesh(shape: Element, version: str) -> trimesh.Trimesh | None:
    """Mesh of a shape without a file in the scene's frame; None for another shape.

    Args:
        shape: a cube, rectangle, disk, cylinder or sphere.
        version: version of its scene file; older ones have other names of parameters.

    Returns:
        The mesh, with the matrix that places it as ``to_world`` in its metadata.

    Raises:
        InputError: a parameter that Mitsuba does not know, or no area.
    """
    import mitsuba as mi

    plugin = shape.get("type", "")
    mesh = trimesh.creation.box((2, 2, 2)) if plugin == "cube" else _unit_shape(plugin)
    if mesh is None:
        return None
    # Mitsuba reads the parameters: its to_world then holds centre, radius and ends, too, and it names unknown ones.
    alone = Element("scene", version=version)
    shape_copy = SubElement(alone, "shape", type=plugin)
    shape_copy.extend([child for child in shape if child.tag in VALUES])
    try:
        with quiet_mitsuba():
            loaded: Any = mi.load_string(ElementTree.tostring(alone, encoding="unicode"))
        parameters = mi.traverse(loaded.shapes()[0])
        if "to_world" in parameters:
            to_world = parameters["to_world"].matrix.numpy().reshape(4, 4).astype(float)
        else:  # a cube is a mesh, whose vertices are placed
            corners = np.asarray(parameters["vertex_positions"].numpy().reshape(-1, 3), float)
            faces = parameters["faces"].numpy().reshape(-1, 3)
            mesh, to_world = trimesh.Trimesh(corners, faces, process=False), np.eye(4)
    except (RuntimeError, ValueError, TypeError) as error:
        raise InputError(f"cannot be opened ({reason(error)}); correct the shape") from None
    if np.isfinite(to_world).all():
        mesh.apply_transform(to_world)
    if not np.isfinite(mesh.vertices).all() or not np.isfinite(to_world).all() or not mesh.area_faces.min() > 0:
        raise InputError("has no area; give a radius and a transform that leave one")
    mesh.metadata["to_world"] = to_world
    return mesh


def _content(shape: Element, version: str, where: str) -> bytes | None:
    """PLY of a shape's triangles, None where Mitsuba has the same; one without a file then loses its parameters."""
    plugin = shape.get("type", "")
    if plugin in ("instance", "shapegroup"):
        raise InputError(f"Sionna RT has no {plugin}; write the shapes of the group in the instance's place")
    if plugin in MESH_PLUGINS:
        return _mesh_content(shape)
    placed = None if plugin == "cube" else placed_mesh(shape, version)
    if placed is None:
        return None
    for child in list(shape):
        if child.tag in VALUES:
            shape.remove(child)
    if plugin != "rectangle":
        # Facets of a sphere lie off it by both the angle between meridians and that between parallels.
        round_axes, angles = (3, 2) if plugin == "sphere" else (2, 1)
        to_world = placed.metadata["to_world"]
        off_m = (1 - np.cos(np.pi / SEGMENTS) ** angles) * np.linalg.norm(to_world[:3, :round_axes], 2)
        logger.info("%s: a %s as %d triangles, up to %.2g m off it", where, plugin, len(placed.faces), off_m)
    return plain_ply(placed)


def plain_ply(mesh: trimesh.Trimesh) -> bytes:
    """PLY of vertices and faces alone: Mitsuba warns of unknown attributes."""
    bare = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    return cast(bytes, bare.export(file_type="ply", vertex_normal=False))


def check_materials(root: Element, path: Path) -> None:
    """Refuse (`InputError`) a BSDF, in a shape or beside the shapes, without the id by which Sionna RT knows it.

    And one with constants whose id makes it a material of ITU-R P.2040, for which Sionna RT leaves them out.
    """
    materials = [(f"<bsdf> {number}", bsdf) for number, bsdf in enumerate(root.findall("bsdf"), start=1)]
    materials += [(f"{name}: its <bsdf>", bsdf) for name, shape in named_shapes(root) for bsdf in shape.findall("bsdf")]
    for where, bsdf in materials:
        if not bsdf.get("id"):
            remedy = 'give it one of its own, such as id="mat-my_material"'
            raise InputError(f"{path}: {where} ({bsdf.get('type')}) has no id; {remedy}")
        if overruled(bsdf):
            raise InputError(f"{path}: {where} {OVERRULED}")


def load_checked(root: Element, path: Path, folder: Path) -> Any:
    """Load a scene in Sionna RT from the root of its file, by way of a file in a folder.

    `InputError` names the file, the shape at fault where it is one, and Mitsuba's or Sionna RT's reason.
    """
    try:
        return _load(root, folder / "scene.xml")
    except REFUSALS as error:
        fault = error
    # Most messages do not name the shape: the first that cannot be loaded alone is at fault.
    shared = [element for element in root if element.tag != "shape"]
    names = {id(shape): name for name, shape in named_shapes(root)}
    name = ""
    for shapes in [[], *([shape] for shape in root.findall("shape"))]:
        part = Element("scene", root.attrib)
        part.extend([*shared, *shapes])
        try:
            _load(part, folder / "scene.xml")
        except REFUSALS as error:
            fault, name = error, f"{names[id(shapes[0])]}: " if shapes else ""
            break
    if "ITU material" in str(fault):
        choices = ", ".join(THICKNESS_M)
        raise InputError(f"{path}: {name}{reason(fault)}; known are {choices}, and constants of your own")
    raise InputError(f"{path}: {name}cannot be opened ({reason(fault)}); correct the scene")


def _load(root: Element, file: Path) -> Any:
    from sionna import rt

    # Cameras of pictures are not traced, and their films warn of the monochrome variant.
    traced = Element("scene", root.attrib)
    traced.extend([element for element in root if element.tag != "sensor"])
    ElementTree.ElementTree(traced).write(file)
    # Merged shapes, and with them the paths, have a random order.
    return rt.load_scene(str(file), merge_shapes=False)


def reason(error: Exception) -> str:
    """Mitsuba's or Sionna RT's reason for a refusal, without places in source code and in a text made by us."""
    text = str(error).strip() or type(error).__name__
    if "Traceback" in text:  # of Sionna RT's error, which Mitsuba repeats
        text = re.sub(r"^\w+: ", "", text.splitlines()[-1])
        if text.endswith("Pattern() takes no arguments"):  # which gets every property that the material does not know
            text = f"a radio material has an unknown property; known are {', '.join(PROPERTIES)}"
    elif unknown := re.findall(r'^\s*- (\w+ "[^"]*")', text, re.MULTILINE):
        text = f"unknown property {listed(unknown)}"
    return one_line(PLACE.sub("", text))


def open_scene(
    source: str | Path, frequency_hz: float, thickness_m: Mapping[str, float] | None = None, material: str | None = None
) -> Any:
    """Open a scene in Sionna RT at a carrier frequency.

    Args:
        source: name of a scene that comes with the package, a scene folder, a Mitsuba XML whose BSDFs are radio
            materials (``mat-itu_*``), or a mesh (``.stl``, ``.ply``, ``.obj``, ``.glb``) in metres, z up (GLB: y up).
        frequency_hz: carrier frequency; below a material's range see `set_frequency`.
        thickness_m: slab thickness of materials by name, metres, in place of the scene's.
        material: radio material of a mesh, a name of ITU-R P.2040 (``concrete`` or ``itu_concrete``) or ``perfect``.

    Returns:
        A ``sionna.rt.Scene``.

    Raises:
        InputError: an unknown name, a file that cannot be opened, no surface, coordinates in millimetres or too
            far from the origin, or a material that is missing, unknown or superfluous.
    """
    scene, stated_m, laws = load_scene(source, material)
    set_frequency(scene, frequency_hz, {**stated_m, **(thickness_m or {})}, laws)
    return scene


def load_scene(
    source: str | Path, material: str | None = None
) -> tuple[Any, dict[str, float], dict[str, tuple[float, float]]]:
    """Load a scene in Sionna RT without setting its frequency, with the arguments and errors of `open_scene`.

    Returns a ``sionna.rt.Scene``, and thicknesses and laws of its materials as `set_frequency` takes them.
    """
    backend.init()
    path, materials = Path(source), Materials()
    if not path.exists() and (named_scene := scenes().get(str(source))):
        path, materials = named_scene.xml, Materials(thickness_m=named_scene.thickness_m)
    elif path.is_dir():
        path, materials = _folder(path)
    if not path.is_file():
        ways = f"a name ({', '.join(scenes())}), a scene folder, a Mitsuba XML or a mesh ({', '.join(MESHES)})"
        raise InputError(f"{source}: no such scene file; give {ways}")
    mesh = path.suffix.lower() in MESHES
    if mesh == (material is None):
        text = f"a mesh has no radio material; give one, such as concrete, or {PERFECT}"
        text = text if mesh else f"has radio materials of its own; leave out the material {material}"
        raise InputError(f"{source}: {text}")
    try:
        scene = _checked(path, source, material)
    except InputError as error:
        raise InputError(f"{error} (wrf-mi check {source} names every fault)") from None
    set_scattering(scene, materials.scattering)
    return scene, dict(materials.thickness_m), materials.laws


def _checked(path: Path, source: str | Path, material: str | None) -> Any:
    """A ``sionna.rt.Scene`` of a scene file, or of a mesh with a material; `InputError` for one that traces wrongly."""
    scene = _from_xml(path) if material is None else _from_mesh(path, material)
    if not scene.objects:
        raise InputError(f"{source}: holds no surface; give a scene with triangles")
    bounds = scene.mi_scene.bbox()
    corners_m = np.array([bounds.min, bounds.max], float).reshape(2, 3)
    if (height := float(bounds.max.z - bounds.min.z)) > HIGHEST_M:
        text = f"{height:.0f} m high, as if in millimetres"
        raise InputError(f"{source}: {text}; scale the coordinates to metres (multiply by 0.001)")
    require_near(corners_m, source)
    return scene


def _folder(folder: Path) -> tuple[Path, Materials]:
    """Scene file and materials of a scene folder, from a scan or like those that come with the package."""
    if (folder / MATERIALS_FILE).is_file():
        read = read_scene_folder(folder)
        return read.xml, read.materials
    file = folder / FACTS_FILE
    if not file.exists():
        raise InputError(f"{folder}: no {FACTS_FILE} in it, so not a scene folder; give one, or a file")
    facts = read_yaml(file)
    stated_m = thicknesses(file, facts.get("thickness_m") or {})
    return scene_file(folder, facts), Materials(thickness_m=stated_m)


def _from_xml(path: Path) -> Any:
    root = read_scene_xml(path)
    check_materials(root, path)
    scattering = take_scattering(root, path)
    with tempfile.TemporaryDirectory() as folder:
        replace_shapes(root, path, Path(folder))
        scene = load_checked(root, path, Path(folder))
    set_scattering(scene, scattering)
    return scene


def _from_mesh(path: Path, material: str) -> Any:
    from sionna import rt

    if material == PERFECT:
        radio_material: Any = perfect_reflector()
    else:
        name = f"itu_{material.removeprefix('itu_')}"
        if name not in THICKNESS_M:
            choices = ", ".join(itu.removeprefix("itu_") for itu in THICKNESS_M)
            raise InputError(f"material {material!r}: unknown; give {PERFECT} or one of ITU-R P.2040: {choices}")
        kind = name.removeprefix("itu_")
        radio_material = rt.ITURadioMaterial(name, kind, THICKNESS_M[name])
    parts, scene = mesh_parts(path), rt.load_scene()
    if parts:
        triangles = np.concatenate([np.asarray(part.triangles) for part in parts])
        warn_of_up(sampled(triangles), path)
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for index, part in enumerate(parts):
            stem = path.stem.replace(".", "_")  # Mitsuba's names have no dots
            name = stem if len(parts) == 1 else f"{stem}_{index}"
            file = Path(folder) / f"{name}.ply"
            file.write_bytes(plain_ply(part))
            objects.append(rt.SceneObject(fname=str(file), name=name, radio_material=radio_material))
        if objects:
            scene.edit(add=objects)
    return scene
