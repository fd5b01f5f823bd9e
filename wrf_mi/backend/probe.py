"""Tries a library in a process of its own before it is let into this one."""

from __future__ import annotations

import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .cache import file_key, recall, remember
from .libraries import CUDA_VARIABLE, LLVM_VARIABLE, LlvmLibrary

VARIANTS = {"llvm": "llvm_ad_mono_polarized", "cuda": "cuda_ad_mono_polarized"}
"""Mitsuba's variant of each backend: the ones in which Sionna RT works."""

OLDEST_TRIED = 17
"""LLVM 14 is refused by Dr.Jit 1.5; 15 and 16 have no instruction for a minimum or maximum and end the process."""

TRIAL_TIMEOUT_S = 180
"""A trial takes about a second; the first start of a CUDA driver may take a minute."""

FAILURE_KEPT_S = 24 * 3600
"""A failure is looked at again after a day: its cause may have been a busy GPU. `doctor` looks at once."""

_REASON_LENGTH = 160
_SCRIPT = Path(__file__).with_name("trial.py")


@dataclass(frozen=True)
class Verdict:
    """What a trial showed.

    Attributes:
        usable: it can be used.
        reason: why not, as a verb phrase ("is too old for Dr.Jit"); empty if it can.
        version: as the library itself reports it, e.g. ``"19.1.7"``; empty if it cannot be used.
        device: name of the GPU; empty for LLVM.
    """

    usable: bool
    reason: str = ""
    version: str = ""
    device: str = ""


def try_llvm(library: LlvmLibrary, *, fresh: bool = False) -> Verdict:
    """Whether Dr.Jit works with an LLVM. ``fresh`` tries again whatever is remembered."""
    if library.version and library.version[0] < OLDEST_TRIED:
        return Verdict(False, "is too old for Dr.Jit")
    return _try("llvm", LLVM_VARIABLE, library.path, fresh)


def try_cuda(driver: Path, *, fresh: bool = False) -> Verdict:
    """Whether Dr.Jit and Mitsuba work with the NVIDIA driver and a device. ``fresh`` as above."""
    return _try("cuda", CUDA_VARIABLE, driver, fresh)


def _try(name: str, variable: str, library: Path, fresh: bool) -> Verdict:
    try:
        key = "|".join([name, file_key(library), *_surroundings(name)])
    except OSError as error:
        return Verdict(False, f"cannot be read: {error.strerror}")
    known = None if fresh else recall(key)
    if known is not None:
        return Verdict(known["usable"], known["reason"], known["version"], known["device"])
    verdict, final = _run_trial(VARIANTS[name], variable, library)
    if final:
        remember(key, vars(verdict), None if verdict.usable else FAILURE_KEPT_S)
    return verdict


def _surroundings(name: str) -> list[str]:
    """What a verdict depends on beside the file: a home folder may be shared by different machines."""
    versions = []
    for package in ("drjit", "mitsuba"):
        try:
            versions.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            versions.append(f"{package} ?")
    devices = os.environ.get("CUDA_VISIBLE_DEVICES", "") if name == "cuda" else ""
    return [*versions, sha256(_SCRIPT.read_bytes()).hexdigest()[:12], platform.node(), devices]


def _run_trial(variant: str, variable: str, library: Path) -> tuple[Verdict, bool]:
    """The verdict, and whether it is worth remembering."""
    with tempfile.TemporaryDirectory() as kernels:
        environment = os.environ | {
            variable: str(library),
            # Kernels compiled earlier, by another library perhaps, must not hide what this one can do.
            "DRJIT_CACHE_DIR": kernels,
            # The child must import the very packages that this process would.
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
    """One short line of what a failed trial left behind."""
    missing = re.search(r"(\S+): cannot open shared object file", errors)
    if missing:
        return f"fails: {missing[1]} is missing"
    lines = [line.strip() for line in errors.splitlines() if line.strip()]
    said = next((line for line in lines if line.startswith("LLVM ERROR")), lines[-1] if lines else "")
    said = re.sub(r"\s*\b0x[0-9a-f]+\b[:,]?", "", said).removeprefix("RuntimeError: ")[:_REASON_LENGTH]
    if status < 0:
        ended = f"ends the process with {signal.Signals(-status).name}"
        return f"{ended}: {said}" if said else ended
    return f"fails: {said}" if said else f"fails with status {status}"
