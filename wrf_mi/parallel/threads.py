"""Independent parts of a NumPy computation on all processors."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import cache
from threading import local
from typing import Any, TypeVar

from threadpoolctl import ThreadpoolController

Part = TypeVar("Part")
Result = TypeVar("Result")


def processors() -> int:
    """Number of processors that this process may use."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


_controller = cache(ThreadpoolController)


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which the BLAS has one thread.

    Its threads wait for each other by spinning: with another process on a processor, products of small matrices take a
    hundred times as long.
    """
    limit: AbstractContextManager[Any] = _controller().limit(limits=1, user_api="blas")
    return limit


_thread = local()


def on_threads(work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Results of ``work(part)`` in order, a thread for each processor, each with a BLAS of one thread.

    Parts of such a part, and a single one, are computed in the thread that asks for them.
    """
    if len(parts) < 2 or getattr(_thread, "works", False):
        return [work(part) for part in parts]
    with (
        one_blas_thread(),
        ThreadPoolExecutor(processors(), initializer=setattr, initargs=(_thread, "works", True)) as pool,
    ):
        return list(pool.map(work, parts))
