"""``wrf-mi export`` and ``wrf-mi import``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from ...core import InputError
from .options import Arguments, add_command, add_replace
from .output import show

POSITION = "X,Y,Z"


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
    where = f"{POSITION} in metres, or a CSV file with such columns; repeatable"
    add("--tx", action="append", metavar=POSITION, help=f"transmitter (3dgs: one; paths of a scene): {where}")
    add("--rx", action="append", metavar=POSITION, help=f"receiver of paths of a scene: {where}")
    add("--frequency", type=float, metavar="HZ", help="carrier of a scene's paths or materials (runs know theirs)")
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
    ends = _positions(a.tx, "--tx"), _positions(a.rx, "--rx")
    options = (a.frequency, a.material, a.paths, a.depth, a.replace, sys.stderr.isatty())
    facts = export(a.source, a.format, a.out, ExportOptions(*ends, *options))
    text = f"{', '.join(f'{name} {value}' for name, value in facts.items())}: {a.out}"
    return show(a.json, {"out": a.out, "format": a.format, **facts}, text)


def import_command(a: Arguments) -> int:
    """Make a run folder of an exported field."""
    from ..exports.fields import import_field

    run = import_field(a.file, a.out, a.replace)
    print(f"{run.config.model} on {run.config.dataset}: {run.folder}")
    return 0


def _positions(texts: list[str] | None, option: str) -> Any:
    """Positions [n, 3], metres, of ``X,Y,Z`` or CSV files; None where unstated."""
    import numpy as np

    from ...runs.prediction_file import read_inputs

    if texts is None:
        return None
    positions = []
    for text in texts:
        if Path(text).suffix.lower() == ".csv":
            positions.append(read_inputs(text, None).tx_pos_m)
            continue
        try:
            position = np.array([float(part) for part in text.split(",")])
        except ValueError:
            position = np.zeros(0)
        if position.shape != (3,) or not np.isfinite(position).all():
            raise InputError(f"{option} {text}: give three numbers {POSITION} in metres, or a CSV file")
        positions.append(position[None])
    return np.concatenate(positions)
