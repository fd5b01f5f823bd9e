"""Gain, pose and antenna patterns of a receiver as parameters, by name."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core import Receiver
from .pattern_parameters import pattern_coefficients
from .pose import pose_parameters

TX_PATTERN = "pattern.transmitter"
"""Name of the parameter [2, c] of the transmitters' pattern."""


def gain_name(receiver: Receiver) -> str:
    """Name of the parameter [2]: logarithm of the instrument's amplitude, and its phase in rad."""
    return f"receiver.{receiver.name}.gain"


def pattern_name(receiver: Receiver) -> str:
    """Name of the parameter [2, c] of the receiver's pattern, see `wrf_mi.tracing.pattern_parameters`."""
    return f"receiver.{receiver.name}.pattern"


def instrument_parameters(receiver: Receiver, gain: float, pattern_degree: int) -> dict[str, NDArray[np.float32]]:
    """Initial values by name: the stated pose and gain, and with a degree of patterns those of both antennas."""
    values = pose_parameters(receiver) | {gain_name(receiver): np.array([np.log(gain), 0], np.float32)}
    if pattern_degree:
        values |= {name: pattern_coefficients(pattern_degree) for name in (pattern_name(receiver), TX_PATTERN)}
    return values
