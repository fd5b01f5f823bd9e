"""The run folder: what `train` writes and everything later reads.

    config.yaml     data set, split, seed, versions and all settings, resolved
    split.npz       rows that trained, chose and score
    log.jsonl       a line each ``log_every`` steps: step, seconds, loss, validation_ssim, held_out, gaussians
    checkpoint.npz  format version, parameters, optimiser state, receivers; arrays only. Of a compressed run:
                    parameters in few bits (`wrf_mi.fit.packed`), no optimiser state
    operator0.npz   where Gaussians stand still: their weights in each pixel at receiver 0 (`wrf_mi.fit.still`),
                    made by the first prediction, safe to delete

Every file appears whole or not at all.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, astuple, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from .. import __version__
from ..backend import init
from ..core import Antenna, AntennaOptions, InputError, Record, Split, receiver_arrays, stored_receivers
from ..core.antenna import AS_STATED
from ..core.files import readable, stored_arrays, write_arrays, write_atomically
from ..core.receivers import KEYS as RECEIVER_KEYS
from ..graph.graph import Graph
from ..graph.receivers import Form
from ..measure import load_split, save_split
from ..tasks import instrument_of
from .config import TrainConfig, from_dict, to_dict
from .packed import pack_params, unpack_params
from .predictor import Predictor
from .state import FitState
from .trainer import Progress, Trainer, check_rows, final_params, make_field

FORMAT = 5
"""Version of ``checkpoint.npz``."""
PACKED_FORMAT = 6
"""Version of ``checkpoint.npz`` of a compressed run."""

CONFIG, SPLIT, LOG, CHECKPOINT = "config.yaml", "split.npz", "log.jsonl", "checkpoint.npz"


@dataclass(frozen=True)
class RunConfig:
    """What ``config.yaml`` says.

    Attributes:
        dataset: name or folder that was loaded.
        split: its name; one fold has its own, e.g. ``blocked:2``.
        n_train: number or fraction of training rows that was asked for; None: all.
        settings: of the fit.
        scene: name, scene folder, Mitsuba XML or mesh whose paths were trained together with the Gaussians; None: none.
        material: of a bare mesh, or None.
        antennas: stated in place of the data's.
    """

    dataset: str
    split: str
    n_train: float | None
    settings: TrainConfig
    scene: str | None = None
    material: str | None = None
    antennas: AntennaOptions = AS_STATED

    def open_scene(self, record: Record) -> Any | None:
        """The scene at the record's carrier, or None.

        Raises:
            InputError: it cannot be opened, or the data do not tell carrier or array.
        """
        if self.scene is None:
            return None
        return open_scene_at(self.scene, instrument_of(record).carrier_hz, self.material)


def open_scene_at(scene: str, frequency_hz: float, material: str | None) -> Any:
    """A scene for the tracer, which is imported now.

    Raises:
        InputError: it cannot be opened.
    """
    from ..trace import open_scene

    return open_scene(scene, frequency_hz, material=material)


def package_versions() -> dict[str, str]:
    """Versions of this package, of those that compute for it, and of Python."""
    packages = ("mitsuba", "drjit", "sionna-rt", "numpy", "scipy", "scikit-image", "scikit-learn")
    return {
        "wrf-mi": __version__,
        **{name: importlib.metadata.version(name) for name in packages},
        "python": platform.python_version(),
    }


def versions() -> dict[str, str]:
    """Versions of what computes: packages, backend and device."""
    backend = init()
    return {
        **package_versions(),
        "backend": f"{backend.name} {backend.llvm_version or ''}".strip(),
        "device": backend.device,
    }


def write_config(folder: Path, run: RunConfig) -> None:
    """Write ``config.yaml``."""
    content = {
        "dataset": run.dataset,
        "split": run.split,
        "n_train": run.n_train,
        "seed": run.settings.seed,
        "versions": versions(),
        "scene": run.scene,
        "material": run.material,
        "antennas": asdict(run.antennas),
        "settings": to_dict(run.settings),
    }
    write_atomically(folder / CONFIG, yaml.safe_dump(content, sort_keys=False))


def read_config(folder: Path) -> RunConfig:
    """Read ``config.yaml``.

    Raises:
        InputError: missing, not YAML, or settings that this version does not know.
    """
    with stated_config(folder) as content:
        names = ("dataset", "split", "n_train", "scene", "material")
        kept, antennas = {name: content[name] for name in names}, AntennaOptions(**content["antennas"])
        settings = from_dict(content["settings"], str(folder / CONFIG))
    return RunConfig(**kept, settings=settings, antennas=antennas)


@contextmanager
def stated_config(folder: Path, made_by: str = "train") -> Iterator[dict[str, Any]]:
    """What ``config.yaml`` of a run of any kind says; the block may take from it what has to be there.

    Args:
        folder: of the run.
        made_by: command that makes such runs.

    Raises:
        InputError: missing, not YAML, or without what the block takes.
    """
    path = folder / CONFIG
    with readable(path, f"{folder}: no {CONFIG}, so not a run folder; give one made by {made_by}", "restore it"):
        content = yaml.safe_load(path.read_text())
        if not isinstance(content, dict):
            raise InputError(f"{path}: not readable (no settings in it); restore it")
        yield content


def check_new(folder: Path, other: str = "") -> None:
    """See that a folder can be made.

    Args:
        folder: a run folder to be.
        other: what else might have been meant, after "choose another --out".

    Raises:
        InputError: it holds something already.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists and is not empty; choose another --out{other}")


def part_folders(folder: Path, splits: Sequence[Split]) -> list[tuple[Path, Split]]:
    """Where each split of a run is kept: one at the top, several in ``fold0``, ..."""
    if len(splits) == 1:
        return [(folder, splits[0])]
    return [(folder / f"fold{k}", rows) for k, rows in enumerate(splits)]


