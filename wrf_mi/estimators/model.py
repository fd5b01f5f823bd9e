"""Base class of models, the problem that they are fitted to, inputs of predictions, and a fitted model."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..core import AntennaOptions, InputError, Prediction, Receiver, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.settings import changed, with_settings
from ..core.stored import Arrays as Arrays
from ..core.stored import from_arrays, to_arrays
from ..core.types import Inputs as Inputs
from ..core.types import IntArray
from ..parallel import Scheduler
from ..receivers.spreads import PathStatistics
from ..training.session import FitSession

Kind = TypeVar("Kind")
UNUSED_HEADING = "its model does not know how the transmitter is turned; omit heading_rad"
UNUSED_UPLINK = "its model does not predict from the uplink; omit uplink"


def inputs_of(record: Record, rows: IntArray) -> Inputs:
    """Inputs of some rows of a record."""
    return record.inputs(rows)


@dataclass
class Problem:
    """Data, scene and settings that a model is fitted to, and loaded with."""

    dataset: str | Path | Record  #: name, folder, or a loaded record
    settings: Any  #: settings of the model's class
    seed: int = 0  #: seed of split and fit
    scene: str | None = None  #: name, scene folder, Mitsuba XML or mesh, or None
    material: str | None = None  #: material of a bare mesh, or None
    antennas: AntennaOptions = AS_STATED  #: patterns and polarisations in place of those of the data
    operator: bool = True  #: learned fields predict by operator where they can, see `wrf_mi.training.predictor`
    left_out: tuple[str, ...] = ()  #: names of receivers that are left out of the data, as if they had not been there
    #: dotted names of the settings that the user stated; None: those that differ from the defaults of their class
    stated: frozenset[str] | None = None
    #: what `Model.check` computed that the fit after it takes
    checked: list[Any] = field(default_factory=list, repr=False, compare=False)
    #: what `wrf_mi.estimators.held_out.hold_out_once` has held out; problems that differ in scene or settings share it
    hold_outs: list[Any] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def record(self) -> Record:
        """The data with the stated antennas and without the receivers that are left out, read on first access.

        Raises:
            InputError: they cannot be read.
        """
        from ..synthetic import load_record

        record = self.dataset if isinstance(self.dataset, Record) else load_record(self.dataset)
        if self.left_out:
            names = [receiver.name for receiver in record.receivers]
            record = record.at_receivers([k for k, name in enumerate(names) if name not in self.left_out])
        return record.with_antennas(self.antennas)

    @property
    def stated_settings(self) -> frozenset[str]:
        """Dotted names of the settings that hold as they are: no search or likelihood may change them."""
        return changed(self.settings) if self.stated is None else self.stated

    @cached_property
    def opened_scene(self) -> Any | None:
        """The scene (``sionna.rt.Scene``) at the record's carrier, or the middle one of its rows, or None.

        Raises:
            InputError: it cannot be opened, or the carrier is unknown.
        """
        from ..tasks.conditions import scene_carrier

        return None if self.scene is None else self.open_scene(scene_carrier(self.record))

    def open_scene(self, frequency_hz: float) -> Any | None:
        """The scene at another frequency, Hz, or None (InputError: it cannot be opened)."""
        from ..tracing import open_scene  # the tracer is imported where there is a scene

        return None if self.scene is None else open_scene(self.scene, frequency_hz, material=self.material)

    def seen(self, split: Split) -> Problem:
        """The problem with what a fit to a split may see (`wrf_mi.core.Record.seen`)."""
        if not split.held_receivers:
            return self
        return replace(self, dataset=self.record.seen(split), antennas=AS_STATED)

    def rows(self, split: Split) -> IntArray:
        """Rows that a fit may use."""
        return split.all_train


@dataclass(frozen=True)
class Session(FitSession):
    """A session of a run."""

    folder: Path
    run: Path
    scheduler: Scheduler | None = None  #: scheduler of parts of the work; None: this process
    show_progress: bool = False  #: show bars on standard error where the tracer takes time


@dataclass(frozen=True)
class HeldOutPrediction(Prediction):
    """Predictions of held-out observations, and of all pairs of `HeldOut.every`; None: of no pairs."""

    every: Prediction | None = None


@dataclass(frozen=True)
class Decomposition:
    """A prediction for m transmitters and what it is made of."""

    prediction: Prediction  #: the prediction
    #: what the traced paths of the scene alone predict, [m, ...] as observations, or, of spectra, as magnitudes in a
    #: common unit of both components; NaN where they are not used. None: the model has one component
    traced: NDArray[Any] | None = None
    learned: NDArray[Any] | None = None  #: what the Gaussians alone predict; None without a scene
    paths: PathStatistics | None = None  #: statistics of the traced paths; None: the model traces none


PredictAll = Callable[[Inputs], NDArray[Any]]  # Observations of all receivers [n_rx, m, ...] for inputs [m]


class Fitted(ABC):
    """A fitted model."""

    #: duration of the fit over all sittings; None: that of the last call of `Model.fit`
    train_seconds: float | None = None
    #: receivers whose observations it predicts; None: those of the record
    receivers: tuple[Receiver, ...] | None = None
    uses_heading: bool | None = None  #: whether `predict` takes headings; None: as `Model.headings`
    #: carriers of the rows that it was fitted to, Hz, none for a single one; None: those of the record
    carriers_hz: FloatArray | None = None
    #: whether predictions may trace paths or evaluate Gaussians, of one receiver at a time; False: NumPy does it all
    traces: bool = True
    #: standard deviation in dB of the offset of another run or device than those of the data; None: they tell none
    run_sd_db: float | None = None
    #: of a fit that chose by held-out rows, not stored: predictions of `wrf_mi.training.selection.HeldOut` without them
    unseen: HeldOutPrediction | None = None
    options: Sequence[Mapping[str, Any]] = ()  #: of such a fit, reports of what it chose from

    @abstractmethod
    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Observations of the receiver of that index, [m, ...] as in `wrf_mi.core.Record`.

        Raises:
            InputError: inputs that it cannot predict from.
        """

    def with_reception(self, prediction: Prediction, inputs: Inputs, receiver: int) -> Prediction:
        """Strengths [m] with their probability of reception; as they are if the model states none."""
        return prediction

    def predict_mean(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The mean of `predict`, for callers that need no standard deviations."""
        return self.predict(inputs, receiver).mean

    def decompose(self, inputs: Inputs, receiver: int, std: bool = True) -> Decomposition:
        """`predict`, with both components and the paths of a model that has them; ``std``: with standard deviations."""
        return Decomposition(self.predict(inputs, receiver) if std else Prediction(self.predict_mean(inputs, receiver)))

    @property
    def depends_on_heading(self) -> bool:
        """Whether predictions depend on the heading of the transmitter."""
        return bool(self.uses_heading)

    def arrays(self) -> Arrays:
        """All that `Model.load` needs: fields of a dataclass (`wrf_mi.core.stored`); no key begins with ``run/``."""
        return to_arrays(self)

    def predict_rows(self, rows: IntArray, receiver: int) -> Prediction | None:
        """Stored predictions for rows of the record; None: `predict` makes them."""
        return None

    def in_scene(self, scene: str) -> Fitted:
        """The model in an edited copy of its scene (`wrf_mi.scene.edit`), without a new fit.

        Raises:
            InputError: it does not predict from the paths of a scene, or not of this one.
        """
        raise InputError("its predictions use no scene, and do not change with one; trace the edited scene")

    def tracing_once(self) -> Fitted:
        """The model as a copy that traces each position once, for all receivers, and keeps it as long as the copy.

        For predictions of all receivers in turn, and for refits, which share what the copy traces.
        """
        return self

    def refit(self, record: Record, rows: IntArray) -> Fitted | None:
        """The model given some of its training rows, with scene, hyperparameters and weights as fitted to all of them.

        None: its parameters are the fit, which has to be made anew.
        """
        return None

    def by_stage(self, split: Split) -> dict[str, PredictAll]:
        """Predictions by the stages up to each but the last, for a fit in stages (entry ``stages`` of `facts`)."""
        return {}

    def facts(self) -> dict[str, Any]:
        """Further entries of ``metrics.json``."""
        return {}


class Model(ABC):
    """A model as the registry, help, descriptions, tables and checks know it; a subclass is one file.

    One line in `wrf_mi.models` registers it; a model of another package is an instance that an entry point of the group
    ``wrf_mi.models`` names.

    The mean of the training rows as a model; `wrf_mi.models.register` makes it known to `wrf_mi.train`:

    >>> @dataclass
    ... class FittedMean(Fitted):
    ...     mean: FloatArray
    ...
    ...     def predict(self, inputs, receiver):
    ...         return Prediction(np.full(len(inputs), self.mean[receiver]))
    >>> @dataclass(frozen=True)
    ... class NoSettings:
    ...     pass
    >>> class Mean(Model):
    ...     name, source, settings, tasks = "mean", "mean of the training rows", NoSettings, ("rssi",)
    ...     fitted = FittedMean
    ...
    ...     def fit(self, problem, split, session):
    ...         return FittedMean(np.nanmean(problem.record.observation[:, problem.rows(split)], axis=1))
    >>> Mean().serves("rssi"), Mean().serves("spectrum")
    (True, False)
    """

    name: str  #: name as in ``wrf-mi train --model``
    source: str  #: publication
    settings: type  #: frozen dataclass of its settings, all with defaults
    #: dataclass of its fits, which `load` makes of stored fields
    fitted: type[Fitted] = Fitted  # type: ignore[type-abstract]
    tasks: tuple[str, ...] | None = None  #: tasks that it serves; None: all
    summary: str = ""  #: the model in a few words for readers of a page; "": its source
    scene_summary: str = ", trained jointly with the paths of the scene"  #: the same with a scene, after ``summary``
    scene: Literal["none", "optional", "required"] = "none"  #: whether it takes a scene
    uses_antennas: bool = True  #: whether patterns and polarisations of antennas count in that scene
    several_carriers: bool = False  #: whether it serves rows of several carriers (`wrf_mi.core.Record.carriers_hz`)
    uplink: Literal["none", "optional", "required"] = "none"  #: whether it predicts from the uplink
    headings: bool = False  #: whether it may predict from the transmitter's heading
    #: whether it predicts what receivers observe that it was not trained on, in a split that holds out receivers
    new_receivers: bool = False
    complete: bool = False  #: whether it needs every receiver's observation of every training row
    #: names, without prefixes that end in ``/``, of arrays of `Fitted.arrays` that may hold NaN or infinity; a run with
    #: such values in another array is refused
    gaps: tuple[str, ...] = ()
    #: arguments of `wrf_mi.train` that are also settings of the model: ``model``, ``seed``, ``deterministic``,
    #: ``receiver`` or ``evaluation``
    train_arguments: tuple[str, ...] = ()
    defaults: tuple[str, ...] = ()  #: ``key=value`` that differ from the defaults of ``settings``
    presets: Mapping[str, tuple[str, ...]] = MappingProxyType({})  #: named settings, ``key=value``

    @abstractmethod
    def fit(self, problem: Problem, split: Split, session: Session) -> Fitted:
        """Fit to the rows ``problem.rows(split)`` alone, of which ``split.validation`` may choose settings.

        Training step by step keeps a checkpoint in ``session.folder`` and continues from it; all other fits call
        ``session.progress``.
        """

    def load(self, arrays: Arrays, problem: Problem, folder: Path) -> Fitted:
        """The model that `Fitted.arrays` described; ``folder`` is that of its fit.

        Fields that are not stored are ``model`` (this object), ``problem`` and ``folder``.
        """
        return from_arrays(self.fitted, arrays, model=self, problem=problem, folder=folder)

    def check(self, problem: Problem, splits: Sequence[Split]) -> None:  # noqa: B027 - most models refuse nothing
        """Refuse what a fit would, before anything is written.

        Raises:
            InputError: settings, data or scene that it cannot be fitted to.
        """

    def unused_settings(self, problem: Problem, splits: Sequence[Split]) -> Mapping[str, str]:
        """Settings that change nothing in a fit to these data with the problem's other settings, and why.

        `wrf_mi.train` refuses them where they are stated (`check_stated`). A name stands for all settings below it:
        ``traced`` for ``traced.depth``, too.
        """
        return {}

    def prepare(self, problem: Problem, splits: Sequence[Split], session: Session) -> Any:
        """Settings without open choices; called before the first fit, and again when an interrupted fit is resumed."""
        return problem.settings

    def serving(self, task: str, with_scene: bool) -> Model:
        """The model of the same name for data of a task that it serves, with or without a scene."""
        return self

    def settings_by_data(self) -> Mapping[str, type]:
        """Classes of settings by the data that they are for, in words; "": all data."""
        return {"": self.settings}

    def pools_receivers(self, problem: Problem) -> bool:
        """Whether it predicts signal strengths of receivers with few training rows, or none, from the others."""
        return False

    def selects(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Whether its fits choose by held-out rows and leave their predictions (`Fitted.unseen`)."""
        return False

    def uses_places(self, problem: Problem, splits: Sequence[Split]) -> bool:
        """Whether its fits use positions of receivers; else those that nobody surveyed are not estimated."""
        return True

    def serves(self, task: str) -> bool:
        """Whether it serves a task."""
        return self.tasks is None or task in self.tasks

    def described(self, with_scene: bool) -> str:
        """The model in a few words, with or without a scene."""
        return (self.summary or self.source) + (self.scene_summary if with_scene else "")


def default_settings(model: Model, settings: Iterable[str], arguments: Mapping[str, Any]) -> Any:
    """Settings of a model, as `Model.serving` gives it, with ``key=value`` applied after its defaults.

    ``arguments`` are those of `wrf_mi.train`, some of which are settings, too (`Model.train_arguments`).
    """
    setting_arguments = {key: arguments[key] for key in model.train_arguments if arguments.get(key) is not None}
    return with_settings(model.settings(**setting_arguments), [*model.defaults, *settings])


def received_rows(record: Record, split: Split, receiver: int, name: str) -> tuple[IntArray, IntArray]:
    """Rows that a receiver received: those that train, and those that choose settings; without the former these train.

    Raises:
        InputError: fewer than two rows.
    """
    received = np.isfinite(record.observation[receiver]).reshape(len(record), -1).all(axis=1)
    train, validation = (rows[received[rows]] for rows in (split.train, split.validation))
    count = len(train) + len(validation)
    if count < 2:
        who = record.receivers[receiver].name
        raise InputError(f"{record.name}: receiver {who} received {count} training row; {name} needs two at least")
    return (train, validation) if len(train) else (validation, train)


def known_positions(record: Record, rows: IntArray, name: str) -> FloatArray:
    """Positions of the transmitter in some rows [n, 3], metres (InputError: unknown positions)."""
    unknown = rows[~np.isfinite(record.tx_pos_m[rows]).all(axis=1)]
    if len(unknown):
        text = f"no position in row {unknown[0]}: positions are not known, from which {name} predicts"
        raise InputError(f"{record.name} has {text}; choose another model")
    return record.tx_pos_m[rows]


def slices(count: int, size: int) -> list[slice]:
    """Slices of ``size`` rows each, the last possibly of fewer, that cover so many rows."""
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]
