"""Writing of binary PLY files: elements with named numbers, as structured arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.files import one_line, write_atomically

TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int", "u4": "uint"}
"""PLY's names of NumPy's types."""


def write_ply(path: Path, elements: Mapping[str, NDArray[Any]], comments: Sequence[str] = ()) -> Path:
    """Write a little-endian PLY file atomically.

    Args:
        path: file to write.
        elements: a packed structured array for each element, with a property for each field. A field ``vertex_indices``
            of shape [3] is a list whose length is stated before it, as PLY has faces.
        comments: lines of the header.

    Source: G. Turk, "The PLY polygon file format" (1994).
    """
    header, body = ["ply", "format binary_little_endian 1.0", *(f"comment {one_line(text)}" for text in comments)], b""
    for element, rows in elements.items():
        header.append(f"element {element} {len(rows)}")
        columns: list[tuple[Any, ...]] = []
        for name in rows.dtype.names or ():
            kind, shape = rows.dtype[name].base.str[1:], rows.dtype[name].shape
            header.append(f"property list uchar {TYPES[kind]} {name}" if shape else f"property {TYPES[kind]} {name}")
            columns += [(f"{name} count", "u1")] if shape else []
            columns.append((name, f"<{kind}", shape))
        packed = np.empty(len(rows), columns)
        for name in rows.dtype.names or ():
            packed[name] = rows[name]
            if shape := rows.dtype[name].shape:
                packed[f"{name} count"] = shape[0]
        body += packed.tobytes()
    return write_atomically(path, "\n".join([*header, "end_header", ""]).encode() + body)


def table(columns: Mapping[str, NDArray[Any]]) -> NDArray[Any]:
    """Structured array of columns [n], or [n, k], by name."""
    rows = np.empty(
        len(next(iter(columns.values()))), [(name, v.dtype.str, v.shape[1:]) for name, v in columns.items()]
    )
    for name, values in columns.items():
        rows[name] = values
    return rows
