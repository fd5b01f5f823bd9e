"""Trial of a library in a separate process before this one loads it.

Results are kept in one JSON file of the user's cache folder, which only saves time: an unreadable or unwritable file
counts as an empty one.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, fields
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import platformdirs

from ..core.files import write_atomically
from .libraries import CUDA_VARIABLE, LLVM_VARIABLE, LlvmLibrary

VARIANTS = {"llvm": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}  # in which Sionna RT works
OLDEST_TRIED = 17  # Dr.Jit 1.5 refuses LLVM 14; 15 and 16 end the process, as they lack minimum and maximum
TRIAL_TIMEOUT_S = 180  # a trial takes about a second, with the first start of a CUDA driver up to a minute
FAILURE_KEPT_S = 24 * 3600  # a failed library is tried again after a day: the GPU may have been busy
_REASON_LENGTH = 160
_SCRIPT = Path(__file__).with_name("trial.py")


@dataclass(frozen=True)
class Verdict:
    """Result of a trial."""

    usable: bool  # whether the library can be used
    reason: str = ""  # reason against it, a verb phrase ("is too old for Dr.Jit"); empty for a usable library
    version: str = ""  # version that the library reports, e.g. ``"19.1.7"``; empty for an unusable library
    device: str = ""  # name of the GPU; empty for LLVM


def installed_version(package: str) -> str | None:
    """Version of a package; None: not installed, or built without metadata."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def try_llvm(library: LlvmLibrary, *, fresh: bool = False) -> Verdict:
    """Whether Dr.Jit works with an LLVM; ``fresh`` ignores the cache."""
    if library.version and library.version[0] < OLDEST_TRIED:
        return Verdict(False, "is too old for Dr.Jit")
    return _try("llvm", LLVM_VARIABLE, library.path, fresh)


def try_cuda(driver: Path, *, fresh: bool = False) -> Verdict:
    """Whether Dr.Jit and Mitsuba work with the NVIDIA driver and a device; ``fresh`` ignores the cache."""
    return _try("cuda", CUDA_VARIABLE, driver, fresh)


def _try(name: str, variable: str, library: Path, fresh: bool) -> Verdict:
    versions = [f"{package} {installed_version(package) or '?'}" for package in ("drjit", "mitsuba")]
    # Several machines may share a home folder. Of the devices, an empty variable hides all, one that is unset none.
    devices = str(os.environ.get("CUDA_VISIBLE_DEVICES")) if name == "cuda" else ""
    try:
        script = sha256(_SCRIPT.read_bytes()).hexdigest()[:12]
        key = "|".join([name, file_key(library), *versions, script, platform.node(), devices])
    except OSError as error:
        return Verdict(False, f"cannot be read: {error.strerror}")
    recalled = None if fresh else recall(key)
    if recalled is not None:
        return Verdict(**{field.name: recalled[field.name] for field in fields(Verdict)})
    verdict, final = _run_trial(VARIANTS[name], variable, library)
    if final:
        remember(key, vars(verdict), float("inf") if verdict.usable else FAILURE_KEPT_S)
    return verdict


def _run_trial(variant: str, variable: str, library: Path) -> tuple[Verdict, bool]:
    """The verdict, and whether to store it."""
    with tempfile.TemporaryDirectory() as kernels:
        environment = os.environ | {
            variable: str(library),
            # Kernels that another library compiled must not be reused.
            "DRJIT_CACHE_DIR": kernels,
            # The child must import the same packages as this process.
            "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        }
        try:
            done = subprocess.run(
                [sys.executable, "-P", str(_SCRIPT), variant],
                env=environment,
                cwd=kernels,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=TRIAL_TIMEOUT_S,
            )
        except subprocess.TimeoutExpired:
            return Verdict(False, f"did not answer within {TRIAL_TIMEOUT_S} s"), False
        except OSError as error:
            return Verdict(False, f"could not be tried: {error}"), False
    try:
        answer = json.loads(done.stdout.strip().splitlines()[-1])
        return Verdict(True, "", ".".join(map(str, answer["version"])), answer["device"]), True
    except (IndexError, ValueError, KeyError, TypeError):
        return Verdict(False, _reason(done.returncode, done.stderr)), True


def _reason(status: int, errors: str) -> str:
    missing = re.search(r"(\S+): cannot open shared object file", errors)
    if missing:
        return f"fails: {missing[1]} is missing"
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    line = next((text for text in lines if text.startswith("LLVM ERROR")), lines[-1] if lines else "")
    line = re.sub(r"\s*\b0x[0-9a-f]+\b[:,]?", "", line).removeprefix("RuntimeError: ")[:_REASON_LENGTH]
    if status < 0:
        ended = f"ends the process with {signal.Signals(-status).name}"
        return f"{ended}: {line}" if line else ended
    return f"fails: {line}" if line else f"fails with status {status}"


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
