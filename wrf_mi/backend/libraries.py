"""LLVM and CUDA libraries: search without loading one into this process, and commands that install LLVM.

File names: Debian and Ubuntu have ``libLLVM-14.so.1`` and ``libLLVM.so.19.1``, Fedora ``libLLVM-17.so`` and
``libLLVM.so.20.1``, Homebrew ``libLLVM.dylib`` and ``libLLVM-19.dylib``. Commands install libatomic, too, to which
Dr.Jit's wheel is linked and which a small Debian lacks.
"""

from __future__ import annotations

import glob
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain, starmap
from pathlib import Path

LLVM_VARIABLE = "DRJIT_LIBLLVM_PATH"
CUDA_VARIABLE = "DRJIT_LIBCUDA_PATH"  # environment variables that name the libraries for Dr.Jit to load

DARWIN_FOLDERS = ("/opt/homebrew/opt/llvm*/lib", "/usr/local/opt/llvm*/lib", "/opt/local/libexec/llvm-*/lib")
LINUX_FOLDERS = (
    *("/usr/lib64", "/usr/lib", "/usr/local/lib", "/usr/lib/llvm*/lib", "/usr/lib64/llvm*/lib", "/usr/lib/llvm*/lib64"),
    *("/opt/llvm*/lib", "/home/linuxbrew/.linuxbrew/opt/llvm*/lib"),
)
READ_TIMEOUT_S = 60  # reading the linker's cache takes milliseconds; a cold network disk may need much longer

_LLVM_NAME = re.compile(r"libLLVM(?:-(\d+(?:\.\d+)*))?\.(?:so((?:\.\d+)*)|(?:(\d+(?:\.\d+)*)\.)?dylib)")
GOOD_FROM = 19  # oldest LLVM that works with Dr.Jit 1.5 in our tests


@dataclass(frozen=True)
class LlvmLibrary:
    """An LLVM shared library.

    Attributes:
        path: the file, symbolic links resolved.
        version: its known part, e.g. ``(19, 1)`` or ``(14,)``; empty if unknown.
    """

    path: Path
    version: tuple[int, ...]

    def __str__(self) -> str:
        """``LLVM 19.1 (/usr/lib/libLLVM.so.19.1)``."""
        name = f"LLVM {'.'.join(map(str, self.version))}" if self.version else "library of unknown version"
        return f"{name} ({self.path})"


def version_from_name(name: str) -> tuple[int, ...] | None:
    """The version in a file name, ``()`` for an LLVM library without one, None for any other file."""
    match = _LLVM_NAME.fullmatch(name)
    if match is None:
        return None
    # In "libLLVM-14.so.1" and "libLLVM.so.1" the number behind .so is not LLVM's.
    behind = "" if match[2] == ".1" else match[2]
    digits = match[1] or behind or match[3] or ""
    return tuple(int(part) for part in digits.split(".") if part)


def find_llvm(*, ignore_variable: bool = False) -> list[LlvmLibrary]:
    """All LLVM libraries of this machine, newest first, those without a version in their names last; none is loaded.

    If ``DRJIT_LIBLLVM_PATH`` is set, and not to be ignored, only that file is returned (or none, if it is not a file).
    """
    asked = None if ignore_variable else os.environ.get(LLVM_VARIABLE)
    files = [file for file in [Path(asked)] if file.is_file()] if asked else list(_llvm_files())
    versions: dict[Path, tuple[int, ...]] = {}
    for file in files:
        real = file.resolve()
        names = [version_from_name(name) or () for name in (file.name, real.name)]
        versions[real] = max([versions.get(real, ()), *names], key=len)
    libraries = starmap(LlvmLibrary, versions.items())
    return sorted(libraries, key=lambda library: (library.version, str(library.path)), reverse=True)


def find_cuda() -> Path | None:
    """The NVIDIA driver's library if it is installed and there is a device, else None (untested, see ``probe``)."""
    asked = os.environ.get(CUDA_VARIABLE)
    if asked:
        return Path(asked) if Path(asked).is_file() else None
    # /dev/dxg is the device of the Windows subsystem for Linux.
    if not (glob.glob("/dev/nvidia[0-9]*") or os.path.exists("/dev/dxg")):
        return None
    folders = [*_library_folders(), Path("/usr/lib/wsl/lib"), Path("/usr/local/nvidia/lib64")]
    candidates = [*_linker_cache("libcuda.so"), *(folder / "libcuda.so.1" for folder in folders)]
    return next((file.resolve() for file in candidates if file.is_file()), None)


