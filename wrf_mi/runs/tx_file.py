"""What a user asks predictions for: transmitter positions, or uplink channels."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from ..core import InputError
from ..core.angles import FloatArray
from ..core.carriers import FREQUENCY
from ..core.files import one_line, text_lines
from ..models.method import Inputs

HEADING = "heading_rad"
"""Column or array of headings."""
POSITIONS, UPLINK = "tx_pos", "uplink"
"""Arrays of positions and of uplink channels."""


def read_inputs(csv_file: str | Path | None, npz_file: str | Path | None) -> Inputs:
    """Positions [m, 3] in metres and what else the file tells; without positions they are NaN.

    Args:
        csv_file: with columns x, y, z and perhaps heading_rad and frequency_hz; or
        npz_file: with arrays ``tx_pos`` [m, 3] and perhaps ``heading_rad`` [m] and ``frequency_hz`` [m], or with
            ``uplink`` [m, antennas, subcarriers] and perhaps these.

    Raises:
        InputError: the file is missing, or a row is not made of finite numbers.
    """
    path = Path(csv_file if csv_file is not None else npz_file or "")
    if not path.is_file():
        raise InputError(f"{path}: no such file; give positions x, y, z in metres")
    inputs = _from_csv(path) if csv_file is not None else _from_npz(path)
    positions, heading, uplink = inputs.tx_pos_m, inputs.tx_heading_rad, inputs.uplink
    if uplink is not None:
        if uplink.ndim != 3 or uplink.dtype.kind != "c":
            text = f"uplink has shape {list(uplink.shape)} of {uplink.dtype}"
            raise InputError(f"{path}: {text}; store complex numbers [m, antennas, subcarriers]")
        if len(uplink) != len(positions):
            raise InputError(f"{path}: {len(uplink)} rows of uplink and {len(positions)} positions; give one each")
        bad = np.flatnonzero(~np.isfinite(uplink).all(axis=(1, 2)))
        if len(bad):
            raise InputError(f"{path}, row {bad[0] + 1}: uplink is not finite; correct or remove the row")
        if np.isnan(positions).all() and len(positions):
            return inputs
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, row {bad[0] + 1}: not a finite number; give x, y, z in metres")
    if len(positions) == 0:
        raise InputError(f"{path}: no positions; give one row x, y, z in metres for each")
    if heading is not None and (heading.shape != (len(positions),) or not np.isfinite(heading).all()):
        raise InputError(f"{path}: {HEADING} must be one finite number (rad) for each position; correct it")
    carriers = inputs.carriers_hz
    if carriers is not None and not (
        carriers.shape == (len(positions),) and ((carriers > 0) & np.isfinite(carriers)).all()
    ):
        raise InputError(f"{path}: {FREQUENCY} must be one positive number (Hz) for each position; correct it")
    return inputs


def _from_csv(path: Path) -> Inputs:
    try:
        rows = [row for row in csv.reader(text_lines(path)) if row]
    except csv.Error as error:
        raise InputError(f"{path}: not a CSV file ({one_line(error)}); give x, y, z in metres") from None
    header = [name.strip().lower() for name in rows[0]] if rows else []
    if not {"x", "y", "z"} <= set(header):
        raise InputError(f"{path}: header {','.join(header)[:40]!r} lacks x, y, z; make it the first line")
    more = [name for name in (HEADING, FREQUENCY) if name in header]
    columns, values = [header.index(name) for name in ("x", "y", "z", *more)], []
    for number, row in enumerate(rows[1:], start=1):
        try:
            values.append([float(row[c]) for c in columns])
        except (ValueError, IndexError):
            wanted = f"{len(columns)} numbers" if more else "three numbers"
            raise InputError(f"{path}, row {number}: {','.join(row)[:60]!r} is not {wanted}; correct it") from None
    table = np.asarray(values, float).reshape(-1, len(columns))
    own = dict(zip(more, table[:, 3:].T, strict=True))
    return Inputs(table[:, :3], own.get(HEADING), carriers_hz=own.get(FREQUENCY))


def _from_npz(path: Path) -> Inputs:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            uplink = arrays.get(UPLINK)
            positions: FloatArray
            if uplink is not None and POSITIONS not in arrays:
                positions = np.full((len(uplink), 3), np.nan)
            else:
                positions = np.asarray(arrays[POSITIONS], float)
            heading, carriers = (
                np.asarray(arrays[name], float) if name in arrays else None for name in (HEADING, FREQUENCY)
            )
    except KeyError:
        raise InputError(f"{path}: no array tx_pos; store positions [m, 3] under that name") from None
    except Exception as error:  # numpy and zipfile raise a dozen kinds on damaged files
        raise InputError(f"{path}: not readable as .npz ({one_line(error)}); write it with numpy.savez") from None
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise InputError(f"{path}: tx_pos has shape {list(positions.shape)}, expected [m, 3]; store x, y, z in metres")
    return Inputs(positions, heading, uplink, carriers_hz=carriers)
