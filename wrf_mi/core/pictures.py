"""Pictures of others: their size is checked before they are decoded."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image

PICTURE_ERRORS = (MemoryError, OSError, SyntaxError, ValueError, struct.error, zlib.error, Image.DecompressionBombError)
"""What Pillow raises on damaged files."""


@contextmanager
def open_picture(path: Path, most_pixels: int, formats: tuple[str, ...] = ("PNG", "PPM")) -> Iterator[Image.Image]:
    """Open a picture of given formats, whose pixels are decoded when they are first used; errors: `PICTURE_ERRORS`.

    `ValueError` for more pixels than ``most_pixels``, as a small file may state any size.
    """
    with Image.open(path, formats=formats) as picture:
        width, height = picture.size
        if width * height > most_pixels:
            raise ValueError(f"{width} x {height} pixels; at most {most_pixels:,} are read")
        yield picture
