"""Networks that make a receiver's spectra from the transmitter's position, one network for each receiver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_float, to_tensor
from ...core import Prediction, Split
from ...tasks import TASKS
from ...tasks.losses import ssim
from ...training.session import FitSession
from ..model import (
    Arrays,
    Fitted,
    Inputs,
    Model,
    Problem,
    field_arrays,
    from_field_arrays,
    keyed,
    known_positions,
    received_rows,
    settings_array,
    stored_settings,
    under,
)
from .layers import Coordinates
from .training import Network, train_network

SPECTRUM = TASKS["spectrum"]


@dataclass(frozen=True)
class ReceiverRows:
    """Rows that a receiver's network learns from, and after them those that choose the number of steps.

    Attributes:
        receiver: name of the receiver.
        spectra: greys [n, height, width].
        where: features of the transmitters [features, n].
        train: number of rows that train while the others choose.
    """

    receiver: str
    spectra: NDArray[np.float32]
    where: Any
    train: int

    def network(self, kind: SpectrumNetwork, module: Any, loss: Any, data: Any, draw: Any) -> Network:
        """Training of a network on these rows, scored by the median structural similarity of those that choose."""
        count = len(self.spectra) - self.train

        def score(module: Any) -> float:
            asked, truth = to_tensor(self.where.numpy()[:, self.train :]), to_float(self.spectra[self.train :])
            with dr.suspend_grad():
                predicted = getattr(module, kind.generator).spectra(asked)
            return float(np.median(ssim(predicted, truth, count, *self.spectra.shape[1:]).numpy()))

        rows = [np.arange(self.train)], [np.arange(len(self.spectra))], score if count else None
        name = f"{kind.name} {self.receiver}"
        return Network(name, module, loss, data, draw, *rows, SPECTRUM.label, SPECTRUM.higher_is_better)


@dataclass(frozen=True)
class SpectrumNetwork:
    """A kind of network.

    Attributes:
        name: name of the method.
        settings: class of its settings, which have ``octaves`` and ``scale_m``.
        network: training of a network, from a receiver's rows, settings and a generator of random numbers.
        make: generator of spectra from settings, a spectrum's height and width, and random numbers; its method
            ``spectra`` makes greys [m * height * width], a flat array, from features of positions [features, m].
        generator: attribute of the trained network that is such a generator; no other part is stored.
        at_once: spectra that are predicted together, which bounds the memory.
        source: publication.
    """

    name: str
    settings: type
    network: Callable[[ReceiverRows, Any, np.random.Generator], Network]
    make: Callable[[Any, tuple[int, int], np.random.Generator], Any]
    generator: str
    at_once: int
    source: str

    def model(self) -> Model:
        """Entry of the registry."""
        how = partial(_fit, self), partial(_load, self), self.source
        return Model(self.name, ("spectrum",), self.settings, *how, uplink="optional", headings=True)


@dataclass(frozen=True)
class FittedNetworks(Fitted):
    """Fitted networks: a generator for each receiver, of spectra of ``shape`` (height, width)."""

    kind: SpectrumNetwork
    settings: Any
    coordinates: Coordinates
    generators: list[Any]
    shape: tuple[int, int]

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Spectra [m, height, width], float32."""
        s, out = self.settings, np.empty((len(inputs), *self.shape), np.float32)
        for first in range(0, len(inputs), self.kind.at_once):
            part = slice(first, first + self.kind.at_once)
            where = self.coordinates.features(inputs.tx_pos_m[part], s.octaves, s.scale_m)
            with dr.suspend_grad():
                out[part] = self.generators[receiver].spectra(where).numpy().reshape(-1, *self.shape)
        return Prediction(out)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Settings, frame and weights."""
        arrays = {"settings": settings_array(self.settings), "shape": np.asarray(self.shape)}
        arrays |= field_arrays(self.coordinates, "frame/")
        for r, generator in enumerate(self.generators):
            arrays |= keyed(f"receiver{r}/{self.kind.generator}.", generator.arrays())
        return arrays


def _fit(kind: SpectrumNetwork, problem: Problem, split: Split, session: FitSession) -> FittedNetworks:
    record, settings, seed = problem.record, problem.settings, problem.seed
    coordinates = Coordinates.of(known_positions(record, split.all_train, kind.name))
    generators = []
    for r, receiver in enumerate(record.receivers):
        train, validation = received_rows(record, split, r, kind.name)
        known = np.concatenate([train, validation])
        where = coordinates.features(record.tx_pos_m[known], settings.octaves, settings.scale_m)
        rows = ReceiverRows(receiver.name, np.asarray(record.observation[r, known], np.float32), where, len(train))
        network = kind.network(rows, settings, np.random.default_rng([seed, r]))
        generators.append(getattr(train_network(network, settings, (seed, r), session)[0], kind.generator))
    height, width = record.observation.shape[-2:]
    return FittedNetworks(kind, settings, coordinates, generators, (height, width))


def _load(kind: SpectrumNetwork, arrays: Arrays, problem: Problem, folder: Path) -> FittedNetworks:
    settings: Any = stored_settings(kind.settings, arrays, kind.name)
    height, width = (int(side) for side in arrays["shape"])
    made = kind.make(settings, (height, width), np.random.default_rng(0))
    generators = [
        made.on_device(under(f"receiver{r}/{kind.generator}.", arrays)) for r in range(len(problem.record.receivers))
    ]
    coordinates = from_field_arrays(Coordinates, arrays, "frame/")
    return FittedNetworks(kind, settings, coordinates, generators, (height, width))
