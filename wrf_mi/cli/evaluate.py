"""``wrf-mi evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .options import Arguments, add_command, add_operator
from .output import show_metrics


def add_parser(commands: Any) -> None:
    """Add ``evaluate`` to the commands."""
    parser = add_command(commands, "evaluate", evaluate_command, "score a run on its held-out rows")
    parser.add_argument("run", metavar="RUN", help="run folder")
    text = "score on the test rows of another split that the run was not trained on; nothing is written"
    parser.add_argument("--split", help=text)
    add_operator(parser)


def evaluate_command(a: Arguments) -> int:
    """Score a run again."""
    from ..runs.api import evaluate_run

    return show_metrics(evaluate_run(a.run, a.split, not a.no_operator), None if a.split else Path(a.run), a.json)
