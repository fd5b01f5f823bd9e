"""How long a call takes, what of that is tracing, code generation and execution, and how much memory it needs.

Two calls are compared by *interleaved pairs*: one after the other, again and again, in one process. What slows the
machine for a while slows both, so that the ratio of a pair is far steadier than either time.

Memory is the largest resident memory during a call beyond what the process held before it, with the stores of freed
memory that Dr.Jit and the C library keep emptied first. Linux counts it anew when asked to; elsewhere the process is
looked at every millisecond.
"""

from __future__ import annotations

import ctypes
import gc
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from ..backend import init

init()

import drjit as dr  # noqa: E402

Call = Callable[[], Any]

REPEATS, WARM_UP = 15, 2
"""Timed calls, and calls before them: the first compiles, the second still fills caches."""
RESAMPLES = 2000
"""Bootstrap resamples: limits of a 95 % interval are then good to a few hundredths of its width."""
CONFIDENCE = 0.95
RESET_PEAK, STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")
LOOK_EVERY_S = 1e-3


@dataclass(frozen=True)
class Interval:
    """A median with the limits of its 95 % bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} ({self.low:.3g} to {self.high:.3g})"


@dataclass(frozen=True)
class Split:
    """Where the time of one call goes, in ms.

    Attributes:
        tracing: Python, NumPy, the recording of Dr.Jit's operations, and what Mitsuba builds on the host (BVHs): all
            that is not in the other two.
        code_generation: of kernels that were not in the cache, with LLVM's or CUDA's compiler.
        execution: of kernels. Those that run beside each other count once each, so this is an upper bound, limited
            to the time of the call.
        kernels: launched, reductions and sorts included.
        compiled: of these, compiled anew.
    """

    tracing: float
    code_generation: float
    execution: float
    kernels: int
    compiled: int


@dataclass(frozen=True)
class Measured:
    """One call, measured.

    Attributes:
        ms: time of a call, warm.
        times_ms: all of them.
        first: where the first call's time went, which compiles what it needs (if not on disk already).
        warm: the same of a later one.
        memory_mb: largest resident memory of a call beyond what was there before.
    """

    ms: Interval
    times_ms: tuple[float, ...]
    first: Split
    warm: Split
    memory_mb: float

    def plain(self) -> dict[str, Any]:
        """As numbers for JSON."""
        return asdict(self)


def bootstrap(
    samples: ArrayLike, statistic: Callable[..., Any] = np.median, seed: int = 0, resamples: int = RESAMPLES
) -> Interval:
    """A statistic of samples [n] with its 95 % percentile interval.

    Args:
        samples: independent.
        statistic: takes an array and ``axis``.
        seed: of the resamples.
        resamples: their number.

    Source: Efron and Tibshirani, "An Introduction to the Bootstrap" (1993), section 13.3.
    """
    values = np.asarray(samples, float)
    if values.ndim != 1 or not len(values):
        raise ValueError(f"bootstrap: samples of shape {values.shape}; give [n], one at least")
    drawn = np.random.default_rng(seed).integers(0, len(values), (resamples, len(values)))
    low, high = np.quantile(statistic(values[drawn], axis=1), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(statistic(values, axis=0)), float(low), float(high))


def one_blas_thread() -> AbstractContextManager[Any]:
    """BLAS on one thread, as a benchmark needs it: its threads wait for each other by spinning.

    Where another process has one of the cores, the spectrum of an array then takes twenty times as long.
    """
    return threadpool_limits(1, "blas")


def settle(result: Any) -> None:
    """Evaluate Dr.Jit arrays in a result, and wait for all kernels."""
    dr.eval(result)
    dr.sync_thread()


@dataclass(frozen=True)
class Within:
    """A call inside a context whose entering and leaving is not timed, for example another variant of Mitsuba.

    Attributes:
        call: what is timed.
        context: makes the context.
    """

    call: Call
    context: Callable[[], AbstractContextManager[Any]]

    def __call__(self) -> Any:
        """Call it in its context."""
        with self.context():
            return self.call()


def seconds(call: Call, processor: bool = False) -> float:
    """Time of one call, until all its kernels have run.

    Args:
        call: what is timed.
        processor: the time of all processors of this process instead, which others on the machine do not lengthen.
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
    """Times in ms [rounds] of several calls that take turns in this process; every round calls each once.

    Args:
        calls: by name.
        repeats: rounds that are timed.
        warm_up: rounds before them that are not.
        most_s: no further round begins after so many seconds; three are timed in any case.
        processor: see `seconds`.
    """
    start = time.perf_counter()
    for _ in range(warm_up):
        for call in calls.values():
            seconds(call)
    times: dict[str, list[float]] = {name: [] for name in calls}
    # Python's collector stops the world when it likes; here it does so between rounds.
    collecting = gc.isenabled()
    gc.disable()
    try:
        for done in range(repeats):
            if done >= 3 and time.perf_counter() - start > most_s:
                break
            gc.collect(1)  # all of them take longer than many a call
            # Every other round the other way round: what the one leaves in caches helps or harms the other.
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


