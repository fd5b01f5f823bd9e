"""Smaller fields from trained ones: fewer Gaussians, a smaller network, fewer bits a number."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..backend.device import to_tensor
from ..core import InputError, Record, Split
from ..gaussians import InitialGaussians
from ..gaussians.operator import removal
from ..gaussians.tiles import perception_plane
from .config import NetworkConfig, TrainConfig
from .fields import make_field
from .loop import Progress
from .packed import PRECISIONS
from .predictor import Predictor
from .state import FitState
from .step import device_pose
from .trainer import Trainer

Params = dict[str, NDArray[np.float32]]

SCORED = 64
"""Views, spread over the training rows, on which Gaussians are scored."""
COPIES = 4
"""Positions near each training row for distillation."""
NEAR_M = 0.2
"""Standard deviation of such a position from its row, metres: less than the distance between rows."""


@dataclass(frozen=True)
class Compression:
    """Settings of a compression.

    Attributes:
        budget: number of Gaussians to keep; 0: all.
        width: neurons a layer of a smaller network; 0: unchanged.
        layers: hidden layers of a smaller network; 0: unchanged.
        terms: terms of a factorised field (`wrf_mi.gaussians.fields`) that replaces the model, with the sizes
            above; 0: the model is kept.
        distil: steps in which a smaller network learns the larger network's spectra.
        fine_tune: final steps on the training rows.
        precision: precision of the stored numbers (`wrf_mi.training.packed`).
    """

    budget: int = 0
    width: int = 0
    layers: int = 0
    terms: int = 0
    distil: int = 6000
    fine_tune: int = 0
    precision: str = "half"

    def __post_init__(self) -> None:
        """Refuse invalid values.

        Raises:
            InputError: naming the setting.
        """
        for name in ("budget", "width", "layers", "terms", "distil", "fine_tune"):
            if getattr(self, name) < 0:
                raise InputError(f"{name.replace('_', '-')} {getattr(self, name)}: give 0 or more")
        if self.precision not in PRECISIONS:
            raise InputError(f"precision {self.precision!r}: unknown; choose from {', '.join(PRECISIONS)}")


def importance(config: TrainConfig, params: Mapping[str, Any], record: Record, split: Split) -> NDArray[np.float64]:
    """Mean |change| of a pixel over training views when a Gaussian is removed, [n].

    Each Gaussian is removed alone (`wrf_mi.gaussians.operator`), so a dark Gaussian that hides a strong one counts.
    """
    field, plane = make_field(config), perception_plane(*map(int, record.observation.shape[-2:]), mi.Float)
    tensors = {name: to_tensor(values) for name, values in params.items()}
    rows = split.all_train
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(SCORED, len(rows))).round().astype(int))]
    total = np.zeros(params["position"].shape[1])
    for receiver in record.receivers:
        pose = device_pose(receiver)
        for row in rows:
            gaussians = field.gaussians(tensors, to_tensor(record.tx_pos_m[row][:, None]))
            total += removal(gaussians, pose, plane)
    return total / (len(rows) * len(record.receivers) * plane.pixels)


def prune(params: Params, names: tuple[str, ...], score: NDArray[np.float64], budget: int) -> Params:
    """Parameters of the ``budget`` Gaussians with the largest score, in their old order; networks are unchanged."""
    kept = np.sort(np.argsort(-score, kind="stable")[:budget])
    return {name: values[:, kept] if name in names else values for name, values in params.items()}


def _exchanged(config: TrainConfig, params: Params, how: Compression) -> tuple[TrainConfig, Params]:
    """Settings and parameters with a new, untrained network of another size or kind."""
    network, model = config.network, config.model
    if how.terms and model != "factorised":
        # Sizes of another kind of network do not apply.
        network, model = NetworkConfig(), "factorised"
    network = replace(
        network,
        width=how.width or network.width,
        layers=how.layers or network.layers,
        terms=how.terms or network.terms,
    )
    changed = replace(config, model=model, network=network)
    # The starting values of a network depend on number and strength of the Gaussians only.
    centres = params["position"].T.astype(float)
    start = InitialGaussians(centres, np.ones(len(centres)), config.initial.opacity, config.initial.signal)
    fresh = make_field(changed).init(start, np.random.default_rng([config.seed, 3]))
    kept = {name for name in fresh if "." not in name and name in params and params[name].shape == fresh[name].shape}
    return changed, {name: params[name] if name in kept else fresh[name] for name in fresh}


def _taught(config: TrainConfig, params: Params, record: Record, split: Split) -> Record:
    """Predictions of the field at the training rows and near them, as a record."""
    known = record.tx_pos_m[split.all_train]
    near = np.repeat(known, COPIES, axis=0)
    near = near + np.random.default_rng([config.seed, 4]).normal(0, NEAR_M, near.shape)
    positions = np.concatenate([known, near])
    height, width = map(int, record.observation.shape[-2:])
    predict = Predictor(make_field(config), params, record.receivers, height, width)
    spectra = np.stack([predict(positions, r) for r in range(len(record.receivers))])
    return replace(
        record, tx_pos_m=positions, observation=spectra, official=None, folds=None, tx_heading_rad=None, runs=None
    )


def _fit(
    record: Record,
    rows: NDArray[Any],
    config: TrainConfig,
    params: Params,
    steps: int,
    on_progress: Any,
) -> Params:
    """Train given parameters for some steps on given rows, without density control."""
    nothing = np.empty(0, np.int64)
    density, optimiser = replace(config.density, every=0), config.optimiser
    optimiser = replace(optimiser, warm_up=min(optimiser.warm_up, max(1, steps // 10)))
    config = replace(config, steps=steps, holdout_steps_fraction=0.0, density=density, optimiser=optimiser)
    trainer = Trainer(record, Split("compress", config.seed, rows, nothing, nothing), config, state=FitState(params))
    trainer.run(on_progress)
    return trainer.state.mean_params()


def compress(
    config: TrainConfig,
    params: Params,
    record: Record,
    split: Split,
    how: Compression,
    on_progress: Callable[[str, int, Progress], None] = lambda stage, steps, progress: None,
) -> tuple[TrainConfig, Params]:
    """A smaller field from the settings and parameters of a trained one, by training and validation rows only.

    Args:
        config: settings of the trained field.
        params: its parameters.
        record: record of its fit.
        split: split of its fit.
        how: settings of the compression.
        on_progress: progress callback: stage, its number of steps, and the progress.

    Returns:
        Settings and parameters, still in single precision.

    Raises:
        InputError: a larger budget than there are Gaussians.
    """
    count, teacher = params["position"].shape[1], (config, params)
    if how.budget > count:
        raise InputError(f"budget {how.budget}: the run has {count} Gaussians; choose fewer")
    if how.budget:
        score = importance(config, params, record, split)
        params = prune(params, make_field(config).per_gaussian, score, how.budget)
    if how.width or how.layers or how.terms:  # the network is replaced
        config, params = _exchanged(config, params, how)
        if how.distil:
            taught = _taught(*teacher, record, split)
            rows = np.arange(len(taught.tx_pos_m))
            params = _fit(taught, rows, config, params, how.distil, lambda p: on_progress("distil", how.distil, p))
    if how.fine_tune:
        rows = split.all_train
        params = _fit(record, rows, config, params, how.fine_tune, lambda p: on_progress("fine-tune", how.fine_tune, p))
    return config, params
