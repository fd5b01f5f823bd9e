"""Scene folders from a scan, a plan or a mesh (the command ``wrf-mi mesh``)."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import replace as replaced
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from ..core import InputError
from ..core.angles import FloatArray
from ..core.array_files import stored_names
from .coordinates import (
    STATING_UP,
    Y_UP,
    Up,
    check_extent,
    local_origin,
    require_clear_up,
    require_fine,
    require_near,
    require_up,
    source_file,
)
from .folder import SceneFolder, read_scene_folder, write_scene
from .materials import Materials, read_materials
from .mesh.facets import planes_of_mesh
from .mesh.files import SUFFIXES, read_mesh
from .mesh.ifc import read_ifc
from .mesh.measured import is_measured
from .mesh.polygon_files import FACES, LONGEST_HEADER, ply_header
from .mesh.surfaces import Surface, bounds, box_of, main_extent, moved, sampled, with_area
from .plan.faces import PlanLines
from .plan.geojson import GEOJSON_SUFFIXES, Extent
from .plan.grid import PlanGrid
from .plan.pictures import PICTURE_SUFFIXES, SHEET_SUFFIXES, PlanDrawing
from .plan.sources import Row0, plan_pixels, read_layout, read_plan
from .plan.storey import layout_walls, plan_surfaces
from .plan.walked import warn_of_places, with_walked_floor
from .positions import check_positions, in_plan, placed, read_positions, reflections
from .register import register_walls, wall_points
from .scan.cloud import surfaces_from_points
from .scan.las_units import require_stated_metres
from .scan.level import level_rotation
from .scan.points import Scan, read_scan, sampled_scan

logger = logging.getLogger(__name__)

PLAN_SUFFIXES = (*PICTURE_SUFFIXES, *SHEET_SUFFIXES, *GEOJSON_SUFFIXES, ".csv", ".dxf")
PREVIEW_POINTS, PREVIEW_PIXELS = 20_000, 1500
Storey = tuple[float | None, float, float | None, Row0 | None, Extent | None, Sequence[str], str | None]
"""Options of a plan: height of the ceiling, z of the floor, side of a cell, side where the first row lies, extent,
layers of walls, and level."""
UNSTATED: Storey = (None, 0.0, None, None, None, (), None)  # these options where none is given
LEAST_TURN_DEG = 0.1  # smaller angles between walls and axes are errors of the planes
RIGID = 1e-6  # largest deviation of a registration's rotation from orthonormal


def make_scene(
    points_file: str | Path | Sequence[str | Path],
    out: str | Path,
    *,
    units: str | None = None,
    up: Up | None = None,
    origin_m: Sequence[float] | None = None,
    materials: str | Path | Materials | None = None,
    height_m: float | None = None,
    floor_m: float = 0.0,
    resolution_m: float | None = None,
    registration: ArrayLike | None = None,
    register_walls_of: str | Path | None = None,
    positions: str | Path | None = None,
    row_0: Row0 | None = None,
    extent_m: Extent | None = None,
    layers: Sequence[str] = (),
    level: str | None = None,
    replace: bool = False,
) -> SceneFolder:
    r"""Make a scene folder that Mitsuba and Sionna RT both open, and return its content.

    Args:
        points_file: a 3D scan, or several in one frame (`wrf_mi.scene.scan.points.read_scan`); a plan in two dimensions
            (`wrf_mi.scene.plan.sources.read_plan`), which becomes walls, floor and ceiling; or a mesh with faces, which
            are cut into triangles and else used as they are.
        out: path of the folder.
        units: unit of the coordinates of a scan, mesh or DXF: m, dm, cm, mm, ft or in; None: that which COLLADA, USD
            and DXF state, else m, which is refused for a LAS or LAZ whose header states another one.
        up: axis of a scan or mesh that is up, y or z; None: that which COLLADA and USD state, y in glTF, else z, and
            coordinates that look otherwise are refused.
        origin_m: point [3] of the source, z up, metres, that becomes the origin before the registration: far from it,
            as in a national grid, single precision would move walls. Positions of measurements have to be less by it.
            None: the file's origin, or where that is too far away, and neither a registration nor positions say where
            the scene lies, a point of hundreds of metres near it, which is stored and logged.
        materials: rules and exceptions, or a ``materials.yml`` (or scene folder) to read them from.
        height_m: height from floor to ceiling, required for a plan and refused otherwise.
        floor_m: z of a plan's floor.
        resolution_m: side of a plan's cell; overrides that of the file.
        registration: 4 x 4 rigid motion from the source's frame to the scene's, metres; None keeps the frame.
        register_walls_of: a layout file (`wrf_mi.scene.plan.sources.read_layout`) to whose walls the scene is
            registered (`wrf_mi.scene.register.register_walls`), in place of ``registration``.
        positions: data folder or CSV file with measured positions in the scene's frame
            (`wrf_mi.scene.positions.read_positions`); a source whose walls they cross, or that they fit better when
            mirrored, is refused.
        row_0: side of the plan where the first row of an NPZ grid lies; overrides that of the file.
        extent_m: width and height of a plan in longitude and latitude (`wrf_mi.scene.plan.geojson.read_geojson`).
        layers: layers of walls in a DXF (`wrf_mi.scene.plan.dxf.read_dxf`).
        level: level of the rooms of OpenStreetMap, or ``buildings``.
        replace: replace an existing folder.

    Raises:
        InputError: an unusable file, a missing package, options that do not fit the source, coordinates too far from
            the origin, or an existing folder.

    A room of 6 m x 5 m from the walls of a plan, and the same without its ceiling:

    >>> import shutil, tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> corners = ["x,y", "0,0", "6,0", "6,5", "0,5", "0,0"]
    >>> characters = (folder / "layout.csv").write_text("\n".join(corners))
    >>> made = make_scene(folder / "layout.csv", folder / "room", height_m=2.5)
    >>> made.xml.name, dict(made.counts)
    ('scene.xml', {'surfaces': 6, 'faces': 12})
    >>> from wrf_mi.scene.edit import edit_scene
    >>> edit_scene(made.folder, folder / "open", remove=["ceiling*"]).name
    'open'
    >>> shutil.rmtree(folder)
    """
    files = list(map(Path, [points_file] if isinstance(points_file, str | Path) else points_file))
    file, out = files[0], Path(out)
    _check_options(file, out, replace, up)
    materials = read_materials(materials) if isinstance(materials, str | Path) else materials
    matrix, known_walls, measured = _references(file, registration, register_walls_of, positions)
    shift = _shift(file, origin_m)
    source = _read_source(files, units, up, (height_m, floor_m, resolution_m, row_0, extent_m, tuple(layers), level))
    if origin_m is None and matrix is known_walls is measured is None:
        origin_m = local_origin(source.extent_m)
        shift = _shift(file, origin_m)
    shift = shift @ source.turn
    if matrix is known_walls is None:  # before minutes are spent on a scan's planes
        require_near(trimesh.transform_points(source.extent_m, shift), file)
    source, turn = source.levelled(shift)
    surfaces = source.surfaces(up)
    motion, registered = shift, turn
    if matrix is known_walls is measured is None and (along := source.along_walls(surfaces)) is not None:
        motion, registered = along @ shift, along if turn is None else along @ turn
    if known_walls is not None:
        matrix = register_walls(wall_points(moved(surfaces, shift)), known_walls, str(file))
        motion, registered = matrix @ shift, matrix if turn is None else matrix @ turn
    elif matrix is not None:  # a registration is of the file as it is
        motion, registered = (matrix if turn is None else matrix @ turn.T) @ shift, matrix
    scene = placed(surfaces, motion, source.grid, measured)
    if measured is not None:
        mirrored = reflections(surfaces, file, source.grid, motion, known_walls, measured)
        check_positions(measured, scene, mirrored, f"{file} with the positions of {positions}")
        if source.grid is not None:  # only of a frame that has been checked
            places = in_plan(measured, motion)
            warn_of_places(source.grid, places, str(positions))
            scene = moved(with_walked_floor(surfaces, source.grid, places, unmapped=True), motion)
    write_scene(
        out,
        with_area(scene, str(file)),
        frame=_frame(file, origin_m, registered),
        origin_m=origin_m,
        source=", ".join(map(str, files)),
        materials=materials,
        registration=registered,
        replace=replace,
        positions_m=measured,
        **source.drawn(motion),
    )
    return read_scene_folder(out)


def _check_options(file: Path, out: Path, replace: bool, up: Up | None) -> None:
    if out.exists() and not replace:
        raise InputError(f"{out}: exists; remove it, choose another folder, or give --replace")
    if up not in (None, "y", "z"):
        raise InputError(f"{file}: {up!r} is up: give y or z")


def _references(
    file: Path, registration: ArrayLike | None, walls_of: str | Path | None, positions: str | Path | None
) -> tuple[FloatArray | None, FloatArray | None, FloatArray | None]:
    """Rigid motion [4, 4], walls [m, 2, 2] to register to, and measured positions [n, 3]; None where not stated."""
    if registration is not None and walls_of is not None:
        raise InputError(f"{file}: registration by pairs and to walls: give one of them")
    matrix = None if registration is None else _rigid(registration)
    walls = None if walls_of is None else layout_walls(read_layout(walls_of))
    return matrix, walls, None if positions is None else read_positions(positions)


@dataclass(frozen=True, eq=False)
class _Source:
    """Content of files: surfaces of a plan or mesh, with the cells of an occupancy grid, or else a scan."""

    file: Path
    parts: Sequence[Surface] = ()
    grid: PlanGrid | None = None
    scan: Scan | None = None
    yaw_rad: float = 0.0
    drawing: PlanDrawing | None = None

    @property
    def extent_m(self) -> FloatArray:
        """Lowest and highest coordinates [2, 3]."""
        return box_of(self.parts) if self.scan is None else bounds(self.scan.points_m)

    @property
    def turn(self) -> FloatArray:
        """Rotation [4, 4] of a robot's map about z in the frame of its file."""
        return np.asarray(trimesh.transformations.rotation_matrix(self.yaw_rad, [0, 0, 1]))

    def levelled(self, shift: FloatArray) -> tuple[_Source, FloatArray | None]:
        """The source with a scan made level about the origin to which a matrix [4, 4] shifts; its rotation or None."""
        if self.scan is None:
            return self, None
        try:
            turn, angle_deg = level_rotation(self.scan.points_m)
        except InputError as error:
            raise InputError(f"{self.file}: {error}") from None
        if not angle_deg:
            return self, None
        text = "%s: not level by %.1f degrees, and turned so that its walls are upright; scene.yml has the rotation, "
        text += "which positions in the frame of the file need as well"
        logger.warning(text, self.file, angle_deg)
        motion = np.linalg.inv(shift) @ turn @ shift
        points, places = (
            trimesh.transform_points(part, motion) for part in (self.scan.points_m, self.scan.viewpoints_m)
        )
        return replaced(self, scan=replaced(self.scan, points_m=points, viewpoints_m=places)), turn

    def surfaces(self, up: Up | None) -> Sequence[Surface]:
        """The surfaces, those of a scan after the search for its planes, which takes minutes for large ones."""
        if self.scan is None:
            return self.parts
        try:
            surfaces = surfaces_from_points(
                self.scan.points_m, self.scan.viewpoints_m, self.scan.viewpoint, walked=self.scan.walked
            )
        except InputError as error:
            raise InputError(f"{self.file}: {error}") from None
        if up is None and not _has_floor(surfaces):
            with suppress(InputError):
                turned = surfaces_from_points(trimesh.transform_points(self.scan.points_m, Y_UP.T))
                if _has_floor(turned):
                    surfaces = turned
            if _has_floor(surfaces):
                raise _other_up(self.file)
        if all(surface.kind == "other" for surface in surfaces):
            logger.warning("%s: no floor, ceiling or wall among its planes; mesh needs the scan of a room", self.file)
        return surfaces

    def along_walls(self, surfaces: Sequence[Surface]) -> FloatArray | None:
        """Rotation [4, 4] about z that puts the axes of a phone's frame along the walls; None where none is due.

        The frame of a survey or of a design is left as it is.
        """
        walls = [surface for surface in surfaces if surface.kind == "wall"]
        if self.scan is None or not self.scan.walked or not walls:
            return None
        normal = main_extent(np.concatenate([wall.vertices_m[wall.faces] for wall in walls]))[0]
        turn_deg = -float((np.degrees(np.arctan2(normal[1], normal[0])) + 45) % 90 - 45)
        if abs(turn_deg) < LEAST_TURN_DEG:
            return None
        text = "%s: turned by %.1f degrees about the vertical, so that its axes run along the walls; scene.yml has the "
        text += "rotation, which positions in the frame of the file need as well; --positions keeps the file's axes"
        logger.warning(text, self.file, turn_deg)
        return np.asarray(trimesh.transformations.rotation_matrix(np.radians(turn_deg), [0, 0, 1]))

    def drawn(self, motion: FloatArray) -> dict[str, Any]:
        """Arguments of `write_scene`: plan or moved points of a scan for the preview, and the number of all points."""
        if self.scan is None:
            return {"drawing_below": self.drawing and replaced(self.drawing, motion=motion)}
        count = len(self.scan.points_m)
        # At random: every k-th point would show the scanner's pattern.
        chosen = np.random.default_rng(1).integers(count, size=min(PREVIEW_POINTS, count))
        return {"points_m": trimesh.transform_points(self.scan.points_m[chosen], motion), "counts": {"points": count}}


