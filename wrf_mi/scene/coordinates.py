"""Coordinates of meshes and scans: units, the axis that is up, distance from the origin, how finely they are stored.

The packages that read some of their formats are imported here, too.
"""

from __future__ import annotations

import logging
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import one_line

logger = logging.getLogger(__name__)

Up = Literal["y", "z"]
UNITS_M = {
    "m": 1.0,
    "dm": 0.1,
    "cm": 0.01,
    "mm": 0.001,
    "ft": 0.3048,
    "in": 0.0254,
}  # length of each unit that a scan or mesh may be in
FORMATS = ".e57, .pcd, .pts, .ptx, .ply, .las, .laz, .xyz, .txt, or .npz with points"  # files with points
CONVERSIONS = {
    ".ifczip": "unpack it",
    ".pbf": "convert it to .osm: osmium cat FILE.osm.pbf -o FILE.osm",
    ".fbx": "convert it, in Blender: File > Import > FBX, File > Export > glTF",
    ".blend": "export it as glTF or OBJ: File > Export in Blender",
    ".skp": "export it as COLLADA (.dae) or OBJ: File > Export > 3D Model in SketchUp",
    **dict.fromkeys((".dxf", ".osm"), "a plan; make a scene of it: wrf-mi mesh FILE --wall-height M --out SCENE"),
    ".dwg": "export it as .dxf: Save As in a CAD program, or the ODA File Converter",
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), "export it as .stl or .obj, in FreeCAD: File > Export"),
    **dict.fromkeys((".rvt", ".rfa", ".3ds", ".max", ".3dm"), "export it as .obj, .stl or glTF"),
    **dict.fromkeys((".rcp", ".rcs"), "export its points as .e57: Export in ReCap"),
    **dict.fromkeys((".b3dm", ".i3dm", ".pnts", ".cmpt"), "a tile of 3D Tiles; convert its content to .glb"),
    **dict.fromkeys((".zip", ".7z", ".rar"), "unpack it"),
}
"""How scenes in other formats become one that is read, by the ending of the file."""
EXTRAS = {
    **dict.fromkeys(("laspy", "open3d", "pye57", "lzf"), "lidar"),
    **dict.fromkeys(("collada", "pxr"), "meshes"),
    **dict.fromkeys(("ezdxf", "pyproj"), "cad"),
    "ifcopenshell": "bim",
}
"""Extra of this package that installs a package; `SYSTEM` are libraries that Open3D needs and a small system lacks."""
SYSTEM = "apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6"
LONGITUDE, LATITUDE = 180.0, 90.0  # largest angles, degrees
LARGEST_M, HIGHEST_M, SMALLEST_M = 1000.0, 100.0, 0.5
"""Bounds of the extent of a building; outside them the units are wrong."""
Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From z up to y up: x, y, z become x, z, -y."""
Y_UP_SUFFIXES = (".glb", ".gltf")  # files whose specification has y up (glTF 2.0, section 3.4)
STATING_UP = (*Y_UP_SUFFIXES, ".dae", ".usd", ".usda", ".usdc", ".usdz", ".ifc")  # files that state the axis that is up
FARTHEST_M = 2.0**14
"""Distance from the origin from which numbers of single precision, in which scenes are traced, are 2 mm apart."""
LOST_M = 0.005  # steps of single precision in a file from which it is refused: nothing brings back what it has rounded
COARSE_M, COARSEST_M = 0.03, 0.06
"""Steps of a scan's coordinates that blur its planes, and that hide them: one and two of the cells it is thinned to."""
STEP_TOLERANCE = 0.01
"""Largest deviation from a multiple of a step, in steps: rounding of single precision near the origin."""
MOST_POINTS = 100_000  # points of a scan by which its axes and steps are judged
ROOM_HEIGHT_M = 1.9, 3.5  # usual heights of rooms
CORRIDOR, CORRIDOR_M = 4.0, 4.5  # least length of a corridor in its widths, and the largest height of one
SHAFT, SHAFT_HEIGHT = 2.0, 2.0
"""Largest length of a shaft or stairwell in its widths, and its least height in its lengths."""
TALL = 1.4  # least ratio of the extents along z and y of data that look as if y were up
BROAD = 1.2  # least ratio of the areas seen along y and z of such data; corridors with a tall end have less
CLEARLY_MORE, TILTED_M = 1.3, 0.5
"""Least ratio of the areas seen along z and y of a room of which z is surely up, and height that a tilt adds."""
FLOOR_M = 0.05  # largest height of a floor that counts as zero
CELLS = 40  # cells along the longest side, in which areas are seen
CORE = (0.005, 0.995)
"""Quantiles of the coordinates between which the extent is taken: strays do not make a room larger."""
WIDEST_DEG = 1.0  # largest extent of a place in degrees
AWAY = 20.0
"""Least distance of a place in degrees from the origin in its extents, 1 km at 0.2 degrees: a room in metres is not a
metre wide and twenty metres away."""


