from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparisons write a few bytes in place of each picture, which takes half a second to draw."""

    def write(path: Path, figure: Any) -> None:
        path.write_bytes(b"picture")

    monkeypatch.setattr("wrf_mi.runs.compare.write_figure", write)
