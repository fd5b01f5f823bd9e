"""Commands that install LLVM, and libatomic, to which Dr.Jit's wheel is linked and which a small Debian lacks."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys

GOOD_FROM = 19  # oldest LLVM that works with Dr.Jit 1.5 in our tests


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
