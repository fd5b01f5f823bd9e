"""Digests of values and files: equal content has equal digests, other content another."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass
from itertools import chain
from pathlib import Path
from types import NoneType
from typing import Any

import numpy as np

from .errors import InputError


def content_digest(*values: Any) -> str:
    """SHA-256 (hex) of arrays, data classes (fields that count in comparisons), mappings, tuples, lists, plain values.

    A path stands for the names and contents of the files there; `InputError`: it does not exist.
    """
    digest = hashlib.sha256()
    for value in values:
        _add(digest, value)
    return digest.hexdigest()


def _add(digest: Any, value: Any) -> None:
    """Kind and size precede content, so that different values give different bytes."""
    if isinstance(value, Path):
        _add_files(digest, value)
    elif isinstance(value, np.ndarray):
        digest.update(f"array {value.dtype.str} {value.shape}\n".encode())
        digest.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(type(value)):
        content = {field.name: getattr(value, field.name) for field in fields(value) if field.compare}
        _add_all(digest, type(value).__name__, (content,))
    elif isinstance(value, Mapping):
        _add_all(digest, f"mapping {len(value)}", chain.from_iterable(sorted(value.items())))
    elif isinstance(value, (tuple, list)):
        _add_all(digest, f"sequence {len(value)}", value)
    elif isinstance(value, (str, int, float, np.generic, NoneType)):
        digest.update(f"{value!r}\n".encode())
    else:
        text = f"content_digest: {type(value).__name__} has no digest"
        raise TypeError(f"{text}; give arrays, data classes or plain values")


def _add_all(digest: Any, kind: str, values: Iterable[Any]) -> None:
    digest.update(f"{kind}\n".encode())
    for value in values:
        _add(digest, value)


def _add_files(digest: Any, path: Path) -> None:
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; restore it")
    files = [path] if path.is_file() else files_below(path)
    digest.update(f"files {len(files)}\n".encode())
    for file in files:
        with file.open("rb") as stream:
            content = hashlib.file_digest(stream, "sha256").hexdigest()
        digest.update(f"{file.relative_to(path).as_posix()!r} {content}\n".encode())


def files_below(folder: Path) -> list[Path]:
    """All files below a folder; links are followed."""
    below = (Path(parent) / name for parent, _, names in os.walk(folder, followlinks=True) for name in names)
    return sorted(path for path in below if path.is_file())
