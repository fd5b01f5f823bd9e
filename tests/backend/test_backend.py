import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wrf_mi import backend
from wrf_mi.backend import libraries, probe
from wrf_mi.core import BackendError, InputError

SECONDS_PER_CHILD = 300
"""A child imports Mitsuba and may try a library: about a second, much longer on a busy machine."""

CHOICE_S = 0.05
"""What choosing may add to the import of Mitsuba once the verdicts are remembered."""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Other tests may have initialised the backend in this process, which sets the variable.
    monkeypatch.delenv(libraries.LLVM_VARIABLE, raising=False)
    monkeypatch.delenv(libraries.CUDA_VARIABLE, raising=False)
    monkeypatch.setattr(probe, "cache_file", lambda: tmp_path / "cache" / "libraries.json")


@pytest.fixture
def only(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Makes a folder with empty files of these names all that is found."""

    def build(*names: str) -> Path:
        folder = tmp_path / "lib"
        folder.mkdir(exist_ok=True)
        for name in names:
            (folder / name).touch()
        monkeypatch.setattr(libraries, "_library_folders", lambda: [folder])
        monkeypatch.setattr(libraries, "_linker_cache", lambda start: [])
        return folder

    return build


def good_if(*versions: tuple[int, ...]):
    """Stands in for the trial: only these versions work."""

    def verdict(library: libraries.LlvmLibrary, *, fresh: bool = False) -> probe.Verdict:
        reason = "" if library.version in versions else "does not work"
        return probe.Verdict(not reason, reason, ".".join(map(str, library.version)))

    return verdict


def refusal(name: str = "llvm") -> str:
    """The one line with which a backend is refused."""
    with pytest.raises(BackendError) as caught:
        backend.choose(name)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def real_llvm(major: int) -> libraries.LlvmLibrary:
    of_major = [library for library in backend.find_llvm(ignore_variable=True) if library.version[:1] == (major,)]
    if not of_major:
        pytest.skip(f"LLVM {major} is not installed here")
    return of_major[0]


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code]
    environment = os.environ | environment
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=SECONDS_PER_CHILD)


VERSIONS = {
    **{"libLLVM-14.so.1": (14,), "libLLVM-14.0.6.so.1": (14, 0, 6), "libLLVM-17.so": (17,), "libLLVM.so.19.1": (19, 1)},
    **{"libLLVM-19.dylib": (19,), "libLLVM.19.1.dylib": (19, 1)},
    **dict.fromkeys(("libLLVM.so", "libLLVM.so.1", "libLLVM.dylib"), ()),
    **dict.fromkeys(("libLLVM.so.19.1-rust-1.83.0-stable", "libLLVMCore.a", "libLLVMSPIRVLib.so.15", "libLLVM-C.so")),
}


@pytest.mark.parametrize(("name", "version"), VERSIONS.items())
def test_version_from_file_name(name, version):
    assert libraries.version_from_name(name) == version


@given(st.integers(3, 99), st.integers(0, 9), st.integers(0, 99))
def test_version_round_trips_through_a_file_name(major, minor, patch):
    assert libraries.version_from_name(f"libLLVM-{major}.{minor}.{patch}.so") == (major, minor, patch)
    assert libraries.version_from_name(f"libLLVM.so.{major}.{minor}") == (major, minor)


def test_newest_first_each_file_once(only):
    folder = only("libLLVM-14.so.1", "libLLVM.so.19.1", "libLLVM.so.9.1", "libLLVM-19.1.7.so", "libLLVMCore.a")
    (folder / "libLLVM-19.so").symlink_to("libLLVM.so.19.1")
    names = ["libLLVM-19.1.7.so", "libLLVM.so.19.1", "libLLVM-14.so.1", "libLLVM.so.9.1"]
    assert [library.path.name for library in backend.find_llvm()] == names
    assert [library.version for library in backend.find_llvm()] == [(19, 1, 7), (19, 1), (14,), (9, 1)]


def test_variable_excludes_all_others(only, tmp_path, monkeypatch):
    folder = only("libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setenv(libraries.LLVM_VARIABLE, str(folder / "libLLVM-15.so.1"))
    assert [library.version for library in backend.find_llvm()] == [(15,)]
    assert len(backend.find_llvm(ignore_variable=True)) == 2
    monkeypatch.setenv(libraries.LLVM_VARIABLE, str(tmp_path / "missing.so"))
    assert backend.find_llvm() == []


def test_newest_good_library_is_chosen(only, monkeypatch):
    only("libLLVM.so.23.1", "libLLVM.so.20.1", "libLLVM.so.19.1", "libLLVM-15.so.1")
    monkeypatch.setattr(backend, "try_llvm", good_if((20, 1), (19, 1), (15,)))
    assert backend.choose("llvm").llvm_version == "20.1"


@pytest.mark.parametrize("major", [14, 16])
def test_old_llvm_is_refused_without_a_trial(only, major, monkeypatch):
    only(f"libLLVM-{major}.so.1")
    monkeypatch.setattr(probe, "_run_trial", lambda *arguments: pytest.fail("an old LLVM was loaded"))
    assert re.search(rf"LLVM {major} .* is too old .*: .*install", refusal())


def test_missing_and_invalid_libraries_are_refused(only, monkeypatch):
    only()
    assert re.search(r"no usable LLVM \(none was found\): .*install", refusal())
    folder = only("libLLVM.so.19.1")
    assert re.search(r"LLVM 19\.1 .* fails", refusal())
    only("libLLVM-15.so.1")
    monkeypatch.setenv(libraries.LLVM_VARIABLE, str(folder / "libLLVM-15.so.1"))
    monkeypatch.setattr(backend, "try_llvm", good_if((19, 1)))
    assert re.search(r"LLVM 15 .* does not work: unset it, LLVM 19\.1 .* works", refusal())


def test_trial_reports_an_abort():
    verdict, final = probe._run_trial(backend.VARIANTS["llvm"], libraries.LLVM_VARIABLE, real_llvm(15).path)
    assert (final, verdict.usable) == (True, False)
    assert re.search("(?=.*SIGABRT)(?=.*fminimum)(?!.*0x)", verdict.reason)


def test_verdicts_are_cached_until_the_file_changes(only, monkeypatch):
    file = only("libLLVM.so.19.1") / "libLLVM.so.19.1"
    trials = []

    def trial(variant: str, variable: str, library: Path) -> tuple[probe.Verdict, bool]:
        trials.append(library)
        return probe.Verdict(True, version="19.1.0"), True

    monkeypatch.setattr(probe, "_run_trial", trial)
    (library,) = backend.find_llvm()
    assert probe.try_llvm(library) == probe.try_llvm(library)
    assert len(trials) == 1
    probe.try_llvm(library, fresh=True)
    os.utime(file, ns=(1, 1))
    probe.try_llvm(library)
    assert len(trials) == 3


def test_verdicts_of_hidden_and_visible_devices_differ(tmp_path, monkeypatch):
    """An empty list of devices hides them, none shows all."""
    driver, tried = tmp_path / "libcuda.so.1", list[str | None]()
    driver.touch()

    def trial(*_: object) -> tuple[probe.Verdict, bool]:
        tried.append(os.environ.get("CUDA_VISIBLE_DEVICES"))
        return probe.Verdict(tried[-1] != "", ""), True

    monkeypatch.setattr(probe, "_run_trial", trial)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert probe.try_cuda(driver).usable
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert not probe.try_cuda(driver).usable
    assert tried == [None, ""]


def test_cached_failures_expire_and_a_damaged_cache_counts_as_empty():
    probe.remember("short", {"usable": False}, seconds=-1)
    probe.remember("long", {"usable": True})
    assert probe.recall("short") is None
    assert probe.recall("long") == {"usable": True}
    probe.cache_file().write_text('{"long": {"usa')
    assert probe.recall("long") is None
    probe.remember("long", {"usable": True})
    assert probe.recall("long") == {"usable": True}


def test_unwritable_cache_is_ignored(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(probe, "cache_file", lambda: tmp_path / "file" / "libraries.json")
    probe.remember("key", {"usable": True})
    assert probe.recall("key") is None


def test_choice_is_fast_once_cached():
    backend.choose()
    seconds = []
    for _ in range(5):
        start = time.perf_counter()
        backend.choose()
        seconds.append(time.perf_counter() - start)
    assert min(seconds) < CHOICE_S


@pytest.mark.parametrize("imported_before", ["", "import drjit; "])
@pytest.mark.parametrize("major", [14, 15])
def test_process_with_an_old_llvm_ends_with_one_line(major, imported_before):
    path = str(real_llvm(major).path)
    ended = run_python(f"{imported_before}import wrf_mi.backend as b; b.init()", **{libraries.LLVM_VARIABLE: path})
    assert ended.returncode == 1
    last = ended.stderr.strip().splitlines()[-1]
    assert last.startswith("wrf_mi.core.errors.LibraryVariableError: ")
    assert libraries.LLVM_VARIABLE in last or "install" in last


IN_A_NEW_PROCESS = """
import os, sys
import wrf_mi.backend as b
assert "drjit" not in sys.modules
first = b.init("llvm", threads=1)
import drjit, mitsuba
assert mitsuba.variant() == first.variant == "llvm_ad_mono_polarized"
assert b.init() is first
assert drjit.thread_count() == 1
assert first.llvm_path == os.environ["DRJIT_LIBLLVM_PATH"]
assert ".".join(map(str, drjit.detail.llvm_version())) == first.llvm_version
try:
    b.init("cuda")
except b.BackendError as error:
    assert "already computes with llvm" in str(error)
else:
    raise AssertionError
"""
AFTER_DRJIT = """
import warnings
import mitsuba
mitsuba.set_variant("scalar_rgb")
import wrf_mi.backend as b
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    chosen = b.init("llvm")
assert mitsuba.variant() == chosen.variant
assert any("from scalar_rgb to llvm_ad_mono_polarized" in str(warning.message) for warning in caught)
assert chosen.llvm_version and "LLVM" in (chosen.llvm_path or "libLLVM")
"""


@pytest.mark.parametrize("code", [IN_A_NEW_PROCESS, AFTER_DRJIT], ids=["first", "after Dr.Jit"])
def test_init_in_a_new_process(code):
    ended = run_python(code)
    assert ended.returncode == 0, ended.stderr


def test_cuda_with_a_driver_that_does_not_load(tmp_path, monkeypatch):
    driver = tmp_path / "libcuda.so.1"
    driver.write_text("not a library")
    monkeypatch.setenv(libraries.CUDA_VARIABLE, str(driver))
    assert re.search(r"CUDA cannot be used, .*libcuda\.so\.1 fails: .* or use the backend llvm", refusal("cuda"))
    assert backend.choose("auto").name == "llvm"


def test_cuda_without_a_device():
    if backend.find_cuda():
        pytest.skip("there is a GPU here")
    assert "CUDA cannot be used, no NVIDIA driver" in refusal("cuda")


@pytest.mark.gpu
def test_cuda_is_preferred_where_it_works():
    assert backend.choose("auto").name == "cuda"


def test_arguments_are_checked():
    with pytest.raises(InputError, match="backend: 'opencl' is none of"):
        backend.init("opencl")
    with pytest.raises(InputError, match="threads: must be at least 1, got 0"):
        backend.init(threads=0)


@pytest.fixture
def wrong_library(tmp_path: Path):
    """Path that the variable may name: a missing file, a file that is no library, and an LLVM that is too old."""
    (tmp_path / "text.so").write_text("no library")
    (tmp_path / "libLLVM-14.so.1").touch()
    return {"missing": tmp_path / "none.so", "no LLVM": tmp_path / "text.so", "old": tmp_path / "libLLVM-14.so.1"}


@pytest.mark.parametrize("kind", ["missing", "no LLVM", "old"])
@pytest.mark.parametrize("imported_before", ["", "import drjit; "])
def test_variable_of_an_unusable_library_is_named_with_its_path(wrong_library, kind, imported_before):
    path = str(wrong_library[kind])
    ended = run_python(
        f"{imported_before}import wrf_mi.backend as b; b.init('llvm')", **{libraries.LLVM_VARIABLE: path}
    )
    last = ended.stderr.strip().splitlines()[-1]
    assert re.search(
        rf"LibraryVariableError: {libraries.LLVM_VARIABLE} is set, but .*{re.escape(path)}.*: unset it", last
    )


@pytest.mark.parametrize(
    "words",
    [
        "train nowhere --model idw --out run",
        "compare run --out page",
        "correct nowhere --scene box --out fit",
        "check box",
    ],
)
def test_commands_end_with_one_line_on_a_wrong_variable(wrong_library, words, tmp_path):
    code = f"import sys; from wrf_mi.apps.commands.main import main; sys.exit(main({words.split()}))"
    ended = run_python(code, **{libraries.LLVM_VARIABLE: str(wrong_library["missing"]), "CUDA_VISIBLE_DEVICES": ""})
    assert (ended.returncode, len(ended.stderr.splitlines())) == (2, 1), ended.stderr
    assert ended.stderr.startswith(f"wrf-mi: {libraries.LLVM_VARIABLE} is set, but {wrong_library['missing']} is not a")
