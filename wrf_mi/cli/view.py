"""``wrf-mi view``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from .options import Arguments, add_command
from .output import Watch, print_json


def add_parser(commands: Any) -> None:
    """Add ``view`` to the commands."""
    text = "write an interactive 3D view of a run, a scene and maps: one HTML file that needs no network"
    parser = add_command(commands, "view", view_command, text)
    add = parser.add_argument
    text = "run folder; scene: name, folder, Mitsuba XML or mesh; map: NetCDF file or Zarr folder. Several are combined"
    add("sources", nargs="+", metavar="RUN|SCENE|MAP", help=text)
    add("--out", required=True, metavar="VIEW.html", help="file to write")
    text = "held-out rows whose observations, Gaussians' signals and paths are stored (default: 40)"
    add("--transmitters", type=int, metavar="N", help=text)
    add("--gaussians", type=int, metavar="N", help="Gaussians, the strongest (default: 1000)")
    add(
        "--paths",
        type=int,
        metavar="N",
        help="paths of each transmitter to each receiver, the strongest (default: 200)",
    )
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete (default: none)")


def view_command(a: Arguments) -> int:
    """Write a view."""
    from ..core import InputError
    from ..viewer.view import view

    out = Path(a.out)
    if out.is_dir():
        raise InputError(f"{out}: a folder; give the name of a file, such as {out / 'view.html'}")
    limits = {name: getattr(a, name) for name in ("transmitters", "gaussians", "paths")}
    limits = {name: value for name, value in limits.items() if value is not None}
    with Watch() as watch:
        found = view(
            *a.sources, **limits, material=a.material, on_stage=watch.on_progress, progress=sys.stderr.isatty()
        )
    size = found.write(out).stat().st_size
    if a.json:
        print_json({"out": a.out, "bytes": size, **found.counts, "notes": found.content.notes})
        return 0
    names = {name: name.replace("_", " ").replace("gaussians", "Gaussians") for name in found.counts}
    print(", ".join(f"{count} {names[name][: -1 if count == 1 else None]}" for name, count in found.counts.items()))
    for note in found.content.notes:
        print(note)
    print(f"view: {out} ({size / 1e6:.1f} MB)")
    return 0
