"""What a run is, in words: its model, the settings that differ from the defaults, and the command that repeats it."""

from __future__ import annotations

import json
import shlex
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import yaml

from ..core import AntennaOptions, InputError
from ..core.settings import flat
from ..models.model import default_settings
from .folder import CONFIG, RunConfig, read_config


def known_config(folder: Path) -> RunConfig | None:
    """Content of ``config.yaml``; None where there is none, or for a model or settings that this version lacks."""
    try:
        return read_config(folder)
    except InputError:
        return None


def stored_versions(folder: Path) -> dict[str, str]:
    """Versions of packages, backend and device with which a run was made; empty where they are not stored."""
    try:
        content = yaml.safe_load((folder / CONFIG).read_text(encoding="utf-8"))
        return {str(name): str(value) for name, value in content["versions"].items()}
    except (OSError, UnicodeDecodeError, yaml.YAMLError, KeyError, TypeError, AttributeError):
        return {}


def model_words(config: RunConfig) -> str:
    """The model in words, with its scene."""
    return config.entry.described(config.scene is not None)


def changed_settings(config: RunConfig) -> dict[str, Any]:
    """Settings, by dotted name, that differ from the model's defaults for these data, but not arguments of `train`."""
    model = config.entry
    arguments = {"model": config.model, "seed": config.seed, "deterministic": config.deterministic}
    standard = dict(flat(asdict(default_settings(model, (), arguments))))
    stated = flat(asdict(config.settings))
    return {key: value for key, value in stated if value != standard[key] and key not in model.train_arguments}


def command(config: RunConfig, folder: Path) -> str:
    """The line that repeats a run.

    Data sets that were passed as objects in Python are named by their folder, and rows by the name of their split.
    """
    words = ["wrf-mi", "train", config.dataset, "--model", config.model, "--split", config.split]
    for option, value in (("n-train", config.n_train), ("scene", config.scene), ("material", config.material)):
        words += [] if value is None else [f"--{option}", str(value)]
    for field in fields(AntennaOptions):
        value = getattr(config.antennas, field.name)
        words += [] if value is None else [f"--{field.name.replace('_', '-')}", str(value)]
    for name in ("receiver", "evaluation"):
        if name in config.entry.train_arguments:
            value = getattr(config.settings, name)
            words += [] if value == getattr(default_settings(config.entry, (), {}), name) else [f"--{name}", value]
    changed = changed_settings(config)
    if config.seed:
        words += ["--seed", str(config.seed)]
        if "seed" not in config.entry.train_arguments and hasattr(config.settings, "seed"):
            changed["seed"] = config.settings.seed  # --seed alone would set that of the rays, too
    words += [f"--{name}" for name in ("deterministic", "intervals") if getattr(config, name)]
    for name, value in changed.items():
        words += ["--set", f"{name}={json.dumps(value)}"]
    return shlex.join([*words, "--out", str(folder)])
