"""Made-up records with what `wrf_mi.apps.checking` looks for: lines of sight, distance laws, headings along a path."""

from typing import Any

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.core.angles import pixel_directions

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
WALL = np.array([0.5, 0.5, 0.5, 0.5])
"""Orientation of an array on the wall x = 0: its normal, z, is the world's x axis."""
SIZE = (30, 120)
CARRIER_HZ = np.array([2.44e9])


def spectra(rows=200, seed=0, direct=1.0, reflectors=2, spread_m=4.0, orientation=WALL) -> Record:
    """Spectra of a 4 x 4 array on the wall of a hall: the direct path, and paths of reflectors that do not move."""
    rng = np.random.default_rng(seed)
    receiver = Receiver("gateway1", np.array([0.0, 4.0, 1.5]), orientation)
    tx = rng.uniform([1.0, 4.0 - spread_m, 0.3], [1.0 + 2 * spread_m, 4.0 + spread_m, 2.5], (rows, 3))
    to_tx = (tx - receiver.position_m) @ receiver.to_world
    fixed = rng.normal(size=(reflectors, 3))
    fixed *= np.sign(fixed[:, 2:])
    ways = np.concatenate([to_tx[:, None], np.broadcast_to(fixed, (rows, reflectors, 3))], axis=1)
    phases = np.exp(2j * np.pi * rng.uniform(size=(rows, 1 + reflectors)))
    gains = np.column_stack([np.full(rows, direct), rng.uniform(0.2, 0.5, (rows, reflectors))]) * phases
    signals = (_steering(ways) * gains[..., None]).sum(axis=1)
    images = np.abs(signals @ _steering(pixel_directions(*SIZE).reshape(-1, 3)).conj().T)
    images = (images - images.min(axis=1, keepdims=True)) / np.ptp(images, axis=1, keepdims=True)
    observed = images.astype(np.float32).reshape(1, rows, *SIZE)
    return Record("hall", "spectrum", tx, (receiver,), observed, official=_split(rows), frequencies_hz=CARRIER_HZ)


def _split(rows: int) -> tuple[np.ndarray, np.ndarray]:
    return np.arange(rows - 20), np.arange(rows - 20, rows)


def _steering(directions: np.ndarray) -> np.ndarray:
    """Phase factors [..., 16] of elements half a wavelength apart, of directions in the array's frame."""
    directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    elements = np.array([np.ravel(axis) for axis in np.mgrid[:4, :4]])
    return np.exp(1j * np.pi * directions[..., :2] @ elements)


def strengths(rows: int = 120, receivers: int = 4, seed: int = 0, noise_db: float = 4.0) -> Record:
    """Signal strengths on a walk through a hall of 12 x 8 m, with headings along it (radians, one turn)."""
    rng = np.random.default_rng(seed)
    places = np.array([[0.5, 1.0, 2.2], [11.0, 0.8, 2.4], [3.0, 7.5, 2.0], [11.5, 7.0, 2.3]])[:receivers]
    turn = np.linspace(0, 6 * np.pi, rows)
    tx = np.stack([6 + 4.5 * np.cos(turn / 3), 4 + 3 * np.sin(turn / 2), np.full(rows, 1.3)], axis=-1)
    way = np.diff(tx, axis=0, append=tx[-1:] + (tx[-1:] - tx[-2:-1]))
    distance = np.linalg.norm(tx[None] - places[:, None], axis=-1)
    levels = -40 - 20 * np.log10(distance) + rng.normal(0, noise_db, distance.shape)
    anchors = tuple(Receiver(f"anchor{k + 1}", place, UPRIGHT) for k, place in enumerate(places))
    facts: dict[str, Any] = {
        "official": _split(rows),
        "frequencies_hz": CARRIER_HZ,
        "tx_heading_rad": np.arctan2(way[:, 1], way[:, 0]),
    }
    return Record("walk", "rssi", tx, anchors, levels.astype(np.float32), **facts)


def channels(rows: int = 60, seed: int = 0) -> Record:
    """Channels of a single antenna in free space with some noise."""
    rng = np.random.default_rng(seed)
    receiver = Receiver("access-point", np.array([0.5, 0.5, 2.5]), UPRIGHT)
    tx = rng.uniform([0.5, 0.5, 0.5], [8.0, 6.0, 2.0], (rows, 3))
    distance = np.linalg.norm(tx - receiver.position_m, axis=1)
    noise = 0.1 * (rng.normal(size=rows) + 1j * rng.normal(size=rows))
    values = 0.01 / distance * (np.exp(-50j * distance) + noise)
    observed = values.astype(np.complex64)[None, :, None]
    return Record("room", "csi", tx, (receiver,), observed, frequencies_hz=np.array([2.4e9]))
