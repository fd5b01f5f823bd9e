"""The wheel, unpacked somewhere else, holds everything and runs from there."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = {"wrf_mi": ".", "wrf_mi_bench": "benchmarks", "wrf_mi_plugins": "plugins", "wrf_mi_scenes": "scenes"}
"""Folders of the packages in the checkout."""
SECONDS_PER_CHILD = 300
"""Building takes a second or two, an import of Mitsuba less than one; a busy machine needs much longer."""
INSTALLED = """
import importlib, json
from importlib.metadata import distribution
from pathlib import Path

names = ["wrf_mi", "wrf_mi_bench", "wrf_mi_plugins", "wrf_mi_scenes"]
folders = [str(Path(importlib.import_module(name).__file__).parent) for name in names]
installed = distribution("wrf-mi")
(command,) = [entry for entry in installed.entry_points if entry.group == "console_scripts"]

import numpy as np
import wrf_mi
from wrf_mi import Receiver, Record, Split, train

rng = np.random.default_rng(0)
receiver = Receiver("gateway1", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
spectra = rng.random((1, 6, 8, 16)).astype(np.float32)
record = Record("noise", "spectrum", rng.normal(size=(6, 3)), (receiver,), spectra)
split = Split("own", 0, np.arange(3), np.arange(3, 4), np.arange(4, 6))
SMALL = ["steps=2", "initial.gaussians=5", "network.layers=2", "network.width=8"]
run = train(record, "wrf-gs+", out="run", settings=SMALL, split=split)
print(json.dumps({
    "folders": folders,
    "command": [command.name, command.load().__name__],
    "same version": wrf_mi.__version__ == installed.version,
    "steps": [run.metrics["steps"], run.metrics["n_test"]],
    "logged": [json.loads(line)["step"] for line in Path("run/log.jsonl").read_text().splitlines()],
    "shape": run.predictor()(record.tx_pos_m[:1]).shape,
}))
"""


def run(*command: str, cwd: Path, **environment: str) -> str:
    """Runs a command outside the checkout and returns what it printed; a failure shows what it said."""
    environment = os.environ | environment
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=SECONDS_PER_CHILD)
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    # Without build isolation hatchling comes from this environment and no network is needed.
    flags = ["--no-deps", "--no-build-isolation", "--no-index", "--quiet", "--wheel-dir", str(folder)]
    run(sys.executable, "-m", "pip", "wheel", *flags, str(CHECKOUT), cwd=folder)
    (built,) = folder.glob("*.whl")
    return zipfile.ZipFile(built)


def test_wheel_holds_every_file_and_nothing_else(wheel):
    files = [
        (CHECKOUT / parent, path) for name, parent in PACKAGES.items() for path in (CHECKOUT / parent / name).rglob("*")
    ]
    expected = {
        path.relative_to(parent).as_posix()
        for parent, path in files
        if path.is_file() and "__pycache__" not in path.parts
    }
    packed = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert packed == expected
    assert any(name.startswith("wrf_mi_scenes/") and not name.endswith(".py") for name in packed)


def test_installed_packages_are_found_state_their_command_and_train(wheel, tmp_path):
    """A wheel of Python alone is installed by unpacking it."""
    site = tmp_path / "site"
    wheel.extractall(site)
    printed = json.loads(run(sys.executable, "-P", "-c", INSTALLED, cwd=tmp_path, PYTHONPATH=str(site)))
    assert printed == {
        "folders": [str(site / name) for name in PACKAGES],
        "command": ["wrf-mi", "main"],
        "same version": True,
        "steps": [2, 2],
        "logged": [2],
        "shape": [1, 8, 16],
    }
    assert (tmp_path / "run" / "model.npz").is_file()
