"""Results of trials of this machine's libraries, in one JSON file of the user's cache folder.

The file only saves time: an unreadable or unwritable file counts as an empty one.
"""

from __future__ import annotations

import contextlib
import json
import time
from pathlib import Path
from typing import Any

import platformdirs

from wrf_mi.core.files import write_atomically


def cache_file() -> Path:
    """The file: ``~/.cache/wrf-mi/libraries.json`` on Linux."""
    return platformdirs.user_cache_path("wrf-mi") / "libraries.json"


def file_key(path: Path) -> str:
    """Key of a file in its present version."""
    real = path.resolve()
    state = real.stat()
    return f"{real}|{state.st_mtime_ns}|{state.st_size}"


def recall(key: str) -> dict[str, Any] | None:
    """The entry under ``key`` if there is a valid one, else None."""
    entry = _read().get(key)
    if not isinstance(entry, dict) or time.time() > entry.get("kept_until_s", float("inf")):
        return None
    return entry


def remember(key: str, entry: dict[str, Any], seconds: float = float("inf")) -> None:
    """Store ``entry`` under ``key`` for a time."""
    limit = {} if seconds == float("inf") else {"kept_until_s": time.time() + seconds}
    with contextlib.suppress(OSError):
        write_atomically(cache_file(), json.dumps(_read() | {key: entry | limit}, indent=1))


def _read() -> dict[str, Any]:
    try:
        entries = json.loads(cache_file().read_text())
    except (OSError, ValueError):
        return {}
    return entries if isinstance(entries, dict) else {}
