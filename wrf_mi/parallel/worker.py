"""Parts inside a worker: the environment of the client, one part at a time, and an opener called once."""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

from ..backend import choose, init
from ..backend.probe import installed_version
from ..core import InputError

VARIABLES = "WRF_MI_"  # environment variables with this beginning are set in workers as they are in the client
THREADS = "OMP_NUM_THREADS"
"""Number of threads of Dr.Jit in a worker. Dask sets it to 1 unless it is set where the worker is started."""
PACKAGES = ("wrf-mi", "drjit", "mitsuba", "sionna-rt", "numpy")
"""Packages whose versions must be the client's, or results differ in more than the last digit."""


@dataclass(frozen=True)
class WorkerEnvironment:
    """Environment of the client, which workers adopt before each part."""

    folder: str  # working directory, to which relative paths refer
    variables: tuple[tuple[str, str], ...]  # environment variables that begin with `VARIABLES`
    backend: str  # ``"llvm"`` or ``"cuda"``
    versions: tuple[tuple[str, str], ...]  # versions of Python and `PACKAGES`


def worker_environment() -> WorkerEnvironment:
    """The environment of this process; `BackendError`: neither LLVM nor CUDA can be used here."""
    variables = tuple(sorted((k, v) for k, v in os.environ.items() if k.startswith(VARIABLES)))
    # The import of Mitsuba can wait where nothing has imported it yet.
    backend = init() if "mitsuba" in sys.modules else choose()
    return WorkerEnvironment(os.getcwd(), variables, backend.name, _versions())


@cache
def _versions() -> tuple[tuple[str, str], ...]:
    python = ("python", ".".join(platform.python_version_tuple()[:2]))
    return (python, *((package, installed_version(package) or "none") for package in PACKAGES))


_one_at_a_time = threading.Lock()
_in_worker = threading.local()
_opened: tuple[str, Any] = ("", None)


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the client, which ends its workers (``preload``)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def run_part(
    environment: WorkerEnvironment,
    token: str,
    opener: Callable[[], Any] | None,
    function: Callable[..., Any],
    part: Any,
) -> Any:
    """Compute one part in a worker: ``function(part)``, or ``function(opener(), part)``.

    A worker with several threads still computes one part at a time: Dr.Jit traces one program per process, and the
    working directory belongs to the process. The result of ``opener`` is kept until a call with another ``token``.
    `InputError`: the environment differs from the client's; or raised by ``opener`` or ``function``.
    """
    global _opened
    with _one_at_a_time:
        _enter(environment)
        _in_worker.active = True
        try:
            if opener is None:
                return function(part)
            if _opened[0] != token:
                _opened = ("", None)  # frees the memory of the old one first
                _opened = (token, opener())
            return function(_opened[1], part)
        finally:
            _in_worker.active = False


def _enter(environment: WorkerEnvironment) -> None:
    installed, worker = dict(_versions()), f"worker on {platform.node()}"
    for name, version in environment.versions:
        if installed[name] != version:
            text = f"{worker}: {name} {installed[name]}, but {version} where the command runs"
            raise InputError(f"{text}; install the same versions on both")
    try:
        os.chdir(environment.folder)
    except OSError as error:
        text = f"{worker}: cannot enter {environment.folder} ({error.strerror})"
        raise InputError(f"{text}; run the command in a folder that workers see under the same name") from None
    os.environ.update(environment.variables)
    init(environment.backend, threads=_threads())


def _threads() -> int:
    text = os.environ.get(THREADS, "").strip()
    return max(1, int(text)) if text.isdecimal() else 1


def worker_threads() -> int | None:
    """Threads that a part in a worker may use; None in any other process, which may use all cores."""
    return _threads() if getattr(_in_worker, "active", False) else None


def given_up() -> bool:
    """Whether the client has cancelled the part that this thread computes; False in any other process."""
    if not getattr(_in_worker, "active", False):
        return False
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state == "cancelled" or worker.status.name not in ("running", "paused")
