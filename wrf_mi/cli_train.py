"""What ``wrf-mi train``, ``trace`` and ``sweep`` do, and how the command shows figures."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from .backend import init
from .baselines.models import METHODS
from .core import AntennaOptions, InputError

Arguments = argparse.Namespace


def train_command(a: Arguments) -> int:
    """``train``: a field, a hybrid, a baseline, or a traced run."""
    if a.help_settings:
        print(_settings_text())
        return 0
    if a.resume:
        given = (
            a.dataset,
            a.out,
            a.model,
            a.split,
            a.n_train,
            a.seed,
            a.preset,
            a.scene,
            a.material,
            a.receiver,
            *_traced(a),
        )
        if any(value is not None for value in given) or _antennas(a) or a.set or a.deterministic:
            raise InputError("--resume RUN goes on with the settings of RUN: leave data set and settings away")
        return _resume(a)
    _check_options(a)
    if a.deterministic:
        init("llvm", threads=1)
    if a.model == "ray-tracing":
        return trace_command(a)
    if (baseline := _baseline(a)) is not None:
        return _train_baseline(a, baseline)
    return _train_hybrid(a) if a.model == "hybrid" else _train_field(a)


def _traced(a: Arguments) -> tuple[Any, ...]:
    return a.paths, a.depth, a.reflections, a.rays, a.calibrate


def _refuse_receiver(a: Arguments, model: str) -> None:
    if a.receiver is not None:
        raise InputError(f"--receiver belongs to fields of spectra (wrf-gs, wrf-gs+, factorised), not to {model}")


def _antennas(a: Arguments) -> AntennaOptions:
    return AntennaOptions(**{one.name: getattr(a, one.name) for one in fields(AntennaOptions)})


def _baseline(a: Arguments) -> str | None:
    """Name of the baseline that is to be trained."""
    return a.model if a.model in METHODS else None


def _check_options(a: Arguments) -> None:
    """Refuse options of ``train`` that do not belong together."""
    if a.model == "ray-tracing":
        _refuse_receiver(a, a.model)
        if not (a.scene and a.dataset and a.out) or a.set or a.preset:
            raise InputError("train --model ray-tracing needs DATASET, --scene SCENE and --out RUN, and no settings")
        return
    if a.model == "hybrid":
        _refuse_receiver(a, a.model)
        if any(value is not None for value in (*_traced(a), a.preset)):
            other = "--scene, --material, --split, --n-train, --seed and --set, and antenna options"
            raise InputError(f"train --model hybrid takes {other}")
    elif (baseline := _baseline(a)) is not None:
        _refuse_receiver(a, baseline)
        if any(value is not None for value in (a.scene, a.material, a.preset, *_traced(a))) or _antennas(a):
            other = "a scene belongs to --model ray-tracing or hybrid, a preset to fields of spectra"
            raise InputError(f"{baseline} on {a.dataset}: takes --split, --n-train, --seed and --set; {other}")
    elif any(value is not None for value in _traced(a)):
        raise InputError("--paths, --depth, --reflections, --rays and --calibrate belong to --model ray-tracing")
    elif a.scene is None and (a.material is not None or _antennas(a)):
        raise InputError("--material and antenna options belong to a scene that is traced; give --scene")
    if not a.dataset or not a.out:
        raise InputError("train needs DATASET and --out RUN (or --resume RUN)")


def _resume(a: Arguments) -> int:
    if _states_determinism(Path(a.resume)):
        init("llvm", threads=1)
    from .report.baseline_run import is_baseline, resume_baseline
    from .report.hybrid_run import is_hybrid, resume_hybrid
    from .report.runs import resume
    from .report.traced import is_traced
    from .report.watch import Stages

    folder = Path(a.resume)
    if is_traced(folder):
        raise InputError(f"{folder}: ray tracing has nothing to go on from; start it anew in another folder")
    if is_hybrid(folder) or is_baseline(folder):
        go_on = resume_hybrid if is_hybrid(folder) else resume_baseline
        with Stages() as stages:
            go_on(folder, stages.listen)
        return _show_stored(folder, a.json)
    with progress_bar() as watch:
        run = resume(folder, watch.listen, watch.stop)
    return show_metrics(run.metrics, folder, a.json)


def _states_determinism(folder: Path) -> bool:
    """Whether a run's settings ask for it; plain YAML, as all else that reads a run chooses a backend first."""
    try:
        content = yaml.safe_load((folder / "config.yaml").read_text())
        # Models that are fitted in one go say it beside their settings.
        return bool(content["deterministic"] if "deterministic" in content else content["settings"]["deterministic"])
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError):
        return False  # what is wrong with it is said where it is read


def _train_field(a: Arguments) -> int:
    from .report.runs import train

    with progress_bar() as watch:
        place = {"scene": a.scene, "material": a.material, "antennas": _antennas(a)}
        asked = a.dataset, a.out, _field_config(a), _split(a), a.n_train
        run = train(*asked, watch.listen, watch.stop, **place)
    return show_metrics(run.metrics, Path(a.out), a.json)


def _field_config(a: Arguments) -> Any:
    from .fit.config import PRESETS, default_config, with_settings
    from .measure.registry import stated_task

    # What is neither a path nor known is refused where it is read.
    begun = default_config(stated_task(a.dataset) or "")
    config: Any = with_settings(begun, PRESETS[a.preset or "default"])
    named = (("model", a.model), ("seed", a.seed), ("receiver", a.receiver))
    own = [f"{key}={value}" for key, value in named if value is not None]
    return with_settings(config, [*own, *(["deterministic=true"] if a.deterministic else []), *a.set])


