"""From the public original of the NeWRF rooms to the layout of `wrf_mi.datasets.newrf`.

Original: ``data/dataset_<room>_ch1_rt_image_fc.pkl`` of https://github.com/LuHaofan/NeWRF, a pickled pandas table that
their ``simulator/mat2pkl.py`` wrote, one row per receiver. ``TxPos``, ``RxPos`` (m), ``Frequency`` (GHz), ``CSI``,
``LastXPts`` [3, p], ``RxChanPerRay`` [p, 1] and ``LineOfSight`` are used. Receivers without a path have no numbers and
are left out, as their ``loaders.py`` does.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError
from ..core.files import one_line
from .pickled_table import read_pickled_table

SCALARS = ("TxID", "RxID", "Frequency", "LineOfSight")
ARRAYS = ("TxPos", "RxPos", "CSI", "LastXPts", "RxChanPerRay")


def convert_newrf(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a room's ``.npz`` file from the authors' pickle, of which nothing is run.

    Raises:
        InputError: not their pickle.
    """
    columns = read_pickled_table(path)
    lacking = sorted(set(SCALARS + ARRAYS) - set(columns))
    if lacking:
        raise InputError(f"{path}: no column {lacking[0]}; give a data set of NeWRF for a single frequency")
    try:
        return _convert(columns)
    except (ValueError, TypeError, IndexError) as error:
        raise InputError(f"{path}: not in the form of NeWRF's data ({one_line(error)}); fetch it again") from None


def _convert(columns: dict[str, Any]) -> dict[str, NDArray[Any]]:
    scalars = {key: np.asarray(columns[key], float) for key in SCALARS}
    rows = np.flatnonzero(np.isfinite(np.stack(list(scalars.values()))).all(axis=0))
    tx_pos, frequency_ghz = (
        np.unique(np.stack([np.asarray(values[r], float) for r in rows]), axis=0)
        for values in (columns["TxPos"], scalars["Frequency"])
    )
    if len(tx_pos) != 1 or len(frequency_ghz) != 1:
        raise ValueError(f"{len(tx_pos)} transmitters and {len(frequency_ghz)} frequencies")
    gains = [np.asarray(columns["RxChanPerRay"][r], complex).ravel() for r in rows]
    points = [np.asarray(columns["LastXPts"][r], float).T.reshape(-1, 3) for r in rows]
    if any(len(g) != len(p) for g, p in zip(gains, points, strict=True)):
        raise ValueError("a receiver with another number of gains than of points")
    return {
        "tx_pos": tx_pos[0].reshape(3),
        "rx_pos": np.stack([np.asarray(columns["RxPos"][r], float).reshape(3) for r in rows]),
        "frequency_hz": np.asarray(frequency_ghz[0] * 1e9),
        "csi": np.concatenate([np.asarray(columns["CSI"][r], complex).reshape(1) for r in rows]),
        "line_of_sight": scalars["LineOfSight"][rows] > 0,
        "path_offsets": np.concatenate([[0], np.cumsum([len(g) for g in gains])]),
        "path_gain": np.concatenate(gains),
        "path_last_point": np.concatenate(points),
    }
