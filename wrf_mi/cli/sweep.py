"""``wrf-mi sweep``."""

from __future__ import annotations

from typing import Any

from ..core import InputError
from . import train
from .options import Arguments, Parser, add_command, add_scheduler, add_training
from .output import print_json


def add_parser(commands: Any) -> None:
    """Add ``sweep`` to the commands."""
    text = "train with every combination of settings, and tabulate the scores"
    parser = add_command(commands, "sweep", sweep_command, text)
    add_training(parser)
    text = "setting or option of train and its values, e.g. seed=0,1,2; repeatable: every combination is run"
    parser.add_argument("--vary", action="append", default=[], metavar="KEY=A,B,...", help=text)
    parser.add_argument("--out", metavar="DIR", required=True, help="folder of all runs and their table")
    add_scheduler(parser)


def training_names() -> list[str]:
    """Names of the options that sweep shares with train, and ``dataset``."""
    parser = Parser(add_help=False)
    add_training(parser)
    return [action.dest.replace("_", "-") for action in parser._actions]


def sweep_command(a: Arguments) -> int:
    """Run ``train`` for each combination."""
    from ..parallel import open_scheduler
    from ..runs.sweep import check_failures, check_run, plan_sweep, run_sweep, sweep_table

    # Read off the parser, so that no option of train is left out.
    given = {name: getattr(a, name.replace("-", "_")) for name in training_names()}
    settings = given.pop("set")
    options = {name: str(value) for name, value in given.items() if value is not None and not isinstance(value, bool)}
    flags = [f"--{name}" for name, value in given.items() if value is True]
    sweep = plan_sweep(a.out, a.vary, options, settings, flags)
    parser = Parser(prog="wrf-mi")
    train.add_parser(parser.add_subparsers())
    for run in sweep.runs:
        single = parser.parse_args([*run.arguments, "--out", str(run.folder)])
        if not single.dataset:
            raise InputError("sweep needs DATASET")
        check_run(single.dataset, train.training_arguments(single))
    with open_scheduler(a.scheduler) as scheduler:
        rows = run_sweep(sweep, scheduler)
    if a.json:
        print_json(rows)
    else:
        print(sweep_table(rows, sweep.varied))
        print(f"results: {a.out}")
    check_failures(rows)
    return 0
