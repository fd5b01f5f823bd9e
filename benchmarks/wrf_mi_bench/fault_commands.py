"""Commands on small data that are tried under faults: trainings, the correction of a scene, and the tables."""

import json
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core.array_files import stored_arrays
from wrf_mi.datasets.registry import DATA_VARIABLE
from wrf_mi.runs.folder import CONFIG, FITTED, METRICS, PREDICTIONS, SECONDS

from .bench import FLAT
from .table_plan import NAMED, Entry, Row, TablePart

FIELD = (
    *("initial.gaussians=8", "network.width=8", "network.layers=2", "steps=6", "checkpoint_every=2"),
    *("log_every=1", "validate_every=3", "density.every=0"),
)
SETTINGS: Mapping[str, tuple[str, ...]] = {
    "kriging": (),
    "vae": ("steps=4", "width=8", "last=8", "checkpoint_every=2"),
    "wrf-gs+": FIELD,
    "wrf-gs+ joint": (*FIELD, "traced.depth=1", "traced.reflections=1", "traced.rays=256"),
}
"""Settings of short trainings by model and, after a space, ``joint`` in a scene."""
TIMES = ("train_seconds", "trace_seconds", "ms_per_sample", "peak_memory_mb")  # metrics that differ from run to run
WHEN = (*TIMES, "date", "wall_seconds", "worker_threads")
"""Entries of a row of the tables that state when and how it was measured."""
SPECTRA, HOME, ROOM = "spectra", "home", "room"
"""Folders of the data: spectra, signal strengths as a known data set, and a closed room around both."""
STRENGTHS, SIDES_M = 24, (-1.0, 5.0)  # number of signal strengths, and extent of the room along each axis


class Command(ABC):
    """A command of ``wrf-mi`` by its name in reports, on the data of a folder, with its results below another."""

    file_bytes: Sequence[int] = (250, 400, 1500, 6000)  # limits of the size of files, in place of a full disk
    refused: Sequence[int] = (2,)  # exit statuses where results cannot be written
    locked: Sequence[str] = ()  # folders that one process at a time writes into

    def __init__(self, name: str, data: Path) -> None:
        self.name, self._data = name, data

    def prepare(self, children: bool) -> None:
        """Prepare this process, in which the command is called.

        Without ``children`` what the command starts as a child process is called in this one, so that its writes count,
        and it ends with it.
        """
        return

    @abstractmethod
    def call(self, place: Path) -> list[str] | None:
        """Arguments with which the command begins or goes on in a folder; None: nothing is left to do."""

    @abstractmethod
    def content(self, place: Path) -> dict[str, Any]:
        """Results in a folder, except dates and times."""


