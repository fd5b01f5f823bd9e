"""Pixels in tiles, and for each tile the Gaussians that may reach it.

A list tile is `TILE_ROWS` x `TILE_COLUMNS` pixels. Inside it pixels are numbered in blocks of 2 x 8, so that
the 16 lanes of a vector register are neighbours, walk the same list and hit the same Gaussian at the same time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import numpy as np

from ..core.angles import azimuth_rad, elevation_rad
from ..project.footprint import Footprints

TILE_ROWS, TILE_COLUMNS = 6, 24
BLOCK_ROWS, BLOCK_COLUMNS = 2, 8


@dataclass
class Plane:
    """The perception plane: pixels in tile order, for one image size.

    Attributes:
        height: rows, over elevations 0 to 90 degrees.
        width: columns, over the whole azimuth.
        tile: list tile of each pixel slot, [slots].
        pixel: row-major pixel of each slot, [slots].
        active: False in slots that pad the plane to whole tiles.
        direction: unit vectors of the slots, three arrays.
        tile_row: first row of each list tile, [tiles].
        tile_column: first column of each list tile, [tiles].
    """

    height: int
    width: int
    tile: dr.ArrayBase
    pixel: dr.ArrayBase
    active: dr.ArrayBase
    direction: list[dr.ArrayBase]
    tile_row: dr.ArrayBase
    tile_column: dr.ArrayBase

    @property
    def tiles(self) -> int:
        """Number of list tiles."""
        return dr.width(self.tile_row)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.height * self.width


@lru_cache(maxsize=16)
def perception_plane(height: int, width: int, float_type: type) -> Plane:
    """The perception plane of ``height`` x ``width`` pixels over the hemisphere, arrays of ``float_type``."""
    index_type, mask_type = dr.uint32_array_t(float_type), dr.mask_t(float_type)
    rows, columns = -(-height // TILE_ROWS), -(-width // TILE_COLUMNS)
    slot = np.arange(rows * columns * TILE_ROWS * TILE_COLUMNS)
    tile, inside = np.divmod(slot, TILE_ROWS * TILE_COLUMNS)
    block, lane = np.divmod(inside, BLOCK_ROWS * BLOCK_COLUMNS)
    block_row, block_column = np.divmod(block, TILE_COLUMNS // BLOCK_COLUMNS)
    lane_row, lane_column = np.divmod(lane, BLOCK_COLUMNS)
    row = (tile // columns) * TILE_ROWS + block_row * BLOCK_ROWS + lane_row
    column = (tile % columns) * TILE_COLUMNS + block_column * BLOCK_COLUMNS + lane_column
    active = (row < height) & (column < width)
    row, column = np.minimum(row, height - 1), np.minimum(column, width - 1)
    elevation, azimuth = elevation_rad(height)[row], azimuth_rad(width)[column]
    direction = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    number = np.arange(rows * columns)
    result = Plane(
        height,
        width,
        tile=index_type(tile.astype(np.uint32)),
        pixel=index_type((row * width + column).astype(np.uint32)),
        active=mask_type(active),
        direction=[float_type(d) for d in direction],
        tile_row=float_type((number // columns * TILE_ROWS).astype(float)),
        tile_column=float_type((number % columns * TILE_COLUMNS).astype(float)),
    )
    dr.eval(result.tile, result.pixel, result.active, result.direction, result.tile_row, result.tile_column)
    return result


@dataclass
class TileLists:
    """For each (transmitter, tile) the Gaussians that may reach it, from near to far.

    Attributes:
        index: columns ``b * n + i`` of the Gaussians, [batch * tiles * n]; a list starts at ``n`` times its number.
        length: number of entries of each list, [batch * tiles].
    """

    index: dr.ArrayBase
    length: dr.ArrayBase


def _boxes(footprints: Footprints, height: int, width: int) -> tuple[dr.ArrayBase, ...]:
    """First and last row, first column and column span of each footprint, in (fractional) pixels.

    The box holds the spherical cap of the footprint's radius: half its azimuth span is
    asin(sin radius / cos elevation), and all azimuths once the cap holds the zenith. It may start below
    the horizon; the span wraps around the seam. A footprint that cannot be seen has an empty box.
    """
    x, y, z = (dr.detach(c) for c in footprints.direction)
    radius = footprints.radius
    elevation = dr.atan2(z, dr.sqrt(x * x + y * y))
    low, high = elevation - radius, elevation + radius
    ratio = dr.minimum(dr.sin(radius) * dr.rsqrt(dr.maximum(x * x + y * y, 1e-12)), 1)
    half = dr.select(high >= 0.5 * dr.pi, dr.pi, dr.asin(ratio))
    # A pixel of slack on each side covers rounding in these few lines.
    to_row, to_column = 2 * height / dr.pi, width / (2 * dr.pi)
    first_row = dr.select(footprints.visible, low * to_row - 1, height + TILE_ROWS)
    return first_row, high * to_row + 1, (dr.atan2(y, x) - half) * to_column - 1, 2 * half * to_column + 2


@dr.syntax
def build_lists(footprints: Footprints, order: dr.ArrayBase, plane: Plane, batch: int) -> TileLists:
    """List the Gaussians of each tile in depth order.

    Args:
        footprints: of ``batch * n`` columns.
        order: Gaussians from near to far, [n].
        plane: the perception plane.
        batch: number of transmitters.
    """
    index_type, float_type = type(order), type(footprints.radius)
    n, tiles = dr.width(order), plane.tiles
    boxes = _boxes(footprints, plane.height, plane.width)
    dr.eval(boxes, order)
    first_row, last_row, first_column, span = boxes
    slot = dr.arange(index_type, batch * tiles)
    tile, column0 = slot % tiles, (slot // tiles) * n
    row = dr.gather(float_type, plane.tile_row, tile)
    column = dr.gather(float_type, plane.tile_column, tile)
    width, start = float_type(plane.width), slot * n
    index = dr.empty(index_type, batch * tiles * n)
    length, k = dr.zeros(index_type, batch * tiles), index_type(0)
    while k < n:
        i = column0 + dr.gather(index_type, order, k)
        hit = (dr.gather(float_type, first_row, i) <= row + (TILE_ROWS - 1)) & (
            dr.gather(float_type, last_row, i) >= row
        )
        # Columns from the box's start to the tile's, going right around the circle.
        ahead = column - dr.gather(float_type, first_column, i)
        ahead -= width * dr.floor(ahead / width)
        hit &= (ahead <= dr.gather(float_type, span, i)) | (ahead + (TILE_COLUMNS - 1) >= width)
        dr.scatter(index, i, start + length, hit)
        length = dr.select(hit, length + 1, length)
        k += 1
    dr.eval(index, length)
    return TileLists(index, length)
