import json
import os
import sys
from pathlib import Path

import pytest

from wrf_mi import backend
from wrf_mi.apps.commands import doctor
from wrf_mi.apps.commands.main import main
from wrf_mi.backend import libraries, probe
from wrf_mi.core import BackendError


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Other tests may have initialised the backend in this process, which sets the variable.
    monkeypatch.delenv(libraries.LLVM_VARIABLE, raising=False)
    monkeypatch.setattr(probe, "cache_file", lambda: tmp_path / "cache" / "libraries.json")


class System:
    """A system whose only commands are stand-ins that write down how they were called."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.bin, self.log, self.monkeypatch = folder / "bin", folder / "calls", monkeypatch
        self.bin.mkdir()
        self.log.touch()
        monkeypatch.setenv("PATH", str(self.bin))

    def command(self, name: str, body: str = "exit 0") -> None:
        file = self.bin / name
        file.write_text(f'#!/bin/sh\necho "{name} $*" >>"{self.log}"\n{body}\n')
        file.chmod(0o755)

    def calls(self, start: str = "") -> list[str]:
        return [line for line in self.log.read_text().splitlines() if line.startswith(start)]

    def works_after(self, call: str) -> None:
        """No backend works until ``call`` was made."""

        def choose(name: str = "auto", *, fresh: bool = False) -> None:
            if not self.calls(call):
                raise BackendError("no usable LLVM (none was found): install one")

        self.monkeypatch.setattr(doctor, "choose", choose)


PACKAGES = """/bin/cat <<'END'
libllvm14 - runtime library
libllvm19 - runtime library
libllvm22t64 - runtime library
libllvmlibc-19-dev - LLVM C Library
libllvm-19-ocaml-dev - bindings
END"""
INSTALL = "apt-get install -y --no-install-recommends"


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> System:
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    return System(tmp_path, monkeypatch)


@pytest.fixture
def apt(system: System) -> System:
    """A system with apt and its lists of packages."""
    system.command("apt-get")
    system.command("apt-cache", PACKAGES)
    return system


def test_report_of_this_machine() -> None:
    report = json.loads(json.dumps(doctor.report()))
    expected = backend.choose()
    assert report["ok"]
    assert report["backend"] == vars(expected)
    if expected.llvm_path:
        (used,) = [library for library in report["llvm"] if library["path"] == expected.llvm_path]
        assert used["usable"]
        assert used["version"] == expected.llvm_version
    assert report["threads"] >= 1
    assert report["versions"]["drjit"] == "1.5.0"
    text = doctor.render(report)
    assert expected.variant in text
    assert all(library["path"] in text for library in report["llvm"])


def test_report_without_any_llvm(apt: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(libraries, "_library_folders", lambda: [])
    monkeypatch.setattr(libraries, "_linker_cache", lambda start: [])
    for part in (backend, doctor):
        monkeypatch.setattr(part, "find_cuda", lambda: None)
    report = doctor.report()
    assert not report["ok"]
    assert report["backend"] is None
    remedy = libraries.install_line()
    assert {"problem": "no usable LLVM (none was found)", "remedy": remedy} in report["problems"]
    assert f"remedy: {remedy}" in doctor.render(report)


def test_report_names_data_that_can_be_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WRF_MI_DATA", str(tmp_path / "data"))
    monkeypatch.setattr("wrf_mi.datasets.registry.user_cache", lambda: tmp_path / "none")
    report = doctor.report()
    assert [entry["remedy"] for entry in report["problems"]] == ["unset WRF_MI_DATA"]
    assert "not on this machine (wrf-mi data fetch rfid-lab)" in doctor.render(report)
    (tmp_path / "data" / "rfid-lab").mkdir(parents=True)
    report = doctor.report()
    folders = {entry["name"]: entry["folder"] for entry in report["data"]["sets"]}
    assert folders["rfid-lab"] == str(tmp_path / "data" / "rfid-lab")
    assert "data fetch rfid-lab" not in doctor.render(report)


def test_nothing_is_installed_where_a_backend_works(system: System) -> None:
    system.command("apt-get")
    system.works_after("")
    system.log.write_text("\n")
    doctor.install_llvm()
    assert system.calls() == [""]


def test_apt_installs_the_newest_working_llvm(apt: System) -> None:
    apt.works_after(f"{INSTALL} libllvm19")
    doctor.install_llvm()
    assert apt.calls("apt-get") == [f"{INSTALL} libllvm22t64 libatomic1", f"{INSTALL} libllvm19 libatomic1"]


def test_line_for_a_system_without_package_lists(system: System) -> None:
    system.command("apt-get")
    system.command("apt-cache")
    assert libraries.install_line() == f"apt-get update && {INSTALL} libllvm19 libatomic1"


def test_apt_fetches_missing_lists(system: System) -> None:
    lists = system.bin / "lists"
    system.command("apt-get", f'[ "$1" = update ] && : >"{lists}"; [ -e "{lists}" ]')
    system.command("apt-cache", f'[ -e "{lists}" ] && {PACKAGES}')
    system.works_after(f"{INSTALL} libllvm22t64")
    doctor.install_llvm()
    assert "apt-get update" in system.calls()


def test_an_install_that_does_not_help_is_an_error(system: System) -> None:
    system.command("dnf")
    system.works_after("never")
    with pytest.raises(BackendError, match=r"did not help: no usable LLVM \(none was found\)"):
        doctor.install_llvm()
    assert "dnf install -y llvm-libs libatomic" in system.calls()


def test_without_rights_the_error_is_the_line_to_run(apt: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    apt.works_after("never")
    assert libraries.install_line() == f"sudo {INSTALL} libllvm22t64 libatomic1"
    with pytest.raises(BackendError, match="no usable LLVM"):
        doctor.install_llvm()
    apt.command("sudo", "exit 1")  # asks for a password
    with pytest.raises(BackendError, match="no usable LLVM"):
        doctor.install_llvm()
    assert not apt.calls("apt-get")


def test_passwordless_sudo_is_used(apt: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    apt.command("sudo", 'shift; [ "$1" = true ] || "$@"')
    apt.works_after(f"{INSTALL} libllvm22t64")
    doctor.install_llvm()
    assert f"sudo -n {INSTALL} libllvm22t64 libatomic1" in apt.calls()


def test_brew_needs_no_root(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(os, "geteuid", lambda: 501)
    system.command("brew")
    system.works_after("brew install llvm")
    doctor.install_llvm()
    assert system.calls() == ["brew install llvm"]


def test_unknown_system_gets_advice(system: System) -> None:
    assert libraries.install_commands() == []
    assert "DRJIT_LIBLLVM_PATH" in libraries.install_line()


def test_a_named_library_is_not_replaced(system: System, monkeypatch: pytest.MonkeyPatch) -> None:
    system.command("apt-get")
    system.works_after("never")
    monkeypatch.setenv(libraries.LLVM_VARIABLE, "/nowhere/libLLVM.so")
    with pytest.raises(BackendError, match="no usable LLVM"):
        doctor.install_llvm()
    assert system.calls() == []


def test_command_prints_the_report_and_the_error_of_an_installation(monkeypatch, capsys):
    assert main(["doctor", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["ok"]

    def refuse() -> None:
        raise BackendError("LLVM is missing: run this")

    monkeypatch.setattr(doctor, "install_llvm", refuse)
    assert main(["doctor", "--install-llvm"]) == 1
    assert capsys.readouterr().err == "wrf-mi: LLVM is missing: run this\n"


def test_packages_that_an_extra_lacks_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    installed_version = doctor.installed_version
    monkeypatch.setattr(
        doctor, "installed_version", lambda name: None if name in ("zarr", "numpy") else installed_version(name)
    )
    state = doctor.report()
    assert state["extras"]["maps"] == ["zarr"]
    text = doctor.render(state)
    assert "not installed: zarr (pip install '.[maps]')" in text
    assert state["memory_gb"] > 0
