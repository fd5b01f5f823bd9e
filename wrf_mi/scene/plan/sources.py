"""Files that show a building from above: occupancy grids, LiDAR returns in a plane, wall vertices, GeoJSON.

Walls are found in a `PlanGrid` of occupied, free and unknown cells, whose rows run with y. Row 0 of a picture, and so
of a ROS map, is its top (largest y); an NPZ file states on which side its row 0 lies.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import InputError
from ...core.angles import FloatArray
from ...core.array_files import stored_arrays
from ...core.files import inside, listed, one_line, text_lines
from ...datasets.folder_files import read_columns
from .buildings import Buildings
from .dxf import read_dxf
from .faces import THICKEST_WALL_M, PlanLines
from .geojson import GEOJSON_SUFFIXES, Extent, read_geojson
from .grid import PlanGrid, without_thin_lines
from .pictures import (
    DARK,
    FREE_PROBABILITY,
    OCCUPIED_PROBABILITY,
    PICTURE_SUFFIXES,
    SAVED_GREYS,
    SHEET_SUFFIXES,
    WHITE,
    Sheet,
    read_pixels,
    read_sheet,
    thumbnail,
    wall_grey,
)

logger = logging.getLogger(__name__)

Row0 = Literal["top", "bottom"]
"""Side of a plan where the first row of a grid lies: top is the largest y, bottom the smallest."""

NUMBERS = ("log_odds", "resolution_m", "origin_m", "xy_m")  # arrays of numbers in an NPZ file
POINT_CELL_M = 0.05  # side of the cells that points are counted in, as usual for maps of indoor robots
LARGEST_GRID_CELLS = 4_000_000  # 100 m x 100 m in cells of 5 cm; more is a mistake of units or a stray point far away
PLANS = ".npz, .png, .pgm, .jpg, .yaml, .csv, .xyz, .geojson, .osm or .dxf"
LARGEST_PICTURE = 4 * LARGEST_GRID_CELLS
"""Most cells of an occupancy grid that is stated as such: the walls of more take hours to find."""


def grid_from_probability(
    probability: ArrayLike,
    resolution_m: float,
    row_0: Row0,
    origin_m: ArrayLike = (0.0, 0.0),
    name: str = "grid",
    thresholds: tuple[float, float] = (FREE_PROBABILITY, OCCUPIED_PROBABILITY),
) -> PlanGrid:
    """A grid from the probability [rows, columns] that a cell is occupied, NaN where that is unknown.

    Cells below the first threshold are free, those above the second occupied. `InputError`: it has not two axes, holds
    nothing occupied, or the resolution is not positive.
    """
    p = np.asarray(probability, float)
    if p.size > LARGEST_PICTURE:
        raise InputError(f"{name}: {p.size:,} cells; give a plan of at most {LARGEST_PICTURE:,}, with larger cells")
    if p.ndim != 2 or not p.size:
        raise InputError(f"{name}: an occupancy grid has two axes (rows, columns), this one has shape {p.shape}")
    origin = np.asarray(origin_m, float)
    if not np.isfinite([resolution_m, *origin]).all() or resolution_m <= 0:
        raise InputError(f"{name}: the resolution is {resolution_m}; give the side of a cell in metres, above zero")
    if row_0 == "top":
        p = p[::-1]
    with np.errstate(invalid="ignore"):
        occupied, free = p > thresholds[1], p < thresholds[0]
    if not occupied.any():
        what = "every cell is NaN" if np.isnan(p).all() else "no cell is occupied"
        raise InputError(f"{name}: {what}; there is no wall to find, give another map")
    return PlanGrid(occupied, free, float(resolution_m), origin)


def grid_from_points(xy_m: ArrayLike, resolution_m: float | None = None) -> PlanGrid:
    """A grid of the cells that hold points [n, 2]; none is free, since points do not show which cells are empty.

    `InputError`: no points, or more cells than `LARGEST_GRID_CELLS`.
    """
    xy = np.asarray(xy_m, float)
    if xy.ndim != 2 or xy.shape[1] != 2 or not len(xy):
        raise InputError(f"points of a plan have shape [n, 2] with n > 0, these have {xy.shape}")
    if len(bad := np.flatnonzero(~np.isfinite(xy).all(axis=1))):
        raise InputError(f"point {bad[0]} is not finite; remove such points")
    cell = POINT_CELL_M if resolution_m is None else float(resolution_m)
    # An empty rim keeps every window of the search inside.
    low = (np.floor(xy.min(axis=0) / cell) - 2) * cell
    columns, rows = (np.floor((xy.max(axis=0) - low) / cell).astype(int) + 3).tolist()
    if rows * columns > LARGEST_GRID_CELLS:
        size = " x ".join(f"{side:.0f} m" for side in np.ptp(xy, axis=0))
        remedy = "are the units metres? Remove stray points or give a coarser resolution"
        raise InputError(f"{size} in cells of {cell} m are too many; {remedy}")
    occupied = np.zeros((rows, columns), bool)
    column, row = ((xy - low) / cell).astype(int).T
    occupied[row, column] = True
    return PlanGrid(occupied, np.zeros_like(occupied), cell, low)


def read_plan(
    path: str | Path,
    resolution_m: float | None = None,
    row_0: Row0 | None = None,
    extent_m: Extent | None = None,
    units: str | None = None,
    layers: Sequence[str] = (),
    level: str | None = None,
) -> PlanGrid | PlanLines | Buildings | FloatArray:
    """Any file that shows a plan, recognised by its ending and its content.

    - ``.npz`` with ``log_odds`` [rows, columns], ``row_0`` ("top" or "bottom"), ``resolution_m``, and optionally
      ``origin_m`` [2] of the lower left corner, zero by default. Values that all lie in 0..1 are taken as probabilities
      (log odds of free cells are negative).
    - ``.npz`` with points ``xy_m`` [n, 2], LiDAR returns in a horizontal plane.
    - ``.png``, ``.pgm``, ``.jpg``: a picture, dark where occupied, transparent pixels on white, with or without the
      ``.yaml`` of a ROS map beside it, which may be given in its place (`wrf_mi.scene.plan.pictures.read_sheet`).
      Without a YAML, and with other greys than those of map_saver, lines thinner than
      `wrf_mi.scene.plan.grid.THINNEST_WALL_M` are not walls (`without_thin_lines`), and a picture with colours has
      no unmapped cells.
    - ``.csv`` with the header ``x,y``: wall vertices (`read_layout`).
    - ``.geojson``, ``.json``, ``.osm``: outlines of rooms or buildings in longitude and latitude, and data of
      OpenStreetMap (`wrf_mi.scene.plan.geojson.read_geojson`).
    - ``.dxf``: lines on layers of walls, doors and windows (`wrf_mi.scene.plan.dxf.read_dxf`).
    - ``.xyz``, ``.txt``: points in two columns x, y (metres), separated by spaces, tabs or commas; # begins a comment.

    Args:
        path: path of the file.
        resolution_m: side of a cell of a grid; overrides that of the file.
        row_0: side of the plan where the first row of an NPZ grid lies; overrides that of the file.
        extent_m: width and height of the plan in GeoJSON.
        units: unit of the coordinates of a DXF; None: that which it states.
        layers: layers of walls in a DXF.
        level: level of the rooms of OpenStreetMap, or ``buildings``.

    Returns:
        A grid, whose cells are nowhere free where the file holds points, wall vertices [n, 2], lines or buildings.

    Raises:
        InputError: missing, unreadable or incomplete, points with the times of their scans, or an option that does
            not belong to the format of the file.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: missing; give a plan as {PLANS}")
    suffix = path.suffix.lower()
    if row_0 is not None and suffix != ".npz":
        fixed = suffix in (*PICTURE_SUFFIXES, *SHEET_SUFFIXES)
        raise _no_rows(path, "the first row of a picture is its top" if fixed else "this file has no rows of cells")
    is_map, is_dxf = suffix in GEOJSON_SUFFIXES, suffix == ".dxf"
    for option, value, fits, of in (
        ("--extent", extent_m, is_map, "plans in longitude and latitude (GeoJSON, OpenStreetMap)"),
        ("--level", level, is_map, "plans of OpenStreetMap"),
        ("--layers", layers or None, is_dxf, "DXF"),
        ("--units", None if units == "m" else units, is_dxf, "plans in DXF; other plans are in metres"),
        ("--resolution", resolution_m, not (is_map or is_dxf), "plans of cells, pixels or points"),
    ):
        if value is not None and not fits:
            raise InputError(f"{path}: {option} is for {of}; leave it out")
    if is_map:
        return read_geojson(path, extent_m, level)
    if is_dxf:
        return read_dxf(path, units, layers)
    if suffix in (*PICTURE_SUFFIXES, *SHEET_SUFFIXES):
        return _read_picture(path, resolution_m)
    match suffix:
        case ".npz":
            return _read_arrays(path, resolution_m, row_0)
        case ".csv":
            return read_layout(path)
        case ".xyz" | ".txt":
            return _grid_of_points(path, _read_text(path), resolution_m)
    raise InputError(f"{path}: unknown ending; a plan is {PLANS}")


