"""Loaded by the workers that are started on this machine (Dask's ``preload``)."""

from __future__ import annotations

import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Leave Ctrl-C, which a terminal sends to all processes, to the one that started the workers: it ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
