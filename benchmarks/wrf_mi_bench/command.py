"""What ``wrf-mi bench`` does."""

from __future__ import annotations

import argparse
from pathlib import Path

from wrf_mi.cli.output import print_json
from wrf_mi.core import InputError

TABLES = "tables"
"""Every method in one table for each task: not a case, but many, each stored by itself."""


def bench_command(a: argparse.Namespace) -> int:
    """Cases and checks, ratios, or tables."""
    _check_options(a)
    from wrf_mi.parallel import open_scheduler

    from .bench import CASES, CHECKS, REFUSED, BenchFailed, CheckRefused, bench, own_table

    if a.quick and TABLES not in a.names:
        return _quick(a)
    with open_scheduler(a.scheduler) as scheduler:
        given = scheduler if a.scheduler else None
        if TABLES in a.names:
            from .tables import tables

            most_s = None if a.hours is None else 3600 * a.hours
            rows = tables(Path(a.out), Path(a.runs), a.quick, given, most_s)
        else:
            try:
                rows = bench(a.names or [*CASES, *CHECKS], Path(a.out), Path(a.runs), given)
            except CheckRefused:  # said on standard error already
                return REFUSED
            for row in rows if not a.json else ():
                if row["case"] in CHECKS:
                    print(own_table(row))
    if a.json:
        print_json(rows)
    if failed := [f"bench {row['case']}: {why}" for row in rows if (why := row.get("figures", {}).get("failed"))]:
        raise BenchFailed("; ".join(failed))
    return 0


def _check_options(a: argparse.Namespace) -> None:
    """Refuse options that do not belong together."""
    alone = TABLES in a.names
    if alone and len(a.names) > 1:
        raise InputError("bench tables: measured by itself; leave the other names away")
    if a.hours is not None and not (alone and a.hours > 0):
        raise InputError("--hours: a positive number with tables; leave it away")
    if a.backend is not None and (alone or not a.quick):
        raise InputError("--backend: belongs to --quick; other cases use the one that `wrf-mi doctor` shows")
    if a.store and (alone or not a.quick):
        raise InputError("--store: belongs to --quick without names; cases and tables are stored in any case")
    if a.quick and a.scheduler and not alone:
        raise InputError("--quick: its pairs are interleaved in one process; leave --scheduler away")


def _quick(a: argparse.Namespace) -> int:
    """Few cases of the named checks, or ratios against the stored ones."""
    from .bench import check_table, quick_checks

    if a.names:
        if a.store:
            raise InputError(f"--store: a quick {a.names[0]} is not stored; leave --store away, or --quick")
        found = quick_checks(a.names)
        if a.json:
            print_json(found)
        else:
            print(check_table(found))
        return 0
    from .quick import quick

    result = quick(Path(a.out), a.store)
    if a.json:
        print_json(result)
    return 0
