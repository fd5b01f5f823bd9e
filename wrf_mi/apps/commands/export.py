"""``wrf-mi export`` and ``wrf-mi import``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ...core import InputError
from .options import Arguments, add_command, add_replace
from .output import show

POSITION = "X,Y,Z[,VX,VY,VZ]"


def add_parser(commands: Any) -> None:
    """Add ``export`` and ``import`` to the commands."""
    from ..exports import FORMATS

    text = "write a run, a scene or a data set in a format of other programs"
    parser = add_command(commands, "export", export_command, text)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    width = max(map(len, FORMATS)) + 2
    lines = [f"  {name:<{width}}{' or '.join(form.kinds).upper():<14}{form.text}" for name, form in FORMATS.items()]
    parser.epilog = "\n".join(["formats, and what they are made of (docs/export.md):", *lines])
    add = parser.add_argument
    add("source", metavar="SOURCE", help="run folder; scene (name, folder, XML, mesh); or data set (name or folder)")
    add("--format", required=True, choices=list(FORMATS), metavar="FORMAT", help=f"one of {', '.join(FORMATS)}")
    add("--out", required=True, metavar="PATH", help="file to write, or folder to make")
    where = (
        f"{POSITION} in m and m/s, or a CSV file with columns x,y,z and perhaps vx,vy,vz, or times t in s; repeatable"
    )
    add("--tx", action="append", metavar=POSITION, help=f"transmitter (3dgs: one; paths of a scene): {where}")
    add("--rx", action="append", metavar=POSITION, help=f"receiver of paths of a scene: {where}")
    add("--frequency", type=float, metavar="HZ", help="carrier of a scene's paths or materials (runs know theirs)")
    add("--bandwidth", type=float, metavar="HZ", help="bandwidth of delay-Doppler spectra (default: 100e6)")
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete")
    add("--paths", metavar="LIST", help="kinds of path of a scene, as for trace")
    add("--depth", type=int, metavar="N", help="largest number of interactions of a scene's paths (default: 3)")
    add("--replace", action="store_true", help="replace an existing folder")

    text = "make a run folder of a file of export --format field"
    parser = add_command(commands, "import", import_command, text, json_output=False)
    parser.add_argument("file", metavar="FILE.npz", help="file of export --format field")
    parser.add_argument("--out", required=True, metavar="RUN", help="run folder to make")
    add_replace(parser)


def export_command(a: Arguments) -> int:
    """Export a source."""
    from ..exports import ExportOptions, export

    if a.frequency is not None and not a.frequency > 0:
        raise InputError(f"--frequency {a.frequency:g}: give a positive number of Hz")
    (tx_pos_m, tx_mps), (rx_pos_m, rx_mps) = _ends(a.tx, "--tx"), _ends(a.rx, "--rx")
    stated = (a.frequency, a.material, a.paths, a.depth, a.replace, tx_mps, rx_mps, a.bandwidth, sys.stderr.isatty())
    facts = export(a.source, a.format, a.out, ExportOptions(tx_pos_m, rx_pos_m, *stated))
    text = f"{', '.join(f'{name} {value}' for name, value in facts.items())}: {a.out}"
    return show(a.json, {"out": a.out, "format": a.format, **facts}, text)


def import_command(a: Arguments) -> int:
    """Make a run folder of an exported field."""
    from ..exports.fields import import_field

    run = import_field(a.file, a.out, a.replace)
    print(f"{run.config.model} on {run.config.dataset}: {run.folder}")
    return 0


def _ends(texts: list[str] | None, option: str) -> Any:
    """Positions [n, 3], m, and velocities [n, 3], m/s, of ``X,Y,Z[,VX,VY,VZ]`` or CSV files; None where unstated."""
    import numpy as np

    from ...runs.prediction_file import read_track

    if texts is None:
        return None, None
    ends = []
    for text in texts:
        if Path(text).suffix.lower() == ".csv":
            ends.append(read_track(text))
            continue
        try:
            values = np.array([float(part) for part in text.split(",")])
        except ValueError:
            values = np.zeros(0)
        if len(values) not in (3, 6) or not np.isfinite(values).all():
            raise InputError(f"{option} {text}: give three numbers X,Y,Z in metres, six with a velocity, or a CSV file")
        ends.append((values[None, :3], values[None, 3:] if len(values) == 6 else None))
    velocities = [np.zeros_like(position) if velocity is None else velocity for position, velocity in ends]
    moves = any(velocity is not None for _, velocity in ends)
    return np.concatenate([position for position, _ in ends]), np.concatenate(velocities) if moves else None
