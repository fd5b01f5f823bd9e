"""Choice of LLVM or CUDA and of Mitsuba's variant.

Dr.Jit loads the newest LLVM at its import, and one that is too old does not raise: 15 and 16 end the process in the
first kernel with a minimum or maximum. So every library is tried once in a separate process (the verdict is cached per
file), and the first that works is named to Dr.Jit before its import. Call `init` before importing drjit, mitsuba or
sionna.
"""

from __future__ import annotations

import os
import platform
import sys
import threading
import warnings
from dataclasses import dataclass
from pathlib import Path

from ..core.errors import BackendError, InputError, LibraryVariableError
from .libraries import CUDA_VARIABLE, GOOD_FROM, LLVM_VARIABLE, LlvmLibrary, find_cuda, find_llvm, install_line
from .probe import VARIANTS, try_cuda, try_llvm

__all__ = [
    "VARIANTS",
    "Backend",
    "BackendError",
    "LlvmLibrary",
    "choose",
    "find_cuda",
    "find_llvm",
    "init",
    "set_threads",
    "stated_threads",
]

THREADS = "OMP_NUM_THREADS"
"""Environment variable with the number of threads, as of OpenMP; schedulers such as Dask and Slurm set it."""
_TOO_EARLY = "Dr.Jit was imported before wrf_mi.backend.init() and"


@dataclass(frozen=True)
class Backend:
    """Backend of Dr.Jit.

    Attributes:
        name: ``"llvm"`` or ``"cuda"``.
        variant: Mitsuba's variant.
        llvm_path: the LLVM library in use; None for CUDA, or if unknown.
        llvm_version: e.g. ``"19.1.7"``; None for CUDA.
        device: name of the GPU or of the processor.
    """

    name: str
    variant: str
    llvm_path: str | None
    llvm_version: str | None
    device: str


_active: Backend | None = None
_lock = threading.Lock()


def init(backend: str = "auto", threads: int | None = None) -> Backend:
    """Choose a backend, import Dr.Jit and Mitsuba and set the variant; later calls return the same backend.

    Args:
        backend: ``"auto"`` (CUDA if it works, else LLVM), ``"llvm"`` or ``"cuda"``.
        threads: number of threads for LLVM kernels; None: that of the environment variable ``OMP_NUM_THREADS``, or else
            all cores.

    Raises:
        BackendError: no usable library, or another backend is already in use: one line with the remedy.
        InputError: unknown ``backend``, or fewer than one thread.
    """
    global _active
    _check_arguments(backend, threads)
    with _lock:
        if _active is None:
            _active = _start(backend)
            threads = stated_threads() if threads is None else threads
        elif backend not in ("auto", _active.name):
            raise BackendError(f"this process already computes with {_active.name}: start another for {backend}")
        import mitsuba as mi

        before = mi.variant()
        if before != _active.variant:
            if before is not None:
                warnings.warn(f"Mitsuba's variant changes from {before} to {_active.variant}", stacklevel=2)
            mi.set_variant(_active.variant)
        if _active.name == "cuda":
            import drjit as dr

            # IEEE 754 division and roots in this thread, where Dr.Jit's flags live: the approximate ones have 20 bits
            # also in float64, where phases of hundreds of wavelengths and derivatives of a correction need more.
            dr.set_flag(dr.JitFlag.FastMath, False)
        if threads is not None:
            set_threads(threads)
        return _active


def stated_threads() -> int | None:
    """Number of threads that the environment variable `THREADS` states; None: none."""
    text = os.environ.get(THREADS, "").strip()
    return int(text) if text.isdecimal() and int(text) else None


def set_threads(threads: int) -> None:
    """Change the number of threads that LLVM kernels run on.

    Kernels traced or launched before have room for the sums of the threads at that time, and more threads write beyond
    it (Dr.Jit 1.5, ``scatter_reduce``), so they are evaluated first. For recorded functions see
    `wrf_mi.backend.device`.

    Args:
        threads: 1 or more.
    """
    import drjit as dr

    if threads != dr.thread_count():
        dr.eval()
        dr.sync_thread()
        dr.set_thread_count(threads)


def choose(backend: str = "auto", *, fresh: bool = False) -> Backend:
    """The backend that `init` uses in a new process; does not import Dr.Jit.

    Args:
        backend: ``"auto"``, ``"llvm"`` or ``"cuda"``.
        fresh: try every library again instead of using cached verdicts.

    Raises:
        BackendError: no usable library: one line with the remedy.
        InputError: unknown ``backend``.
    """
    _check_arguments(backend, None)
    cuda = None if backend == "llvm" else _choose_cuda(required=backend == "cuda", fresh=fresh)
    return cuda or _choose_llvm(fresh)


def _check_arguments(backend: str, threads: int | None) -> None:
    if backend not in ("auto", *VARIANTS):
        raise InputError(f"backend: {backend!r} is none of auto, llvm, cuda")
    if threads is not None and threads < 1:
        raise InputError(f"threads: must be at least 1, got {threads}")


