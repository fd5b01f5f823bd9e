"""Command ``wrf-mi bench``."""

import argparse
from dataclasses import asdict
from pathlib import Path

from wrf_mi.apps.commands.output import show
from wrf_mi.core import InputError

TABLES = "tables"  # name of the tables of all methods, which are neither a case nor a check


def bench_command(a: argparse.Namespace) -> int:
    """Measure cases and checks, ratios, or tables; returns the exit status."""
    _check(a)
    if a.stale:
        from .stale import stale, stale_lines

        older, count = stale(Path(a.out))
        show(a.json, older, stale_lines(older, count))
        return 0
    return _quick(a) if a.quick and TABLES not in a.names else _measure(a)


def _quick(a: argparse.Namespace) -> int:
    from .bench import check_table, quick_checks

    if a.names:
        checks = quick_checks(a.names)
        return show(a.json, checks, check_table(checks))
    from .quick import quick, ratio_table

    result = quick(Path(a.out), a.store)
    return show(a.json, result, ratio_table(result["figures"]["ratios"]))


def _measure(a: argparse.Namespace) -> int:
    from wrf_mi.parallel import open_scheduler

    from .bench import CHECKS, REFUSED, BenchFailed, CheckRefused, all_here, bench, own_table
    from .entries import OF, write_entries

    with open_scheduler(a.scheduler) as scheduler:
        workers = scheduler if a.scheduler else None
        if TABLES in a.names:
            from .tables import FOLDER, tables

            most_s = None if a.hours is None else 3600 * a.hours
            place = Path(a.out).parent / (f"{FOLDER}-quick" if a.quick else FOLDER)
            rows = [asdict(entry) for entry in tables(place, Path(a.runs), a.quick, workers, most_s).values()]
        else:
            try:
                rows = bench(a.names or all_here(), Path(a.out), Path(a.runs), workers)
                if OF & {row["case"] for row in rows}:
                    write_entries(Path(a.out))
            except CheckRefused:  # printed on standard error by the check
                return REFUSED
            for row in rows if not a.json else ():
                if row["case"] in CHECKS:
                    print(own_table(row))
    if a.json:
        show(a.json, rows, "")
    if failed := [f"bench {row['case']}: {why}" for row in rows if (why := row.get("figures", {}).get("failed"))]:
        raise BenchFailed("; ".join(failed))
    return 0


def _check(a: argparse.Namespace) -> None:
    """Refuse options that do not belong together."""
    tables, quick = TABLES in a.names, a.quick and TABLES not in a.names
    others = a.names or a.quick or a.store or a.scheduler
    for refused, message in (
        (tables and len(a.names) > 1, "bench tables: measured by itself; omit the other names"),
        (a.hours is not None and not (tables and a.hours > 0), "--hours: a positive number with tables; omit it"),
        (a.backend and not quick, "--backend: belongs to --quick; other cases use the one that `wrf-mi doctor` shows"),
        (a.store and not quick, "--store: belongs to --quick without names; cases and tables are stored in any case"),
        (quick and a.scheduler, "--quick: its pairs are interleaved in one process; omit --scheduler"),
        (a.store and quick and a.names, f"--store: a quick {' '.join(a.names)} is not stored; omit it, or --quick"),
        (a.stale and others, "--stale: lists results and measures none; omit names, --quick, --store and --scheduler"),
    ):
        if refused:
            raise InputError(message)
