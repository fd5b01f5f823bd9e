"""Files of arrays, ``.npz`` and ``.npy``: written atomically, read without trust in what they state.

A file is read into memory of the size that it states only if its content can fill it and the memory is there. Nothing
is unpickled. With a checksum any change of names, types, shapes or numbers is noticed.
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from .digest import content_digest
from .files import atomic_file
from .memory import require_memory

CHECKSUM = "wrf_mi/sha256"  # key of the SHA-256 of all other arrays
MOST_DEFLATED = 1032  # largest ratio of DEFLATE (zlib's documentation, "Maximum compression factor")
RATIOS = {zipfile.ZIP_STORED: 1, zipfile.ZIP_DEFLATED: MOST_DEFLATED}
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
REMEDY = "read it on a machine with more memory"


def keyed(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays with a prefix before their names."""
    return {f"{prefix}{name}": values for name, values in arrays.items()}


def under(prefix: str, arrays: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Arrays whose names have a prefix, without it: the inverse of `keyed`."""
    return {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}


def write_arrays(path: Path, arrays: Mapping[str, Any], compressed: bool = False, checksum: bool = False) -> Path:
    """Write an ``.npz`` file of plain arrays atomically. `stored_arrays` compares the checksum."""
    stored = {name: np.asanyarray(values) for name, values in arrays.items()}
    if checksum:
        stored[CHECKSUM] = np.asarray(content_digest(stored))
    how = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    # Higher levels take four times as long for a file that is a few percent smaller.
    with atomic_file(path) as part, zipfile.ZipFile(part, "w", how, compresslevel=1) as archive:
        for name, values in stored.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)
    return path


def stored_arrays(path: Path, names: Collection[str] | None = None) -> dict[str, NDArray[Any]]:
    """Arrays of an ``.npz`` file: those of some names that are there, or all (None), compared with their checksum.

    Call it within `wrf_mi.core.files.readable`: a damaged file raises a dozen kinds of error. `InputError` for arrays
    that do not fit into memory.
    """
    with zipfile.ZipFile(path) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        chosen = members if names is None else {name: info for name, info in members.items() if name in names}
        _check_sizes(path, chosen)
        arrays = {}
        for name, info in chosen.items():
            with archive.open(info) as member:
                arrays[name] = _read_array(member, info.file_size)
    if names is None and CHECKSUM in arrays and str(arrays.pop(CHECKSUM)) != content_digest(arrays):
        raise ValueError("its content has changed since it was written: another checksum")
    return arrays


def _check_sizes(path: Path, members: Mapping[str, zipfile.ZipInfo]) -> None:
    """Refuse members of an archive that state more content than they can have, or than memory has room for."""
    size = path.stat().st_size
    for name, info in members.items():
        if info.file_size > RATIOS.get(info.compress_type, 0) * min(info.compress_size, size):
            raise ValueError(f"array {name} states more content than it has")
    require_memory(sum(info.file_size for info in members.values()), f"{path}: its content", REMEDY)


def stored_names(path: Path) -> set[str]:
    """Names of the arrays of an ``.npz`` file; errors as `stored_arrays`."""
    with zipfile.ZipFile(path) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def stored_array(path: Path) -> NDArray[Any]:
    """The array of a ``.npy`` file; errors as `stored_arrays`."""
    size = path.stat().st_size
    require_memory(size, f"{path}: its content", REMEDY)
    with path.open("rb") as stream:
        return _read_array(stream, size)


def _read_array(stream: IO[bytes], size: int) -> NDArray[Any]:
    """The array of a stream in NumPy's format with ``size`` bytes."""
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"format {version} of NumPy")
    shape, _, dtype = HEADERS[version](stream)
    count = math.prod(shape) * dtype.itemsize
    if dtype.hasobject:
        raise ValueError("objects, which would be unpickled")
    if any(side < 0 for side in shape) or count > size - stream.tell():
        raise ValueError(f"states {list(shape)} numbers of {dtype}, and has {size} bytes")
    stream.seek(0)
    values: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    stream.read(1)  # the archive compares its own checksum at the end
    return values
