"""Test of wheel and source distribution: built, and each used in an empty environment outside the checkout.

In each environment: all names of the package, ``py.typed``, ``wrf-mi doctor``, kriging and a field of Gaussians trained
for moments through the command, and a prediction. Each extra is then installed alone beside the wheel's dependencies
and used; without it, its commands end in one line that names it. The network is used for the dependencies alone.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
import tomllib
import venv
from dataclasses import dataclass
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
faces = [np.insert(rng.random((8000, 2)), axis, side, axis=1) for axis in range(3) for side in (0, 1)]
np.savetxt("scan.xyz", np.concatenate(faces) * [5, 4, 2.7], fmt="%.4f")
# Refused without an extra before they are read.
for name in ("capture.hdf5", "scan.laz", "room.usda", "a.dxf", "a.osm", "a.ifc"):
    Path(name).touch()
"""
COMMANDS = (
    "wrf-mi --version",
    "wrf-mi doctor",
    "wrf-mi train data --model kriging --out kriging",
    "wrf-mi train data --model wrf-gs+ --set steps=5 --set initial.gaussians=10 --out field",
    "wrf-mi predict field --tx positions.csv --out powers.csv",
    "wrf-mi compare kriging field --out compare",
)

SCAN = """
import laspy
import numpy as np

cloud = laspy.LasData(laspy.LasHeader(point_format=3, version="1.4"))
cloud.header.scales = np.full(3, 1e-3)
cloud.x, cloud.y, cloud.z = np.loadtxt("scan.xyz").T
cloud.write("scan.laz")
"""
ROOM = """
from pathlib import Path

import trimesh

room = trimesh.creation.box((5, 4, 2.7))
points = ", ".join(str(tuple(vertex)) for vertex in room.vertices.tolist())
corners = room.faces.ravel().tolist()
mesh = f"point3f[] points = [{points}]\\nint[] faceVertexIndices = {corners}\\nint[] faceVertexCounts = {[3] * 12}"
stated = '(\\n    metersPerUnit = 1\\n    upAxis = "Z"\\n)'
Path("room.usda").write_text(f'#usda 1.0\\n{stated}\\ndef Mesh "Room"\\n{{\\n{mesh}\\n}}\\n')
"""
DRAWING = """
import ezdxf

document = ezdxf.new()
document.header["$INSUNITS"] = 6
corners = [(0, 0), (5, 0), (5, 4), (0, 4)]
document.modelspace().add_lwpolyline(corners, close=True, dxfattribs={"layer": "A-WALL"})
document.saveas("a.dxf")
nodes = "".join(f'<node id="{i}" lon="{x / 1e5}" lat="{y / 1e5}"/>' for i, (x, y) in enumerate(corners, 1))
way = "".join(f'<nd ref="{i}"/>' for i in (1, 2, 3, 4, 1))
Path("a.osm").write_text(f'<osm>{nodes}<way id="1">{way}<tag k="building" v="yes"/></way></osm>')
"""
MODEL = """
import ifcopenshell.api.context
import ifcopenshell.api.geometry
import ifcopenshell.api.project
import ifcopenshell.api.root
import ifcopenshell.api.unit

file = ifcopenshell.api.project.create_file()
ifcopenshell.api.root.create_entity(file, "IfcProject")
ifcopenshell.api.unit.assign_unit(file)
model = ifcopenshell.api.context.add_context(file, "Model")
body = ifcopenshell.api.context.add_context(file, "Model", "Body", "MODEL_VIEW", model)
wall = ifcopenshell.api.root.create_entity(file, "IfcWall")
ifcopenshell.api.geometry.edit_object_placement(file, wall)
shape = ifcopenshell.api.geometry.add_wall_representation(file, body, length=5, height=3, thickness=0.2)
ifcopenshell.api.geometry.assign_representation(file, wall, shape)
file.write("a.ifc")
"""
CAPTURE = """
import h5py
import numpy as np

samples = np.random.default_rng(0).integers(-9, 9, (4, 2, 3 * 224, 2)).astype(np.int16)
with h5py.File("capture.hdf5", "w") as file:
    file["Pilot_Samples"] = samples
    file.attrs.update(num_mob_ant=3, samples_per_user=224)
"""
TABLES = """
import numpy as np
import pandas

rng = np.random.default_rng(0)
places = {"latitude": 52 + rng.random(40) / 1e4, "longitude": 13 + rng.random(40) / 1e4}
table = pandas.DataFrame(places | {f"AP{k} dBm": rng.integers(-80, -40, 40) for k in range(3)})
table.to_csv("table.csv", index=False)
table.to_parquet("table.parquet")
table.to_excel("table.xlsx", index=False)
"""
SCENARIO = """
import deepmimo
import numpy as np
import wrf_mi
from wrf_mi.datasets import write_ble_folder

receiver = wrf_mi.Receiver("anchor1", np.array([1.0, 1.0, 1.5]), np.array([0.0, 0, 0, 1]))
positions_m = np.random.default_rng(0).uniform([2, 1, 1], [4, 3, 2], (9, 3))
known = {"frequencies_hz": np.array([2.44e9]), "official": (np.arange(6), np.arange(6, 9))}
write_ble_folder("inside", wrf_mi.Record("inside", "rssi", positions_m, (receiver,), np.full((1, 9), -50.0), **known))
wrf_mi.train("inside", "ray-tracing", "xyz", out="traced", settings=["depth=1", "rays=1024"])
wrf_mi.tracing.write_deepmimo("scenario", wrf_mi.tracing.load_trace("traced/paths.npz"))
deepmimo.config.set("scenarios_folder", str(Path.cwd()))
assert len(deepmimo.load("scenario").compute_channels())
"""


