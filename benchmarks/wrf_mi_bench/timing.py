"""Time of a call, the history of its kernels, and its memory.

Calls are compared by *interleaved pairs* in one process: a changing load affects both alike, so that the ratio of a
pair varies far less than either time.

Memory is the largest resident memory during a call less that before it, after the caches of Dr.Jit and the C library
are emptied. Linux resets its peak on request; elsewhere the process is sampled every millisecond.
"""

import ctypes
import gc
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import ArrayLike, NDArray

from wrf_mi.backend import init
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.memory import peak_memory_mb
from wrf_mi.tasks.scores import Interval, bootstrap

init()

import drjit as dr  # noqa: E402

Call = Callable[[], Any]

REPEATS, WARM_UP = 15, 2  # timed calls, and calls before them: the first compiles, the second still fills caches
RESET_PEAK = Path("/proc/self/clear_refs")
LOOK_EVERY_S = 1e-3


def settle(result: Any) -> None:
    """Evaluate Dr.Jit arrays of a result and wait for all kernels."""
    dr.eval(result)
    dr.sync_thread()


@dataclass(frozen=True)
class Within:
    """A call in a context whose entering and leaving is not timed, for example another variant of Mitsuba."""

    call: Call  # timed call
    context: Callable[[], AbstractContextManager[Any]]  # function that returns the context

    def __call__(self) -> Any:
        with self.context():
            return self.call()


def seconds(call: Call, processor: bool = False) -> float:
    """Time of one call, until all its kernels have run.

    ``processor`` measures the processor time of this process, which other processes do not lengthen.
    """
    if isinstance(call, Within):
        with call.context():
            return seconds(call.call, processor)
    clock = time.process_time if processor else time.perf_counter
    dr.sync_thread()
    start = clock()
    settle(call())
    return clock() - start


def interleaved(
    calls: Mapping[str, Call],
    repeats: int = REPEATS,
    warm_up: int = WARM_UP,
    most_s: float = np.inf,
    processor: bool = False,
) -> dict[str, NDArray[np.float64]]:
    """Times in ms [rounds] of several interleaved calls in this process; every round calls each once.

    ``warm_up`` rounds precede the timed ones; after ``most_s`` seconds no further round begins, but three are timed in
    any case. ``processor``: see `seconds`.
    """
    start = time.perf_counter()
    for _ in range(warm_up):
        for call in calls.values():
            seconds(call)
    times: dict[str, list[float]] = {name: [] for name in calls}
    # Garbage is collected between rounds only.
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(repeats):
            if done >= 3 and time.perf_counter() - start > most_s:
                break
            gc.collect(1)  # older generations take longer than many calls
            # The order alternates, as a call may profit from the caches of the one before.
            for name in list(calls)[:: 1 if done % 2 == 0 else -1]:
                times[name].append(1e3 * seconds(calls[name], processor))
    finally:
        if collecting:
            gc.enable()
    return {name: np.array(values) for name, values in times.items()}


def ratio(ours_ms: ArrayLike, theirs_ms: ArrayLike) -> Interval:
    """Median of the ratios of interleaved pairs, ours over theirs, with its interval."""
    ours, theirs = np.asarray(ours_ms, float), np.asarray(theirs_ms, float)
    if ours.shape != theirs.shape:
        raise ValueError(f"ratio: {ours.shape} and {theirs.shape} times; pairs need as many of both")
    return bootstrap(ours / theirs)


@dataclass(frozen=True)
class Split:
    """Shares of the time of a call, in ms."""

    tracing: float  # Python, NumPy, recording of Dr.Jit's operations, and building of BVHs on the host: the remainder
    code_generation: float  # generation of kernels that were not in the cache, with LLVM's or CUDA's compiler
    execution: float  # execution of kernels; concurrent ones count in full, up to the time of the call
    kernels: int  # number of launched kernels, reductions and sorts included
    compiled: int  # number of compiled kernels among them


def history_of(call: Call) -> tuple[float, list[dict[str, Any]]]:
    """Time of a call in ms, and Dr.Jit's history of its kernels."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        settle(call())  # functions that were recorded without the history are recorded again
        dr.sync_thread()
        dr.kernel_history_clear()
        total_ms = 1e3 * seconds(call)
        return total_ms, dr.kernel_history()


def split(call: Call) -> Split:
    """Shares of the time of a call, see `history_of`."""
    total_ms, history = history_of(call)
    generated = sum(entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0) for entry in history)
    # Kernels may run concurrently with each other and with the recording of the next.
    executed = min(sum(entry["execution_time"] for entry in history), max(total_ms - generated, 0.0))
    compiled = sum(not entry.get("cache_hit", 1) for entry in history)
    return Split(max(total_ms - generated - executed, 0.0), generated, executed, len(history), compiled)


def memory_mb(call: Call) -> float:
    """Largest resident memory during a call less that before it, MB."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    # The C library keeps memory that NumPy freed and would reuse it unseen.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
    before = psutil.Process().memory_info().rss
    if RESET_PEAK.exists():
        RESET_PEAK.write_text("5")  # proc(5): resets the peak resident set size
        settle(call())
        peak = round(1e6 * peak_memory_mb())
    else:
        peak = _watched(call)
    return float(max(peak - before, 0) / 1e6)


def _watched(call: Call) -> int:
    """Largest resident memory during a call sampled by a thread, bytes."""
    process, done, peak = psutil.Process(), threading.Event(), [0]

    def watch() -> None:
        while not done.is_set():
            peak[0] = max(peak[0], process.memory_info().rss)
            done.wait(LOOK_EVERY_S)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        settle(call())
    finally:
        done.set()
        thread.join()
    return int(max(peak[0], process.memory_info().rss))


def exponent(sizes: Sequence[float], times: Sequence[ArrayLike], seed: int = 0) -> Interval:
    """Exponent of the growth of time with size: the least-squares slope of their logarithms over the larger sizes.

    Overheads hide the growth at small sizes. Sizes ascend; the interval is from resampled repetitions at each size.
    """
    if len(sizes) != len(times) or len(sizes) < 2:
        raise ValueError(f"exponent: {len(sizes)} sizes and {len(times)} sets of times; give two or more of both")
    larger = larger_half(len(sizes))
    x = np.log(np.asarray(sizes, float)[larger])
    x -= x.mean()

    def slope(*samples: FloatArray, axis: int) -> Any:
        return np.tensordot(x, np.log([np.median(values, axis=axis) for values in samples]), 1) / (x @ x)

    return bootstrap(*list(times)[larger], statistic=slope, seed=seed)


def larger_half(count: int) -> slice:
    """Slice of the larger half of ascending sizes; of four or five the largest three, two at least."""
    return slice(count - max(count - count // 2, min(3, count - 1), 2), count)


def n_log_n(sizes: Sequence[float]) -> float:
    """Result of `exponent` for a cost of n log n at these sizes, slightly above 1."""
    return exponent(sizes, [[n * np.log(max(n, 2))] for n in sizes]).value
