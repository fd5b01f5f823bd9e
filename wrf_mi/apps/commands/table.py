"""``wrf-mi table``: the table of radio fields, its entries and its page."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...core import InputError
from .options import Arguments, add_command, add_n_train, refuse
from .output import show

COSTS = {"train-seconds": "time of the fit, s", "ms-per-sample": "time of a prediction of one row, ms"}
COSTS |= {"peak-memory-mb": "peak memory of the fit, MB"}
ABOUT = {"label": "method in words, with what it knows", "origin": "address or commit of the code"}
ABOUT |= {"paper": "address of the paper", "licence": "licence of the code", "machine": "machine of the times"}


def add_parser(commands: Any) -> None:
    """Add ``table`` to the commands."""
    text = "table of radio fields: score any program's predictions on its rows, add them, make its page"
    parser = commands.add_parser("table", help=text, description=text)
    actions = parser.add_subparsers(required=True, metavar="ACTION")
    for add in (_add_add, _add_dataset, _add_check, _add_page):
        add(actions)


def _table(parser: Any) -> None:
    parser.add_argument("--table", default="benchmarks/table", metavar="DIR", help="folder of the entries")


def _add_add(actions: Any) -> None:
    parser = add_command(actions, "add", add_entry_command, "score predictions, and write an entry")
    add = parser.add_argument
    text = "predictions as of `wrf-mi evaluate --predictions`, outputs of NeRF2 and WRF-GS+ among them, or a run folder"
    add("predictions", metavar="PREDICTIONS", help=text)
    add("--dataset", metavar="DATASET", help="data set of the table: a name or a folder; omit it with a run folder")
    add("--split", help="split (default: official, or that of the run folder)")
    add("--method", metavar="NAME", help="name of the method (default: model of the run folder)")
    add("--seed", type=int, metavar="N", help="seed of the split (default: 0, or that of the run folder)")
    add_n_train(parser)
    for name, words in ABOUT.items():
        add(f"--{name}", metavar="TEXT", help=words)
    for name, words in COSTS.items():
        add(f"--{name}", type=float, metavar="X", help=words)
    add("--replace", action="store_true", help="replace the entry of the same method, data, rows and seed")
    _table(parser)


def add_entry_command(a: Arguments) -> int:
    """Score predictions, and write an entry of the table."""
    from ...runs.folder import CONFIG
    from ..table.add import add_entry
    from ..table.entries import read_entry

    names = [name.replace("-", "_") for name in (*ABOUT, *COSTS)]
    facts = {name: getattr(a, name) for name in names if getattr(a, name) is not None}
    if (Path(a.predictions) / CONFIG).exists():
        refuse(a, ("split", "n_train", "seed"), "is stated by the run folder")
    rows = {"split": a.split or "official", "n_train": a.n_train, "seed": a.seed or 0, "replace": a.replace}
    path = add_entry(Path(a.table), a.predictions, a.dataset, a.method, **rows, **facts)
    entry = read_entry(path)
    scores = ", ".join(f"{key} {value:.4g}" for key, value in entry.score.items())
    return show(a.json, {"entry": str(path), "score": dict(entry.score)}, f"{entry.of.label}: {scores}\nentry: {path}")


def _add_dataset(actions: Any) -> None:
    parser = add_command(actions, "dataset", dataset_command, "add a data set, with its rights and digests")
    add = parser.add_argument
    add("dataset", metavar="DATASET", help="name or folder of the data set")
    add("--name", required=True, metavar="NAME", help="name of the data set in the table")
    add("--licence", required=True, metavar="TEXT", help="licence of the data")
    add("--origin", required=True, metavar="TEXT", help="author and place of the data")
    add("--get", required=True, metavar="TEXT", help="command that fetches or imports it")
    add("--split", action="append", metavar="NAME", help="split of the table, repeatable (default: official)")
    add("--building", action="store_true", help="measured by walks in a building or outdoors")
    add("--not-redistributable", action="store_true", help="the licence does not allow to pass the data on")
    _table(parser)


def dataset_command(a: Arguments) -> int:
    """Write the file of a data set of the table."""
    from ..table.sources import add_source

    facts: dict[str, Any] = {"licence": a.licence, "origin": a.origin, "get": a.get, "building": a.building}
    facts["redistributable"] = not a.not_redistributable
    path = add_source(Path(a.table), a.dataset, a.name, a.split or ["official"], **facts)
    return show(a.json, {"file": str(path)}, f"data set: {path}")


def _add_check(actions: Any) -> None:
    text = "read all entries, compare data sets and splits with those of this machine, score stored predictions again"
    _table(add_command(actions, "check", check_command, text))


def check_command(a: Arguments) -> int:
    """Check a table; exit status 2 where anything is wrong."""
    from ..table.add import check_table

    table = Path(a.table)
    if (checked := check_table(table)).faults:
        raise InputError("; ".join(checked.faults))
    text = f"{checked.entries} entries, {checked.scored} with predictions that were scored again: nothing wrong"
    text += f"\nnot on this machine, and not checked: {', '.join(checked.absent)}" if checked.absent else ""
    return show(a.json, asdict(checked), text)


def _add_page(actions: Any) -> None:
    parser = add_command(actions, "page", page_command, "write the page of the table, one HTML file without network")
    parser.add_argument("--out", required=True, metavar="FILE", help="HTML file to write")
    _table(parser)


def page_command(a: Arguments) -> int:
    """Write the page of the table."""
    from ...core.files import write_atomically
    from ..table.page import table_page

    out = write_atomically(Path(a.out), table_page(Path(a.table)))
    return show(a.json, {"page": str(out)}, f"page: {out}")
