"""Modules run as child processes that end with their parent, however that ends.

A worker that is killed cannot stop its children, and its part starts again on another worker: both children would
write to the same run folder. So a child holds a pipe from its parent and ends when that closes
(`wrf_mi.parallel.child`).
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence

from .worker import given_up, worker_threads

POLL_S = 0.5
GRACE_S = 30.0  # time for a child that is stopped to finish its step and write a checkpoint


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
    call = [sys.executable, "-m", "wrf_mi.parallel.child", str(threads or 0), module, *arguments]
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