def read_layout(path: str | Path) -> FloatArray:
    """Consecutive wall vertices [n, 2] in metres from a CSV file with the header ``x,y``; the path may double back.

    `InputError`: missing file, header or number, or no wall in it.
    """
    vertices = read_columns(Path(path), "x,y")
    if not np.any(np.diff(vertices, axis=0)):
        raise InputError(f"{path}: no wall; give at least two different vertices")
    return vertices


def _read_arrays(path: Path, resolution_m: float | None, row_0: Row0 | None) -> PlanGrid:
    try:
        content = stored_arrays(path)
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not an NPZ file ({one_line(error)})") from None
    numbers = dict[str, FloatArray]()
    for key in sorted(content.keys() & set(NUMBERS)):
        if content[key].dtype.kind not in "biuf":
            raise InputError(f"{path}: {key} holds no numbers but {content[key].dtype}")
        numbers[key] = content[key].astype(float)
    if "log_odds" in numbers:
        return _grid_of_arrays(path, {**content, **numbers}, resolution_m, row_0)
    if "xy_m" not in numbers:
        text = f"{path}: has neither log_odds nor xy_m but {listed(content) or 'nothing'}"
        raise InputError(f"{text}; give one of them")
    if row_0 is not None:
        raise _no_rows(path, "it holds points, which have no rows")
    if "time_s" in content:
        text = f"{path}: time_s: scans from several places are not aligned"
        raise InputError(f"{text}; give the map of a SLAM program, or leave out time_s if their poses are exact")
    return _grid_of_points(path, numbers["xy_m"], resolution_m)


