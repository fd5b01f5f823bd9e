"""The hybrid as a run: what physics and measurements tell together, in the run folder of a fitted model.

As `wrf_mi.report.fitted_run` has it, with ``hybrid.npz`` as the model, ``scene`` and ``material`` in ``config.yaml``,
``fitted`` and ``inside_90`` in ``metrics.json`` and ``std``, the predicted standard deviation, in ``predictions.npz``.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..baselines.method import Listen
from ..core import Antenna, AntennaOptions, InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA, AS_STATED
from ..core.types import IntArray
from ..fit.config import with_settings
from ..fit.folder import check_new, stated_config
from ..hybrid.models import HybridModel, kind_of
from ..measure import make_splits
from ..measure.observations import check_observations
from ..tasks import instrument_of
from ..trace import load_record, open_scene
from ..trace.polarization import check_polarization
from ..trace.solve import Prepared
from .fitted_run import FittedConfig, FittedRun, opened
from .run_folder import stated_model
from .traced import UNUSED_HEADING

logger = logging.getLogger(__name__)

MODEL = "hybrid"
FITTED = "hybrid.npz"


@dataclass(frozen=True)
class HybridConfig(FittedConfig):
    """What ``config.yaml`` says of a run of the hybrid.

    Attributes:
        n_train: as of any run, and 0: none, the scene alone.
        scene: name, scene folder, Mitsuba XML or mesh; None: without a mesh.
        material: of a bare mesh, or None.
        settings: those of the model that were changed, as ``key=value``.
        antennas: stated in place of the data's.
    """

    scene: str | None
    material: str | None
    settings: tuple[str, ...]
    antennas: AntennaOptions = field(default=AS_STATED, kw_only=True)


class HybridRun(FittedRun[HybridConfig, HybridModel]):
    """The folder of a run of the hybrid."""

    file = FITTED
    format = 1
    model_name = MODEL

    def __init__(self, folder: Path, config: HybridConfig, record: Record) -> None:
        """Open the scene.

        Raises:
            InputError: a task that no hybrid serves, a scene that cannot be opened, or a material without one.
        """
        self._kind = kind_of(record, config.scene is not None)
        if config.antennas and not (config.scene is not None and self._kind.uses_antennas):
            why = "without --scene nothing is traced" if config.scene is None else "its channels are of isotropic ones"
            raise InputError(f"{MODEL} on {record.name}: takes no antenna options: {why}")
        super().__init__(folder, config, config.antennas.of(record))
        self._settings = with_settings(self._kind.settings(), config.settings)
        if config.n_train == 0 and config.scene is None:
            raise InputError("--n-train 0: nothing to predict from; give training rows or a scene")
        self._scene: Any | None = None
        if config.scene is not None:
            self._scene = open_scene(config.scene, instrument_of(record).carrier_hz, material=config.material)
            if not self._kind.uses_antennas and any(one != ANTENNA for one in self._antennas()):
                logger.warning("%s: the hybrid for channels takes all antennas to be isotropic", record.name)
        elif config.material is not None:
            raise InputError("--material belongs to a bare mesh; give it with --scene")

    def _antennas(self) -> list[Antenna]:
        return [self.record.tx_antenna, *(receiver.antenna for receiver in self.record.receivers)]

    @classmethod
    def stored(cls, folder: Path) -> HybridRun:
        """A run that was begun.

        Raises:
            InputError: not a run of the hybrid; a data set or scene that is not there any more.
        """
        config = read_hybrid_config(folder)
        return cls(folder, config, load_record(config.dataset))

    def check_antennas(self) -> None:
        """Refuse antennas in solids, warn of those near surfaces and of crossed polarisations, as `wrf-mi trace` does.

        Raises:
            InputError: naming the transmitter or receiver, and the solid.
        """
        if self._scene is not None:
            places = np.asarray(self.record.tx_pos_m, float)
            Prepared(self._scene).check(places, self.record.receivers)
            if self._kind.uses_antennas:
                check_polarization(self._scene, places, self.record.receivers, self.record.tx_antenna)

    def fit(self, rows: Split, listen: Listen) -> HybridModel:
        """Fit it to all training rows."""
        return self._kind.fit(self.record, self.seen(rows), self._scene, self._settings, self.config.seed, listen)

    def arrays(self, model: HybridModel) -> dict[str, NDArray[Any]]:
        """All that is needed to predict again."""
        return model.arrays()

    def load(self, arrays: dict[str, NDArray[Any]]) -> HybridModel:
        """The model of these arrays."""
        return self._kind.load(arrays, self._scene)

    def predict(self, model: HybridModel, rows: IntArray, receiver: int) -> tuple[NDArray[Any], FloatArray | None]:
        """What a receiver observes in rows of the record, and how far that may be off."""
        heading = self.record.tx_heading_rad
        estimate = model.predict(self.record.tx_pos_m[rows], receiver, None if heading is None else heading[rows])
        return estimate.mean, estimate.std

    def facts(self, model: HybridModel) -> dict[str, Any]:
        """Its scene, and what was fitted."""
        return {"scene": self.config.scene, "fitted": model.summary()}

    def seen(self, rows: Split) -> IntArray:
        """None, where the scene alone predicts."""
        return np.zeros(0, np.int64) if self.config.n_train == 0 else rows.all_train


def is_hybrid(folder: Path) -> bool:
    """Whether a folder is a run of the hybrid."""
    return stated_model(folder) == MODEL


def read_hybrid_config(folder: Path) -> HybridConfig:
    """Read ``config.yaml`` of a run of the hybrid.

    Raises:
        InputError: missing, not YAML, or not of such a run.
    """
    with stated_config(folder) as content:
        if content["model"] != MODEL:
            raise InputError(f"{folder}: a run of {content['model']}, not of the hybrid; give one of the hybrid")
        names = ("dataset", "scene", "material", "split", "n_train", "seed")
        kept = {name: content[name] for name in names}
        kept["deterministic"] = bool(content.get("deterministic"))
        kept["antennas"] = AntennaOptions(**content["antennas"])
        return HybridConfig(**kept, settings=tuple(content["settings"]))


def train_hybrid(
    dataset: str | Path | Record,
    out: str | Path,
    scene: str | Path | None = None,
    *,
    material: str | None = None,
    split: str = "official",
    n_train: int | float | None = None,
    seed: int = 0,
    settings: tuple[str, ...] = (),
    antennas: AntennaOptions = AS_STATED,
    deterministic: bool = False,
    listen: Listen = lambda what, share: None,
) -> Path:
    """Fit a hybrid to a data set and score it.

    Args:
        dataset: name, folder, or a record that was loaded.
        out: run folder to make; must not exist or be empty.
        scene: name, scene folder, Mitsuba XML or mesh; None: without a mesh.
        material: of a bare mesh.
        split: name of a split; ``blocked`` fits every fold in turn and pools the scores.
        n_train: number or fraction of the training rows to use; None: all; 0: none, physics alone (needs a scene).
        seed: of split and fit.
        settings: ``key=value`` of the model (see `wrf_mi.hybrid.models`).
        antennas: patterns and polarisations in place of what the data state; with a scene.
        deterministic: on one thread of the CPU, so bit-identical from run to run.
        listen: hears what is being done and the share of it that is done.

    Returns:
        The run folder.

    Raises:
        InputError: data, scene, settings or folder that cannot be used.
    """
    check_new(Path(out))
    record, source = opened(dataset)
    place = None if scene is None else str(scene)
    config = HybridConfig(
        source, split, n_train, seed, place, material, settings, antennas=antennas, deterministic=deterministic
    )
    run = HybridRun(Path(out), config, record)
    run.check_antennas()
    # Without training rows the split keeps them for the references beside the model, which need some.
    splits = make_splits(record, split, seed, None if n_train == 0 else n_train)
    for rows in splits:
        check_observations(record, rows)
    return run.train(splits, listen)


def resume_hybrid(folder: Path, listen: Listen = lambda what, share: None) -> Path:
    """Go on with a run that was stopped: folds that were fitted are kept.

    Raises:
        InputError: not a run of the hybrid.
    """
    return HybridRun.stored(folder).resume(listen)


def evaluate_hybrid(folder: Path, split: str | None = None) -> dict[str, Any]:
    """Score a run again.

    Args:
        folder: the run; without ``split`` its ``metrics.json`` and ``predictions.npz`` are written anew.
        split: score on another split's test rows that the run has not seen; nothing is written.

    Raises:
        InputError: not a finished run, or no row of ``split`` is left that it has not seen.
    """
    run = HybridRun.stored(folder)
    return run.score() if split is None else run.score_on(split)


def open_hybrid(folder: str | Path) -> HybridModel:
    """The fitted model of a run: ``open_hybrid(run).predict(tx_pos_m, receiver)`` gives mean and standard deviation.

    Raises:
        InputError: not a finished run, or one over several splits; a data set or scene that is not there any more.
    """
    return HybridRun.stored(Path(folder)).the_model()


def predict_hybrid(
    folder: Path, tx_pos_m: FloatArray, tx_heading_rad: FloatArray | None = None
) -> tuple[NDArray[Any], FloatArray, tuple[str, ...]]:
    """What a run's receivers report of new transmitter positions.

    Args:
        folder: the run, with one split.
        tx_pos_m: positions [q, 3], metres.
        tx_heading_rad: how the transmitter is turned, [q]; None: unknown.

    Returns:
        Observations [n_rx, q, ...], their predicted standard deviations, and the receivers' names.

    Raises:
        InputError: not a finished run, or one over several splits.
    """
    return predict_with(open_hybrid(folder), tx_pos_m, tx_heading_rad)


def predict_with(
    model: HybridModel, tx_pos_m: FloatArray, tx_heading_rad: FloatArray | None
) -> tuple[NDArray[Any], FloatArray, tuple[str, ...]]:
    """The same with a run's model from `open_hybrid`.

    Raises:
        InputError: headings for a model that does not use them.
    """
    if tx_heading_rad is not None and not model.uses_heading:
        raise InputError(f"{MODEL}: {UNUSED_HEADING}")
    found = [model.predict(tx_pos_m, r, tx_heading_rad) for r in range(len(model.receivers))]
    names = tuple(receiver.name for receiver in model.receivers)
    return np.stack([e.mean for e in found]), np.stack([e.stated_std for e in found]), names
