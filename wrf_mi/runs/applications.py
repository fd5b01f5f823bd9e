"""Applications of installed packages: what people do with a run or a scene beside training and prediction.

Entry points of the group ``wrf_mi.applications`` name functions: ``map``, ``locate``, ``plan`` and ``view`` of a run,
``view`` of a scene's folder, ``export`` of a run's folder, ``warn`` of a record before it trains, and the module of the
command. So the library knows no application, and other packages may add some.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..core.registry import Registry

APPLICATIONS: Registry[Callable[..., Any]] = Registry("application", "wrf_mi.applications", {})
COMMAND = "command"  # name of the entry point whose module is the command
