"""The moving device's heading: directions in its own frame, for a pattern that turns with it.

A device that is carried upright is turned by its yaw psi about +z, from +x towards +y: R_z(psi) takes its own frame to
the world's. A direction u in which a wave leaves is R_z(psi)^T u for the device, as `wrf_mi.tracing.field_calculator`
has it, and a pattern (`wrf_mi.receivers.physical_array.Pattern`, trained: `wrf_mi.tracing.pattern_parameters`) is a
function of that alone.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..core.angles import FloatArray


def body_directions(directions: ArrayLike, heading_rad: ArrayLike) -> FloatArray:
    """World directions [..., 3] in the frame of a device of some heading [...], shape [..., 3]."""
    u, heading = np.asarray(directions, float), np.asarray(heading_rad, float)
    cosine, sine = np.cos(heading), np.sin(heading)
    own = [cosine * u[..., 0] + sine * u[..., 1], cosine * u[..., 1] - sine * u[..., 0], u[..., 2] + 0 * heading]
    return np.stack(own, axis=-1)


def relative_bearing_rad(tx_pos_m: ArrayLike, heading_rad: ArrayLike, receiver_m: ArrayLike) -> FloatArray:
    """Azimuth in which a device sees a receiver, from straight ahead towards its left, in [-pi, pi).

    Args:
        tx_pos_m: of the device [..., 3], metres.
        heading_rad: of the device [...].
        receiver_m: of the receiver [3], metres.
    """
    offset = np.asarray(receiver_m, float) - np.asarray(tx_pos_m, float)
    bearing = np.arctan2(offset[..., 1], offset[..., 0]) - np.asarray(heading_rad, float)
    wrapped: FloatArray = (bearing + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def bearing_harmonics(bearing_rad: ArrayLike, order: int) -> FloatArray:
    """Columns cos(n b), sin(n b) for n = 1 to ``order``, shape [..., 2 * order].

    A horizontal pattern in dB is their sum: linear, so that it is fitted by least squares beside a path loss.
    """
    turns = np.asarray(bearing_rad, float)[..., None] * np.arange(1, order + 1)
    return np.concatenate([np.cos(turns), np.sin(turns)], axis=-1)
