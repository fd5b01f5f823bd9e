"""Memory that this process may still take, and refusal of what does not fit, before hours of work.

A large allocation is estimated and compared with what is free: memory of the machine, the limit of its control group
(containers, batch systems) and that of the process (``ulimit -v``). Beyond them the system ends the process without a
message, or Python raises far from the setting that is too large.
"""

from __future__ import annotations

import resource
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil

from .errors import InputError

SMALL_BYTES = 1 << 26  # allocations up to 64 MiB are not compared: an estimate of what is free is no better
_STATUS = Path("/proc/self/status")
_CGROUP = Path("/sys/fs/cgroup")
_UNLIMITED = 1 << 60  # control groups of version 1 state about 2^63 where there is no limit


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, MB."""
    # On Linux ru_maxrss of a new program begins at the peak of the process that started it. Some containers state no
    # other figure.
    lines = _STATUS.read_text().splitlines() if _STATUS.exists() else []
    for line in lines:
        if line.startswith("VmHWM:"):
            return 1.024e-3 * int(line.split()[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e6 if sys.platform == "darwin" else 1e3)


def free_bytes() -> int:
    """Bytes that this process may still allocate: of the machine, its control group and its own limits."""
    free = [psutil.virtual_memory().available, *_cgroup_bytes()]
    used = psutil.Process().memory_info()
    for limit, used_bytes in ((resource.RLIMIT_AS, used.vms), (resource.RLIMIT_DATA, getattr(used, "data", used.rss))):
        most, _ = resource.getrlimit(limit)
        if most != resource.RLIM_INFINITY:
            free.append(most - used_bytes)
    return max(int(min(free)), 0)


def _cgroup_bytes() -> Iterator[int]:
    """Free bytes of the control group, of version 2 or 1, as a container sees it; none without a limit."""
    for limit, usage, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
    ):
        try:
            most, used_bytes = ((_CGROUP / name).read_text().strip() for name in (limit, usage))
            words = (_CGROUP / limit).with_name("memory.stat").read_text().split()
            reclaimed = int(words[words.index(cache) + 1]) if cache in words else 0
            if most.isdecimal() and int(most) < _UNLIMITED:
                yield int(most) - max(int(used_bytes) - reclaimed, 0)
        except (OSError, ValueError):
            continue


def require_memory(needed: float, what: str, remedy: str) -> None:
    """Refuse by `InputError` an allocation of ``needed`` bytes for ``what`` (a file or setting) that does not fit."""
    if needed > SMALL_BYTES and needed > (free := free_bytes()):
        gib = f"{needed / 2**30:,.3g}" if needed < 2**40 else f"{needed / 2**30:,.0f}"
        raise InputError(f"{what} takes {gib} GiB, and {free / 2**30:.3g} GiB of memory are free; {remedy}")
