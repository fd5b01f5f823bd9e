"""A baseline as a run: fitted, kept and scored as a learned model is.

As `wrf_mi.report.fitted_run` has it, with ``fitted.npz`` as the model and all ``settings`` in ``config.yaml``.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..baselines.checks import check_inputs, check_record
from ..baselines.method import Fitted, Inputs, Listen, Method, inputs_of
from ..baselines.models import METHODS
from ..core import InputError, Receiver, Record, Split
from ..core.angles import FloatArray
from ..core.receivers import receiver_index
from ..core.types import IntArray
from ..fit.config import settings_from, with_settings
from ..fit.folder import CONFIG, check_new, stated_config
from ..measure import make_splits
from ..measure.observations import check_observations
from ..trace import load_record
from .fitted_run import FittedConfig, FittedRun, opened
from .run_folder import stated_model


@dataclass(frozen=True)
class BaselineConfig(FittedConfig):
    """What ``config.yaml`` says of a run of a baseline.

    Attributes:
        model: name of the method.
        settings: all of them, a dataclass of the method's.
    """

    model: str
    settings: Any


class BaselineRun(FittedRun[BaselineConfig, Fitted]):
    """The folder of a run of a baseline."""

    file = "fitted.npz"
    format = 1

    def __init__(self, folder: Path, config: BaselineConfig, record: Record) -> None:
        """Check that the method serves the data.

        Raises:
            InputError: it does not.
        """
        super().__init__(folder, config, record)
        self.method = known_method(config.model)
        check_record(self.method, record, METHODS.values())

    @classmethod
    def stored(cls, folder: Path, record: Record | None = None) -> BaselineRun:
        """A run that was begun; ``record`` is what it was fitted to, None: the data set that it names.

        Raises:
            InputError: not a run of a baseline, or a data set that is not there any more.
        """
        config = read_baseline_config(folder)
        return cls(folder, config, load_record(config.dataset) if record is None else record)

    @property
    def model_name(self) -> str:
        """Name of the method."""
        return self.config.model

    def fit(self, rows: Split, listen: Listen) -> Fitted:
        """Fit it; validation rows may choose what is open."""
        return self.method.fit(self.record, rows, self.config.settings, self.config.seed, listen)

    def arrays(self, model: Fitted) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        return model.arrays()

    def load(self, arrays: dict[str, NDArray[Any]]) -> Fitted:
        """The model of these arrays."""
        return self.method.load(arrays, self.record)

    def predict(self, model: Fitted, rows: IntArray, receiver: int) -> tuple[NDArray[Any], FloatArray | None]:
        """What a receiver observes in rows of the record; a baseline states no deviation."""
        return model.predict(inputs_of(self.record, rows), receiver), None


@dataclass(frozen=True)
class Baseline:
    """A fitted baseline, ready to predict.

    Attributes:
        method: what it is.
        record: the data that it was fitted to: poses, frequencies and shapes count, observations do not.
        fitted: the model.
    """

    method: Method
    record: Record
    fitted: Fitted

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """Whose observations it predicts."""
        return self.record.receivers

    def predict(
        self,
        tx_pos_m: ArrayLike | None = None,
        receiver: int | str = 0,
        tx_heading_rad: ArrayLike | None = None,
        uplink: ArrayLike | None = None,
    ) -> NDArray[Any]:
        """What a receiver observes.

        Args:
            tx_pos_m: positions [m, 3], metres; None: unknown.
            receiver: name, or number from 0.
            tx_heading_rad: how the transmitter is turned, [m]; None: unknown.
            uplink: uplink channels [m, antennas, subcarriers]; None: unknown.

        Returns:
            Observations [m, ...] as in `wrf_mi.core.Record`.

        Raises:
            InputError: not what the method predicts from, or no such receiver.
        """
        index = receiver_index(self.receivers, receiver)
        up = None if uplink is None else np.asarray(uplink)
        unknown = np.full((0 if up is None else len(up), 3), np.nan)
        positions = unknown if tx_pos_m is None else np.atleast_2d(np.asarray(tx_pos_m, float))
        heading = None if tx_heading_rad is None else np.atleast_1d(np.asarray(tx_heading_rad, float))
        return self.predict_inputs(Inputs(positions, heading, up), index)

    def predict_inputs(self, inputs: Inputs, receiver: int) -> NDArray[Any]:
        """The same."""
        check_inputs(inputs, self.record, self.method)
        return self.fitted.predict(inputs, receiver)


def known_method(name: str) -> Method:
    """The method of that name.

    Raises:
        InputError: there is none.
    """
    if name not in METHODS:
        raise InputError(f"model {name!r}: no such baseline; choose from {', '.join(METHODS)}")
    return METHODS[name]


def is_baseline(folder: Path) -> bool:
    """Whether a folder is a run of a baseline."""
    return stated_model(folder) in METHODS


def read_baseline_config(folder: Path) -> BaselineConfig:
    """Read ``config.yaml`` of a run of a baseline.

    Raises:
        InputError: missing, not YAML, or not of such a run.
    """
    with stated_config(folder) as content:
        names = ("dataset", "split", "n_train", "seed", "model")
        kept, settings = {name: content[name] for name in names}, content["settings"]
        kept["deterministic"] = bool(content.get("deterministic"))
    if kept["model"] not in METHODS:
        raise InputError(f"{folder}: a run of {kept['model']}, not of a baseline; give one of {', '.join(METHODS)}")
    kind = METHODS[kept["model"]].settings
    return BaselineConfig(**kept, settings=settings_from(kind, settings, str(folder / CONFIG)))


def check_baseline(
    model: str, record: Record, split: str, n_train: int | float | None, seed: int, settings: tuple[str, ...]
) -> tuple[Any, list[Split]]:
    """Refuse a run that cannot be, before anything is written.

    Returns:
        Its settings and splits.

    Raises:
        InputError: as `train_baseline`.
    """
    method = known_method(model)
    chosen: Any = with_settings(method.settings(), settings)
    check_record(method, record, METHODS.values())
    splits = make_splits(record, split, seed, n_train)
    for rows in splits:
        check_observations(record, rows)
    return chosen, splits


def train_baseline(
    dataset: str | Path | Record,
    out: str | Path,
    model: str,
    *,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    settings: tuple[str, ...] = (),
    deterministic: bool = False,
    listen: Listen = lambda what, share: None,
) -> Path:
    """Fit a baseline to a data set and score it.

    Args:
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        model: name of the method, a key of `wrf_mi.baselines.models.METHODS`.
        split: name of a split; ``blocked`` fits every fold in turn and pools the scores.
        n_train: number or fraction of the training rows to use; None: all.
        seed: of split and fit.
        settings: ``key=value`` of the method.
        deterministic: on one thread of the CPU, so bit-identical from run to run.
        listen: hears what is being done and the share of it that is done.

    Returns:
        The run folder.

    Raises:
        InputError: data that the method does not serve or cannot learn from, settings or folder that cannot be used.
    """
    check_new(Path(out))
    with_settings(known_method(model).settings(), settings)  # before data are read, or even traced
    record, source = opened(dataset)
    chosen, splits = check_baseline(model, record, split, n_train, seed, settings)
    config = BaselineConfig(source, split, n_train, seed, model, chosen, deterministic=deterministic)
    return BaselineRun(Path(out), config, record).train(splits, listen)


def resume_baseline(folder: Path, listen: Listen = lambda what, share: None) -> Path:
    """Go on with a run that was stopped: folds that were fitted are kept.

    Raises:
        InputError: not a run of a baseline.
    """
    return BaselineRun.stored(folder).resume(listen)


def evaluate_baseline(folder: Path, split: str | None = None) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: the run; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on another split's test rows that the run has not seen; nothing is written.

    Raises:
        InputError: not a finished run, or no row of ``split`` is left that it has not seen.
    """
    run = BaselineRun.stored(folder)
    return run.score() if split is None else run.score_on(split)


def open_baseline(folder: str | Path, record: Record | None = None) -> Baseline:
    """The fitted model of a run: ``open_baseline(run).predict(tx_pos_m, receiver)`` gives observations.

    Args:
        folder: the run.
        record: that it was fitted to, where that is no data set by name or folder; None: the data set it names.

    Raises:
        InputError: not a finished run, or one over several splits; a data set that is not there any more.
    """
    run = BaselineRun.stored(Path(folder), record)
    return Baseline(run.method, run.record, run.the_model())


def settings_of_baselines() -> dict[str, Any]:
    """Default settings of each method by its name."""
    return {name: METHODS[name].settings() for name in METHODS}
