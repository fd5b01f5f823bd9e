"""FIRE: a variational autoencoder from uplink to downlink coefficients.

Source: Liu, Singh, Xu and Vasisht, "FIRE: enabling reciprocity for FDD MIMO systems" (MobiCom 2021): an encoder takes
the uplink to a distribution over few latent numbers, a decoder takes these to the downlink; it learns end to end from
pairs, by the squared error of the downlink and the Kullback-Leibler divergence of the latent distribution. Before, each
uplink loses its scale and phase, which say nothing about the paths, and the downlink is expressed in them.

Chosen here, as no code of theirs was found:

- Encoder and decoder are fully connected with two hidden layers each and leaky rectifiers.
- Sample: the network sees one antenna, or all of a row at once, as ``sample`` says. One antenna has as many samples as
  there are antennas times rows, and all of them share one network; a whole row knows the directions of its waves.
  With ``auto`` both are fitted and the one with the better validation rows is kept; a whole row is tried only where
  there are more training rows than coefficients in one (on made rooms, one antenna was 6 dB ahead with 104 antennas
  and 800 rows, the whole row 1.6 dB with 8 antennas and 1,200 rows).
- Scale: root mean square of the sample's uplink; phase: of the sum over subcarriers at the first antenna whose sum is
  not weak, since a single coefficient may be lost in noise.
- The squared error of a sample counts in units of its row's downlink energy, as the score does: samples that have faded
  weigh little.
- Predictions decode the mean of the latent distribution.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...core import InputError, Record, Split
from ...core.settings import Count, settings_from
from ...core.types import IntArray
from ...gaussians.network import Weights, init_layer, linear
from ...training.session import FitSession
from ..method import Inputs, Method
from ..networks.tensors import columns
from ..networks.training import Network, NetworkSettings, keyed, opaque_rows, train_network, under
from .cross_band import bands_arrays, bands_from
from .csi_bands import Bands, bands_of, relative_error, training_rows, uplink_of

Sample = Literal["antenna", "row", "auto"]
CHUNK_SIZE = 4096
"""Samples that are predicted together: bounds the memory."""
LEAK = 0.1
"""Slope of the rectifier below zero."""
WEAK = 0.3
"""Share of the root mean square below which a sum over subcarriers has no phase to lean on."""


@dataclass(frozen=True)
class FireSettings(NetworkSettings):
    """Settings of FIRE, beside those of the loop.

    Attributes:
        batch: antennas of a step, at most, where a sample is an antenna.
        sample: what the network sees: one ``antenna``, a whole ``row``, or ``auto``, chosen on validation rows.
        row_batch: rows of a step, at most, where a sample is a row.
        latent: latent numbers.
        width: neurons of the hidden layers.
        beta: weight of the Kullback-Leibler divergence against the mean squared error of a sample.
        spacing_hz: see `wrf_mi.models.uplink.r2f2.R2F2Settings`.
    """

    steps: int = 5000
    batch: int = 256
    validate_every: int = 500
    sample: Sample = "auto"
    row_batch: Count = 64
    latent: Count = 32
    width: Count = 256
    beta: float = 1e-4
    spacing_hz: float = 312.5e3

    def __post_init__(self) -> None:
        """Refuse what is no network.

        Raises:
            InputError: naming the setting.
        """
        super().__post_init__()
        if self.sample not in get_args(Sample):
            raise InputError(f"setting sample: {self.sample!r}; choose from {', '.join(get_args(Sample))}")


def samples_of(h: NDArray[Any], sample: str) -> NDArray[np.complex128]:
    """Coefficients [n, antennas, f] as samples [m, antennas of a sample, f]."""
    antennas, subcarriers = h.shape[1:]
    return np.asarray(h, complex).reshape(-1, 1 if sample == "antenna" else antennas, subcarriers)


def units_of(uplink: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Scale and phase of each uplink [m, antennas, f], as one complex number; 1 where nothing is received."""
    scale = np.sqrt(np.square(np.abs(uplink)).mean(axis=(1, 2)))
    total = uplink.mean(axis=2)
    strong = np.abs(total) >= WEAK * scale[:, None]
    # Where none is, the strongest will do.
    first = np.where(strong.any(axis=1), strong.argmax(axis=1), np.abs(total).argmax(axis=1))
    chosen = total[np.arange(len(total)), first]
    phase = np.divide(chosen, np.abs(chosen), out=np.ones_like(chosen), where=np.abs(chosen) > 0)
    return np.where(scale > 0, scale, 1.0) * phase


