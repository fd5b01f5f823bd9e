"""Polygons of OBJ and PLY files, with all their corners.

Other readers do not serve: trimesh cuts each polygon into a fan, and counts negative indices of OBJ from the end of the
file, as meshio does; Assimp and OpenMesh have single precision and lose or refuse leading blanks, comments behind
faces or continued lines; plyfile has the GPL.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.angles import FloatArray
from ...core.types import IntArray

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8", "int64": "i8", "uint64": "u8"},
}
PLY_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": ""}
CORNERS = ("vertex_indices", "vertex_index")  # names that writers of PLY give the list of a face's vertices
FACES = ("face", "tristrips")  # elements of PLY that make a mesh of points
LONGEST_HEADER = 1 << 20  # bytes in which a PLY file's header has to end


@dataclass(frozen=True)
class Polygons:
    """Polygons of a file.

    Attributes:
        vertices: shape [v, 3], in the file's unit.
        corners: vertex indices from 0, polygon after polygon, shape [k].
        sizes: number of corners of each polygon, shape [n].
        parts: number of the part that each polygon belongs to, from 0, shape [n].
        place: where in the file a polygon is, by its number, for messages.
    """

    vertices: FloatArray
    corners: IntArray
    sizes: IntArray
    parts: IntArray
    place: Callable[[int], str]

    @classmethod
    def of(
        cls, vertices: ArrayLike, corners: ArrayLike, sizes: ArrayLike, parts: ArrayLike, place: Callable[[int], str]
    ) -> Polygons:
        """Polygons of numbers of any type."""
        numbers = [np.asarray(values, np.int64).reshape(-1) for values in (corners, sizes, parts)]
        return cls(np.asarray(vertices, float).reshape(-1, 3), numbers[0], numbers[1], numbers[2], place)

    def __post_init__(self) -> None:
        """Refuse a polygon without three corners, or with one that is no vertex (`ValueError`)."""
        if len(few := np.flatnonzero(self.sizes < 3)):
            raise ValueError(f"{self.place(few[0])} has {self.sizes[few[0]]} corners; a face has three or more")
        count = len(self.vertices)
        if len(wrong := np.flatnonzero((self.corners < 0) | (self.corners >= count))):
            polygon = int(np.searchsorted(np.cumsum(self.sizes), wrong[0], side="right"))
            raise ValueError(f"a face names a vertex that is not among its {count}: {self.place(polygon)}")


def read_obj(path: Path) -> Polygons:
    """Polygons of a Wavefront OBJ file, a part for each material (``usemtl``); `ValueError` for a damaged line."""
    vertices: list[list[float]] = []
    corners: list[int] = []
    sizes, lines, parts = list[int](), list[int](), list[int]()
    materials = {"": 0}
    part = 0
    for number, words in _obj_statements(path):
        try:
            match words[0]:
                case "v":  # x y z, then perhaps a weight or a colour
                    vertices.append([float(word) for word in words[1:4]])
                    if len(words) < 4:
                        raise ValueError(f"a vertex of {len(words) - 1} numbers; expected 3")
                case "f" | "fo":  # fo: name of f in old versions
                    corners += [_obj_index(word, len(vertices)) for word in words[1:]]
                    sizes.append(len(words) - 1)
                    lines.append(number)
                    parts.append(part)
                case "usemtl":
                    part = materials.setdefault(" ".join(words[1:]), len(materials))
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    return Polygons.of(vertices, corners, sizes, parts, lambda polygon: f"line {lines[polygon]}")


def _obj_statements(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Words of each statement that is not empty, and its first line from 1."""
    pieces, first = list[str](), 0  # of a statement that goes on in the next line; joined once, as there may be many
    # Universal line ends; names may be in any encoding, and are not used.
    with path.open(encoding="utf-8-sig", errors="replace") as stream:
        for number, line in enumerate(stream, 1):
            first = first if pieces else number
            text = line.partition("#")[0].rstrip()
            pieces.append(text.removesuffix("\\"))
            if not text.endswith("\\"):
                if words := " ".join(pieces).split():
                    yield first, words
                pieces = []
    if words := " ".join(pieces).split():
        yield first, words


def _obj_index(word: str, count: int) -> int:
    """Vertex index from 0 of a corner such as ``3``, ``3/1/2``, ``3//2`` or ``-1``, after ``count`` vertices."""
    text = word.partition("/")[0]
    if not text.lstrip("+-").isdecimal():
        raise ValueError(f"{word[:20]!r} is no number of a vertex")
    index = int(text)
    if index == 0:
        raise ValueError("names vertex 0, and OBJ counts from 1; add 1 to the indices of all faces")
    if index > 0:
        return index - 1  # may be stated further down
    if index < -count:  # negative indices count back from the vertex above the face
        raise ValueError(f"names vertex {index}, and only {count} are above it")
    return count + index


@dataclass(frozen=True)
class PlyElement:
    """An element of a PLY file: rows of properties with a name, a NumPy type, and for a list the type of its length."""

    name: str
    count: int
    properties: list[tuple[str, str, str | None]]


