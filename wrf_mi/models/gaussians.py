"""The models of 3D Gaussians: ``wrf-gs``, ``wrf-gs+`` and ``factorised``, trained step by step."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baselines import gaussian_fields
from ..baselines.method import Inputs
from ..core import Antenna, Prediction, Receiver, Split, receiver_arrays, stored_receivers
from ..fit.checkpoint import CHECKPOINT, append_log, cut_log, read_checkpoint, write_checkpoint
from ..fit.config import PRESETS, TrainConfig
from ..fit.packed import pack_params, unpack_params
from ..fit.predictor import Predictor
from ..fit.schedule import plan
from ..fit.start import initial_gaussians
from ..fit.state import FitState
from ..fit.trainer import Progress, Trainer, make_field
from ..graph.graph import Field, Graph
from ..tasks import TASKS
from .model import Arrays, Fitted, Model, Problem, Session, model_of

SOURCE = "Wen, Tong, Hu, Lin and Zhang, 'Neural representation for wireless radiation field reconstruction' (WRF-GS+)"
PARAM = "param/"
"""Prefix of a parameter's array in ``model.npz``."""

Params = dict[str, NDArray[np.float32]]


class FittedField(Fitted):
    """Trained Gaussians, alone or with the paths of a scene.

    Attributes:
        config: settings of the training.
        params: parameters by name.
        field: the model, see `wrf_mi.field`.
    """

    def __init__(self, arrays: Arrays, config: TrainConfig, graph: Callable[..., Graph], predictor: Any) -> None:
        self._arrays, self._graph, self._made = arrays, graph, predictor
        self.config, self.field, self.receivers = config, make_field(config), stored_receivers(arrays)
        own = {key.removeprefix(PARAM): values for key, values in arrays.items() if key.startswith(PARAM)}
        self.params: Params = own or unpack_params(arrays)
        self.uses_heading = False

    @cached_property
    def predictor(self) -> Predictor:
        """``predictor(tx_pos_m, receiver)`` gives spectra [m, H, W]."""
        height, width = map(int, self._arrays["image_size"])
        graph = self._graph(self.field, self.receivers, (height, width))
        ends = self.field, self.params, self.receivers, height, width, self.config.skip
        made: Predictor = self._made(*ends, graph=graph)
        return made

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """See `Fitted`; greys [m, H, W]."""
        return Prediction(self.predictor(inputs.tx_pos_m, receiver))

    def arrays(self) -> Arrays:
        """See `Fitted`."""
        return self._arrays

    def facts(self) -> dict[str, Any]:
        """Steps of the training and number of Gaussians."""
        return {"steps": self.config.steps, "gaussians": int(self.params["position"].shape[1])}

    def packed(self, params: Params, precision: str) -> Arrays:
        """Arrays of a field with other parameters for the same receivers, see `wrf_mi.fit.packed`."""
        ends = {key: v for key, v in self._arrays.items() if not key.startswith((PARAM, "packed_"))}
        return ends | pack_params(params, precision)


def load(arrays: Arrays, problem: Problem, folder: Path) -> FittedField:
    """What `FittedField.arrays` described; operators are stored in the folder (`wrf_mi.fit.still`)."""
    config, hz = problem.settings, float(arrays["carrier_hz"])

    def graph(field: Field, receivers: Sequence[Receiver], size: tuple[int, int]) -> Graph:
        known, scene = (None, None) if np.isnan(hz) else (np.array([hz]), problem.open_scene(hz))
        antenna = Antenna(*map(str, arrays["tx_antenna"]))
        return Graph(field, receivers, size, config.receiver, known, scene, config.traced, antenna)

    return FittedField(arrays, config, graph, partial(Predictor, operator=problem.operator, store=folder))


def fit(problem: Problem, split: Split, session: Session) -> FittedField:
    """Train from the last checkpoint, or from the start, to the last step.

    Raises:
        Interrupted: stopped between two steps; the checkpoint is written.
        NumericsError: a value that is not finite.
    """
    folder, record, config = session.folder, problem.record, problem.settings
    stored = read_checkpoint(folder) if (folder / CHECKPOINT).exists() else None
    state = None if stored is None else FitState.from_arrays(stored)
    trainer = Trainer(record, split, config, state=state, scene=problem.opened_scene)
    trainer.seconds = 0.0 if stored is None else float(stored["seconds"])
    cut_log(folder, trainer.state.step)

    def heard(progress: Progress) -> None:
        append_log(folder, progress)
        session.listen(session.fold or "training", progress.step / config.steps, progress)

    if not trainer.run(heard, lambda: write_checkpoint(folder, trainer), session.stop):
        raise session.interrupted(f"after step {trainer.state.step} of {config.steps}")
    known = record.frequencies_hz
    arrays: Arrays = {
        **{f"{PARAM}{name}": values for name, values in trainer.state.mean_params().items()},
        "image_size": np.asarray([trainer.height, trainer.width]),
        "carrier_hz": np.asarray(np.nan if known is None else float(known[0])),
        "tx_antenna": np.asarray(astuple(record.tx_antenna)),
        **receiver_arrays(record.receivers),
    }
    fitted = load(arrays, problem, folder)
    fitted.train_seconds = trainer.seconds
    return fitted


def prepare(problem: Problem, splits: Sequence[Split], session: Session) -> TrainConfig:
    """Settings with number of steps, scale of transmitters and starting signals resolved."""
    known = np.concatenate([rows.all_train for rows in splits])
    config: TrainConfig = problem.settings
    return config.resolved(problem.record.tx_pos_m[known], problem.scene is not None)


def check(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse settings, files and scenes that a training would refuse."""
    record = problem.record
    assert problem.scene is None or problem.opened_scene is not None
    for rows in splits:
        config = problem.settings.resolved(record.tx_pos_m[rows.all_train], problem.scene is not None)
        make_field(config)
        plan(config, rows, len(record.receivers))
        initial_gaussians(config.initial, record, rows.train, np.random.default_rng([config.seed, 0]))


@cache
def _spectra(name: str) -> Model:
    return Model(
        name,
        ("spectrum",),
        TrainConfig,
        fit,
        load,
        SOURCE,
        scene="optional",
        complete=True,
        given=("model", "seed", "deterministic", "receiver"),
        presets=PRESETS,
        check=check,
        prepare=prepare,
    )


@cache
def _by_data(name: str, task: str, with_scene: bool) -> Model:
    """Which fit serves a task: spectra are trained here, signal strengths and channels as `gaussian_fields` does."""
    return _spectra(name) if TASKS[task].image else model_of(gaussian_fields.method_of(name))


def _entry(name: str) -> Model:
    settings = {"spectra": TrainConfig, "signal strengths and channels": gaussian_fields.GaussianSettings}
    tasks = ("spectrum", "rssi", "csi")
    return replace(_spectra(name), tasks=tasks, settings=settings, by_data=partial(_by_data, name))


WRF_GS, WRF_GS_PLUS = _entry("wrf-gs"), _entry("wrf-gs+")
FACTORISED = _spectra("factorised")
