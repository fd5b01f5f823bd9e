"""Scans from files: points in metres, and where the scanner of each stood, in the formats that scanners write."""

from __future__ import annotations

import logging
import re
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from ...core import InputError
from ...core.angles import FloatArray
from ...core.array_files import stored_arrays
from ...core.files import one_line
from ...core.memory import require_memory
from ...core.types import IntArray
from ...parallel import run_module
from ..coordinates import FORMATS, UNITS_M, Up, extra_package, require_precise, source_file, turned, up_of
from ..mesh.planes import Mask
from ..mesh.polygon_files import read_obj, read_ply
from ..mesh.surfaces import Surface, sampled
from .read_child import surveyed_points

logger = logging.getLogger(__name__)

MOST_LAZ, MOST_LZF = 1000, 100
"""Largest ratios of compression: points of a LAZ reach 10, equal points a hundred; LZF writes 264 bytes as 3."""
LEAST_E57 = 8  # least points that a byte of an E57 may hold: a bit for a point, whatever its fields
LEAST_ROW = 6  # least bytes of a point in a text: three digits and what separates them
LAS_HEADER, LAS_MINOR, LAS_EXTENDED = 375, 25, 4
"""Bytes of the header of LAS 1.4, place of its minor version, and the version from which extended records exist."""
LAS_RECORDS = (("records", 100, 54), ("extended records", 243, 60))
"""Places of the numbers (32 bits) of variable-length records in the header, and the least bytes of a record."""
CHILD_BYTES, CHILD_S, CHILD_BYTES_PER_S = 4 << 30, 30.0, 1 << 20
"""Address space of the process that reads a file beside its points, and the time that it has."""
PCD_HEADER = 1 << 16  # bytes in which the header of a PCD has to end
PCD_KEYS = {"POINTS", "SIZE", "TYPE"}
PCD_TYPES = {"F": "<f", "I": "<i", "U": "<u"}
COMMENTS = ("#", "//")  # CloudCompare begins the line of the columns' names with slashes
STRAY_NEIGHBOURS = 20  # a surface has more returns about each of its own
STRAY_REACH = 0.05  # radius in which they lie, relative to the distance from the middle of the scan
FAR_OUT = 3.0
"""Quartile ranges beyond a quartile from which values are far out (Tukey 1977, "Exploratory data analysis")."""
SAMPLES_PER_FACE, SAMPLES_PER_M2, MOST_SAMPLES = 2, (150, 2500), 3_000_000
"""Points drawn on a mesh: of more on a face, whose noise is the same, medians would look like layers of a wall; of
fewer on a square metre no plane is found, more cost time alone. The most of them are as many as a large scan has."""
PTX_LINES = 8  # lines of a PTX after columns and rows: position and axes of the scanner, and its pose

