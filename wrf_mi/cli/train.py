"""``wrf-mi train``."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..backend import init
from ..core import AntennaOptions, InputError
from ..core.yaml_files import read_yaml
from .options import Arguments, add_command, add_training
from .output import Watch, show_metrics

HYBRID, RAY_TRACING = "hybrid", "ray-tracing"
TRACING = ("paths", "depth", "reflections", "rays", "phase_error", "calibrate")
"""Options that become settings of the ray tracer."""
BESIDE_RESUME = ("resume", "json", "help_settings", "call")
"""Arguments that ``--resume`` does not refuse."""


def add_parser(commands: Any) -> None:
    """Add ``train`` to the commands."""
    parser = add_command(commands, "train", train_command, "fit a model to measurements and score it")
    add_training(parser)
    parser.add_argument("--out", metavar="RUN", help="run folder to make")
    parser.add_argument("--help-settings", action="store_true", help="list all settings with their defaults, and exit")
    parser.add_argument("--resume", metavar="RUN", help="run folder of a stopped run to go on with")


def train_command(a: Arguments) -> int:
    """Fit any model, or continue a stopped fit."""
    if a.help_settings:
        print(_settings_text())
        return 0
    if a.resume:
        given = (value for name, value in vars(a).items() if name not in BESIDE_RESUME)
        if any(value is not None and value is not False and value != [] for value in given):
            raise InputError("--resume RUN goes on with the settings of RUN: omit data set and settings")
        return _resume(a)
    if not a.dataset or not a.out:
        raise InputError("train needs DATASET and --out RUN (or --resume RUN)")
    if a.deterministic:
        init("llvm", threads=1)
    return run_training(a)


def run_training(a: Arguments, **more: Any) -> int:
    """Call `wrf_mi.train` with the arguments of the command line and ``more``, and print the scores."""
    arguments = training_arguments(a)
    from ..runs.api import train

    with Watch(resumable=True) as watch:
        progress: dict[str, Any] = {"on_progress": watch.on_progress, "stop": watch.stop}
        run = train(a.dataset, a.out, **arguments, **progress, **more, progress=sys.stderr.isatty())
    return show_metrics(run.metrics, run.folder, a.json)


def _resume(a: Arguments) -> int:
    if _is_deterministic(Path(a.resume)):
        init("llvm", threads=1)
    from ..runs.api import resume

    with Watch(resumable=True) as watch:
        run = resume(a.resume, watch.on_progress, watch.stop, progress=sys.stderr.isatty())
    return show_metrics(run.metrics, run.folder, a.json)


def _is_deterministic(folder: Path) -> bool:
    """Whether a run's settings ask for determinism; read as plain YAML, since `read_config` chooses a backend."""
    try:
        return bool(read_yaml(folder / "config.yaml").get("deterministic"))
    except InputError:
        return False  # `read_config` reports the error


def training_arguments(a: Arguments) -> dict[str, Any]:
    """Arguments of `wrf_mi.train` except data set and folder.

    Raises:
        InputError: options that do not belong together.
    """
    model = a.model or HYBRID
    settings = [*a.set]
    if getattr(a, "stages", None) is not None or getattr(a, "fast", False):  # trace has neither
        settings = [*_stages(a, model), *settings]
    if model == RAY_TRACING:
        settings = [*_tracing_settings(a), *settings]
    elif any(getattr(a, name) is not None for name in TRACING):
        raise InputError(
            f"--paths, --depth, --reflections, --rays, --phase-error and --calibrate belong to --model {RAY_TRACING}"
        )
    if a.preset is not None:
        settings = [*_preset(a, model), *settings]
    return {
        **{name: getattr(a, name) for name in ("scene", "material", "receiver", "evaluation", "n_train")},
        "model": model,
        "settings": settings,
        "deterministic": a.deterministic,
        "intervals": a.intervals,
        "antennas": AntennaOptions(**{field.name: getattr(a, field.name) for field in fields(AntennaOptions)}),
        "split": "official" if a.split is None else a.split,
        "seed": a.seed or 0,
    }


def _stages(a: Arguments, model: str) -> list[str]:
    from ..models.hybrid.scene_side import FAST

    if model != HYBRID:
        raise InputError(f"--stages and --fast belong to --model {HYBRID}, not to {model}")
    if a.stages is not None and a.fast:
        raise InputError("--fast limits the stages, too: give one of --stages and --fast")
    return [f"stages={a.stages or ','.join(FAST)}"]


def _preset(a: Arguments, model: str) -> tuple[str, ...]:
    from ..datasets.registry import stated_task
    from ..models import known_model

    # A data set that is neither a path nor known is refused when it is read.
    presets = known_model(model).serving(stated_task(a.dataset) or "spectrum", a.scene is not None).presets
    if a.preset not in presets:
        raise InputError(f"{model} on {a.dataset}: takes no preset, which belongs to fields of spectra; use --set")
    return presets[a.preset]


def _tracing_settings(a: Arguments) -> list[str]:
    from ..tracing.convergence import CHOSEN_KINDS
    from ..tracing.options import stated_kinds

    target = getattr(a, "target_error", None)  # an option of trace
    for name in ("depth", "rays"):
        if target is not None and getattr(a, name) is not None:
            raise InputError(f"trace: --target-error chooses what --{name} states; give one of them")
    # Trained paths are searched with the default seed; --seed is that of training and split.
    seed = None if a.calibrate is not None else a.seed
    numbers = {"max_depth": a.depth, "max_reflections": a.reflections, "rays": a.rays, "seed": seed}
    numbers["phase_error"] = a.phase_error
    stated: dict[str, Any] = {key: given for key, given in numbers.items() if given is not None}
    if a.rays is not None and a.rays != "auto":
        if not a.rays.isdecimal():
            raise InputError(f'rays {a.rays!r}: give a whole number, or "auto"')
        stated["rays"] = int(a.rays)
    if a.paths is not None:
        stated |= stated_kinds(a.paths)
    if target is not None:
        # A kind in --paths is permitted, and switched on where it contributes.
        kinds = [kind for kind in CHOSEN_KINDS if a.paths is None or stated[kind]]
        stated |= {**dict.fromkeys(CHOSEN_KINDS, False), "target_error_db": target, "target_kinds": ",".join(kinds)}
    if a.calibrate is not None:
        stated["calibration"] = a.calibrate
    return [f"{key}={json.dumps(value)}" for key, value in stated.items()]


def _settings_text() -> str:
    from ..core.settings import describe
    from ..models import MODELS

    names: dict[type, list[str]] = {}
    for name, model in MODELS.items():
        kinds = model.settings if isinstance(model.settings, Mapping) else {"": model.settings}
        for data, kind in kinds.items():
            names.setdefault(kind, []).append(f"{name}, {data}" if data else name)
    return "\n".join(f"{'; '.join(known)}:\n{describe(kind())}\n" for kind, known in names.items())
