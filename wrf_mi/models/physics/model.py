"""The model ``physics``: planes, materials and kriging, by the task of the data, in a scene."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module
from typing import Any

from ..model import Model

TASKS = {"spectrum": "spectra", "rssi": "signal strengths", "csi": "channel coefficients"}
"""Tasks, each with a module that has its entry as ``MODEL``, and headings of their settings in the help."""


def _by_data(task: str, with_scene: bool) -> Model:
    entry: Model = import_module(f".{task}", __package__).MODEL
    return entry


_settings: dict[str, Any] = {name: _by_data(task, True).settings for task, name in TASKS.items()}
MODEL = replace(_by_data("rssi", True), tasks=tuple(TASKS), settings=_settings, by_data=_by_data)