def parts(h: NDArray[np.complex128]) -> NDArray[np.float32]:
    """Real and imaginary parts, [values, m]: columns as samples."""
    flat = h.reshape(len(h), -1)
    return np.concatenate([flat.real, flat.imag], axis=1).T.astype(np.float32)


def initial_weights(settings: FireSettings, inputs: int, outputs: int, rng: np.random.Generator) -> Weights:
    """Random weights of encoder (``q``) and decoder (``p``)."""
    width = settings.width
    weights = init_layer("q.0", {"hidden": inputs}, width, rng) | init_layer("q.1", {"hidden": width}, width, rng)
    weights |= init_layer("q.mean", {"hidden": width}, settings.latent, rng, gain=1.0)
    weights |= init_layer("q.spread", {"hidden": width}, settings.latent, rng, gain=0.1)
    # Latent distributions start narrow: noise of the prior's width would drown the mean.
    weights["q.spread.bias"] -= 4
    weights |= init_layer("p.0", {"hidden": settings.latent}, width, rng)
    weights |= init_layer("p.1", {"hidden": width}, width, rng)
    return weights | init_layer("p.out", {"hidden": width}, outputs, rng, gain=1.0)


def leaky(x: Any) -> Any:
    """Leaky rectified linear unit."""
    return dr.maximum(x, LEAK * x)


def encoder(params: Mapping[str, Any], x: Any) -> tuple[Any, Any]:
    """Mean and logarithm of the variance of the latent numbers, each [latent, batch]."""
    hidden = leaky(linear(params, "q.1", leaky(linear(params, "q.0", x))))
    return linear(params, "q.mean", hidden), linear(params, "q.spread", hidden)


def decoder(params: Mapping[str, Any], latent: Any) -> Any:
    """Downlink in the uplink's units, [values, batch]."""
    return linear(params, "p.out", leaky(linear(params, "p.1", leaky(linear(params, "p.0", latent)))))


def fire_loss(params: Mapping[str, Any], data: Any, given: Any, beta: float) -> Any:
    """Relative squared error of the downlink and divergence of the latent distribution, means over the batch.

    Args:
        params: weights.
        data: ``uplink`` and ``downlink`` [values, n] of all samples, in their own units, and ``weight`` [1, n], the
            square of these over the energy of their row.
        given: ``rows`` [batch] and normal draws ``noise`` [latent, batch].
        beta: weight of the divergence.
    """
    uplink, downlink, weight = (columns(data[name], given["rows"]) for name in ("uplink", "downlink", "weight"))
    mean, log_variance = encoder(params, uplink)
    latent = mean + dr.exp(0.5 * log_variance) * given["noise"]
    batch = mean.shape[1]
    error = dr.sum(dr.square(decoder(params, latent) - downlink) * weight, axis=None)
    # Divergence of N(mean, variance) from N(0, 1), Kingma and Welling (2014), appendix B.
    divergence = 0.5 * dr.sum(mean * mean + dr.exp(log_variance) - 1 - log_variance, axis=None)
    return ((error + beta * divergence) / batch).array


