"""Polygons of COLLADA and USD files, with the unit and the axis up that these state, and the content of glTF files.

trimesh reads COLLADA, too, but cuts concave polygons into fans, and drops unit and axis.
"""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from defusedxml.common import DefusedXmlException
from defusedxml.ElementTree import parse
from numpy.typing import ArrayLike

from ...core import InputError
from ...core.files import inside, one_line
from ...core.types import IntArray
from ..coordinates import Up, extra_package
from .polygon_files import Polygons

USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
MOST_PARTS = 100_000  # most parts of a file: nested copies of a small file would be without end
UP = {"Z_UP": "z", "Y_UP": "y", "Z": "z", "Y": "y"}
GEOMETRY = ("nodes", "meshes", "accessors", "bufferViews", "buffers", "scenes")
"""Parts of a glTF file in which an extension may change the geometry."""
HARMLESS = (
    "KHR_materials_",
    "KHR_texture_",
    "EXT_texture_",
    "KHR_lights_",
    "KHR_mesh_quantization",
    "KHR_xmp",
    "EXT_struc",
)
"""Beginnings of extensions of light, colour and description, and of integers as positions, which trimesh reads."""
Content = tuple[list[Polygons], float, Up]
"""Polygons of each part, the unit of their vertices in metres, and the axis that is up."""


def read_collada(path: Path) -> Content:
    """Geometry of a COLLADA scene, moved by its nodes; `ValueError` for a damaged file.

    Source: Khronos Group, "COLLADA 1.5.0", 5-18 (asset). Coordinates have single precision in pycollada.
    """
    collada = extra_package("collada")
    try:
        parse(path, forbid_dtd=True)
    except DefusedXmlException:
        raise InputError(f"{path}: has a document type or entities; remove them") from None
    with path.open("rb") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # it computes with numpy.matrix
        content = collada.Collada(stream, aux_file_loader=lambda name: inside(path.parent, name, path).read_bytes())
        parts = []
        for geometry in content.scene.objects("geometry") if content.scene else ():
            for primitive in geometry.primitives():
                if primitive.vertex is None or not hasattr(primitive, "normal_index"):
                    continue  # lines
                index = np.asarray(primitive.vertex_index)
                sizes = np.diff(primitive.polyindex)[:, 0] if index.ndim == 1 else np.full(len(index), 3)
                parts.append(_polygons(primitive.vertex, index, sizes, geometry.original.id))
                _check_number(parts)
    up = str(content.assetInfo.upaxis or "Y_UP")
    return parts, float(content.assetInfo.unitmeter or 1.0), _up(path, up)


def read_usd(path: Path) -> Content:
    """Meshes of a USD stage, moved by their transforms, without those that are guides or invisible.

    Subdivision surfaces are their cages. `InputError` for a stage with layers outside its folder, or with shapes that
    are no meshes, which would be missing.
    """
    extra_package("pxr")
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError(str(error).strip().splitlines()[-1]) from None
    for layer in stage.GetUsedLayers():
        if not layer.anonymous and not Path(layer.realPath).resolve().is_relative_to(path.parent.resolve()):
            raise InputError(f"{path}: has a layer outside its folder, {layer.realPath}; export one file")
    moves, parts = UsdGeom.XformCache(Usd.TimeCode.EarliestTime()), []
    for prim in Usd.PrimRange.Stage(stage, Usd.TraverseInstanceProxies()):
        if not _is_surface(prim, UsdGeom):
            continue
        if not prim.IsA(UsdGeom.Mesh):
            raise InputError(f"{path}: {prim.GetPath()} is a {prim.GetTypeName()}; export it as a mesh")
        mesh, time = UsdGeom.Mesh(prim), Usd.TimeCode.EarliestTime()
        attributes = (mesh.GetPointsAttr(), mesh.GetFaceVertexIndicesAttr(), mesh.GetFaceVertexCountsAttr())
        vertices, corners, sizes = (np.array(attribute.Get(time) or ()) for attribute in attributes)
        matrix = np.array(moves.GetLocalToWorldTransform(prim))  # of rows, multiplied from the left
        moved = vertices.reshape(-1, 3).astype(float) @ matrix[:3, :3] + matrix[3, :3]
        parts.append(_polygons(moved, corners, sizes, str(prim.GetPath())))
        _check_number(parts)
    return parts, float(UsdGeom.GetStageMetersPerUnit(stage)), _up(path, str(UsdGeom.GetStageUpAxis(stage)))


