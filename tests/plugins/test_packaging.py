"""The wheel, installed somewhere else, holds everything and runs from there."""

import os
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = {
    "wrf_mi": CHECKOUT / "wrf_mi",
    "wrf_mi_bench": CHECKOUT / "benchmarks" / "wrf_mi_bench",
    "wrf_mi_plugins": CHECKOUT / "plugins" / "wrf_mi_plugins",
    "wrf_mi_scenes": CHECKOUT / "scenes" / "wrf_mi_scenes",
}

SECONDS_PER_CHILD = 300
"""Building takes a second or two, an import of Mitsuba less than one; a busy machine needs much longer."""


def run(*command: str, cwd: Path, **environment: str) -> str:
    """Runs a command outside the checkout and returns what it printed; a failure shows what it said."""
    done = subprocess.run(
        command, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, timeout=SECONDS_PER_CHILD
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def run_installed(site: Path, code: str, cwd: Path) -> str:
    """Runs Python ``code`` in a new process in which the packages come from the folder ``site``."""
    return run(sys.executable, "-P", "-c", code, cwd=cwd, PYTHONPATH=str(site))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    # Without build isolation hatchling comes from this environment and no network is needed.
    flags = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--wheel-dir", str(folder)]
    run(sys.executable, "-m", "pip", "wheel", *flags, str(CHECKOUT), cwd=folder)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    flags = ["--no-deps", "--no-index", "--quiet", "--target", str(folder)]
    run(sys.executable, "-m", "pip", "install", *flags, str(wheel), cwd=folder)
    return folder


def files_of(package: Path) -> Iterator[str]:
    for file in package.rglob("*"):
        if file.is_file() and "__pycache__" not in file.parts:
            yield file.relative_to(package.parent).as_posix()


def test_wheel_holds_every_file_and_nothing_else(wheel):
    expected = {name for package in PACKAGES.values() for name in files_of(package)}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == expected
    assert any(name.startswith("wrf_mi_scenes/") and not name.endswith(".py") for name in packed)


def test_packages_come_from_the_wheel(site, tmp_path):
    printed = run_installed(
        site, f"import {', '.join(PACKAGES)}; print({'.__file__, '.join(PACKAGES)}.__file__)", tmp_path
    )
    assert [Path(name).parent for name in printed.split()] == [site / name for name in PACKAGES]


def test_command_and_version(site, tmp_path):
    code = """
from importlib.metadata import distribution
found = distribution("wrf-mi")
(command,) = [entry for entry in found.entry_points if entry.group == "console_scripts"]
print(found.version, command.name, command.load().__name__)
import wrf_mi
assert wrf_mi.__version__ == found.version
"""
    assert run_installed(site, code, tmp_path).split()[1:] == ["wrf-mi", "main"]


def test_installed_backend_computes(site, tmp_path):
    code = """
from wrf_mi.backend import init
init()
import drjit as dr, mitsuba as mi
assert dr.all(dr.minimum(dr.arange(mi.Float, 4), 2) == mi.Float([0, 1, 2, 2]))
"""
    run_installed(site, code, tmp_path)


def test_installed_package_trains_a_step(site, tmp_path):
    code = """
import json
from pathlib import Path
import numpy as np
from wrf_mi import Receiver, Record, Split, train
rng = np.random.default_rng(0)
receiver = Receiver("gateway1", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
spectra = rng.random((1, 6, 8, 16)).astype(np.float32)
record = Record("noise", "spectrum", rng.normal(size=(6, 3)), (receiver,), spectra)
split = Split("own", 0, np.arange(3), np.arange(3, 4), np.arange(4, 6))
run = train(record, "run", "wrf-gs+", settings=["steps=2", "initial.gaussians=5"], split=split)
assert run.metrics["steps"] == 2 and run.metrics["n_test"] == 2
assert [json.loads(line)["step"] for line in Path("run/log.jsonl").read_text().splitlines()] == [2]
assert run.predictor()(record.tx_pos_m[:1]).shape == (1, 8, 16)
"""
    run_installed(site, code, tmp_path)
    assert (tmp_path / "run" / "model.npz").is_file()
