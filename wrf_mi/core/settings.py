"""Settings: frozen dataclasses of plain values, from nested dictionaries and from ``key=value``."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from typing import Any, TypeVar, cast

import yaml

from .errors import InputError


def flat(values: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    """Dotted names and values of a nested dictionary."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


Settings = TypeVar("Settings")
"""A frozen dataclass of plain values or of such dataclasses."""


def settings_from(kind: type[Settings], values: Mapping[str, Any], source: str) -> Settings:
    """The same for any dataclass of settings."""
    return cast(Settings, _build(kind, values, source, ""))


def _build(kind: type, values: Any, source: str, prefix: str) -> Any:
    if not isinstance(values, Mapping):
        raise InputError(f"{source}, setting {prefix[:-1] or 'top'}: expected a mapping, got {values!r}")
    hints = typing.get_type_hints(kind)
    arguments = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        if key not in hints:
            known = ", ".join(f"{prefix}{k}" for k in hints)
            raise InputError(f"{source}, setting {name}: unknown; known here: {known}")
        if dataclasses.is_dataclass(hints[key]):
            arguments[key] = _build(hints[key], value, source, f"{name}.")
        else:
            arguments[key] = _convert(value, hints[key], name, source)
    return kind(**arguments)


def _convert(value: Any, kind: Any, name: str, source: str) -> Any:
    choices = typing.get_args(kind)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):  # X | None, int | Literal["auto"]
        words = [word for choice in choices for word in typing.get_args(choice)]
        if (value is None and types.NoneType in choices) or value in words:
            return value
        kind = next(choice for choice in choices if choice is not types.NoneType)
        choices = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        if value not in choices:
            raise InputError(f"{source}, setting {name}: {value!r}; choose from {', '.join(map(str, choices))}")
        return value
    if typing.get_origin(kind) is tuple:
        parts = value if isinstance(value, list | tuple) else []
        kinds = choices[:1] * len(parts) if Ellipsis in choices else choices
        if not parts or len(parts) != len(kinds):
            count = "" if Ellipsis in choices else f"{len(kinds)} "
            raise InputError(f"{source}, setting {name}: expected a list of {count}values, got {value!r}")
        return tuple(_convert(one, own, name, source) for one, own in zip(parts, kinds, strict=True))
    good = isinstance(value, kind) and not (kind is int and isinstance(value, bool))
    # YAML reads 1e-3 as text.
    if kind is float and isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)
        except (ValueError, OverflowError):
            good = False
    if not good:
        raise InputError(f"{source}, setting {name}: expected {kind.__name__}, got {value!r}")
    return value


def with_settings(config: Settings, settings: Iterable[str]) -> Settings:
    """Settings (`TrainConfig`, or those of a physics model) with ``key=value`` applied in order; keys dotted, values
    YAML.

    Raises:
        InputError: no ``=``, an unknown key, or a value of the wrong type.
    """
    values: dict[str, Any] = dataclasses.asdict(config)  # type: ignore[call-overload]
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise InputError(f"--set {setting}: expected key=value, e.g. --set steps=2000")
        *parents, last = key.strip().split(".")
        node: Any = values
        for parent in parents:
            node = node.get(parent) if isinstance(node, dict) else None
        if not isinstance(node, dict) or last not in node or isinstance(node[last], dict):
            known = [name for name, _ in flat(dataclasses.asdict(config), "")]  # type: ignore[call-overload]
            close = get_close_matches(key.strip(), known, n=3)
            meant = f"did you mean {' or '.join(close)}? " if close else ""
            remedy = f"{meant}All are listed by `wrf-mi train --help-settings`"
            raise InputError(f"--set {setting}: unknown setting {key.strip()}; {remedy}")
        try:
            node[last] = yaml.safe_load(text) if text.strip() else ""
        except (yaml.YAMLError, ValueError):  # the latter from dates that are none
            raise InputError(f"--set {setting}: {text!r} is no YAML value; quote text that is none") from None
    return cast(Settings, _build(type(config), values, "--set", ""))


def describe(settings: Any) -> str:
    """One line a setting, with its default, for ``wrf-mi train --help-settings``."""
    values = dataclasses.asdict(settings)
    return "\n".join(f"{name}={_shown(value)}" for name, value in flat(values, ""))


def _shown(value: Any) -> Any:
    """As ``--set`` takes it."""
    return "null" if value is None else list(value) if isinstance(value, tuple) else value
