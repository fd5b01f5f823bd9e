"""Transmitter positions that a user asks predictions for."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray


def read_tx_positions(csv_file: str | Path | None, npz_file: str | Path | None) -> FloatArray:
    """Positions [m, 3] in metres of a CSV file with columns x, y, z, or of an ``.npz`` file with ``tx_pos``.

    Raises:
        InputError: the file is missing, or a row is not three finite numbers.
    """
    path = Path(csv_file if csv_file is not None else npz_file or "")
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    positions = _from_csv(path) if csv_file is not None else _from_npz(path)
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, row {bad[0] + 1}: not a finite number; give x, y, z in metres")
    if len(positions) == 0:
        raise InputError(f"{path}: no positions; give one row x, y, z in metres for each")
    return positions


def _from_csv(path: Path) -> FloatArray:
    with path.open(newline="", encoding="utf-8-sig") as stream:
        reader = csv.reader(stream)
        header = [name.strip() for name in next(reader, [])]
        if not {"x", "y", "z"} <= set(header):
            raise InputError(f"{path}: header {','.join(header)!r} lacks x, y, z; make it the first line")
        columns, rows = [header.index(name) for name in "xyz"], []
        for number, row in enumerate((row for row in reader if row), start=1):
            try:
                rows.append([float(row[c]) for c in columns])
            except (ValueError, IndexError):
                raise InputError(f"{path}, row {number}: {','.join(row)!r} is not three numbers") from None
    return np.asarray(rows, float).reshape(-1, 3)


def _from_npz(path: Path) -> FloatArray:
    try:
        with np.load(path, allow_pickle=False) as arrays:
            positions = np.asarray(arrays["tx_pos"], float)
    except KeyError:
        raise InputError(f"{path}: no array tx_pos; store positions [m, 3] under that name") from None
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not readable as .npz ({error})") from None
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: tx_pos has shape {list(positions.shape)}, expected [m, 3]")
    return positions
