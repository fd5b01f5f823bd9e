"""Pictures of plans: what their pixels say of the cells, and the YAML of ROS maps.

Source of the YAML and of how its modes read a pixel: https://wiki.ros.org/map_server.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
from PIL import Image, ImageOps

from ...core import InputError
from ...core.angles import FloatArray
from ...core.files import one_line
from ...core.pictures import PICTURE_ERRORS, open_picture
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

Mode = Literal["trinary", "scale", "raw"]


@dataclass(frozen=True)
class Sheet:
    """Content of the YAML of a ROS map.

    Attributes:
        image: name of the picture, as it is stated.
        resolution_m: side of a cell.
        origin_m: lower left corner [2].
        thresholds: probabilities below which a cell is free and above which it is occupied.
        negate: whether light pixels are occupied.
        mode: what a pixel means.
    """

    image: object
    resolution_m: float
    origin_m: FloatArray
    thresholds: tuple[float, float]
    negate: bool
    mode: Mode


def read_sheet(file: Path, resolution_m: float | None, thresholds: tuple[float, float]) -> Sheet:
    """The YAML of a ROS map, of which a resolution may be given; thresholds where it has none.

    `InputError`: a missing or unusable value, by its name, or a map that is turned.
    """
    facts = read_yaml(file)
    required = ["origin", *(["resolution"] if resolution_m is None else [])]
    if missing := [name for name in required if facts.get(name) is None]:
        raise InputError(f"{file}: not the YAML of a ROS map: it needs {', '.join(missing)}")
    x, y, yaw = _numbers(file, "origin", facts["origin"], 3, "x, y in metres and the yaw in rad")
    if yaw:
        raise InputError(f"{file}: the map is turned by {yaw:g} rad; set the yaw to 0 and register the scene")
    if resolution_m is None:
        (resolution_m,) = _numbers(file, "resolution", facts["resolution"], 1, "the side of a cell in metres")
        if resolution_m <= 0:
            raise InputError(f"{file}: resolution is {resolution_m:g}; give the side of a cell in metres, above zero")
    names = ("free_thresh", "occupied_thresh")
    stated = [
        _numbers(file, name, facts.get(name, usual), 1, "a probability")[0]
        for name, usual in zip(names, thresholds, strict=True)
    ]
    if not 0 < stated[0] < stated[1] < 1:
        text = f"free_thresh is {stated[0]:g} and occupied_thresh {stated[1]:g}"
        raise InputError(f"{file}: {text}; give probabilities above 0 and below 1, that of free cells first")
    if (negate := facts.get("negate", 0)) not in (0, 1):
        raise InputError(f"{file}: negate is {one_line(negate)[:40]}; give 0, or 1 if light pixels are occupied")
    if (mode := facts.get("mode", "trinary")) not in get_args(Mode):
        raise InputError(f"{file}: mode is {one_line(mode)[:40]}; give {', '.join(get_args(Mode))}")
    return Sheet(
        facts.get("image"), resolution_m, np.array([x, y]), (stated[0], stated[1]), bool(negate), cast(Mode, mode)
    )


def _numbers(file: Path, name: str, value: object, count: int, what: str) -> list[float]:
    """The finite numbers of a value of a YAML."""
    words: list[Any] = value if isinstance(value, list) else [value]
    try:
        numbers = [float(word) for word in words if not isinstance(word, bool)]
    except (TypeError, ValueError, OverflowError):
        numbers = []
    if len(numbers) != count or len(words) != count or not np.isfinite(numbers).all():
        numbers_text = "a finite number" if count == 1 else f"{count} finite numbers"
        raise InputError(f"{file}: {name} is {one_line(value)[:60]}; give {numbers_text}: {what}")
    return numbers


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
