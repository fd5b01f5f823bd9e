"""``wrf-mi check``: why a scene does not open in Sionna RT, and a repaired copy."""

from __future__ import annotations

import argparse
from typing import Any

from .options import Arguments, add_command, refuse
from .output import exit_status, show


def add_parser(commands: Any) -> None:
    """Add ``check`` to the commands."""
    from ..checking.scene_findings import KINDS

    text = "find what keeps a scene, mesh or scan from opening or makes its paths wrong, and repair a copy"
    parser = add_command(commands, "check", check_command, text)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    width = max(map(len, KINDS)) + 2
    lines = [f"  {kind:<{width}}{level:<9}{description}" for kind, (level, description) in KINDS.items()]
    parser.epilog = "\n".join(["kinds of findings:", *lines])
    add = parser.add_argument
    add("scene", metavar="SCENE", help="name of a scene, scene folder, Mitsuba XML, mesh, scan or plan")
    text = "data set whose devices must not be inside solids, and whose carrier counts"
    add("--dataset", metavar="DATASET", help=text)
    add("--frequency", type=float, metavar="HZ", help="carrier at which materials and phases are checked")
    add("--units", default="m", help="unit of the coordinates: m (default), dm, cm, mm, ft or in")
    add("--up", choices=("y", "z"), help="axis that is up (default: y in GLB, else z)")
    add("--repair", metavar="OUT", help="scene folder to make, which plain Sionna RT opens; the source is not changed")
    text = "for --repair: material of shapes whose names mean none, or SHAPE=NAME of one shape; repeatable"
    add("--material", action="append", default=[], metavar="NAME", help=text)
    add("--replace", action="store_true", help="for --repair: replace an existing folder")
    add("--strict", action="store_true", help="exit status 1 if there are warnings")


def check_command(a: Arguments) -> int:
    """Report faults (exit status 2), warnings (0, or 1 if asked) and notes of a scene, or repair it."""
    from ..checking import check_scene, repair_scene

    form = {"units": a.units, "up": a.up, "frequency_hz": a.frequency}
    if a.repair is not None:
        refuse(a, ("dataset", "strict"), "has no effect beside --repair: check the new folder")
        repair = repair_scene(a.scene, a.repair, **_materials(a.material), overwrite=a.replace, **form)
        show(a.json, repair.as_dict(), "\n".join(repair.lines()))
        return 2 if repair.unrepaired else 0
    refuse(a, ("material", "replace"), "belongs to --repair OUT")
    report = check_scene(a.scene, data=a.dataset, **form)
    show(a.json, report.as_dict(), "\n".join(report.lines()))
    return exit_status(report.ok, a.strict and report.of_level("warning"))


def _materials(texts: list[str]) -> dict[str, Any]:
    """Material of shapes that have none, and those of single shapes."""
    from ...core import InputError

    others = [text for text in texts if "=" not in text]
    if len(others) > 1:
        raise InputError(f"check: --material {' and '.join(others)}; give one, and SHAPE=NAME for single shapes")
    of_shapes = dict(text.rsplit("=", 1) for text in texts if "=" in text)
    return {"material": others[0] if others else None, "shape_materials": of_shapes}
