"""``wrf-mi compare``."""

from __future__ import annotations

from typing import Any

from .options import Arguments, add_command
from .output import Watch


def add_parser(commands: Any) -> None:
    """Add ``compare`` to the commands."""
    text = "write a page that compares runs: tables, paired differences, pictures, commands (docs/compare.md)"
    parser = add_command(commands, "compare", compare_command, text, json_output=False)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to write to")


def compare_command(a: Arguments) -> int:
    """Compare runs."""
    from ..runs.compare import compare

    with Watch() as watch:
        page = compare(a.runs, a.out, watch.on_progress)
    print(f"comparison: {page}")
    return 0