def _check_number(parts: list[Polygons]) -> None:
    if len(parts) > MOST_PARTS:
        raise ValueError(f"has more than {MOST_PARTS:,} parts with its copies written out")


def _is_surface(prim: Any, geometry: Any) -> bool:
    """Whether a visible part of a USD stage has surfaces, by the package's module ``UsdGeom``."""
    shape = geometry.Gprim(prim)
    if not shape:
        return bool(prim.IsA(geometry.PointInstancer))
    drawn = shape.ComputePurpose() != "guide" and shape.ComputeVisibility() != "invisible"
    return drawn and not prim.IsA(geometry.Curves) and not prim.IsA(geometry.Points)


def _polygons(vertices: ArrayLike, corners: IntArray, sizes: IntArray, name: str) -> Polygons:
    if sizes.sum() != corners.size:
        raise ValueError(f"{name} states {sizes.sum()} corners of faces and has {corners.size}")
    parts = np.zeros(len(sizes))
    return Polygons.of(vertices, corners, sizes, parts, lambda polygon: f"face {polygon + 1} of {name}")


def _up(path: Path, axis: str) -> Up:
    if axis not in UP:
        raise InputError(f"{path}: states {axis} as its axis up; export it with y or z up")
    return "y" if UP[axis] == "y" else "z"


def gltf_facts(file: Path) -> dict[str, Any]:
    """JSON of a glTF or GLB file, of which trimesh reads all that belongs to its geometry.

    Source: Khronos Group, "glTF 2.0", 3.6.2 (accessors), 3.12 (extensions) and 4.4 (binary chunks).

    Raises:
        InputError: an extension of the geometry, sparse or normalised positions, which trimesh would read as others.
    """
    content = file.read_bytes()
    if file.suffix.lower() == ".glb":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    facts: dict[str, Any] = json.loads(content)
    primitives = [primitive for mesh in facts.get("meshes", ()) for primitive in mesh["primitives"]]
    parts = [*primitives, *(part for key in GEOMETRY for part in facts.get(key, ()))]
    named = [name for part in parts for name in part.get("extensions", ())]
    # What is not required may be left out by a reader, unless it stands in a part of the geometry.
    needed = sorted({*named, *facts.get("extensionsRequired", ())})
    if unknown := [name for name in needed if not name.startswith(HARMLESS)]:
        raise InputError(f"{file}: its geometry needs the extension {one_line(unknown[0])}; export it without")
    for primitive in primitives:
        numbers = [primitive.get("indices"), *primitive["attributes"].values()]
        accessors = [facts["accessors"][number] for number in numbers if number is not None]
        if any("sparse" in accessor for accessor in accessors):
            raise InputError(f"{file}: has sparse accessors; export it without")
        if facts["accessors"][primitive["attributes"]["POSITION"]].get("normalized"):
            raise InputError(f"{file}: has positions in normalised integers; export it without")
    return facts


def bare_gltf(facts: dict[str, Any]) -> bytes:
    """A glTF file without materials and textures, of which no file is read."""
    for key in ("materials", "textures", "images", "samplers"):
        facts.pop(key, None)
    for mesh in facts.get("meshes", ()):
        for primitive in mesh["primitives"]:
            primitive.pop("material", None)
    return json.dumps(facts).encode()


class Beside:
    """Files in the folder of another one, as trimesh asks for them."""

    def __init__(self, path: Path) -> None:
        """The file beside which they are."""
        self._path = path

    def __getitem__(self, name: str) -> bytes:
        """Content of a file; `InputError` for one outside the folder."""
        return inside(self._path.parent, name, self._path).read_bytes()
