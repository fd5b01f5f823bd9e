"""``wrf-mi compare``."""

from __future__ import annotations

from typing import Any

from .options import Arguments, add_command


def add_parser(commands: Any) -> None:
    """Add ``compare`` to the commands."""
    text = "write a table, score distributions and pictures of several runs"
    parser = add_command(commands, "compare", compare_command, text, json_output=False)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder to write to")


def compare_command(a: Arguments) -> int:
    """Compare runs."""
    from ..runs.compare import compare

    print(f"comparison: {compare(a.runs, a.out)}")
    return 0