def differing(results: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Keys of results, from `Command.content`, that differ in a bit, or that one of them lacks."""

    def same(a: Any, b: Any) -> bool:
        if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
            return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
        return type(a) is type(b) and bool(a == b)

    return sorted(key for key in results.keys() | other.keys() if not same(results.get(key), other.get(key)))


class Training(Command):
    """``wrf-mi train`` of a model, which goes on with ``--resume``."""

    locked = ("run",)

    def call(self, place: Path) -> list[str]:
        out = place / "run"
        if (out / CONFIG).exists():
            return ["train", "--resume", str(out)]
        model, _, joint = self.name.partition(" ")
        call = ["train", str(self._data / SPECTRA), "--model", model, "--deterministic", "--out", str(out)]
        scene = ["--scene", str(self._data / ROOM)] if joint else []
        return [*call, *scene, *(part for setting in SETTINGS[self.name] for part in ("--set", setting))]

    def content(self, place: Path) -> dict[str, Any]:
        return _run_content(place / "run")


def _run_content(run: Path) -> dict[str, Any]:
    metrics = json.loads((run / METRICS).read_text())
    content: dict[str, Any] = {key: value for key, value in metrics.items() if key not in (*TIMES, "scene")}
    times = (SECONDS, *TIMES)
    content |= {f"{FITTED}/{key}": v for key, v in stored_arrays(run / FITTED).items() if key not in times}
    return content | {f"{PREDICTIONS}/{key}": values for key, values in stored_arrays(run / PREDICTIONS).items()}


def _file_content(folder: Path) -> dict[str, Any]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


class Correction(Command):
    """``wrf-mi correct``, which is called again unless the scene is there."""

    def prepare(self, children: bool) -> None:
        """Compute on one thread: sums of several depend on their order."""
        from wrf_mi.backend import init

        init("llvm", threads=1)

    def call(self, place: Path) -> list[str] | None:
        out, scene, data = (str(path) for path in (place / "scene", self._data / ROOM, self._data / HOME / FLAT))
        options = ["--depth", "1", "--rays", "256", "--calibrate", "gain"]
        return None if Path(out).exists() else ["correct", data, "--scene", scene, "--out", out, *options]

    def content(self, place: Path) -> dict[str, Any]:
        """All files of the scene folder, without the duration on its page."""
        from wrf_mi.correction.page import PAGE
        from wrf_mi.scene.correction_data import FILE

        content = _file_content(place / "scene")
        content[PAGE] = re.sub(rb"Duration: \d+ s", b"", content[PAGE])
        return content | {FILE: {key: v for key, v in json.loads(content[FILE]).items() if key != "seconds"}}


class Tables(Command):
    """``wrf-mi bench tables`` of a small plan, which is called again."""

    refused = (1, 2)  # 1: rows failed, the others and the page are written

    def prepare(self, children: bool) -> None:
        """Plan a row that is resumed and one that is not, whose scene is made."""
        from . import bench, table_pages, tables

        os.environ[DATA_VARIABLE] = str(self._data / HOME)
        rows = small_plan()
        for module in (tables, table_pages):
            setattr(module, "plan", lambda quick=False: rows)  # noqa: B010
        setattr(table_pages, "PARTS", (rows[0].part,))  # noqa: B010
        if not children:
            from wrf_mi.apps.commands.main import main
            from wrf_mi.backend import init

            init("llvm", threads=1)

            def run_module(module: str, call: Sequence[str]) -> tuple[int, str]:
                with redirect_stdout(StringIO()):
                    return main(call), ""

            setattr(bench, "run_module", run_module)  # noqa: B010

    def call(self, place: Path) -> list[str]:
        return ["bench", "tables", "--out", str(place / "results"), "--runs", str(place / "runs")]

    def content(self, place: Path) -> dict[str, Any]:
        content = _file_content(place / "results") | _file_content(place / "runs" / "tables" / "scenes")
        for name in [name for name in content if name.endswith("-seed0.json")]:
            content[name] = {key: value for key, value in json.loads(content[name]).items() if key not in WHEN}
        # Columns of training time, time of a sample, and memory.
        page = content["tables/README.md"]
        content["tables/README.md"] = re.sub(rb"\| \d+ s \| [\d.e+]+ ms \| \d+ MB ", b"", page)
        for path in (place / "runs" / "tables").glob(f"*/{METRICS}"):
            content |= {f"{path.parent.name}/{key}": value for key, value in _run_content(path.parent).items()}
        return content


def small_plan() -> list[Row]:
    """Rows of the tables that take seconds: a field, which is resumed, and a trace in a scene that is made for it."""
    words = [word for setting in FIELD for word in ("--set", setting)]
    entries = {
        "wrf-gs+": Entry("WRF-GS+", "wrf-gs+", options=("--deterministic", *words)),
        "ray-tracing": Entry("ray tracing", "ray-tracing", NAMED, ("--depth", "1")),
    }
    part = TablePart("rssi", "rssi", FLAT, "official", entries, scene="open")
    return [Row(part, name, 1.0, 0) for name in entries]


COMMANDS: Mapping[str, Callable[[Path], Command]] = {
    **{name: partial(Training, name) for name in SETTINGS},
    "correct": partial(Correction, "correct"),
    "tables": partial(Tables, "tables"),
}
"""Commands by name, each of a folder of `prepare_data`."""


def prepare_data(folder: Path) -> None:
    """Make the data of all commands in a folder, where they are missing."""
    from .hostile_samples import prepare_spectra, prepare_strengths

    if (folder / ROOM).exists():
        return
    prepare_spectra(folder / SPECTRA)
    prepare_strengths(folder / HOME / FLAT, STRENGTHS)
    ends = [(axis, end) for axis in range(3) for end in range(2)]
    sides = {f"side{k}{end}": ("itu_concrete", sheet(k, SIDES_M[end], SIDES_M, SIDES_M)) for k, end in ends}
    write_scene(folder / ROOM, sides, "A closed room")
