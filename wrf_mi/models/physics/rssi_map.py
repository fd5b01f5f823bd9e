"""Traced signal strength as a map: traced once on a grid, local means in between.

What ray tracing tells of a place that is known to a decimetre is the mean over some wavelengths, so powers are averaged
over the neighbourhood before they become decibels. A map needs the scene only while it is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import distance_transform_edt, gaussian_filter

from ...core import InputError, Record
from ...core.angles import FloatArray

MOST_POINTS = 6000
"""Places that are traced at most; the grid becomes wider for larger scenes."""
LAYER_M = 0.5
"""Layers of the grid are at most that far apart over the heights that the transmitter takes."""
SAME_HEIGHT_M = 0.02
LEAST_SHARE = 1e-3
"""Share of a neighbourhood outside of solids below which the nearest point that has more counts."""


@dataclass(frozen=True)
class PowerMap:
    """Local mean of traced power on a grid.

    Attributes:
        x_m: of the grid's columns, ascending.
        y_m: of its rows.
        z_m: of its layers; one layer serves all heights.
        power_dbm: for 0 dBm sent, [n_rx, x, y, z].
    """

    x_m: FloatArray
    y_m: FloatArray
    z_m: FloatArray
    power_dbm: FloatArray

    def __call__(self, position_m: FloatArray, receiver: int) -> FloatArray:
        """Power in dBm at places [m, 3], linear between the grid's points; outside that of its nearest edge."""
        axes = [axis for axis in (self.x_m, self.y_m, self.z_m) if len(axis) > 1]
        which = [k for k, axis in enumerate((self.x_m, self.y_m, self.z_m)) if len(axis) > 1]
        values = self.power_dbm[receiver].reshape([len(axis) for axis in axes])
        inside = [np.clip(position_m[:, k], axis[0], axis[-1]) for k, axis in zip(which, axes, strict=True)]
        return np.asarray(RegularGridInterpolator(axes, values)(np.stack(inside, axis=-1)))


def trace_map(
    scene: Any, record: Record, spacing_m: float, smooth_m: float, max_depth: int, max_reflections: int
) -> PowerMap:
    """Trace a scene on a grid over all of it and all of a record's positions.

    Points of the grid inside closed solids (`wrf_mi.tracing.devices.solids`) are not traced: means over a neighbourhood
    leave them out, and they take the mean of the points outside, or the value of the nearest of these.

    Args:
        scene: from `wrf_mi.tracing.open_scene`.
        record: whose receivers and heights count.
        spacing_m: between the grid's points.
        smooth_m: standard deviation of the Gaussian over which powers are averaged; 0: none.
        max_depth: interactions of a path at most, transmissions included.
        max_reflections: of these.

    Raises:
        InputError: no path to a receiver from anywhere.
    """
    from ...receivers import rssi_dbm
    from ...tracing import TraceOptions, trace_paths
    from ...tracing.devices import solid_around
    from ...tracing.solve import Prepared

    box = scene.mi_scene.bbox()
    low = np.minimum([box.min.x, box.min.y], record.tx_pos_m[:, :2].min(axis=0))
    high = np.maximum([box.max.x, box.max.y], record.tx_pos_m[:, :2].max(axis=0))
    bottom, top = record.tx_pos_m[:, 2].min(), record.tx_pos_m[:, 2].max()
    layers = 1 if top - bottom < SAME_HEIGHT_M else 2 + int((top - bottom) // LAYER_M)
    z_m = np.linspace(bottom, top, layers) if layers > 1 else np.array([(bottom + top) / 2])
    spacing = max(spacing_m, float(np.sqrt(np.prod(high - low) * layers / MOST_POINTS)))
    x_m, y_m = (np.linspace(a, b, 2 + int((b - a) / spacing)) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(x_m, y_m, z_m, indexing="ij"), axis=-1)
    options = TraceOptions(transmission=True, max_depth=max_depth, max_reflections=min(max_reflections, max_depth))
    points, prepared = grid.reshape(-1, 3), Prepared(scene)
    outside = solid_around(prepared.surfaces, points) < 0
    if not outside.any():
        raise InputError("the scene: a solid fills it at all heights of the transmitter; check the mesh and positions")
    traced = np.full((len(record.receivers), len(points)), np.nan)
    how: dict[str, Any] = {"prepared": prepared, "tx_antenna": record.tx_antenna, "check": False}
    found = trace_paths(scene, points[outside], record.receivers, options, **how)
    traced[:, outside] = rssi_dbm(found.paths)
    power = np.where(np.isnan(traced), 0, 10 ** (traced / 10)).reshape(len(record.receivers), *grid.shape[:3])
    steps = [(axis[1] - axis[0]) if len(axis) > 1 else np.inf for axis in (x_m, y_m, z_m)]
    # Not across layers: a floor apart is another place, and they lie wider than the neighbourhood.
    sigma = (0, smooth_m / steps[0], smooth_m / steps[1], 0)
    power = _means_outside(power, outside.reshape(grid.shape[:3]), sigma, steps)
    for receiver, own in zip(record.receivers, power, strict=True):
        if not (own > 0).any():
            raise InputError(f"{receiver.name}: no path from anywhere in the scene; check its position, or max_depth")
        own[own <= 0] = own[own > 0].min()
    return PowerMap(x_m, y_m, z_m, 10 * np.log10(power))


def _means_outside(
    power: FloatArray, outside: NDArray[np.bool_], sigma: tuple[float, ...], steps_m: list[float]
) -> FloatArray:
    """Local means of power [n_rx, x, y, z] over the points outside of solids; the nearest such where there is none."""
    share = gaussian_filter(outside[None].astype(float), sigma, mode="nearest")
    mean = gaussian_filter(power, sigma, mode="nearest") / np.maximum(share, LEAST_SHARE)
    sampling = [step if np.isfinite(step) else 1.0 for step in steps_m]
    nearest = distance_transform_edt(share[0] < LEAST_SHARE, sampling, return_distances=False, return_indices=True)
    return np.asarray(mean[:, *nearest])
