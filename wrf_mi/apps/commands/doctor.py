"""``wrf-mi doctor``: packages, backends and data on this machine, and remedies for what is missing."""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from importlib.metadata import requires
from typing import Any

from packaging.requirements import Requirement

from ...backend import BackendError, choose, find_cuda, find_llvm
from ...backend.libraries import install_commands, package_manager
from ...backend.probe import installed_version, try_cuda, try_llvm
from ...core.memory import free_bytes
from ...parallel.threads import processors
from .options import Arguments, add_command
from .output import show

_PACKAGES = ("wrf-mi", "mitsuba", "drjit", "sionna-rt", "numpy", "scipy", "scikit-image")
EXTRAS = ("lidar", "meshes", "cad", "bim", "tables", "view", "cluster", "maps", "argos")  # what commands of users need
_DATA_VARIABLE = "WRF_MI_DATA"


def add_parser(commands: Any) -> None:
    """Add ``doctor`` to the commands."""
    text = "show which backend, LLVM, GPU and data were found, and the remedy for what is missing"
    parser = add_command(commands, "doctor", doctor_command, text)
    text = "first install LLVM with the system's package manager if no backend works"
    parser.add_argument("--install-llvm", action="store_true", help=text)


def report() -> dict[str, Any]:
    """State of this machine; each LLVM and the GPU are tried anew. Dr.Jit is not imported.

    Returns:
        Values for JSON: ``ok`` (a backend works and all packages are installed), ``python``, ``system``, ``versions``
        (package to version or None), ``threads`` (cores this process may use), ``memory_gb`` (free memory, 1e9 bytes),
        ``extras`` (packages of each of `EXTRAS` that are not installed), ``backend`` (the fields of
        `wrf_mi.backend.Backend`, or None), ``llvm`` (a list of path, version, usable, reason), ``gpu`` (driver,
        usable, reason, device), ``data`` (home, cache, sets: a list of name, task, folder or None, and fetch, the
        command, or None) and ``problems`` (a list of problem, remedy).
    """
    problems: list[dict[str, str]] = []
    versions = {name: installed_version(name) for name in _PACKAGES}
    for name, version in versions.items():
        if version is None:
            problems.append({"problem": f"the package {name} is not installed", "remedy": "pip install -e ."})
    complete = not problems
    llvm = []
    for library in find_llvm(ignore_variable=True):
        verdict = try_llvm(library, fresh=True)
        number = verdict.version or ".".join(map(str, library.version))
        llvm.append({"path": str(library.path), "version": number, "usable": verdict.usable, "reason": verdict.reason})
    gpu, backend = _gpu(), None
    try:
        backend = vars(choose())
    except BackendError as error:
        problem, _, remedy = str(error).rpartition(": ")
        problems.append({"problem": problem, "remedy": remedy})
    if gpu["driver"] and not gpu["usable"]:
        problems.append({"problem": f"the GPU cannot be used: {gpu['driver']} {gpu['reason']}", "remedy": "nvidia-smi"})
    return {
        "ok": complete and backend is not None,
        "python": f"{platform.python_version()} ({sys.executable})",
        "system": platform.platform(),
        "versions": versions,
        "threads": processors(),
        "memory_gb": round(free_bytes() / 1e9, 1),
        "extras": _missing_of_extras(),
        "backend": backend,
        "llvm": llvm,
        "gpu": gpu,
        "data": _data(problems),
        "problems": problems,
    }


def _missing_of_extras() -> dict[str, list[str]]:
    """Packages of each extra of users that are not installed, by the requirements of the installed package."""
    missing: dict[str, list[str]] = {}
    for line in requires("wrf-mi") or ():
        requirement = Requirement(line)
        for extra in EXTRAS:
            if requirement.marker and requirement.marker.evaluate({"extra": extra}):
                missing_of_extra = missing.setdefault(extra, [])
                if not requirement.marker.evaluate({"extra": ""}) and installed_version(requirement.name) is None:
                    missing_of_extra.append(requirement.name)
    return missing