Part = tuple[FloatArray, FloatArray | None]
"""Points [n, 3] of a scan in the file's unit and frame, and the place [3] of its scanner, or None."""


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of one or several scans.

    Attributes:
        points_m: shape [n, 3], metres, z up.
        viewpoints_m: places of the scanners that files state [k, 3], metres.
        viewpoint: number of the viewpoint of each point [n], -1 where it is not stated.
        walked: whether they were seen on a walk, so that the origin is no place of a scanner.
    """

    points_m: FloatArray
    viewpoints_m: FloatArray
    viewpoint: IntArray
    walked: bool = False


def read_points(path: str | Path, units: str | None = None, up: Up | None = None) -> FloatArray:
    """Points [m, 3] in metres, z up, of a point cloud, or the vertices of a mesh, see `read_scan`."""
    return read_scan([path], units, up).points_m


def read_scan(paths: Sequence[str | Path], units: str | None = None, up: Up | None = None) -> Scan:
    """Points of scan files in one frame, with the places of their scanners where the files state them.

    Scans of E57 and PTX are moved by their poses, and stand where these put their scanner; PCD states a viewpoint.
    Directions without a return (invalid points of E57, NaN in PCD, 0 0 0 in PTX) are no points.

    Args:
        paths: ``.npz`` with an array ``points`` or ``xyz_m`` [m, 3]; ``.las``, ``.laz``, ``.e57``, ``.pcd``; ``.pts``
            and ``.ptx``; ``.xyz`` or ``.txt`` with three or more columns, separated by spaces or commas; or any format
            that trimesh reads (PLY, OBJ, STL).
        units: unit of the files' coordinates, a key of `UNITS_M`; None: metres.
        up: axis that is up in them, see `wrf_mi.scene.mesh.files.mesh_parts`.

    Raises:
        InputError: missing file or package, unknown units, no points, a point that is not finite, or coordinates that
            were rounded far from the origin.
    """
    unit_m = UNITS_M.get(units or "m", 1.0)
    points, viewpoints, numbers = list[FloatArray](), list[FloatArray](), list[IntArray]()
    for path in paths:
        file = source_file(path, units, f"a point cloud ({FORMATS})")
        for part, viewpoint in _parts(file):
            near = ~_strays(part, file)
            part = part[near]
            require_precise(part, unit_m, file)
            points.append(turned(part * unit_m, up_of(file, up)))
            numbers.append(np.full(len(part), -1 if viewpoint is None else len(viewpoints)))
            if viewpoint is not None:
                viewpoints.append(turned(viewpoint * unit_m, up_of(file, up)))
    return Scan(np.concatenate(points), np.array(viewpoints, float).reshape(-1, 3), np.concatenate(numbers))


def _strays(points: FloatArray, file: Path) -> Mask:
    """Returns [n] far out of a scan that no surface explains, such as reflections in windows; logged.

    Few others are near them: at any distance, the directions of a scanner are spread as evenly on a surface.
    """
    strays = np.zeros(len(points), bool)
    low, middle, high = np.quantile(points, (0.25, 0.5, 0.75), axis=0)
    fence = FAR_OUT * (high - low)
    far = np.flatnonzero(((points < low - fence) | (points > high + fence)).any(axis=1))
    if not len(far) or len(points) < 2 * STRAY_NEIGHBOURS:
        return strays
    distance = np.linalg.norm(points[far] - middle, axis=-1)
    reach, _ = cKDTree(points).query(points[far], k=[STRAY_NEIGHBOURS + 1])  # the first is the point
    strays[far] = reach[:, 0] > STRAY_REACH * distance
    if strays.any():
        text = "%s: %d of %d points, up to %.4g from the middle, are strays without a surface, and are left out"
        logger.warning(text, file, strays.sum(), len(points), distance[strays[far]].max())
    return strays


def sampled_scan(surfaces: Sequence[Surface]) -> Scan:
    """Points on the faces of a measured mesh."""
    corners = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    least, most = (int(density * trimesh.triangles.area(corners).sum()) for density in SAMPLES_PER_M2)
    count = min(MOST_SAMPLES, max(min(SAMPLES_PER_FACE * len(corners), most), least))
    return Scan(sampled(corners, count), np.empty((0, 3)), np.full(count, -1), walked=True)


def _parts(file: Path) -> list[Part]:
    """The scans of a file, each with points, all of them finite."""
    try:
        parts = list(READERS.get(file.suffix.lower(), _read_vertices)(file))
        parts = [(points, viewpoint) for part, viewpoint in parts if (points := np.asarray(part, float)).size]
    except InputError:
        raise
    except Exception as error:  # NumPy, laspy and trimesh raise a dozen kinds on damaged files
        raise InputError(f"{file}: no points to be read ({one_line(error)}); give {FORMATS}") from None
    if not parts:
        raise InputError(f"{file}: no points in it; give {FORMATS}")
    first = 0
    for points, _ in parts:
        if points.shape[1:] != (3,):
            raise InputError(f"{file}: expected points of shape [m, 3], got {list(points.shape)}")
        if len(bad := np.flatnonzero(~np.isfinite(points).all(axis=1))):
            raise InputError(f"{file}, point {first + bad[0] + 1}: not finite; remove that point")
        first += len(points)
    return parts


def _read_npz(file: Path) -> list[Part]:
    arrays = stored_arrays(file, ("xyz_m", "points"))
    if not arrays:
        raise InputError(f"{file}: no array points or xyz_m in it; give one [m, 3]")
    return [(arrays["xyz_m" if "xyz_m" in arrays else "points"], None)]


def _read_text(file: Path) -> list[Part]:
    """Points of lines of text, whose columns a line above them may name; between commas, semicolons or blanks."""
    with file.open(encoding="utf-8-sig") as text:
        comments, first = list[str](), ""
        for first in filter(str.strip, text):
            if not first.startswith(COMMENTS):
                break
            comments.append(first)
        columns = _named_columns(first, len(_fields(first)))
        if columns is None:  # the line has numbers, and a comment above may name them: CloudCompare's "//X Y Z R G B"
            columns = next(filter(None, (_named_columns(line, len(_fields(first))) for line in comments[::-1])), None)
            text.seek(0)
        delimiter = next((mark for mark in ";," if mark in first), None)
        # Where semicolons separate fields, a comma is the decimal mark.
        rows: Iterable[str] = text if delimiter != ";" else (line.replace(",", ".") for line in text)
        table = _text_rows(rows, columns, delimiter)
    if columns is not None:
        return [(table, None)]
    if len(table) and table.shape[1] < 3:
        raise ValueError(f"{table.shape[1]} {'columns' if table.shape[1] > 1 else 'column'}; x y z wanted")
    is_whole = (table == np.round(table)).all(axis=0)
    if is_whole.size and is_whole[0] and np.count_nonzero(~is_whole) >= 3:
        raise ValueError(
            f"column 1 has whole numbers alone, such as {table[0, 0]:g}, as labels, colours and indices are; "
            "name the columns in a first line, as in: label x y z"
        )
    return [(table[:, :3], None)]


def _fields(line: str) -> list[str]:
    """Fields of a line between semicolons, else between commas and blanks."""
    return re.split(r"\s*;\s*" if ";" in line else r"\s*,\s*|\s+", line.strip())


def _named_columns(line: str, count: int) -> list[int] | None:
    """Places of x, y and z among ``count`` columns that a line names, with or without units: X[m], "x", x_m.

    Other words may stand before and after the names, as in ``# columns: class x y z``. None: the line names no columns.
    """
    words = [word.strip("\"'") for word in _fields(line.strip().lstrip("#/"))]
    names = [re.sub(r"[\[(].*|_m$", "", word).lower() for word in words]
    for first in range(max(len(names) - count, 0) + 1):
        if set(window := names[first : first + count]) >= set("xyz"):
            return [window.index(axis) for axis in "xyz"]
    return None


def _text_rows(
    rows: Iterable[str], columns: Sequence[int] | None = (0, 1, 2), delimiter: str | None = None
) -> FloatArray:
    """Columns [n, k] of rows of text, None: all; no row, and no warning of NumPy's, where there are no rows."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "loadtxt: input contained no data")
        return np.loadtxt(rows, usecols=columns, delimiter=delimiter, ndmin=2, comments=COMMENTS)


