"""FIRE: a variational autoencoder from uplink to downlink coefficients.

Source: Liu, Singh, Xu and Vasisht, "FIRE: enabling reciprocity for FDD MIMO systems" (MobiCom 2021): an encoder takes
the uplink to a distribution over few latent numbers, a decoder takes these to the downlink; both learn from pairs, by
the squared error of the downlink and the Kullback-Leibler divergence of the latent distribution. Uplink and downlink
are divided by the uplink's scale and phase. Chosen here:

- Encoder and decoder are fully connected with two hidden layers each and leaky rectifiers.
- A sample of the network is one antenna, or all of a row, as ``sample`` says. With ``auto`` both are fitted and the
  network with the better validation rows is kept; a whole row is tried only where there are more training rows than
  coefficients in a row.
- Scale: root mean square of the sample's uplink; phase: of the sum over subcarriers at the first antenna whose sum is
  not weak.
- The squared error of a sample counts in units of its row's downlink energy, as the score does.
- Predictions decode the mean of the latent distribution.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal

import drjit as dr
import numpy as np
from drjit import nn
from numpy.typing import NDArray

from ...backend.device import to_tensor
from ...core import Prediction, Split
from ...core.settings import Count, Positive
from ...core.types import IntArray
from ...tasks.conditions import real_parts
from ...training.config import unused_of_loop, validates
from ...training.session import FitSession
from ..model import Arrays, Fitted, Inputs, Problem, slices
from ..networks.layers import Linear, Mlp, Module, columns
from ..networks.training import Network, NetworkSettings, opaque_rows, train_network
from ..networks.vae import normal_divergence
from .uplink_waves import Bands, UplinkModel, bands_of, relative_error, unused_spacing

Sample = Literal["antenna", "row", "auto"]
CHUNK_SIZE = 4096  # samples that are predicted together: bounds the memory
leaky = nn.LeakyReLU(0.1)
ROW_BATCH = 64  # rows of a step, at most, where a sample is a row
BETA = 1e-4  # weight of the divergence against the relative squared error of a sample
WEAK = 0.3  # share of the root mean square below which a sum over subcarriers has no reliable phase


@dataclass(frozen=True)
class FireSettings(NetworkSettings):
    """Settings of FIRE and of the training loop."""

    steps: int = 5000
    batch: int = 256  #: antennas of a step, at most, where a sample is an antenna
    validate_every: int = 500
    #: input of the network: one ``antenna``, a whole ``row``, or ``auto``, chosen on validation rows
    sample: Sample = "auto"
    FIXED: ClassVar[Mapping[str, float]] = {"row_batch": ROW_BATCH, "beta": BETA}
    latent: Count = 32  #: number of latent variables
    width: Count = 256  #: neurons of the hidden layers
    #: distance of subcarriers where the data have no frequencies; that of 802.11 at 20 MHz
    spacing_hz: Positive = 312.5e3


def samples_of(h: NDArray[Any], sample: str) -> NDArray[np.complex128]:
    """Coefficients [n, antennas, f] as samples [m, antennas of a sample, f]."""
    antennas, subcarriers = h.shape[1:]
    return np.asarray(h, complex).reshape(-1, 1 if sample == "antenna" else antennas, subcarriers)


def units_of(uplink: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """Scale and phase of each uplink [m, antennas, f], as one complex number; 1 where nothing is received."""
    scale = np.sqrt(np.square(np.abs(uplink)).mean(axis=(1, 2)))
    total = uplink.mean(axis=2)
    strong = np.abs(total) >= WEAK * scale[:, None]
    # Where all are weak, the strongest counts.
    first = np.where(strong.any(axis=1), strong.argmax(axis=1), np.abs(total).argmax(axis=1))
    chosen = total[np.arange(len(total)), first]
    phase = np.divide(chosen, np.abs(chosen), out=np.ones_like(chosen), where=np.abs(chosen) > 0)
    return np.asarray(np.where(scale > 0, scale, 1.0) * phase)


class Encoder(Mlp):
    """Mean and logarithm of the variance of the latent variables, each [latent, batch], of uplinks [values, batch]."""

    def __init__(self, s: FireSettings, inputs: int, rng: np.random.Generator) -> None:
        super().__init__([Linear(inputs, s.width, rng), Linear(s.width, s.width, rng)], None, leaky)
        self.mean = Linear(s.width, s.latent, rng, gain=1.0)
        self.spread = Linear(s.width, s.latent, rng, gain=0.1)
        # Latent distributions start narrow: noise of the prior's width would drown the mean.
        self.spread.bias -= 4

    def __call__(self, uplink: Any) -> tuple[Any, Any]:
        """Mean and logarithm of the variance for uplinks."""
        hidden = super().__call__(uplink)
        return self.mean(hidden), self.spread(hidden)


class Fire(Module):
    """Encoder ``q`` and decoder ``p``."""

    def __init__(self, s: FireSettings, inputs: int, outputs: int, rng: np.random.Generator) -> None:
        self.q = Encoder(s, inputs, rng)
        hidden = [Linear(s.latent, s.width, rng), Linear(s.width, s.width, rng)]
        self.p = Mlp(hidden, Linear(s.width, outputs, rng, gain=1.0), leaky)


def fire_loss(fire: Fire, data: Any, drawn: Any) -> Any:
    """Relative squared error of the downlink and divergence of the latent distribution, means over the batch.

    ``data`` has ``uplink`` and ``downlink`` [values, n] of all samples in units of their uplink, and ``weight`` [1, n],
    the square of these units over the energy of their row; ``drawn`` has ``rows`` [batch] and normal draws ``noise``
    [latent, batch].
    """
    uplink, downlink, weight = (columns(data[name], drawn["rows"]) for name in ("uplink", "downlink", "weight"))
    mean, log_variance = fire.q(uplink)
    latent = mean + dr.exp(0.5 * log_variance) * drawn["noise"]
    error = dr.sum(dr.square(fire.p(latent) - downlink) * weight, axis=None)
    return ((error + BETA * normal_divergence(mean, log_variance)) / mean.shape[1]).array


@dataclass(eq=False)
class FittedFire(Fitted):
    """A fitted network for samples of an ``antenna`` or a ``row``."""

    sample: str
    weights: Arrays
    bands: Bands
    settings: FireSettings

    def __post_init__(self) -> None:
        sizes = self.weights["q.0.hidden"].shape[1], len(self.weights["p.out.bias"])
        self.network = Fire(self.settings, *sizes, np.random.default_rng(0)).on_device(self.weights)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``."""
        uplink = np.asarray(inputs.uplink, complex)
        samples = samples_of(uplink, self.sample)
        out = predict_samples(self.network, samples, units_of(samples), len(self.bands.downlink_hz))
        return Prediction(out.reshape(len(uplink), self.bands.antennas, -1).astype(np.complex64))


