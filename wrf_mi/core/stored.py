"""Dataclasses as arrays of a file, and back, by the annotations of their fields.

A field ``x`` is stored by what its annotation says:

- an array, a number or a text: array ``x``, of numbers and texts without axes;
- a dataclass: ``x``, the name of its class, and its fields ``x/...``; a base class stands for its subclasses, too;
- a list or tuple of arrays or dataclasses: ``x``, their number, and ``x/0``, ``x/1``, ...; a dictionary of these has
  its keys in ``x``, as JSON;
- a dictionary of arrays by text: ``x/<key>``;
- other plain values, which are lists, tuples and dictionaries of numbers and texts, and dataclasses of these, such as
  settings: ``x``, JSON;
- None: nothing.

Fields with the metadata `NOT_STORED`, such as the data of a fit, are arguments of `from_arrays`.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import json
import sys
import types
import typing
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from .array_files import under
from .errors import InputError
from .settings import as_json, converted

Kind = TypeVar("Kind")
Arrays = dict[str, NDArray[Any]]
NOT_STORED = {"stored": False}
"""Metadata of fields that are not stored: ``field(metadata=NOT_STORED)``."""
SCALARS = (bool, int, float, complex, str)
SEQUENCES, MAPPINGS = (list, tuple, collections.abc.Sequence), (dict, collections.abc.Mapping)


def to_arrays(value: Any, prefix: str = "") -> Arrays:
    """Fields of a dataclass as arrays whose names begin with a prefix (TypeError: a field that cannot be stored).

    >>> from wrf_mi.core import Antenna
    >>> to_arrays(Antenna("dipole"))["pattern"]
    array('dipole', dtype='<U6')
    """
    kind, arrays = cast(Any, type(value)), Arrays()
    for field, hint in _fields(kind):
        arrays |= _stored(f"{prefix}{field.name}", hint, getattr(value, field.name))
    return arrays


def from_arrays(kind: type[Kind], arrays: Mapping[str, NDArray[Any]], prefix: str = "", **not_stored: Any) -> Kind:
    """The dataclass of the class ``kind`` that `to_arrays` stored.

    ``not_stored`` are values of fields that are not stored, of this dataclass and of those in its fields. Call it
    within `wrf_mi.core.files.readable`: `ValueError` names an array that is missing or of another form; `InputError`
    from settings that are out of range.

    >>> from wrf_mi.core import Antenna
    >>> from_arrays(Antenna, to_arrays(Antenna("dipole"))).pattern
    'dipole'
    """
    of_class: Any = kind
    values = {name: value for name, value in not_stored.items() if name in _not_stored(of_class)}
    for field, hint in _fields(of_class):
        values[field.name] = _loaded(f"{prefix}{field.name}", hint, arrays, not_stored)
    return kind(**values)


def _hint(kind: Any, name: str) -> Any:
    """Annotation of a field; names in those of fields that are not stored may be known to type checkers alone."""
    base = next(each for each in kind.__mro__ if name in vars(each).get("__annotations__", ()))
    alone = types.SimpleNamespace(__annotations__={name: base.__annotations__[name]})
    return typing.get_type_hints(alone, vars(sys.modules[base.__module__]), include_extras=True)[name]


@cache
def _fields(kind: Any) -> list[tuple[dataclasses.Field[Any], Any]]:
    """Fields of a dataclass that are stored, and their annotations."""
    stored = (field for field in dataclasses.fields(kind) if field.init and field.name not in _not_stored(kind))
    return [(field, _hint(kind, field.name)) for field in stored]


@cache
def _not_stored(kind: Any) -> frozenset[str]:
    return frozenset(field.name for field in dataclasses.fields(kind) if not field.metadata.get("stored", True))


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """The types of an annotation without those of `typing.Annotated` and None."""
    if typing.get_origin(hint) is Annotated:
        return _alternatives(typing.get_args(hint)[0])
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return tuple(each for part in typing.get_args(hint) for each in _alternatives(part))
    return () if hint is types.NoneType else (hint,)


def _is_optional(hint: Any) -> bool:
    if typing.get_origin(hint) is Annotated:
        return _is_optional(typing.get_args(hint)[0])
    return hint is Any or types.NoneType in typing.get_args(hint)


def _origin(hint: Any) -> Any:
    """Class of an annotation: of ``list[int]`` the list."""
    kind = (_alternatives(hint) or (types.NoneType,))[0]
    return typing.get_origin(kind) or kind


def _is_plain(hint: Any) -> bool:
    """Whether JSON has the values of an annotation."""
    if hint is Ellipsis or typing.get_origin(hint) is Literal:
        return True
    if len(alternatives := _alternatives(hint)) != 1:
        return all(map(_is_plain, alternatives))
    kind: Any = _origin(hint)
    arguments = typing.get_args(alternatives[0])
    if kind in (*SEQUENCES, *MAPPINGS):
        return all(map(_is_plain, arguments))
    if hasattr(kind, "__dataclass_fields__"):
        return not _not_stored(kind) and all(_is_plain(each) for _, each in _fields(kind))
    return kind in (Any, Literal, bool, int, float, str)


def _members(hint: Any, count: int) -> list[Any]:
    """Annotations of the members of a list, tuple or dictionary."""
    arguments = typing.get_args(_alternatives(hint)[0])
    fixed = _origin(hint) is tuple and arguments[-1] is not Ellipsis
    return list(arguments) if fixed else [arguments[-1 if _origin(hint) in MAPPINGS else 0]] * count


def _classes(hint: Any) -> dict[str, type]:
    """Dataclasses that an annotation stands for, by name: its classes and their subclasses."""

    def below(kind: Any) -> Iterator[Any]:
        yield kind
        for each in kind.__subclasses__():
            yield from below(each)

    classes = [each for kind in _alternatives(hint) if isinstance(kind, type) for each in below(kind)]
    return {each.__name__: each for each in classes if hasattr(each, "__dataclass_fields__")}


def _is_named(hint: Any) -> bool:
    """Whether an annotation is of a dictionary of arrays by text."""
    return _origin(hint) in MAPPINGS and _origin(_members(hint, 1)[0]) is np.ndarray


def _is_scalar(hint: Any) -> bool:
    return all(kind in SCALARS or typing.get_origin(kind) is Literal for kind in _alternatives(hint))


def _stored(name: str, hint: Any, value: Any) -> Arrays:
    kind = _origin(hint)
    if value is None:
        return {}
    if kind is np.ndarray or _is_scalar(hint):
        return {name: np.asarray(value)}
    if _is_plain(hint):
        return {name: np.asarray(as_json(value))}
    if _is_named(hint):
        return {f"{name}/{key}": np.asarray(array) for key, array in value.items()}
    if kind in SEQUENCES or kind in MAPPINGS:
        is_mapping = kind in MAPPINGS
        arrays = {name: np.asarray(as_json(list(value)) if is_mapping else len(value))}
        members = value.values() if is_mapping else value
        for number, (of_member, member) in enumerate(zip(_members(hint, len(value)), members, strict=True)):
            arrays |= _stored(f"{name}/{number}", of_member, member)
        return arrays
    if type(value) not in _classes(hint).values():
        raise TypeError(f"field {name}: {type(value).__name__} cannot be stored as {hint}")
    return {name: np.asarray(type(value).__name__)} | to_arrays(value, f"{name}/")


def _loaded(name: str, hint: Any, arrays: Mapping[str, NDArray[Any]], not_stored: Mapping[str, Any]) -> Any:
    kind, stored = _origin(hint), arrays.get(name)
    if _is_named(hint) and (named := under(f"{name}/", arrays)):
        return named
    if stored is None:
        if _is_optional(hint):
            return None
        if _is_named(hint):
            return {}
        raise ValueError(f"array {name} is missing")
    if kind is np.ndarray:
        return stored
    if stored.ndim:
        raise ValueError(f"array {name} has shape {stored.shape}, and one without axes is due")
    value = stored.item()
    if _is_scalar(hint):
        return kind(value) if kind is complex else _converted(hint, value, name)
    if _is_plain(hint):
        return _converted(hint, json.loads(value), name)
    if kind in SEQUENCES or kind in MAPPINGS:
        keys = range(int(value)) if kind in SEQUENCES else json.loads(value)
        of_members = enumerate(_members(hint, len(keys)))
        members = [_loaded(f"{name}/{number}", each, arrays, not_stored) for number, each in of_members]
        if kind in MAPPINGS:
            return dict(zip(keys, members, strict=True))
        return tuple(members) if kind is tuple else members
    if value not in (classes := _classes(hint)):
        raise ValueError(f"array {name} is {value!r}, and {' or '.join(classes)} is due")
    return from_arrays(classes[value], arrays, f"{name}/", **not_stored)


def _converted(hint: Any, value: Any, name: str) -> Any:
    try:
        return converted(hint, value, f"array {name}", "value")
    except InputError as error:
        raise ValueError(error) from None
