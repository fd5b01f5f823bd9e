"""``wrf-mi demo``."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..core import InputError
from .options import Arguments, add_command
from .output import Watch, show_metrics

if TYPE_CHECKING:
    from ..runs.api import Run
    from ..training.session import OnProgress

REAL = "rfid-lab"
FLAT = "flat-ble"
FLAT_PLAN = "layout.csv"
FLAT_HEIGHT_M = 2.7  # usual height of a room; the plan does not state it


def add_parser(commands: Any) -> None:
    """Add ``demo`` to the commands."""
    text = "train, trace, score and draw measured spectra, or those of a traced room where no data are available"
    parser = add_command(commands, "demo", demo_command, text)
    parser.add_argument("--out", metavar="RUN", help="run folder (default: a new one in runs/)")


def demo_command(a: Arguments) -> int:
    """Run the demonstration."""
    with Watch(resumable=True) as watch:
        run, index = demo(Path(a.out) if a.out else None, watch.on_progress, watch.stop)
    show_metrics(run.metrics, run.folder, a.json)
    print(f"pictures: {index}", file=sys.stderr if a.json else sys.stdout)
    return 0


def find_data(name: str) -> Path | None:
    """Folder of a real data set on this machine or fetched; else None, with a line on standard error."""
    from ..datasets import fetch
    from ..datasets.registry import locate

    try:
        return locate(name) or fetch(name)
    except InputError as error:
        print(f"no {name} ({error})", file=sys.stderr)
        return None


def demo(out: Path | None, on_progress: OnProgress, stop: Callable[[], bool]) -> tuple[Run, Path]:
    """Train on measured spectra, trace measured signal strengths, and draw both.

    Without measured spectra, those of the embedded room are used, traced in its true mesh; the ray tracer then gets
    the mesh made from a LiDAR scan of the room. The run of the field is in ``out`` (None: a new folder in ``runs/``)
    with the traced one in its subfolder ``traced``; ``index.html`` has all pictures.
    """
    from ..runs.api import train
    from ..runs.compare import compare
    from ..scene.make import make_scene
    from ..synthetic import load_record
    from ..synthetic.laboratory import NAME
    from ..synthetic.stored import SCAN
    from ..training.config import PRESETS

    folder = out or Path("runs") / time.strftime("demo-%Y%m%d-%H%M%S")
    real = find_data(REAL) is not None
    if not real:
        print(f"using the embedded room {NAME}, traced by Sionna RT, instead", file=sys.stderr)
    dataset = REAL if real else NAME
    print(f"training wrf-gs+ on {dataset}; results go to {folder}", file=sys.stderr)
    run = train(dataset, folder, "wrf-gs+", settings=PRESETS["quick"], on_progress=on_progress, stop=stop)
    settings: tuple[str, ...] = ()
    if not real:
        print(f"tracing {NAME} in the mesh of its scan", file=sys.stderr)
        scene = make_scene(Path(load_record(NAME).source) / SCAN, folder / "scene")
    elif (data := find_data(FLAT)) is not None:
        print(f"tracing {FLAT} in the walls of its plan", file=sys.stderr)
        scene = make_scene(data / FLAT_PLAN, folder / "scene", height_m=FLAT_HEIGHT_M)
        dataset, settings = FLAT, ("transmission=true", "depth=6", "reflections=2")
    else:
        return run, compare([folder], folder / "compare")
    options: dict[str, Any] = {"scene": scene.folder, "settings": settings, "progress": sys.stderr.isatty()}
    train(dataset, folder / "traced", "ray-tracing", **options)
    return run, compare([folder, folder / "traced"], folder / "compare")
