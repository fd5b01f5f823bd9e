"""Notebooks whose metadata name packages beside the dependencies (``requires``) are skipped where one is absent."""

from __future__ import annotations

import json
from importlib.util import find_spec

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark notebooks of which a package is absent."""
    for item in items:
        if item.path.suffix == ".ipynb":
            metadata = json.loads(item.path.read_text(encoding="utf-8"))["metadata"]
            if absent := [name for name in metadata.get("requires", ()) if find_spec(name) is None]:
                item.add_marker(pytest.mark.skip(reason=f"not installed: {', '.join(absent)}"))
