"""Keys of stored fits: digests of everything that determines a fit.

A run folder whose name holds the key of a fit is used again. Other settings, rows, seed, data or versions give another
key, and so another folder.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from ..core import InputError
from ..core.files import one_line
from ..datasets.registry import locate
from .folder import versions

PACKAGES, COMPILED = ("wrf_mi", "wrf_mi_plugins", "wrf_mi_scenes"), "__pycache__"
DIGITS = 16
"""Hexadecimal digits of a key: two of a million fits share a key with a probability of 3e-8."""


def fit_key(*determining: Any) -> str:
    """Key of a fit: a digest of `versions` and of the given values.

    Args:
        determining: arrays, data classes (fields that count in comparisons), mappings, tuples and lists of these, and
            plain values. A path stands for the names and contents of the files there.

    Raises:
        InputError: a path that does not exist.
    """
    return content_digest(versions(), *determining)[:DIGITS]


def content_digest(*values: Any) -> str:
    """SHA-256 (hex) of values as for `fit_key`, without versions."""
    digest = hashlib.sha256()
    for value in values:
        _add(digest, value)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    """Kind and size precede content, so that different values give different bytes."""
    if isinstance(value, Path):
        if not value.exists():
            raise InputError(f"{value}: no such file or folder; restore it")
        files = [value] if value.is_file() else _files_below(value)
        digest.update(f"files {len(files)}\n".encode())
        for file in files:
            with file.open("rb") as stream:
                content = hashlib.file_digest(stream, "sha256").hexdigest()
            digest.update(f"{file.relative_to(value).as_posix()!r} {content}\n".encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape}\n".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        digest.update(f"{type(value).__name__}\n".encode())
        _add(digest, {field.name: getattr(value, field.name) for field in fields(value) if field.compare})
    elif isinstance(value, Mapping):
        digest.update(f"mapping {len(value)}\n".encode())
        for key in sorted(value):
            _add(digest, key)
            _add(digest, value[key])
    elif isinstance(value, (tuple, list)):
        digest.update(f"sequence {len(value)}\n".encode())
        for item in value:
            _add(digest, item)
    elif value is None or isinstance(value, (str, int, float, np.generic)):
        digest.update(f"{value!r}\n".encode())
    else:
        raise TypeError(f"fit_key: {type(value).__name__} has no digest; give arrays, data classes or plain values")


def _files_below(folder: Path) -> list[Path]:
    """All files below a folder; links are followed."""
    below = (Path(parent) / name for parent, _, names in os.walk(folder, followlinks=True) for name in names)
    return sorted(path for path in below if path.is_file())


def source_files() -> dict[str, Path]:
    """Files of this package, its plugins and its scenes by name, except compiled files."""
    found: dict[str, Path] = {}
    for name in PACKAGES:
        spec = find_spec(name)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            files = [path for path in _files_below(Path(folder)) if COMPILED not in path.parts]
            found |= {f"{name}/{path.relative_to(folder).as_posix()}": path for path in files}
    return found


def dataset_files(name_or_folder: str) -> list[Path]:
    """Folder or file of a data set; empty where it is not on this machine.

    Raises:
        InputError: no such data set.
    """
    path = Path(name_or_folder)
    found = path if path.exists() else locate(name_or_folder)
    return [] if found is None else [found]


def scene_files(scene: str | Path) -> list[Path]:
    """Folder or file of a scene, with the files that a Mitsuba XML names; empty for the name of an embedded scene.

    Raises:
        InputError: an XML that cannot be read.
    """
    path = Path(scene)
    if not path.exists():
        return []
    if path.suffix.lower() != ".xml":
        return [path]
    try:
        stated = [node.get("value", "") for node in ElementTree.parse(path).iter("string")]
    except (ElementTree.ParseError, OSError) as error:
        raise InputError(f"{path}: not readable as XML ({one_line(error)}); correct the scene") from None
    return [path, *(file for value in stated if value and (file := path.parent / value).is_file())]
