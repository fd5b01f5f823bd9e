"""Networks that make a receiver's spectra from the transmitter's position, one network for each receiver."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from ...backend.device import to_float, to_tensor
from ...core import Prediction, Split
from ...core.stored import NOT_STORED
from ...tasks import TASKS
from ...tasks.losses import ssim
from ...training.config import unused_of_loop, validates
from ...training.session import FitSession
from ..model import Arrays, Fitted, Inputs, Model, Problem, known_positions, received_rows, slices
from .layers import Coordinates
from .training import Network, train_network

SPECTRUM = TASKS["spectrum"]


@dataclass(frozen=True)
class NetworkRows:
    """Rows that a receiver's network learns from, and after them those that choose the number of steps."""

    receiver: str
    spectra: NDArray[np.float32]  # greys [n, height, width]
    where: Any  # features of the transmitters [features, n]
    train: int  # number of rows that train while the others choose


@dataclass(eq=False)
class FittedNetworks(Fitted):
    """Fitted networks: weights of a generator for each receiver, of spectra of ``shape`` (height, width)."""

    model: SpectrumNetwork = field(metadata=NOT_STORED)
    problem: Problem = field(metadata=NOT_STORED)
    coordinates: Coordinates
    weights: list[Arrays]
    shape: tuple[int, int]

    def __post_init__(self) -> None:
        initial = self.model.generator_class(self.problem.settings, self.shape, np.random.default_rng(0))
        self.generators = [initial.on_device(weights) for weights in self.weights]

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Spectra [m, height, width], float32."""
        s, out = self.problem.settings, np.empty((len(inputs), *self.shape), np.float32)
        for part in slices(len(inputs), self.model.at_once):
            where = self.coordinates.features(inputs.tx_pos_m[part], s.octaves, s.scale_m)
            with dr.suspend_grad():
                out[part] = self.generators[receiver].spectra(where).numpy().reshape(-1, *self.shape)
        return Prediction(out)


class SpectrumNetwork(Model):
    """A model with a network for each receiver."""

    tasks, fitted = ("spectrum",), FittedNetworks
    uplink, headings = "optional", True
    generator: str  # attribute of the trained network that makes spectra; no other part is stored
    # Its class: ``generator_class(settings, (height, width), rng)``. The method ``spectra`` makes greys [m * height *
    # width], a flat array, from features of positions [features, m]
    generator_class: Any
    at_once: int  # spectra that are predicted together, which bounds the memory

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings of the training loop that choose by validation rows, where there are none."""
        return unused_of_loop(problem.settings, validates(splits))

    @abstractmethod
    def network(self, rows: NetworkRows, settings: Any, rng: np.random.Generator) -> Network:
        """Training of a network on a receiver's rows; ``settings`` have ``octaves`` and ``scale_m``."""

    def trained_on(self, rows: NetworkRows, module: Any, loss: Any, data: Any, draw: Any) -> Network:
        """Training of a network on rows, scored by the median structural similarity of those that choose."""
        count = len(rows.spectra) - rows.train

        def score(module: Any) -> float:
            asked, truth = to_tensor(rows.where.numpy()[:, rows.train :]), to_float(rows.spectra[rows.train :])
            with dr.suspend_grad():
                predicted = getattr(module, self.generator).spectra(asked)
            return float(np.median(ssim(predicted, truth, count, *rows.spectra.shape[1:]).numpy()))

        samples = [np.arange(rows.train)], [np.arange(len(rows.spectra))], score if count else None
        name = f"{self.name} {rows.receiver}"
        return Network(name, module, loss, data, draw, *samples, SPECTRUM.label, SPECTRUM.higher_is_better)

    def fit(self, problem: Problem, split: Split, session: FitSession) -> FittedNetworks:
        """Train the networks of all receivers in turn (InputError: unknown positions, or fewer than two rows)."""
        record, settings, seed = problem.record, problem.settings, problem.seed
        coordinates = Coordinates.of(known_positions(record, split.all_train, self.name))
        weights = []
        for r, receiver in enumerate(record.receivers):
            train, validation = received_rows(record, split, r, self.name)
            all_train = np.concatenate([train, validation])
            where = coordinates.features(record.tx_pos_m[all_train], settings.octaves, settings.scale_m)
            rows = NetworkRows(
                receiver.name, np.asarray(record.observation[r, all_train], np.float32), where, len(train)
            )
            network = self.network(rows, settings, np.random.default_rng([seed, r]))
            trained = train_network(network, settings, (seed, r), session)[0]
            weights.append(getattr(trained, self.generator).arrays())
        height, width = record.observation.shape[-2:]
        return FittedNetworks(self, problem, coordinates, weights, (height, width))
