"""``wrf-mi data``."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record
from ...core.carriers import carriers_text
from ...core.files import listed, one_line
from ..importing.options import AVERAGES
from .options import DATASET, Arguments, add_command, comma_numbers
from .output import exit_status, show

SHOWN_CARRIERS = 8
MOST_ALIKE = 3  # notes of one kind on several files that are printed


def add_parser(commands: Any) -> None:
    """Add ``data`` and its subcommands to the commands."""
    data = commands.add_parser("data", help="data sets: list, fetch, import, info, check").add_subparsers(
        required=True, metavar="COMMAND"
    )
    add_command(data, "list", list_command, "list known data sets and their folders")
    parser = add_command(data, "fetch", fetch_command, "download a data set, checked by SHA-256", json_output=False)
    parser.add_argument("name", metavar="NAME", help="name of a data set")
    _add_import(data)
    parser = add_command(data, "info", info_command, "read and check a data set, and summarise its content")
    parser.add_argument("dataset", metavar="DATASET", help=DATASET)
    text = "find every fault of a data set, and data that are likely wrong (docs/data.md)"
    parser = add_command(data, "check", check_command, text)
    parser.add_argument("dataset", metavar="DATASET", help=DATASET)
    parser.add_argument("--strict", action="store_true", help="exit status 1 if there is a suspicion")
    text = "suspicion that is not reported, see docs/data.md; repeatable"
    parser.add_argument("--ignore", action="append", default=[], metavar="NAME", help=text)


def _add_import(data: Any) -> None:
    text = "make a data set from tables, surveys and logs of signal strengths (docs/howto/own-data.md, surveys.md)"
    parser = add_command(data, "import", import_command, text)
    add, metres = parser.add_argument, dict[str, Any](type=float, metavar="M")
    add("files", nargs="+", metavar="FILE", help="tables with a column per receiver, or a row per reading")
    add("--out", required=True, metavar="FOLDER", help="data set to write")
    add("--replace", action="store_true", help="replace the folder if it exists")
    text = "columns by meaning, such as x=X,y=Y,rssi=level,id=bssid,time=ts (default: guessed); '-': there is none"
    add("--columns", metavar="LIST", help=text)
    add("--sheet", metavar="NAME", help="sheet of workbooks that have several")
    text = "columns of strengths of a wide table, such as 'AP* RSS(dBm)'; repeatable"
    add("--receivers", action="append", metavar="PATTERN", help=text)
    add("--test", nargs="+", metavar="FILE", help="tables with the test rows")
    text = "tables with the positions of the rows: one for each table, those of --test last, or one for all"
    add("--positions", nargs="+", metavar="FILE", help=text)
    add("--anchors", metavar="FILE", help="table with the receivers' positions: id,x,y[,z] (default: unknown)")
    text = "use the rows alone that have this text or number in a column, such as device=Samsung; repeatable"
    add("--where", action="append", metavar="COLUMN=TEXT", help=text)
    text = "number for what was not heard, repeatable, or none (default: found and named)"
    add("--not-heard", action="append", metavar="DBM", help=text)
    add("--average", choices=AVERAGES, help="mean of the readings of a place (default: db)")
    add("--place", dest="place_m", **metres, help="average in squares of this side (default: at equal positions)")
    add("--units", metavar="UNIT", help="unit of positions: m, mm, cm, km, ft, deg, px (default: by names, or m)")
    text = "plan in whose pixels positions are (--units px), y down; or a ROS map's YAML"
    add("--plan", metavar="PICTURE", help=text)
    add("--resolution", dest="resolution_m", **metres, help="side of a pixel of the plan")
    text = "point of the plan, from its lower left corner, metres, that becomes the origin, as of mesh"
    add("--origin", dest="origin_m", type=comma_numbers(3, "X,Y,Z"), metavar="X,Y,Z", help=text)
    text = "move positions by pairs of points: x,y,to_x,to_y, in the tables' unit and in metres"
    add("--register-pairs", metavar="CSV", help=text)
    text = "axis that is up in a trajectory of --positions: z, y, or -y (a camera's frame) as --up=-y"
    add("--up", metavar="AXIS", help=text)
    add("--pitch", dest="pitch_m", **metres, help="positions are indices of a grid of this pitch")
    add("--crs", metavar="CRS", help="coordinate reference system of positions, such as EPSG:3857")
    text = "unit of headings: rad, deg (from x towards y) or compass (degrees from north, clockwise)"
    add("--heading-unit", metavar="UNIT", dest="heading", help=text)
    text = "height of the moving end without z, one for all tables or each (default: 1.3)"
    add("--height", dest="height_m", nargs="+", **metres, help=text)
    add("--storey", dest="storey_m", **metres, help="height of a storey, for a column floor without z (default: 3)")
    add("--anchor-height", dest="anchor_height_m", **metres, help="height of receivers without z (default: 2.5)")
    text = "carrier of all rows (default: of the table, or 2.44e9)"
    add("--frequency", type=float, dest="frequency_hz", metavar="HZ", help=text)
    text = "leave out receivers with fewer training rows (default: 1)"
    add("--min-rows", type=int, dest="min_heard", metavar="N", help=text)


def list_command(a: Arguments) -> int:
    """List known data sets."""
    from ...datasets import datasets

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
    from ...datasets import fetch
    from ...datasets.registry import known
    from ...synthetic import load_record

    dataset = known(a.name)
    synthetic = dataset.base_url is None
    print(f"{a.name}: {load_record(a.name, progress=True).source if synthetic else fetch(a.name)}")
    if synthetic and dataset.note:
        print(f"{a.name}: {dataset.note}", file=sys.stderr)
    return 0


def import_command(a: Arguments) -> int:
    """Import tables, check the data set, and name the next command."""
    from dataclasses import fields

    from ..checking import check_data
    from ..importing import ImportOptions, import_measurements

    arguments = {attribute.name: getattr(a, attribute.name) for attribute in fields(ImportOptions)}
    options = {name: value for name, value in arguments.items() if value is not None}
    if "not_heard" in options:
        options["not_heard"] = _not_heard(options["not_heard"])
    if "where" in options:
        options["where"] = dict(_where(text) for text in options["where"])
    report = import_measurements(a.files, a.out, a.replace, **options)
    check = check_data(a.out)
    facts = summary(report.record)
    next_command = f"wrf-mi train {a.out} [--scene SCENE] --out RUN"
    values: dict[str, Any] = {"folder": str(report.folder), "columns": report.columns, "notes": report.notes}
    values |= {"summary": facts, "check": check.as_dict(), "next": next_command}
    rows = f"{a.out}: {facts['rows']} rows, {len(facts['receivers'])} receivers; plan.png shows them"
    lines = [*report.columns, "", *_of_many_files(report.notes), "", rows, *check.lines(), f"next: {next_command}"]
    show(a.json, values, "\n".join(lines))
    return 0 if check.ok else 2


def _of_many_files(notes: Sequence[str]) -> list[str]:
    """Notes without those that differ from `MOST_ALIKE` others in the name of their file and in numbers alone."""
    counts, shown = Counter[str](), list[str]()
    for note in notes:
        kind = re.sub(r"\d[\d.,]*", "#", note.partition(": ")[2])
        counts[kind] += 1
        shown += [note] * (not kind or counts[kind] <= MOST_ALIKE)
    more = len(notes) - len(shown)
    return shown + [f"import.yml has {more} more notes of this kind on other files"] * bool(more)


def _where(text: str) -> tuple[str, str]:
    column, equals, wanted = text.partition("=")
    if not equals:
        raise InputError(f"--where {one_line(text)}: give COLUMN=TEXT")
    return column.strip(), wanted.strip()


def _not_heard(texts: list[str]) -> list[float]:
    """Numbers of ``--not-heard``; none for ``none``."""
    try:
        return [float(text) for text in texts if text != "none"]
    except ValueError:
        raise InputError(f"--not-heard {one_line(' '.join(texts))}: give numbers in dBm, or none") from None


def info_command(a: Arguments) -> int:
    """Summarise a data set."""
    from ...synthetic import load_record

    facts = summary(load_record(a.dataset, progress=True))
    return show(a.json, facts, render(facts))


def check_command(a: Arguments) -> int:
    """Report faults (exit status 2) and suspicions (0, or 1 if asked) of a data set."""
    from ..checking import check_data

    report = check_data(a.dataset, a.ignore, progress=True)
    show(a.json, report.as_dict(), "\n".join(report.lines()))
    return exit_status(report.ok, a.strict and report.suspicions)


def summary(record: Record) -> dict[str, Any]:
    """Summary of a record in plain values; None: not stated.

    ``receivers`` are received rows by name, ``observation`` the shape of an observation, ``official`` the numbers of
    training and test rows, ``folds`` rows by spatial fold, ``frequencies_hz`` the carrier or the subcarriers,
    ``carriers_hz`` rows by carrier, ``receiver_carriers_hz`` carriers by receiver, ``antennas`` patterns and
    polarisations of receivers, ``runs`` rows by run, ``n_readings`` and ``std_db`` minimum, median and maximum,
    ``extent_m`` that of the positions, ``nearest_m`` distances of test to training rows.

    Raises:
        InputError: parts of the record that do not fit together.
    """
    from ...estimators.checks import check_parts

    check_parts(record)
    received = np.asarray(np.isfinite(record.observation).reshape(len(record.receivers), len(record), -1).all(axis=2))
    hz_of = record.receiver_carriers_hz
    return {
        "name": record.name,
        "task": record.task.name,
        "source": record.source,
        "rows": len(record),
        "receivers": {r.name: int(count) for r, count in zip(record.receivers, received.sum(axis=1), strict=True)},
        "observation": list(record.observation.shape[2:]),
        "official": None if record.official is None else [len(part) for part in record.official],
        "frequencies_hz": None if record.frequencies_hz is None else record.frequencies_hz.tolist(),
        "carriers_hz": _counts(record.carriers_hz),
        "receiver_carriers_hz": None if hz_of is None else {r.name: r.frequency_hz for r in record.receivers},
        "folds": None if record.folds is None else np.bincount(record.folds).tolist(),
        "antennas": sorted({f"{Path(a.pattern).name} {a.polarization}" for a in (r.antenna for r in record.receivers)}),
        "runs": _counts(record.runs),
        "n_readings": _range(record.n_readings, received),
        "std_db": _range(record.std, received),
        "positions": record.has_positions,
        "headings": record.tx_heading_rad is not None,
        "uplink": record.uplink is not None,
        "truth": record.truth is not None,
        "extent_m": np.ptp(record.tx_pos_m, axis=0).tolist() if record.has_positions else None,
        "nearest_m": _nearest(record),
    }


def _nearest(record: Record) -> dict[str, list[float]]:
    """Median and largest distance of test rows to the nearest training row, by split, metres; empty where unknown."""
    from scipy.spatial import KDTree

    from ...datasets import make_splits

    distances = {}
    for split in ("official", "blocked") if record.has_positions else ():
        with suppress(InputError):  # not stated, or too few rows
            parts, at_m = make_splits(record, split), record.tx_pos_m
            nearest_m = np.concatenate([KDTree(at_m[part.all_train]).query(at_m[part.test])[0] for part in parts])
            distances[split] = [float(np.median(nearest_m)), float(nearest_m.max())]
    return distances


def render(facts: dict[str, Any]) -> str:
    """`summary` as text."""
    shape = " x ".join(map(str, facts["observation"])) or "one number"
    official = "{} training rows, {} test rows".format(*facts["official"]) if facts["official"] else "not stated"
    if facts["folds"]:
        official += f"; {len(facts['folds'])} spatial folds of {', '.join(map(str, facts['folds']))} rows"
    lines = {
        "data set": f"{facts['name']}, {facts['task']}, {facts['source']}",
        "rows": f"{facts['rows']}, each {shape}",
        "received": _named(facts["receivers"]),
        "official split": official,
        "extent": "{:.2f} x {:.2f} x {:.2f} m".format(*facts["extent_m"]) if facts["extent_m"] else "not stated",
        "nearest": _distances(facts["nearest_m"]),
        "carrier": _carrier(facts["receiver_carriers_hz"], facts["carriers_hz"], facts["frequencies_hz"]),
        "antennas": listed(facts["antennas"]),
        "runs": "not stated" if facts["runs"] is None else _named(facts["runs"]),
        "readings per row": _shown(facts["n_readings"], ""),
        "noise": _shown(facts["std_db"], " dB"),
        "known": ", ".join(filter(facts.get, ("positions", "headings", "uplink", "truth"))) or "observations alone",
    }
    return "\n".join(f"{label + ':':<18}{text}" for label, text in lines.items())


def _distances(nearest_m: dict[str, list[float]]) -> str:
    words = ("{}: median {:.3g}, at most {:.3g} m".format(split, *of_split) for split, of_split in nearest_m.items())
    return "; ".join(words) + " from test to training rows" if nearest_m else "not stated"


def _named(counts: dict[str, int]) -> str:
    return listed(f"{name} {count}" for name, count in counts.items())


def _carrier(
    of_receivers: dict[str, float] | None, of_rows: dict[float, int] | None, frequencies_hz: list[float] | None
) -> str:
    """Carriers in words: of the receivers, of the rows, or of the record with its subcarriers."""
    if of_receivers:
        return listed(f"{name} {hz:.10g} Hz" for name, hz in of_receivers.items())
    if of_rows is not None and len(of_rows) > SHOWN_CARRIERS:
        return carriers_text(np.array(list(of_rows)))
    if of_rows is not None:
        return ", ".join(f"{hz:.10g} Hz in {rows} rows" for hz, rows in of_rows.items())
    match frequencies_hz:
        case None:
            return "not stated"
        case [hz]:
            return f"{hz:.10g} Hz"
    return f"{min(frequencies_hz):.10g} to {max(frequencies_hz):.10g} Hz, {len(frequencies_hz)} subcarriers"


def _counts(values: NDArray[Any] | None) -> dict[Any, int] | None:
    """Number of rows of each value: of numbers in their order, of names in that in which they come first."""
    if values is None:
        return None
    return dict(Counter(np.sort(values).tolist() if values.dtype.kind == "f" else map(str, values)))


def _range(values: NDArray[Any] | None, received: NDArray[np.bool_]) -> list[float] | None:
    if values is None or not received.any():
        return None
    return [float(value) for value in np.percentile(values[received], [0, 50, 100])]


def _shown(values: list[float] | None, unit: str) -> str:
    return "not stated" if values is None else f"{values[0]:g} to {values[2]:g}{unit}, median {values[1]:g}{unit}"
