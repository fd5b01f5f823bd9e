"""Examples in the docstrings of the main path run and print what they state."""

from __future__ import annotations

import doctest
import importlib

import pytest


@pytest.mark.parametrize(
    "name", ["wrf_mi.checking.check", "wrf_mi.core.receivers", "wrf_mi.runs.api", "wrf_mi.viewer.view"]
)
def test_examples_of_docstrings_run(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0
    assert results.failed == 0
