"""``wrf-mi train``, ``trace`` and ``sweep``."""

from __future__ import annotations

import json
import sys
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...backend import init
from ...core import InputError
from ...core.yaml_files import read_yaml
from .options import (
    DATASET,
    SCENE,
    Arguments,
    Parser,
    add_command,
    add_replace,
    add_rows,
    add_run,
    add_scheduler,
    add_tracing,
    add_training,
    antenna_options,
    refuse,
    stated,
)
from .output import Watch, show, show_metrics

if TYPE_CHECKING:
    from ...runs.folder import RunRequest

HYBRID, RAY_TRACING = "hybrid", "ray-tracing"
TRACING = ("paths", "depth", "reflections", "rays", "phase_error", "calibrate")
"""Options that become settings of the ray tracer."""
BESIDE_RESUME = ("resume", "json", "help_settings", "call")  # arguments that ``--resume`` does not refuse


def add_parser(commands: Any) -> None:
    """Add ``train``, ``trace`` and ``sweep`` to the commands."""
    for add in (_add_train, _add_trace, _add_sweep):
        add(commands)


def _add_train(commands: Any) -> None:
    parser = add_command(commands, "train", train_command, "fit a model to measurements and score it")
    add_training(parser)
    parser.add_argument("--out", metavar="RUN", help="run folder to make")
    add_replace(parser)
    text = "CSV of positions (x,y,z, metres) where predictions are wanted: training rows as far from the others choose"
    parser.add_argument("--for", dest="wanted", metavar="FILE", help=f"{text} (of rssi; default: as the test rows)")
    parser.add_argument("--help-settings", action="store_true", help="list all settings with their defaults, and exit")
    parser.add_argument("--resume", metavar="RUN", help="run folder of a stopped run to go on with")


def train_command(a: Arguments) -> int:
    """Fit any model, or continue a stopped fit."""
    if a.help_settings:
        return _show_settings()
    if a.resume:
        if stated(a, (name for name in vars(a) if name not in BESIDE_RESUME)):
            raise InputError("--resume RUN goes on with the settings of RUN: omit data set and settings")
        return _resume(a)
    if not a.dataset or not a.out:
        raise InputError("train needs DATASET and --out RUN (or --resume RUN)")
    if a.deterministic:
        init("llvm", threads=1)
    return run_training(a)


def run_training(a: Arguments, **more: Any) -> int:
    """Call `wrf_mi.train` with the arguments of the command line and ``more``, and print the scores."""
    request = training_request(a)
    from ...runs.api import train

    with Watch(run=a.out) as watch:
        session: dict[str, Any] = {"on_progress": watch.on_progress, "stop": watch.stop, **more}
        run = train(a.dataset, out=a.out, overwrite=a.replace, **vars(request), **session, progress=sys.stderr.isatty())
    return show_metrics(run.metrics, run.folder, a.json)


def _resume(a: Arguments) -> int:
    with suppress(InputError):  # `read_config`, which chooses a backend, reports the error
        if read_yaml(Path(a.resume) / "config.yaml").get("deterministic"):
            init("llvm", threads=1)
    from ...runs.api import resume

    with Watch(run=a.resume) as watch:
        run = resume(a.resume, watch.on_progress, watch.stop, progress=sys.stderr.isatty())
    return show_metrics(run.metrics, run.folder, a.json)


def training_request(a: Arguments) -> RunRequest:
    """What the arguments of the command line ask to fit; `InputError`: options that do not belong together."""
    from ...runs.folder import RunRequest

    model = a.model or HYBRID
    settings = [*_tracing_settings(a, model), *_stages(a, model), *a.set]
    names = ("scene", "material", "evaluation", "n_train", "min_rows", "deterministic", "intervals", "preset", "split")
    request = {name: getattr(a, name) for name in names} | {"receiver": a.receiver_model, "seed": a.seed or 0}
    request["wanted"] = getattr(a, "wanted", None)  # an option of train alone
    return RunRequest(model, settings=settings, antennas=antenna_options(a), **request)


def _stages(a: Arguments, model: str) -> list[str]:
    """Setting of ``--stages``, which trace does not have."""
    if model != HYBRID:
        refuse(a, ("stages",), f"belongs to --model {HYBRID}, not to {model}")
    return [f"stages={a.stages}"] if stated(a, ("stages",)) else []


