"""``wrf-mi bench``."""

from __future__ import annotations

from typing import Any

from ...backend import init
from ...core.registry import resolve
from .options import Arguments, add_command, add_scheduler


def add_parser(commands: Any) -> None:
    """Add ``bench`` to the commands."""
    text = "measure the stored figures; a stopped measurement goes on"
    parser = add_command(commands, "bench", bench_command, text)
    add = parser.add_argument
    add("names", nargs="*", metavar="NAME", help="cases to measure (default: all), or tables")
    add("--out", default="benchmarks/results", metavar="DIR", help="folder of results")
    add("--runs", default="runs/bench", metavar="DIR", help="folder of run folders")
    text = "backend, with --quick (default: CUDA where it works, else LLVM)"
    add("--backend", choices=("llvm", "cuda"), help=text)
    add_scheduler(parser)
    text = "ratios of interleaved pairs in a minute, fails if one is clearly above twice the stored one; with NAME "
    text += "stress a few of its cases, fails if a bound is exceeded; with tables a small version in ten minutes"
    add("--quick", action="store_true", help=text)
    add("--store", action="store_true", help="store the ratios, with --quick")
    text = "list the results that are older than their source, with the command that measures each anew"
    add("--stale", action="store_true", help=text)
    text = "hours after which no row is begun, with tables; the next call goes on (default: measure all)"
    add("--hours", type=float, metavar="H", help=text)


def bench_command(a: Arguments) -> int:
    """Call the package of benchmarks, whose import starts the backend."""
    if a.backend is not None:
        init(a.backend)
    status: int = resolve("wrf_mi_bench.command:bench_command")(a)
    return status
