"""Convolutional adversarial network that makes spatial spectra from the transmitter's position.

Source: Radford, Metz and Chintala, "Unsupervised representation learning with deep convolutional generative
adversarial networks" (2016); condition: Mirza and Osindero, "Conditional generative adversarial nets" (2014). Chosen
here:

- The generator takes noise and the encoded position through one hidden layer to a coarse grid, then three transposed
  convolutions of stride two, ReLU between; the discriminator has three convolutions of stride two, leaky ReLU of slope
  0.2. Azimuths wrap around (`wrf_mi.models.networks.conv`). A sigmoid makes greys in 0..1.
- Instance normalisation makes a prediction independent of the other positions of a batch. The discriminator judges
  patches. Both are of Isola et al., "Image-to-image translation with conditional adversarial networks" (2017, pix2pix).
- The mean absolute difference from the measured spectrum is pix2pix's second term, with its weight of 100, Adam's
  momentum of 0.5 and rate of 2e-4 for the adversary.
- Predictions take zero noise.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import drjit as dr
import numpy as np
from drjit import nn
from pydantic import Field

from ...backend.device import to_float, to_tensor
from ...core.settings import Count, Positive
from ...core.types import IntArray
from ...training.loop_config import AdamConfig
from .conv import Convolution, Grid, InstanceNorm, coarser, finer, resized
from .layers import GAIN, Linear, Module, columns, feature_count, relu, sigmoid
from .spectrum_networks import ReceiverRows, SpectrumNetwork
from .training import Network, NetworkSettings, network_adam, opaque_rows

LEVELS = 3
"""Convolutions of stride two in either network."""
leaky = nn.LeakyReLU(0.2)
"""Activation of the discriminator (Radford et al.)."""
MOMENTUM = 0.5
"""Adam's decay of the first moment (Radford et al.)."""


@dataclass(frozen=True)
class DcganSettings(NetworkSettings):
    """Settings of the adversarial network and of the training loop.

    Attributes:
        adversary_rate: learning rate of the discriminator.
        noise: number of inputs that are drawn from -1 to 1.
        hidden: neurons before the coarse grid.
        channels: channels of the coarse grid; halved at each finer grid.
        octaves: octaves of the position's encoding.
        scale_m: unit of encoded positions, metres (`wrf_mi.gaussians.encoding`).
        l1: weight of the mean absolute difference against the adversarial term.
    """

    steps: int = 1875
    batch: int = 8
    validate_every: int = 188
    optimiser: AdamConfig = field(default_factory=lambda: network_adam(2e-3))
    adversary_rate: Positive = 2e-4
    noise: Count = 8
    hidden: Count = 64
    channels: Annotated[int, Field(ge=2**LEVELS, description=f"{2**LEVELS} or more")] = 32
    octaves: int = 4
    scale_m: Positive = 1.0
    l1: float = 100.0


def coarse_grid(shape: tuple[int, int], batch: int) -> Grid:
    """Coarsest grid of both networks: an eighth of a spectrum's sides, rounded up."""
    return Grid(batch, -(-shape[0] // 2**LEVELS), -(-shape[1] // 2**LEVELS))


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
        return sigmoid(resized(x, grid, *self.shape)[0])

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
        x, grid = resized(spectra, Grid(batch, *shape), coarse.height * 2**LEVELS, coarse.width * 2**LEVELS)
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


def duel_loss(dcgan: Dcgan, data: Any, given: Any, s: DcganSettings) -> Any:
    """Sum of the losses of generator and discriminator, each with gradients of its own weights alone.

    Args:
        dcgan: both networks.
        data: ``truth``, spectra one after the other, and ``where`` [features, n].
        given: ``rows`` [batch] and ``noise`` [k, batch] of the step.
        s: settings.
    """
    chosen, flat, shape = given["rows"], data["truth"], dcgan.g.shape
    pixels = shape[0] * shape[1]
    slot = dr.arange(type(chosen), dr.width(chosen) * pixels)
    index = dr.gather(type(chosen), chosen, slot // pixels) * pixels + slot % pixels
    real = type(data["where"])(dr.gather(type(flat), flat, index), (1, dr.width(slot)))
    where = columns(data["where"], chosen)
    fake = dcgan.g(given["noise"], where)
    right = dr.mean(softplus(-dcgan.d(real, where, shape)), axis=None)
    right += dr.mean(softplus(dcgan.d(dr.detach(fake), where, shape)), axis=None)
    fixed = dcgan.d.with_state({path: dr.detach(weight) for path, weight in dcgan.d.state().items()})
    fooled = dr.mean(softplus(-fixed(fake, where, shape)), axis=None)
    return (right + fooled + s.l1 * dr.mean(dr.abs(fake - real), axis=None)).array


def network(rows: ReceiverRows, s: DcganSettings, rng: np.random.Generator) -> Network:
    """Generator and discriminator of a receiver, to be trained together."""
    data = {"where": rows.where, "truth": to_float(rows.spectra)}
    dr.make_opaque(data)
    dcgan = Dcgan(s, rows.spectra.shape[1:], rng)
    # The generator starts near the mean grey of the rows that it may learn from.
    grey = float(np.clip(rows.spectra[: rows.train].mean(dtype=np.float64), 0.01, 0.99))
    dcgan.g.layers[-1].bias += np.float32(np.log(grey / (1 - grey)))

    def draw(chosen: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return {"rows": opaque_rows(chosen), "noise": to_tensor(rng.uniform(-1, 1, (s.noise, len(chosen))))}

    both = rows.network(KIND, dcgan, lambda dcgan, data, given: duel_loss(dcgan, data, given, s), data, draw)
    rates = dict.fromkeys((f"d.{path}" for path in dcgan.d.state()), s.adversary_rate)
    return replace(both, rates=rates, momentum=MOMENTUM)


KIND = SpectrumNetwork(
    "dcgan",
    DcganSettings,
    network,
    Generator,
    "g",
    16,
    "Radford, Metz and Chintala (2016), conditioned as by Mirza and Osindero (2014), with pix2pix's second term (2017)",
)
MODEL = KIND.model()