def _read_vertices(file: Path) -> list[Part]:
    suffix = file.suffix.lower()
    if suffix in (".ply", ".obj"):
        return [((read_ply if suffix == ".ply" else read_obj)(file).vertices, None)]
    with file.open("rb") as stream:  # without a name no other file is looked for
        points: Any = getattr(trimesh.load(stream, file_type=suffix.removeprefix(".")), "vertices", [])
    return [(points, None)]


def _read_las(file: Path) -> list[Part]:
    """Points of a LAS or LAZ file, whose header must not state more than the file can hold."""
    size = file.stat().st_size
    laspy = extra_package("laspy")
    with file.open("rb") as stream:
        head = stream.read(LAS_HEADER).ljust(LAS_HEADER, b"\0")
    for what, at, least in LAS_RECORDS:  # laspy reads as many as are stated, beyond the end of the file, too
        records = int.from_bytes(head[at : at + 4], "little")
        if (what == "records" or head[LAS_MINOR] >= LAS_EXTENDED) and records * least > size:
            raise ValueError(f"states {records} {what}, and has {size} bytes")
    with laspy.open(file) as source:
        header = source.header
        packed, needed = header.are_points_compressed, header.point_count * header.point_format.size
        _check_count(file, header.point_count, needed, size * (MOST_LAZ if packed else 1))
        parts = _read_apart(file, needed) if packed else [(surveyed_points(source.read()), None)]
    return [(_kept(points, file, "points of classes noise or withheld"), place) for points, place in parts]


