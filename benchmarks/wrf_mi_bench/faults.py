"""Faults of commands: killed at every write and at random moments, full disk, folder without write permission, closed
pipe, Ctrl-C twice.

Each command (`wrf_mi_bench.fault_commands`) is a fork of one process that has imported everything and computed nothing
(``python -m wrf_mi_bench.faults FOLDER COMMANDS KILLS``). After the fault it goes on, and has to give the results of
one without faults, bit for bit, with no other file.
"""

import contextlib
import ctypes
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

from wrf_mi.apps.commands.main import main as command
from wrf_mi.core.files import write_atomically
from wrf_mi.core.locks import locked_folder

from .fault_commands import COMMANDS, Command, differing, prepare_data

MOST_S = 240.0
REFUSED, INTERRUPTED, CLOSED = 2, 130, 141
EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate")
"""Audit events of Python that change folders; opening a file to write is another."""
CAPABILITIES_VERSION, DAC_OVERRIDE = 0x20080522, 1
"""Version 3 of Linux's capabilities, and the one by which root writes where permissions forbid it (capabilities(7))."""

Signals = Sequence[tuple[float, int]]  # signals to a process: seconds after its start, and number


def watch_changes(folder: Path, at: int = 0, number: int = signal.SIGKILL, times: int = 1) -> list[str]:
    """Audit events of the changes of files below a folder that this process makes, kept up to date.

    A signal, which this process sends to itself, precedes the change ``at``, counted from 1, and the next ones, as many
    ``times`` in all; 0: none.
    """
    changes, below = list[str](), str(folder)

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
        if (writes or event in EVENTS) and str(arguments[0]).startswith(below):
            changes.append(event)
            if at and 0 <= len(changes) - at < times:
                os.kill(os.getpid(), number)

    sys.addaudithook(hook)
    return changes


def forked(work: Callable[[], int], errors: Path, signals: Signals = ()) -> int:
    """Status of a function in a fork of this process, negative for a signal; its standard error goes to a file."""
    read, write = os.pipe()  # not the file: its size may be limited
    child = os.fork()
    if not child:
        status = 70
        with contextlib.suppress(BaseException):
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(write, 2)
            status = work()
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(status)
    os.close(write)
    os.set_blocking(read, False)
    begun, left, ended = time.monotonic(), [*sorted(signals), (MOST_S, int(signal.SIGKILL))], 0
    with errors.open("wb") as stream:
        while not ended:
            time.sleep(0.005)
            ended, status = os.waitpid(child, os.WNOHANG)
            with contextlib.suppress(BlockingIOError):
                while piece := os.read(read, 1 << 16):
                    stream.write(piece)
            if left and not ended and time.monotonic() - begun > left[0][0]:
                os.kill(child, left.pop(0)[1])
    os.close(read)
    return os.waitstatus_to_exitcode(status)


def obey_permissions() -> None:
    """Root, too, is refused what the permissions of files and folders forbid."""
    header, data = (ctypes.c_uint32 * 2)(CAPABILITIES_VERSION, 0), (ctypes.c_uint32 * 6)()
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.capget(header, data) == 0:
        data[0] &= ~(1 << DAC_OVERRIDE)  # of the effective ones
        libc.capset(header, data)


