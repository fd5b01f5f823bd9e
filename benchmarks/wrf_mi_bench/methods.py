"""Methods of predicting spectra that the Pareto plot compares.

A method is a name, a family and a function from a `MethodInput` to a `FittedMethod`. To compare another method, append
it to `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wrf_mi.core import Record, Split
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.settings import with_settings
from wrf_mi.datasets import make_splits
from wrf_mi.models.interpolation.idw import InverseDistance
from wrf_mi.models.interpolation.kriging import Kriging
from wrf_mi.models.physics.spectrum_model import SpectrumSettings
from wrf_mi.runs.api import Run, train
from wrf_mi.runs.fit_key import fit_key, fit_once, scene_files
from wrf_mi.runs.folder import FITTED
from wrf_mi.runs.timing import Call, Within
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import TrainConfig

from .stock import StockRenderer, rgb_variant

Predict = Callable[[FloatArray], NDArray[Any]]
"""Function from transmitter positions [m, 3] in metres to spectra [m, height, width]."""

STEPS = 3000
"""Training steps of every learned field: a third of the default, so that all fits take minutes."""


@dataclass(frozen=True)
class MethodInput:
    """Data and schedule of the methods.

    Attributes:
        record: spectra of one receiver.
        scene: mesh of the scene.
        folder: folder of runs; a finished run with the same key (`wrf_mi.runs.fit_key`) is used again.
        rows: number of training rows; None: all.
        steps: training steps of each learned field.
        seed: seed of the subset and of fits.
    """

    record: Record
    scene: Path
    folder: Path
    rows: int | None = None
    steps: int = STEPS
    seed: int = 0

    @property
    def split(self) -> Split:
        """Training and test rows."""
        return make_splits(self.record, "official", self.seed, self.rows)[0]


@dataclass(frozen=True)
class FittedMethod:
    """A fitted method.

    Attributes:
        predict: predictions.
        stored_mb: size of its stored parameters, MB.
        train_seconds: training time.
        context: context of timed predictions, see `wrf_mi.runs.timing.Within`; None: none.
    """

    predict: Predict
    stored_mb: float
    train_seconds: float = 0.0
    context: Callable[[], AbstractContextManager[Any]] | None = None

    def call(self, tx_pos_m: FloatArray) -> Call:
        """Prediction as a timed call."""
        call = partial(self.predict, tx_pos_m)
        return call if self.context is None else Within(call, self.context)


@dataclass(frozen=True)
class Method:
    """A point of the plot: name, family (colour and line), function that fits it, and whether it predicts batches."""

    name: str
    family: str
    make: Callable[[MethodInput], FittedMethod]
    batches: bool = True


def _megabytes(arrays: Sequence[Any]) -> float:
    return sum(np.asarray(array).nbytes for array in arrays) / 1e6


def _blend(given: MethodInput) -> FittedMethod:
    rows, record = given.split.all_train, given.record
    fitted = InverseDistance().fit(record.tx_pos_m[rows], record.observation[0][rows])
    # Spectra are kept as the instrument writes them, 8 bits a pixel.
    return FittedMethod(fitted.predict, record.observation[0][rows].size / 1e6)


def _kriging(given: MethodInput) -> FittedMethod:
    from .physics_room import LENGTH_M, NOISE

    rows, record = given.split.all_train, given.record
    fitted = Kriging(LENGTH_M, NOISE).fit(record.tx_pos_m[rows], record.observation[0][rows])
    return FittedMethod(fitted.predict, _megabytes([record.observation[0][rows].astype(np.float32)]))


def field_run(given: MethodInput, model: str, gaussians: int) -> Run:
    """Run of a field with a fixed number of Gaussians, trained or used again."""
    settings = [f"model={model}", f"steps={given.steps}", f"initial.gaussians={gaussians}"]
    settings += ["holdout_steps_fraction=0", "density.every=0", f"validate_every={given.steps}"]
    config = with_settings(TrainConfig(seed=given.seed), settings)
    folder = given.folder / f"{model}-{gaussians}-{fit_key(given.record, given.split, config)}"
    fit_once(folder, lambda: train(given.record, folder, model, settings=config, n_train=given.rows))
    return Run(folder, given.record)


def _field(given: MethodInput, model: str, gaussians: int) -> FittedMethod:
    run = field_run(given, model, gaussians)
    return FittedMethod(run.predictor(), _megabytes(list(run.field.params.values())), run.metrics["train_seconds"])


def _stock(given: MethodInput, gaussians: int) -> FittedMethod:
    """WRF-GS+ whose Gaussians are rendered by Mitsuba's ``volprim_rf_basic``."""
    run = field_run(given, "wrf-gs+", gaussians)
    predictor = run.predictor()
    height, width = given.record.observation.shape[-2:]
    renderer = StockRenderer(given.record.receivers[0], height, width)

    def predict(tx_pos_m: FloatArray) -> NDArray[Any]:
        with rgb_variant():
            return np.stack([np.abs(renderer.field(predictor.gaussians(one))) for one in np.asarray(tx_pos_m)[:, None]])

    return FittedMethod(predict, _megabytes(list(run.field.params.values())), run.metrics["train_seconds"], rgb_variant)


def _physics(given: MethodInput) -> FittedMethod:
    key = fit_key(given.record, given.split, scene_files(given.scene), SpectrumSettings(), given.seed)
    folder = given.folder / f"physics-{key}"
    asked: dict[str, Any] = {"scene": given.scene, "n_train": given.rows, "seed": given.seed}
    fit_once(folder, lambda: train(given.record, folder, "physics", **asked))
    run = Run(folder, given.record)
    size = (folder / FITTED).stat().st_size / 1e6
    return FittedMethod(lambda tx_pos_m: run.predict(tx_pos_m).mean, size, run.metrics["train_seconds"])


def _tracer(given: MethodInput, rays: int, depth: int) -> FittedMethod:
    """Ray tracing on the given mesh with transmission; rays of the array are kept between predictions."""
    options = TraceOptions(transmission=True, max_depth=depth, rays=rays)
    tracer = RayTracer(given.scene, instrument_of(given.record), options)
    size = sum(one.stat().st_size for one in Path(given.scene).rglob("*.ply")) / 1e6
    return FittedMethod(lambda tx_pos_m: tracer(tx_pos_m)[0], size)


def _tracer_method(rays_log2: int, depth: int) -> Method:
    name = f"tracer, depth {depth}, 2^{rays_log2} rays"
    return Method(name, "ray tracing", partial(_tracer, rays=1 << rays_log2, depth=depth))


def _field_method(model: str, gaussians: int) -> Method:
    name = {"wrf-gs": "WRF-GS", "wrf-gs+": "WRF-GS+"}.get(model, model)
    return Method(f"{name}, {gaussians}", name, partial(_field, model=model, gaussians=gaussians))


METHODS: list[Method] = [
    Method("blend", "interpolation", _blend),
    Method("kriging", "interpolation", _kriging),
    *(_field_method("wrf-gs", count) for count in (90, 270)),
    *(_field_method("factorised", count) for count in (270, 1000)),
    *(_field_method("wrf-gs+", count) for count in (90, 270, 1000)),
    Method("volprim_rf_basic, WRF-GS+, 270", "stock integrator", partial(_stock, gaussians=270), batches=False),
    *(_tracer_method(10, depth) for depth in (1, 2, 3)),
    *(_tracer_method(rays, 4) for rays in (8, 17)),
    Method("physics", "physics", _physics),
]
"""All methods; the numbers after a field's name count Gaussians."""
