"""Examples in the docstrings of the public names run and print what they state."""

import doctest
import importlib

import pytest

import wrf_mi

MOST_NAMES = 25  # names of the library in short
NAMES = {getattr(wrf_mi, name).__module__ for name in wrf_mi.__all__}
NAMES |= {
    f"wrf_mi.{name}"
    for name in ("core.settings", "scene.make", "apps.maps.api", "apps.maps.locate", "apps.viewer.view")
}


@pytest.mark.parametrize("name", sorted(NAMES))
def test_examples_of_docstrings_run(name: str) -> None:
    results = doctest.testmod(importlib.import_module(name))
    assert results.attempted > 0
    assert results.failed == 0


@pytest.mark.parametrize("name", wrf_mi.__all__)
def test_every_public_name_has_an_example_on_its_page(name: str) -> None:
    assert len(wrf_mi.__all__) <= MOST_NAMES
    assert ">>> " in (getattr(wrf_mi, name).__doc__ or "")