def _train_hybrid(a: Arguments) -> int:
    from .report.hybrid_run import train_hybrid
    from .report.watch import Stages

    with Stages() as stages:
        own = {"material": a.material, "antennas": _antennas(a), **_fitted(a)}
        folder = train_hybrid(a.dataset, a.out, a.scene, **own, listen=stages.listen)
    return _show_stored(folder, a.json)


def _train_baseline(a: Arguments, model: str) -> int:
    from .report.baseline_run import train_baseline
    from .report.watch import Stages

    with Stages() as stages:
        folder = train_baseline(a.dataset, a.out, model, **_fitted(a), listen=stages.listen)
    return _show_stored(folder, a.json)


def _fitted(a: Arguments) -> dict[str, Any]:
    """What models that are fitted in one go take alike."""
    return {
        "split": _split(a),
        "n_train": a.n_train,
        "seed": a.seed or 0,
        "settings": tuple(a.set),
        "deterministic": a.deterministic,
    }


def _split(a: Arguments) -> str:
    return "official" if a.split is None else a.split


def _settings_text() -> str:
    from .fit.config import describe
    from .hybrid.models import settings_of_hybrids
    from .report.baseline_run import settings_of_baselines

    parts = ["wrf-gs, wrf-gs+, factorised:", describe()]
    for name, settings in settings_of_hybrids().items():
        parts += [f"\nhybrid, {name}:", describe(settings)]
    for name, settings in settings_of_baselines().items():
        parts += [f"\n{name}:", describe(settings)]
    return "\n".join(parts)


def trace_command(a: Arguments) -> int:
    """``trace``: what ray tracing alone predicts."""
    from .parallel import open_scheduler
    from .report.traced import trace_run
    from .trace.target import CHOSEN_KINDS

    options = _trace_options(a)
    target = getattr(a, "target_error", None)  # train has none
    for name, given in (("--depth", a.depth), ("--rays", a.rays)):
        if target is not None and given is not None:
            raise InputError(f"trace: --target-error chooses what {name} states; give one of them")
    kinds = CHOSEN_KINDS if a.paths is None else [kind for kind in CHOSEN_KINDS if getattr(options, kind)]
    if target is not None:
        # What --paths names may be switched on; it is where it counts.
        options = replace(options, **dict.fromkeys(CHOSEN_KINDS, False))
    asked = {"material": a.material, "split": _split(a), "n_train": a.n_train, "seed": a.seed or 0}
    call = partial(trace_run, a.scene, a.dataset, a.out, options, **asked, calibration=a.calibrate)
    call = partial(call, antennas=_antennas(a), target_error_db=target, kinds=kinds)
    where = getattr(a, "scheduler", None)  # train has none
    with open_scheduler(where) as scheduler:
        folder = call(progress=sys.stderr.isatty(), scheduler=scheduler if where else None)
    return _show_stored(folder, a.json)


def _trace_options(a: Arguments) -> Any:
    from .trace.options import DEFAULTS, with_kinds

    numbers = {"max_depth": a.depth, "max_reflections": a.reflections, "rays": a.rays, "seed": a.seed}
    return with_kinds(DEFAULTS, a.paths, **numbers)


def sweep_command(a: Arguments, parse: Callable[[list[str]], Arguments]) -> int:
    """``sweep``: a run of ``train`` for each combination; ``parse`` reads the arguments of a call of the command."""
    from .parallel import open_scheduler
    from .report.sweep import OPTIONS, check_baseline_run, check_failures, check_fit, plan_sweep, run_sweep, sweep_table

    given = {key: getattr(a, key.replace("-", "_")) for key in OPTIONS}
    options = {key: str(value) for key, value in given.items() if value is not None}
    sweep = plan_sweep(a.out, a.vary, options, a.set, ["--deterministic"] if a.deterministic else [])
    for run in sweep.runs:
        one = parse([*run.arguments, "--out", str(run.folder)])
        _check_options(one)
        if (baseline := _baseline(one)) is not None:
            check_baseline_run(baseline, one.dataset, (_split(one), one.seed or 0, one.n_train), tuple(one.set))
            continue
        traced, field = one.model == "ray-tracing", one.model not in ("ray-tracing", "hybrid")
        settings: Any = _field_config(one) if field else _trace_options(one) if traced else tuple(one.set)
        drawn = settings.seed if field else one.seed or 0
        check_fit(one.dataset, settings, one.scene, one.material, (_split(one), drawn, one.n_train), one.calibrate)
    with open_scheduler(a.scheduler) as scheduler:
        rows = run_sweep(sweep, scheduler)
    if a.json:
        print_json(rows)
    else:
        print(sweep_table(rows, sweep.varied))
        print(f"results: {a.out}")
    check_failures(rows)
    return 0


def _show_stored(folder: Path, as_json: bool) -> int:
    return show_metrics(json.loads((folder / "metrics.json").read_text()), folder, as_json)


def show_metrics(metrics: dict[str, Any], folder: Path | None, as_json: bool) -> int:
    """Print the content of ``metrics.json`` as a table or as JSON, and where the run lies."""
    if as_json:
        print_json(metrics)
        return 0
    from .tasks import TASKS

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
    """A `wrf_mi.report.watch.Watch`, imported when it is needed."""
    from .report.watch import Watch

    return Watch()
