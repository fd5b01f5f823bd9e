"""Test of wheel and source distribution: built, and each used in an empty environment outside the checkout.

In each environment: all names of the package, ``py.typed``, ``wrf-mi doctor``, kriging and a field of Gaussians trained
for moments through the command, and a prediction. The network is used for the dependencies alone.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
import venv
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]

USE = """
from importlib.resources import files
from pathlib import Path
import sys

import numpy as np
import wrf_mi
from wrf_mi.datasets import write_ble_folder

place = Path(wrf_mi.__file__)
assert place.is_relative_to(sys.prefix), place
assert (files("wrf_mi") / "py.typed").is_file()
for name in wrf_mi.__all__:
    getattr(wrf_mi, name)
import wrf_mi_bench, wrf_mi_plugins, wrf_mi_scenes

rng = np.random.default_rng(0)
positions_m = rng.uniform(1, 5, (40, 3))
rssi_dbm = -40 - 20 * np.log10(np.linalg.norm(positions_m, axis=1))[None]
receiver = wrf_mi.Receiver("anchor1", np.zeros(3), np.array([0.0, 0, 0, 1]))
known = {"frequencies_hz": np.array([2.44e9]), "official": (np.arange(30), np.arange(30, 40))}
record = wrf_mi.Record("made-up", "rssi", positions_m, (receiver,), rssi_dbm.astype(np.float32), **known)
write_ble_folder("data", record)
np.savetxt("positions.csv", positions_m[:3], delimiter=",", header="x,y,z", comments="")
"""
COMMANDS = (
    "wrf-mi --version",
    "wrf-mi doctor",
    "wrf-mi train data --model kriging --out kriging",
    "wrf-mi train data --model wrf-gs+ --set steps=5 --set initial.gaussians=10 --out field",
    "wrf-mi predict field --tx positions.csv --out powers.csv",
    "wrf-mi compare kriging field --out compare",
)


class Steps:
    """Numbered steps with the time so far and, from the second on, the time left at the same pace."""

    def __init__(self, count: int) -> None:
        self.count, self.done, self.begin = count, 0, time.monotonic()

    def next(self, what: str) -> None:
        """State the next step."""
        passed = time.monotonic() - self.begin
        left = f", about {passed / self.done * (self.count - self.done):.0f} s left" if self.done else ""
        self.done += 1
        print(f"package-test: {self.done} of {self.count}, {what} ({passed:.0f} s so far{left})", file=sys.stderr)


def run(*command: str | Path, folder: Path) -> None:
    """Run a program in a folder without the caller's variables about Python; print its output on failure."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(
            f"package-test: {' '.join(map(str, command))} ended with {done.returncode}\n{done.stdout}{done.stderr}"
        )


def main() -> None:
    """Build and test both packages."""
    steps = Steps(7)
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        steps.next("source distribution, and a wheel from it")
        run(sys.executable, "-m", "build", "--outdir", folder / "dist", CHECKOUT, folder=folder)
        for kind, pattern in (("wheel", "*.whl"), ("source distribution", "*.tar.gz")):
            (package,) = (folder / "dist").glob(pattern)
            place = folder / pattern[2:]
            place.mkdir()
            steps.next(f"environment for the {kind}")
            venv.create(place / "venv", with_pip=True)
            binaries = place / "venv" / ("Scripts" if os.name == "nt" else "bin")
            steps.next(f"installing the {kind} and its dependencies")
            run(binaries / "python", "-m", "pip", "install", "-q", package, folder=place)
            steps.next(f"using the {kind}")
            run(binaries / "python", "-c", USE, folder=place)
            for line in COMMANDS:
                program, *arguments = line.split()
                run(binaries / program, *arguments, folder=place)
            assert (place / "powers.csv").read_text().startswith("x,y,z,anchor1_dbm")
            print(f"package-test: {package.name} works", file=sys.stderr)


if __name__ == "__main__":
    main()
