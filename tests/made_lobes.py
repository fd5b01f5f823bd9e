"""Spectra of a few lobes on a dark ground, which move with the transmitter."""

import numpy as np

from wrf_mi.core import Receiver, Record
from wrf_mi.core.angles import pixel_directions

EXTENT_M = 0.6  # side of the square that transmitters are in, a metre above the receiver


def lobes(size, *, rows=60, width_deg=25.0, peak=1.0, ground=0.0, noise=0.0, reflected=False):
    """A record of spectra with one lobe in the direction of the transmitter; its last fifth is the test set.

    Args:
        size: height and width of a spectrum.
        rows: number of transmitters.
        width_deg: width of a lobe at half of its peak.
        peak: grey at the peak.
        ground: grey elsewhere.
        noise: standard deviation of the noise, whose magnitude is added.
        reflected: whether a second lobe of half the peak comes from the image behind a wall at x = -1 m.
    """
    rng = np.random.default_rng(0)
    half = EXTENT_M / 2
    tx_m = rng.uniform([-half, -half, 0.9], [half, half, 1.1], (rows, 3))
    pixels = pixel_directions(*size).reshape(-1, 3)

    def lobe(source_m: np.ndarray) -> np.ndarray:
        cosine = source_m @ pixels.T / np.linalg.norm(source_m, axis=1, keepdims=True)
        return np.exp(-4 * np.log(2) * np.square(np.arccos(np.clip(cosine, -1, 1)) / np.radians(width_deg)))

    greys = lobe(tx_m)
    if reflected:
        greys = np.maximum(greys, 0.5 * lobe(tx_m * [-1, 1, 1] - [2, 0, 0]))
    greys = ground + (peak - ground) * greys + np.abs(rng.normal(0, noise, greys.shape))
    observed = np.clip(greys, 0, 1).astype(np.float32).reshape(1, rows, *size)
    receiver = Receiver("gateway", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    official = np.split(np.arange(rows), [rows - rows // 5])
    return Record("lobes", "spectrum", tx_m, (receiver,), observed, official=(official[0], official[1]))
