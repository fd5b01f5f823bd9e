"""What happens inside a worker: the place of the client, one part at a time, and what is opened once."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from ..backend import choose, init
from ..core import InputError

VARIABLES = "WRF_MI_"
"""Environment variables with this beginning are set in workers as they are in the client."""
THREADS = "OMP_NUM_THREADS"
"""Says how many threads Dr.Jit uses in a worker. Dask sets it to 1 unless whoever starts the worker has set it."""
PACKAGES = ("wrf-mi", "drjit", "mitsuba", "sionna-rt", "numpy")
"""Their versions must be the client's, or results differ in more than the last digit."""


@dataclass(frozen=True)
class Place:
    """Where and with what the client computes: workers take it over before each part.

    Attributes:
        folder: working directory, by which relative paths are meant.
        variables: environment variables that begin with `VARIABLES`.
        backend: ``"llvm"`` or ``"cuda"``.
        versions: of Python and `PACKAGES`.
    """

    folder: str
    variables: tuple[tuple[str, str], ...]
    backend: str
    versions: tuple[tuple[str, str], ...]


def this_place() -> Place:
    """The place of this process.

    Raises:
        BackendError: neither LLVM nor CUDA can be used here.
    """
    variables = tuple(sorted((k, v) for k, v in os.environ.items() if k.startswith(VARIABLES)))
    # Where Mitsuba is there already, what it was given decides; else its import can wait.
    backend = init() if "mitsuba" in sys.modules else choose()
    return Place(os.getcwd(), variables, backend.name, _versions())


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    found = [("python", ".".join(platform.python_version_tuple()[:2]))]
    for package in PACKAGES:
        try:
            found.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            found.append((package, "none"))
    return tuple(found)


_one_at_a_time = threading.Lock()
_in_worker = threading.local()
_opened: tuple[str, Any] = ("", None)


def run_part(
    place: Place, token: str, opener: Callable[[], Any] | None, function: Callable[..., Any], part: Any
) -> Any:
    """Compute one part in a worker.

    A worker with several threads still computes one part at a time: Dr.Jit traces one program per process, and the
    working directory is the process's too.

    Args:
        place: of the client.
        token: of the call of ``map``; what ``opener`` gives is kept until another one comes.
        opener: makes the first argument of ``function``; None: there is none.
        function: of ``part``.
        part: what to compute.

    Raises:
        InputError: this worker cannot stand in for the client; or what ``opener`` or ``function`` raise.
    """
    global _opened
    with _one_at_a_time:
        _enter(place)
        _in_worker.active = True
        try:
            if opener is None:
                return function(part)
            if _opened[0] != token:
                _opened = ("", None)  # the old one goes before the new one needs its memory
                _opened = (token, opener())
            return function(_opened[1], part)
        finally:
            _in_worker.active = False


def _enter(place: Place) -> None:
    own = dict(_versions())
    for name, version in place.versions:
        if own[name] != version:
            what = f"worker on {platform.node()}: {name} {own[name]}, but {version} where the command runs"
            raise InputError(f"{what}; install the same versions on both")
    try:
        os.chdir(place.folder)
    except OSError as error:
        what = f"worker on {platform.node()}: cannot enter {place.folder} ({error.strerror})"
        raise InputError(f"{what}; run the command in a folder that workers see under the same name") from None
    os.environ.update(place.variables)
    init(place.backend, threads=_threads())


def _threads() -> int:
    text = os.environ.get(THREADS, "").strip()
    return max(1, int(text)) if text.isdecimal() else 1


def worker_threads() -> int | None:
    """Threads that a part in a worker may use; None in a process that is no worker, which may use all cores."""
    return _threads() if getattr(_in_worker, "active", False) else None


def given_up() -> bool:
    """Whether the client no longer wants the part that this thread computes; False in a process that is no worker."""
    if not getattr(_in_worker, "active", False):
        return False
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state == "cancelled" or worker.status.name not in ("running", "paused")
