"""Receivers that a fit of Gaussians has not seen: their parameters are means of those of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...core import Receiver, Record, Split
from ...graph.graph import LEVEL
from ...training.by_distance import Reach

Params = dict[str, NDArray[np.float32]]
OF_RECEIVER = "receiver."  # prefix of the names of a receiver's parameters
MEANS = ("gain", "pattern")  # parameters of a receiver whose mean is taken; a pose is the stated one


def without_rows(split: Split) -> tuple[int, ...]:
    """Receivers that a split holds out and leaves no row."""
    return tuple(number for number in split.held_receivers if number not in split.left[:, 0])


def trained_part(record: Record, split: Split) -> tuple[Record, Split]:
    """A record and its split with the receivers alone that have training rows."""
    trained = np.setdiff1d(np.arange(len(record.receivers)), without_rows(split))
    if len(trained) == len(record.receivers):
        return record, split
    return record.at_receivers(trained), split.at_receivers(trained)


def of_all_receivers(
    params: Params, reach: Reach | None, receivers: tuple[Receiver, ...], new: tuple[int, ...]
) -> tuple[Params, Reach | None]:
    """Parameters and reach of a fit without some receivers, for all.

    A new receiver has the mean level, gain (logarithm of an amplitude) and pattern of the others and its stated pose;
    the Gaussians reach as far from the transmitters that any receiver observed.
    """
    if not new:
        return params, reach
    trained, of_all = np.setdiff1d(np.arange(len(receivers)), new), dict(params)
    for kind in MEANS:
        names = np.array([f"{OF_RECEIVER}{receiver.name}.{kind}" for receiver in receivers])
        if values := [params[name] for name in names[trained] if name in params]:
            of_all |= dict.fromkeys(names[[*new]].tolist(), np.asarray(np.mean(values, axis=0, dtype=np.float32)))
    if LEVEL in params:
        of_all[LEVEL] = np.full((1, len(receivers)), params[LEVEL].mean(), np.float32)
        of_all[LEVEL][:, trained] = params[LEVEL]
    if reach is None:
        return of_all, None
    positions_m = dict.fromkeys(range(len(receivers)), np.concatenate(reach.known_m))
    positions_m |= dict(zip(trained, reach.known_m, strict=True))
    return of_all, replace(reach, known_m=tuple(positions_m.values()))
