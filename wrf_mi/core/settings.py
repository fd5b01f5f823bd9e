"""Settings: frozen dataclasses of plain values, from nested dictionaries and from ``key=value``, checked by pydantic.

The range of a number is part of its type (`Count`, `Share`, ...); `check` applies it.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, reduce
from operator import getitem
from typing import Annotated, Any, TypeVar, cast

import numpy as np
import yaml
from pydantic import Field, TypeAdapter, ValidationError

from .errors import InputError

Count = Annotated[int, Field(ge=1, description="1 or more")]
Positive = Annotated[float, Field(gt=0, description="more than 0")]
Share = Annotated[float, Field(ge=0, le=1, description="0 to 1")]
ShareBelow1 = Annotated[float, Field(ge=0, lt=1, description="0 or more and less than 1")]
Inside = Annotated[float, Field(gt=0, lt=1, description="more than 0 and less than 1")]
Finite = Annotated[float, Field(description="a finite number")]
NOT_NEGATIVE = Field(ge=0, description="0 or more")  # range of numbers for which a class of settings states no other

FORMER_NAMES = {"max_depth": "depth", "max_reflections": "reflections", "parts": "groups"}
"""Names that settings had, which stored runs and scripts still state."""

Settings = TypeVar("Settings")  # a frozen dataclass of plain values or of such dataclasses


def flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of a nested dictionary."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def setting_texts(values: Mapping[str, Any]) -> list[str]:
    """Texts ``key=value`` of values by nested or dotted names, as `with_settings` takes them.

    >>> setting_texts({"steps": 200, "initial": {"gaussians": 500}})
    ['steps=200', 'initial.gaussians=500']
    """
    return [f"{key}={as_json(value)}" for key, value in flat(values)]


def as_json(value: Any) -> str:
    """A value as JSON: lists in place of tuples and arrays, dictionaries of dataclasses, texts of paths and others."""
    return json.dumps(value, default=_plain)


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # type: ignore[arg-type]


_adapter = cache(TypeAdapter)


@cache
def _ranges(kind: Any) -> dict[str, tuple[TypeAdapter[Any], str]]:
    """Ranges of all fields of a class, as if they were numbers; a subclass that changes a default keeps the range."""
    hints = [typing.get_type_hints(base, include_extras=True) for base in reversed(kind.__mro__)]
    items = (item for of_class in hints for item in of_class.items())
    annotated = {name: typing.get_args(hint)[1] for name, hint in items if typing.get_origin(hint) is Annotated}
    limits = {field.name: annotated.get(field.name, NOT_NEGATIVE) for field in dataclasses.fields(kind)}
    finite = Field(allow_inf_nan=False)
    return {name: (TypeAdapter(Annotated[float, each, finite]), each.description) for name, each in limits.items()}


def check(settings: Any, prefix: str = "") -> None:
    """Refuse by `InputError` numbers of (nested) settings that are not finite or out of their range, or other words."""
    kind: Any = type(settings)
    hints = typing.get_type_hints(kind)
    for name, (adapter, words) in _ranges(kind).items():
        value = getattr(settings, name)
        choices = typing.get_args(hints[name]) if typing.get_origin(hints[name]) is typing.Literal else (value,)
        if value not in choices:
            raise InputError(f"setting {prefix}{name}: {value!r}; choose from {', '.join(map(str, choices))}")
        if dataclasses.is_dataclass(value):
            check(value, f"{prefix}{name}.")
        elif isinstance(value, int | float):
            try:
                adapter.validate_python(value)
            except ValidationError:
                raise InputError(f"setting {prefix}{name}: {value} is out of range, choose {words}") from None


@dataclasses.dataclass(frozen=True)
class CheckedSettings:
    """Base of settings whose numbers are checked (`check`) when they are made."""

    def __post_init__(self) -> None:
        check(self)


def settings_from(kind: type[Settings], values: Mapping[str, Any], source: str) -> Settings:
    """Settings of a dataclass from a nested dictionary; what it does not name keeps its default.

    Settings of earlier versions that are constants now, in the mapping ``FIXED`` of the class, must have that value.
    `InputError`, which names the ``source``: an unknown name, or a value of the wrong type or out of its range.
    """
    return cast(Settings, _build(kind, values, source, ""))


def _build(kind: Any, values: Any, source: str, prefix: str) -> Any:
    if not isinstance(values, Mapping):
        raise InputError(f"{source}, setting {prefix[:-1] or 'top'}: expected a mapping, got {values!r}")
    hints = typing.get_type_hints(kind)
    arguments = {}
    for key, value in values.items():
        key = _present_name(key, hints)
        name = f"{prefix}{key}"
        if key in (fixed := getattr(kind, "FIXED", {})):
            if value != fixed[key]:
                text = f"{value!r}, where this version has {fixed[key]!r} alone; omit it, or train the run anew"
                raise InputError(f"{source}, setting {name}: {text}")
            continue
        if key not in hints:
            choices = ", ".join(f"{prefix}{k}" for k in hints)
            raise InputError(f"{source}, setting {name}: unknown; known here: {choices}")
        arguments[key] = converted(hints[key], value, source, name)
    return kind(**arguments)


def _number(value: Any) -> Any:
    """A number that YAML 1.1 reads as text, such as 1e-3; all else as it is."""
    with suppress(ValueError):
        return float(value) if isinstance(value, str) else value
    return value


def converted(hint: Any, value: Any, source: str, name: str) -> Any:
    """A value of the type ``hint``, or settings of a dataclass, from JSON or YAML; errors as `settings_from`."""
    if dataclasses.is_dataclass(hint):
        return _build(hint, value, source, f"{name}.")
    if float in (hint, *typing.get_args(hint)):
        value = [_number(each) for each in value] if isinstance(value, list | tuple) else _number(value)
    try:
        return _adapter(hint).validate_json(as_json(value), strict=True)
    except ValidationError as error:
        raise InputError(f"{source}, setting {name}: {_mismatch(hint, value, error)}") from None


def _mismatch(hint: Any, value: Any, error: ValidationError) -> str:
    first: Any = error.errors()[0]
    if first["type"] == "literal_error":
        listed = first["ctx"]["expected"].replace("'", "").replace(" or ", ", ")
        return f"{value!r}; choose from {listed}"
    if first["type"] in ("tuple_type", "missing", "too_long", "too_short"):
        parts = typing.get_args(hint) if typing.get_origin(hint) is tuple else (Ellipsis,)
        count = "" if Ellipsis in parts else f"{len(parts)} "
        return f"expected a list of {count}values, got {value!r}"
    return f"expected {first['type'].split('_')[0]}, got {first['input']!r}"


def names_of(kind: Any) -> frozenset[str]:
    """Names of the settings of a dataclass."""
    return frozenset(setting.name for setting in dataclasses.fields(kind))


def changed(settings: Any) -> frozenset[str]:
    """Dotted names of the settings that differ from the defaults of their class."""
    default = dict(flat(dataclasses.asdict(type(settings)())))
    return frozenset(name for name, value in flat(dataclasses.asdict(settings)) if value != default[name])


def stated_values(config: Any, settings: Iterable[str]) -> dict[str, str]:
    """Values, as they are stated, of ``key=value`` by dotted name; `InputError`: a name with two different values.

    >>> from wrf_mi.training.config import TrainConfig
    >>> stated_values(TrainConfig(), ["steps=200", "traced.depth=3"])
    {'steps': '200', 'traced.depth': '3'}
    """
    names = [name for name, _ in flat(dataclasses.asdict(config))]
    values: dict[str, str] = {}
    for setting in settings:
        key, _, text = (part.strip() for part in setting.partition("="))
        key = _present_name(key, names)
        if values.setdefault(key, text) != text:
            raise InputError(f"setting {key}: stated as {values[key]} and as {text}; give one of both")
    return values


def _present_name(key: str, names: Iterable[str]) -> str:
    # Other settings may never have had the former name: what is unknown is refused as it was written.
    present = FORMER_NAMES.get(key, key)
    return present if key not in names and present in names else key


def with_settings(config: Settings, settings: Iterable[str]) -> Settings:
    """Settings with ``key=value`` applied in order; keys dotted, values YAML; `InputError`: any that does not fit.

    >>> from wrf_mi.training.config import TrainConfig
    >>> config = with_settings(TrainConfig(), ["steps=200", "initial.gaussians=500"])
    >>> config.steps, config.initial.gaussians
    (200, 500)
    """
    values: dict[str, Any] = dataclasses.asdict(config)  # type: ignore[call-overload]
    names = [name for name, _ in flat(values)]
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: expected key=value, e.g. --set steps=2000")
        key = _present_name(key.strip(), names)
        if key not in names:
            close = get_close_matches(key, names, n=3)
            meant = f"did you mean {' or '.join(close)}? " if close else ""
            remedy = f"{meant}All are listed by `wrf-mi train --help-settings`"
            raise InputError(f"--set {setting}: unknown setting {key}; {remedy}")
        *parents, last = key.split(".")
        try:
            reduce(getitem, parents, values)[last] = yaml.safe_load(text) if text.strip() else ""
        except (yaml.YAMLError, ValueError):  # the latter from text that looks like a date
            raise InputError(f"--set {setting}: {text!r} is no YAML value; put text in quotes") from None
    return settings_from(type(config), values, "--set")


def describe(settings: Any) -> str:
    """One line a setting, ``key=value`` with its default, for ``wrf-mi train --help-settings``."""

    def shown(value: Any) -> Any:
        return "null" if value is None else list(value) if isinstance(value, tuple) else value

    return "\n".join(f"{name}={shown(value)}" for name, value in flat(dataclasses.asdict(settings)))
