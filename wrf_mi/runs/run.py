"""Run folder as a model that predicts."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import starmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core import InputError, Prediction, Receiver, Record
from ..core.angles import FloatArray
from ..core.carriers import FREQUENCY, carriers_text
from ..core.files import readable
from ..core.locks import alone_in_process
from ..core.memory import require_memory
from ..core.receivers import receiver_index
from ..datasets import load_split
from ..datasets.labelled import LabelledPrediction, ordered
from ..estimators.checks import check_inputs
from ..estimators.gaussian.model import FittedField
from ..estimators.model import UNUSED_HEADING, UNUSED_UPLINK
from ..estimators.own_readings import DeviceOffset, ForDevice, OwnReadings, checked_readings, device_offset
from ..estimators.receiver_places import stored_problem
from ..models import Fitted, Inputs, Model, Problem
from ..training.predictor import Predictor
from .applications import APPLICATIONS
from .evaluate import FittedPart, score_other, score_part, score_run
from .folder import FITTED, METRICS, SPLIT, RunConfig, load_rows, read_config, read_fitted, run_parts

PREDICTED_PER_CHUNK = 256  # positions that are predicted at a time: 33 MB of spectra of 90 x 360 for each receiver
MOST_PER_CHUNK, CHUNK_BYTES = 4096, 1 << 25
"""Largest number of positions of small observations at a time, and bytes of their observations."""


@dataclass(frozen=True)
class Run:
    """Run folder and the model in it.

    Attributes:
        folder: run folder.
        record: data that the model was fitted to; None: the data set that the folder names.
        operator: learned fields predict by operator where they can.
        scene: edited copy of the scene that the model was fitted in, to predict in; None: that scene.
        own: readings of the device that it predicts for, whose offset they tell; None: any device, of unknown offset.
        owner: object that is kept alive with the run, such as a scene in a temporary folder.

    >>> import wrf_mi
    >>> run = wrf_mi.train("laboratory", "idw", n_train=20)
    >>> run.predict([[2.2, 3.0, 1.7]]).to_xarray()["prediction"].dims
    ('row', 'receiver', 'elevation', 'azimuth')
    """

    folder: Path
    record: Record | None = field(default=None, repr=False, compare=False)
    operator: bool = True
    scene: str | Path | None = None
    owner: Any = field(default=None, repr=False, compare=False)
    own: OwnReadings | None = field(default=None, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Accept the folder's name as text."""
        object.__setattr__(self, "folder", Path(self.folder))

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of ``metrics.json``."""
        metrics: dict[str, Any] = json.loads((self.folder / METRICS).read_text())
        return metrics

    @cached_property
    def config(self) -> RunConfig:
        """Content of ``config.yaml``; `InputError`: not a run folder, or a damaged one."""
        return read_config(self.folder)

    @property
    def model(self) -> Model:
        """Registry entry of the model."""
        return self.config.entry

    @cached_property
    def problem(self) -> Problem:
        """Data, scene and settings that the model was fitted to, with an edited scene in place of its own."""
        if self.own is not None:
            return self.of_any_device.problem
        config = self.config
        scene = (config.scene, config.material) if self.scene is None else (str(self.scene), None)
        data, left_out = self.record or config.dataset, tuple(config.left_out)
        stated_settings = None if config.stated is None else frozenset(config.stated)
        problem = Problem(
            data, config.settings, config.seed, *scene, config.antennas, self.operator, left_out, stated_settings
        )
        return stored_problem(problem, self.folder)

    @cached_property
    def fitted(self) -> Fitted:
        """Fitted model; `InputError`: not a finished run, or a run with several splits."""
        if self.own is not None:
            return ForDevice(self.of_any_device.fitted, self.device)
        if self.scene is not None:
            with self._named():
                return replace(self, scene=None).fitted.in_scene(str(self.scene))
        problem = self.problem
        if not (self.folder / SPLIT).exists():
            raise InputError(f"{self.folder}: one model for each block; choose one, e.g. {self.folder / 'fold0'}")
        return load_fitted(self.config, problem, self.folder)[0]

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the folder in an `InputError`."""
        try:
            yield
        except InputError as error:
            raise InputError(f"{self.folder}: {error}") from None

    def in_scene(self, scene: str | Path | Any) -> Run:
        """The run in an edited copy of its scene, a `wrf_mi.Scene` or folder; of hybrids, of the corrected scene."""
        return replace(self, scene=getattr(scene, "folder", scene), owner=(self.owner, scene))

    def with_readings(self, tx_pos_m: ArrayLike, power_dbm: ArrayLike) -> Run:
        """The run as it predicts for one device, a handful of whose readings tell its offset (`device`).

        Args:
            tx_pos_m: where they were taken [m, 3], metres.
            power_dbm: received power [n_rx, m], dBm, receivers in the order of ``receivers``; NaN: nothing received.

        Raises:
            InputError: a run of another task or of several carriers, or arrays of other shapes.
        """
        with self._named():
            readings = checked_readings(tx_pos_m, power_dbm, self.problem.record, len(self.receivers))
        run = replace(self, own=readings)
        vars(run)["of_any_device"] = self.of_any_device  # whose data and model are open already
        return run

    @cached_property
    def of_any_device(self) -> Run:
        """The run without own readings."""
        return self if self.own is None else replace(self, own=None)

    @cached_property
    def device(self) -> DeviceOffset:
        """Offset of the device that ``own`` readings are of; that of any device without them.

        `InputError`: a model without standard deviations.
        """
        with self._named():
            return device_offset(self.of_any_device.fitted, self.own)

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """Receivers whose observations are predicted."""
        return self.fitted.receivers or self.problem.record.receivers

    @property
    def field(self) -> FittedField:
        """Trained field of spectra: settings, parameters and predictor.

        Raises:
            InputError: not a finished run of a learned field.
        """
        if not isinstance(self.fitted, FittedField):
            raise InputError(f"{self.folder}: a run of {self.config.model}, not of a learned field of spectra")
        return self.fitted

    @property
    def takes_heading(self) -> bool:
        """Whether predictions may be given the transmitter's heading."""
        return self.model.headings if self.fitted.uses_heading is None else self.fitted.uses_heading

    def predictor(self) -> Predictor:
        """Predictor of the trained field: ``predictor()(tx_pos_m)`` gives spectra [m, H, W].

        Raises:
            InputError: as `field`.
        """
        return self.field.predictor

    def predict(
        self,
        tx_pos_m: ArrayLike | None = None,
        receiver: int | str | None = None,
        tx_heading_rad: ArrayLike | None = None,
        uplink: ArrayLike | None = None,
        carriers_hz: ArrayLike | None = None,
    ) -> LabelledPrediction:
        """Predict the observations of a receiver, or of all.

        Args:
            tx_pos_m: transmitter positions [m, 3], metres, or an `xarray.DataArray` (row, axis); None: unknown.
            receiver: name, or index from 0; None: all receivers.
            tx_heading_rad: yaw of the transmitter [m], radians; None: unknown.
            uplink: uplink channels [m, antennas, subcarriers]; None: unknown.
            carriers_hz: carrier of each position [m], Hz, where the data have several; else None.

        Returns:
            Observations [m, ...] as in `wrf_mi.core.Record` and, if the model states them, standard deviations of a
            reading (``std``) and of the mean without noise (``std_mean``); of several receivers [n_rx, m, ...], as in
            ``predictions.npz``; `to_xarray` names the dimensions.

        Raises:
            InputError: not a finished run with one split, inputs that the model does not predict from, or no such
                receiver.
        """
        inputs = known_inputs(ordered(tx_pos_m, "row", "axis"), tx_heading_rad, uplink, carriers_hz)
        receivers = self.receivers
        of_one = receiver is not None or len(receivers) == 1
        numbers = [receiver_index(receivers, receiver or 0)] if of_one else range(len(receivers))
        every = [self.predict_inputs(inputs, number) for number in numbers]
        joined = _joined(every, np.concatenate if of_one else np.stack)
        names = tuple(receivers[number].name for number in numbers)
        places: dict[str, Any] = {"tx_pos_m": inputs.tx_pos_m, "receiver_names": names}
        return LabelledPrediction(**joined, **places, task=self.config.task, of_one=of_one)

    @alone_in_process()
    def score(self, split: str | None = None) -> dict[str, Any]:
        """Score the run again.

        Args:
            split: name of another split, whose test rows are scored except those used in training; nothing is written.
                None: the run's own, and ``metrics.json`` and ``predictions.npz`` are written anew.

        Returns:
            The metrics.

        Raises:
            InputError: not a run folder, a stopped run, or no row of ``split`` that was not used in training.
        """
        folder, folders = self.folder, run_parts(self.folder)
        # In the scene that it was fitted in, and for any device.
        config, problem = self.config, replace(self, scene=None, own=None).problem
        if split is not None and folders != [folder]:
            raise InputError(f"{folder}: every row is held out in one of its folds; omit --split")
        loaded = [(part, load_rows(part, problem.record), *load_fitted(config, problem, part)) for part in folders]
        parts = list(starmap(FittedPart, loaded))
        if split is not None:
            return score_other(config, problem, parts[0], split)
        scores = [score_part(folder, config, problem, part) for part in parts if len(part.split.test)]
        return score_run(folder, config, parts, scores)

    @property
    def stages(self) -> list[dict[str, Any]]:
        """Stages of a hybrid in their order, with what each contributes on held-out rows; empty for other models."""
        return list(self.metrics.get("stages", []))

    def map(self, **options: Any) -> Any:
        """Map of power, coverage and best receiver, ``xarray.Dataset``; options of `wrf_mi.apps.maps.api.radio_map`."""
        return APPLICATIONS["map"](self, **options)

    def locate(self, observed_dbm: ArrayLike, **options: Any) -> Any:
        """Positions of transmitters from signal strengths; options of `wrf_mi.apps.maps.locate.locate`."""
        return APPLICATIONS["locate"](self, observed_dbm, **options)

    def plan(self, count: int = 10, **options: Any) -> Any:
        """Positions to measure next; options of `wrf_mi.apps.maps.plan.plan`."""
        return APPLICATIONS["plan"](self, count, **options)

    def view(self, *more: Any, **options: Any) -> Any:
        """Interactive 3D view of the run and of ``more``, such as maps; options of `wrf_mi.apps.viewer.view.view`."""
        return APPLICATIONS["view"](self, *more, **options)

    def plot(self) -> Any:
        """Matplotlib figure of test rows: truth, prediction and interpolation side by side."""
        from .results import read_runs
        from .sample_figures import samples

        return samples(read_runs([self.folder]))[1]

    def export(self, format: str, out: str | Path, **options: Any) -> dict[str, Any]:
        """Write a file for other programs; formats and options of `wrf_mi.apps.exports.export`."""
        return dict(APPLICATIONS["export"](self.folder, format, out, **options))

    def predict_inputs(self, inputs: Inputs, receiver: int) -> Prediction:
        """Predict the observations of the receiver of an index; errors as those of `predict`."""
        self.check_inputs(inputs)
        chunks = list[Prediction]()
        for rows, chunk in self.predicted_parts(inputs, receiver):
            if not rows.start:
                chunk_bytes = chunk.mean.nbytes + (0 if chunk.std is None else chunk.std.nbytes)
                # Twice: parts, and the parts joined.
                needed = 2 * chunk_bytes * len(inputs) / max(len(chunk.mean), 1)
                what = f"{self.folder}: predictions at {len(inputs)} positions at once"
                require_memory(needed, what, "predict fewer at a time, or into a file (predict_to_file)")
            chunks.append(chunk)
        return Prediction(**_joined(chunks, np.concatenate))

    def predicted_parts(self, inputs: Inputs, receiver: int) -> Iterator[tuple[slice, Prediction]]:
        """Predictions of the receiver of an index in chunks, with the rows of each: memory for a chunk at a time.

        Raises:
            InputError: as `predict`.
        """
        start, size = 0, PREDICTED_PER_CHUNK
        while start < len(inputs) or not start:
            rows = slice(start, min(start + size, len(inputs)))
            chunk = self.fitted.predict(inputs if rows == slice(0, len(inputs)) else inputs.rows(rows), receiver)
            if np.isinf(chunk.mean).any():
                raise InputError(f"{self.folder}: predictions are infinite, as parameters are too large; train it anew")
            yield rows, chunk
            if rows.stop >= len(inputs):
                return
            row_bytes = max(chunk.mean.nbytes // len(chunk.mean), 1)
            start, size = rows.stop, int(np.clip(CHUNK_BYTES // row_bytes, PREDICTED_PER_CHUNK, MOST_PER_CHUNK))

    def check_inputs(self, inputs: Inputs) -> None:
        """Refuse inputs that the model does not predict from.

        Raises:
            InputError: heading, carrier or uplink that is not used, missing, or of another shape.
        """
        model = self.model
        if inputs.tx_heading_rad is not None:
            if not self.takes_heading:
                raise InputError(f"{self.folder}: {UNUSED_HEADING}")
            self._check_numbers(inputs, inputs.tx_heading_rad, "headings", "finite heading")
        if inputs.carriers_hz is not None or model.several_carriers:
            self._check_carriers(inputs)
        if model.uplink == "none":
            if inputs.uplink is not None:
                raise InputError(f"{self.folder}: {UNUSED_UPLINK}")
        elif inputs.uplink is not None or model.uplink == "required":
            check_inputs(inputs, self.problem.record, model)

    def _check_carriers(self, inputs: Inputs) -> None:
        fitted_hz = self.fitted.carriers_hz
        carriers_hz = self.problem.record.carriers_hz if fitted_hz is None else fitted_hz if fitted_hz.size else None
        if inputs.carriers_hz is not None:
            if carriers_hz is None:
                raise InputError(f"{self.folder}: its data have one carrier; omit {FREQUENCY}")
            self._check_numbers(inputs, inputs.carriers_hz, "carriers", f"positive {FREQUENCY}", 0.0)
        elif carriers_hz is not None:
            text = f"its data have {carriers_text(carriers_hz)}; give {FREQUENCY} for each position"
            raise InputError(f"{self.folder}: {text}")

    def _check_numbers(
        self, inputs: Inputs, values: FloatArray, name: str, wanted: str, above: float = -np.inf
    ) -> None:
        if values.shape != (len(inputs),) or not (np.isfinite(values) & (values > above)).all():
            text = f"{len(inputs)} positions and {name} {values.shape}; give one {wanted} for each"
            raise InputError(f"{self.folder}: {text}")


def _joined(parts: Sequence[Prediction], join: Callable[[Sequence[Any]], Any]) -> dict[str, Any]:
    """Attributes of `Prediction` of joined predictions; None where one of them has none."""

    def of(name: str) -> Any:
        values = [getattr(part, name) for part in parts]
        return None if any(value is None for value in values) else values[0] if len(values) == 1 else join(values)

    return {attribute.name: of(attribute.name) for attribute in fields(Prediction)}


def known_inputs(
    tx_pos_m: ArrayLike | None, tx_heading_rad: ArrayLike | None, uplink: Any, carriers_hz: ArrayLike | None
) -> Inputs:
    """Inputs of known quantities, as arrays; unknown positions are NaN, one for each uplink."""
    channels = None if uplink is None else np.asarray(uplink)
    if tx_pos_m is None:
        tx_pos_m = np.full((0 if channels is None else len(channels), 3), np.nan)
    heading, carriers = (
        None if values is None else np.atleast_1d(np.asarray(values, float)) for values in (tx_heading_rad, carriers_hz)
    )
    return Inputs(np.atleast_2d(np.asarray(tx_pos_m, float)), heading, channels, carriers_hz=carriers)


def load_fitted(config: RunConfig, problem: Problem, part: Path) -> tuple[Fitted, float]:
    """Fitted model of a run or fold, and the training time in seconds; `InputError` where missing or damaged."""
    arrays, seconds = read_fitted(part, config.entry)
    visible = stored_problem(problem, part).seen(load_split(part / SPLIT))
    with readable(part / FITTED, f"{part / FITTED}: missing", "train the run anew"):
        return config.entry.load(arrays, visible, part), seconds


def open_run(
    folder: str | Path,
    record: Record | None = None,
    operator: bool = True,
    scene: Any = None,
    own: OwnReadings | None = None,
) -> Run:
    """Open a run: ``open_run(folder).predict(tx_pos_m, receiver)`` predicts what a receiver observes.

    Arguments are the attributes of `Run`; `InputError` where the folder is none of a run.

    >>> import wrf_mi
    >>> run = wrf_mi.train("laboratory", "idw", n_train=20)
    >>> open_run(run.folder).config.model
    'idw'
    """
    run = Run(Path(folder), record, operator, scene, own=own)
    _ = run.config
    return run