class FittedFire:
    """A fitted network.

    Args:
        sample: ``antenna`` or ``row``.
        weights: of encoder and decoder.
        bands: what it was fitted on.
        settings: of the fit.
    """

    def __init__(self, sample: str, weights: Weights, bands: Bands, settings: FireSettings) -> None:
        self.sample, self.bands, self.settings = sample, bands, settings
        self._weights = weights
        self._params = {name: to_tensor(values) for name, values in weights.items()}

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[np.complex64]:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``.

        Raises:
            InputError: no uplink, one of another shape, or one that is not finite.
        """
        uplink = uplink_of(inputs, self.bands)
        samples = samples_of(uplink, self.sample)
        unit = units_of(samples)
        out = predict_samples(self._params, samples, unit, len(self.bands.downlink_hz))
        return out.reshape(len(uplink), self.bands.antennas, -1).astype(np.complex64)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """See `wrf_mi.models.method.Fitted`."""
        own = {"sample": np.asarray(self.sample), "settings": np.asarray(json.dumps(asdict(self.settings)))}
        return own | bands_arrays("", self.bands) | keyed("network", self._weights)


def predict_samples(
    params: Mapping[str, Any], samples: NDArray[np.complex128], unit: NDArray[np.complex128], subcarriers: int
) -> NDArray[np.complex128]:
    """Downlink [m, antennas of a sample, subcarriers] of uplink samples with their units."""
    scaled = parts(samples / unit[:, None, None])
    out = np.empty((len(samples), samples.shape[1] * subcarriers), complex)
    for first in range(0, len(samples), CHUNK_SIZE):
        some = slice(first, first + CHUNK_SIZE)
        values = decoder(params, encoder(params, to_tensor(scaled[:, some]))[0]).numpy().T
        half = values.shape[1] // 2
        out[some] = values[:, :half] + 1j * values[:, half:]
    return out.reshape(len(samples), -1, subcarriers) * unit[:, None, None]


def fit(record: Record, split: Split, settings: FireSettings, seed: int, session: FitSession) -> FittedFire:
    """Fit one network, or two of which the better stays.

    Raises:
        InputError: no uplink, shapes that do not fit, coefficients that are not finite, or one training row.
    """
    train, validation = training_rows(METHOD, record, split)
    bands = bands_of(record, settings.spacing_hz)
    kinds = ("antenna", "row") if settings.sample == "auto" else (settings.sample,)
    few = len(train) + len(validation) <= bands.antennas * len(bands.uplink_hz)
    unscored = not len(validation) or not settings.patience or not settings.holdout_steps_fraction
    if settings.sample == "auto" and (few or unscored or bands.antennas == 1):
        kinds = ("antenna",)
    fits = [(*_fit(record, train, validation, settings, seed, session, kind), kind) for kind in kinds]
    weights, _, kind = max(fits, key=lambda one: one[1])
    return FittedFire(kind, weights, bands, settings)


def _fit(
    record: Record,
    train: IntArray,
    validation: IntArray,
    s: FireSettings,
    seed: int,
    session: FitSession,
    sample: str,
) -> tuple[Weights, float]:
    """Weights and the best validation score, see `train_network`."""
    assert record.uplink is not None
    known = np.concatenate([train, validation])
    uplink, downlink = samples_of(record.uplink[known], sample), samples_of(record.observation[0, known], sample)
    unit = units_of(uplink)
    x, y = parts(uplink / unit[:, None, None]), parts(downlink / unit[:, None, None])
    per_row = uplink.shape[0] // len(known)
    # Samples are in their own units; errors are to count in their row's.
    energy = np.square(np.abs(downlink)).sum(axis=(1, 2)).reshape(-1, per_row).mean(axis=1).repeat(per_row)
    # A row without energy has no relative error.
    heard = energy > 0
    weight = np.where(heard, np.square(np.abs(unit)) / np.where(heard, energy, 1), 0).astype(np.float32)[None]
    data = {"uplink": to_tensor(x), "downlink": to_tensor(y), "weight": to_tensor(weight)}
    dr.make_opaque(data)
    rng = np.random.default_rng([seed, int(sample == "row")])
    weights = initial_weights(s, len(x), len(y), rng)

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return {"rows": opaque_rows(rows), "noise": to_tensor(rng.standard_normal((s.latent, len(rows))))}

    def loss(params: Mapping[str, Any], data: Any, given: Any) -> Any:
        return fire_loss(params, data, given, s.beta)

    held = slice(len(train) * per_row, None)
    truth, given_unit, given_uplink = downlink[held], unit[held], uplink[held]

    def score(params: Mapping[str, Any]) -> float:
        predicted = predict_samples(params, given_uplink, given_unit, truth.shape[-1])
        return float(np.median(relative_error(_rows(predicted, per_row), _rows(truth, per_row))))

    rows = [np.arange(len(part) * per_row) for part in (train, known)]
    ends = rows[:1], rows[1:], score if len(validation) else None, "relative error"
    network = Network(f"fire {sample}", weights, loss, data, draw, *ends)
    config = s if sample == "antenna" else replace(s, batch=s.row_batch)
    return train_network(network, config, (seed, int(sample == "row")), session)


def _rows(samples: NDArray[Any], per_row: int) -> NDArray[Any]:
    """Samples [rows * per_row, antennas, f] as [rows, all of them]."""
    return samples.reshape(len(samples) // per_row, -1)


def load(arrays: dict[str, NDArray[Any]], record: Record) -> FittedFire:
    """From `FittedFire.arrays`."""
    settings = settings_from(FireSettings, json.loads(str(arrays["settings"])), "fire")
    return FittedFire(str(arrays["sample"]), under("network", arrays), bands_from(arrays)[1], settings)


METHOD = Method(
    name="fire",
    tasks=("csi",),
    settings=FireSettings,
    fit=fit,
    load=load,
    source="Liu et al., FIRE: enabling reciprocity for FDD MIMO systems (MobiCom 2021)",
    needs_uplink=True,
)
