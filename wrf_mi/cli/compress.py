"""``wrf-mi compress``."""

from __future__ import annotations

from typing import Any

from .options import Arguments, add_command
from .output import Watch, print_json


def add_parser(commands: Any) -> None:
    """Add ``compress`` to the commands."""
    text = "make a smaller and faster run of a run, and measure the loss of accuracy"
    parser = add_command(commands, "compress", compress_command, text)
    add = parser.add_argument
    add("run", metavar="RUN", help="run folder")
    add("--out", required=True, metavar="RUN2", help="run folder to make")
    add("--budget", type=int, default=0, metavar="N", help="number of Gaussians to keep (default: all)")
    add("--width", type=int, default=0, metavar="N", help="neurons per layer of a smaller network")
    add("--layers", type=int, default=0, metavar="N", help="hidden layers of a smaller network")
    add("--terms", type=int, default=0, metavar="K", help="convert to a factorised field of K terms")
    text = "steps in which the smaller network learns the old one's output (default: 6000)"
    add("--distil", type=int, default=6000, metavar="STEPS", help=text)
    add("--fine-tune", type=int, default=0, metavar="STEPS", help="further steps on the training rows (default: 0)")
    add("--precision", default="half", help="precision of stored numbers: single, half (default) or 8bit")


def compress_command(a: Arguments) -> int:
    """Compress a run."""
    from ..runs.compressed import compress_run, render
    from ..training.compress import Compression

    how = Compression(a.budget, a.width, a.layers, a.terms, a.distil, a.fine_tune, a.precision)
    with Watch() as watch:
        found = compress_run(a.run, a.out, how, on_progress=watch.on_progress)
    if a.json:
        print_json(found)
    else:
        print(render(found), f"results: {a.out}", sep="\n")
    return 0
