"""One computation in a process of its own, to be held against the same in another process.

``python -m wrf_mi_bench.alone JOB FILE``: ``JOB`` is a `Job` as JSON; arrays go to ``FILE`` (npz).
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
from wrf_mi.core.files import write_arrays
from wrf_mi.parallel import run_module

Arrays = dict[str, NDArray[Any]]


class AloneFailed(RuntimeError):
    """The process failed; says how."""

    exit_status = 1


@dataclass(frozen=True)
class Job:
    """What to compute.

    Attributes:
        kind: a key of `KINDS`.
        dataset: name or folder.
        settings: of the fit, ``key=value``.
        scene: of a physics model or traced run; "": none.
        material: of a bare mesh; "": it is none.
        n_train: training rows; 0: all.
        stop: step after which a fit is stopped, to be gone on with in another process; 0: none.
        deterministic: as the command's flag.
        threads: of Dr.Jit; 0: its own choice.
        backend: ``"llvm"`` or ``"cuda"``.
    """

    kind: str
    dataset: str
    settings: tuple[str, ...] = ()
    scene: str = ""
    material: str = ""
    n_train: int = 0
    stop: int = 0
    deterministic: bool = False
    threads: int = 0
    backend: str = "llvm"


def alone(job: Job, llvm: Path | str | None = None) -> Arrays:
    """Do a job in a process of its own.

    Args:
        job: what to do.
        llvm: library to compute with; None: as this process.

    Returns:
        What it computed, see `KINDS`.

    Raises:
        AloneFailed: the process did not end well.
    """
    with TemporaryDirectory() as work:
        out = Path(work) / "out.npz"
        with _computing_with(llvm):
            status, said = run_module(__name__, [json.dumps(asdict(job)), str(out)], quiet=True)
        if status != 0:
            raise AloneFailed(f"{job.kind} of {job.dataset} ended with status {status}: {said}")
        with np.load(out, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}


@contextmanager
def _computing_with(llvm: Path | str | None) -> Iterator[None]:
    """Processes that are started in the block load this LLVM; None: the same as this process."""
    before = os.environ.get(LLVM_VARIABLE)
    if llvm is not None:
        os.environ[LLVM_VARIABLE] = str(llvm)
    try:
        yield
    finally:
        os.environ.pop(LLVM_VARIABLE, None)
        if before is not None:
            os.environ[LLVM_VARIABLE] = before


def _of_run(folder: Path, files: tuple[str, ...]) -> Arrays:
    """Arrays of a run's files, but how long it took."""
    found: Arrays = {}
    for name in files:
        with np.load(folder / name, allow_pickle=False) as stored:
            found |= {f"{name}: {key}": stored[key] for key in stored.files if not key.endswith("seconds")}
    return found


def _predicted(folder: Path) -> Arrays:
    """What ``predict`` writes at positions between those of the test rows."""
    from wrf_mi.runs.api import predict_to_file

    with np.load(folder / "predictions.npz") as stored:
        tx = stored["tx_pos"][:8]
    predict_to_file(folder, tx + 0.01, folder / "new.npz")
    return _of_run(folder, ("new.npz",))


def _field(job: Job, work: Path) -> Arrays:
    from wrf_mi.core.settings import with_settings
    from wrf_mi.runs.api import Interrupted, train
    from wrf_mi.training.config import TrainConfig

    config: Any = with_settings(TrainConfig(deterministic=job.deterministic), job.settings)
    taken = iter(range(1, config.steps))
    asked: dict[str, Any] = {"settings": config, "n_train": job.n_train or None}
    with suppress(Interrupted):
        train(job.dataset, work, config.model, **asked, stop=lambda: next(taken) == job.stop)
    if job.stop:  # gone on with in a process that has compiled and drawn nothing yet
        run_module("wrf_mi.cli", ["train", "--resume", str(work)], quiet=True)
    score = json.loads((work / "metrics.json").read_text())["ssim"]["median"]
    files = _of_run(work, ("model.npz", "predictions.npz"))
    return files | _predicted(work) | {"score": np.asarray(score)}


def _physics(job: Job, work: Path) -> Arrays:
    from wrf_mi.runs.api import train

    asked: dict[str, Any] = {"material": job.material or None, "n_train": job.n_train or None}
    train(job.dataset, work, "physics", scene=job.scene or None, **asked, settings=job.settings)
    return _of_run(work, ("model.npz", "predictions.npz")) | _predicted(work)


def _channels(job: Job, work: Path) -> Arrays:
    """A physics model for channels in a CAD room, on a mesh made of a simulated scan."""
    from wrf_mi.models.physics.csi import CsiSettings, fit_csi
    from wrf_mi.synthetic import load_record

    from .physics_csi import scanned_scene
    from .trace import room_file

    record = load_record(job.dataset)
    assert record.official is not None
    train, test = record.official
    room = room_file(job.dataset.removeprefix("newrf-"))
    model = fit_csi(record, train[: job.n_train or None], scanned_scene(room, work.parent, 1), CsiSettings(), 0)
    found = model.predict(record.tx_pos_m[test], 0)
    return {**model.arrays(), "mean": found.mean, "std": found.stated_std}


def _traced(job: Job, work: Path) -> Arrays:
    from wrf_mi.runs.api import train

    train(job.dataset, work, "ray-tracing", scene=job.scene, material=job.material or None)
    return _of_run(work, ("paths.npz", "predictions.npz")) | _predicted(work)


def _step(job: Job, work: Path) -> Arrays:
    """The images of a batch and the gradient of one step, of starting values."""
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
"""By name. ``field``, ``physics`` and ``traced`` make a run and give what its files hold and what it predicts at new
positions, ``channels`` a model and what it predicts, ``step`` images and a gradient."""


def main(job: str, out: str) -> None:
    """Do a job in this process."""
    given = json.loads(job)
    asked = Job(**{**given, "settings": tuple(given["settings"])})
    # As the command: with --deterministic on one thread.
    init(asked.backend, 1 if asked.deterministic else asked.threads or None)
    with TemporaryDirectory() as work:
        write_arrays(Path(out), KINDS[asked.kind](asked, Path(work) / "run"))


if __name__ == "__main__":
    main(*sys.argv[1:])
