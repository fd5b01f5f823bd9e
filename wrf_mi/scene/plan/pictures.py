"""Pictures of plans: what their pixels say of the cells, and the YAML of ROS maps.

Source of the YAML and of how its modes read a pixel: https://wiki.ros.org/map_server.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps
from scipy import ndimage

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.pictures import PICTURE_ERRORS, open_picture
from ...core.settings import CheckedSettings, Inside, Positive, names_of, settings_from
from ...core.yaml_files import read_yaml

PICTURE_SUFFIXES = (".png", ".pgm", ".jpg", ".jpeg")
SHEET_SUFFIXES = (".yaml", ".yml")
FORMATS = ("PNG", "PPM", "JPEG")
WHITE, DEEP_WHITE = 255, 65535  # the lightest value of pixels of 8 and of 16 bits
SAVED_GREYS = (0, 205, 254)
"""Occupied, unmapped and free, as map_saver writes them. 205 is a probability of 0.196, at which readers disagree."""
UNMAPPED_GREY = SAVED_GREYS[1]
RAW_PERCENT = (
    100.0  # a pixel of mode raw is a probability in percent; larger values, such as -1 as a byte, are unmapped
)

OCCUPIED_PROBABILITY = 0.65
"""A cell more likely than this is occupied (``occupied_thresh`` of the ROS map_server's documentation)."""
FREE_PROBABILITY = 0.196  # a cell less likely than this is free (``free_thresh`` there)

DARK = WHITE * (1 - OCCUPIED_PROBABILITY)  # lightest grey of walls where nothing else is clear
LIGHTEST, GREY_RANGE = 240.0, 25.0
"""Grey from which nothing is drawn, and range of the greys of walls that are lighter than `DARK`."""
CORE_M, LEAST_CORE = 0.04, 0.001
"""Least distance of the middle of a wall from its faces, and least share of such pixels in a drawing."""
MOST_WIDE, SPANNED = 0.1, 0.6
"""Largest share of pixels of walls that are farther inside, and least share of the drawing's sides that walls span."""

Mode = Literal["trinary", "scale", "raw"]


@dataclass(frozen=True)
class Sheet(CheckedSettings):
    """Content of the YAML of a ROS map, by the names that map_server gives it.

    Attributes:
        origin: lower left corner x, y in metres, and the yaw of the map about it in radians, counter-clockwise.
        resolution: side of a cell, metres.
        image: name of the picture.
        free_thresh: probability below which a cell is free.
        occupied_thresh: probability above which a cell is occupied.
        negate: 1 where light pixels are occupied.
        mode: what a pixel means.
    """

    origin: tuple[float, float, float]
    resolution: Positive
    image: str = ""
    free_thresh: Inside = FREE_PROBABILITY
    occupied_thresh: Inside = OCCUPIED_PROBABILITY
    negate: Literal[0, 1] = 0
    mode: Mode = "trinary"


def read_sheet(file: Path, resolution_m: float | None) -> Sheet:
    """The YAML of a ROS map, whose resolution a stated one overrides.

    `InputError`: a missing or unusable value, by its name.
    """
    facts = {name: value for name, value in read_yaml(file).items() if name in names_of(Sheet)}
    facts |= {} if resolution_m is None else {"resolution": resolution_m}
    if missing := [name for name in ("origin", "resolution") if facts.get(name) is None]:
        raise InputError(f"{file}: not the YAML of a ROS map: it needs {', '.join(missing)}")
    try:
        sheet = settings_from(Sheet, facts, str(file))
    except InputError as error:  # ranges are those of any settings, whose file is not known there
        raise InputError(f"{file}, {str(error).removeprefix(f'{file}, ')}") from None
    if not np.isfinite(sheet.origin).all():
        raise InputError(f"{file}: origin is {list(sheet.origin)}; give finite x and y in metres and a yaw in radians")
    if sheet.free_thresh >= sheet.occupied_thresh:
        text = f"free_thresh is {sheet.free_thresh:g} and occupied_thresh {sheet.occupied_thresh:g}"
        raise InputError(f"{file}: {text}; give that of free cells first, the lower one")
    return sheet


@dataclass(frozen=True, eq=False)
class PlanDrawing:
    """Plan as it is drawn, for pictures of its scene.

    Attributes:
        pixels: picture [rows, columns, 3], its first row on top; None: there is none.
        box_m: lowest and highest coordinates [2, 2] of the picture.
        lines_m: lines [n, 2, 2].
        motion: matrix [4, 4] from the drawing's frame to the scene's.
    """

    pixels: NDArray[np.uint8] | None = None
    box_m: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))
    lines_m: FloatArray = field(default_factory=lambda: np.empty((0, 2, 2)))
    motion: FloatArray = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class Pixels:
    """Pixels of a picture, its first row on top.

    Attributes:
        grey: lightness from 0 to 1 on a white ground [rows, columns].
        transparent: pixels of which nothing is drawn, same shape.
        coloured: whether some pixel has a colour, which those of an occupancy grid never have.
    """

    grey: FloatArray
    transparent: np.ndarray
    coloured: bool

    def probability(self, sheet: Sheet | None) -> FloatArray:
        """Probability that a cell is occupied [rows, columns], NaN where the picture states that it is unmapped."""
        levels = np.round(WHITE * self.grey)
        if sheet is not None and sheet.mode == "raw":
            percent = WHITE - levels if sheet.negate else levels
            return np.where(percent <= RAW_PERCENT, percent / RAW_PERCENT, np.nan)
        probability = self.grey if sheet is not None and sheet.negate else 1 - self.grey
        if self.is_saved_map and not (sheet is not None and sheet.negate):
            probability = np.where(levels == UNMAPPED_GREY, np.nan, probability)
        if sheet is not None and sheet.mode == "scale":
            probability = np.where(self.transparent, np.nan, probability)
        return np.asarray(probability)

    @property
    def is_saved_map(self) -> bool:
        """Whether the pixels have the greys of map_saver and no others."""
        return not self.coloured and bool(np.isin(np.round(WHITE * self.grey, 6), SAVED_GREYS).all())


