"""A made building, walked several times by phones of different offsets."""

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.core.antenna import UPRIGHT

NOISE_DB = 2.0
STEPS = 60  # rows of a walk
SIDE_M = 30.0


def walked(offset_db: dict[str, float], seed: int = 0) -> Record:
    """Walks by the name of their run, each a line across a square with eight receivers; the last two test.

    Shadowing is smooth over metres, and the same in all walks.
    """
    rng = np.random.default_rng(seed)
    places_m = np.column_stack([rng.uniform(0, SIDE_M, (8, 2)), np.full(8, 2.5)])
    receivers = tuple(Receiver(f"anchor{k}", place, np.array(UPRIGHT)) for k, place in enumerate(places_m))
    ends = rng.uniform(0, SIDE_M, (len(offset_db), 2, 2))
    ends[:, 0, 0], ends[:, 1, 0] = 0, SIDE_M  # from one side to the other: walks cross
    share = np.linspace(0, 1, STEPS)[:, None]
    tx_m = np.concatenate([np.column_stack([a + share * (b - a), np.full(STEPS, 1.3)]) for a, b in ends])
    waves, phases = rng.normal(0, 0.4, (8, 12, 2)), rng.uniform(0, 2 * np.pi, (8, 12, 1))
    shadow_db = 2 * np.cos(waves @ tx_m[:, :2].T + phases).sum(axis=1)
    distance_m = np.linalg.norm(tx_m - places_m[:, None], axis=2)
    runs = np.repeat(list(offset_db), STEPS)
    power = -40 - 20 * np.log10(distance_m) + shadow_db + np.repeat(list(offset_db.values()), STEPS)
    power += rng.normal(0, NOISE_DB, power.shape)
    rows, tested = np.arange(len(tx_m)), 2 * STEPS
    return Record(
        "walks",
        "rssi",
        tx_m,
        receivers,
        power.astype(np.float32),
        official=(rows[:-tested], rows[-tested:]),
        frequencies_hz=np.array([2.44e9]),
        runs=runs,
    )
