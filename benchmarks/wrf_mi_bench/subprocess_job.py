"""A computation in a subprocess, to be compared with that of another one.

``python -m wrf_mi_bench.subprocess_job JOB FILE``: ``JOB`` is a `Job` as JSON; arrays go to ``FILE`` (npz).
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend import init
from wrf_mi.backend.libraries import LLVM_VARIABLE
from wrf_mi.core.files import stored_arrays, write_arrays
from wrf_mi.parallel import run_module

Arrays = dict[str, NDArray[Any]]


class SubprocessJobFailed(RuntimeError):
    """The subprocess failed."""

    exit_status = 1


@dataclass(frozen=True)
class Job:
    """A computation.

    Attributes:
        kind: a key of `KINDS`.
        dataset: name or folder of a data set.
        settings: settings of the fit, ``key=value``.
        scene: scene of a physics model or of ray tracing; "": none.
        n_train: number of training rows; 0: all.
        stop: step after which a fit is stopped, to be resumed in another subprocess; 0: none.
        deterministic: whether to fit with ``--deterministic``.
        threads: number of Dr.Jit's threads; 0: its default.
        backend: ``"llvm"`` or ``"cuda"``.
    """

    kind: str
    dataset: str
    settings: tuple[str, ...] = ()
    scene: str = ""
    n_train: int = 0
    stop: int = 0
    deterministic: bool = False
    threads: int = 0
    backend: str = "llvm"


def subprocess_job(job: Job, llvm: Path | str | None = None) -> Arrays:
    """Arrays that a job computes in a subprocess, with another LLVM library where one is given (see `KINDS`)."""
    with TemporaryDirectory() as work:
        out = Path(work) / "out.npz"
        with _llvm_library(llvm):
            status, message = run_module(__name__, [json.dumps(asdict(job)), str(out)], quiet=True)
        if status != 0:
            raise SubprocessJobFailed(f"{job.kind} of {job.dataset} ended with status {status}: {message}")
        return stored_arrays(out)


@contextmanager
def _llvm_library(llvm: Path | str | None) -> Iterator[None]:
    """Context in which subprocesses load an LLVM library; None: that of this process."""
    before = os.environ.get(LLVM_VARIABLE)
    if llvm is not None:
        os.environ[LLVM_VARIABLE] = str(llvm)
    try:
        yield
    finally:
        os.environ.pop(LLVM_VARIABLE, None)
        if before is not None:
            os.environ[LLVM_VARIABLE] = before


def _results(folder: Path, *files: str) -> Arrays:
    """Arrays of a run's files and its predictions at positions near those of test rows, without times."""
    from wrf_mi.runs.api import predict_to_file

    tx_pos_m = stored_arrays(folder / "predictions.npz")["tx_pos"][:8]
    predict_to_file(folder, tx_pos_m + 0.01, folder / "new.npz")
    return {
        f"{name}: {key}": values
        for name in (*files, "predictions.npz", "new.npz")
        for key, values in stored_arrays(folder / name).items()
        if not key.endswith("seconds")
    }


def _field(job: Job, work: Path) -> Arrays:
    from wrf_mi.core.settings import with_settings
    from wrf_mi.runs.api import Interrupted, train
    from wrf_mi.training.config import TrainConfig

    config: Any = with_settings(TrainConfig(deterministic=job.deterministic), job.settings)
    steps = iter(range(1, config.steps))
    with suppress(Interrupted):
        train(job.dataset, work, config.model, settings=config, stop=lambda: next(steps) == job.stop)
    if job.stop:
        run_module("wrf_mi.cli", ["train", "--resume", str(work)], quiet=True)
    score = json.loads((work / "metrics.json").read_text())["ssim"]["median"]
    return _results(work, "model.npz") | {"score": np.asarray(score)}


def _physics(job: Job, work: Path) -> Arrays:
    from wrf_mi.runs.api import train

    train(job.dataset, work, "physics", scene=job.scene or None, n_train=job.n_train or None, settings=job.settings)
    return _results(work, "model.npz")


def _channels(job: Job, work: Path) -> Arrays:
    """A physics model for channels in a CAD room, on a mesh made of a simulated scan."""
    from wrf_mi.models.physics.csi import fit_csi
    from wrf_mi.models.physics.csi_fit import CsiSettings
    from wrf_mi.synthetic import load_record

    from .comparison import room_file
    from .physics_csi import scanned_scene

    record = load_record(job.dataset)
    assert record.official is not None
    train, test = record.official
    room = room_file(job.dataset.removeprefix("newrf-"))
    model = fit_csi(record, train[: job.n_train or None], scanned_scene(room, work.parent, 1), CsiSettings(), 0)
    found = model.predict(record.tx_pos_m[test], 0)
    return {**model.arrays(), "mean": found.mean, "std": found.stated_std}


def _traced(job: Job, work: Path) -> Arrays:
    from wrf_mi.runs.api import train

    train(job.dataset, work, "ray-tracing", scene=job.scene)
    return _results(work, "paths.npz")


def _step(job: Job, work: Path) -> Arrays:
    """Images of a batch and gradient of one step, at the initial parameters."""
    import drjit as dr
    import mitsuba as mi

    from wrf_mi.backend.device import to_float, to_tensor
    from wrf_mi.core.settings import with_settings
    from wrf_mi.datasets import make_splits
    from wrf_mi.gaussians.tiles import perception_plane
    from wrf_mi.synthetic import load_record
    from wrf_mi.tasks.losses import spectrum_loss
    from wrf_mi.training.config import TrainConfig
    from wrf_mi.training.step import TrainingData, device_pose, grey
    from wrf_mi.training.trainer import Trainer

    record = load_record(job.dataset)
    (split,) = make_splits(record, "official")
    trainer = Trainer(record, split, with_settings(TrainConfig(), job.settings))
    params = {name: to_tensor(values) for name, values in trainer.state.params().items()}
    plane, pose = perception_plane(*record.observation.shape[-2:], mi.Float), device_pose(record.receivers[0])
    data = TrainingData(to_tensor(record.tx_pos_m.T), to_float(record.observation), to_float([1.0]))
    for value in params.values():
        dr.enable_grad(value)
    config = trainer.config
    tx, truth = data.select(mi.UInt32(split.train[: config.batch].tolist()), mi.UInt32(0), plane.pixels)
    image = grey(trainer.field, params, tx, pose, plane)
    loss = spectrum_loss(image, truth, config.batch, plane.height, plane.width, config.loss.ssim_weight)[0]
    dr.backward(loss)
    gradients = {f"gradient/{name}": dr.grad(value).numpy() for name, value in params.items()}
    return {"image": dr.detach(image).numpy(), **gradients}


KINDS: Mapping[str, Callable[[Job, Path], Arrays]] = {
    "field": _field,
    "physics": _physics,
    "channels": _channels,
    "traced": _traced,
    "step": _step,
}
"""Computations by name. ``field``, ``physics`` and ``traced`` return a run's arrays and predictions at new positions,
``channels`` a model and its predictions, ``step`` images and a gradient."""


def main(job: str, out: str) -> None:
    """Compute a job in this process."""
    given = json.loads(job)
    asked = Job(**{**given, "settings": tuple(given["settings"])})
    # As the command: with --deterministic on one thread.
    init(asked.backend, 1 if asked.deterministic else asked.threads or None)
    with TemporaryDirectory() as work:
        write_arrays(Path(out), KINDS[asked.kind](asked, Path(work) / "run"))


if __name__ == "__main__":
    main(*sys.argv[1:])
