"""The one interface to what computes many parts: this process, workers on this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import os
import queue
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Protocol, Self

from ..core import InputError
from ..core.files import one_line
from .progress import Parts
from .worker import run_part, this_place

CONNECT_S = 10.0
"""A scheduler that runs answers within milliseconds; a busy one within seconds."""
POLL_S = 1.0

Each = Callable[[int, Any], None]


class SchedulerFailed(RuntimeError):
    """The scheduler or its workers were lost for good: one line."""

    exit_status = 1


class Scheduler(Protocol):
    """Computes parts; a context manager that gives back what it started."""

    @property
    def workers(self) -> int:
        """Processes that compute at this moment, 1 at least."""
        ...

    def map(
        self,
        function: Callable[..., Any],
        parts: Sequence[Any],
        opener: Callable[[], Any] | None = None,
        *,
        what: str = "computing",
        sizes: Sequence[int] | None = None,
        each: Each | None = None,
    ) -> list[Any]:
        """``[function(part) for part in parts]``, or with an opener ``function(opener(), part)``.

        Args:
            function: a function of a module that workers can import, or a `functools.partial` of one.
            parts: independent of each other; they and the results travel between processes.
            opener: opens what all parts need; called once in each process that computes some of them.
            what: is done, for the progress on standard error: a bar on a terminal, else a line at each tenth.
            sizes: rows in each part, for the same; None: one each.
            each: hears the index and the result of each part as it is there, in whatever order, once; then there are
                no lines of progress.

        Returns:
            A result for each part, in their order.

        Raises:
            InputError: that of a part, as it is; the parts that are left are cancelled then.
            SchedulerFailed: the scheduler, or several workers in a row that computed the same part, were lost.
        """
        ...

    def __enter__(self) -> Self:
        """Itself."""
        ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give back what was started."""
        ...


class SerialScheduler:
    """One part after the other in this process."""

    workers = 1

    def map(
        self,
        function: Callable[..., Any],
        parts: Sequence[Any],
        opener: Callable[[], Any] | None = None,
        *,
        what: str = "computing",
        sizes: Sequence[int] | None = None,
        each: Each | None = None,
    ) -> list[Any]:
        """See `Scheduler.map`; without progress, as parts show their own."""
        first = () if opener is None else (opener(),)
        results = []
        for index, part in enumerate(parts):
            results.append(function(*first, part))
            if each is not None:
                each(index, results[-1])
        return results

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Nothing was started."""


class DaskScheduler:
    """Parts as tasks of a Dask scheduler. Dask gives the parts of a lost worker to another one, three times each.

    Args:
        client: ``distributed.Client``, connected.
        cluster: to be closed with it; None: it runs on without us.
    """

    def __init__(self, client: Any, cluster: Any | None = None) -> None:
        self._client, self._cluster = client, cluster

    @property
    def workers(self) -> int:
        """Workers that the scheduler has at this moment, 1 at least."""
        return max(len(self._client.nthreads()), 1)

    def map(
        self,
        function: Callable[..., Any],
        parts: Sequence[Any],
        opener: Callable[[], Any] | None = None,
        *,
        what: str = "computing",
        sizes: Sequence[int] | None = None,
        each: Each | None = None,
    ) -> list[Any]:
        """See `Scheduler.map`."""
        token = uuid.uuid4().hex
        task = partial(run_part, this_place(), token, opener, function)
        sizes = [1] * len(parts) if sizes is None else sizes
        results: list[Any] = [None] * len(parts)
        done: queue.SimpleQueue[str] = queue.SimpleQueue()
        index = {f"{what.replace(' ', '-')}-{token}-{k}": k for k in range(len(parts))}
        futures = {future.key: future for future in self._client.map(task, parts, key=list(index), pure=False)}
        try:
            for future in futures.values():
                future.add_done_callback(lambda future: done.put(future.key))
            with Parts(what, sum(sizes), lines=each is None) as bar:
                while futures:
                    key = self._next(done, bar)
                    place = index[key]
                    results[place] = _result(futures[key], what)
                    # Dask forgets it now: a worker that is lost later takes no result with it.
                    del futures[key]
                    bar.advance(sizes[place], self.workers)
                    if each is not None:
                        each(place, results[place])
        except BaseException:
            self._client.cancel(list(futures.values()), force=True)
            raise
        return results

    def _next(self, done: queue.SimpleQueue[str], bar: Parts) -> str:
        """Key of the next part that is done, however long that takes: a cluster may have to start workers first."""
        while True:
            try:
                return done.get(timeout=POLL_S)
            except queue.Empty:
                if self._client.status == "running" and not self._client.nthreads():
                    bar.waiting()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the connection, and the workers that were started here."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


def _result(future: Any, what: str) -> Any:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        reason = f"{what}: {error.allowed_failures + 1} workers in a row ended in one part"
        remedy = "for want of memory, or by a crash that their log tells; use fewer workers on a machine"
        raise SchedulerFailed(f"{reason}, {remedy}") from None
    except CancelledError:
        # So Dask ends all tasks when the connection breaks.
        raise SchedulerFailed(f"{what}: the Dask scheduler was lost; start it, and the command again") from None
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("wrf_mi", "wrf_mi_plugins", "wrf_mi_scenes"):
            raise
        raise InputError(f"workers: {one_line(error)}; install wrf-mi where scheduler and workers run") from None
    except InputError as error:
        raise error from None


def open_scheduler(text: str | None) -> Scheduler:
    """What computes.

    Args:
        text: ``local`` (a worker for each core of this machine), ``local:N`` (N of them), or the address of a running
            Dask scheduler (``tcp://host:port`` or ``host:port``); None: this process, serially.

    Returns:
        To be used in a ``with`` statement. Workers that are started here compute with one thread each, unless
        ``OMP_NUM_THREADS`` says otherwise. A script that starts some needs ``if __name__ == "__main__":``.

    Raises:
        InputError: another text, no scheduler at the address, or Dask is not installed.
        BackendError: neither LLVM nor CUDA can be used here.
    """
    if text is None:
        return SerialScheduler()
    count = _local_workers(text)
    address = text if "://" in text else f"tcp://{text}"
    if count is None and not _has_port(address):
        raise InputError(f"--scheduler {text}: expected local, local:N or the address of a scheduler, tcp://HOST:PORT")
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("--scheduler: needs Dask; install it with: pip install 'wrf-mi[cluster]'") from None
    this_place()  # what cannot compute is told before anything is started
    # What Dask says of lost and restarted workers is told by the progress, or by the error that ends the command.
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    if count is None:
        try:
            return DaskScheduler(Client(address, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--scheduler {text}: no Dask scheduler answers there ({one_line(error)}); start one: docs/cluster.md"
            ) from None
    cluster = LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=":0",
        preload=["wrf_mi.parallel.local_worker"],
        # Dask would end a worker at its share of the memory, where one process alone may use all.
        memory_limit=None,
        silence_logs=logging.CRITICAL,
    )
    return DaskScheduler(Client(cluster, set_as_default=False), cluster)


def _local_workers(text: str) -> int | None:
    """Number of workers on this machine; None for an address."""
    name, colon, number = text.partition(":")
    if name != "local":
        return None
    if not colon:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not number.isdecimal() or int(number) < 1:
        raise InputError(f"--scheduler {text}: give the number of workers, 1 or more, such as local:2")
    return int(number)


def _has_port(address: str) -> bool:
    host, colon, port = address.partition("://")[2].rstrip("/").rpartition(":")
    return bool(host and colon) and port.isdecimal() and 0 < int(port) < 1 << 16