def _read_source(files: Sequence[Path], units: str | None, up: Up | None, storey: Storey) -> _Source:
    file = files[0]
    if len(files) > 1 and (flat := [f for f in files if is_plan(f) or has_faces(f)]):
        raise InputError(f"{flat[0]}: several files are scans of one place, and this is none; give it alone")
    if is_plan(file):
        return _read_plan(file, units, up, storey)
    if storey != UNSTATED:
        raise InputError(f"{file}: no plan; leave out the options of plans, from --wall-height to --level")
    if file.suffix.lower() == ".ifc":
        if units is not None or up is not None:
            raise InputError(f"{file}: states its unit and has z up; leave out --units and --up")
        return _Source(file, read_ifc(source_file(file, None, "a model in IFC")))
    if has_faces(file):
        raw = read_mesh(file, units, up)
        require_up(sampled(np.concatenate([surface.vertices_m[surface.faces] for surface in raw])), file, up)
        if not is_measured(raw):
            return _Source(file, _split(raw, file, up))
        logger.warning("%s: its faces are uneven as those of a scan, and are read as points of its planes", file)
        scan = sampled_scan(raw)
        require_clear_up(scan.points_m, file, up)
    else:
        scan = read_scan(files, units, up)
    require_stated_metres(files, units)
    check_extent(scan.points_m, file)
    require_fine(scan.points_m, file)
    require_up(scan.points_m, file, up)
    return _Source(file, scan=scan)


