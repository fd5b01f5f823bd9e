"""Independent parts of a NumPy computation on all processors."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_limits

Part = TypeVar("Part")
Result = TypeVar("Result")


def processors() -> int:
    """Number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def on_threads(work: Callable[[Part], Result], parts: Iterable[Part]) -> list[Result]:
    """Results of ``work(part)`` in order, a thread for each processor, each with a BLAS of one thread."""
    # Threads of the BLAS wait for each other by spinning: with another process on a processor, they take seconds.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(processors()) as pool:
        return list(pool.map(work, parts))
