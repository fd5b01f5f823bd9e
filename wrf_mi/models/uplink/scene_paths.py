"""Paths of a scene as the start of the search in an uplink (`wrf_mi.models.uplink.uplink_paths`).

Over a band of some megahertz an uplink tells directions well, but lengths only to metres, and the phase between the
bands turns with the length. A mesh that is centimetres off knows lengths far better. Gains are those of the uplink
alone: materials are not needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ...core import Antenna, InputError, Receiver
from ...core.angles import FloatArray
from ...tracing.options import TraceOptions
from .csi_bands import principal_axes
from .uplink_paths import Start, expected_gains, in_parts
from .uplink_waves import Complex, Waves

CHUNK_SIZE = 256
"""Positions that are traced together."""
LENGTH_SD_M, COSINE_SD = 0.3, 0.03
"""Standard deviations of a path's length and its direction's cosines, by a mesh that is some centimetres off."""
ALIKE_M, ALIKE_COSINE = 0.02, 0.01
"""Paths that differ by less count as one."""
FAINT = 10 ** (-50 / 20)
"""Least amplitude of a path, as a share of the root mean square of all."""
MOST = 70
"""Most traced paths of a row, the strongest."""
NEEDED = 1e-4
"""Least power of a path in the uplink, as a share of the strongest path's."""


class ScenePaths:
    """Paths of transmitters to a receiver.

    Args:
        scene: scene from `wrf_mi.tracing.open_scene`.
        receiver: receiver with an array.
        tx_antenna: antenna of the transmitters.
        options: options of the search.
    """

    def __init__(self, scene: Any, receiver: Receiver, tx_antenna: Antenna, options: TraceOptions) -> None:
        from ...tracing.solve import Prepared
        from ...tracing.traced_field import TracedOptions

        assert receiver.array_m is not None
        self._scene, self._receiver, self._prepared = scene, receiver, Prepared(scene)
        self._options = TracedOptions(options, tx_antenna=tx_antenna)
        self._centre, self._axes = receiver.array_m.mean(axis=0), principal_axes(receiver.array_m)

    def __call__(self, waves: Waves, h: Complex, tx_pos_m: FloatArray, heading_rad: FloatArray | None) -> Start:
        """Paths that explain uplinks [n, antennas, f] of transmitters [n, 3], metres, with yaw [n] in rad or None.

        Raises:
            InputError: positions that are not known, or inside a solid.
        """
        if not np.isfinite(tx_pos_m).all():
            raise InputError("r2f2 with a scene: traces from positions; give finite x, y, z in metres for every row")
        rows = list(self._rows(tx_pos_m, heading_rad))
        theta = np.zeros((len(rows), max(1, *map(len, rows)), 1 + len(self._axes)))
        theta[..., 0] = 1.0  # of absent paths: any length that is not zero
        present = np.zeros(theta.shape[:2], bool)
        for number, row in enumerate(rows):
            theta[number, : len(row)], present[number, : len(row)] = row, True

        def needed(part: slice) -> Any:
            solved = waves.solve(theta[part], present[part], h[part])
            return expected_gains(waves, h[part], present[part], solved)[1]

        power = np.concatenate(in_parts(needed, len(h)))
        present &= power > NEEDED * power.max(axis=1, keepdims=True)
        order = np.argsort(~present, axis=1, kind="stable")[:, : max(1, int(present.sum(axis=1).max()))]
        theta = np.take_along_axis(theta, order[..., None], axis=1)
        precision = np.broadcast_to(np.r_[LENGTH_SD_M, np.full(len(self._axes), COSINE_SD)] ** -2.0, theta.shape)
        return Start(theta, np.take_along_axis(present, order, axis=1), precision)

    def _rows(self, tx_pos_m: FloatArray, heading_rad: FloatArray | None) -> Iterator[FloatArray]:
        """Lengths and direction cosines [k, p] of each transmitter's paths, seen from the middle of the array."""
        from ...tracing.traced_field import TracedField

        for start in range(0, len(tx_pos_m), CHUNK_SIZE):
            part = slice(start, start + CHUNK_SIZE)
            turned = None if heading_rad is None else heading_rad[part]
            given = tx_pos_m[part], self._receiver, self._options, turned
            self._prepared.check(tx_pos_m[part], (self._receiver,))
            traced = TracedField(self._scene, *given, prepared=self._prepared)
            found = traced({})
            shape = found.batch, found.each
            amplitude = np.hypot(*(part.numpy() for part in found.gain)).reshape(shape)
            arrival = np.stack([u.numpy() for u in found.arrival], axis=-1).reshape(*shape, 3)
            source = arrival * found.length_m.numpy().reshape(*shape, 1) - self._centre
            length = np.linalg.norm(source, axis=-1, keepdims=True)
            every = np.concatenate([length, source / length @ self._axes.T], axis=-1)
            for strength, row in zip(amplitude * traced.exists.reshape(shape), every, strict=True):
                yield distinct(row, strength)


def distinct(theta: FloatArray, strength: FloatArray) -> FloatArray:
    """The strongest different paths [k, p] among some with strengths [m], 0 for place holders."""
    order = np.argsort(-strength, kind="stable")
    least = FAINT * np.sqrt(np.square(strength).sum())
    kept: list[int] = []
    for place in order[strength[order] > least]:
        apart = np.abs(theta[kept] - theta[place])
        if not ((apart[:, 0] < ALIKE_M) & (apart[:, 1:] < ALIKE_COSINE).all(axis=1)).any():
            kept.append(int(place))
        if len(kept) == MOST:
            break
    return theta[kept]