def stored_parts(folder: Path) -> list[Path]:
    """The folders of a run that hold a split."""
    return [folder] if (folder / SPLIT).exists() else sorted(folder.glob("fold*"))


def write_checkpoint(folder: Path, trainer: Trainer) -> None:
    """Write ``checkpoint.npz``: enough to go on and enough to predict."""
    arrays = trainer.state.arrays() | {
        "format": np.asarray(FORMAT),
        "seconds": np.asarray(trainer.seconds),
        "tx_antenna": np.asarray(astuple(trainer.record.tx_antenna)),
        **trainer.graph.form.arrays(),
        **receiver_arrays(trainer.graph.receivers),
    }
    write_arrays(folder / CHECKPOINT, arrays)


def write_packed(
    folder: Path, source: Mapping[str, NDArray[Any]], params: Mapping[str, NDArray[np.float32]], precision: str
) -> int:
    """Write ``checkpoint.npz`` of a compressed run: enough to predict, and no more.

    Args:
        folder: of the compressed run.
        source: arrays of the checkpoint that it was made from, for what stays.
        params: its parameters.
        precision: of their numbers, see `wrf_mi.fit.packed`.

    Returns:
        Its size, bytes.
    """
    kept = ("step", "seconds", "tx_antenna", *RECEIVER_KEYS)
    arrays = {"format": np.asarray(PACKED_FORMAT)} | {key: source[key] for key in kept}
    arrays |= Form.of(source).arrays()
    arrays |= pack_params(params, precision)
    return write_arrays(folder / CHECKPOINT, arrays, compressed=True).stat().st_size


def read_checkpoint(folder: Path) -> dict[str, NDArray[Any]]:
    """Arrays of ``checkpoint.npz``.

    Raises:
        InputError: missing, damaged, or of another format version.
    """
    path = folder / CHECKPOINT
    missing = f"{folder}: no {CHECKPOINT}, the run was stopped early; go on with train --resume"
    with readable(path, missing, "restore it or train anew"):
        arrays = stored_arrays(path)
        version = int(arrays["format"])
        if version == PACKED_FORMAT:
            arrays |= {f"mean/{name}": values for name, values in unpack_params(arrays).items()}
    if version not in (FORMAT, PACKED_FORMAT):
        known = f"{FORMAT} and {PACKED_FORMAT}"
        raise InputError(f"{path}: format {version}, this version reads {known}; use the version that wrote it")
    return arrays


def append_log(folder: Path, progress: Progress) -> None:
    """Add a line to ``log.jsonl``."""
    entry = asdict(progress)
    del entry["left_s"]
    if progress.validation_ssim is not None and math.isnan(progress.validation_ssim):
        entry["validation_ssim"] = None  # there are no validation rows, and JSON has no NaN
    with (folder / LOG).open("a") as stream:
        stream.write(json.dumps(entry) + "\n")


def cut_log(folder: Path, step: int) -> None:
    """Drop lines after ``step``: what was logged after the checkpoint that a run goes on from happens again."""
    path = folder / LOG
    if path.is_file():
        lines = [line for line in path.read_text().splitlines() if line and json.loads(line)["step"] <= step]
        write_atomically(path, "".join(f"{line}\n" for line in lines))


def start_run(folder: Path, record: Record, split: Split, run: RunConfig) -> Trainer:
    """A new run in a new or empty folder.

    Raises:
        InputError: the folder holds something already, or the split has rows that the record has not.
    """
    check_new(folder, f", or go on with train --resume {folder}")
    trainer = Trainer(record, split, run.settings, scene=run.open_scene(record))
    folder.mkdir(parents=True, exist_ok=True)
    save_split(folder / SPLIT, split)
    write_config(folder, replace(run, settings=trainer.config))
    return trainer


def load_rows(folder: Path, record: Record) -> Split:
    """The rows of a run.

    Raises:
        InputError: no split file, a damaged one, or one with rows that the record has not.
    """
    split = load_split(folder / SPLIT)
    check_rows(split, record, str(folder / SPLIT))
    return split


def resume_run(folder: Path, record: Record) -> Trainer:
    """A run as its last checkpoint left it; from the start if it was stopped before the first."""
    run, split = read_config(folder), load_rows(folder, record)
    if (folder / CHECKPOINT).exists():
        arrays = read_checkpoint(folder)
        if int(arrays["format"]) == PACKED_FORMAT:
            raise InputError(f"{folder}: compressed, so without what training needs; go on with the run it is made of")
        state = FitState.from_arrays(arrays)
        trainer = Trainer(record, split, run.settings, state=state, scene=run.open_scene(record))
        trainer.seconds = float(arrays["seconds"])
    else:
        trainer = Trainer(record, split, run.settings, scene=run.open_scene(record))
    cut_log(folder, trainer.state.step)
    return trainer


def load_predictor(folder: str | Path, operator: bool = True) -> Predictor:
    """The trained field of a run folder, ready to predict.

    Args:
        folder: of the run.
        operator: predict by operator where the field allows it; operators are stored in the folder.

    Raises:
        InputError: not a run folder, or a damaged one.
    """
    path = Path(folder)
    config, arrays = read_config(path), read_checkpoint(path)
    form, receivers, settings = Form.of(arrays), stored_receivers(arrays), config.settings
    field = make_field(settings, form.components, form.features)
    scene = None if config.scene is None else open_scene_at(config.scene, form.carrier_hz, config.material)
    graph = Graph(field, receivers, form, scene, settings.traced, Antenna(*map(str, arrays["tx_antenna"])))
    return Predictor(field, final_params(arrays), receivers, *form.size, settings.skip, operator, path, graph=graph)
