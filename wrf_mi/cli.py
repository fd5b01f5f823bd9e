"""The command ``wrf-mi``. Exit status 0 on success, 1 on failure, 2 with one line on bad input, 130 when stopped."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from . import __version__
from .core import BackendError, InputError

Arguments = argparse.Namespace


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, default=str))


def _doctor(a: Arguments) -> int:
    from . import doctor

    if a.install_llvm:
        doctor.install_llvm()
    found = doctor.report()
    if a.json:
        _print_json(found)
    else:
        print(doctor.render(found))
    return 0 if found["ok"] else 1


def _data_list(a: Arguments) -> int:
    from .measure import datasets

    rows = [
        {
            "name": s.dataset.name,
            "task": s.dataset.task,
            "licence": s.dataset.licence,
            "origin": s.dataset.origin,
            "location": str(s.location) if s.location else None,
        }
        for s in datasets()
    ]
    if a.json:
        _print_json(rows)
        return 0
    for row in rows:
        print(f"{row['name']:<12} {row['task']:<9} {row['licence']:<5} {row['location'] or 'not here yet'}")
        print(f"{'':<12} {row['origin']}")
    return 0


def _data_fetch(a: Arguments) -> int:
    from .measure import fetch
    from .measure.registry import known
    from .trace import load_record

    made_here = known(a.name).base_url is None
    where = load_record(a.name, progress=True).source if made_here else fetch(a.name)
    print(f"{a.name}: {where}")
    return 0


def _train(a: Arguments) -> int:
    from .fit.config import PRESETS, TrainConfig, describe, with_settings
    from .report.runs import resume, train

    if a.help_settings:
        print(describe())
        return 0
    with _watch() as watch:
        if a.resume:
            given = (a.dataset, a.out, a.model, a.split, a.n_train, a.seed, a.preset)
            if any(value is not None for value in given) or a.set or a.deterministic:
                raise InputError("--resume RUN goes on with the settings of RUN: leave data set and settings away")
            folder = Path(a.resume)
            run = resume(folder, watch.listen, watch.stop)
        else:
            if not a.dataset or not a.out:
                raise InputError("train needs DATASET and --out RUN (or --resume RUN)")
            folder = Path(a.out)
            config = with_settings(TrainConfig(), PRESETS[a.preset or "default"])
            own = [f"{key}={value}" for key, value in (("model", a.model), ("seed", a.seed)) if value is not None]
            config = with_settings(config, [*own, *(["deterministic=true"] if a.deterministic else []), *a.set])
            run = train(
                a.dataset,
                folder,
                config,
                "official" if a.split is None else a.split,
                a.n_train,
                watch.listen,
                watch.stop,
            )
    return _show_metrics(run.metrics, folder, a.json)


def _evaluate(a: Arguments) -> int:
    from .report.runs import evaluate_run

    return _show_metrics(evaluate_run(a.run, a.split), None if a.split else Path(a.run), a.json)


def _show_metrics(metrics: dict[str, Any], folder: Path | None, as_json: bool) -> int:
    if as_json:
        _print_json(metrics)
        return 0
    own, blend = metrics["ssim"], metrics["reference"]["idw4"]
    print(f"{'SSIM on ' + str(metrics['n_test']) + ' test rows':<28}{'median':>8}{'mean':>8}{'p10':>8}{'p90':>8}")
    for name, block in ((metrics["model"], own), ("blend of 4 nearest (idw4)", blend)):
        print(f"{name:<28}" + "".join(f"{block[key]:8.3f}" for key in ("median", "mean", "p10", "p90")))
    print(
        f"split {metrics['split']}, {metrics['n_train']} training rows, trained {metrics['train_seconds']:.0f} s, "
        f"{metrics['ms_per_sample']:.1f} ms per spectrum, peak memory {metrics['peak_memory_mb']:.0f} MB"
    )
    if folder is not None:
        print(f"results: {folder}")
    return 0


def _predict(a: Arguments) -> int:
    from .report.runs import predict_to_file
    from .report.tx_file import read_tx_positions

    shapes = predict_to_file(a.run, read_tx_positions(a.tx, a.input), a.out)
    if a.json:
        _print_json({"out": str(a.out), "arrays": {key: list(shape) for key, shape in shapes.items()}})
    else:
        print(f"{shapes['tx_pos'][0]} spectra: {a.out}")
    return 0


def _compare(a: Arguments) -> int:
    from .report.compare import compare

    index = compare(a.runs, a.out)
    print(f"comparison: {index}")
    return 0


def _bench(a: Arguments) -> int:
    from .report.bench import CASES, bench

    rows = bench(a.names or list(CASES), Path(a.out), Path(a.runs))
    if a.json:
        _print_json(rows)
    return 0


def _demo(a: Arguments) -> int:
    from .report.demo import demo

    with _watch() as watch:
        run, index = demo(Path(a.out) if a.out else None, watch.listen, watch.stop)
    _show_metrics(run.metrics, run.folder, a.json)
    print(f"pictures: {index}", file=sys.stderr if a.json else sys.stdout)
    return 0


def _watch() -> Any:
    from .report.watch import Watch

    return Watch()


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="wrf-mi", description="Learned wireless radiation fields and ray tracing.")
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Any, text: str, json_output: bool = True, where: Any = commands) -> Any:
        sub = where.add_parser(name, help=text, description=text)
        sub.set_defaults(call=run)
        if json_output:
            sub.add_argument("--json", action="store_true", help="print figures as JSON")
        return sub

    sub = command("doctor", _doctor, "which backend, LLVM, GPU and data were found, and the remedy for what is missing")
    sub.add_argument("--install-llvm", action="store_true", help="install LLVM with the system's package manager first")

    data = commands.add_parser("data", help="known data sets: list, fetch").add_subparsers(
        required=True, metavar="COMMAND"
    )
    command("list", _data_list, "known data sets and where they lie", where=data)
    sub = command("fetch", _data_fetch, "download a data set, checked by SHA-256", json_output=False, where=data)
    sub.add_argument("name", metavar="NAME")

    sub = command("train", _train, "fit a field to measured spectra and score it")
    sub.add_argument(
        "dataset", nargs="?", metavar="DATASET", help="name of a data set (`wrf-mi data list`) or a folder"
    )
    sub.add_argument("--model", choices=("wrf-gs", "wrf-gs+"), help="default: wrf-gs+")
    sub.add_argument("--out", metavar="RUN", help="run folder to make")
    sub.add_argument(
        "--split", help="official (default), random, blocked (every fold in turn), blocked:K, or trajectory"
    )
    sub.add_argument("--n-train", type=_number, metavar="N", help="number or fraction of the training rows to use")
    sub.add_argument("--seed", type=int, metavar="N", help="default: 0")
    sub.add_argument("--deterministic", action="store_true", help="bit-identical results, on one thread")
    sub.add_argument("--preset", choices=("default", "paper", "quick"), help="a named set of settings")
    sub.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a setting; repeatable")
    sub.add_argument("--help-settings", action="store_true", help="list all settings with their defaults, and exit")
    sub.add_argument("--resume", metavar="RUN", help="go on with a run that was stopped")

    sub = command("evaluate", _evaluate, "score a run on its held-out rows")
    sub.add_argument("run", metavar="RUN")
    sub.add_argument("--split", help="score on another split's test rows that the run has not seen; writes nothing")

    sub = command("predict", _predict, "spectra at new transmitter positions")
    sub.add_argument("run", metavar="RUN")
    given = sub.add_mutually_exclusive_group(required=True)
    given.add_argument("--tx", metavar="FILE.csv", help="positions x, y, z in metres, with a header")
    given.add_argument("--input", metavar="FILE.npz", help="array tx_pos [m, 3] in metres")
    sub.add_argument("--out", required=True, metavar="FILE.npz")

    sub = command("compare", _compare, "table, SSIM distribution and pictures of several runs", json_output=False)
    sub.add_argument("runs", nargs="+", metavar="RUN")
    sub.add_argument("--out", required=True, metavar="DIR")

    sub = command("bench", _bench, "measure the README's figures; goes on where it was stopped")
    sub.add_argument("names", nargs="*", metavar="NAME", help="cases to measure (default: all)")
    sub.add_argument("--out", default="benchmarks/results", metavar="DIR", help="where results are written")
    sub.add_argument("--runs", default="runs/bench", metavar="DIR", help="where run folders are kept")

    sub = command("demo", _demo, "the main job on real spectra, or on a traced room where there are none")
    sub.add_argument("--out", metavar="RUN", help="run folder (default: a new one in runs/)")
    return parser


def _number(text: str) -> int | float:
    try:
        return int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no number") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command.

    Returns:
        The exit status.
    """
    a = _parser().parse_args(arguments)
    try:
        return a.call(a)
    except InputError as error:
        print(f"wrf-mi: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        # A file or folder that cannot be written, in nearly all cases one that was named on the command line.
        print(f"wrf-mi: {error}; choose another place", file=sys.stderr)
        return 2
    except BackendError as error:
        print(f"wrf-mi: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("wrf-mi: interrupted", file=sys.stderr)
        return 130
    except Exception as error:
        # Errors of ours that say all there is to say; anything else keeps its traceback.
        status = getattr(error, "exit_status", None)
        if status is None:
            raise
        print(f"wrf-mi: {error}", file=sys.stderr)
        return status


if __name__ == "__main__":
    sys.exit(main())
