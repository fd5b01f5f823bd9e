"""``wrf-mi data``."""

from __future__ import annotations

import sys
from typing import Any

from .options import DATASET, Arguments, add_command
from .output import print_json


def add_parser(commands: Any) -> None:
    """Add ``data`` and its subcommands to the commands."""
    data = commands.add_parser("data", help="data sets: list, fetch, info").add_subparsers(
        required=True, metavar="COMMAND"
    )
    add_command(data, "list", list_command, "list known data sets and their folders")
    parser = add_command(data, "fetch", fetch_command, "download a data set, checked by SHA-256", json_output=False)
    parser.add_argument("name", metavar="NAME", help="name of a data set")
    parser = add_command(data, "info", info_command, "read and check a data set, and summarise its content")
    parser.add_argument("dataset", metavar="DATASET", help=DATASET)


def list_command(a: Arguments) -> int:
    """List known data sets."""
    from ..datasets import datasets

    rows = [
        {name: getattr(entry.dataset, name) for name in ("name", "task", "licence", "origin")}
        | {"location": str(entry.location) if entry.location else None}
        for entry in datasets()
    ]
    if a.json:
        print_json(rows)
        return 0
    for row in rows:
        print(f"{row['name']:<19}{row['task']:<9}{row['licence']:<10}{row['location'] or 'not here yet'}")
        print(f"{'':<19}{row['origin']}")
    return 0


def fetch_command(a: Arguments) -> int:
    """Download or generate a data set."""
    from ..datasets import fetch
    from ..datasets.registry import known
    from ..synthetic import load_record

    dataset = known(a.name)
    synthetic = dataset.base_url is None
    print(f"{a.name}: {load_record(a.name, progress=True).source if synthetic else fetch(a.name)}")
    if synthetic and dataset.note:
        print(f"{a.name}: {dataset.note}", file=sys.stderr)
    return 0


def info_command(a: Arguments) -> int:
    """Summarise a data set."""
    from ..runs.data_info import data_info, render
    from ..synthetic import load_record

    found = data_info(load_record(a.dataset, progress=True))
    if a.json:
        print_json(found)
    else:
        print(render(found))
    return 0
