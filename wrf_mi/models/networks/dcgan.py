"""Convolutional adversarial network that makes spatial spectra from the transmitter's position.

Source: Radford, Metz and Chintala, "Unsupervised representation learning with deep convolutional generative
adversarial networks" (2016), which the WRF-GS papers name; the condition is Mirza and Osindero's ("Conditional
generative adversarial nets", 2014). NeRF2, whose figures the papers compare with, says no more than that a DCGAN
predicts spectra from positions, and has not released it. Chosen here:

- The generator takes noise and the encoded position through one hidden layer to a coarse grid, then three transposed
  convolutions of stride two, ReLU between; the discriminator three convolutions of stride two, leaky ReLU of slope
  0.2. Azimuths wrap around (`wrf_mi.models.networks.conv`).
- A sigmoid in place of tanh: greys lie in 0..1.
- Instance instead of batch normalisation, as of batches of one: what is predicted for one position must not depend on
  the others. The discriminator judges patches. Both are of Isola et al., "Image-to-image translation with conditional
  adversarial networks" (2017, pix2pix).
- An adversary alone asks only for plausible spectra. That the one of this position is wanted comes from pix2pix's
  second term, the mean absolute difference, with its weight of 100, Adam's momentum of 0.5 and rate of 2e-4 for the
  adversary.
- Predictions take no noise, the middle of what was drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import drjit as dr
import numpy as np
from pydantic import Field

from ...backend.device import to_float, to_tensor
from ...core.settings import Count, Positive
from ...core.types import IntArray
from ...gaussians.network import Weights, init_layer, linear, relu
from ...training.loop_config import AdamConfig
from .conv import Grid, coarser, convolve, finer, instance_norm, resized
from .coordinates import feature_count
from .spectrum_networks import ReceiverRows, SpectrumNetwork
from .tensors import columns
from .training import Network, NetworkSettings, network_adam, opaque_rows

LEVELS = 3
"""Convolutions of stride two in either network."""
SLOPE = 0.2
"""Of the leaky ReLU below zero (Radford et al.)."""
MOMENTUM = 0.5
"""Adam's decay of the first moment (Radford et al.)."""
CHUNK_SIZE = 16
"""Spectra that are predicted together: bounds the memory."""


@dataclass(frozen=True)
class DcganSettings(NetworkSettings):
    """Settings of the adversarial network, beside those of the loop.

    Attributes:
        adversary_rate: the discriminator's learning rate.
        noise: numbers drawn from -1 to 1.
        hidden: neurons before the coarse grid.
        channels: of the coarse grid; halved at each finer one.
        octaves: of the position's encoding.
        scale_m: metres that make its unit (`wrf_mi.gaussians.encoding`).
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
    """Where the generator begins: an eighth of a spectrum's sides, rounded up."""
    return Grid(batch, -(-shape[0] // 2**LEVELS), -(-shape[1] // 2**LEVELS))


def _layer(name: str, inputs: int, side: int, outputs: int, rng: np.random.Generator, gain: float) -> Weights:
    return init_layer(name, {"hidden": inputs * side * side}, outputs, rng, gain)


def generator_weights(s: DcganSettings, shape: tuple[int, int], rng: np.random.Generator) -> Weights:
    """Random weights of the generator."""
    grid, where = coarse_grid(shape, 1), feature_count(s.octaves)
    weights = init_layer("g.in", {"noise": s.noise, "position": where}, s.hidden, rng)
    weights |= init_layer("g.grid", {"hidden": s.hidden}, s.channels * grid.pixels, rng)
    channels = s.channels
    for level in range(LEVELS):
        last = level == LEVELS - 1
        outputs = 1 if last else channels // 2
        weights |= _norm(f"g.norm{level}", channels)
        weights |= _layer(f"g.{level}", channels, 3, 4 * outputs, rng, 1.0 if last else float(np.sqrt(2)))
        channels = outputs
    return weights


def adversary_weights(s: DcganSettings, rng: np.random.Generator) -> Weights:
    """Random weights of the discriminator."""
    where, gain = feature_count(s.octaves), float(np.sqrt(2))
    first = s.channels // 2 ** (LEVELS - 1)
    weights, channels = {"d.position": init_layer("x", {"p": where}, first, rng)["x.p"]}, 1
    for level in range(LEVELS):
        outputs = first * 2**level
        weights |= _layer(f"d.{level}", 4 * channels, 2, outputs, rng, gain)
        if level:
            weights |= _norm(f"d.norm{level}", outputs)
        channels = outputs
    return weights | _layer("d.out", channels, 3, 1, rng, 1.0)


def _norm(name: str, channels: int) -> Weights:
    return {f"{name}.scale": np.ones((channels, 1), np.float32), f"{name}.bias": np.zeros((channels, 1), np.float32)}


def generate(params: Mapping[str, Any], noise: Any, where: Any, shape: tuple[int, int], channels: int) -> Any:
    """Spectra [1, batch * height * width] in 0..1, from noise [k, batch] and positions' features [f, batch]."""
    batch = where.shape[1]
    grid = coarse_grid(shape, batch)
    hidden = relu(linear(params, "g.in", noise, "noise") + params["g.in.position"] @ where)
    x = linear(params, "g.grid", hidden)
    # [channels, pixels, batch] to image by image.
    x = dr.moveaxis(dr.reshape(x, (channels, grid.pixels, batch)), 1, 2)
    x = dr.reshape(x, (channels, grid.columns))
    for level in range(LEVELS):
        x = relu(instance_norm(params, f"g.norm{level}", x, grid))
        x, grid = finer(convolve(params, f"g.{level}", x, grid), grid)
    x, _ = resized(x, grid, *shape)
    return dr.rcp(1 + dr.exp(-x))


def judge(params: Mapping[str, Any], spectra: Any, where: Any, shape: tuple[int, int]) -> Any:
    """How real each patch of spectra [1, batch * height * width] at positions' features looks: logits [1, columns]."""
    batch = where.shape[1]
    coarse = coarse_grid(shape, batch)
    x, grid = resized(spectra, Grid(batch, *shape), coarse.height * 2**LEVELS, coarse.width * 2**LEVELS)
    for level in range(LEVELS):
        x, grid = coarser(x, grid)
        x = convolve(params, f"d.{level}", x, grid, 2)
        if level:
            x = instance_norm(params, f"d.norm{level}", x, grid)
        else:
            # The position as constant channels of the first layer: a bias for each image.
            own: Any = dr.reshape(params["d.position"] @ where, (x.shape[0], batch, 1))
            x = dr.reshape(dr.reshape(x, (x.shape[0], batch, grid.pixels)) + own, (x.shape[0], grid.columns))
        x = dr.maximum(x, SLOPE * x)
    return convolve(params, "d.out", x, grid)


def softplus(x: Any) -> Any:
    """log(1 + exp(x)), without overflow."""
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))


