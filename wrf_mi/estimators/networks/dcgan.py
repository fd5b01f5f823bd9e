"""Convolutional adversarial network that makes spatial spectra from the transmitter's position.

Source: Radford, Metz and Chintala, "Unsupervised representation learning with deep convolutional generative
adversarial networks" (2016); condition: Mirza and Osindero, "Conditional generative adversarial nets" (2014). Chosen
here:

- The generator takes noise and the encoded position through one hidden layer to a coarse grid, then three transposed
  convolutions of stride two, ReLU between; the discriminator has three convolutions of stride two, leaky ReLU of slope
  0.2. Azimuths wrap around. A sigmoid makes greys in 0..1.
- Instance normalisation makes a prediction independent of the other positions of a batch. The discriminator judges
  patches. Both are of Isola et al., "Image-to-image translation with conditional adversarial networks" (2017, pix2pix).
- The mean absolute difference from the measured spectrum is pix2pix's second term, with its weight of 100, Adam's
  momentum of 0.5 and rate of 2e-4 for the adversary.
- Predictions take zero noise.

An image batch is a tensor [channels, batch * height * width], image by image, row by row. A convolution gathers each
pixel's neighbours (im2col) and is then one matrix product. Columns are azimuths and wrap; beyond the first and last row
there are zeros. A transposed convolution of stride two is a convolution of stride one to four times the channels, whose
four parts are the four positions of a finer pixel (Shi et al., "Is the deconvolution layer the same as a convolutional
layer?", 2016): `finer`. A convolution of stride two is the reverse: `coarser`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import drjit as dr
import numpy as np
from drjit import nn
from pydantic import Field

from ...backend.device import to_float, to_tensor
from ...core.settings import Count, Positive
from ...core.types import IntArray
from ...gaussians.parameters import logistic
from ...training.config import AdamConfig
from .layers import GAIN, Linear, Module, columns, feature_count, relu
from .spectrum_networks import NetworkRows, SpectrumNetwork
from .training import Network, NetworkSettings, network_adam, opaque_rows

NORM_FLOOR = 1e-5  # added to variances: an image may be flat
LEVELS = 3  # convolutions of stride two in either network
leaky = nn.LeakyReLU(0.2)  # activation of the discriminator (Radford et al.)
ADVERSARY_RATE = 2e-4  # learning rate of the discriminator (Radford et al.)
L1 = 100.0  # weight of the mean absolute difference against the adversarial term (Isola et al., pix2pix)
MOMENTUM = 0.5  # Adam's decay of the first moment (Radford et al.)


@dataclass(frozen=True)
class DcganSettings(NetworkSettings):
    """Settings of the adversarial network and of the training loop."""

    steps: int = 1875
    batch: int = 8
    validate_every: int = 188
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    FIXED: ClassVar[Mapping[str, float]] = {"adversary_rate": ADVERSARY_RATE, "l1": L1}
    noise: Count = 8  #: number of inputs that are drawn from -1 to 1
    hidden: Count = 64  #: neurons before the coarse grid
    #: channels of the coarse grid; halved at each finer grid
    channels: Annotated[int, Field(ge=2**LEVELS, description=f"{2**LEVELS} or more")] = 32
    octaves: int = 4  #: octaves of the position's encoding
    scale_m: Positive = 1.0  #: unit of encoded positions, metres (`wrf_mi.gaussians.network`)


@dataclass(frozen=True)
class BatchShape:
    """Number, height and width of the images of a batch."""

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

    def eval(self, x: Any, channels: int, grid: BatchShape, side: int) -> Any:
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


def patches(x: Any, grid: BatchShape, side: int) -> Any:
    """Neighbours of every pixel of images [channels, columns], [side * side * channels, columns].

    Taps row by row, the channels of each. Side 3: the pixel and its eight neighbours; 2: the pixel and its neighbours
    above and left.
    """
    channels = x.shape[0]
    flat = dr.custom(_Patches, x.array, channels, grid, side)
    return type(x)(flat, (side * side * channels, grid.columns))


class Convolution(Linear):
    """A convolution of stride one with a bias, [outputs, columns]; ``side`` as in `patches`."""

    def __init__(self, inputs: int, side: int, outputs: int, rng: np.random.Generator, gain: float = GAIN) -> None:
        super().__init__(inputs * side * side, outputs, rng, gain)
        self.side = side

    def __call__(self, x: Any, grid: BatchShape) -> Any:
        """Outputs of images [inputs, columns]."""
        return super().__call__(patches(x, grid, self.side))


class InstanceNorm(Module):
    """Each channel of each image scaled to mean 0 and variance 1, then by learned numbers.

    Source: Ulyanov, Vedaldi and Lempitsky, "Instance normalization" (2016).
    """

    def __init__(self, channels: int) -> None:
        self.scale: Any = np.ones((channels, 1), np.float32)
        self.bias: Any = np.zeros((channels, 1), np.float32)

    def __call__(self, x: Any, grid: BatchShape) -> Any:
        """Scaled images [channels, columns]."""
        channels = x.shape[0]
        images: Any = dr.reshape(x, (channels * grid.batch, grid.pixels))
        mean: Any = dr.reshape(dr.mean(images, axis=1), (channels * grid.batch, 1))
        centred = images - mean
        variance: Any = dr.reshape(dr.mean(centred * centred, axis=1), (channels * grid.batch, 1))
        scaled: Any = dr.reshape(centred * dr.rsqrt(variance + NORM_FLOOR), (channels, grid.columns))
        return scaled * self.scale + self.bias


def finer(x: Any, grid: BatchShape) -> tuple[Any, BatchShape]:
    """Four times the channels, [4 c, columns], laid out as twice the rows and columns, [c, 4 columns]."""
    fine = BatchShape(grid.batch, 2 * grid.height, 2 * grid.width)
    channels = x.shape[0] // 4
    image, row, column = fine.at(dr.arange(dr.uint32_array_t(type(x.array)), channels * fine.columns))
    part = 2 * (row % 2) + column % 2
    index = grid.index(part * (channels * grid.batch) + image, row // 2, column // 2)
    return type(x)(_permuted(x.array, index), (channels, fine.columns)), fine


def coarser(x: Any, grid: BatchShape) -> tuple[Any, BatchShape]:
    """The reverse of `finer`: each block of 2 x 2 pixels becomes a pixel of four times the channels."""
    coarse = BatchShape(grid.batch, grid.height // 2, grid.width // 2)
    channels = x.shape[0]
    image, row, column = coarse.at(dr.arange(dr.uint32_array_t(type(x.array)), 4 * channels * coarse.columns))
    part = image // (channels * grid.batch)
    index = grid.index(image - part * (channels * grid.batch), 2 * row + part // 2, 2 * column + part % 2)
    return type(x)(_permuted(x.array, index), (4 * channels, coarse.columns)), coarse


def resized(x: Any, grid: BatchShape, height: int, width: int) -> tuple[Any, BatchShape]:
    """Rows and columns cut off at the end, or filled up with zeros."""
    new = BatchShape(grid.batch, height, width)
    image, row, column = new.at(dr.arange(dr.uint32_array_t(type(x.array)), x.shape[0] * new.columns))
    inside = (row < grid.height) & (column < grid.width)
    return type(x)(_permuted(x.array, grid.index(image, row, column), inside), (x.shape[0], new.columns)), new


def _permuted(x: Any, index: Any, active: Any = True) -> Any:
    """A gather that takes no element twice, so that its reverse adds without atomics."""
    # `ReduceMode.Permute` would overwrite the gradient of another use of the same array.
    return dr.gather(type(x), x, index, active, mode=dr.ReduceMode.NoConflicts)


def coarse_grid(shape: tuple[int, int], batch: int) -> BatchShape:
    """Coarsest grid of both networks: an eighth of a spectrum's sides, rounded up."""
    return BatchShape(batch, -(-shape[0] // 2**LEVELS), -(-shape[1] // 2**LEVELS))


class Generator(Module):
    """Spectra [1, batch * height * width] in 0..1 from noise [k, batch] and features of positions [f, batch]."""

    def __init__(self, s: DcganSettings, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self.shape, self.noise, self.channels = shape, s.noise, s.channels
        self.in_ = Linear({"noise": s.noise, "position": feature_count(s.octaves)}, s.hidden, rng)
        self.grid = Linear(s.hidden, s.channels * coarse_grid(shape, 1).pixels, rng)
        channels = [s.channels // 2**level for level in range(LEVELS)]
        self.norm = [InstanceNorm(inputs) for inputs in channels]
        outputs, gains = [*channels[1:], 1], [GAIN] * (LEVELS - 1) + [1.0]
        pairs = zip(channels, outputs, gains, strict=True)
        self.layers = [Convolution(inputs, 3, 4 * count, rng, gain) for inputs, count, gain in pairs]

    def __call__(self, noise: Any, where: Any) -> Any:
        """Spectra of noise and positions."""
        batch = where.shape[1]
        grid = coarse_grid(self.shape, batch)
        x = self.grid(relu(self.in_(noise=noise, position=where)))
        # [channels, pixels, batch] to image by image.
        x = dr.moveaxis(dr.reshape(x, (self.channels, grid.pixels, batch)), 1, 2)
        x = dr.reshape(x, (self.channels, grid.columns))
        for norm, layer in zip(self.norm, self.layers, strict=True):
            x, grid = finer(layer(relu(norm(x, grid)), grid), grid)
        return logistic(resized(x, grid, *self.shape)[0])

    def spectra(self, where: Any) -> Any:
        """Spectra without noise, a flat array, from features of positions [features, m]."""
        return self(dr.zeros(type(where), (self.noise, where.shape[1])), where).array


class Discriminator(Module):
    """Logits [1, columns] of patches of spectra to be measured, and not generated, at given positions."""

    def __init__(self, s: DcganSettings, rng: np.random.Generator) -> None:
        channels = [s.channels // 2 ** (LEVELS - 1) * 2**level for level in range(LEVELS)]
        self.position: Any = Linear({"p": feature_count(s.octaves)}, channels[0], rng).p
        pairs = zip([1, *channels], channels, strict=False)
        self.layers = [Convolution(4 * inputs, 2, outputs, rng) for inputs, outputs in pairs]
        self.norm = [None, *(InstanceNorm(outputs) for outputs in channels[1:])]
        self.out = Convolution(channels[-1], 3, 1, rng, 1.0)

    def __call__(self, spectra: Any, where: Any, shape: tuple[int, int]) -> Any:
        """Logits of spectra [1, batch * height * width] at features of positions [features, batch]."""
        batch = where.shape[1]
        coarse = coarse_grid(shape, batch)
        x, grid = resized(spectra, BatchShape(batch, *shape), coarse.height * 2**LEVELS, coarse.width * 2**LEVELS)
        for norm, layer in zip(self.norm, self.layers, strict=True):
            x, grid = coarser(x, grid)
            x = layer(x, grid)
            if norm is None:
                # The position as constant channels of the first layer: a bias for each image.
                bias: Any = dr.reshape(self.position @ where, (x.shape[0], batch, 1))
                x = dr.reshape(dr.reshape(x, (x.shape[0], batch, grid.pixels)) + bias, (x.shape[0], grid.columns))
            else:
                x = norm(x, grid)
            x = leaky(x)
        return self.out(x, grid)


class Dcgan(Module):
    """Generator ``g`` and discriminator ``d``."""

    def __init__(self, s: DcganSettings, shape: tuple[int, int], rng: np.random.Generator) -> None:
        self.g, self.d = Generator(s, shape, rng), Discriminator(s, rng)


def softplus(x: Any) -> Any:
    """log(1 + exp(x)), without overflow."""
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))


def duel_loss(dcgan: Dcgan, data: Any, drawn: Any) -> Any:
    """Sum of the losses of generator and discriminator, each with gradients of its own weights alone.

    ``data`` has ``truth``, spectra one after the other, and ``where`` [features, n]; ``drawn`` has ``rows`` [batch] and
    ``noise`` [k, batch] of the step.
    """
    chosen, flat, shape = drawn["rows"], data["truth"], dcgan.g.shape
    pixels = shape[0] * shape[1]
    slot = dr.arange(type(chosen), dr.width(chosen) * pixels)
    index = dr.gather(type(chosen), chosen, slot // pixels) * pixels + slot % pixels
    real = type(data["where"])(dr.gather(type(flat), flat, index), (1, dr.width(slot)))
    where = columns(data["where"], chosen)
    fake = dcgan.g(drawn["noise"], where)
    # -log D(real) - log (1 - D(fake)) by logits; detached, as the generator must not learn from it.
    right = dr.mean(softplus(-dcgan.d(real, where, shape)), axis=None)
    right += dr.mean(softplus(dcgan.d(dr.detach(fake), where, shape)), axis=None)
    # -log D(fake) in place of log (1 - D(fake)), which is flat where the discriminator wins (Goodfellow et al., 2014).
    fixed = dcgan.d.with_state({path: dr.detach(weight) for path, weight in dcgan.d.state().items()})
    fooled = dr.mean(softplus(-fixed(fake, where, shape)), axis=None)
    return (right + fooled + L1 * dr.mean(dr.abs(fake - real), axis=None)).array


class DcganModel(SpectrumNetwork):
    """A generator and a discriminator for each receiver."""

    name, settings, summary = "dcgan", DcganSettings, "generative adversarial network"
    source = (
        "Radford, Metz and Chintala (2016), conditioned as by Mirza and Osindero (2014), "
        "with pix2pix's second term (2017)"
    )
    generator_class, generator, at_once = Generator, "g", 16

    def network(self, rows: NetworkRows, settings: DcganSettings, rng: np.random.Generator) -> Network:
        """Generator and discriminator of a receiver, to be trained together."""
        data = {"where": rows.where, "truth": to_float(rows.spectra)}
        dr.make_opaque(data)
        dcgan = Dcgan(settings, rows.spectra.shape[1:], rng)
        # The generator starts near the mean grey of the rows that it may learn from.
        grey = float(np.clip(rows.spectra[: rows.train].mean(dtype=np.float64), 0.01, 0.99))
        dcgan.g.layers[-1].bias += np.float32(np.log(grey / (1 - grey)))

        def draw(chosen: IntArray, receiver: int, rng: np.random.Generator) -> Any:
            return {"rows": opaque_rows(chosen), "noise": to_tensor(rng.uniform(-1, 1, (settings.noise, len(chosen))))}

        both = self.trained_on(rows, dcgan, duel_loss, data, draw)
        rates = dict.fromkeys((f"d.{path}" for path in dcgan.d.state()), ADVERSARY_RATE)
        return replace(both, rates=rates, momentum=MOMENTUM)


MODEL = DcganModel()
