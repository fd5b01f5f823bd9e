"""Convolutions over images whose columns wrap around, on Dr.Jit tensors.

An image batch is a tensor [channels, batch * height * width], image by image, row by row: columns are samples, as in
`wrf_mi.gaussians.network`. A convolution gathers each pixel's neighbours (im2col) and is then one matrix product.
Columns are azimuths and wrap; beyond the first and last row there are zeros.

A transposed convolution of stride two is a convolution of stride one to four times the channels, whose four parts are
the four positions of a finer pixel (Shi et al., "Is the deconvolution layer the same as a convolutional layer?", 2016);
a convolution of stride two is the reverse. That is how `finer` and `coarser` serve here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr


@dataclass(frozen=True)
class Grid:
    """Sizes of an image batch.

    Attributes:
        batch: images.
        height: rows.
        width: columns.
    """

    batch: int
    height: int
    width: int

    @property
    def pixels(self) -> int:
        """Of one image."""
        return self.height * self.width

    @property
    def columns(self) -> int:
        """Of the batch's tensor."""
        return self.batch * self.pixels


class _Patches(dr.CustomOp):
    """Neighbours of every pixel; the reverse pass gathers too, so that no sum is atomic."""

    def eval(self, x: Any, channels: int, grid: Grid, side: int) -> Any:
        self.sizes = channels, grid, side
        uint = dr.uint32_array_t(type(x))
        per_tap = channels * grid.columns
        slot = dr.arange(uint, side * side * per_tap)
        tap = slot // per_tap
        inside = slot - tap * per_tap
        down, right = tap // side, tap % side
        line = inside // grid.width
        column = inside - line * grid.width
        image = line // grid.height
        row = line - image * grid.height + down
        # The first tap looks one row up and one column left, modulo the width.
        column = column + right + (grid.width - 1)
        column = dr.select(column >= grid.width, column - grid.width, column)
        column = dr.select(column >= grid.width, column - grid.width, column)
        seen = (row >= 1) & (row <= grid.height)
        return dr.gather(type(x), x, (image * grid.height + row - 1) * grid.width + column, seen)

    def _adjoint(self, g: Any) -> Any:
        channels, grid, side = self.sizes
        uint = dr.uint32_array_t(type(g))
        per_tap = channels * grid.columns
        slot = dr.arange(uint, per_tap)
        line = slot // grid.width
        column = slot - line * grid.width
        image = line // grid.height
        row = line - image * grid.height
        total: Any = 0
        for down in range(side):
            for right in range(side):
                # Pixel p was tap (down, right) of the pixel one row down and one column right of p - tap.
                above = row + 1 - down
                seen = (row + 1 >= down) & (above < grid.height)
                beside = column + (grid.width + 1 - right)
                beside = dr.select(beside >= grid.width, beside - grid.width, beside)
                beside = dr.select(beside >= grid.width, beside - grid.width, beside)
                index = (down * side + right) * per_tap + (image * grid.height + above) * grid.width + beside
                total = total + dr.gather(type(g), g, index, seen)
        return total

    def forward(self) -> None:
        channels, grid, side = self.sizes
        self.set_grad_out(_Patches.eval(self, self.grad_in("x"), channels, grid, side))

    def backward(self) -> None:
        self.set_grad_in("x", self._adjoint(self.grad_out()))

    def name(self) -> str:
        return "patches"


def patches(x: Any, grid: Grid, side: int) -> Any:
    """Neighbours of every pixel, [side * side * channels, columns]: taps row by row, the channels of each.

    Args:
        x: images [channels, columns].
        grid: their sizes.
        side: 3: the pixel and its eight neighbours; 2: the pixel, its neighbours above and left.
    """
    channels = x.shape[0]
    flat = dr.custom(_Patches, x.array, channels, grid, side)
    return type(x)(flat, (side * side * channels, grid.columns))


def convolve(params: Mapping[str, Any], name: str, x: Any, grid: Grid, side: int = 3) -> Any:
    """A convolution of stride one with a bias, [outputs, columns]; its matrix is ``name.hidden``."""
    return params[f"{name}.hidden"] @ patches(x, grid, side) + params[f"{name}.bias"]


def finer(x: Any, grid: Grid) -> tuple[Any, Grid]:
    """Four times the channels, [4 c, columns], laid out as twice the rows and columns, [c, 4 columns]."""
    fine = Grid(grid.batch, 2 * grid.height, 2 * grid.width)
    channels = x.shape[0] // 4
    slot = dr.arange(dr.uint32_array_t(type(x.array)), channels * fine.columns)
    line = slot // fine.width
    column = slot - line * fine.width
    image = line // fine.height
    row = line - image * fine.height
    part = 2 * (row % 2) + column % 2
    index = (part * (channels * grid.batch) + image) * grid.pixels + (row // 2) * grid.width + column // 2
    return type(x)(_permuted(x.array, index), (channels, fine.columns)), fine


def coarser(x: Any, grid: Grid) -> tuple[Any, Grid]:
    """The reverse of `finer`: each block of 2 x 2 pixels becomes one of four times the channels."""
    coarse = Grid(grid.batch, grid.height // 2, grid.width // 2)
    channels = x.shape[0]
    slot = dr.arange(dr.uint32_array_t(type(x.array)), 4 * channels * coarse.columns)
    line = slot // coarse.width
    column = slot - line * coarse.width
    image = line // coarse.height
    row = line - image * coarse.height
    part = image // (channels * grid.batch)
    image = image - part * (channels * grid.batch)
    index = image * grid.pixels + (2 * row + part // 2) * grid.width + 2 * column + part % 2
    return type(x)(_permuted(x.array, index), (4 * channels, coarse.columns)), coarse


def resized(x: Any, grid: Grid, height: int, width: int) -> tuple[Any, Grid]:
    """Rows and columns cut off at the end, or filled up with zeros."""
    new = Grid(grid.batch, height, width)
    slot = dr.arange(dr.uint32_array_t(type(x.array)), x.shape[0] * new.columns)
    line = slot // width
    column = slot - line * width
    image = line // height
    row = line - image * height
    seen = (row < grid.height) & (column < grid.width)
    index = (image * grid.height + row) * grid.width + column
    return type(x)(_permuted(x.array, index, seen), (x.shape[0], new.columns)), new


def _permuted(x: Any, index: Any, active: Any = True) -> Any:
    """A gather that takes no element twice, whose reverse adds without atomics.

    (`ReduceMode.Permute` would overwrite what another use of the same array sends back.)
    """
    return dr.gather(type(x), x, index, active, mode=dr.ReduceMode.NoConflicts)


def instance_norm(params: Mapping[str, Any], name: str, x: Any, grid: Grid) -> Any:
    """Each channel of each image scaled to mean 0 and variance 1, then by learned numbers.

    Source: Ulyanov, Vedaldi and Lempitsky, "Instance normalization" (2016).
    """
    channels = x.shape[0]
    images: Any = dr.reshape(x, (channels * grid.batch, grid.pixels))
    mean: Any = dr.reshape(dr.mean(images, axis=1), (channels * grid.batch, 1))
    centred = images - mean
    variance: Any = dr.reshape(dr.mean(centred * centred, axis=1), (channels * grid.batch, 1))
    scaled: Any = dr.reshape(centred * dr.rsqrt(variance + NORM_FLOOR), (channels, grid.columns))
    return scaled * params[f"{name}.scale"] + params[f"{name}.bias"]


NORM_FLOOR = 1e-5
"""Added to variances: an image may be flat."""
