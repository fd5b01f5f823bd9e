"""Networks that make a receiver's spectra from the transmitter's position, one network for each receiver."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_float, to_tensor
from ...core import Record, Split
from ...core.settings import settings_from
from ...gaussians.network import Weights
from ...tasks import TASKS
from ...tasks.ssim import ssim
from ...training.session import FitSession
from ..method import Inputs, Method
from .coordinates import Coordinates
from .training import Network, keyed, positions, train_network, under, usable_rows

SPECTRUM = TASKS["spectrum"]
Generate = Callable[[Mapping[str, Any], Any, Any, tuple[int, int]], Any]
"""Parameters, settings, features of positions [features, m] and a spectrum's height and width give greys
[m * height * width], a flat Dr.Jit array."""


@dataclass(frozen=True)
class ReceiverRows:
    """What a receiver's network learns from: rows that train, then those that choose.

    Attributes:
        receiver: its name.
        spectra: greys [n, height, width].
        where: features of the transmitters [features, n].
        train: how many rows train while the others choose.
    """

    receiver: str
    spectra: NDArray[np.float32]
    where: Any
    train: int

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of a spectrum."""
        return int(self.spectra.shape[1]), int(self.spectra.shape[2])

    def network(self, kind: str, weights: Weights, loss: Any, data: Any, draw: Any, score: Any) -> Network:
        """What is trained on these rows, see `Network`."""
        train, everything = [np.arange(self.train)], [np.arange(len(self.spectra))]
        ends = weights, loss, data, draw, train, everything, score
        return Network(f"{kind} {self.receiver}", *ends, SPECTRUM.label, SPECTRUM.higher_is_better)

    def score(self, generate: Generate, settings: Any) -> Callable[[Mapping[str, Any]], float] | None:
        """Median structural similarity of the rows that choose; None without such rows."""
        count = len(self.spectra) - self.train
        if not count:
            return None
        asked, truth = to_tensor(self.where.numpy()[:, self.train :]), to_float(self.spectra[self.train :])

        def of(params: Mapping[str, Any]) -> float:
            with dr.suspend_grad():
                predicted = generate(params, settings, asked, self.shape)
            return float(np.median(ssim(predicted, truth, count, *self.shape).numpy()))

        return of


@dataclass(frozen=True)
class SpectrumNetwork:
    """A kind of network.

    Attributes:
        name: of the method.
        settings: class of its settings, which have ``octaves`` and ``scale_m``.
        network: what is trained, from a receiver's rows, settings and a generator of random numbers.
        generate: spectra of positions by its weights.
        generator: prefix of the weights that it needs.
        at_once: spectra that are predicted together, which bounds the memory.
        source: who it is by.
    """

    name: str
    settings: type
    network: Callable[[ReceiverRows, Any, np.random.Generator], Network]
    generate: Generate
    generator: str
    at_once: int
    source: str

    def method(self) -> Method:
        """For the table of methods."""
        return Method(self.name, ("spectrum",), self.settings, partial(_fit, self), partial(_load, self), self.source)


class FittedNetworks:
    """Networks that were fitted.

    Args:
        kind: of network.
        settings: of the networks.
        coordinates: frame of the positions.
        networks: weights of each receiver's network.
        shape: height and width of a spectrum.
    """

    def __init__(
        self,
        kind: SpectrumNetwork,
        settings: Any,
        coordinates: Coordinates,
        networks: list[Weights],
        shape: tuple[int, int],
    ) -> None:
        self._kind, self._settings, self._coordinates, self._shape = kind, settings, coordinates, shape
        self._networks = networks
        self._params = [{name: to_tensor(w) for name, w in weights.items()} for weights in networks]

    def predict(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """Spectra [m, height, width], float32."""
        s, out = self._settings, np.empty((len(inputs), *self._shape), np.float32)
        for first in range(0, len(inputs), self._kind.at_once):
            part = slice(first, first + self._kind.at_once)
            where = self._coordinates.features(inputs.tx_pos_m[part], s.octaves, s.scale_m)
            with dr.suspend_grad():
                flat = self._kind.generate(self._params[receiver], s, where, self._shape)
            out[part] = flat.numpy().reshape(-1, *self._shape)
        return out

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, frame and weights."""
        own = {"settings": np.asarray(json.dumps(asdict(self._settings))), "shape": np.asarray(self._shape)}
        own |= keyed("frame", self._coordinates.arrays())
        for r, weights in enumerate(self._networks):
            own |= keyed(f"receiver{r}", weights)
        return own


def _fit(
    kind: SpectrumNetwork, record: Record, split: Split, settings: Any, seed: int, session: FitSession
) -> FittedNetworks:
    """Fit a network to each receiver.

    Raises:
        InputError: positions that the data do not tell, or a receiver without training rows.
    """
    coordinates = Coordinates.of(positions(record, kind.name)[split.all_train])
    networks = []
    for r, receiver in enumerate(record.receivers):
        train, validation = usable_rows(record, split, r, kind.name)
        known = np.concatenate([train, validation])
        where = coordinates.features(record.tx_pos_m[known], settings.octaves, settings.scale_m)
        own = ReceiverRows(receiver.name, np.asarray(record.observation[r, known], np.float32), where, len(train))
        network = kind.network(own, settings, np.random.default_rng([seed, r]))
        weights, _ = train_network(network, settings, (seed, r), session)
        networks.append({name: values for name, values in weights.items() if name.startswith(kind.generator)})
    height, width = (int(side) for side in record.observation.shape[-2:])
    return FittedNetworks(kind, settings, coordinates, networks, (height, width))


def _load(kind: SpectrumNetwork, arrays: dict[str, NDArray[Any]], record: Record) -> FittedNetworks:
    """What `FittedNetworks.arrays` described."""
    settings: Any = settings_from(kind.settings, json.loads(str(arrays["settings"])), kind.name)
    networks = [under(f"receiver{r}", arrays) for r in range(len(record.receivers))]
    height, width = (int(side) for side in arrays["shape"])
    return FittedNetworks(kind, settings, Coordinates.load(under("frame", arrays)), networks, (height, width))