def predict_samples(
    fire: Fire, samples: NDArray[np.complex128], unit: NDArray[np.complex128], subcarriers: int
) -> NDArray[np.complex128]:
    """Downlink [m, antennas of a sample, subcarriers] of uplink samples with their units."""
    scaled = real_parts(samples / unit[:, None, None]).T
    out = np.empty((len(samples), samples.shape[1] * subcarriers), complex)
    for chunk in slices(len(samples), CHUNK_SIZE):
        values = fire.p(fire.q(to_tensor(scaled[:, chunk]))[0]).numpy().T
        half = values.shape[1] // 2
        out[chunk] = values[:, :half] + 1j * values[:, half:]
    return out.reshape(len(samples), -1, subcarriers) * unit[:, None, None]


def _fit(
    problem: Problem, train: IntArray, validation: IntArray, session: FitSession, sample: str
) -> tuple[Fire, float]:
    """Network and its best validation score."""
    record, s = problem.record, problem.settings
    assert record.uplink is not None
    all_train = np.concatenate([train, validation])
    uplink, downlink = (
        samples_of(record.uplink[all_train], sample),
        samples_of(record.observation[0, all_train], sample),
    )
    unit = units_of(uplink)
    x, y = (real_parts(coefficients / unit[:, None, None]).T for coefficients in (uplink, downlink))
    per_row = uplink.shape[0] // len(all_train)
    # Samples are in units of their uplink; errors count in units of their row.
    energy = np.square(np.abs(downlink)).sum(axis=(1, 2)).reshape(-1, per_row).mean(axis=1).repeat(per_row)
    # A row without energy has no relative error.
    received = energy > 0
    weight = np.where(received, np.square(np.abs(unit)) / np.where(received, energy, 1), 0).astype(np.float32)[None]
    data = {"uplink": to_tensor(x), "downlink": to_tensor(y), "weight": to_tensor(weight)}
    dr.make_opaque(data)
    seeds = problem.seed, int(sample == "row")
    fire = Fire(s, len(x), len(y), np.random.default_rng(seeds))

    def draw(rows: IntArray, receiver: int, rng: np.random.Generator) -> Any:
        return {"rows": opaque_rows(rows), "noise": to_tensor(rng.standard_normal((s.latent, len(rows))))}

    judges = slice(len(train) * per_row, None)

    def score(fire: Fire) -> float:
        predicted = predict_samples(fire, uplink[judges], unit[judges], downlink.shape[-1])
        rows = (samples.reshape(len(validation), -1) for samples in (predicted, downlink[judges]))
        return float(np.median(relative_error(*rows)))

    first, everything = ([np.arange(len(part) * per_row)] for part in (train, all_train))
    rows_of = draw, first, everything, score if len(validation) else None
    network = Network(f"fire {sample}", fire, fire_loss, data, *rows_of, "relative error")
    config = s if sample == "antenna" else replace(s, batch=ROW_BATCH)
    return train_network(network, config, seeds, session)


class FireModel(UplinkModel):
    """FIRE."""

    name, settings, fitted = "fire", FireSettings, FittedFire
    source = "Liu et al., FIRE: enabling reciprocity for FDD MIMO systems (MobiCom 2021)"
    summary = "variational autoencoder from uplink to downlink"

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of validation without rows, of antennas where rows are samples, and of known frequencies."""
        s, unused = problem.settings, unused_of_loop(problem.settings, validates(splits))
        unused |= {"batch": "samples are whole rows"} if s.sample == "row" else {}
        return unused | unused_spacing(problem.record)

    def fit(self, problem: Problem, split: Split, session: FitSession) -> FittedFire:
        """Fit a network, or two of which the better is kept."""
        record, settings = problem.record, problem.settings
        train, validation = self.known_rows(record, split)
        bands = bands_of(record, settings.spacing_hz)
        kinds = ("antenna", "row") if settings.sample == "auto" else (settings.sample,)
        # A network of whole rows has that many more weights, which fewer rows than coefficients do not determine.
        few = len(train) + len(validation) <= bands.antennas * len(bands.uplink_hz)
        unscored = not len(validation) or not settings.patience or not settings.holdout_steps_fraction
        if settings.sample == "auto" and (few or unscored or bands.antennas == 1):
            kinds = ("antenna",)
        fits = [(*_fit(problem, train, validation, session, kind), kind) for kind in kinds]
        network, _, kind = max(fits, key=lambda fit: fit[1])
        return FittedFire(kind, network.arrays(), bands, settings)


MODEL = FireModel()
