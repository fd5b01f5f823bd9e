"""Faults of small trainings: killed at every write and at random moments, a full disk, a closed pipe, Ctrl-C twice.

Each training is a fork of one process that has imported everything and computed nothing (``python -m
wrf_mi_bench.faults FOLDER MODELS KILLS``). A killed training is resumed, and has to give the metrics, predictions and
arrays of one that was left alone, bit for bit, with no other file.
"""

from __future__ import annotations

import contextlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from wrf_mi.cli.main import main as command
from wrf_mi.core.array_files import stored_arrays
from wrf_mi.core.files import write_atomically
from wrf_mi.runs.folder import CONFIG, FITTED, METRICS, PREDICTIONS, SECONDS

SETTINGS = {
    "kriging": (),
    "vae": ("steps=4", "width=8", "last=8", "checkpoint_every=2"),
    "wrf-gs+": (
        *("initial.gaussians=8", "network.width=8", "network.layers=2", "steps=6", "checkpoint_every=2"),
        *("log_every=1", "validate_every=3", "density.every=0"),
    ),
}
"""Settings of short trainings by model: one that is fitted at once, a network, and Gaussians."""
TIMES = ("train_seconds", "ms_per_sample", "peak_memory_mb")
"""Metrics that differ from run to run."""
FILE_BYTES = (250, 400, 1500, 6000)
"""Limits of the size of files, in place of a full disk; the message on standard error is a file here, too."""
MOST_S = 120.0
REFUSED, INTERRUPTED, CLOSED = 2, 130, 141
EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")
"""Audit events of Python that change folders; opening a file to write is another."""


def count_changes(folder: Path, kill_at: int = 0) -> list[int]:
    """Number of changes of files below a folder that this process makes, kept up to date; it is killed at a number."""
    count, below = [0], str(folder)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if (writes or event in EVENTS) and str(arguments[0]).startswith(below):
            count[0] += 1
            if count[0] == kill_at:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(hook)
    return count