class Trial:
    """A command, and its results without faults, in a folder for data and results."""

    def __init__(self, command: Command, folder: Path) -> None:
        self.command, self.folder = command, folder
        self.errors, self.whole = folder / "errors.txt", folder / "whole"
        folder.mkdir(parents=True, exist_ok=True)
        changes = folder / "changes.json"

        def watch() -> Callable[[], object]:
            events = watch_changes(self.whole)
            return lambda: write_atomically(changes, json.dumps(events))

        status = self.run(self.whole, watch)
        if status != 0:
            raise RuntimeError(f"{command.name} without faults ended with status {status}: {self.message()}")
        self.changes: list[str] = json.loads(changes.read_text())
        self.files, self.content = self._found(self.whole)
        begun = time.monotonic()  # of the second time: the first one compiles kernels
        if wrong := self.finished(folder / "again"):
            raise RuntimeError(f"{command.name} without faults, called twice: {wrong}")
        self.seconds = time.monotonic() - begun
        shutil.rmtree(folder / "again")

    def run(
        self, place: Path, before: Callable[[], Any] = lambda: None, signals: Signals = (), children: bool = False
    ) -> int:
        """Status of the command with its results in a folder, where it goes on if it was begun.

        ``before`` is called in the fork before the command; what it returns, if callable, is called after it. With
        ``children`` the processes that the command starts stay processes, see `Command.prepare`.
        """
        place.mkdir(exist_ok=True)
        call = self.command.call(place)
        if call is None:
            return 0

        def work() -> int:
            self.command.prepare(children)
            after = before()
            status = command(call)
            if callable(after):
                after()
            return status

        return forked(work, self.errors, signals)

    def numbers(self, most: int | None) -> list[int]:
        """Numbers of all changes, or of some renames, the last one included."""
        if most is None:
            return list(range(1, len(self.changes) + 1))
        renames = [number for number, event in enumerate(self.changes, 1) if event == "os.rename"]
        return sorted({renames[round(k)] for k in np.linspace(len(renames) - 1, 0, most, endpoint=False)})

    def _found(self, place: Path) -> tuple[set[str], dict[str, Any]]:
        return {path.relative_to(place).as_posix() for path in place.rglob("*")}, self.command.content(place)

    def finished(self, place: Path) -> str:
        """Go on to the end; what differs from results without faults, or ""."""
        status = self.run(place)
        if status != 0:
            return f"going on ended with status {status}: {self.message()}"
        files, content = self._found(place)
        if files != self.files:
            return f"other files: {', '.join(sorted(files ^ self.files))}"
        wrong = differing(self.content, content)
        return f"other results: {', '.join(wrong)}" if wrong else ""

    def judged(self, place: Path, how: str, wrong: str = "") -> str:
        """What is wrong after a fault, or with the results of going on, which are removed; "" if nothing is."""
        wrong = wrong or self.finished(place)
        shutil.rmtree(place, ignore_errors=True)
        return wrong and f"{self.command.name}, {how}: {wrong}"

    def message(self) -> str:
        """Last line of the standard error of the last call."""
        lines = self.errors.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    def one_line(self, status: int, *wanted: int) -> str:
        """What is wrong with status and message of a command that was stopped; "" if nothing is."""
        text = self.errors.read_text(errors="replace")
        if status not in wanted or "Traceback" in text or not self.message().startswith("wrf-mi: "):
            return f"status {status} for {wanted}, {self.message()[:200]!r}"
        return ""


def killed_at_changes(trial: Trial, most: int | None) -> Iterator[str]:
    """Kill at each change of files, or at ``most`` of the renames, before which there are temporary files."""
    for number in trial.numbers(most):
        place = trial.folder / f"change{number}"
        status = trial.run(place, partial(watch_changes, place, number))
        wrong = "" if status == -signal.SIGKILL else f"status {status} for a kill"
        yield trial.judged(place, f"killed at change {number} of {len(trial.changes)}", wrong)


def killed_at_random(trial: Trial, count: int) -> Iterator[str]:
    """Kill at random moments, once or several times before the end."""
    rng = random.Random(trial.command.name)
    for number in range(count):
        place, kills = trial.folder / f"random{number}", 0
        while rng.random() < 0.7 or not kills:
            trial.run(place, signals=[(rng.uniform(0, trial.seconds), signal.SIGKILL)])
            kills += 1
        yield trial.judged(place, f"killed at {kills} random moments")


def full_disk(trial: Trial, most: int | None) -> Iterator[str]:
    """Limit the size of files: refused in one line, and gone on with later."""
    sizes = trial.command.file_bytes
    for size in sizes if most is None else sizes[1:3]:
        place = trial.folder / f"full{size}"
        limits = (size, resource.RLIM_INFINITY)
        status = trial.run(place, partial(resource.setrlimit, resource.RLIMIT_FSIZE, limits))
        wrong = trial.one_line(status, *trial.command.refused) if status else ""
        yield trial.judged(place, f"files of {size} bytes at most", wrong)


def no_permission(trial: Trial) -> Iterator[str]:
    """A folder without write permission: refused in one line, and gone on with when there is one."""
    place = trial.folder / "closed"
    place.mkdir()
    place.chmod(0o500)
    wrong = trial.one_line(trial.run(place, obey_permissions), REFUSED)
    place.chmod(0o700)
    yield trial.judged(place, "no write permission", wrong)


