"""Parts inside a worker, one at a time, in the environment of the client; modules run as child processes.

A worker that is killed cannot stop its children, and its part starts again on another worker: both children would
write to the same run folder. So a child holds a pipe from its parent and ends when that closes, however the parent ends
(`wrf_mi.parallel.child`).
"""

from __future__ import annotations

import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from ..backend import choose, init, stated_threads
from ..backend.probe import installed_version
from ..core import InputError

VARIABLES = "WRF_MI_"  # environment variables with this beginning are set in workers as they are in the client
POLL_S = 0.5
GRACE_S = 30.0  # time for a child that is stopped to finish its step and write a checkpoint
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
    init(environment.backend, threads=stated_threads() or 1)


def worker_threads() -> int | None:
    """Threads that a part in a worker may use; None in any other process, which may use all cores."""
    return (stated_threads() or 1) if getattr(_in_worker, "active", False) else None


def given_up() -> bool:
    """Whether the client has cancelled the part that this thread computes; False in any other process."""
    if not getattr(_in_worker, "active", False):
        return False
    from distributed import get_worker

    worker = get_worker()
    task = worker.state.tasks.get(worker.get_current_task())
    return task is None or task.state == "cancelled" or worker.status.name not in ("running", "paused")


def run_module(
    module: str, arguments: Sequence[str], quiet: bool | None = None, most_s: float | None = None
) -> tuple[int, str]:
    """Run ``python -m module arguments`` and wait for it.

    In a worker the child computes with the worker's number of threads and prints nothing; it is stopped, as by Ctrl-C,
    when the client cancels the part. Elsewhere it writes to this process's standard error unless ``quiet``. After
    ``most_s`` seconds it is killed.

    Returns:
        The exit status, that of a killed child negative, and the last line of a quiet child's standard error.

    Raises:
        KeyboardInterrupt: in this process; the child has ended then.
    """
    threads = worker_threads()
    captured = threads is not None if quiet is None else quiet
    # -P: a folder ``wrf_mi`` here, as a clone of the project is, would hide the installed package.
    call = [sys.executable, "-P", "-m", "wrf_mi.parallel.child", str(threads or 0), module, *arguments]
    with tempfile.TemporaryFile("w+", errors="replace") as errors:
        streams = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": errors if captured else None}
        # In a separate process group: Ctrl-C on a terminal reaches this process alone, which passes it on once.
        # It inherits that Ctrl-C is blocked, until it can end without a traceback.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            child = subprocess.Popen(call, process_group=0, **streams)  # type: ignore[call-overload]
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        try:
            status = _wait(child, None if most_s is None else time.monotonic() + most_s)
        except BaseException:
            _stop(child)
            raise
        finally:
            child.stdin.close()
        errors.seek(0)
        lines = [line.strip() for line in errors if line.strip()]
    return status, lines[-1] if lines else ""


def _wait(child: subprocess.Popen[bytes], until: float | None) -> int:
    while True:
        try:
            return child.wait(POLL_S)
        except subprocess.TimeoutExpired:
            if until is not None and time.monotonic() > until:
                child.kill()
            if given_up():
                return _stop(child)


def _stop(child: subprocess.Popen[bytes]) -> int:
    if child.poll() is None:
        child.send_signal(signal.SIGINT)
    try:
        return child.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()
        return child.wait()