def is_geographic(xy: FloatArray) -> bool:
    """Whether coordinates [n, 2] may be degrees of a place on the globe rather than metres of a room."""
    extent, largest = float(np.ptp(xy, axis=0).max()), np.abs(xy).max(axis=0)
    in_range = largest.max() <= LONGITUDE and largest.min() <= LATITUDE
    return bool(in_range and 0 < extent <= WIDEST_DEG and largest.max() >= AWAY * extent)


def local_projection(longitude: float, latitude: float) -> str:
    """The azimuthal equidistant projection about a place in degrees (PROJ), to metres east and north.

    Distances from the place are exact.
    """
    return f"+proj=aeqd +lon_0={longitude:.10g} +lat_0={latitude:.10g} +datum=WGS84 +units=m"


def up_of(path: str | Path, up: Up | None) -> Up:
    """The axis that is up in a file: the one that is stated, else that of its format."""
    return up or ("y" if Path(path).suffix.lower() in Y_UP_SUFFIXES else "z")


def turned(points: FloatArray, up: Up) -> FloatArray:
    """Points [n, 3] with an axis up as points with z up."""
    return points @ Y_UP[:3, :3] if up == "y" else points


def extent(points_m: FloatArray) -> FloatArray:
    """Lowest and highest coordinates [2, 3] of points [n, 3] but for strays."""
    return np.quantile(points_m, CORE, axis=0)