def _llvm_files() -> Iterator[Path]:
    files = [folder / name for folder in _library_folders() for name in glob.glob("libLLVM*", root_dir=folder)]
    yield from (file for file in [*files, *_linker_cache("libLLVM")] if version_from_name(file.name) is not None)


def _library_folders() -> list[Path]:
    """Existing folders in which a system's package manager, Conda or Homebrew puts shared libraries."""
    listed = [os.environ.get(f"{system}LD_LIBRARY_PATH", "") for system in ("", "DY")]
    roots = filter(None, (sys.prefix, os.environ.get("CONDA_PREFIX")))
    patterns = [*filter(None, os.pathsep.join(listed).split(os.pathsep)), *(f"{root}/lib" for root in roots)]
    if sys.platform == "darwin":
        patterns += [*DARWIN_FOLDERS, "/usr/local/lib"]
    else:
        multiarch = sysconfig.get_config_var("MULTIARCH") or f"{os.uname().machine}-linux-gnu"
        patterns += [f"/usr/lib/{multiarch}", *LINUX_FOLDERS]
    folders = map(Path, chain.from_iterable(map(glob.glob, patterns)))
    return list(dict.fromkeys(filter(Path.is_dir, folders)))


def _linker_cache(start: str) -> list[Path]:
    """Libraries of the dynamic linker's cache whose names start with ``start`` (Linux only)."""
    # Root's folders are often missing from a user's PATH.
    ldconfig = shutil.which("ldconfig", path=f"{os.environ.get('PATH', '')}:/sbin:/usr/sbin")
    if ldconfig is None or sys.platform == "darwin":
        return []
    try:
        listing = subprocess.run([ldconfig, "-p"], capture_output=True, text=True, timeout=READ_TIMEOUT_S).stdout
    except (OSError, subprocess.TimeoutExpired):
        return []
    pairs = (line.strip().split(" => ") for line in listing.splitlines() if " => " in line)
    return [Path(target) for name, target in pairs if name.startswith(start)]


def package_manager() -> str | None:
    """``apt-get``, ``dnf`` or ``brew``, whichever this system has, else None."""
    names = ["brew"] if sys.platform == "darwin" else ["apt-get", "dnf", "brew"]
    return next((name for name in names if shutil.which(name)), None)


def apt_packages() -> list[str]:
    """Packages of a suitable LLVM in the package lists of this Debian or Ubuntu, newest first; may be empty."""
    command = ["apt-cache", "search", "--names-only", "^libllvm[0-9]+"]
    try:
        listing = subprocess.run(command, capture_output=True, text=True).stdout
    except OSError:
        return []
    # Ubuntu 24.04 has names with "t64" behind the number.
    names = re.findall(r"^(libllvm(\d+)(?:t64)?) ", listing, re.MULTILINE)
    good = [(int(number), name) for name, number in names if int(number) >= GOOD_FROM]
    return [name for _, name in sorted(good, reverse=True)]


def install_commands() -> list[list[str]]:
    """Alternative commands that install an LLVM, best first, without ``sudo``; empty for an unknown system."""
    manager = package_manager()
    if manager == "apt-get":
        names = apt_packages() or [f"libllvm{GOOD_FROM}"]
        return [["apt-get", "install", "-y", "--no-install-recommends", name, "libatomic1"] for name in names]
    others = {"dnf": [["dnf", "install", "-y", "llvm-libs", "libatomic"]], "brew": [["brew", "install", "llvm"]]}
    return others.get(manager or "", [])


def install_line() -> str:
    """The command to run, or advice for a system without a known package manager."""
    commands = install_commands()
    if not commands:
        return f"install LLVM {GOOD_FROM} or newer, or set DRJIT_LIBLLVM_PATH to its libLLVM"
    sudo = "sudo " if commands[0][0] != "brew" and os.geteuid() != 0 else ""
    update = f"{sudo}apt-get update && " if package_manager() == "apt-get" and not apt_packages() else ""
    return update + sudo + " ".join(commands[0])