def _grid_of_points(path: Path, xy_m: FloatArray, resolution_m: float | None) -> PlanGrid:
    try:
        return grid_from_points(xy_m, resolution_m)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _grid_of_arrays(
    path: Path, content: Mapping[str, NDArray[Any]], resolution_m: float | None, row_0: Row0 | None
) -> PlanGrid:
    if resolution_m is None:
        if "resolution_m" not in content:
            raise InputError(f"{path}: no resolution_m; give the side of a cell in metres (--resolution)")
        resolution_m = float(content["resolution_m"].reshape(-1)[0])
    origin = content.get("origin_m", np.zeros(2))
    if origin.shape != (2,) or not np.isfinite(origin).all():
        raise InputError(f"{path}: origin_m is {origin.tolist()}; give x and y of the lower left corner in metres")
    values = content["log_odds"]
    measured = values[~np.isnan(values)]
    if measured.size and (measured.min() < 0 or measured.max() > 1):  # else they are probabilities
        values = 1 / (1 + np.exp(-np.clip(values, -50, 50)))
    row_0 = row_0 or _stated_side(path, content.get("row_0"))
    return grid_from_probability(values, resolution_m, row_0, origin, str(path))


def _stated_side(path: Path, row_0: NDArray[Any] | None) -> Row0:
    """Side of the plan where the first row of an NPZ grid lies, as the file states it."""
    if row_0 is None:
        way = "store row_0 in the file, or give --row-0: top if the first row is the largest y, else bottom"
        raise InputError(f"{path}: does not state which side of the plan the first row is; {way}")
    word = str(row_0.astype(str).reshape(-1)[0]) if row_0.size == 1 else str(row_0.tolist())
    if (side := word.strip().lower()) in get_args(Row0):
        return cast(Row0, side)
    raise InputError(f"{path}: row_0 is {one_line(word)[:40]!r}; give top (largest y) or bottom (smallest y)")


