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
from ..models.model import Model, default_settings
from .compressed import COMPRESSION
from .folder import CONFIG, GIVEN, RunConfig, read_config

WORDS = {
    "wrf-gs": "3D Gaussians with complex attenuation, signals by networks",
    "wrf-gs+": "3D Gaussians with static attributes and a deformation network",
    "factorised": "static 3D Gaussians, signals are mixtures of a few functions of the transmitter",
    "ray-tracing": "Sionna RT in the scene",
    "hybrid": "one fit in stages: paths of a scene, its correction, Gaussians, interpolation of the rest",
    "idw": "inverse-distance weighting",
    "kriging": "kriging (Gaussian process)",
    "trees": "extremely randomised trees",
    "mri": "log-distance path loss of each receiver, interpolated residuals",
    "vae": "variational autoencoder",
    "dcgan": "generative adversarial network",
    "nerf2": "neural field of voxels, marched along rays",
    "linear": "linear map from uplink to downlink",
    "fire": "variational autoencoder from uplink to downlink",
    "r2f2": "paths fitted to the uplink",
    "optml": "paths fitted to the uplink, started by a network",
}
"""Models for readers of a page; others, of installed packages, are named by their source."""


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
    words = WORDS.get(config.model, config.entry.source)
    if config.scene is not None and config.model not in ("ray-tracing", "hybrid"):
        words += ", trained jointly with the paths of the scene"
    return words


def changed_settings(config: RunConfig) -> dict[str, Any]:
    """Settings, by dotted name, that differ from the model's defaults for these data; not those of `GIVEN`."""
    entry: Model = config.entry
    given = {"model": config.model, "seed": config.seed, "deterministic": config.deterministic}
    standard = dict(flat(asdict(default_settings(entry, (), given))))
    stated = flat(asdict(config.settings))
    return {
        name: value for name, value in stated if value != standard[name] and not (name in GIVEN and name in entry.given)
    }


def command(config: RunConfig, folder: Path) -> str:
    """The line that repeats a run.

    Data sets that were passed as objects in Python are named by their folder, and rows by the name of their split.
    """
    if (folder / COMPRESSION).exists():
        how = json.loads((folder / COMPRESSION).read_text())
        words = ["wrf-mi", "compress", how["run"]]
        for name, value in how["how"].items():
            words += [f"--{name.replace('_', '-')}", str(value)]
        return shlex.join([*words, "--out", str(folder)])
    words = ["wrf-mi", "train", config.dataset, "--model", config.model, "--split", config.split]
    for option, value in (("n-train", config.n_train), ("scene", config.scene), ("material", config.material)):
        words += [] if value is None else [f"--{option}", str(value)]
    for field in fields(AntennaOptions):
        value = getattr(config.antennas, field.name)
        words += [] if value is None else [f"--{field.name.replace('_', '-')}", str(value)]
    for name in ("receiver", "evaluation"):
        if name in config.entry.given:
            value = getattr(config.settings, name)
            words += [] if value == getattr(default_settings(config.entry, (), {}), name) else [f"--{name}", value]
    changed = changed_settings(config)
    if config.seed:
        words += ["--seed", str(config.seed)]
        if "seed" not in config.entry.given and hasattr(config.settings, "seed"):
            changed["seed"] = config.settings.seed  # --seed alone would set that of the rays, too
    words += [f"--{name}" for name in ("deterministic", "intervals") if getattr(config, name)]
    for name, value in changed.items():
        words += ["--set", f"{name}={json.dumps(value)}"]
    return shlex.join([*words, "--out", str(folder)])
