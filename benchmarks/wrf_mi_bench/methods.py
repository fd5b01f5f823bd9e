"""Every way to predict a spectrum, made ready on one data set: what the Pareto plot of the benchmark compares.

A method is a name, a family and a function from a `Place` to a `Ready`. To have another one measured, append it to
`METHODS`.
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
from wrf_mi.models.physics.selection import kind_of
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
"""From transmitter positions [m, 3] in metres to spectra [m, height, width]."""

STEPS = 3000
"""Of every learned field: a third of the default schedule, so that all of them together take minutes."""


@dataclass(frozen=True)
class Place:
    """What methods are given.

    Attributes:
        record: spectra of one receiver.
        scene: mesh of the place.
        folder: for runs; a finished one with the same key (`wrf_mi.runs.fit_key`) is used again.
        rows: number of training rows; None: all.
        steps: of each learned field.
        seed: of subset and fits.
    """

    record: Record
    scene: Path
    folder: Path
    rows: int | None = None
    steps: int = STEPS
    seed: int = 0

    @property
    def split(self) -> Split:
        """Rows that train and rows that score."""
        return make_splits(self.record, "official", self.seed, self.rows)[0]


@dataclass(frozen=True)
class FittedMethod:
    """A method that can predict.

    Attributes:
        predict: the method.
        stored_mb: what has to be kept for it, MB.
        train_seconds: that making it ready took.
        context: what ``predict`` runs in where it is timed, see `wrf_mi.runs.timing.Within`; None: nothing.
    """

    predict: Predict
    stored_mb: float
    train_seconds: float = 0.0
    context: Callable[[], AbstractContextManager[Any]] | None = None

    def call(self, tx_pos_m: FloatArray) -> Call:
        """A prediction to be timed."""
        own = partial(self.predict, tx_pos_m)
        return own if self.context is None else Within(own, self.context)


@dataclass(frozen=True)
class Method:
    """One point of the plot.

    Attributes:
        name: for tables and labels.
        family: methods of one family differ by a budget; they share a colour and a line.
        make: makes it ready.
        batches: whether it has something to gain from many transmitters at once.
    """

    name: str
    family: str
    make: Callable[[Place], FittedMethod]
    batches: bool = True


def _megabytes(arrays: Sequence[Any]) -> float:
    return sum(np.asarray(array).nbytes for array in arrays) / 1e6


def _blend(place: Place) -> FittedMethod:
    rows, record = place.split.all_train, place.record
    fitted = InverseDistance().fit(record.tx_pos_m[rows], record.observation[0][rows])
    # Spectra are kept as the instrument writes them, 8 bits a pixel.
    return FittedMethod(fitted.predict, record.observation[0][rows].size / 1e6)


def _kriging(place: Place) -> FittedMethod:
    from .box_room import LENGTH_M, NOISE

    rows, record = place.split.all_train, place.record
    fitted = Kriging(LENGTH_M, NOISE).fit(record.tx_pos_m[rows], record.observation[0][rows])
    return FittedMethod(fitted.predict, _megabytes([record.observation[0][rows].astype(np.float32)]))


def field_run(place: Place, model: str, gaussians: int) -> Run:
    """A field of a fixed number of Gaussians, trained with the place's short schedule or used again."""
    settings = [f"model={model}", f"steps={place.steps}", f"initial.gaussians={gaussians}"]
    settings += ["holdout_steps_fraction=0", "density.every=0", f"validate_every={place.steps}"]
    config = with_settings(TrainConfig(seed=place.seed), settings)
    folder = place.folder / f"{model}-{gaussians}-{fit_key(place.record, place.split, config)}"
    fit_once(folder, lambda: train(place.record, folder, model, settings=config, n_train=place.rows))
    return Run(folder, place.record)


def _field(place: Place, model: str, gaussians: int) -> FittedMethod:
    run = field_run(place, model, gaussians)
    return FittedMethod(run.predictor(), _megabytes(list(run.field.params.values())), run.metrics["train_seconds"])


def _stock(place: Place, gaussians: int) -> FittedMethod:
    """The same WRF-GS+, its Gaussians computed by us and rendered by Mitsuba's own integrator."""
    run = field_run(place, "wrf-gs+", gaussians)
    predictor = run.predictor()
    height, width = place.record.observation.shape[-2:]
    renderer = StockRenderer(place.record.receivers[0], height, width)

    def predict(tx_pos_m: FloatArray) -> NDArray[Any]:
        with rgb_variant():
            return np.stack([np.abs(renderer.field(predictor.gaussians(one))) for one in np.asarray(tx_pos_m)[:, None]])

    return FittedMethod(predict, _megabytes(list(run.field.params.values())), run.metrics["train_seconds"], rgb_variant)


def _physics(place: Place) -> FittedMethod:
    settings = kind_of(place.record, True).settings()
    key = fit_key(place.record, place.split, scene_files(place.scene), settings, place.seed)
    folder = place.folder / f"physics-{key}"
    asked: dict[str, Any] = {"scene": place.scene, "n_train": place.rows, "seed": place.seed}
    fit_once(folder, lambda: train(place.record, folder, "physics", **asked))
    run = Run(folder, place.record)
    size = (folder / FITTED).stat().st_size / 1e6
    return FittedMethod(lambda tx_pos_m: run.predict(tx_pos_m).mean, size, run.metrics["train_seconds"])


def _tracer(place: Place, rays: int, depth: int) -> FittedMethod:
    """The mesh as given, walls let through; what rays from the array find is kept from one prediction to the next."""
    options = TraceOptions(transmission=True, max_depth=depth, rays=rays)
    tracer = RayTracer(place.scene, instrument_of(place.record), options)
    size = sum(one.stat().st_size for one in Path(place.scene).rglob("*.ply")) / 1e6
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
"""All that is measured; numbers after a field's name are Gaussians, 2^17 rays the tracer's default."""
