"""Packages of the extra ``lidar``, imported only where a scan or plan is read: tracing and training do without."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..core import InputError


def lidar_package(name: str) -> Any:
    """A package of the extra ``lidar``.

    Raises:
        InputError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        text = " ".join(str(error).split())
        raise InputError(f"scenes from scans need {name} ({text}): pip install 'wrf-mi[lidar]'") from None
