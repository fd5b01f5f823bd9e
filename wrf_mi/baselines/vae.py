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
  position could tell; Sohn et al.'s hybrid objective, taken here, also trains it on z from the prior.
- Positions pass through the coordinates and their positional encoding.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_float, to_tensor
from ..core import InputError, Record, Split
from ..core.types import IntArray
from ..field.network import Weights, init_layer, linear, relu
from ..loss.ssim import ssim
from .coordinates import Coordinates, feature_count
from .method import Inputs, Listen, Method
from .tensors import columns
from .training import Descent, Training, epochs, fit_network, keyed, opaque_rows, positions, under, usable_rows

AT_ONCE = 64
"""Spectra that are predicted together: bounds the memory."""


@dataclass(frozen=True)
class VaeSettings:
    """Settings of the variational autoencoder.

    Attributes:
        training: how it learns.
        latent: numbers in z.
        width: neurons of the hidden layers.
        last: neurons of the decoder's second hidden layer, from which each pixel is made: most weights lie behind it.
        pool: largest side of the blocks of pixels whose means the encoder sees.
        octaves: of the position's encoding.
        scale_m: metres that make its unit (`wrf_mi.field.encoding`).
        noise: deviation of the likelihood, in grey levels from 0 to 1.
        beta: weight of the Kullback-Leibler divergence against the mean over pixels.
        prior_share: share of the reconstruction whose z is drawn from the prior.
    """

    training: Training = field(default_factory=lambda: Training(steps=3000, batch=16))
    latent: int = 16
    width: int = 256
    last: int = 64
    pool: int = 6
    octaves: int = 4
    scale_m: float = 1.0
    noise: float = 0.1
    beta: float = 3e-2
    prior_share: float = 0.8

    def __post_init__(self) -> None:
        """Refuse what is no network.

        Raises:
            InputError: naming the setting.
        """
        if min(self.latent, self.width, self.last, self.pool) < 1 or self.octaves < 0:
            raise InputError(
                f"vae: latent {self.latent}, width {self.width}, last {self.last}, pool {self.pool}, "
                f"octaves {self.octaves}; choose 1 or more (octaves: 0 or more)"
            )
        if not (self.noise > 0 and self.scale_m > 0 and self.beta >= 0 and 0 <= self.prior_share <= 1):
            raise InputError(
                f"vae: noise {self.noise}, scale_m {self.scale_m}, beta {self.beta}, prior_share {self.prior_share}; "
                "choose positive numbers and a share up to 1"
            )


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


