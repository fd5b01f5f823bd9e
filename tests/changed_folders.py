"""Changes of a data set's folder, what its reader then says, and data sets that the machine may have."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from wrf_mi.core import InputError

Change = Callable[[Path], object]
DATA = Path(os.environ.get("WRF_MI_DATA", "/nowhere"))


def needs(name: str) -> pytest.MarkDecorator:
    return pytest.mark.skipif(not (DATA / name).is_dir(), reason=f"WRF_MI_DATA names no folder with {name}/")


def text(name: str, old: str, new: str) -> Change:
    """Replace the first match of a pattern in a text file."""

    def change(folder: Path) -> None:
        before = (folder / name).read_text()
        changed = re.sub(old, new, before, count=1, flags=re.MULTILINE)
        assert changed != before
        (folder / name).write_text(changed)

    return change


def write(name: str, content: bytes | str) -> Change:
    return lambda folder: (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)


def append(name: str, line: str) -> Change:
    def change(folder: Path) -> None:
        with (folder / name).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    return change


def remove(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def refusal(read: Callable[[Any], Any], given: Any, message: str) -> str:
    """The error of a reader: one line with a remedy that matches."""
    with pytest.raises(InputError, match=message) as error:
        read(given)
    line = str(error.value)
    assert "\n" not in line
    assert ";" in line, "no remedy"
    return line