def ply_header(content: bytes) -> tuple[list[PlyElement], str, int]:
    """Elements of a PLY file, its byte order (``<``, ``>``, or empty for text), and where its body begins."""
    # The line end may be LF, CR LF or CR; of binary data none may be taken for a part of it.
    begin = re.match(rb"(?:\xef\xbb\xbf)?ply[ \t]*(\r\n|\n|\r)", content)
    end = begin and re.compile(rb"end_header[ \t]*" + begin[1]).search(content[:LONGEST_HEADER])
    if not begin or not end:
        raise ValueError("no header of a PLY file, or none that ends")
    order, elements = None, list[PlyElement]()
    for line in content[begin.end() : end.start()].decode("utf-8", errors="replace").split(begin[1].decode()):
        match line.split():
            case ["format", form, _] if form in PLY_ORDERS:
                order = PLY_ORDERS[form]
            case ["element", name, count] if count.isdecimal():
                elements.append(PlyElement(name, int(count), []))
            case ["property", "list", count, kind, name] if elements and {count, kind} <= set(PLY_TYPES):
                elements[-1].properties.append((name, PLY_TYPES[kind], PLY_TYPES[count]))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].properties.append((name, PLY_TYPES[kind], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"line {line[:60]!r} of the header is none of PLY")
    if order is None:
        raise ValueError("no known format in the header")
    return elements, order, end.end()


def read_ply(path: Path) -> Polygons:
    """Polygons of a PLY file as one part; `ValueError` for a damaged file, or one without vertices.

    Source: G. Turk, "The PLY polygon file format" (1994).
    """
    columns = _ply_elements(path.read_bytes())
    vertex, face = columns.get("vertex", {}), columns.get("face", {})
    if not {"x", "y", "z"} <= set(vertex):
        raise ValueError("no vertices with x, y and z in it")
    if columns.get("tristrips"):
        raise ValueError("its faces are triangle strips; store them as faces")
    vertices = np.column_stack([vertex[axis] for axis in "xyz"])
    lists = next((face[name] for name in CORNERS if name in face), None)
    if face and lists is None:
        raise ValueError(f"faces without a list {' or '.join(CORNERS)}")
    corners, sizes = lists or (np.empty(0), np.empty(0))
    return Polygons.of(vertices, corners, sizes, np.zeros(len(sizes)), lambda polygon: f"face {polygon + 1}")


def _ply_elements(content: bytes) -> dict[str, dict[str, Any]]:
    """Columns of each element of a PLY file, see `_ply_columns`."""
    elements, order, at = ply_header(content)
    body, at, columns = content[at:], 0, dict[str, dict[str, Any]]()
    if not order:
        # Numbers of text as one binary table, so that both are cut into rows by the same code.
        body = np.fromstring(body.strip(), float, sep=" ").tobytes()
        elements = [
            PlyElement(e.name, e.count, [(name, "f8", count and "f8") for name, _, count in e.properties])
            for e in elements
        ]
    for element in elements:
        columns[element.name], at = _ply_columns(body, at, element, order or "=")
    return columns


def _ply_columns(body: bytes, at: int, element: PlyElement, order: str) -> tuple[dict[str, Any], int]:
    """Values [n] of an element's properties by name, of lists with their lengths [n]; where the next element begins."""
    rows = list[NDArray[Any]]()
    try:
        row, count = _row_type(body, at, element, order), element.count
        if count and at + row.itemsize * count <= len(body):
            # Lists mostly have the length of the first row's.
            table = np.frombuffer(body, row, count, at)
            lengths = [name for name in row.names or () if name.startswith("count")]
            if all((table[name] == table[name][0]).all() for name in lengths):
                rows, at = [table], at + table.nbytes
        for _ in range(0 if rows else count):
            row = _row_type(body, at, element, order)
            rows.append(np.frombuffer(body, row, 1, at))
            at += row.itemsize
    except ValueError:
        text = f"states {element.count} of {element.name} and ends before the last; it is cut off"
        raise ValueError(text) from None
    columns = {}
    for k, (name, _, has_length) in enumerate(element.properties if rows else ()):
        values = np.concatenate([part[f"{k}"].reshape(-1) for part in rows])
        columns[name] = (values, np.concatenate([part[f"count {k}"] for part in rows])) if has_length else values
    return columns, at


def _row_type(body: bytes, at: int, element: PlyElement, order: str) -> np.dtype[Any]:
    """Type of the row of an element at a place, with the lengths that its lists have there; `ValueError`: past the end.

    Fields have numbers, as names of properties may come twice.
    """
    fields, end = list[tuple[Any, ...]](), at
    for k, (_, kind, count) in enumerate(element.properties if element.count else ()):
        length = 1
        if count:
            length = int(np.frombuffer(body, order + count, 1, end)[0])
            end += np.dtype(count).itemsize
            fields.append((f"count {k}", order + count))
        if length < 0 or end + length * np.dtype(kind).itemsize > len(body):
            raise ValueError
        end += length * np.dtype(kind).itemsize
        fields.append((f"{k}", order + kind, (length,)))
    return np.dtype(fields)
