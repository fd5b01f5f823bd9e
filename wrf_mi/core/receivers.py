"""Receivers as plain arrays, as every file that holds some stores them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .antenna import Antenna
from .types import Receiver

KEYS = ("receiver_name", "receiver_position_m", "receiver_orientation_xyzw", "receiver_antenna")


def receiver_arrays(receivers: Sequence[Receiver]) -> dict[str, NDArray[Any]]:
    """Arrays of n receivers by the names `KEYS`: [n], [n, 3] in metres, [n, 4], and [n, 3] words of the antennas."""
    return {
        "receiver_name": np.array([one.name for one in receivers]),
        "receiver_position_m": np.stack([one.position_m for one in receivers]),
        "receiver_orientation_xyzw": np.stack([one.orientation_xyzw for one in receivers]),
        "receiver_antenna": np.array([astuple(one.antenna) for one in receivers]),
    }


def stored_receivers(arrays: Mapping[str, NDArray[Any]]) -> tuple[Receiver, ...]:
    """The receivers that `receiver_arrays` stored.

    Raises:
        KeyError: one of `KEYS` is missing.
        InputError: an antenna that is none.
    """
    columns = zip(*(arrays[key] for key in KEYS), strict=True)
    return tuple(Receiver(str(n), p, q, Antenna(*map(str, words))) for n, p, q, words in columns)
