"""Networks that make a receiver's spectra from the transmitter's position, one network for each receiver."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_float, to_tensor
from ..core import Record, Split
from ..core.types import IntArray
from ..field.network import Weights
from ..loss.ssim import ssim
from .coordinates import Coordinates
from .method import Inputs, Listen, Method
from .training import Training, epochs, keyed, positions, under, usable_rows

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

    def draw(self, everything: bool, batch: int, rng: np.random.Generator) -> Iterator[IntArray]:
        """Batches of rows without end: of all of them, or of those that train."""
        return epochs(np.arange(len(self.spectra) if everything else self.train), batch, rng)

    def score(self, generate: Generate, settings: Any) -> Callable[[Mapping[str, Any]], float] | None:
        """1 - the median structural similarity of the rows that choose; None without such rows."""
        count = len(self.spectra) - self.train
        if not count:
            return None
        asked, truth = to_tensor(self.where.numpy()[:, self.train :]), to_float(self.spectra[self.train :])

        def of(params: Mapping[str, Any]) -> float:
            with dr.suspend_grad():
                predicted = generate(params, settings, asked, self.shape)
            return 1 - float(np.median(ssim(predicted, truth, count, *self.shape).numpy()))

        return of


@dataclass(frozen=True)
class SpectrumNetwork:
    """A kind of network.

    Attributes:
        name: of the method.
        settings: class of its settings, which have ``octaves``, ``scale_m`` and ``training``.
        fit: weights of a receiver's network from its rows, settings, a generator of random numbers and who listens.
        generate: spectra of positions by such weights.
        at_once: spectra that are predicted together, which bounds the memory.
        source: who it is by.
    """

    name: str
    settings: type
    fit: Callable[[ReceiverRows, Any, np.random.Generator, Listen], Weights]
    generate: Generate
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
    kind: SpectrumNetwork, record: Record, split: Split, settings: Any, seed: int, listen: Listen
) -> FittedNetworks:
    """Fit a network to each receiver.

    Raises:
        InputError: positions that the data do not tell, or a receiver without training rows.
    """
    coordinates = Coordinates.of(positions(record, kind.name)[split.all_train])
    networks, count = [], len(record.receivers)
    for r, receiver in enumerate(record.receivers):
        train, validation = usable_rows(record, split, r, kind.name)
        known = np.concatenate([train, validation])
        where = coordinates.features(record.tx_pos_m[known], settings.octaves, settings.scale_m)
        own = ReceiverRows(receiver.name, np.asarray(record.observation[r, known], np.float32), where, len(train))

        def part(what: str, share: float, first: int = r) -> None:
            listen(what, (first + share) / count)

        networks.append(kind.fit(own, settings, np.random.default_rng([seed, r]), part))
    height, width = (int(side) for side in record.observation.shape[-2:])
    return FittedNetworks(kind, settings, coordinates, networks, (height, width))


def _load(kind: SpectrumNetwork, arrays: dict[str, NDArray[Any]], record: Record) -> FittedNetworks:
    """What `FittedNetworks.arrays` described."""
    plain = json.loads(str(arrays["settings"]))
    settings = kind.settings(**plain | {"training": Training(**plain["training"])})
    networks = [under(f"receiver{r}", arrays) for r in range(len(record.receivers))]
    height, width = (int(side) for side in arrays["shape"])
    return FittedNetworks(kind, settings, Coordinates.load(under("frame", arrays)), networks, (height, width))