def forked(work: Callable[[], int], errors: Path, kill_after_s: float | None = None) -> int:
    """Status of a function in a fork of this process, negative for a signal; its standard error goes to a file."""
    child = os.fork()
    if not child:
        status = 70
        with contextlib.suppress(BaseException):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(errors, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
            status = work()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    until = time.monotonic() + (MOST_S if kill_after_s is None else kill_after_s)
    while True:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() > until:
            os.kill(child, signal.SIGKILL)
            return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        time.sleep(0.005)


class Training:
    """A short training of a model, and what it gives when it is left alone.

    Args:
        model: a key of `SETTINGS`.
        data: folder of spectra.
        folder: folder for runs.
    """

    def __init__(self, model: str, data: Path, folder: Path) -> None:
        self.model, self.data, self.folder = model, data, folder
        self.errors = folder / "errors.txt"
        folder.mkdir(parents=True, exist_ok=True)
        whole = folder / "whole"
        start = time.monotonic()
        status = self.train(whole)
        self.seconds = time.monotonic() - start
        if status != 0:
            raise RuntimeError(f"{model}: a training that was left alone ended with status {status}")
        self.files, self.content = self._content(whole)

    def changes(self) -> int:
        """Number of changes of files of a training."""
        out, stored = self.folder / "counted", self.folder / "changes.txt"

        def work() -> int:
            count = count_changes(out)
            status = command(self._new(out))
            stored.write_text(str(count[0]))
            return status

        forked(work, self.errors)
        shutil.rmtree(out)
        return int(stored.read_text())

    def _new(self, out: Path) -> list[str]:
        call = ["train", str(self.data), "--model", self.model, "--deterministic", "--out", str(out)]
        return [*call, *(part for setting in SETTINGS[self.model] for part in ("--set", setting))]

    def train(self, out: Path, before: Callable[[], Any] = lambda: None, kill_after_s: float | None = None) -> int:
        """Status of a training into a folder, or of its continuation there."""
        resumed = (out / CONFIG).exists()

        def work() -> int:
            before()
            return command(["train", "--resume", str(out)] if resumed else self._new(out))

        return forked(work, self.errors, kill_after_s)

    def _content(self, run: Path) -> tuple[set[str], dict[str, Any]]:
        metrics = json.loads((run / METRICS).read_text())
        content: dict[str, Any] = {key: value for key, value in metrics.items() if key not in TIMES}
        content |= {f"{FITTED}/{key}": v for key, v in stored_arrays(run / FITTED).items() if key != SECONDS}
        content |= {f"{PREDICTIONS}/{key}": values for key, values in stored_arrays(run / PREDICTIONS).items()}
        return {path.relative_to(run).as_posix() for path in run.rglob("*")}, content

    def finished(self, out: Path) -> str:
        """Go on to the end; what differs from a training that was left alone, or ""."""
        status = self.train(out)
        if status != 0:
            return f"going on ended with status {status}: {self.message()}"
        files, content = self._content(out)
        if files != self.files:
            return f"other files: {', '.join(sorted(files ^ self.files))}"
        if content.keys() != self.content.keys():
            return "other keys of the results"
        wrong = [key for key, value in self.content.items() if not _same(value, content[key])]
        return f"other results: {', '.join(wrong)}" if wrong else ""

    def message(self) -> str:
        """Last line of the standard error of the last training."""
        lines = self.errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def one_line(self, status: int, wanted: int) -> str:
        """What is wrong with status and message of a training that was refused; "" if nothing is."""
        text = self.errors.read_text(errors="replace")
        if status != wanted or "Traceback" in text or not self.message().startswith("wrf-mi: "):
            return f"status {status} for {wanted}, {self.message()[:200]!r}"
        return ""


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    return bool(one == other)


def killed_at_changes(training: Training, most: int | None) -> Iterator[str]:
    """Kill a training at each change of files, or at ``most`` of them spread over all."""
    changes = training.changes()
    numbers = list(range(1, changes + 1))
    if most is not None and most < changes:
        numbers = np.unique(np.linspace(1, changes, most).astype(int)).tolist()
    for number in numbers:
        out = training.folder / f"change{number}"
        status = training.train(out, partial(count_changes, out, number))
        wrong = training.finished(out) if status == -signal.SIGKILL else f"status {status} for a kill"
        shutil.rmtree(out, ignore_errors=True)
        yield wrong and f"{training.model}, killed at change {number} of {changes}: {wrong}"


def killed_at_random(training: Training, count: int) -> Iterator[str]:
    """Kill a training at random moments, once or several times before its end."""
    rng = random.Random(training.model)
    for number in range(count):
        out, kills = training.folder / f"random{number}", 0
        while rng.random() < 0.7 or not kills:
            training.train(out, kill_after_s=rng.uniform(0, training.seconds))
            kills += 1
        wrong = training.finished(out)
        shutil.rmtree(out, ignore_errors=True)
        yield wrong and f"{training.model}, killed at {kills} random moments: {wrong}"


def full_disk(training: Training, sizes: Sequence[int]) -> Iterator[str]:
    """Limit the size of files: refused in one line, and gone on with later."""
    for size in sizes:
        out = training.folder / f"full{size}"
        limits = (size, resource.RLIM_INFINITY)
        status = training.train(out, partial(resource.setrlimit, resource.RLIMIT_FSIZE, limits))
        wrong = training.one_line(status, REFUSED) if status else ""
        wrong = wrong or training.finished(out)
        shutil.rmtree(out, ignore_errors=True)
        yield wrong and f"{training.model}, files of {size} bytes at most: {wrong}"


def signals_and_pipes(training: Training) -> Iterator[str]:
    """A closed pipe, Ctrl-C twice, and a second training into the folder of one that runs."""
    whole = training.folder / "whole"

    def closed() -> int:
        read, write = os.pipe()
        os.close(read)
        os.dup2(write, 1)
        return command(["evaluate", str(whole)])

    status = forked(closed, training.errors)
    text = training.errors.read_text().strip()
    yield "" if (status, text) == (CLOSED, "") else f"a closed pipe: status {status}, {text[:200]!r}"
    out = training.folder / "twice"

    def impatient() -> None:
        def stop(*_: Any) -> bool:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            return False

        from wrf_mi.cli.output import Watch

        setattr(Watch, "on_progress", stop)  # noqa: B010

    wrong = training.one_line(training.train(out, impatient), INTERRUPTED) or training.finished(out)
    yield wrong and f"Ctrl-C twice: {wrong}"
    from wrf_mi.core.locks import locked_folder

    shutil.rmtree(out)
    shutil.copytree(whole, out)
    with locked_folder(out):
        wrong = training.one_line(training.train(out), REFUSED)
    yield wrong and f"a second training into a folder: {wrong}"


def measure(folder: Path, models: Sequence[str], kills: int | None) -> dict[str, Any]:
    """Cases and failures of all faults, by their kind.

    Args:
        folder: folder for data (``data``) and runs.
        models: keys of `SETTINGS`.
        kills: random kills, and kills at changes of files, of each model; None: 20, and all.
    """
    found: dict[str, list[str]] = {}
    for model in models:
        training = Training(model, folder / "data", folder / model)
        parts: dict[str, Iterator[str]] = {
            "killed at a write or rename": killed_at_changes(training, kills),
            "killed at random moments": killed_at_random(training, 20 if kills is None else kills),
            "full disk": full_disk(training, FILE_BYTES if kills is None else FILE_BYTES[1:3]),
            "pipe, Ctrl-C, lock": signals_and_pipes(training),
        }
        for kind, cases in parts.items():
            for wrong in cases:
                found.setdefault(kind, []).append(wrong)
                print(f"{model}: {kind} {len(found[kind])} {wrong}", file=sys.stderr, flush=True)
    return {kind: {"cases": len(every), "failed": [one for one in every if one]} for kind, every in found.items()}


def run(folder: Path, models: Sequence[str] = tuple(SETTINGS), kills: int | None = None) -> dict[str, Any]:
    """`measure` in a process of its own, over spectra that are made in the folder."""
    from .hostile_samples import prepare_spectra

    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "data").exists():
        prepare_spectra(folder / "data")
    call = [sys.executable, "-m", "wrf_mi_bench.faults", str(folder), ",".join(models), str(kills or 0)]
    done = subprocess.run(call, check=False, stdout=subprocess.DEVNULL)
    if done.returncode != 0:
        raise RuntimeError(f"faults: ended with status {done.returncode}")
    figures: dict[str, Any] = json.loads((folder / "faults.json").read_text())
    return figures


def main(folder: str, models: str, kills: str) -> None:
    """Measure, and write ``faults.json`` in the folder."""
    place = Path(folder)
    import_module("wrf_mi.runs.api")  # before the first fork: all that a training needs
    figures = measure(place, models.split(","), int(kills) or None)
    write_atomically(place / "faults.json", json.dumps(figures, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
