from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from PIL import Image


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparisons write a grey image in place of each picture, which takes half a second to draw."""

    def write(path: Path, figure: Any) -> None:
        Image.new("L", (4, 3)).save(path, format="png")

    monkeypatch.setattr("wrf_mi.runs.compare.write_figure", write)
