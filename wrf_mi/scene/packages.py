"""Packages of the extra ``lidar``, imported only where a scan or plan is read: tracing and training do without."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..core import InputError
from ..core.files import one_line

SYSTEM = "apt-get install libusb-1.0-0 libgl1 libegl1 libx11-6"
"""What Open3D is linked against and a small system lacks."""


def lidar_package(name: str) -> Any:
    """A package of the extra ``lidar``.

    Raises:
        InputError: it is not installed, or a library of the system is that it is linked against.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError:
        raise InputError(f"scenes from scans need {name}: pip install 'wrf-mi[lidar]'") from None
    except ImportError as error:
        text = one_line(error)
        raise InputError(f"{name} cannot be loaded ({text}); install that library, on Debian: {SYSTEM}") from None
