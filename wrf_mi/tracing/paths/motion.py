"""Motion of transmitters, receivers and objects: how fast the lengths of paths change."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core import InputError, Paths
from ...core.types import FloatArray
from ...scene.materials import FASTEST_MPS
from ..search.chains import TRANSMISSION


def checked_velocities(stated: ArrayLike | None, count: int, what: str) -> FloatArray:
    """Velocities [count, 3], m/s, of what is named; None: at rest. `InputError`: not finite, or above `FASTEST_MPS`."""
    values = np.broadcast_to(np.asarray(0.0 if stated is None else stated, float), (count, 3))
    for row in np.flatnonzero(~(np.linalg.norm(values, axis=1) < FASTEST_MPS))[:1]:
        text = f"its velocity is {values[row].tolist()}; give finite numbers, below {FASTEST_MPS:g} m/s"
        raise InputError(f"{what} {row + 1}: {text}")
    return values


def length_rates(
    paths: Paths,
    tx_pos_m: FloatArray,
    rx_pos_m: FloatArray,
    tx_velocity_mps: FloatArray,
    rx_velocity_mps: FloatArray,
    object_velocity_mps: FloatArray,
) -> FloatArray:
    """Rate of change [p], m/s, of the lengths of paths.

    The sum over the segments of a path of (v_(i+1) - v_i) . k_i, with the velocities v of a segment's ends and its
    direction k. Points of reflection and diffraction slide along their surfaces, which to first order has no effect on
    the length (Fermat's principle), so that they may be taken to move with their objects.

    Args:
        paths: traced paths.
        tx_pos_m: transmitters [n_tx, 3], metres.
        rx_pos_m: receivers [n_rx, 3], metres.
        tx_velocity_mps: velocities of the transmitters [n_tx, 3], m/s.
        rx_velocity_mps: velocities of the receivers [n_rx, 3], m/s.
        object_velocity_mps: velocities of the objects ``paths.object_names`` [n_objects, 3], m/s.

    Source: Sionna RT, ``Paths.doppler``, whose shift is the negative rate divided by the wavelength.
    """
    rate = np.zeros(len(paths))
    if not any(map(np.any, (tx_velocity_mps, rx_velocity_mps, object_velocity_mps))):
        return rate
    # Point and velocity of each interaction, and after them those of the receiver.
    points = [*np.moveaxis(paths.vertices_m, 1, 0), rx_pos_m[paths.rx]]
    objects = np.concatenate([object_velocity_mps, np.zeros((1, 3))])[paths.objects]  # -1, no object: the last
    velocities = [*np.moveaxis(objects, 1, 0), rx_velocity_mps[paths.rx]]
    # A transmission keeps the direction of a path, so that the motion of its surface has no effect: such points are
    # left out, as touching surfaces have points too close together to tell a direction.
    bends = [*((paths.interactions != 0) & (paths.interactions != TRANSMISSION)).T, np.ones(len(paths), bool)]
    point, velocity = tx_pos_m[paths.tx], tx_velocity_mps[paths.tx]
    for following, its_velocity, bent in zip(points, velocities, bends, strict=True):
        way = np.where(bent[:, None], following - point, 0.0)
        length = np.linalg.norm(way, axis=1)
        rate += np.sum((its_velocity - velocity) * way, axis=1) / np.where(length > 0, length, 1.0)
        point, velocity = np.where(bent[:, None], (following, its_velocity), (point, velocity))
    return rate
