"""Variational autoencoder of spatial spectra, conditioned on the transmitter's position.

Source: Kingma and Welling, "Auto-encoding variational Bayes" (2014); condition: Sohn, Lee and Yan, "Learning structured
output representation using deep conditional generative models" (2015). Chosen here:

- Encoder q(z | spectrum, position) and decoder p(spectrum | z, position) are fully connected. The encoder sees means
  over blocks of pixels; the decoder's last layer has one output a pixel, through a sigmoid.
- The likelihood is Gaussian. Its pixels are far from independent, so the Kullback-Leibler term is weighted against the
  mean over pixels (Higgins et al. 2017, beta-VAE).
- Predictions decode z = 0, the prior's mean. The decoder is trained on z from the encoder and, as in Sohn et al.'s
  hybrid objective, on z from the prior, so that it learns the effect of the position.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...core.settings import Count, Positive
from ...core.types import IntArray
from ...gaussians.parameters import logistic
from .layers import Linear, Mlp, Module, columns, feature_count
from .spectrum_networks import NetworkRows, SpectrumNetwork
from .training import Network, NetworkSettings, opaque_rows

POOL = 6  # largest side of the blocks of pixels whose means the encoder sees
NOISE = 0.1  # standard deviation of the likelihood, in grey levels from 0 to 1
BETA = 3e-2  # weight of the divergence against the mean over pixels, which are far from independent (Higgins et al.)
PRIOR_SHARE = 0.8  # share of the reconstruction with z from the prior, which teaches the position's effect


@dataclass(frozen=True)
class VaeSettings(NetworkSettings):
    """Settings of the variational autoencoder and of the training loop."""

    steps: int = 3750
    batch: int = 16
    validate_every: int = 375
    FIXED: ClassVar[Mapping[str, float]] = {"pool": POOL, "noise": NOISE, "beta": BETA, "prior_share": PRIOR_SHARE}
    latent: Count = 16  #: size of z
    width: Count = 256  #: neurons of the hidden layers
    #: neurons of the decoder's second hidden layer, which precedes the pixels: most weights lie behind it
    last: Count = 64
    octaves: int = 4  #: octaves of the position's encoding
    scale_m: Positive = 1.0  #: unit of encoded positions, metres (`wrf_mi.gaussians.network`)


def pooled(spectra: NDArray[Any], pool: int) -> NDArray[np.float32]:
    """Means of spectra [n, height, width] over square blocks of pixels, [n, cells].

    The blocks' side is the largest up to ``pool`` that divides both sides.
    """
    n, height, width = spectra.shape
    side = max(s for s in range(1, pool + 1) if height % s == 0 and width % s == 0)
    blocks = spectra.reshape(n, height // side, side, width // side, side)
    return np.asarray(blocks.mean(axis=(2, 4), dtype=np.float64).reshape(n, -1), np.float32)


class Decoder(Mlp):
    """Mean of p(spectrum | z, position), [pixels, batch], in 0..1."""

    def __init__(self, s: VaeSettings, shape: tuple[int, ...], rng: np.random.Generator) -> None:
        first = Linear({"latent": s.latent, "position": feature_count(s.octaves)}, s.width, rng)
        super().__init__([first, Linear(s.width, s.last, rng)], Linear(s.last, shape[0] * shape[1], rng, gain=1.0))
        self.size = s.latent

    def spectra(self, where: Any) -> Any:
        """Spectra at the prior's mean, z = 0, a flat array, from features of positions [features, m]."""
        pixels = logistic(self(latent=dr.zeros(type(where), (self.size, where.shape[1])), position=where))
        return dr.moveaxis(pixels, 0, 1).array


class Vae(Module):
    """Encoder ``q`` and decoder ``p``."""

    def __init__(self, s: VaeSettings, cells: int, shape: tuple[int, ...], rng: np.random.Generator) -> None:
        first = Linear({"image": cells, "position": feature_count(s.octaves)}, s.width, rng)
        self.q = Mlp([first, Linear(s.width, s.width, rng)], Linear(s.width, 2 * s.latent, rng, gain=0.1))
        self.p = Decoder(s, shape, rng)


def normal_divergence(mean: Any, log_variance: Any) -> Any:
    """Sum of the divergences of N(mean, variance) from N(0, 1) (Kingma and Welling, appendix B)."""
    return 0.5 * dr.sum(mean * mean + dr.exp(log_variance) - 1 - log_variance, axis=None)


def elbo_loss(vae: Vae, data: Any, drawn: Any, latents: int) -> Any:
    """Negative evidence lower bound a pixel, mixed with the likelihood under the prior, for z of ``latents`` numbers.

    ``data`` has ``cells`` [cells, n], ``where`` [features, n] and ``pixels`` [pixels, n] of all rows; ``drawn`` has
    ``rows`` [batch] and two draws of a normal distribution, ``noise`` and ``prior`` [latents, batch].
    """
    cells, where, truth = (columns(data[name], drawn["rows"]) for name in ("cells", "where", "pixels"))
    out = vae.q(image=cells, position=where)
    mean, log_variance = out[:latents, :], out[latents:, :]
    latent = mean + dr.exp(0.5 * log_variance) * drawn["noise"]  # reparametrised: gradients reach mean and variance
    divergence = normal_divergence(mean, log_variance)
    # One product for both, since the decoder's last matrix is the large one.
    latent, both = dr.concat([latent, drawn["prior"]], axis=1), dr.concat([where, where], axis=1)
    greys, batch = logistic(vae.p(latent=latent, position=both)), mean.shape[1]
    error = dr.mean(dr.square(greys[:, :batch] - truth), axis=None)
    free = dr.mean(dr.square(greys[:, batch:] - truth), axis=None)
    # -log p of a Gaussian likelihood, by z of the encoder and of the prior (Sohn et al.'s hybrid objective).
    likelihood = ((1 - PRIOR_SHARE) * error + PRIOR_SHARE * free) / (2 * NOISE * NOISE)
    return (likelihood + (BETA / batch) * divergence).array


class VaeModel(SpectrumNetwork):
    """A variational autoencoder for each receiver."""

    name, settings, summary = "vae", VaeSettings, "variational autoencoder"
    source = "Kingma and Welling, 'Auto-encoding variational Bayes' (2014), conditioned as by Sohn, Lee and Yan (2015)"
    generator_class, generator, at_once = Decoder, "p", 64

    def network(self, rows: NetworkRows, settings: VaeSettings, rng: np.random.Generator) -> Network:
        """Encoder and decoder of a receiver, to be trained."""
        cells, flat = pooled(rows.spectra, POOL), rows.spectra.reshape(len(rows.spectra), -1)
        data = {"cells": to_tensor(cells.T), "where": rows.where, "pixels": to_tensor(flat.T)}
        dr.make_opaque(data)
        vae = Vae(settings, cells.shape[1], rows.spectra.shape[1:], rng)
        # The decoder starts at the mean spectrum of the rows that it may learn from.
        mean = np.clip(flat[: rows.train].mean(axis=0, dtype=np.float64), 0.01, 0.99)
        assert vae.p.out is not None
        vae.p.out.bias = np.log(mean / (1 - mean)).astype(np.float32)[:, None]

        def draw(chosen: IntArray, receiver: int, rng: np.random.Generator) -> Any:
            noise, prior = rng.standard_normal((2, settings.latent, len(chosen)))
            return {"rows": opaque_rows(chosen), "noise": to_tensor(noise), "prior": to_tensor(prior)}

        return self.trained_on(rows, vae, partial(elbo_loss, latents=settings.latent), data, draw)


MODEL = VaeModel()