def _shift(file: Path, origin_m: Sequence[float] | None) -> FloatArray:
    """Matrix [4, 4] that makes a point the origin."""
    origin = np.zeros(3) if origin_m is None else np.asarray(origin_m, float)
    if origin.shape != (3,) or not np.isfinite(origin).all():
        raise InputError(f"{file}: origin {tuple(origin.tolist())}: give three finite numbers of metres, x, y and z")
    return np.asarray(trimesh.transformations.translation_matrix(-origin))


def _frame(file: Path, origin_m: Sequence[float] | None, matrix: FloatArray | None) -> str:
    """Axes and origin of the scene in words."""
    origin = "" if origin_m is None else f", less the origin {', '.join(f'{value:.12g}' for value in origin_m)}"
    return f"that of {file.name}, z upwards{origin}{'' if matrix is None else ', moved by the registration'}"


def _rigid(registration: ArrayLike) -> FloatArray:
    """A rigid motion [4, 4]; `InputError` for another matrix."""
    matrix = np.asarray(registration, float)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not np.allclose(matrix[3], [0, 0, 0, 1]):
        raise InputError(f"registration: give a 4 x 4 matrix with the last row 0 0 0 1, not shape {matrix.shape}")
    rotation = matrix[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > RIGID or np.linalg.det(rotation) < 0:
        raise InputError("registration: not rigid (its rotation scales, shears or mirrors); give a rigid motion")
    return matrix


def _read_plan(file: Path, units: str | None, up: Up | None, storey: Storey) -> _Source:
    height_m, floor_m, resolution_m, row_0, extent_m, layers, level = storey
    if file.suffix.lower() == ".csv" and _has_heights(file):
        text = f"{file}: has a column z or three numbers in a row, and a CSV is a plan of wall corners, x,y"
        raise InputError(f"{text}; for points in three dimensions leave out its header and call it .xyz")
    if up is not None:
        raise InputError(f"{file}: a plan; leave out --up, which is for scans and meshes")
    plan = read_plan(file, resolution_m, row_0, extent_m, units, layers, level)
    below = None
    if isinstance(plan, PlanGrid):
        size_m = plan.resolution_m * np.array(plan.occupied.shape[::-1])
        below = PlanDrawing(plan_pixels(file, plan, PREVIEW_PIXELS), np.stack([plan.origin_m, plan.origin_m + size_m]))
    elif isinstance(plan, PlanLines):
        below = PlanDrawing(lines_m=np.concatenate(list(plan.pieces_m.values())))
    walls = plan_surfaces(plan, height_m=height_m, floor_m=floor_m, name=str(file))
    if not isinstance(plan, PlanGrid):
        return _Source(file, walls, drawing=below)
    return _Source(file, walls, plan if plan.free.any() else None, yaw_rad=plan.yaw_rad, drawing=below)


def _split(raw: Sequence[Surface], file: Path, up: Up | None) -> list[Surface]:
    """Surfaces of a mesh by kind, of which some floor shows that z is up."""
    surfaces = planes_of_mesh(raw)
    unstated = up is None and file.suffix.lower() not in STATING_UP
    if unstated and not _has_floor(surfaces) and _has_floor(planes_of_mesh(moved(raw, Y_UP.T))):
        raise _other_up(file)
    return surfaces


def _has_floor(surfaces: Sequence[Surface]) -> bool:
    return any(surface.kind == "floor" for surface in surfaces)


def _other_up(file: Path) -> InputError:
    remedy = "state it by wrf-mi mesh --up y, or --up z if it is right"
    return InputError(f"{file}: has no floor with z up, and one with y up; {remedy}")


def is_plan(path: str | Path) -> bool:
    """Whether a file shows a building from above, in two dimensions: by its ending, its arrays or its columns."""
    file = Path(path)
    suffix = file.suffix.lower()
    if suffix in PLAN_SUFFIXES:
        return True
    with suppress(OSError, ValueError, BadZipFile, NotImplementedError):  # the reader of points raises
        if suffix == ".npz":
            return bool(stored_names(file) & {"log_odds", "xy_m"})
        if suffix in (".xyz", ".txt"):
            with file.open(encoding="utf-8-sig") as stream:
                rows = (line.split("#")[0].replace(",", " ").split() for line in stream)
                return len(next(filter(None, rows), [])) == 2
    return False


def _has_heights(file: Path) -> bool:
    """Whether the first row of a table has three numbers or names x, y and z."""
    try:
        with file.open(encoding="utf-8-sig") as stream:
            row = re.split(r"[,;\s]+", stream.readline().strip().lower())[:3]
        return row == ["x", "y", "z"] or len([float(cell) for cell in row]) == 3
    except (OSError, ValueError):
        return False  # the reader of plans raises, and a header of names is no row of numbers


def has_faces(file: Path) -> bool:
    """Whether a file is a mesh and not a cloud; PLY may be either."""
    suffix = file.suffix.lower()
    if suffix != ".ply" or not file.is_file():
        return suffix in SUFFIXES and file.is_file()
    with file.open("rb") as stream:
        try:
            elements, _, _ = ply_header(stream.read(LONGEST_HEADER))
        except ValueError:
            return False  # the reader of points raises
    return any(element.name in FACES and element.count for element in elements)