def interrupted(trial: Trial, most: int | None) -> Iterator[str]:
    """Ctrl-C twice: at a change of files and the next one, which may be the cleaning up, and at random moments."""
    rng = random.Random(trial.command.name)

    def stopped(place: Path, status: int, when: str) -> str:
        wrong = trial.one_line(status, INTERRUPTED) if status else ""  # it may have been about to end
        return trial.judged(place, f"Ctrl-C twice {when}", wrong)

    for number in trial.numbers(5 if most is None else 2):
        place = trial.folder / f"stopped{number}"
        twice = partial(watch_changes, place, number, signal.SIGINT, 2)
        yield stopped(place, trial.run(place, twice, children=True), f"at change {number} of {len(trial.changes)}")
    for number in range(5 if most is None else 1):
        place, first_s = trial.folder / f"impatient{number}", rng.uniform(0.1, trial.seconds)
        signals = [(first_s, signal.SIGINT), (first_s + rng.uniform(0, 0.5), signal.SIGINT)]
        yield stopped(place, trial.run(place, signals=signals, children=True), f"after {first_s:.2f} s")


def closed_pipe(trial: Trial) -> Iterator[str]:
    """A closed pipe of standard output: no message, and the results are whole."""
    place = trial.folder / "pipe"

    def closed() -> None:
        read, write = os.pipe()
        os.close(read)
        os.dup2(write, 1)

    status, text = trial.run(place, closed), trial.errors.read_text()
    silent = status in (0, CLOSED) and "Traceback" not in text and "wrf-mi: " not in text
    yield trial.judged(place, "a closed pipe", "" if silent else f"status {status}, {trial.message()[:200]!r}")


def locked(trial: Trial) -> Iterator[str]:
    """A second command into the folder of one that runs."""
    for name in trial.command.locked:
        place = trial.folder / "locked"
        shutil.copytree(trial.whole, place)
        with locked_folder(place / name):
            wrong = trial.one_line(trial.run(place), REFUSED)
        shutil.rmtree(place)
        yield wrong and f"{trial.command.name}, a second one into a folder: {wrong}"


def measure(folder: Path, names: Sequence[str], kills: int | None) -> dict[str, Any]:
    """Cases and failures of all faults of commands (`wrf_mi_bench.fault_commands.COMMANDS`), by their kind.

    ``kills`` are random kills, and kills at changes of files, of each command; None: 20, and all.
    """
    outcomes: dict[str, list[str]] = {}
    for name in names:
        trial = Trial(COMMANDS[name](folder), folder / name.replace(" ", "-"))
        kinds: dict[str, Iterator[str]] = {
            "killed at a write or rename": killed_at_changes(trial, kills),
            "killed at random moments": killed_at_random(trial, 20 if kills is None else kills),
            "full disk": full_disk(trial, kills),
            "no write permission": no_permission(trial),
            "Ctrl-C twice": interrupted(trial, kills),
            "closed pipe": closed_pipe(trial),
            "locked folder": locked(trial),
        }
        for kind, cases in kinds.items():
            for wrong in cases:
                outcomes.setdefault(kind, []).append(wrong)
                print(f"{name}: {kind} {len(outcomes[kind])} {wrong}", file=sys.stderr, flush=True)
    return {kind: {"cases": len(every), "failed": [text for text in every if text]} for kind, every in outcomes.items()}


def run(folder: Path, names: Sequence[str] = tuple(COMMANDS), kills: int | None = None) -> dict[str, Any]:
    """`measure` in a process of its own, over data that are made in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    prepare_data(folder)
    call = [sys.executable, "-m", "wrf_mi_bench.faults", str(folder), ",".join(names), str(kills or 0)]
    done = subprocess.run(call, check=False, stdout=subprocess.DEVNULL)
    if done.returncode != 0:
        raise RuntimeError(f"faults: ended with status {done.returncode}")
    figures: dict[str, Any] = json.loads((folder / "faults.json").read_text())
    return figures


def main(folder: str, names: str, kills: str) -> None:
    """Measure, and write ``faults.json`` in the folder."""
    place = Path(folder)
    # Before the first fork: all that a command needs.
    for module in ("wrf_mi.runs.api", "wrf_mi.correction", "wrf_mi_bench.tables", "sionna.rt"):
        import_module(module)
    figures = measure(place, names.split(","), int(kills) or None)
    write_atomically(place / "faults.json", json.dumps(figures, indent=1))


if __name__ == "__main__":
    main(*sys.argv[1:])
