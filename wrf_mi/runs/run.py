"""A run folder as a model that predicts."""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError, Prediction, Receiver, Record
from ..core.angles import FloatArray
from ..core.carriers import FREQUENCY, carriers_text
from ..core.files import readable
from ..core.receivers import receiver_index
from ..models import Fitted, Inputs, Model, Problem
from ..models.checks import check_inputs
from ..models.gaussian.model import FittedField
from ..models.model import UNUSED_HEADING, UNUSED_UPLINK
from ..parallel import Scheduler, row_parts
from ..training.predictor import Predictor
from .folder import FITTED, METRICS, SPLIT, RunConfig, read_config, read_fitted
from .prediction_file import check_prediction_file, write_prediction_file

PREDICTED_PER_CHUNK = 256
"""Positions of one part at most, for a scheduler: 33 MB of spectra of 90 x 360 for each receiver."""


@dataclass(frozen=True)
class Run:
    """A run folder and the model in it.

    Attributes:
        folder: where everything lies.
        record: that it was fitted to, where that is no data set by name or folder; None: the data set it names.
        operator: learned fields predict by operator where they can.
    """

    folder: Path
    record: Record | None = dataclasses.field(default=None, repr=False, compare=False)
    operator: bool = True

    def __post_init__(self) -> None:
        """Take the folder's name as text, too."""
        object.__setattr__(self, "folder", Path(self.folder))

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Content of ``metrics.json``."""
        metrics: dict[str, Any] = json.loads((self.folder / METRICS).read_text())
        return metrics

    @cached_property
    def config(self) -> RunConfig:
        """Content of ``config.yaml``.

        Raises:
            InputError: not a run folder, a damaged one, or one of version 0.1.
        """
        return read_config(self.folder)

    @property
    def model(self) -> Model:
        """The entry of its model."""
        return self.config.entry

    @cached_property
    def problem(self) -> Problem:
        """What it was fitted to."""
        config, own = self.config, self.record
        place = config.scene, config.material, config.antennas
        rows = config.n_train != 0
        return Problem(own or config.dataset, config.settings, config.seed, *place, rows, self.operator)

    @cached_property
    def fitted(self) -> Fitted:
        """The fitted model.

        Raises:
            InputError: not a finished run, or one with several splits.
        """
        _ = self.config  # a folder that is no run is refused as such
        if not (self.folder / SPLIT).exists():
            raise InputError(f"{self.folder}: one model for each block; choose one, e.g. {self.folder / 'fold0'}")
        return load_part(self.config, self.problem, self.folder)[0]

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """Whose observations it predicts."""
        return self.fitted.receivers or self.problem.record.receivers

    @property
    def field(self) -> FittedField:
        """The trained field of spectra: settings, parameters and predictor.

        Raises:
            InputError: not a finished run of one such field.
        """
        if not isinstance(self.fitted, FittedField):
            raise InputError(f"{self.folder}: a run of {self.config.model}, not of a learned field of spectra")
        return self.fitted

    def predictor(self) -> Predictor:
        """The predictor of the trained field: ``predictor()(tx_pos_m)`` gives spectra [m, H, W].

        Raises:
            InputError: as `field`.
        """
        return self.field.predictor

    def predict(
        self,
        tx_pos_m: ArrayLike | None = None,
        receiver: int | str = 0,
        tx_heading_rad: ArrayLike | None = None,
        uplink: ArrayLike | None = None,
        carriers_hz: ArrayLike | None = None,
    ) -> Prediction:
        """What a receiver observes.

        Args:
            tx_pos_m: positions [m, 3], metres; None: unknown.
            receiver: name, or number from 0.
            tx_heading_rad: how the transmitter is turned, [m]; None: unknown.
            uplink: uplink channels [m, antennas, subcarriers]; None: unknown.
            carriers_hz: carrier of each position [m], Hz, where the data have several; else None.

        Returns:
            Observations [m, ...] as in `wrf_mi.core.Record` and, where the model states them, standard deviations.

        Raises:
            InputError: not a finished run with one split, inputs that the model does not predict from, or no such
                receiver.
        """
        index = receiver_index(self.receivers, receiver)
        up = None if uplink is None else np.asarray(uplink)
        unknown = np.full((0 if up is None else len(up), 3), np.nan)
        positions = unknown if tx_pos_m is None else np.atleast_2d(np.asarray(tx_pos_m, float))
        heading = None if tx_heading_rad is None else np.atleast_1d(np.asarray(tx_heading_rad, float))
        carriers = None if carriers_hz is None else np.atleast_1d(np.asarray(carriers_hz, float))
        return self.predict_inputs(Inputs(positions, heading, up, carriers_hz=carriers), index)

    def predict_inputs(self, inputs: Inputs, receiver: int) -> Prediction:
        """What the receiver of that index observes, see `predict`."""
        self.check_inputs(inputs)
        return self.fitted.predict(inputs, receiver)

    def check_inputs(self, inputs: Inputs) -> None:
        """Refuse inputs that the model does not predict from.

        Raises:
            InputError: saying which.
        """
        model, heading = self.model, inputs.tx_heading_rad
        if heading is not None:
            if not (model.headings if self.fitted.uses_heading is None else self.fitted.uses_heading):
                raise InputError(f"{self.folder}: {UNUSED_HEADING}")
            if heading.shape != (len(inputs),) or not np.isfinite(heading).all():
                text = f"{len(inputs)} positions and headings {heading.shape}; give one finite heading for each"
                raise InputError(f"{self.folder}: {text}")
        if model.several_carriers or inputs.carriers_hz is not None:
            self._check_carriers(inputs)
        if model.uplink == "none":
            if inputs.uplink is not None:
                raise InputError(f"{self.folder}: {UNUSED_UPLINK}")
        elif inputs.uplink is not None or model.needs_uplink:
            check_inputs(inputs, self.problem.record, model)

    def _check_carriers(self, inputs: Inputs) -> None:
        known, asked = self.problem.record.carriers_hz, inputs.carriers_hz
        if known is None and asked is not None:
            raise InputError(f"{self.folder}: its data have one carrier; leave {FREQUENCY} away")
        if known is not None and asked is None:
            raise InputError(f"{self.folder}: its data have {carriers_text(known)}; give {FREQUENCY} for each position")
        if asked is not None and not (asked.shape == (len(inputs),) and (np.isfinite(asked) & (asked > 0)).all()):
            text = f"{len(inputs)} positions and carriers {asked.shape}; give one positive {FREQUENCY} for each"
            raise InputError(f"{self.folder}: {text}")


def load_part(config: RunConfig, problem: Problem, part: Path) -> tuple[Fitted, float]:
    """The fitted model of a part, and the seconds that its fit took.

    Raises:
        InputError: missing or damaged.
    """
    arrays, seconds = read_fitted(part)
    with readable(part / FITTED, f"{part / FITTED}: missing", "train the run anew"):
        return config.entry.load(arrays, problem, part), seconds


def open_run(folder: str | Path, record: Record | None = None, operator: bool = True) -> Run:
    """The run in a folder: ``open_run(folder).predict(tx_pos_m, receiver)`` gives what a receiver observes.

    Args:
        folder: of the run.
        record: that it was fitted to, where that is no data set by name or folder; None: the data set it names.
        operator: learned fields predict by operator where they can.

    Raises:
        InputError: not a run folder, or one of version 0.1.
    """
    run = Run(Path(folder), record, operator)
    _ = run.config
    return run


def predict_to_file(
    folder: str | Path,
    tx_pos_m: np.ndarray,
    out: str | Path,
    tx_heading_rad: np.ndarray | None = None,
    scheduler: Scheduler | None = None,
    operator: bool = True,
    uplink: NDArray[Any] | None = None,
    carriers_hz: FloatArray | None = None,
) -> dict[str, tuple[int, ...]]:
    """What a run's model predicts at new transmitter positions, as an ``.npz`` or ``.csv`` file.

    Args:
        folder: run folder with one fitted model.
        tx_pos_m: positions [m, 3], metres; NaN where they are not known.
        out: file to write. ``.npz``: keys ``row`` (0..m-1), ``prediction`` ([m, H, W] for one receiver, else
            [n_rx, m, H, W]), ``tx_pos`` [m, 3] and ``receiver_name``, as in ``predictions.npz``, and ``std`` of models
            that state it. ``.csv``, signal strengths alone: see
            `wrf_mi.runs.prediction_file.write_prediction_file`.
        tx_heading_rad: yaw of the transmitter's body [m], radians, for models that use it.
        scheduler: what computes parts of the positions; None: this process. Its workers must see the run folder, data
            set and scene under the same names.
        operator: learned fields predict by operator where they can.
        uplink: uplink channels [m, antennas, subcarriers], for models that predict from them.
        carriers_hz: carrier of each position [m], Hz, where the data have several; also in the file, ``frequency_hz``.

    Returns:
        Shape of each array that ``.npz`` has.

    Raises:
        InputError: a run over several blocks, positions that are not known, headings or an uplink for a model
            without, no headings for a model that needs them, or a file name with another suffix or of a form that
            does not hold what the run predicts.
    """
    path = Path(folder)
    asked = Inputs(np.asarray(tx_pos_m, float), tx_heading_rad, uplink, carriers_hz=carriers_hz)
    run = open_run(path, operator=operator)
    check_prediction_file(Path(out), path)
    run.check_inputs(asked)
    if scheduler is None or not len(asked):
        parts = [_predict_part(run, asked)]
    else:
        given = [asked.rows(rows) for rows in row_parts(len(asked), scheduler.workers, most=PREDICTED_PER_CHUNK)]
        opener = partial(open_run, path, operator=operator)
        parts = scheduler.map(_predict_part, given, opener, what="predicting", sizes=[len(one) for one in given])
    means, stds, names = zip(*parts, strict=True)
    arrays: dict[str, Any] = {
        "row": np.arange(len(asked)),
        "prediction": np.concatenate(means, axis=1),
        "tx_pos": asked.tx_pos_m,
        "receiver_name": np.asarray(names[0]),
    }
    if carriers_hz is not None:
        arrays[FREQUENCY] = carriers_hz
    if stds[0] is not None:
        arrays["std"] = np.concatenate(stds, axis=1).astype(np.float32)
    written = write_prediction_file(Path(out), arrays, tx_heading_rad)
    return {key: value.shape for key, value in written.items()}


def _predict_part(run: Run, inputs: Inputs) -> tuple[NDArray[Any], NDArray[Any] | None, list[str]]:
    """Observations [n_rx, m, ...], their standard deviations where the model states them, and the receivers' names."""
    found = [run.predict_inputs(inputs, index) for index in range(len(run.receivers))]
    stated = None if found[0].std is None else np.stack([one.stated_std for one in found])
    return np.stack([one.mean for one in found]), stated, [receiver.name for receiver in run.receivers]
