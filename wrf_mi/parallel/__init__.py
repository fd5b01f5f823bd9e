"""Many independent parts of one task: one after the other in this process, or on the workers of a Dask scheduler.

    with open_scheduler("local:4") as scheduler:
        rows = scheduler.map(function, parts, opener=partial(open_it, path))

``docs/cluster.md`` says how to start workers on several machines, and what they must share.
"""

from .scheduler import PartsProgress, Scheduler, SchedulerFailed, open_scheduler, row_parts
from .worker import run_module, worker_threads

__all__ = [
    "PartsProgress",
    "Scheduler",
    "SchedulerFailed",
    "open_scheduler",
    "row_parts",
    "run_module",
    "worker_threads",
]