def _tracing_settings(a: Arguments, model: str) -> list[str]:
    from ...tracing.options import stated_kinds

    if model != RAY_TRACING:
        refuse(a, TRACING, f"belongs to --model {RAY_TRACING}, not to {model}")
        return []
    # Trained paths are searched with the default seed; --seed is that of training and split.
    seed = None if a.calibrate is not None else a.seed
    kinds = {} if a.paths is None else stated_kinds(a.paths)
    traced = {"depth": a.depth, "reflections": a.reflections, "rays": _rays(a.rays), "seed": seed}
    traced |= {"phase_error": a.phase_error, **kinds}
    if (target := getattr(a, "target_error", None)) is not None:  # an option of trace
        traced |= _target_settings(a, target, kinds)
    traced["calibration"] = a.calibrate
    return [f"{key}={json.dumps(value)}" for key, value in traced.items() if value is not None]


def _rays(text: str | None) -> int | str | None:
    if text in (None, "auto"):
        return text
    if not text.isdecimal():
        raise InputError(f'rays {text!r}: give a whole number, or "auto"')
    return int(text)


def _target_settings(a: Arguments, target_db: float, kinds: dict[str, bool]) -> dict[str, Any]:
    """Settings of ``--target-error``: a kind in ``--paths`` is permitted, and switched on where it contributes."""
    from ...tracing.convergence import CHOSEN_KINDS

    refuse(a, ("depth", "rays"), "is chosen by --target-error")
    permitted = ",".join(kind for kind in CHOSEN_KINDS if kinds.get(kind, not kinds))
    return {**dict.fromkeys(CHOSEN_KINDS, False), "target_error_db": target_db, "target_kinds": permitted}


def _show_settings() -> int:
    from ...core.settings import describe
    from ...models import MODELS

    names: dict[type, list[str]] = {}
    for name, model in MODELS.items():
        for data, kind in model.settings_by_data().items():
            names.setdefault(kind, []).append(f"{name}, {data}" if data else name)
    print("\n".join(f"{'; '.join(labels)}:\n{describe(kind())}\n" for kind, labels in names.items()))
    return 0


def _add_trace(commands: Any) -> None:
    text = "predict by ray tracing and score it like a learned field"
    parser = add_command(commands, "trace", trace_command, text)
    parser.set_defaults(model=RAY_TRACING, receiver_model=None, evaluation=None, preset=None)
    add = parser.add_argument
    add("dataset", metavar="DATASET", help=DATASET)
    add("--scene", required=True, metavar="SCENE", help=SCENE)
    add("--out", metavar="RUN", required=True, help="run folder to make")
    add_replace(parser)
    add_tracing(parser)
    target = "choose depth, rays, diffraction and scattering until power and spectra are converged to DB decibels"
    add("--target-error", type=float, metavar="DB", help=target)
    text = "write the traced paths as a scenario of DeepMIMO, which deepmimo.load opens (docs/data.md)"
    add("--deepmimo", metavar="FOLDER", help=text)
    add_rows(parser)
    add_run(parser)
    add_scheduler(parser)


def trace_command(a: Arguments) -> int:
    """Predict by ray tracing alone."""
    from ...parallel import open_scheduler

    training_request(a)  # refused before workers start
    if a.deterministic:
        init("llvm", threads=1)
    if a.calibrate is not None:
        text = "has no effect beside --calibrate, which trains in one process and stores no paths"
        refuse(a, ("scheduler", "deepmimo"), text)
    if a.deepmimo is not None:
        from ...tracing.deepmimo import check_deepmimo_folder

        check_deepmimo_folder(a.deepmimo, a.replace)
    with open_scheduler(a.scheduler) as scheduler:
        status = run_training(a, scheduler=scheduler if a.scheduler else None)
    if a.deepmimo is not None:
        from ...estimators.ray_tracing import PATHS
        from ...tracing import load_trace, write_deepmimo

        write_deepmimo(a.deepmimo, load_trace(Path(a.out) / PATHS), a.replace)
    return status


def _add_sweep(commands: Any) -> None:
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
    from ...parallel import open_scheduler
    from ...runs.sweep import check_failures, check_run, plan_sweep, run_sweep, sweep_table

    # Read off the parser, so that no option of train is left out.
    common = {name: getattr(a, name.replace("-", "_")) for name in training_names()}
    settings = common.pop("set")
    options = {name: str(value) for name, value in common.items() if value is not None and not isinstance(value, bool)}
    flags = [f"--{name}" for name, value in common.items() if value is True]
    sweep = plan_sweep(a.out, a.vary, options, settings, flags)
    parser = Parser(prog="wrf-mi")
    _add_train(parser.add_subparsers())
    for run in sweep.runs:
        single = parser.parse_args([*run.arguments, "--out", str(run.folder)])
        if not single.dataset:
            raise InputError("sweep needs DATASET")
        check_run(single.dataset, training_request(single))
    with open_scheduler(a.scheduler) as scheduler:
        rows = run_sweep(sweep, scheduler)
    show(a.json, rows, f"{sweep_table(rows, sweep.varied)}\nresults: {a.out}")
    check_failures(rows)
    return 0
