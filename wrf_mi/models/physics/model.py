"""The model ``physics``: planes, materials and kriging, by the task of the data and with or without a scene."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

from ..model import Model

MODULES = {"spectrum": ("measured_spectrum", "spectrum"), "rssi": ("rssi", "rssi"), "csi": ("csi", "csi")}
"""Modules of the physics models without and with a scene, by task; each has its entry as ``MODEL``."""
SETTINGS = {
    "spectra with --scene": ("spectrum", True),
    "spectra without": ("spectrum", False),
    "signal strengths": ("rssi", True),
    "channel coefficients": ("csi", True),
}
"""Headings of the settings in the help, with task and whether there is a scene."""


def _by_data(task: str, with_scene: bool) -> Model:
    entry: Model = import_module(f".{MODULES[task][with_scene]}", __package__).MODEL
    return entry


_settings: dict[str, Any] = {name: _by_data(*data).settings for name, data in SETTINGS.items()}
MODEL = replace(_by_data("rssi", True), tasks=tuple(MODULES), settings=_settings, by_data=_by_data)
