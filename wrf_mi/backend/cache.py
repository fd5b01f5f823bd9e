"""What was found out about this machine's libraries, kept in the user's cache folder.

One JSON file. It only saves time: a file that cannot be read or written is as good as an empty one.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

import platformdirs

_KEPT_UNTIL = "kept_until_s"


def cache_file() -> Path:
    """Where it is kept: ``~/.cache/wrf-mi/libraries.json`` on Linux."""
    return platformdirs.user_cache_path("wrf-mi") / "libraries.json"


def file_key(path: Path) -> str:
    """Names one state of one file: another file, or another version in its place, has another key."""
    real = path.resolve()
    state = real.stat()
    return f"{real}|{state.st_mtime_ns}|{state.st_size}"


def recall(key: str) -> dict[str, Any] | None:
    """What was remembered under ``key`` and is still valid, or None."""
    entry = _read().get(key)
    if not isinstance(entry, dict) or time.time() > entry.get(_KEPT_UNTIL, float("inf")):
        return None
    return entry


def remember(key: str, entry: dict[str, Any], seconds: float | None = None) -> None:
    """Keeps ``entry`` under ``key``, for ``seconds`` or for good."""
    file = cache_file()
    entries = _read() | {key: entry if seconds is None else entry | {_KEPT_UNTIL: time.time() + seconds}}
    with contextlib.suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        # Written beside and then moved, so that another process never reads half a file.
        handle, temporary = tempfile.mkstemp(dir=file.parent, suffix=".tmp")
        with os.fdopen(handle, "w") as stream:
            json.dump(entries, stream, indent=1)
        os.replace(temporary, file)


def _read() -> dict[str, Any]:
    try:
        entries = json.loads(cache_file().read_text())
    except (OSError, ValueError):
        return {}
    return entries if isinstance(entries, dict) else {}
