"""Command ``wrf-mi bench``."""

from __future__ import annotations

import argparse
from pathlib import Path

from wrf_mi.cli.output import show
from wrf_mi.core import InputError

TABLES = "tables"  # name of the tables of all methods, which are neither a case nor a check


def bench_command(a: argparse.Namespace) -> int:
    """Measure cases and checks, ratios, or tables; returns the exit status."""
    tables_only = TABLES in a.names
    for refused, message in (
        (tables_only and len(a.names) > 1, "bench tables: measured by itself; omit the other names"),
        (a.hours is not None and not (tables_only and a.hours > 0), "--hours: a positive number with tables; omit it"),
        (
            a.backend is not None and (tables_only or not a.quick),
            "--backend: belongs to --quick; other cases use the one that `wrf-mi doctor` shows",
        ),
        (
            a.store and (tables_only or not a.quick),
            "--store: belongs to --quick without names; cases and tables are stored in any case",
        ),
        (
            a.quick and a.scheduler and not tables_only,
            "--quick: its pairs are interleaved in one process; omit --scheduler",
        ),
        (
            a.store and a.quick and a.names,
            f"--store: a quick {' '.join(a.names)} is not stored; omit --store, or --quick",
        ),
        (
            a.stale and bool(a.names or a.quick or a.store or a.scheduler),
            "--stale: lists all results and measures none; omit names, --quick, --store and --scheduler",
        ),
    ):
        if refused:
            raise InputError(message)
    if a.stale:
        from .stale import stale, stale_lines

        older, count = stale(Path(a.out))
        show(a.json, older, stale_lines(older, count))
        return 0
    from wrf_mi.parallel import open_scheduler

    from .bench import CHECKS, REFUSED, BenchFailed, CheckRefused, all_here, bench, check_table, own_table, quick_checks

    if a.quick and not tables_only:
        if a.names:
            found = quick_checks(a.names)
            show(a.json, found, check_table(found))
            return 0
        from .quick import quick, ratio_table

        result = quick(Path(a.out), a.store)
        show(a.json, result, ratio_table(result["figures"]["ratios"]))
        return 0
    with open_scheduler(a.scheduler) as scheduler:
        given = scheduler if a.scheduler else None
        if tables_only:
            from .tables import tables

            most_s = None if a.hours is None else 3600 * a.hours
            rows = tables(Path(a.out), Path(a.runs), a.quick, given, most_s)
        else:
            try:
                rows = bench(a.names or all_here(), Path(a.out), Path(a.runs), given)
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
