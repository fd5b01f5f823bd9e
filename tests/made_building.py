"""Signal strengths in a building of which each receiver covers a part, so that some received few rows or none."""

from dataclasses import replace
from functools import cache

import numpy as np
from calling import SMALL

from wrf_mi.core import Receiver, Record
from wrf_mi.runs.api import Run, train

PLACES_M = {"hall": (0.5, 0.5, 2.5), "stairs": (11.5, 0.5, 2.5), "lab": (6.0, 7.5, 2.5)}
"""Receivers that received every row."""
FAR_M = {"attic": (0.5, 7.5, 2.5), "cellar": (11.5, 7.5, 2.5)}
"""Receivers of which a test states the received rows."""
UPRIGHT = np.array([0.0, 0, 0, 1])
TRAINED, TESTED = 40, 12
FITS = dict.fromkeys(("idw", "kriging", "mri", "trees", "hybrid"), ()) | {
    "wrf-gs+": tuple(SMALL),
    "nerf2": ("steps=2", "validate_every=2"),
    "trees": ("trees=20",),
}
"""Settings of short fits of the models of strengths that need no scene."""
WITH_INTERVALS = ("idw", "trees")


def building(**received: tuple[int, ...]) -> Record:
    """Strengths by a path-loss law with noise of 1 dB: `TRAINED` training rows, then `TESTED` test rows.

    Args:
        received: rows that receivers of `FAR_M` received; those that are not named are not in the record.
    """
    places = PLACES_M | {name: FAR_M[name] for name in received}
    rng = np.random.default_rng(3)
    rows = TRAINED + TESTED
    tx_pos_m = np.column_stack([rng.uniform(0, 12, rows), rng.uniform(0, 8, rows), np.full(rows, 1.3)])
    noise = dict(zip(PLACES_M | FAR_M, rng.normal(0, 1, (len(PLACES_M | FAR_M), rows)), strict=True))
    observation = np.full((len(places), rows), np.nan, np.float32)
    for readings, (name, place) in zip(observation, places.items(), strict=True):
        heard = list(received.get(name, range(rows)))
        distance_m = np.linalg.norm(tx_pos_m[heard] - place, axis=1)
        readings[heard] = -40 - 25 * np.log10(distance_m) + noise[name][heard]
    receivers = tuple(Receiver(name, np.array(place), UPRIGHT) for name, place in places.items())
    official = np.arange(TRAINED), np.arange(TRAINED, rows)
    hz = np.array([2.44e9])
    return Record("building", "rssi", tx_pos_m, receivers, observation, official=official, frequencies_hz=hz)


@cache
def fitted(model: str) -> Run:
    """A fit to the receivers of `PLACES_M` alone, once for all tests of a process."""
    return train(building(), model, settings=FITS[model], intervals=model in WITH_INTERVALS)


def silent_in(record: Record, rows: list[int], *names: str) -> Record:
    """The record in which some receivers received nothing in some rows."""
    observation = record.observation.copy()
    numbers = [number for number, receiver in enumerate(record.receivers) if receiver.name in names]
    observation[np.ix_(numbers, rows)] = np.nan
    return replace(record, observation=observation)
