"""What a run fits to which rows, known and refused before anything is written."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.settings import names_of, setting_texts, stated_values
from ..datasets import make_splits
from ..datasets.folder_files import read_positions
from ..datasets.observations import (
    LEAST_ROWS,
    check_observations,
    check_rows,
    fitted_receivers,
    place_of,
)
from ..datasets.splits import NONE, default_split, splits_below
from ..estimators.checks import check_held_receivers, check_record, check_stated
from ..estimators.model import default_settings
from ..estimators.receiver_places import check_placeable, placed_problem, tell_places
from ..models import MODELS, Model, Problem, known_model
from ..synthetic import load_record
from ..training.session import OnProgress, quiet
from .folder import (
    GIVEN,
    RunConfig,
    RunRequest,
)

logger = logging.getLogger(__name__)

LOSS = "loss"  # setting of fields of Gaussians that names their loss


def plan_run(
    dataset: str | Path | Record, request: RunRequest, progress: bool = False, on_progress: OnProgress = quiet
) -> tuple[Problem, RunConfig, list[Split]]:
    """Problem, configuration and splits of a run; errors as those of `train`. Nothing is written."""
    scene = None if request.scene is None else str(request.scene)
    record = dataset if isinstance(dataset, Record) else load_record(str(dataset), progress=progress)
    model = _serving_model(record, request)
    _check_scene(model, record, scene, request)
    settings, stated_settings = _settings_of(model, request)
    seed, deterministic = request.seed, request.deterministic
    if "seed" in model.train_arguments:
        seed, deterministic = settings.seed, settings.deterministic
    split = _split_of(record, request)
    record, splits, left_out = _split_rows(record, split, seed, request.n_train, least_rows(record, request))
    if request.wanted is not None:
        wanted_m = _wanted_m(record, request.wanted)
        splits = [replace(rows, wanted_m=wanted_m) for rows in splits]
    for rows in splits:
        check_held_receivers(record, rows, model, MODELS.values())
        check_observations(record, rows, model.complete, may_be_silent=record.task.may_be_silent)
    problem = Problem(record, settings, seed, scene, request.material, request.antennas, stated=stated_settings)
    check_placeable(problem, splits)
    source = (record.source or record.name) if isinstance(dataset, Record) else str(dataset)
    name = split.name if isinstance(split, Split) else split
    options = (seed, scene, request.material, request.antennas, deterministic, request.intervals, settings, left_out)
    names = None if stated_settings is None else tuple(sorted(stated_settings))
    config = RunConfig(request.model, source, record.task.name, name, request.n_train, *options, names)
    placed = placed_problem(problem.seen(splits[-1]), splits[-1], config.entry, on_progress)
    config.entry.check(placed, splits)
    check_stated(config.entry, placed, splits)
    tell_places(placed)
    return problem, config, splits


def _wanted_m(record: Record, wanted: str | Path | FloatArray) -> FloatArray:
    """Positions where predictions are wanted; `InputError`: none, or a task whose hold-out does not depend on them."""
    if not record.task.in_decibel:
        raise InputError(f"--for: {record.name} holds {record.task}; positions shape the hold-out of rssi; omit it")
    positions_m = np.asarray(read_positions(Path(wanted)).positions_m if isinstance(wanted, str | Path) else wanted)
    if positions_m.ndim != 2 or positions_m.shape[1] != 3 or not np.isfinite(positions_m).all() or not len(positions_m):
        raise InputError(f"--for: positions {positions_m.shape}; give finite x, y, z in metres in each row")
    return positions_m.astype(float)


def _serving_model(record: Record, request: RunRequest) -> Model:
    """Registry entry that serves a record; `InputError`: none does, or arguments belong to other models."""
    entry = known_model(request.model)
    check_record(entry, record, (other for other in MODELS.values() if other.scene != "required"))
    model = entry.serving(record.task.name, request.scene is not None)
    for name, option, data in (("evaluation", "", "Gaussians"), ("receiver", "-model", "fields of spectra")):
        if getattr(request, name) is not None and name not in model.train_arguments:
            able = ", ".join(other.name for other in MODELS.values() if name in other.train_arguments)
            raise InputError(f"--{name}{option} belongs to {data} ({able}), not to {request.model}")
    return model


def _split_of(record: Record, request: RunRequest) -> str | Split:
    """Stated split, else the official one, or `NONE` with a warning."""
    if request.split is not None:
        return request.split
    split = default_split(record)
    if split == NONE:
        text = "%s: no official split, so --split none: scores are of folds held out in space, the model of all rows"
        logger.warning(text, place_of(record))
    return split


def _settings_of(model: Model, request: RunRequest) -> tuple[Any, frozenset[str] | None]:
    """Settings, and the names of those that are stated; None: those of a dataclass that differ from its defaults."""
    kind: Any = model.settings
    requested, names = request.settings, None
    if is_dataclass(requested) and not isinstance(requested, type):
        if request.preset is not None:
            raise InputError(f"preset {request.preset}: the settings state all values; give one of both")
        if request.loss is not None:
            raise InputError(f"loss {request.loss}: the settings state all values; state it as loss.name there")
        if not issubclass(kind, type(requested)):
            raise InputError(f"settings of {model.name}: {type(requested).__name__}; give {kind.__name__}")
        settings: Any = kind(**{field.name: getattr(requested, field.name) for field in fields(requested)})
    else:
        assert isinstance(requested, Iterable)
        texts = [
            *(setting_texts(requested) if isinstance(requested, Mapping) else requested),
            *_loss_text(model, request.loss),
        ]
        preset, arguments = _preset(model, request.preset), {name: getattr(request, name) for name in GIVEN}
        settings = default_settings(model, [*preset, *texts], arguments)
        names = frozenset(stated_values(settings, texts))
        if preset and stated_values(settings, preset).keys() <= names:
            raise InputError(f"preset {request.preset}: the settings state all that it does; omit one of them")
        for name in names.intersection(model.train_arguments) - {"model"}:
            value = getattr(settings, name)
            if arguments[name] not in (None, type(value)(), value):
                raise InputError(f"setting {name}: {value}, where the argument is {arguments[name]}; give one of both")
    if "model" in model.train_arguments and settings.model != model.name:
        raise InputError(f"setting model: {settings.model}, where the model is {model.name}; choose it with --model")
    return settings, names


def _loss_text(model: Model, name: str | None) -> list[str]:
    """The setting that a loss of a name is."""
    if name is None:
        return []
    if LOSS not in names_of(model.settings):
        able = ", ".join(other.name for other in MODELS.values() if LOSS in names_of(other.settings))
        raise InputError(f"loss {name}: belongs to fields of Gaussians ({able}), not to {model.name}")
    return [f"{LOSS}.name={name}"]


def _preset(model: Model, name: str | None) -> tuple[str, ...]:
    if name is not None and name not in model.presets:
        presets = f"has the presets {', '.join(model.presets)}" if model.presets else "has no presets; use --set"
        raise InputError(f"--preset {name}: {model.name} for such data {presets}")
    return () if name is None else model.presets[name]


def least_rows(record: Record, request: RunRequest) -> int:
    """Training rows below which receivers are left out; by default no receiver of signal strengths is."""
    if request.min_rows is None:
        return 0 if record.task.shares_law else LEAST_ROWS
    if request.min_rows < 0:
        raise InputError(f"min_rows {request.min_rows}: give a number of training rows, 0 or more")
    return request.min_rows


def _split_rows(
    record: Record, split: str | Split, seed: int, n_train: int | float | None, least: int
) -> tuple[Record, list[Split], dict[str, int]]:
    """Record without receivers that have too few training rows, its splits, and those receivers' numbers of rows."""
    left_out: dict[str, int] = {}
    if isinstance(split, Split):
        check_rows(split, record, f"split {split.name}")
    # Receivers are held out of those that have enough rows in the split of rows that lies below.
    below = () if isinstance(split, Split) else splits_below(record, split)
    for rule in (*below, split):
        while True:
            splits = [rule] if isinstance(rule, Split) else make_splits(record, rule, seed, n_train)
            numbers, scarce = fitted_receivers(record, splits, least)
            if not scarce:
                break
            # Rows that only these receivers received are in no split any more, and a seeded draw from fewer rows may
            # leave another receiver without: so again, until none is left out. Each turn leaves out one at least.
            left_out |= scarce
            record = record.at_receivers(numbers)
            rule = rule.at_receivers(numbers) if isinstance(rule, Split) else rule
    return record, splits, left_out


def _check_scene(model: Model, record: Record, scene: str | None, request: RunRequest) -> None:
    if scene is None:
        if model.scene == "required":
            raise InputError(f"{model.name} needs a scene; give --scene SCENE, or choose kriging, which takes none")
        if request.material is not None or request.antennas:
            raise InputError("--material and antenna options belong to a scene that is traced; give --scene")
    elif model.scene == "none":
        raise InputError(f"{model.name} on {place_of(record)}: takes no scene; omit --scene")
    elif request.antennas and not model.uses_antennas:
        raise InputError(f"{model.name} on {record.name}: takes no antenna options: its channels are of isotropic ones")
