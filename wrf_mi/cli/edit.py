"""``wrf-mi edit``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .options import Arguments, add_command
from .output import show

if TYPE_CHECKING:
    from ..scene.edit import Move


def add_parser(commands: Any) -> None:
    """Add ``edit`` to the commands."""
    text = "move or remove parts of a scene, whose changed signals `trace` then predicts; without --out: list its parts"
    parser = add_command(commands, "edit", edit_command, text)
    add = parser.add_argument
    add("scene", metavar="SCENE", help="scene folder")
    text = "move parts, together, by metres and turn them by degrees about the vertical axis; * and ? are wildcards"
    add("--move", action="append", default=[], metavar="NAME,...:DX,DY,DZ[,DEG]", help=f"{text}; repeatable")
    add("--remove", action="append", default=[], type=_names, metavar="NAME,...", help="leave parts out; repeatable")
    add("--out", metavar="SCENE2", help="scene folder to make")
    add("--replace", action="store_true", help="replace an existing scene folder")


def edit_command(a: Arguments) -> int:
    """Edit a scene, or list its parts."""
    from ..core import InputError
    from ..scene.edit import box_of, edit_scene, read_surfaces

    if a.out is not None:
        removed = [name for names in a.remove for name in names]
        folder = edit_scene(a.scene, a.out, [_move(text) for text in a.move], removed, a.replace)
        return show(a.json, {"scene": str(folder)}, f"scene: {folder}\npicture: {folder / 'preview.png'}")
    if a.move or a.remove or a.replace:
        raise InputError("edit: give the folder of the edited scene (--out)")
    surfaces, materials = read_surfaces(a.scene)
    rows = [
        {"part": one.name, "material": materials.of(one.name, one.kind), "box_m": box_of([one]).round(3).tolist()}
        for one in surfaces
    ]
    width = max(len(row["part"]) for row in rows) + 2
    lines = [f"{'part':<{width}}{'material':<24}{'from x, y, z (m)':<24}to"]
    for row in rows:
        low, high = (" ".join(f"{value:7.2f}" for value in corner) for corner in row["box_m"])
        lines.append(f"{row['part']:<{width}}{row['material']:<24}{low:<24}{high}")
    return show(a.json, {"scene": a.scene, "parts": rows}, "\n".join(lines))


def _names(text: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def _move(text: str) -> Move:
    from ..core import InputError
    from ..scene.edit import Move

    names, _, numbers = text.rpartition(":")
    try:
        values = [float(value) for value in numbers.split(",")]
    except ValueError:
        values = []
    if not _names(names) or len(values) not in (3, 4):
        raise InputError(f"--move {text}: give names, a colon, and DX,DY,DZ in metres, such as box:0.5,0,0")
    return Move(_names(names), (values[0], values[1], values[2]), values[3] if len(values) == 4 else 0.0)