def wall_grey(grey: FloatArray, resolution_m: float, thickest_m: float) -> float:
    """Lightest grey, 0 to 255, of the walls of a drawing [rows, columns] with values from 0 to 1.

    It is `DARK` unless dark pixels lie in a small part of the drawing, or are lines, while those of a lighter grey are
    bands along most of it, at most as wide as a wall.
    """
    levels = WHITE * grey
    drawn = np.ptp(np.argwhere(levels < LIGHTEST), axis=0) if (levels < LIGHTEST).any() else np.zeros(2)

    def looks_like_walls(mask: NDArray[np.bool_]) -> bool:
        half_m = ndimage.distance_transform_edt(mask) * resolution_m
        core = np.argwhere(half_m >= CORE_M)
        if len(core) < LEAST_CORE * mask.size:
            return False
        wide = np.mean(half_m[mask] > thickest_m / 2)
        return bool(wide < MOST_WIDE and (np.ptp(core, axis=0) >= SPANNED * drawn).all())

    if looks_like_walls(levels <= DARK):
        return DARK
    ends = np.arange(DARK + GREY_RANGE, LIGHTEST, GREY_RANGE / 2)
    bands = [end for end in ends if looks_like_walls((levels > end - GREY_RANGE) & (levels <= end))]
    return float(bands[-1]) if bands and np.ptp(bands) <= GREY_RANGE else DARK


def thumbnail(file: Path, most_pixels: int, side: int) -> NDArray[np.uint8] | None:
    """Colours [rows, columns, 3] of a picture with at most some pixels along a side; None for 16 bits.

    `read_pixels` refuses files that cannot be read.
    """
    with open_picture(file, most_pixels, FORMATS) as stored:
        picture = ImageOps.exif_transpose(stored)
        if picture.mode.startswith(("I", "F")):
            return None
        small = picture.convert("RGBA")
        small.thumbnail((side, side))
        return np.asarray(Image.alpha_composite(Image.new("RGBA", small.size, "white"), small).convert("RGB"))


def read_pixels(file: Path, most_pixels: int) -> Pixels:
    """Pixels of a picture of any kind (grey, palette, colour, of 1, 8 or 16 bits, upright by its EXIF orientation).

    `InputError`: not a picture that can be read, or more pixels than ``most_pixels``.
    """
    try:
        with open_picture(file, most_pixels, FORMATS) as stored:
            picture = ImageOps.exif_transpose(stored)
            if picture.mode == "F":
                raise ValueError("pixels of floating point, whose white is not known; store 8 or 16 bits")
            if picture.mode.startswith("I"):  # 16 bits, which Pillow would cut off at 255
                values = np.asarray(picture, float)
                hidden = values == picture.info.get("transparency", -1)
                return Pixels(np.where(hidden, 1.0, values / DEEP_WHITE), hidden, False)
            drawn = picture.convert("RGBA")
            on_white = Image.alpha_composite(Image.new("RGBA", drawn.size, "white"), drawn).convert("RGB")
    except PICTURE_ERRORS as error:
        raise InputError(f"{file}: not a picture that can be read ({one_line(error)})") from None
    colours = np.asarray(on_white)
    grey = np.asarray(on_white.convert("L"), float) / WHITE
    return Pixels(grey, np.asarray(drawn)[..., 3] == 0, bool(np.ptp(colours, axis=-1).any()))
