"""Parts of a task on a scheduler: this process, workers on this machine, or a Dask cluster."""

from __future__ import annotations

import logging
import queue
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from ..core import InputError
from ..core.files import one_line
from .threads import processors
from .worker import run_part, worker_environment

CONNECT_S = 10.0  # time for a scheduler to answer: an idle one needs milliseconds, a busy one seconds
POLL_S = 1.0
LOST_S = 60.0  # time for a worker of this machine to start anew: a busy machine needs seconds
PARTS_EACH = 8  # parts for each worker: a slow or late worker leaves the others at most an eighth of its share
LINES = 10  # lines of progress in all where standard error is a file


class SchedulerFailed(RuntimeError):
    """The scheduler or its workers were lost for good: one line."""

    exit_status = 1


def row_parts(count: int, workers: int, least: int = 1, most: int = 1024) -> list[slice]:
    """Consecutive slices that cover ``count`` rows, for a number of workers, nearly equal in size.

    A part has ``least`` rows at least (but for the last), where it costs something whatever its size, and ``most`` at
    most, which bounds the size of a message and the loss with a worker.
    """
    size = min(max(-(-count // (PARTS_EACH * workers)), least), most)
    return [slice(start, min(start + size, count)) for start in range(0, count, size)]


class PartsProgress(Progress):
    """Progress over ``total`` rows on standard error: a bar on a terminal; else, with ``lines``, one each tenth."""

    def __init__(self, what: str, total: int, lines: bool) -> None:
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        super().__init__(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._what, self._total, self._lines = what, total, lines
        self._done, self._shown, self._waits = 0, 0, False
        self._bar = self.add_task(what, total=total)

    def add(self, rows: int, workers: int) -> None:
        """Count further rows as done, by this number of workers."""
        self._done, self._waits = self._done + rows, False
        by = f"{workers} worker{'s' * (workers != 1)}"
        self.update(self._bar, completed=self._done, description=f"{self._what}, {by}")
        if self._lines and self.disable and self._done * LINES // self._total > self._shown:
            self._shown = self._done * LINES // self._total
            print(f"{self._what}: {self._done} of {self._total}, {by}", file=sys.stderr, flush=True)

    def waiting(self) -> None:
        """State that there is no worker at the moment."""
        self.update(self._bar, description=f"{self._what}, waiting for a worker")
        if self.disable and not self._waits:
            print(f"{self._what}: waiting for a worker to connect to the scheduler", file=sys.stderr, flush=True)
        self._waits = True


class Scheduler:
    """Computes the parts of a task; a context manager that closes what it started.

    Without a client parts are computed one after the other in this process, without progress of its own. Dask gives
    the parts of a lost worker to another one, three times each.

    Args:
        client: ``distributed.Client``, connected; None: this process.
        cluster: cluster to be closed with the scheduler; None: it goes on running.
    """

    def __init__(self, client: Any | None = None, cluster: Any | None = None) -> None:
        self._client, self._cluster = client, cluster

    @property
    def workers(self) -> int:
        """Number of workers at this moment, 1 at least."""
        return 1 if self._client is None else max(len(self._client.nthreads()), 1)

    def map(
        self,
        function: Callable[..., Any],
        parts: Sequence[Any],
        opener: Callable[[], Any] | None = None,
        *,
        what: str = "computing",
        sizes: Sequence[int] | None = None,
        each: Callable[[int, Any], None] | None = None,
        lines: bool | None = None,
    ) -> list[Any]:
        """``[function(part) for part in parts]``, or with an opener ``function(opener(), part)``.

        Args:
            function: function of a module that workers can import, or a `functools.partial` of one.
            parts: independent parts; they and the results travel between processes.
            opener: opens what all parts need; called once in each process that computes some of them.
            what: present participle for the progress on standard error: a bar on a terminal, else a line at each tenth.
            sizes: rows in each part, for the progress; None: one each.
            each: called with index and result of each part once it is computed, in any order.
            lines: print progress as lines where there is no terminal; None: without ``each``.

        Returns:
            A result for each part, in their order.

        Raises:
            InputError: raised by a part; the parts that are left are cancelled.
            SchedulerFailed: the scheduler, or several workers in a row that computed the same part, were lost.
        """
        on_result = each or (lambda index, result: None)
        if self._client is None:
            opened, results = () if opener is None else (opener(),), []
            for k, part in enumerate(parts):
                results.append(function(*opened, part))
                on_result(k, results[k])
            return results
        token = uuid.uuid4().hex
        task = partial(run_part, worker_environment(), token, opener, function)
        keys = [f"{what.replace(' ', '-')}-{token}-{k}" for k in range(len(parts))]
        futures = {future.key: future for future in self._client.map(task, parts, key=keys, pure=False)}
        sizes = [1] * len(parts) if sizes is None else sizes
        try:
            with PartsProgress(what, sum(sizes), lines=each is None if lines is None else lines) as progress:
                return self._collect(futures, keys, sizes, what, progress, on_result)
        except BaseException:
            self._client.cancel(list(futures.values()), force=True)
            raise

    def _collect(
        self,
        futures: dict[str, Any],
        keys: Sequence[str],
        sizes: Sequence[int],
        what: str,
        progress: PartsProgress,
        on_result: Callable[[int, Any], None],
    ) -> list[Any]:
        """Results of futures in the order of their keys; ``on_result`` gets them as they are done."""
        client: Any = self._client
        done, results = queue.SimpleQueue[str](), [None] * len(keys)
        index = {key: k for k, key in enumerate(keys)}
        for future in futures.values():
            future.add_done_callback(lambda future: done.put(future.key))
        worked = time.monotonic()
        while futures:
            try:
                key = done.get(timeout=POLL_S)
            except queue.Empty:
                if client.status == "running" and not client.nthreads():
                    # For however long on a cluster, which may have to start workers first.
                    progress.waiting()
                    if self._cluster is not None and time.monotonic() - worked > LOST_S:
                        reason = f"{what}: no worker of this machine has started for {LOST_S:.0f} s"
                        raise SchedulerFailed(f"{reason}; use fewer workers, or omit --scheduler") from None
                else:
                    worked = time.monotonic()
                continue
            worked = time.monotonic()
            k = index[key]
            # Dask forgets a result that was fetched: a worker that is lost later takes none with it.
            results[k] = _result(futures.pop(key), what)
            progress.add(sizes[k], self.workers)
            on_result(k, results[k])
        return results

    def __enter__(self) -> Self:
        """The scheduler."""
        return self

    def __exit__(self, *error: object) -> None:
        """Close the connection, and the workers that were started here."""
        for started in (self._client, self._cluster):
            if started is not None:
                started.close()


def _result(future: Any, what: str) -> Any:
    from distributed import CancelledError, KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        reason = f"{what}: {error.allowed_failures + 1} workers in a row ended in one part"
        remedy = "for want of memory, or by a crash (see their log); use fewer workers on a machine"
        raise SchedulerFailed(f"{reason}, {remedy}") from None
    except CancelledError:
        # Dask cancels all tasks when the connection breaks.
        raise SchedulerFailed(f"{what}: the Dask scheduler was lost; start it, and the command again") from None
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("wrf_mi", "wrf_mi_plugins", "wrf_mi_scenes"):
            raise
        raise InputError(f"workers: {one_line(error)}; install wrf-mi where scheduler and workers run") from None
    except InputError as error:
        raise error from None  # without the traceback of the worker


def open_scheduler(text: str | None) -> Scheduler:
    """Open a scheduler.

    Args:
        text: ``local`` (a worker for each core of this machine), ``local:N`` (N of them), or the address of a running
            Dask scheduler (``tcp://host:port`` or ``host:port``); None: this process, serially.

    Returns:
        A context manager. Workers that are started here compute with one thread each, unless
        ``OMP_NUM_THREADS`` says otherwise. A script that starts some needs ``if __name__ == "__main__":``.

    Raises:
        InputError: any other text, no scheduler at the address, or Dask is not installed.
        BackendError: neither LLVM nor CUDA can be used here.
    """
    if text is None:
        return Scheduler()
    count = _local_workers(text)
    address = text if "://" in text else f"tcp://{text}"
    if count is None and not _has_port(address):
        raise InputError(f"--scheduler {text}: expected local, local:N or the address of a scheduler, tcp://HOST:PORT")
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("--scheduler: needs Dask; install it with: pip install '.[cluster]'") from None
    worker_environment()  # fails before anything is started where nothing can compute
    _silence_dask()
    if count is None:
        try:
            return Scheduler(Client(address, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError, RuntimeError) as error:
            reason = f"no Dask scheduler answers there ({one_line(error)})"
            raise InputError(f"--scheduler {text}: {reason}; start one: docs/cluster.md") from None
    cluster = LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=":0",
        preload=["wrf_mi.parallel.worker"],
        # By default Dask ends a worker at its share of the memory.
        memory_limit=None,
        silence_logs=logging.CRITICAL,
    )
    return Scheduler(Client(cluster, set_as_default=False), cluster)


def _silence_dask() -> None:
    """Lost and restarted workers show in the progress, or in the error that ends the command."""
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "distributed"]:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)


def _local_workers(text: str) -> int | None:
    name, colon, number = text.partition(":")
    if name != "local" or not colon:
        return processors() if name == "local" else None
    if not number.isdecimal() or int(number) < 1:
        raise InputError(f"--scheduler {text}: give the number of workers, 1 or more, such as local:2")
    return int(number)


def _has_port(address: str) -> bool:
    host, colon, port = address.partition("://")[2].rstrip("/").rpartition(":")
    return bool(host and colon) and port.isdecimal() and 0 < int(port) < 1 << 16