def _no_rows(path: Path, why: str) -> InputError:
    return InputError(f"{path}: --row-0 is for an occupancy grid in an NPZ file, and {why}; leave it out")


def _scaled_picture(path: Path, resolution_m: float | None) -> tuple[Path, float, Sheet | None]:
    """Picture of a plan, side of its pixels, and the YAML of a ROS map that is it, names it or lies beside it."""
    is_sheet = path.suffix.lower() in SHEET_SUFFIXES
    file, sheet = path if is_sheet else path.with_suffix(".yaml"), None
    if file.is_file():
        sheet = read_sheet(file, resolution_m)
        path, resolution_m = inside(path.parent, sheet.image, path) if is_sheet else path, sheet.resolution
    if resolution_m is None:
        raise InputError(f"{path}: a picture has no resolution; give the side of a pixel in metres (--resolution)")
    return path, resolution_m, sheet


def picture_scale(
    path: Path, resolution_m: float | None = None
) -> tuple[tuple[int, int], float, tuple[float, float, float]]:
    """Rows and columns of a plan's picture, side of its pixels, and pose x, y, yaw of its lower left corner, metres.

    Raises:
        InputError: no picture that can be read, or no resolution.
    """
    path, resolution_m, sheet = _scaled_picture(path, resolution_m)
    rows, columns = read_pixels(path, LARGEST_PICTURE).grey.shape
    return (rows, columns), resolution_m, (0.0, 0.0, 0.0) if sheet is None else sheet.origin


def plan_pixels(path: Path, grid: PlanGrid, side: int) -> NDArray[np.uint8]:
    """Picture [rows, columns, 3] of a plan of cells that has been read, at most some pixels along a side."""
    if path.suffix.lower() in (*PICTURE_SUFFIXES, *SHEET_SUFFIXES):
        pixels = thumbnail(_scaled_picture(path, grid.resolution_m)[0], LARGEST_PICTURE, side)
        if pixels is not None:
            return pixels
    step = -(-max(grid.occupied.shape) // side)
    grey = np.where(grid.occupied, 0, np.where(grid.free, 255, SAVED_GREYS[1]))[::-step, ::step]
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def _read_picture(path: Path, resolution_m: float | None) -> PlanGrid:
    path, resolution_m, sheet = _scaled_picture(path, resolution_m)
    pixels = read_pixels(path, LARGEST_PICTURE)
    probability = pixels.probability(sheet)
    if sheet is not None:
        thresholds = sheet.free_thresh, sheet.occupied_thresh
        x, y, yaw = sheet.origin
        origin = np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x  # in the turned frame
        grid = grid_from_probability(probability, resolution_m, "top", origin, str(path), thresholds)
        return replace(grid, yaw_rad=yaw)
    level = DARK if pixels.is_saved_map else wall_grey(pixels.grey, resolution_m, THICKEST_WALL_M)
    if pixels.coloured or level > DARK:  # a drawing: what is no line is ground, of whatever colour
        probability = np.where(WHITE * pixels.grey <= level, 1.0, 0.0)
    grid = grid_from_probability(probability, resolution_m, "top", name=str(path))
    if pixels.is_saved_map:
        return grid
    if pixels.coloured or level > DARK:
        text = (
            "%s: %.2g %% of its pixels, those darker than grey %d, count as walls; if walls are others, darken these, "
        )
        text += "or state a lower occupied_thresh in the YAML of a ROS map beside it"
        logger.warning(text, path, 100 * grid.occupied.mean(), level)
    return without_thin_lines(grid, str(path))


def _read_text(path: Path) -> FloatArray:
    """Points [n, 2] of a text of two columns."""
    rows = []
    for number, line in enumerate(text_lines(path), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            rows.append([])
        if len(rows[-1]) != 2 or not np.isfinite(rows[-1]).all():
            raise InputError(f"{path}: line {number}: expected two numbers x, y, found {' '.join(words)!r}")
    if not rows:
        raise InputError(f"{path}: no points; give rows x y in metres")
    return np.array(rows)
