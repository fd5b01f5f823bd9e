"""Variational autoencoder of spatial spectra, conditioned on the transmitter's position.

Source: Kingma and Welling, "Auto-encoding variational Bayes" (2014), which the WRF-GS papers name, and for the
condition Sohn, Lee and Yan, "Learning structured output representation using deep conditional generative models"
(2015). NeRF2, whose figures the papers compare with, says no more than that a VAE predicts spectra from positions, and
has not released it. Chosen here:

- Encoder q(z | spectrum, position) and decoder p(spectrum | z, position) are fully connected as in Kingma and Welling.
  The encoder sees means over blocks of pixels: a spectrum of a small array has few degrees of freedom. The decoder's
  last layer has one output a pixel, through a sigmoid.
- Gaussian likelihood of stated deviation. Its pixels are far from independent, so that the Kullback-Leibler term is
  weighted against the mean, not the sum, over pixels (Higgins et al. 2017, beta-VAE).
- Predictions decode z = 0, the prior's mean. A decoder that is trained only on z from the encoder leaves to z what the
  position could tell; Sohn et al.'s physics objective, taken here, also trains it on z from the prior.
- Positions pass through the coordinates and their positional encoding.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...core.settings import Count, Positive, Share
from ...core.types import IntArray
from ...gaussians.network import Weights, init_layer, linear, relu
from .coordinates import feature_count
from .spectrum_networks import ReceiverRows, SpectrumNetwork
from .tensors import columns
from .training import Network, NetworkSettings, opaque_rows

CHUNK_SIZE = 64
"""Spectra that are predicted together: bounds the memory."""


@dataclass(frozen=True)
class VaeSettings(NetworkSettings):
    """Settings of the variational autoencoder, beside those of the loop.

    Attributes:
        latent: numbers in z.
        width: neurons of the hidden layers.
        last: neurons of the decoder's second hidden layer, from which each pixel is made: most weights lie behind it.
        pool: largest side of the blocks of pixels whose means the encoder sees.
        octaves: of the position's encoding.
        scale_m: metres that make its unit (`wrf_mi.gaussians.encoding`).
        noise: deviation of the likelihood, in grey levels from 0 to 1.
        beta: weight of the Kullback-Leibler divergence against the mean over pixels.
        prior_share: share of the reconstruction whose z is drawn from the prior.
    """

    steps: int = 3750
    batch: int = 16
    validate_every: int = 375
    latent: Count = 16
    width: Count = 256
    last: Count = 64
    pool: Count = 6
    octaves: int = 4
    scale_m: Positive = 1.0
    noise: Positive = 0.1
    beta: float = 3e-2
    prior_share: Share = 0.8


def pooled(spectra: NDArray[Any], pool: int) -> NDArray[np.float32]:
    """Means over square blocks of pixels, [n, cells], whose side is the largest up to ``pool`` that divides both sides.

    Args:
        spectra: [n, height, width].
        pool: largest side.
    """
    n, height, width = spectra.shape
    side = max(s for s in range(1, pool + 1) if height % s == 0 and width % s == 0)
    blocks = spectra.reshape(n, height // side, side, width // side, side)
    return blocks.mean(axis=(2, 4), dtype=np.float64).reshape(n, -1).astype(np.float32)


def initial_weights(settings: VaeSettings, cells: int, pixels: int, rng: np.random.Generator) -> Weights:
    """Random weights of encoder (``q``) and decoder (``p``)."""
    where, width = feature_count(settings.octaves), settings.width
    weights = init_layer("q.0", {"image": cells, "position": where}, width, rng)
    weights |= init_layer("q.1", {"hidden": width}, width, rng)
    weights |= init_layer("q.out", {"hidden": width}, 2 * settings.latent, rng, gain=0.1)
    weights |= init_layer("p.0", {"latent": settings.latent, "position": where}, width, rng)
    weights |= init_layer("p.1", {"hidden": width}, settings.last, rng)
    return weights | init_layer("p.out", {"hidden": settings.last}, pixels, rng, gain=1.0)


def encoder(params: Mapping[str, Any], cells: Any, where: Any) -> tuple[Any, Any]:
    """Mean and logarithm of the variance of q(z | spectrum, position), each [latent, batch]."""
    hidden = relu(linear(params, "q.0", cells, "image") + params["q.0.position"] @ where)
    out = linear(params, "q.out", relu(linear(params, "q.1", hidden)))
    half = out.shape[0] // 2
    return out[:half, :], out[half:, :]


def decoder(params: Mapping[str, Any], latent: Any, where: Any) -> Any:
    """Mean of p(spectrum | z, position), [pixels, batch], in 0..1."""
    hidden = relu(linear(params, "p.0", latent, "latent") + params["p.0.position"] @ where)
    out = linear(params, "p.out", relu(linear(params, "p.1", hidden)))
    return dr.rcp(1 + dr.exp(-out))


def elbo_loss(params: Mapping[str, Any], data: Any, given: Any, noise: float, beta: float, prior_share: float) -> Any:
    """Negative evidence lower bound a pixel, mixed with the likelihood under the prior.

    Args:
        params: weights.
        data: ``cells`` [cells, n], ``where`` [features, n] and ``pixels`` [pixels, n] of all rows.
        given: ``rows`` [batch] and two draws of a normal distribution, ``noise`` and ``prior`` [latent, batch].
        noise: deviation of the likelihood.
        beta: weight of the divergence.
        prior_share: share of the likelihood with z from the prior.
    """
    cells, where, truth = (columns(data[name], given["rows"]) for name in ("cells", "where", "pixels"))
    mean, log_variance = encoder(params, cells, where)
    latent = mean + dr.exp(0.5 * log_variance) * given["noise"]
    # Divergence of N(mean, variance) from N(0, 1), Kingma and Welling, appendix B.
    divergence = 0.5 * dr.sum(mean * mean + dr.exp(log_variance) - 1 - log_variance, axis=None)
    # One product for both, since the decoder's last matrix is the large one.
    both = decoder(params, dr.concat([latent, given["prior"]], axis=1), dr.concat([where, where], axis=1))
    batch = mean.shape[1]
    error = dr.mean(dr.square(both[:, :batch] - truth), axis=None)
    free = dr.mean(dr.square(both[:, batch:] - truth), axis=None)
    likelihood = ((1 - prior_share) * error + prior_share * free) / (2 * noise * noise)
    return (likelihood + (beta / batch) * divergence).array


def generate(params: Mapping[str, Any], s: VaeSettings, where: Any, shape: tuple[int, int]) -> Any:
    """Spectra of the decoder at the prior's mean, z = 0, a flat array."""
    pixels = decoder(params, dr.zeros(type(where), (s.latent, where.shape[1])), where)
    return dr.moveaxis(pixels, 0, 1).array


