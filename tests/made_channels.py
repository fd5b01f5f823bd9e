"""Uplink and downlink of a base station with three antennas."""

from typing import Any

import numpy as np

from wrf_mi.core import Receiver, Record

ROWS, ANTENNAS, SUBCARRIERS = 30, 3, 4


def channels(positions: bool = True) -> Record:
    """A downlink that is its uplink turned by a tenth, at an array of three antennas."""
    rng = np.random.default_rng(8)
    shape = (ROWS, ANTENNAS, SUBCARRIERS)
    uplink = (rng.normal(size=shape) + 1j * rng.normal(size=shape)).astype(np.complex64)
    tx_pos = rng.uniform(0, 4, (ROWS, 3)) if positions else np.full((ROWS, 3), np.nan)
    array_m = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    place, upright = np.array([0.0, 0, 2]), np.array([0.0, 0, 0, 1])
    receiver = Receiver("base-station", place, upright, array_m=array_m)
    downlink, official = (uplink * np.exp(0.1j)).astype(np.complex64)[None], (np.arange(20), np.arange(20, ROWS))
    carriers: dict[str, Any] = {
        name: hz + 1e6 * np.arange(SUBCARRIERS) for name, hz in (("frequencies_hz", 2.4e9), ("uplink_hz", 2.3e9))
    }
    return Record("made-up", "csi", tx_pos, (receiver,), downlink, official=official, uplink=uplink, **carriers)