def split(call: Call) -> Split:
    """Where the time of a single call goes, from Dr.Jit's kernel history.

    A frozen function that was recorded without the history is recorded anew for it, so this is called with
    ``call`` again by whoever wants its warm state (`typical_split`).
    """
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.sync_thread()
        dr.kernel_history_clear()
        whole = 1e3 * seconds(call)
        history = dr.kernel_history()
    generated = sum(entry.get("codegen_time", 0.0) + entry.get("backend_time", 0.0) for entry in history)
    # Kernels may run beside each other and beside the recording of the next.
    executed = min(sum(entry["execution_time"] for entry in history), max(whole - generated, 0.0))
    compiled = sum(not entry.get("cache_hit", 1) for entry in history)
    return Split(max(whole - generated - executed, 0.0), generated, executed, len(history), compiled)


def typical_split(call: Call, calls: int = 5) -> Split:
    """That of several calls whose time is the median: one alone may have been disturbed."""
    found = sorted((split(call) for _ in range(calls)), key=lambda s: s.tracing + s.code_generation + s.execution)
    return found[calls // 2]


def memory_mb(call: Call) -> float:
    """Largest resident memory during a call beyond what the process held before it, MB."""
    gc.collect()
    dr.sync_thread()
    dr.flush_malloc_cache()
    # The C library keeps what NumPy freed, and a call that takes it again would seem to need nothing.
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)
    before = psutil.Process().memory_info().rss
    if RESET_PEAK.exists():
        RESET_PEAK.write_text("5")  # proc(5): resets the peak resident set size
        settle(call())
        line = next(one for one in STATUS.read_text().splitlines() if one.startswith("VmHWM:"))
        peak = 1024 * int(line.split()[1])
    else:
        peak = _watched(call)
    return max(peak - before, 0) / 1e6


def _watched(call: Call) -> int:
    """Largest resident memory during a call that was seen from a thread beside it, bytes."""
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
    return max(peak[0], process.memory_info().rss)


def measure(call: Call, repeats: int = REPEATS, most_s: float = np.inf) -> Measured:
    """Time, split and memory of a call.

    Args:
        call: what is measured; what it returns is evaluated.
        repeats: timed calls.
        most_s: no further one begins after so many seconds; three are timed in any case.
    """
    first, warm = split(call), typical_split(call)
    memory = memory_mb(call)
    times = interleaved({"call": call}, repeats, 1, most_s)["call"]
    return Measured(bootstrap(times), tuple(float(t) for t in times), first, warm, memory)


def exponent(sizes: Sequence[float], times: Sequence[ArrayLike], seed: int = 0) -> Interval:
    """Exponent of cost against work: the least-squares slope of log time over log size, over the larger half of sizes.

    At small sizes overheads hide the growth. The interval is from resampling the repetitions at each size: it says how
    sure the slope of *these* sizes is, not that it goes on like that.

    Args:
        sizes: ascending, two or more.
        times: repetitions at each size.
        seed: of the resamples.
    """
    if len(sizes) != len(times) or len(sizes) < 2:
        raise ValueError(f"exponent: {len(sizes)} sizes and {len(times)} sets of times; give two or more of both")
    kept = larger_half(len(sizes))
    x = np.log(np.asarray(sizes, float)[kept])
    x -= x.mean()
    rng = np.random.default_rng(seed)
    own, drawn = [], []
    for one in list(times)[kept]:
        values = np.asarray(one, float)
        own.append(np.log(np.median(values)))
        picked = rng.integers(0, len(values), (RESAMPLES, len(values)))
        drawn.append(np.log(np.median(values[picked], axis=1)))
    low, high = np.quantile(x @ np.array(drawn) / (x @ x), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Interval(float(x @ np.array(own) / (x @ x)), float(low), float(high))


def larger_half(count: int) -> slice:
    """The larger half of ascending sizes; of four or five the largest three, two at least."""
    return slice(count - max(count - count // 2, min(3, count - 1), 2), count)


def n_log_n(sizes: Sequence[float]) -> float:
    """What `exponent` gives for a cost of n log n at these sizes; a little above 1."""
    return exponent(sizes, [[n * np.log(max(n, 2))] for n in sizes]).value
