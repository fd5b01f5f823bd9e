"""``wrf-mi demo``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...core import InputError
from .options import Arguments, add_command
from .output import Watch, show, show_metrics

if TYPE_CHECKING:
    from ...runs.api import Run
    from ...training.session import OnProgress

REAL = "flat-ble"
REAL_PLAN = "layout.csv"
REAL_HEIGHT_M = 2.7  # usual height of a room; the plan does not state it
SPLIT, ROWS = "blocked:0", 40
"""A region without measurements, which interpolation cannot know, and the number of measurements elsewhere."""
REAL_ROWS = 64  # measurements of the real flat
MODELS = {"hybrid": True, "ray-tracing": True, "kriging": False}
"""Models that are compared, and whether each is given the scene; the first takes a minute, the others seconds."""
IN_A_FLAT = ("depth=6", "reflections=2")  # transmission through walls of two surfaces each


def add_parser(commands: Any) -> None:
    """Add ``demo`` to the commands."""
    text = "a scanned room and 40 measurements: the hybrid, ray tracing and interpolation in a region without any"
    parser = add_command(commands, "demo", demo_command, text)
    parser.add_argument("--out", metavar="DIR", help="folder of the runs (default: a new one in runs/)")


def demo_command(a: Arguments) -> int:
    """Run the demonstration."""
    folder = Path(a.out) if a.out else Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    with Watch(resumable=True) as watch:
        shown = Demo(folder, watch.on_progress, watch.stop, a.json)
        runs = shown.laboratory()
        real = shown.measured_flat()
        pages = shown.pages([*runs, *real])
    if a.json:
        return show(True, {run.folder.name: run.metrics for run in [*runs, *real]} | pages, "")
    for of_data in (runs, real):
        if of_data:
            show_metrics(of_data[0].metrics, None, False)
            print(summary(of_data))
    print("\n".join(f"{what}: {file}" for what, file in pages.items()))
    return 0


def summary(runs: list[Run]) -> str:
    """One line: the median scores of the models of one data set on its test rows."""
    from ...tasks import TASKS

    task = TASKS[runs[0].metrics["task"]]
    scores = {run.metrics["model"]: run.metrics[task.block]["median"] for run in runs}
    scores |= {key.upper(): block["median"] for key, block in runs[0].metrics["reference"].items() if block}
    listed = ", ".join(f"{name} {score:.{task.digits + 1}f}" for name, score in scores.items())
    return f"median {task.label} on the test rows: {listed}"


def find_data(name: str) -> Path | None:
    """Folder of a real data set on this machine or fetched; else None, with a line on standard error."""
    from ...datasets import fetch
    from ...datasets.registry import locate

    try:
        return locate(name) or fetch(name)
    except InputError as error:
        print(f"no {name} ({error})", file=sys.stderr)
        return None


@dataclass(frozen=True)
class Demo:
    """The demonstration: runs below a folder, and pages that compare them."""

    folder: Path
    on_progress: OnProgress
    stop: Callable[[], bool]
    quiet: bool = False  # standard output is for JSON

    def laboratory(self) -> list[Run]:
        """Spectra of the embedded room: a scene from its scan, and fits to a few of them.

        Test rows lie in a region without a training row. The ray tracer and the hybrid are given the mesh that is made
        from a LiDAR scan of the room; the spectra were traced in the true one.
        """
        from ...scene.make import make_scene
        from ...synthetic import load_record
        from ...synthetic.laboratory import NAME
        from ...synthetic.stored import SCAN

        self._say(f"a scan of the room {NAME} becomes a scene: {self.folder / 'scene'}")
        scene = make_scene(Path(load_record(NAME).source) / SCAN, self.folder / "scene")
        self._say(f"{ROWS} measured spectra, and a region without any: split {SPLIT}")
        return self._fitted(NAME, scene.folder, "", split=SPLIT, n_train=ROWS)

    def measured_flat(self) -> list[Run]:
        """Signal strengths that were measured in a flat, in the walls of its plan, where the data can be had."""
        from ...scene.make import make_scene

        data = find_data(REAL)
        if data is None:
            return []
        self._say(f"measured signal strengths: {REAL_ROWS} rows of {REAL}, in the walls of its plan")
        scene = make_scene(data / REAL_PLAN, self.folder / "flat", height_m=REAL_HEIGHT_M)
        return self._fitted(str(data), scene.folder, f"{REAL}-", IN_A_FLAT, n_train=REAL_ROWS)

    def _fitted(
        self, dataset: str, scene: Path, prefix: str, tracing: tuple[str, ...] = (), **options: Any
    ) -> list[Run]:
        from ...runs.api import train

        runs = []
        for model, in_scene in MODELS.items():
            how: dict[str, Any] = {"settings": tracing if model == "ray-tracing" else (), **options}
            how |= {"preset": "fast"} if model == "hybrid" else {}
            how |= {"scene": scene if in_scene else None, "on_progress": self.on_progress, "stop": self.stop}
            runs.append(train(dataset, model, out=self.folder / f"{prefix}{model}", **how))
            self._say(summary(runs[-1:]))
        return runs

    def pages(self, runs: list[Run]) -> dict[str, str]:
        """A comparison of all runs, and a view of the first in its room; file by title."""
        from ...runs.compare import compare
        from ..viewer.view import view

        page = compare([run.folder for run in runs], self.folder / "compare")
        view(runs[0]).write(self.folder / "view.html")
        return {"comparison, with pictures": str(page), "the room in 3D": str(self.folder / "view.html")}

    def _say(self, text: str) -> None:
        print(text, file=sys.stderr)