def generate_silent(params: Mapping[str, Any], s: DcganSettings, where: Any, shape: tuple[int, int]) -> Any:
    """Spectra without noise, a flat array."""
    return generate(params, dr.zeros(type(where), (s.noise, where.shape[1])), where, shape, s.channels).array


def duel_loss(params: Mapping[str, Any], data: Any, given: Any, s: DcganSettings, shape: tuple[int, int]) -> Any:
    """Loss of generator (``g``) plus that of discriminator (``d``), each of which differentiates its own alone.

    Args:
        params: weights of both.
        data: ``truth``, spectra one after the other, and ``where`` [features, n].
        given: ``rows`` [batch] and ``noise`` [k, batch] of the step.
        s: settings.
        shape: height and width of a spectrum.
    """
    chosen, flat, pixels = given["rows"], data["truth"], shape[0] * shape[1]
    slot = dr.arange(type(chosen), dr.width(chosen) * pixels)
    index = dr.gather(type(chosen), chosen, slot // pixels) * pixels + slot % pixels
    real = type(data["where"])(dr.gather(type(flat), flat, index), (1, dr.width(slot)))
    where = columns(data["where"], chosen)
    fake = generate(params, given["noise"], where, shape, s.channels)
    right = dr.mean(softplus(-judge(params, real, where, shape)), axis=None)
    right += dr.mean(softplus(judge(params, dr.detach(fake), where, shape)), axis=None)
    held = {name: dr.detach(values) for name, values in params.items()}
    fooled = dr.mean(softplus(-judge(held, fake, where, shape)), axis=None)
    return (right + fooled + s.l1 * dr.mean(dr.abs(fake - real), axis=None)).array


def network(own: ReceiverRows, s: DcganSettings, rng: np.random.Generator) -> Network:
    """A receiver's generator and discriminator, to be trained together."""
    data = {"where": own.where, "truth": to_float(own.spectra)}
    dr.make_opaque(data)
    weights = generator_weights(s, own.shape, rng)
    # The generator starts near the mean grey of the rows that it may learn from.
    grey = float(np.clip(own.spectra[: own.train].mean(dtype=np.float64), 0.01, 0.99))
    weights[f"g.{LEVELS - 1}.bias"] += np.float32(np.log(grey / (1 - grey)))
    adversary = adversary_weights(s, rng)

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return {"rows": opaque_rows(rows), "noise": to_tensor(rng.uniform(-1, 1, (s.noise, len(rows))))}

    def loss(params: Mapping[str, Any], data: Any, given: Any) -> Any:
        return duel_loss(params, data, given, s, own.shape)

    both = own.network("dcgan", weights | adversary, loss, data, draw, own.score(generate_silent, s))
    return replace(both, rates=dict.fromkeys(adversary, s.adversary_rate), momentum=MOMENTUM)


METHOD = SpectrumNetwork(
    "dcgan",
    DcganSettings,
    network,
    generate_silent,
    "g.",
    CHUNK_SIZE,
    "Radford, Metz and Chintala (2016), conditioned as by Mirza and Osindero (2014), with pix2pix's second term (2017)",
).method()
