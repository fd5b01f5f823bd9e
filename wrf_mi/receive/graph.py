"""Signal strength of paths as Dr.Jit arrays with derivatives; in NumPy: `wrf_mi.receive.channel.rssi_dbm`."""

from __future__ import annotations

from typing import Any

import numpy as np

NO_POWER = 1e-30
"""Added to a power before its logarithm, -300 dB: what receives nothing must not divide by zero."""


def path_power(gain: tuple[Any, Any]) -> Any:
    """Power gain of each path [p] from the real and imaginary part of its gain. Differentiable."""
    import drjit as dr

    return dr.square(gain[0]) + dr.square(gain[1])


def power_sum_db(power: Any, pair: Any, count: int) -> Any:
    """Powers of the paths of each pair of devices added, in dB. Differentiable.

    Args:
        power: of each path, shape [p].
        pair: which pair a path belongs to, unsigned integers [p].
        count: number of pairs.

    Returns:
        Shape [count]; -300 for a pair without a path.
    """
    import drjit as dr

    total = dr.zeros(type(power), count)
    dr.scatter_add(total, power, pair)
    return dr.log(total + NO_POWER) * (10 / np.log(10))