def render(state: dict[str, Any]) -> str:
    """Report as text."""
    backend = state["backend"]
    lines = [
        ("backend", f"{backend['name']} ({backend['variant']}) on {backend['device']}" if backend else "none"),
        ("threads", str(state["threads"])),
        ("memory", f"{state['memory_gb']:.1f} GB free"),
        ("GPU", state["gpu"]["device"] or state["gpu"]["reason"]),
    ]
    lines += [("LLVM", _llvm_line(library, backend)) for library in state["llvm"]] or [("LLVM", "none found")]
    lines += [("Python", state["python"]), ("system", state["system"])]
    lines += [(name, text or "not installed") for name, text in state["versions"].items()]
    for extra, missing in state["extras"].items():
        text = f"not installed: {', '.join(missing)} (pip install '.[{extra}]')" if missing else "installed"
        lines.append((f"extra {extra}", text))
    lines.append(("data", state["data"]["home"]))
    for entry in state["data"]["sets"]:
        absent = f"not on this machine ({entry['fetch']})" if entry["fetch"] else "not on this machine"
        lines.append((f"  {entry['name']}", entry["folder"] or absent))
    width = max(len(label) for label, _ in lines) + 2
    rows = [f"{label:<{width}}{value}" for label, value in lines]
    for entry in state["problems"]:
        rows += ["", entry["problem"], f"  remedy: {entry['remedy']}"]
    return "\n".join(rows)


def install_llvm() -> None:
    """Install an LLVM that works, with apt, dnf or brew, unless a backend works already.

    Runs as root, or with a ``sudo`` that asks for no password. The package manager prints its output. `BackendError`:
    no permission, or no working LLVM afterwards: one line with the command to run by hand.
    """
    try:
        choose()
        return
    except BackendError as error:
        # A library that the variable names is the user's choice: no package replaces it.
        if os.environ.get("DRJIT_LIBLLVM_PATH") or not install_commands() or (prefix := _privilege()) is None:
            raise
        reason = error
    _install(prefix, reason)


def _install(prefix: list[str], reason: BackendError) -> None:
    """Install packages until one of them works; ``reason`` is why LLVM does not work before."""
    # The second round is for package lists that are empty or outdated.
    for refresh in (False, True):
        if refresh and package_manager() == "apt-get":
            _run([*prefix, "apt-get", "update"])
        for command in install_commands():
            if _run([*prefix, *command]):
                try:
                    choose("llvm", fresh=True)
                    return
                except BackendError as error:
                    reason = error
    raise BackendError(f"installing LLVM did not help: {reason}")


def doctor_command(a: Arguments) -> int:
    """Report on this machine; with ``--install-llvm`` LLVM is installed first."""
    if a.install_llvm:
        install_llvm()
    state = report()
    show(a.json, state, render(state))
    return 0 if state["ok"] else 1


def _gpu() -> dict[str, Any]:
    driver = find_cuda()
    if driver is None:
        return {"driver": None, "usable": False, "reason": "no NVIDIA GPU with its driver", "device": ""}
    verdict = try_cuda(driver, fresh=True)
    return {"driver": str(driver), "usable": verdict.usable, "reason": verdict.reason, "device": verdict.device}


def _data(problems: list[dict[str, str]]) -> dict[str, Any]:
    """Folders of data sets, and commands that fetch them; none of them is needed."""
    from ...datasets import data_home, datasets, user_cache

    home = data_home()
    if os.environ.get(_DATA_VARIABLE) and not home.is_dir():
        problems.append({"problem": f"{_DATA_VARIABLE}={home} is not a folder", "remedy": f"unset {_DATA_VARIABLE}"})
    sets = []
    for entry in datasets():
        name, folder = entry.dataset.name, entry.location
        fetched = None if entry.dataset.base_url is None else f"wrf-mi data fetch {name}"
        location = {"folder": str(folder) if folder else None, "fetch": fetched}
        sets.append({"name": name, "task": entry.dataset.task, **location})
    return {"home": str(home), "cache": str(user_cache()), "sets": sets}


def _llvm_line(library: dict[str, Any], backend: dict[str, Any] | None) -> str:
    chosen = backend is not None and backend["llvm_path"] == library["path"]
    state = "in use" if chosen else "works" if library["usable"] else library["reason"]
    return f"{library['version'] or '?'} {library['path']}: {state}"


def _privilege() -> list[str] | None:
    """Prefix of commands that change the system; None without permission."""
    if package_manager() == "brew" or os.geteuid() == 0:
        return []
    sudo = shutil.which("sudo")
    if sudo and subprocess.run([sudo, "-n", "true"], capture_output=True).returncode == 0:
        return [sudo, "-n"]
    return None


def _run(command: list[str]) -> bool:
    print("+", *command, file=sys.stderr, flush=True)
    environment = os.environ | {"DEBIAN_FRONTEND": "noninteractive"}
    return subprocess.run(command, env=environment, stdin=subprocess.DEVNULL).returncode == 0
