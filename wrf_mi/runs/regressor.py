"""Models of signal strengths as a regressor of scikit-learn."""

from __future__ import annotations

import shutil
import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.metrics import r2_score
from sklearn.utils.validation import check_consistent_length, check_is_fitted, validate_data

from ..core import InputError, Receiver, Record
from ..core.angles import FloatArray
from ..core.antenna import UPRIGHT
from ..datasets.splits import NONE, single_split
from .api import train
from .folder import Settings
from .run import Run


class WrfRegressor(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Regressor of signal strengths over transmitter positions, in scikit-learn's conventions.

    Attributes:
        model: name of the model, a key of `wrf_mi.models.MODELS` that serves signal strengths.
        scene: scene, or name, scene folder, Mitsuba XML or mesh to trace, for models that take one.
        height_m: height of the transmitters, metres, where ``X`` has the columns x and y alone.
        receivers: positions [k, 3], metres, NaN where unknown, or `wrf_mi.Receiver` objects with their antennas, in the
            order of the columns of ``y``. None: unknown, as of receivers that nobody mapped; models estimate them.
        frequency_hz: carrier, Hz; None: unknown, or stated by the receivers.
        preset: settings by a name of `wrf_mi.models.Model.presets`, such as ``"fast"``.
        settings: settings of the model, as those of `wrf_mi.train`.
        intervals: calibrate standard deviations on held-out rows, for which the model is fitted once more; models that
            state none have these.
        random_state: seed of the fit, a whole number.
        out: run folder of a single fit, which must not exist. None: a temporary one, removed with the run.
        run_: run of the fit, a `wrf_mi.Run` without test rows or scores.
        n_features_in_: number of columns of ``X``.

    Copies and pickles of a fitted regressor contain the files of its run, but no scene folder.

    >>> positions_m = np.random.default_rng(0).uniform(0, 20, (60, 2))
    >>> power_dbm = -40 - 20 * np.log10(np.linalg.norm(positions_m - [5, 5], axis=1) + 1)
    >>> regressor = WrfRegressor("kriging", height_m=1.3, intervals=True).fit(positions_m, power_dbm)
    >>> mean_dbm, std_db = regressor.predict([[6.0, 7.0]], return_std=True)
    >>> mean_dbm.shape, std_db.shape
    ((1,), (1,))
    """

    def __init__(
        self,
        model: str = "hybrid",
        scene: str | Path | Any | None = None,
        *,
        height_m: float | None = None,
        receivers: ArrayLike | Sequence[Receiver] | None = None,
        frequency_hz: float | None = None,
        preset: str | None = None,
        settings: Settings = (),
        intervals: bool = False,
        random_state: int = 0,
        out: str | Path | None = None,
    ) -> None:
        self.model = model
        self.scene = scene
        self.height_m = height_m
        self.receivers = receivers
        self.frequency_hz = frequency_hz
        self.preset = preset
        self.settings = settings
        self.intervals = intervals
        self.random_state = random_state
        self.out = out

    def fit(self, X: ArrayLike, y: ArrayLike) -> WrfRegressor:
        """Fit the model to all rows.

        Args:
            X: positions of the transmitter [n, 3], or [n, 2] with ``height_m``, world frame, metres.
            y: signal strengths [n] or [n, receivers], dBm; NaN where nothing was received.

        Raises:
            InputError: other columns than positions have, another number of receivers than of columns of ``y``, or
                an error of `wrf_mi.train`.
        """
        of_targets = {"dtype": np.float64, "ensure_2d": False, "ensure_all_finite": "allow-nan"}
        of_positions = {"dtype": np.float64, "ensure_min_samples": 2}
        columns, targets = validate_data(self, X, y, validate_separately=(of_positions, of_targets))
        check_consistent_length(columns, targets)
        power_dbm = targets.reshape(len(targets), -1).T
        carriers = None if self.frequency_hz is None else np.array([float(self.frequency_hz)])
        record = Record(
            "X and y",
            "rssi",
            self._positions_m(columns),
            self._known_receivers(len(power_dbm)),
            power_dbm.astype(np.float32),
            frequencies_hz=carriers,
        )
        seed = int(self.random_state)
        self.run_ = train(
            record,
            self.model,
            self.scene,
            out=self.out,
            preset=self.preset,
            split=single_split(record, NONE, seed),
            seed=seed,
            settings=self.settings,
            intervals=self.intervals,
        )
        self._of_one = targets.ndim == 1
        return self

    def predict(self, X: ArrayLike, return_std: bool = False) -> FloatArray | tuple[FloatArray, FloatArray]:
        """Predict signal strengths at positions [m, 2 or 3], of the columns of ``fit``.

        Returns:
            Means [m] or [m, receivers], as ``y``, in dBm; with ``return_std`` also standard deviations of a reading,
            its noise included, in dB.

        Raises:
            InputError: other columns than those of ``fit``, or a model without standard deviations.
        """
        check_is_fitted(self, "run_")
        positions_m = self._positions_m(validate_data(self, X, reset=False, dtype=np.float64))
        prediction = self.run_.predict(positions_m)
        mean_dbm = self._as_targets(prediction.mean)
        if not return_std:
            return mean_dbm
        if prediction.std is None:
            text = "states no standard deviations of these data; fit it with intervals=True"
            raise InputError(f"{self.run_.config.model}: {text}")
        return mean_dbm, self._as_targets(prediction.std)

    def score(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> float:
        """Coefficient of determination R² of the rows that each receiver received, its mean over receivers."""
        weights = np.ones(len(np.asarray(y))) if sample_weight is None else np.asarray(sample_weight, float)
        truths, means = (np.asarray(values, float).reshape(len(weights), -1).T for values in (y, self.predict(X)))
        received = np.isfinite(truths)
        pairs = zip(truths, means, received, strict=True)
        scores = [r2_score(t[rows], m[rows], sample_weight=weights[rows]) for t, m, rows in pairs if rows.sum() > 1]
        return float(np.mean(scores))

    def _positions_m(self, X: NDArray[np.float64]) -> FloatArray:
        """Positions [n, 3] of rows with two or three columns."""
        if X.shape[1] != (needed := 3 if self.height_m is None else 2):
            remedy = "x, y, z, or x, y with height_m" if needed == 3 else "x, y, or omit height_m for x, y, z"
            raise InputError(f"X: n_features = {X.shape[1]}; give {remedy}, in metres")
        return X if self.height_m is None else np.column_stack([X, np.full(len(X), float(self.height_m))])

    def _known_receivers(self, count: int) -> tuple[Receiver, ...]:
        """Receivers of the columns of ``y``."""
        receivers: Any = np.full((count, 3), np.nan) if self.receivers is None else self.receivers
        if len(receivers) != count or not all(
            isinstance(each, Receiver) or np.shape(each) == (3,) for each in receivers
        ):
            text = f"receivers: {len(receivers)} for {count} columns of y"
            raise InputError(f"{text}; give a position x, y, z in metres of each column, or None for unknown places")
        return tuple(
            each if isinstance(each, Receiver) else Receiver(f"receiver{k}", np.array(each, float), np.array(UPRIGHT))
            for k, each in enumerate(receivers)
        )

    def _as_targets(self, values: NDArray[Any]) -> FloatArray:
        """Values of a prediction, [m] of one receiver or [receivers, m], in the shape of ``y``."""
        of_receivers = np.asarray(values, float)
        return of_receivers if self._of_one else np.atleast_2d(of_receivers).T

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.target_tags.multi_output = True
        return tags

    def __getstate__(self) -> dict[str, Any]:
        state = dict(super().__getstate__())
        if "run_" in state:
            run = state.pop("run_")
            files = {
                path.relative_to(run.folder): path.read_bytes() for path in run.folder.rglob("*") if path.is_file()
            }
            state["run_files"] = files, run.record
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        files, record = state.pop("run_files", ({}, None))
        super().__setstate__(state)
        if files:
            folder = Path(tempfile.mkdtemp(prefix="wrf-mi-"))
            for name, content in files.items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(content)
            self.run_ = Run(folder, record, owner=self.scene)
            weakref.finalize(self.run_, shutil.rmtree, folder, ignore_errors=True)
