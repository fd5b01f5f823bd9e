"""Convolutions over images whose columns wrap around, on Dr.Jit tensors.

An image batch is a tensor [channels, batch * height * width], image by image, row by row. A convolution gathers each
pixel's neighbours (im2col) and is then one matrix product. Columns are azimuths and wrap; beyond the first and last row
there are zeros.

A transposed convolution of stride two is a convolution of stride one to four times the channels, whose four parts are
the four positions of a finer pixel (Shi et al., "Is the deconvolution layer the same as a convolutional layer?", 2016):
`finer`. A convolution of stride two is the reverse: `coarser`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from .layers import GAIN, Linear, Module

NORM_FLOOR = 1e-5
"""Added to variances: an image may be flat."""


@dataclass(frozen=True)
class Grid:
    """Sizes of an image batch.

    Attributes:
        batch: number of images.
        height: rows of an image.
        width: columns of an image.
    """

    batch: int
    height: int
    width: int

    @property
    def pixels(self) -> int:
        """Pixels of one image."""
        return self.height * self.width

    @property
    def columns(self) -> int:
        """Columns of the batch's tensor."""
        return self.batch * self.pixels

    def at(self, slot: Any) -> tuple[Any, Any, Any]:
        """Number of the image (counting channels), row and column of flat indices."""
        line = slot // self.width
        image = line // self.height
        return image, line - image * self.height, slot - line * self.width

    def index(self, image: Any, row: Any, column: Any) -> Any:
        """Flat index: the inverse of `at`."""
        return (image * self.height + row) * self.width + column

    def wrapped(self, column: Any) -> Any:
        """A column below twice the width, modulo the width."""
        return dr.select(column >= self.width, column - self.width, column)


class _Patches(dr.CustomOp):
    """Neighbours of every pixel; the reverse pass gathers too, so that no sum is atomic."""

    def eval(self, x: Any, channels: int, grid: Grid, side: int) -> Any:
        self.sizes = channels, grid, side
        per_tap = channels * grid.columns
        slot = dr.arange(dr.uint32_array_t(type(x)), side * side * per_tap)
        tap = slot // per_tap
        image, row, column = grid.at(slot - tap * per_tap)
        # The first tap looks one row up and one column left.
        row = row + tap // side
        column = grid.wrapped(grid.wrapped(column + tap % side + (grid.width - 1)))
        return dr.gather(type(x), x, grid.index(image, row - 1, column), (row >= 1) & (row <= grid.height))

    def backward(self) -> None:
        channels, grid, side = self.sizes
        g: Any = self.grad_out()
        per_tap = channels * grid.columns
        image, row, column = grid.at(dr.arange(dr.uint32_array_t(type(g)), per_tap))
        total: Any = 0
        for down in range(side):
            for right in range(side):
                # Pixel p was tap (down, right) of the pixel one row down and one column right of p - tap.
                above = row + 1 - down
                inside = (row + 1 >= down) & (above < grid.height)
                beside = grid.wrapped(grid.wrapped(column + (grid.width + 1 - right)))
                index = (down * side + right) * per_tap + grid.index(image, above, beside)
                total = total + dr.gather(type(g), g, index, inside)
        self.set_grad_in("x", total)

    def name(self) -> str:
        return "patches"


def patches(x: Any, grid: Grid, side: int) -> Any:
    """Neighbours of every pixel, [side * side * channels, columns]: taps row by row, the channels of each.

    Args:
        x: images [channels, columns].
        grid: sizes of the images.
        side: 3: the pixel and its eight neighbours; 2: the pixel, its neighbours above and left.
    """
    channels = x.shape[0]
    flat = dr.custom(_Patches, x.array, channels, grid, side)
    return type(x)(flat, (side * side * channels, grid.columns))


class Convolution(Linear):
    """A convolution of stride one with a bias, [outputs, columns]; ``side`` as in `patches`."""

    def __init__(self, inputs: int, side: int, outputs: int, rng: np.random.Generator, gain: float = GAIN) -> None:
        super().__init__(inputs * side * side, outputs, rng, gain)
        self.side = side

    def __call__(self, x: Any, grid: Grid) -> Any:
        """Outputs of images [inputs, columns]."""
        return super().__call__(patches(x, grid, self.side))


class InstanceNorm(Module):
    """Each channel of each image scaled to mean 0 and variance 1, then by learned numbers.

    Source: Ulyanov, Vedaldi and Lempitsky, "Instance normalization" (2016).
    """

    def __init__(self, channels: int) -> None:
        self.scale: Any = np.ones((channels, 1), np.float32)
        self.bias: Any = np.zeros((channels, 1), np.float32)

    def __call__(self, x: Any, grid: Grid) -> Any:
        """Scaled images [channels, columns]."""
        channels = x.shape[0]
        images: Any = dr.reshape(x, (channels * grid.batch, grid.pixels))
        mean: Any = dr.reshape(dr.mean(images, axis=1), (channels * grid.batch, 1))
        centred = images - mean
        variance: Any = dr.reshape(dr.mean(centred * centred, axis=1), (channels * grid.batch, 1))
        scaled: Any = dr.reshape(centred * dr.rsqrt(variance + NORM_FLOOR), (channels, grid.columns))
        return scaled * self.scale + self.bias


def finer(x: Any, grid: Grid) -> tuple[Any, Grid]:
    """Four times the channels, [4 c, columns], laid out as twice the rows and columns, [c, 4 columns]."""
    fine = Grid(grid.batch, 2 * grid.height, 2 * grid.width)
    channels = x.shape[0] // 4
    image, row, column = fine.at(dr.arange(dr.uint32_array_t(type(x.array)), channels * fine.columns))
    part = 2 * (row % 2) + column % 2
    index = grid.index(part * (channels * grid.batch) + image, row // 2, column // 2)
    return type(x)(_permuted(x.array, index), (channels, fine.columns)), fine


def coarser(x: Any, grid: Grid) -> tuple[Any, Grid]:
    """The reverse of `finer`: each block of 2 x 2 pixels becomes a pixel of four times the channels."""
    coarse = Grid(grid.batch, grid.height // 2, grid.width // 2)
    channels = x.shape[0]
    image, row, column = coarse.at(dr.arange(dr.uint32_array_t(type(x.array)), 4 * channels * coarse.columns))
    part = image // (channels * grid.batch)
    index = grid.index(image - part * (channels * grid.batch), 2 * row + part // 2, 2 * column + part % 2)
    return type(x)(_permuted(x.array, index), (4 * channels, coarse.columns)), coarse


def resized(x: Any, grid: Grid, height: int, width: int) -> tuple[Any, Grid]:
    """Rows and columns cut off at the end, or filled up with zeros."""
    new = Grid(grid.batch, height, width)
    image, row, column = new.at(dr.arange(dr.uint32_array_t(type(x.array)), x.shape[0] * new.columns))
    inside = (row < grid.height) & (column < grid.width)
    return type(x)(_permuted(x.array, grid.index(image, row, column), inside), (x.shape[0], new.columns)), new


def _permuted(x: Any, index: Any, active: Any = True) -> Any:
    """A gather that takes no element twice, so that its reverse adds without atomics."""
    # `ReduceMode.Permute` would overwrite the gradient of another use of the same array.
    return dr.gather(type(x), x, index, active, mode=dr.ReduceMode.NoConflicts)