def _check_count(file: Path, count: int, needed: int, most: int) -> None:
    """Refuse a file whose header states more points than it can hold, or than memory can."""
    if needed > most:
        raise ValueError(f"states {count} points, and has {file.stat().st_size} bytes")
    require_memory(4 * needed, f"{file}: {count} points", "thin the cloud first")


def _read_apart(file: Path, needed: int) -> list[Part]:
    """Scans of a file of about ``needed`` bytes of points, read by `wrf_mi.scene.scan.read_child`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "points.npz"
        arguments = [str(file), str(out), str(CHILD_BYTES + 4 * needed)]
        seconds = CHILD_S + file.stat().st_size / CHILD_BYTES_PER_S
        status, message = run_module("wrf_mi.scene.scan.read_child", arguments, quiet=True, most_s=seconds)
        if status != 0:
            raise ValueError(message if status == 1 else "its points are damaged")
        arrays = stored_arrays(out)
    parts = np.split(arrays["points"], np.cumsum(arrays["sizes"])[:-1])
    return [
        (points, viewpoint if np.isfinite(viewpoint).all() else None)
        for points, viewpoint in zip(parts, arrays["viewpoints"], strict=True)
    ]


def _read_e57(file: Path) -> list[Part]:
    pye57 = extra_package("pye57")
    source = pye57.E57(str(file))
    try:
        counts = [source.get_header(index).point_count for index in range(source.scan_count)]
    finally:
        source.close()
    _check_count(file, sum(counts), sum(counts), LEAST_E57 * file.stat().st_size)
    return _read_apart(file, 24 * sum(counts))


def _read_pcd(file: Path) -> list[Part]:
    """Points of a PCD file (https://pointclouds.org/documentation/tutorials/pcd_file_format.html).

    Open3D 0.20 reads wrong numbers where binary fields have types of different widths, and takes text that is cut off.
    """
    header, begin = _pcd_header(file)
    storage = header["DATA"][0]
    count, fields = int(header["POINTS"][0]), header["FIELDS"]
    lengths = [int(length) for length in header.get("COUNT", ["1"] * len(fields))]
    # Fields differ in type and width, and several may be called "_": their places name them.
    types = [PCD_TYPES[letter] + size for letter, size in zip(header["TYPE"], header["SIZE"], strict=True)]
    record = np.dtype([(str(i), kind, (n,)) for i, (kind, n) in enumerate(zip(types, lengths, strict=True))])
    most = file.stat().st_size * (MOST_LZF if storage == "binary_compressed" else 1)
    _check_count(file, count, count * (LEAST_ROW if storage == "ascii" else record.itemsize), most)
    places = [fields.index(axis) for axis in "xyz"]
    with file.open("rb") as stream:
        stream.seek(begin)
        if storage == "ascii":
            rows = (line.decode("ascii") for line in islice(stream, count))
            points = _text_rows(rows, [sum(lengths[:place]) for place in places])
        elif storage == "binary":
            table = np.frombuffer(stream.read(count * record.itemsize), record)
            points = np.stack([table[str(place)][:, 0] for place in places], axis=1, dtype=float)
        else:  # compressed as one block, of each field after the other
            packed, unpacked = np.frombuffer(stream.read(8), "<u4").tolist()
            if unpacked != count * record.itemsize:
                raise ValueError(f"states {count} points and {unpacked} bytes of them; it is damaged")
            block = extra_package("lzf").decompress(stream.read(packed), unpacked) or b""
            starts = count * np.cumsum([0, *(record[i].itemsize for i in range(len(fields)))])
            columns = [np.frombuffer(block[starts[i] : starts[i + 1]], types[i]) for i in places]
            points = np.stack(columns, axis=1, dtype=float)
    if len(points) != count:
        raise ValueError(f"states {count} points and ends after {len(points)}; it is cut off or damaged")
    place = np.array(header.get("VIEWPOINT", ["nan"] * 3)[:3], float)
    return [(_kept(points, file, "directions without a return"), place if np.isfinite(place).all() else None)]


def _pcd_header(file: Path) -> tuple[dict[str, list[str]], int]:
    """Words of the lines of a PCD file's header by their first, and the byte at which its points begin."""
    with file.open("rb") as stream:
        head = re.match(rb"(?:.*\n)*?DATA .*\n", stream.read(PCD_HEADER))
    lines = head[0].decode("ascii", "replace").splitlines() if head else []
    header = {words[0]: words[1:] for line in lines if (words := line.split())}
    if head is None or not {"x", "y", "z"} <= set(header.get("FIELDS", ())) or not header.keys() >= PCD_KEYS:
        raise ValueError(f"no header of a PCD file with x, y, z and {', '.join(sorted(PCD_KEYS))}")
    return header, head.end()


def _read_blocks(file: Path) -> Iterator[Part]:
    """Scans of a PTS or PTX file, each after its number of points, in PTX of columns and rows, and its pose there.

    Source: Leica Geosystems, "HDS scan formats"; points of a row are x y z, intensity and colours.
    """
    require_memory(4 * file.stat().st_size, str(file), "thin the cloud first")
    with file.open(encoding="utf-8-sig") as stream:
        while line := next((line for line in stream if line.strip()), ""):
            pose = None
            if not line.strip().isdecimal():
                raise ValueError("no number of points in the line before them; call it .xyz if all lines are points")
            count = int(line)
            if file.suffix.lower() == ".ptx":
                count *= int(next(stream, ""))
                pose = _ptx_pose(stream)
            if count < 0 or count * LEAST_ROW > file.stat().st_size:
                raise ValueError(f"states {count} points, and has {file.stat().st_size} bytes")
            points = _text_rows(islice(stream, count))
            if len(points) != count:
                raise ValueError(f"states {count} points and ends after {len(points)}; it is cut off")
            if pose is None:
                yield points, None
            else:  # rows are multiplied from the left, and the scanner is at the origin of its scan
                points[(points == 0).all(axis=1)] = np.nan
                points = _kept(points, file, "directions without a return")
                yield points @ pose[:3, :3] + pose[3, :3], pose[3, :3]


def _ptx_pose(stream: Iterator[str]) -> FloatArray:
    pose = np.array([[float(word) for word in next(stream, "").split()] for _ in range(PTX_LINES)][-4:])
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError("a scan without the 4 x 4 matrix of its pose")
    return pose


def _kept(points: FloatArray, file: Path, what: str) -> FloatArray:
    """Points without those that a reader marked as none, by NaN in all coordinates; their count is logged."""
    none = np.isnan(points).all(axis=1)
    if none.any():
        logger.info("%s: %d of %d are %s: left out", file, np.count_nonzero(none), len(points), what)
    return points[~none]


READERS: dict[str, Callable[[Path], Iterable[Part]]] = {
    **{".npz": _read_npz, ".las": _read_las, ".laz": _read_las, ".e57": _read_e57, ".pcd": _read_pcd},
    **{".pts": _read_blocks, ".ptx": _read_blocks, ".xyz": _read_text, ".txt": _read_text},
}
"""Readers of points by the ending of a file; others are read as the vertices of a mesh."""