def network(own: ReceiverRows, s: VaeSettings, rng: np.random.Generator) -> Network:
    """A receiver's encoder and decoder, to be trained."""
    cells, flat = pooled(own.spectra, s.pool), own.spectra.reshape(len(own.spectra), -1)
    data = {"cells": to_tensor(cells.T), "where": own.where, "pixels": to_tensor(flat.T)}
    dr.make_opaque(data)
    weights = initial_weights(s, cells.shape[1], flat.shape[1], rng)
    # The decoder starts at the mean spectrum of the rows that it may learn from.
    mean = np.clip(flat[: own.train].mean(axis=0, dtype=np.float64), 0.01, 0.99)
    weights["p.out.bias"] = np.log(mean / (1 - mean)).astype(np.float32)[:, None]

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        noise, prior = rng.standard_normal((2, s.latent, len(rows)))
        return {"rows": opaque_rows(rows), "noise": to_tensor(noise), "prior": to_tensor(prior)}

    def loss(params: Mapping[str, Any], data: Any, given: Any) -> Any:
        return elbo_loss(params, data, given, s.noise, s.beta, s.prior_share)

    return own.network("vae", weights, loss, data, draw, own.score(generate, s))


METHOD = SpectrumNetwork(
    "vae",
    VaeSettings,
    network,
    generate,
    "p.",
    CHUNK_SIZE,
    "Kingma and Welling, 'Auto-encoding variational Bayes' (2014), conditioned as by Sohn, Lee and Yan (2015)",
).method()
