"""What ``wrf-mi train``, ``trace`` and ``sweep`` do, and how the command shows figures."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from ..backend import init
from ..core import AntennaOptions, InputError

Arguments = argparse.Namespace

RAY_TRACING = "ray-tracing"


def train_command(a: Arguments) -> int:
    """``train``: any model."""
    if a.help_settings:
        print(_settings_text())
        return 0
    if a.resume:
        names = ("dataset", "out", "model", "split", "n_train", "seed", "preset", "scene", "material", "receiver")
        given = (*(getattr(a, name) for name in names), a.evaluation, *_traced(a))
        if any(value is not None for value in given) or _antennas(a) or a.set or a.deterministic:
            raise InputError("--resume RUN goes on with the settings of RUN: leave data set and settings away")
        return _resume(a)
    if not a.dataset or not a.out:
        raise InputError("train needs DATASET and --out RUN (or --resume RUN)")
    if a.deterministic:
        init("llvm", threads=1)
    return _train(a, _arguments(a))


def trace_command(a: Arguments) -> int:
    """``trace``: what ray tracing alone predicts."""
    from ..parallel import open_scheduler

    a.model, a.receiver, a.evaluation, a.preset = RAY_TRACING, None, None, None
    a.set, a.deterministic = [], False
    asked = _arguments(a)
    with open_scheduler(a.scheduler) as scheduler:
        return _train(a, asked | {"scheduler": scheduler if a.scheduler else None})


def _train(a: Arguments, asked: dict[str, Any]) -> int:
    from ..runs.api import train

    with progress_bar() as watch:
        asked |= {"on_progress": watch.on_progress, "stop": watch.stop, "progress": sys.stderr.isatty()}
        run = train(a.dataset, a.out, **asked)
    return show_metrics(run.metrics, run.folder, a.json)


def _resume(a: Arguments) -> int:
    if _states_determinism(Path(a.resume)):
        init("llvm", threads=1)
    from ..runs.api import resume

    with progress_bar() as watch:
        run = resume(a.resume, watch.on_progress, watch.stop, progress=sys.stderr.isatty())
    return show_metrics(run.metrics, run.folder, a.json)


def _states_determinism(folder: Path) -> bool:
    """Whether a run's settings ask for it; plain YAML, as all else that reads a run chooses a backend first."""
    try:
        return bool(yaml.safe_load((folder / "config.yaml").read_text())["deterministic"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return False  # what is wrong with it is said where it is read


def _traced(a: Arguments) -> tuple[Any, ...]:
    return a.paths, a.depth, a.reflections, a.rays, a.calibrate


def _antennas(a: Arguments) -> AntennaOptions:
    return AntennaOptions(**{one.name: getattr(a, one.name) for one in fields(AntennaOptions)})


def _arguments(a: Arguments) -> dict[str, Any]:
    """Arguments of `wrf_mi.train` beside data set and folder.

    Raises:
        InputError: options that do not belong together.
    """
    name = a.model or "wrf-gs+"
    settings = [*a.set]
    if name == RAY_TRACING:
        settings = [*_tracing_settings(a), *settings]
    elif any(value is not None for value in _traced(a)):
        raise InputError(f"--paths, --depth, --reflections, --rays and --calibrate belong to --model {RAY_TRACING}")
    if a.preset is not None:
        settings = [*_preset(a, name), *settings]
    place = {"scene": a.scene, "material": a.material, "antennas": _antennas(a), "receiver": a.receiver}
    rows = {"split": "official" if a.split is None else a.split, "n_train": a.n_train, "seed": a.seed or 0}
    rows["evaluation"] = a.evaluation
    return {"model": name, "settings": settings, "deterministic": a.deterministic, **place, **rows}


def _preset(a: Arguments, name: str) -> tuple[str, ...]:
    from ..datasets.registry import stated_task
    from ..models import known_model

    # What is neither a path nor known is refused where it is read.
    presets = known_model(name).serving(stated_task(a.dataset) or "spectrum", a.scene is not None).presets
    if a.preset not in presets:
        raise InputError(f"{name} on {a.dataset}: takes no preset, which belongs to fields of spectra; use --set")
    return presets[a.preset]


def _tracing_settings(a: Arguments) -> list[str]:
    """Settings of the ray tracer that the options state."""
    from ..tracing.convergence import CHOSEN_KINDS
    from ..tracing.options import DEFAULTS, KINDS, with_kinds

    target = getattr(a, "target_error", None)  # train has none
    for name, given in (("--depth", a.depth), ("--rays", a.rays)):
        if target is not None and given is not None:
            raise InputError(f"trace: --target-error chooses what {name} states; give one of them")
    # Where paths are trained, the seed is the training's and that of the rows; they are searched with the default one.
    seed = None if a.calibrate is not None else a.seed
    numbers = {"max_depth": a.depth, "max_reflections": a.reflections, "rays": a.rays, "seed": seed}
    options = with_kinds(DEFAULTS, a.paths, **numbers)
    stated: dict[str, Any] = {key: getattr(options, key) for key, given in numbers.items() if given is not None}
    if a.paths is not None:
        stated |= {kind: getattr(options, kind) for kind in (kind.replace("-", "_") for kind in KINDS)}
    if target is not None:
        # What --paths names may be switched on; it is where it counts.
        kinds = [kind for kind in CHOSEN_KINDS if a.paths is None or stated[kind]]
        stated |= {**dict.fromkeys(CHOSEN_KINDS, False), "target_error_db": target, "target_kinds": ",".join(kinds)}
    if a.calibrate is not None:
        stated["calibration"] = a.calibrate
    return [f"{key}={json.dumps(value)}" for key, value in stated.items()]


def _settings_text() -> str:
    from ..core.settings import describe
    from ..models import MODELS

    found: dict[type, list[str]] = {}
    for name, model in MODELS.items():
        for what, kind in model.settings.items() if isinstance(model.settings, Mapping) else (("", model.settings),):
            found.setdefault(kind, []).append(f"{name}, {what}" if what else name)
    return "\n".join(f"{'; '.join(names)}:\n{describe(kind())}\n" for kind, names in found.items())


def sweep_command(a: Arguments, parse: Callable[[list[str]], Arguments]) -> int:
    """``sweep``: a run of ``train`` for each combination; ``parse`` reads the arguments of a call of the command."""
    from ..parallel import open_scheduler
    from ..runs.sweep import OPTIONS, check_failures, check_run, plan_sweep, run_sweep, sweep_table

    given = {key: getattr(a, key.replace("-", "_")) for key in OPTIONS}
    options = {key: str(value) for key, value in given.items() if value is not None}
    sweep = plan_sweep(a.out, a.vary, options, a.set, ["--deterministic"] if a.deterministic else [])
    for run in sweep.runs:
        one = parse([*run.arguments, "--out", str(run.folder)])
        if not one.dataset:
            raise InputError("sweep needs DATASET")
        check_run(one.dataset, _arguments(one))
    with open_scheduler(a.scheduler) as scheduler:
        rows = run_sweep(sweep, scheduler)
    if a.json:
        print_json(rows)
    else:
        print(sweep_table(rows, sweep.varied))
        print(f"results: {a.out}")
    check_failures(rows)
    return 0


def show_metrics(metrics: dict[str, Any], folder: Path | None, as_json: bool) -> int:
    """Print the content of ``metrics.json`` as a table or as JSON, and where the run lies."""
    if as_json:
        print_json(metrics)
        return 0
    from ..tasks import TASKS

    task = TASKS[metrics["task"]]
    title = f"{task.label} on {metrics['n_test']} test rows"
    print(f"{title:<36}{'median':>8}{'mean':>8}{'p10':>8}{'p90':>8}")
    held = metrics["reference"]
    named = [(metrics["model"], metrics[task.block])]
    named += [(f"{words} ({key})", held[key]) for key, words in task.references.items() if key in held]
    for name, block in named:
        print(f"{name:<36}" + "".join(f"{block[key]:8.3f}" for key in ("median", "mean", "p10", "p90")))
    if metrics.get("n_not_scored"):
        print(f"{metrics['n_not_scored']} observations of test rows are not finite and not scored")
    if "inside_90" in metrics:
        print(f"{metrics['inside_90']:.0%} of the test values lie inside the predicted 90 % intervals")
    print(
        f"split {metrics['split']}, {metrics['n_train']} training rows, trained {metrics['train_seconds']:.0f} s, "
        f"{metrics['ms_per_sample']:.2g} ms per sample, peak memory {metrics['peak_memory_mb']:.0f} MB"
    )
    if folder is not None:
        print(f"results: {folder}")
    return 0


def print_json(value: Any) -> None:
    """Figures for programs."""
    print(json.dumps(value, indent=1, default=str))


def progress_bar() -> Any:
    """A `wrf_mi.runs.watch.Watch`, imported when it is needed."""
    from ..runs.watch import Watch

    return Watch()
