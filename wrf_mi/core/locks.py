"""Locks: one process at a time writes into a run folder, and one thread of a process computes a fit."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from .errors import InputError
from .files import remove_leftovers

LOCK = ".lock"
"""Lock file in a folder, with the number of the process that holds it. The system frees the lock when that process
ends, however it ends; the file that remains is taken over."""

_fitting = threading.RLock()


@contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """A block that alone writes into a folder, without the temporary files of processes that ended in theirs.

    The lock file remains where `KeyboardInterrupt` ends the block. `InputError`: another process, or another block of
    this process, writes into it.
    """
    file = folder / LOCK
    lock = FileLock(file, timeout=0, thread_local=False)
    try:
        lock.acquire()
    except Timeout:
        who = "another process"
        with suppress(OSError, UnicodeDecodeError):
            if (text := file.read_text().strip()).isdecimal():
                who = f"process {text}"
        raise InputError(f"{folder}: {who} writes into it; wait for its end, or stop it") from None
    remains = False
    try:
        file.write_text(f"{os.getpid()}\n")
        remove_leftovers(folder)
        yield
    except KeyboardInterrupt:
        remains = True  # as after a kill: it tells an unfinished folder from one of other files
        raise
    finally:
        if not remains:
            # Removed before it is free: whoever waits for it makes another file.
            file.unlink(missing_ok=True)
        with suppress(OSError):
            lock.release()


@contextmanager
def alone_in_process() -> Iterator[None]:
    """A block that no other thread of this process may be in.

    Dr.Jit's threads, flags and recorded kernels belong to the process: two fits at a time would change each other.
    `InputError`: another thread is in such a block.
    """
    if not _fitting.acquire(blocking=False):
        text = "another thread of this process fits or scores a model"
        raise InputError(f"{text}; wait for its end, or use a process of its own (wrf-mi train, --scheduler local)")
    try:
        yield
    finally:
        _fitting.release()
