"""Changes of a data set's folder, what its reader then says, and data sets that the machine may have."""

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


def replaced(name: str, old: str, new: str, message: str) -> tuple[Change, str, str]:
    """A change by `text`, the file that is refused, and the message."""
    return text(name, old, new), name, message


def rewritten(name: str, content: bytes | str, message: str) -> tuple[Change, str, str]:
    """Likewise by `write`."""
    return write(name, content), name, message


def append(name: str, line: str) -> Change:
    def change(folder: Path) -> None:
        with (folder / name).open("a", encoding="utf-8") as file:
            file.write(f"{line}\n")

    return change


def remove(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def error_line(function: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """The error of a function, one line; the last argument is the pattern that it matches."""
    *passed, message = arguments
    with pytest.raises(InputError, match=message) as error:
        function(*passed, **options)
    line = str(error.value)
    del error  # and its frames, which hold the sockets of downloads
    assert "\n" not in line
    return line


def refusal(function: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Likewise an error that states a remedy."""
    line = error_line(function, *arguments, **options)
    assert ";" in line, "no remedy"
    return line