@dataclass(frozen=True)
class Extra:
    """An extra, and how it is used.

    Attributes:
        name: name of the extra.
        commands: arguments of ``wrf-mi`` that need it, and are refused without it.
        script: Python code that is run before them where the extra is installed.
        programs: other programs' modules and arguments, where it is installed.
    """

    name: str
    commands: tuple[str, ...] = ()
    script: str = ""
    programs: tuple[str, ...] = ()


EXTRAS = (
    Extra("maps", tuple(f"map kriging --step 1 --out map.{suffix}" for suffix in ("nc", "zarr"))),
    Extra("view", ("view kriging --out run.html", "view map.nc --out nc.html", "view map.zarr --out zarr.html")),
    Extra("cluster", ("predict field --tx positions.csv --out spread.csv --scheduler local:1",)),
    Extra("argos", ("data info capture.hdf5",), CAPTURE),
    Extra("lidar", tuple(f"mesh scan.{suffix} --out {suffix} --replace" for suffix in ("xyz", "laz")), SCAN),
    Extra("tables", tuple(f"data import table.{end} --out {end}" for end in ("csv", "parquet", "xlsx")), TABLES),
    Extra("meshes", ("mesh room.usda --out usda --replace",), ROOM),
    Extra("cad", tuple(f"mesh {name} --wall-height 3 --out cad --replace" for name in ("a.dxf", "a.osm")), DRAWING),
    Extra("bim", ("mesh a.ifc --out bim --replace",), MODEL),
    Extra("deepmimo", script=SCENARIO),
    Extra("docs", programs=(f"sphinx -q -b html -D execute_notebooks=0 {CHECKOUT / 'docs'} site",)),
    Extra("tests", programs=(f"pytest -q -p no:cacheprovider {CHECKOUT / 'tests' / 'core' / 'test_antenna.py'}",)),
)
"""All extras but dev, whose environment runs this program, in the order in which the files that they need are made."""


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


def run(*command: str | Path, folder: Path, refusal: str = "") -> None:
    """Run a program in a folder without the caller's variables about Python; print its output if it fails.

    ``refusal`` is the end of the line with which it has to refuse what it is asked, instead of succeeding.
    """
    variables = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    refused = done.returncode == 2 and done.stderr.count("\n") == 1 and done.stderr.rstrip().endswith(refusal)
    if not refused if refusal else done.returncode:
        text = f"{' '.join(map(str, command))} ended with {done.returncode}"
        sys.exit(f"package-test: {text}{f', not with {refusal}' if refusal else ''}\n{done.stdout}{done.stderr}")


def environment(place: Path, package: str, beside: Path | None = None) -> Path:
    """An environment with a package installed in it; the Python of it.

    ``beside`` is an environment whose packages it sees, so that they are not installed again.
    """
    venv.create(place / "venv", with_pip=True)
    python = place / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    if beside is not None:
        packages, its_own = (
            Path(sysconfig.get_path("purelib", "venv", {"base": str(each.parents[1])})) for each in (beside, python)
        )
        (its_own / "beside.pth").write_text(f"{packages}\n")
    run(python, "-m", "pip", "install", "-q", package, folder=place)
    return python


def use_extra(extra: Extra, package: Path, beside: Path, folder: Path) -> None:
    """Check that the commands of an extra are refused without it, then use it where it is installed alone."""
    for line in extra.commands:
        run(beside, "-m", "wrf_mi.apps.commands", *shlex.split(line), folder=folder, refusal=f"'.[{extra.name}]'")
    place = folder / f"extra-{extra.name}"
    place.mkdir()
    python = environment(place, f"wrf-mi[{extra.name}] @ {package.as_uri()}", beside)
    run(python, "-c", f"from pathlib import Path\n{extra.script}", folder=folder)
    for line in extra.commands:
        run(python, "-m", "wrf_mi.apps.commands", *shlex.split(line), folder=folder)
    for line in extra.programs:
        run(python, "-m", *shlex.split(line), folder=folder)
    shutil.rmtree(place)  # some take a gigabyte


def main() -> None:
    """Build and test both packages, and use every extra."""
    stated = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra.name for extra in EXTRAS} == set(stated) - {"dev"}, "an extra is not used here"
    steps = Steps(5 + len(EXTRAS))
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        steps.next("source distribution, and a wheel from it")
        run(sys.executable, "-m", "build", "--outdir", folder / "dist", CHECKOUT, folder=folder)
        for kind, pattern in (("source distribution", "*.tar.gz"), ("wheel", "*.whl")):
            (package,) = (folder / "dist").glob(pattern)
            place = folder / pattern[2:]
            place.mkdir()
            steps.next(f"environment of the {kind} and its dependencies")
            python = environment(place, str(package))
            steps.next(f"using the {kind}")
            run(python, "-c", USE, folder=place)
            for line in COMMANDS:
                program, *arguments = line.split()
                run(python.parent / program, *arguments, folder=place)
            assert (place / "powers.csv").read_text().startswith("x,y,z,anchor1_dbm")
            print(f"package-test: {package.name} works", file=sys.stderr)
            if kind != "wheel":
                shutil.rmtree(place)
        for extra in EXTRAS:
            steps.next(f"using the extra {extra.name}")
            use_extra(extra, package, python, place)


if __name__ == "__main__":
    main()