class FittedVae:
    """Decoders that were fitted, one for each receiver.

    Args:
        settings: of the networks.
        coordinates: frame of the positions.
        networks: weights of each receiver.
        shape: height and width of a spectrum.
    """

    def __init__(
        self, settings: VaeSettings, coordinates: Coordinates, networks: list[Weights], shape: tuple[int, int]
    ) -> None:
        self._settings, self._coordinates, self._shape = settings, coordinates, shape
        self._networks = [{name: w for name, w in weights.items() if name[0] == "p"} for weights in networks]
        self._params = [{name: to_tensor(w) for name, w in weights.items()} for weights in self._networks]

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """Spectra [m, height, width], float32."""
        s, out = self._settings, np.empty((len(inputs), *self._shape), np.float32)
        for first in range(0, len(inputs), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            where = self._coordinates.features(inputs.tx_pos_m[part], s.octaves, s.scale_m)
            out[part] = decode_prior(self._params[receiver], s.latent, where).numpy().T.reshape(-1, *self._shape)
        return out

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, frame and decoders."""
        own = {"settings": np.asarray(json.dumps(asdict(self._settings))), "shape": np.asarray(self._shape)}
        own |= keyed("frame", self._coordinates.arrays())
        for r, weights in enumerate(self._networks):
            own |= keyed(f"receiver{r}", weights)
        return own


def decode_prior(params: Mapping[str, Any], latent: int, where: Any) -> Any:
    """The decoder at the prior's mean, z = 0: [pixels, batch]."""
    return decoder(params, dr.zeros(type(where), (latent, where.shape[1])), where)


def median_dissimilarity(predicted: Any, truth: Any, count: int, height: int, width: int) -> float:
    """1 - the median structural similarity of flat Dr.Jit arrays of ``count`` spectra."""
    return 1 - float(np.median(ssim(predicted, truth, count, height, width).numpy()))


def fit(record: Record, split: Split, settings: VaeSettings, seed: int, listen: Listen) -> FittedVae:
    """Fit a network to each receiver.

    Raises:
        InputError: positions that the data do not tell, or a receiver without training rows.
    """
    where_m = positions(record, "vae")
    coordinates = Coordinates.of(where_m[split.all_train])
    networks, count = [], len(record.receivers)
    for r in range(count):

        def part(what: str, share: float, first: int = r) -> None:
            listen(what, (first + share) / count)

        networks.append(_fit_receiver(record, split, settings, seed, part, r, coordinates))
    height, width = (int(side) for side in record.observation.shape[-2:])
    return FittedVae(settings, coordinates, networks, (height, width))


def _fit_receiver(
    record: Record, split: Split, s: VaeSettings, seed: int, listen: Listen, receiver: int, coordinates: Coordinates
) -> Weights:
    train, validation = usable_rows(record, split, receiver, "vae")
    known = np.concatenate([train, validation])
    spectra = np.asarray(record.observation[receiver, known], np.float32)
    height, width = (int(side) for side in spectra.shape[1:])
    cells = pooled(spectra, s.pool)
    where = coordinates.features(record.tx_pos_m[known], s.octaves, s.scale_m)
    flat = spectra.reshape(len(known), -1)
    data = {"cells": to_tensor(cells.T), "where": where, "pixels": to_tensor(flat.T)}
    dr.make_opaque(data)
    rng = np.random.default_rng([seed, receiver])
    weights = initial_weights(s, cells.shape[1], height * width, rng)
    # The decoder starts at the mean spectrum of the rows that it may learn from.
    mean = np.clip(flat[: len(train)].mean(axis=0, dtype=np.float64), 0.01, 0.99)
    weights["p.out.bias"] = np.log(mean / (1 - mean)).astype(np.float32)[:, None]

    def draw(everything: bool) -> Iterator[Any]:
        rows: IntArray = np.arange(len(known) if everything else len(train))
        for picked in epochs(rows, s.training.batch, rng):
            noise, prior = rng.standard_normal((2, s.latent, s.training.batch))
            yield {"rows": opaque_rows(picked), "noise": to_tensor(noise), "prior": to_tensor(prior)}

    def loss(params: Mapping[str, Any], data: Any, given: Any) -> Any:
        return elbo_loss(params, data, given, s.noise, s.beta, s.prior_share)

    score = None
    if len(validation):
        asked = coordinates.features(record.tx_pos_m[validation], s.octaves, s.scale_m)
        truth = to_float(spectra[len(train) :])

        def score(params: Mapping[str, Any]) -> float:
            predicted = dr.moveaxis(decode_prior(params, s.latent, asked), 0, 1).array
            return median_dissimilarity(predicted, truth, len(validation), height, width)

    name = record.receivers[receiver].name
    return fit_network(
        Descent(weights, loss, s.training.averaging), data, draw, score, s.training, listen, f"vae {name}"
    )[0]


def load(arrays: dict[str, NDArray[Any]], record: Record) -> FittedVae:
    """What `FittedVae.arrays` described."""
    plain = json.loads(str(arrays["settings"]))
    settings = VaeSettings(**plain | {"training": Training(**plain["training"])})
    networks = [under(f"receiver{r}", arrays) for r in range(len(record.receivers))]
    height, width = (int(side) for side in arrays["shape"])
    return FittedVae(settings, Coordinates.load(under("frame", arrays)), networks, (height, width))


METHOD = Method(
    "vae",
    ("spectrum",),
    VaeSettings,
    fit,
    load,
    "Kingma and Welling, 'Auto-encoding variational Bayes' (2014), conditioned as by Sohn, Lee and Yan (2015)",
)
