"""Signal strengths at receivers in buildings of many rooms, whose walls each take some decibels."""

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from wrf_mi.core.angles import FloatArray


class Heard(NamedTuple):
    """Positions [n, 3] and strengths [n] that a receiver received, the size of the area of all rows, its position."""

    tx_pos_m: FloatArray
    power_dbm: FloatArray
    extent_m: float
    place_m: FloatArray


def heard_through_walls(seed: int, rows: int = 150) -> Heard:
    """A building of random size, walked across all of it or along a corridor; one receiver in eight is outside.

    Rooms are rectangles between lines across the building, whose walls take 2 to 12 dB each, outer walls 10 dB; beside
    them shadowing by furniture, fading, rounding, and silence below -92 dBm.
    """
    rng = np.random.default_rng(seed)
    size_m = rng.uniform([15, 10], [60, 30])
    lines_m = [np.sort(rng.uniform(0, size, int(size // 5))) for size in size_m]
    loss_db = [rng.uniform(2, 12, len(lines)) for lines in lines_m]
    tx_pos_m = np.column_stack([rng.uniform(0, size_m, (rows, 2)), np.full(rows, 1.2)])
    if rng.random() < 1 / 3:
        tx_pos_m[:, 1] = size_m[1] * rng.uniform(0.2, 0.8) + rng.uniform(-1, 1, rows)
    place_m = np.append(rng.uniform(0, size_m), rng.uniform(0.5, 3.0))
    outside = rng.random() < 1 / 8
    if outside:
        place_m[1] = -rng.uniform(0, 10)
    distance_m = np.linalg.norm(tx_pos_m - place_m, axis=1)
    furniture_db = 3 * np.linalg.cholesky(np.exp(-cdist(tx_pos_m, tx_pos_m) / 2) + 1e-9 * np.eye(rows))
    power_dbm = rng.uniform(-45, -30) - 20 * np.log10(distance_m) + furniture_db @ rng.normal(size=rows) - 10 * outside
    for axis, (lines, loss) in enumerate(zip(lines_m, loss_db, strict=True)):
        power_dbm -= ((tx_pos_m[:, axis, None] < lines) != (place_m[axis] < lines)) @ loss
    power_dbm = np.round(power_dbm + 10 * np.log10(rng.gamma(3, 1 / 3, rows)))
    received = power_dbm > -92
    received[np.argsort(-power_dbm)[:10]] = True
    extent_m = float(np.linalg.norm(np.ptp(tx_pos_m[:, :2], axis=0)))
    return Heard(tx_pos_m[received], power_dbm[received], extent_m, place_m)
