"""``wrf-mi correct``."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from .options import DATASET, Arguments, add_command, add_n_train
from .output import Watch, show


def add_parser(commands: Any) -> None:
    """Add ``correct`` to the commands."""
    parser = add_command(commands, "correct", correct_command, "correct a scene by measurements")
    add = parser.add_argument
    add("scene", metavar="SCENE", help="name of a scene, scene folder, Mitsuba XML, or mesh file")
    add("dataset", metavar="DATASET", help=DATASET)
    add("--out", required=True, metavar="SCENE2", help="scene folder to make")
    parts = "what is changed, from materials,planes,frame,hidden,gain,pose,patterns"
    add("--fit", metavar="LIST", help=f"{parts} (default: the first four; for signal strengths materials and gain)")
    add("--depth", type=int, metavar="N", help="largest number of interactions per path (default: 3; strengths: 6)")
    add("--reflections", type=int, metavar="N", help="largest number of reflections (default: 3; strengths: 2)")
    add("--rows", type=int, metavar="N", help="most training rows that are compared (default: 600)")
    add("--rays", type=int, metavar="N", help="number of rays from each receiver (default: 65536)")
    add("--shift-sd", type=float, metavar="M", help="standard deviation of a plane's stated position (default: 0.02 m)")
    add("--material", metavar="NAME", help="radio material of a bare mesh, e.g. concrete")
    add("--split", default="official", help="as for train (default: official); test rows are not used")
    add_n_train(parser)
    add("--seed", type=int, default=0, metavar="N", help="seed of split and held-out rows (default: 0)")
    add("--replace", action="store_true", help="replace an existing scene folder")


def correct_command(a: Arguments) -> int:
    """Correct a scene, and write its page."""
    from ..checking import warn_of_suspicions
    from ..core import InputError
    from ..core.settings import with_settings
    from ..correction import correct_scene, default_options, write_page
    from ..correction.options import FRAME, PLANES
    from ..datasets import make_splits
    from ..synthetic import load_record

    if Path(a.out).exists() and not a.replace:  # before the work, not after it
        raise InputError(f"{a.out}: exists; remove it, choose another folder, or give --replace")
    record = load_record(a.dataset, progress=sys.stderr.isatty())
    options = default_options(record)
    if a.fit is not None:
        options = replace(options, parts=tuple(a.fit.split(",")))
    names = ("depth", "reflections", "rows", "rays")
    given = {name: getattr(a, name) for name in names} | {"shift_sd_m": a.shift_sd}
    options = with_settings(options, [f"{key}={value}" for key, value in given.items() if value is not None])
    if a.shift_sd is not None and not {PLANES, FRAME} & set(options.parts):
        raise InputError(f"--shift-sd: of {PLANES} and {FRAME}, which --fit {','.join(options.parts)} leaves; omit it")
    splits = make_splits(record, a.split, a.seed, a.n_train)
    if len(splits) > 1:
        raise InputError(f"--split {a.split}: a scene is corrected by one split; choose a fold, such as {a.split}:0")
    warn_of_suspicions(record)
    with Watch() as watch:
        found = correct_scene(a.scene, record, splits[0], options, a.material, watch.on_progress)
        facts = write_page(found, a.out, a.replace)
    what = "rows of held-out receivers" if facts["held_out_receivers"] else "held-out rows"
    lines = [f"{facts['score']} of {facts['held_out']} {what}   median    mean"]
    for stage, score in facts["held_out_scores"].items():
        mark = "  kept" if stage == facts["kept"] else ""
        lines.append(f"{stage:<40}{score['median']:8.3f}{score['mean']:8.3f}{mark}")
    lines.append(f"{facts['rows']} training rows, {facts['paths']} paths, {facts['seconds']:.0f} s")
    lines.append(f"scene: {a.out}\npage: {a.out}/correction.md")
    shown = {"scene": a.out, **{key: value for key, value in facts.items() if key != "parameters"}}
    return show(a.json, shown, "\n".join(lines))
