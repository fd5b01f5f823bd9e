"""Transmitter positions that a user asks predictions for."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..core.files import one_line, text_lines


def read_tx_positions(csv_file: str | Path | None, npz_file: str | Path | None) -> FloatArray:
    """Positions [m, 3] in metres of a CSV file with columns x, y, z, or of an ``.npz`` file with ``tx_pos``.

    Raises:
        InputError: the file is missing, or a row is not three finite numbers.
    """
    path = Path(csv_file if csv_file is not None else npz_file or "")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give positions x, y, z in metres")
    positions = _from_csv(path) if csv_file is not None else _from_npz(path)
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, row {bad[0] + 1}: not a finite number; give x, y, z in metres")
    if len(positions) == 0:
        raise InputError(f"{path}: no positions; give one row x, y, z in metres for each")
    return positions


def _from_csv(path: Path) -> FloatArray:
    rows = [row for row in csv.reader(text_lines(path)) if row]
    header = [name.strip().lower() for name in rows[0]] if rows else []
    if not {"x", "y", "z"} <= set(header):
        raise InputError(f"{path}: header {','.join(header)[:40]!r} lacks x, y, z; make it the first line")
    columns, positions = [header.index(name) for name in "xyz"], []
    for number, row in enumerate(rows[1:], start=1):
        try:
            positions.append([float(row[c]) for c in columns])
        except (ValueError, IndexError):
            raise InputError(f"{path}, row {number}: {','.join(row)[:60]!r} is not three numbers; correct it") from None
    return np.asarray(positions, float).reshape(-1, 3)


def _from_npz(path: Path) -> FloatArray:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            positions = np.asarray(arrays["tx_pos"], float)
    except KeyError:
        raise InputError(f"{path}: no array tx_pos; store positions [m, 3] under that name") from None
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not readable as .npz ({one_line(error)}); write it with numpy.savez") from None
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: tx_pos has shape {list(positions.shape)}, expected [m, 3]; store x, y, z in metres")
    return positions
