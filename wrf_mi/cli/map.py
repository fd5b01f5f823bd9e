"""``wrf-mi map``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from .options import Arguments, add_command
from .output import Watch, print_json


def add_parser(commands: Any) -> None:
    """Add ``map`` to the commands."""
    text = "map power, coverage and best receiver over a plane or a mesh"
    parser = add_command(commands, "map", map_command, text)
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder")
    add("--out", required=True, metavar="FILE", help="file to write: MAP.nc, MAP.zarr or MAP.csv; beside it MAP.png")
    text = "z of the transmitter, metres (default: the median of the data's); the grid covers the scene, or the data"
    add("--height", type=float, metavar="M", help=text)
    text = "mesh whose faces' centres are the positions, in place of the grid (PLY, STL, OBJ, GLB; metres)"
    add("--surface", metavar="MESH", help=text)
    text = "spacing of the grid, metres (default: 0.1), or longest edge of the mesh's faces, which are halved"
    add("--step", type=float, metavar="M", help=text)
    text = "name of a receiver, repeatable (default: all)"
    add("--receiver", action="append", metavar="NAME", help=text)
    text = "received power above which a position is covered, dBm (default: -90; in dB for spectra, where none is set)"
    add("--threshold", type=float, metavar="DBM", help=text)
    text = "transmit power, dBm: what path gain and received power differ by (default: 0)"
    add("--transmit-power", type=float, default=0.0, metavar="DBM", help=text)
    text = "yaw of the transmitter, degrees, for models that know it (default: mean over 8 headings)"
    add("--heading", type=float, metavar="DEG", help=text)
    add("--frequency", type=float, metavar="HZ", help="carrier, where the data have several")


def map_command(a: Arguments) -> int:
    """Write a radio map and its picture."""
    from ..core.files import write_figure
    from ..maps.api import radio_map
    from ..maps.dataset import check_map_file, write_map
    from ..maps.picture import map_figure
    from ..runs.run import open_run

    out = Path(a.out)
    check_map_file(out)
    run = open_run(a.run)
    with Watch() as watch:
        dataset = radio_map(
            run,
            height_m=a.height,
            step_m=a.step,
            surface=a.surface,
            receivers=a.receiver,
            threshold_dbm=a.threshold,
            transmit_dbm=a.transmit_power,
            heading_deg=a.heading,
            frequency_hz=a.frequency,
            on_progress=watch.on_progress,
        )
    write_map(dataset, out)
    picture = write_figure(out.with_suffix(".png"), map_figure(dataset, run))
    if "power_std_db" not in dataset:
        print("no coverage: the model states no standard deviation; train with --intervals", file=sys.stderr)
    sizes = {str(name): int(dataset.sizes[name]) for name in ("receiver", "y", "x", "point") if name in dataset.sizes}
    if a.json:
        names = [str(name) for name in dataset.data_vars]
        print_json({"out": str(out), "picture": str(picture), "sizes": sizes, "variables": names})
        return 0
    shape = " x ".join(str(count) for name, count in sizes.items() if name != "receiver")
    print(f"{shape} positions, {sizes['receiver']} receivers: {out}\npicture: {picture}")
    return 0
