"""Examples in the docstrings of the public names run and print what they state."""

from __future__ import annotations

import doctest
import importlib

import pytest

import wrf_mi

WITHOUT = {
    "wrf_mi.core.errors",
    "wrf_mi.datasets.download",  # needs a network
    "wrf_mi.runs.compare",  # in that of wrf_mi.runs.api
    "wrf_mi.runs.other_models",  # in that of wrf_mi.runs.api
    "wrf_mi.runs.run",  # in that of wrf_mi.runs.api
    "wrf_mi.scene.edit",  # in that of wrf_mi.scene.make
}
"""Modules of public names without examples of their own."""
NAMES = {getattr(wrf_mi, name).__module__ for name in wrf_mi.__all__}
NAMES |= {f"wrf_mi.{name}" for name in ("core.settings", "maps.api", "maps.locate", "scene.make", "viewer.view")}


@pytest.mark.parametrize("name", sorted(NAMES - WITHOUT))
def test_examples_of_docstrings_run(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0
    assert results.failed == 0
