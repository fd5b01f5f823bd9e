"""Cost against work: times and memory of `wrf_mi_bench.scaling_axes.AXES`, and the exponents of their growth."""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from wrf_mi.runs.timing import Interval, exponent, interleaved, larger_half, memory_mb, n_log_n, one_blas_thread

from .scaling_axes import AXES, Axis

logger = logging.getLogger(__name__)

REPEATS, MOST_S = 7, 8.0
"""Timed calls of each size; after so many seconds no further one begins, three are timed in any case."""
CALL_S = 100.0
"""A size is left out when, growing as n^1.1, its call would take longer than that; the row says so."""
SLOW_MS, FEW = 4000.0, 2
"""Calls that take longer than that are timed so often, without a further warm-up."""


def scale(axis: Axis, repeats: int = REPEATS, most_s: float = MOST_S, call_s: float = CALL_S) -> dict[str, Any]:
    """Times and memory of one call at each size.

    Returns:
        ``sizes`` that were measured, ``left_out``, ``ms`` and ``memory_mb`` of each, and the ``exponent`` of time with
        its interval and ``limit``, that of n log n at the same sizes.
    """
    sizes: list[int] = []
    times: list[Any] = []
    memory: list[float] = []
    for size in axis.sizes:
        if sizes and 1e-3 * float(np.median(times[-1])) * (size / sizes[-1]) ** 1.1 > call_s:
            break
        call = axis.make(size)
        # Before any time: kernels are compiled here.
        start = time.perf_counter()
        memory.append(memory_mb(call))
        slow = 1e3 * (time.perf_counter() - start) > SLOW_MS
        sizes.append(size)
        often, warm_up = (min(FEW, repeats), 0) if slow else (repeats, 1)
        times.append(interleaved({"call": call}, often, warm_up, most_s)["call"])
        logger.info("%s %d: %.1f ms, %.0f MB", axis.name, size, np.median(times[-1]), memory[-1])
        del call
        gc.collect()
    found = exponent(sizes, times)
    return {
        "name": axis.name,
        "title": axis.title,
        "work": axis.work,
        "sizes": sizes,
        "left_out": list(axis.sizes[len(sizes) :]),
        "ms": [float(np.median(own)) for own in times],
        "memory_mb": memory,
        "exponent": vars(found),
        "limit": n_log_n(sizes),
    }


def verdict(found: Interval, limit: float) -> str:
    """Whether growth is at most that of the limit: only what lies above it with its whole interval is not."""
    if found.low > limit:
        return "does not hold"
    return "holds" if found.high <= limit else "holds within its interval"


def rows(results: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """Rows for the benchmark's table."""
    made = []
    for one in results:
        found, sizes = Interval(**one["exponent"]), one["sizes"]
        kept = sizes[larger_half(len(sizes))]
        missing = f", {one['left_out'][0]:,} left out: too slow" if one["left_out"] else ""
        growth = [f"{ms:.3g} ms" for ms in one["ms"]]
        memory = [f"{mb:.0f}" for mb in one["memory_mb"]]
        made.append(
            {
                "what": f"{sizes[0]:,} to {sizes[-1]:,} {one['work']}, {one['title']}{missing}",
                "value": f"exponent {found.value:.2f} ({found.low:.2f} to {found.high:.2f}) from {kept[0]:,}; "
                f"{', '.join(growth)}; {', '.join(memory)} MB",
                "asked": f"at most n log n ({one['limit']:.2f}): {verdict(found, one['limit'])}",
            }
        )
    return made


def main() -> dict[str, Any]:
    """All axes, some ten minutes on two cores."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with one_blas_thread():
        results = [scale(axis) for axis in AXES]
    return {"rows": rows(results), "axes": results}