def _start(backend: str) -> Backend:
    """The backend of this process; names its library to Dr.Jit if Dr.Jit is not imported yet."""
    if backend == "auto" and "mitsuba" in sys.modules:
        # A usable variant that is already set is kept.
        variant = sys.modules["mitsuba"].variant()
        backend = next((name for name, ours in VARIANTS.items() if ours == variant), backend)
    if "drjit" in sys.modules:
        return _judge_loaded(backend)
    chosen = choose(backend)
    if chosen.llvm_path is not None:
        os.environ[LLVM_VARIABLE] = chosen.llvm_path
    if chosen.name == "cuda":
        os.environ[CUDA_VARIABLE] = str(find_cuda())
    return chosen


def _choose_cuda(*, required: bool, fresh: bool) -> Backend | None:
    driver = find_cuda()
    if driver is None:
        reason, remedy = "no NVIDIA driver library with a device beside it was found", "install NVIDIA's driver"
    else:
        verdict = try_cuda(driver, fresh=fresh)
        if verdict.usable:
            return Backend("cuda", VARIANTS["cuda"], None, None, verdict.device)
        reason, remedy = f"{driver} {verdict.reason}", "see what nvidia-smi says"
    if required:
        raise BackendError(f"CUDA cannot be used, {reason}: {remedy}, or use the backend llvm")
    return None


def _choose_llvm(fresh: bool) -> Backend:
    refused = []
    for library in find_llvm():
        verdict = try_llvm(library, fresh=fresh)
        if verdict.usable:
            return _llvm(library.path, verdict.version)
        refused.append(f"{library} {verdict.reason}")
    if asked := os.environ.get(LLVM_VARIABLE):
        what = refused[0] if refused else f"{asked} is not a file"
        other = _good_llvm()
        remedy = f"unset it, {other} works" if other else f"unset it and install a newer one: {install_line()}"
        raise LibraryVariableError(f"{LLVM_VARIABLE} is set, but {what}: {remedy}")
    what = "; ".join(refused) or "none was found"
    raise BackendError(f"no usable LLVM ({what}): {install_line()}")


def _good_llvm() -> LlvmLibrary | None:
    return next((library for library in find_llvm(ignore_variable=True) if try_llvm(library).usable), None)


def _judge_loaded(backend: str) -> Backend:
    """The backend that Dr.Jit has already loaded, if it is usable."""
    import drjit as dr

    cuda = None if backend == "llvm" else _choose_cuda(required=backend == "cuda", fresh=False)
    if cuda is not None and dr.has_backend(dr.JitBackend.CUDA):
        return cuda
    if backend == "cuda":
        remedy = f"call wrf_mi.backend.init() first, or set {CUDA_VARIABLE}={find_cuda()} before Python starts"
        raise BackendError(f"{_TOO_EARLY} did not find the NVIDIA driver: {remedy}")
    if not dr.has_backend(dr.JitBackend.LLVM):
        raise _too_early("found no LLVM that it can use")
    version: tuple[int, ...] = dr.detail.llvm_version()
    path = _loaded_llvm()
    if path is None:
        # The file is unknown and cannot be tried; its version decides.
        usable, reason = version[0] >= GOOD_FROM, f"which is older than {GOOD_FROM}"
    else:
        verdict = try_llvm(LlvmLibrary(path, version))
        usable, reason = verdict.usable, f"which {verdict.reason}"
    text = ".".join(map(str, version))
    if not usable:
        raise _too_early(f"loaded LLVM {text} ({path or 'its file is not known'}), {reason}")
    return _llvm(path, text)


def _loaded_llvm() -> Path | None:
    """The LLVM mapped into this process (Linux), or the one that `LLVM_VARIABLE` names."""
    try:
        with open("/proc/self/maps") as maps:
            files = {line.split(maxsplit=5)[5].strip() for line in maps if "/libLLVM" in line}
    except OSError:
        files = set()
    # With several (a graphics driver loads another) Dr.Jit's is unknown.
    name = files.pop() if len(files) == 1 else os.environ.get(LLVM_VARIABLE)
    return Path(name) if name and Path(name).is_file() else None


def _too_early(text: str) -> BackendError:
    """Error of the LLVM that Dr.Jit loaded at its import, by the environment variable or by itself."""
    if os.environ.get(LLVM_VARIABLE):
        try:
            _choose_llvm(fresh=False)
        except LibraryVariableError as error:
            return error
    other = _good_llvm()
    remedy = (
        f"call wrf_mi.backend.init() first, or set {LLVM_VARIABLE}={other.path} before Python starts" if other else ""
    )
    return BackendError(f"{_TOO_EARLY} {text}: {remedy or install_line()}")


def _llvm(path: Path | None, version: str) -> Backend:
    try:
        with open("/proc/cpuinfo") as lines:
            name = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    except OSError:
        name = ""
    processor = name or platform.processor() or platform.machine()
    return Backend("llvm", VARIANTS["llvm"], None if path is None else str(path), version, processor)
