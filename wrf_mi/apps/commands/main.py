"""The command ``wrf-mi``.

Exit status 0 on success, 1 on failure, 2 with one line on bad input, 130 when stopped, 141 when the pipe of its output
was closed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from ...core import BackendError, InputError
from ...core.files import os_failure
from ...version import __version__
from .options import Parser

MODULES = ("doctor", "check", "data", "scenes", "train", "runs", "maps", "export", "table", "bench", "demo")
"""Modules of the commands, in the order of the help."""
INTERRUPTED = 130  # exit status of a command that was stopped


def build_parser() -> Parser:
    """Parser of ``wrf-mi`` and all its commands."""
    parser = Parser(prog="wrf-mi", description="Learned wireless radiation fields and ray tracing.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for name in MODULES:
        import_module(f".{name}", __package__).add_parser(commands)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status."""
    try:
        return _run(arguments)
    except KeyboardInterrupt as error:  # anywhere, also while another error is reported
        print(f"wrf-mi: {_noted('interrupted', error)}", file=sys.stderr)
        return INTERRUPTED


def _run(arguments: Sequence[str] | None) -> int:
    a = build_parser().parse_args(arguments)
    try:
        status: int = a.call(a)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # The reader of the output has gone; Python flushes again on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except Exception as error:
        if _is_interrupt(error):
            print(f"wrf-mi: {_noted('interrupted', error)}", file=sys.stderr)
            return INTERRUPTED
        # Errors of this package have an exit status and a message of one line; any other keeps its traceback.
        status_of_kind = {InputError: 2, OSError: 2, BackendError: 1}
        statuses = (status for kind, status in status_of_kind.items() if isinstance(error, kind))
        exit_status = next(statuses, getattr(error, "exit_status", None))
        if exit_status is None:
            raise
        text = os_failure(error) if isinstance(error, OSError) else str(error)
        print(f"wrf-mi: {_noted(text, error)}", file=sys.stderr)
        return int(exit_status)


def _noted(text: str, error: BaseException) -> str:
    """An error's text with its notes, such as how to go on, on one line."""
    return "; ".join([text, *getattr(error, "__notes__", ())])


def _is_interrupt(error: BaseException) -> bool:
    """Whether Ctrl-C caused an error: Dr.Jit raises its own for one within a function that it records."""
    return isinstance(error, KeyboardInterrupt) or (error.__cause__ is not None and _is_interrupt(error.__cause__))
