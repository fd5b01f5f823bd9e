"""``wrf-mi data``."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Record
from ..core.carriers import carriers_text
from .options import DATASET, Arguments, add_command
from .output import show

SHOWN_CARRIERS = 8


def add_parser(commands: Any) -> None:
    """Add ``data`` and its subcommands to the commands."""
    data = commands.add_parser("data", help="data sets: list, fetch, info, check").add_subparsers(
        required=True, metavar="COMMAND"
    )
    add_command(data, "list", list_command, "list known data sets and their folders")
    parser = add_command(data, "fetch", fetch_command, "download a data set, checked by SHA-256", json_output=False)
    parser.add_argument("name", metavar="NAME", help="name of a data set")
    parser = add_command(data, "info", info_command, "read and check a data set, and summarise its content")
    parser.add_argument("dataset", metavar="DATASET", help=DATASET)
    text = "find every fault of a data set, and data that are likely wrong (docs/data.md)"
    parser = add_command(data, "check", check_command, text)
    parser.add_argument("dataset", metavar="DATASET", help=DATASET)
    parser.add_argument("--strict", action="store_true", help="exit status 1 if there is a suspicion")
    text = "suspicion that is not reported, see docs/data.md; repeatable"
    parser.add_argument("--ignore", action="append", default=[], metavar="NAME", help=text)


def list_command(a: Arguments) -> int:
    """List known data sets."""
    from ..datasets import datasets

    rows = [
        {name: getattr(entry.dataset, name) for name in ("name", "task", "licence", "origin")}
        | {"location": str(entry.location) if entry.location else None}
        for entry in datasets()
    ]
    width = max(len(row["name"]) for row in rows) + 1
    lines = [
        f"{row['name']:<{width}}{row['task']:<9}{row['licence']:<10}{row['location'] or 'not here yet'}\n"
        f"{'':<{width}}{row['origin']}"
        for row in rows
    ]
    return show(a.json, rows, "\n".join(lines))


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
    from ..synthetic import load_record

    facts = summary(load_record(a.dataset, progress=True))
    return show(a.json, facts, render(facts))


def check_command(a: Arguments) -> int:
    """Report faults (exit status 2) and suspicions (0, or 1 if asked) of a data set."""
    from ..checking import check_data

    report = check_data(a.dataset, a.ignore, progress=True)
    show(a.json, report.as_dict(), "\n".join(report.lines()))
    if not report.ok:
        return 2
    return 1 if a.strict and report.suspicions else 0


def summary(record: Record) -> dict[str, Any]:
    """Summary of a record in plain values; None: not stated.

    ``receivers`` are received rows by name, ``observation`` the shape of an observation, ``official`` the numbers of
    training and test rows, ``folds`` rows by spatial fold, ``frequencies_hz`` the carrier or the subcarriers,
    ``carriers_hz`` rows by carrier, ``receiver_carriers_hz`` carriers by receiver, ``antennas`` patterns and
    polarisations of receivers, ``runs`` rows by run, ``n_readings`` and ``std_db`` minimum, median and maximum.

    Raises:
        InputError: parts of the record that do not fit together.
    """
    from ..models.checks import check_parts

    check_parts(record)
    received = np.asarray(np.isfinite(record.observation).reshape(len(record.receivers), len(record), -1).all(axis=2))
    carriers = None
    if record.carriers_hz is not None:
        hz, rows = np.unique(record.carriers_hz, return_counts=True)
        carriers = dict(zip(hz.tolist(), rows.tolist(), strict=True))
    runs, hz_of = None, record.receiver_carriers_hz
    if record.runs is not None:
        names, first, rows = np.unique(record.runs, return_index=True, return_counts=True)
        runs = {str(names[k]): int(rows[k]) for k in np.argsort(first)}
    return {
        "name": record.name,
        "task": record.task,
        "source": record.source,
        "rows": len(record),
        "receivers": {r.name: int(count) for r, count in zip(record.receivers, received.sum(axis=1), strict=True)},
        "observation": list(record.observation.shape[2:]),
        "official": None if record.official is None else [len(part) for part in record.official],
        "frequencies_hz": None if record.frequencies_hz is None else record.frequencies_hz.tolist(),
        "carriers_hz": carriers,
        "receiver_carriers_hz": None if hz_of is None else {r.name: r.frequency_hz for r in record.receivers},
        "folds": None if record.folds is None else np.bincount(record.folds).tolist(),
        "antennas": sorted({f"{r.antenna.pattern} {r.antenna.polarization}" for r in record.receivers}),
        "runs": runs,
        "n_readings": _range(record.n_readings, received),
        "std_db": _range(record.std, received),
        "positions": record.has_positions,
        "headings": record.tx_heading_rad is not None,
        "uplink": record.uplink is not None,
        "truth": record.truth is not None,
    }


def render(facts: dict[str, Any]) -> str:
    """`summary` as text."""
    shape = " x ".join(map(str, facts["observation"])) or "one number"
    received = ", ".join(f"{name} {count}" for name, count in facts["receivers"].items())
    official = "{} training rows, {} test rows".format(*facts["official"]) if facts["official"] else "not stated"
    if facts["folds"]:
        official += f"; {len(facts['folds'])} spatial folds of {', '.join(map(str, facts['folds']))} rows"
    carriers, frequencies = facts["carriers_hz"], facts["frequencies_hz"]
    if facts["receiver_carriers_hz"]:
        carrier = ", ".join(f"{name} {hz:.10g} Hz" for name, hz in facts["receiver_carriers_hz"].items())
    elif carriers is not None:
        carrier = carriers_text(np.array(list(carriers)))
        if len(carriers) <= SHOWN_CARRIERS:
            carrier = ", ".join(f"{hz:.10g} Hz in {rows} rows" for hz, rows in carriers.items())
    elif frequencies is None:
        carrier = "not stated"
    else:
        band = f"{min(frequencies):.10g} to {max(frequencies):.10g} Hz, {len(frequencies)} subcarriers"
        carrier = f"{frequencies[0]:.10g} Hz" if len(frequencies) == 1 else band
    known = [name for name in ("positions", "headings", "uplink", "truth") if facts[name]]
    lines = {
        "data set": f"{facts['name']}, {facts['task']}, {facts['source']}",
        "rows": f"{facts['rows']}, each {shape}",
        "received": received,
        "official split": official,
        "carrier": carrier,
        "antennas": ", ".join(facts["antennas"]),
        "runs": "not stated" if facts["runs"] is None else ", ".join(f"{k} {n}" for k, n in facts["runs"].items()),
        "readings per row": _shown(facts["n_readings"], ""),
        "noise": _shown(facts["std_db"], " dB"),
        "known": ", ".join(known) or "observations alone",
    }
    return "\n".join(f"{label + ':':<18}{text}" for label, text in lines.items())


def _range(values: NDArray[Any] | None, received: NDArray[np.bool_]) -> list[float] | None:
    """Minimum, median and maximum where something was received."""
    if values is None or not received.any():
        return None
    return [float(value) for value in np.percentile(values[received], [0, 50, 100])]


def _shown(values: list[float] | None, unit: str) -> str:
    return "not stated" if values is None else f"{values[0]:g} to {values[2]:g}{unit}, median {values[1]:g}{unit}"