def looks_y_up(points_m: FloatArray) -> bool:
    """Whether points [n, 3] on the surfaces of a room or building look as if y were up and not z.

    They do if they are a room's height along y and higher along z, where more area is seen along y than along z; or if
    they begin at zero along y and end at zero along z. Corridors and shafts have walls larger than their floor, and do
    not.
    """
    points_m = points_m[:: len(points_m) // MOST_POINTS + 1]
    low, high = extent(points_m)
    length, along_y, along_z = high - low
    least, most = ROOM_HEIGHT_M
    if along_y < least or along_z <= most:
        return False
    if abs(low[1]) <= FLOOR_M and abs(high[2]) <= FLOOR_M:
        return True
    corridor = length >= CORRIDOR * along_y and along_z <= CORRIDOR_M
    shaft = length <= SHAFT * along_y and along_z >= SHAFT_HEIGHT * length
    if any((corridor, shaft, along_y > most, along_z < TALL * along_y)):
        return False
    seen_along_y, seen_along_z = _seen_cells(points_m, low, high)
    return seen_along_y > BROAD * seen_along_z


def _seen_cells(points_m: FloatArray, low: FloatArray, high: FloatArray) -> tuple[int, int]:
    """Numbers of cells in which points [n, 3] of an extent are seen along y, and along z."""
    cell = ((points_m - low) / ((high - low).max() / CELLS)).astype(int)
    return len(np.unique(cell[:, [0, 2]], axis=0)), len(np.unique(cell[:, [0, 1]], axis=0))


def warn_of_up(points_m: FloatArray, name: str | Path, stated: Up | None = None) -> None:
    """Log that points [n, 3], z up, of a file for which no axis was stated look as if another than `up_of` were up."""
    if stated is None and looks_y_up(points_m):
        logger.warning("%s, or --up %s", _up_text(points_m, name), up_of(name, None))


def require_up(points_m: FloatArray, name: str | Path, stated: Up | None) -> None:
    """Refuse points [n, 3], z up, that look as if y were up in a file that states no axis; warn where it states one.

    The floor of such a file would become a wall.
    """
    if Path(name).suffix.lower() in STATING_UP:
        warn_of_up(points_m, name, stated)
    elif stated is None and looks_y_up(points_m):
        raise InputError(f"{_up_text(points_m, name)}, or --up {up_of(name, None)} if it is right")


def _up_text(points_m: FloatArray, name: str | Path) -> str:
    up = up_of(name, None)
    _, along_y, along_z = np.ptp(extent(points_m), axis=0)
    other, sides = ("y", (along_y, along_z)) if up == "z" else ("z", (along_z, along_y))
    size = f"{sides[0]:.3g} m along y, {sides[1]:.3g} m along z of the file"
    text = f"{name}: looks as if {other} were up ({size}), and is read with {up} up"
    return f"{text}; state it by wrf-mi mesh --up {other}"


def require_clear_up(points_m: FloatArray, name: str | Path, stated: Up | None) -> None:
    """Refuse points [n, 3], z up, of a phone's scan that may be of a room with y up, in a file that states no axis.

    Phones write either. The axis is clear where y is no height of a room, or z is one along which far more area is
    seen.
    """
    if stated is not None or Path(name).suffix.lower() in STATING_UP:
        return
    low, high = extent(points_m)
    _, along_y, along_z = high - low
    seen_along_y, seen_along_z = _seen_cells(points_m[:: len(points_m) // MOST_POINTS + 1], low, high)
    is_clear = along_z >= ROOM_HEIGHT_M[0] and seen_along_z > CLEARLY_MORE * seen_along_y
    if ROOM_HEIGHT_M[0] <= along_y <= ROOM_HEIGHT_M[1] + TILTED_M and not is_clear:
        text = f"{name}: {along_y:.1f} m along y and {along_z:.1f} m along z of a phone's scan may both be the height"
        raise InputError(f"{text} of a room; state the axis that is up by wrf-mi mesh --up y or --up z")


def check_extent(points_m: FloatArray, name: str | Path) -> None:
    """Refuse coordinates [n, 3] of a named source that are not metres of a room or a building."""
    size = np.ptp(extent(points_m), axis=0)
    text = f"{name}: extent {' x '.join(f'{side:.4g}' for side in size)} m"
    if size.max() > LARGEST_M:
        raise InputError(f"{text} looks like millimetres; give --units mm (or cut out one building)")
    if size[2] > HIGHEST_M:
        raise InputError(f"{text} looks like centimetres; give --units cm (or cut out one building)")
    if size.max() < SMALLEST_M:
        raise InputError(f"{text} is too small for a room; give its --units ({', '.join(UNITS_M)})")


def local_origin(points_m: FloatArray) -> tuple[float, float, float] | None:
    """Point of hundreds of metres near the lowest coordinates of points [n, 3]; None for points near the origin.

    Farther away than `FARTHEST_M` single precision, in which scenes are traced, would move them by a millimetre.
    """
    if not len(points_m) or np.abs(points_m).max() < FARTHEST_M:
        return None
    x, y, z = (0.0 if abs(low) < 1000 else float(np.floor(low / 100) * 100) for low in points_m.min(axis=0))
    return x, y, z


def require_near(points_m: FloatArray, name: str | Path) -> None:
    """Refuse (`InputError`) points [n, 3] for which `local_origin` has an origin."""
    if (origin := local_origin(points_m)) is None:
        return
    far, text = float(np.abs(points_m).max()), ",".join(f"{value:.0f}" for value in origin)
    apart = f"where numbers of single precision, which scenes have, are {np.spacing(np.float32(far)):.2g} m apart"
    remedy = f"subtract {text} (wrf-mi mesh --origin {text}), and from the positions of the measurements, too"
    raise InputError(f"{name}: coordinates up to {far:.0f} m, {apart}; {remedy}")


def require_precise(points: FloatArray, unit_m: float, name: str | Path) -> None:
    """Refuse (`InputError`) points [n, 3] of a file, in its unit, that single precision rounded far from the origin."""
    if not len(points):
        return
    farthest = np.abs(points).max(axis=0)
    axis = int(np.argmax(farthest))
    values, step = points[:, axis], float(np.spacing(np.float32(farthest[axis])))
    if step * unit_m < LOST_M or (values != values.astype(np.float32)).any():
        return
    # Whole and half metres of a design are exact in single precision, too; other axes then have no more digits.
    digits = np.log10(step)
    if _on_grid(values, 10.0 ** np.ceil(digits)) or _on_grid(np.delete(points, axis, axis=1), 10.0 ** np.floor(digits)):
        return
    text = f"has been rounded to steps of {step * unit_m:.2g} m, by single precision far from zero"
    remedy = "export it with a local origin or in double precision"
    raise InputError(f"{name}: {'xyz'[axis]} {text}; {remedy}")


def _on_grid(values: FloatArray, spacing: float) -> bool:
    return np.allclose(values / spacing, np.round(values / spacing), rtol=0, atol=1e-6)


def require_fine(points_m: FloatArray, name: str | Path) -> None:
    """Refuse (`InputError`) a scan [n, 3] stored in coarse steps, and log steps that blur its planes."""
    # Steps are those of two axes: on a third all points may lie on floor and ceiling.
    step = sorted(_step(values) for values in points_m[:: len(points_m) // MOST_POINTS + 1].T)[1]
    text = f"{name}: coordinates are in steps of {step:.2g} m (the scale of a LAS, or digits of a text)"
    if step > COARSEST_M:
        raise InputError(f"{text}, too coarse for planes; export it with steps of 1 cm or less")
    if step > COARSE_M:
        logger.warning("%s, which blurs planes; export it with steps of 1 cm or less", text)


def _step(values: FloatArray) -> float:
    """Step of which all differences of values [n] are multiples; 0 where there is none."""
    gaps = np.diff(np.unique(np.round(values - values[0], 6)))
    if not len(gaps):
        return 0.0
    ratio = gaps / gaps.min()
    return float(gaps.min()) if np.abs(ratio - np.round(ratio)).max() < STEP_TOLERANCE else 0.0


def extra_package(name: str) -> Any:
    """A package of `EXTRAS`; an `InputError` if it or a system library that it needs is not installed."""
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise InputError(f"scenes from such files need {name}: pip install '.[{EXTRAS[name]}]'") from None
    except ImportError as error:
        text = one_line(error)
        raise InputError(f"{name} cannot be loaded ({text}); install that library, on Debian: {SYSTEM}") from None


def source_file(path: str | Path, units: str | None, wanted: str) -> Path:
    """The path of a file; an `InputError` for unknown units or a missing file, whose message ends with ``wanted``."""
    if units is not None and units not in UNITS_M:
        raise InputError(f"units {units!r}: not known; give one of {', '.join(UNITS_M)}")
    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; give {wanted}")
    if remedy := CONVERSIONS.get(Path(path).suffix.lower()):
        raise InputError(f"{path}: {Path(path).suffix} is not read; {remedy}")
    return Path(path)
