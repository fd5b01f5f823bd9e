"""Receivers without training rows, for which a field is evaluated at their pose with means of the others' units."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core import Receiver, Record, Split
from ...graph.graph import LEVEL
from ...training.reach import Reach

Params = dict[str, NDArray[np.float32]]
OF_RECEIVER = "receiver."
"""Prefix of the names of a receiver's parameters."""
MEANS = ("gain", "pattern")
"""Parameters of a receiver whose mean is taken; a pose is the stated one."""


def without_rows(split: Split) -> tuple[int, ...]:
    """Receivers that a split holds out and leaves no row."""
    return tuple(number for number in split.held_receivers if number not in split.left[:, 0])


def trained_part(record: Record, split: Split) -> tuple[Record, Split]:
    """A record and its split with the receivers alone that have training rows."""
    new = without_rows(split)
    if not new:
        return record, split
    kept = np.setdiff1d(np.arange(len(record.receivers)), new)
    return record.at_receivers(kept), split.at_receivers(kept)


def of_all_receivers(
    params: Params, reach: Reach | None, receivers: tuple[Receiver, ...], new: tuple[int, ...]
) -> tuple[Params, Reach | None]:
    """Parameters and reach of a fit without some receivers, for all.

    A new receiver has the mean level, gain (logarithm of an amplitude) and pattern of the others and its stated pose;
    the Gaussians reach as far from the transmitters that any receiver observed.
    """
    if not new:
        return params, reach
    trained = [number for number in range(len(receivers)) if number not in new]
    whole = dict(params)
    for number in new:
        for kind in MEANS:
            names = [f"{OF_RECEIVER}{receivers[other].name}.{kind}" for other in trained]
            found = [params[name] for name in names if name in params]
            if found:
                whole[f"{OF_RECEIVER}{receivers[number].name}.{kind}"] = np.mean(found, axis=0, dtype=np.float32)
    if LEVEL in params:
        level = np.full((1, len(receivers)), params[LEVEL].mean(), np.float32)
        level[:, trained] = params[LEVEL]
        whole[LEVEL] = level
    if reach is None:
        return whole, None
    known = [np.concatenate(reach.known_m)] * len(receivers)
    for number, positions_m in zip(trained, reach.known_m, strict=True):
        known[number] = positions_m
    return whole, replace(reach, known_m=tuple(known))
