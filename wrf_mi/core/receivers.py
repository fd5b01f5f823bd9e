"""Receivers by name or number, and their arrays in files."""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .antenna import Antenna
from .errors import InputError
from .files import listed, one_line
from .types import Receiver

UNKNOWN = -1  # stored number of elements of a receiver without a known array
CARRIERS = "receiver_frequency_hz"
STORED = operator.attrgetter("name", "position_m", "orientation_xyzw", "antenna", "frequency_hz", "array_m")


def receiver_index(receivers: Sequence[Receiver], receiver: int | str) -> int:
    """Index of a receiver by its name (a string) or number from 0 (an integer); `InputError`: none, or several.

    >>> import numpy as np
    >>> both = [Receiver(name, np.zeros(3), np.array([0.0, 0, 0, 1])) for name in ("kitchen", "0")]
    >>> receiver_index(both, "kitchen"), receiver_index(both, 0), receiver_index(both, "0")
    (0, 0, 1)
    """
    names = [each.name for each in receivers]
    if isinstance(receiver, str):
        if names.count(receiver) > 1:
            numbers = listed(str(index) for index, name in enumerate(names) if name == receiver)
            raise InputError(f"receiver {receiver!r}: name of several; give a number, of {numbers}")
        index = names.index(receiver) if receiver in names else -1
    else:
        try:
            index = -1 if isinstance(receiver, bool) else operator.index(receiver)
        except TypeError:
            index = -1
    if not 0 <= index < len(names):
        text = f"no receiver {one_line(repr(receiver))}; give one of {one_line(listed(names))}"
        raise InputError(f"{text}, or its number from 0 to {len(names) - 1}")
    return index


def receiver_arrays(receivers: Sequence[Receiver]) -> dict[str, NDArray[Any]]:
    """Arrays of n receivers by name.

    Shapes, in the order below: [n]; [n, 3] metres; [n, 4]; [n, 4] attributes of the antennas; [n] number of elements of
    each array; [all, 3] positions of all elements in the receivers' frames, metres; [n] carriers in Hz, if stated.
    """
    names, positions_m, orientations, antennas, frequencies, arrays = zip(*map(STORED, receivers), strict=True)
    carriers = np.array(frequencies, float)  # NaN in place of None
    return {
        "receiver_name": np.array(names),
        "receiver_position_m": np.stack(positions_m),
        "receiver_orientation_xyzw": np.stack(orientations),
        "receiver_antenna": np.array(list(map(astuple, antennas))),
        "receiver_elements": np.array([UNKNOWN if array is None else len(array) for array in arrays]),
        "receiver_elements_m": np.concatenate([np.zeros((0, 3)), *(array for array in arrays if array is not None)]),
        **({} if np.isnan(carriers).all() else {CARRIERS: carriers}),
    }


def stored_receivers(arrays: Mapping[str, NDArray[Any]]) -> tuple[Receiver, ...]:
    """Receivers from the arrays of `receiver_arrays`; `KeyError`: one is missing, `InputError`: an invalid antenna."""
    counts = arrays["receiver_elements"]
    split = np.split(arrays["receiver_elements_m"], np.cumsum(np.maximum(counts, 0))[:-1])
    elements = [None if count == UNKNOWN else array_m for count, array_m in zip(counts, split, strict=True)]
    carriers = [None if np.isnan(hz) else float(hz) for hz in arrays.get(CARRIERS, np.full(len(counts), np.nan))]
    names = ("name", "position_m", "orientation_xyzw", "antenna")
    columns = zip(*(arrays[f"receiver_{name}"] for name in names), elements, carriers, strict=True)
    return tuple(Receiver(str(n), p, q, Antenna(*map(str, words)), m, hz) for n, p, q, words, m, hz in columns)
