"""What measurements tell about a traced room: materials, antenna patterns and what the decibels count from.

    rssi = offset_rx + 10 log10 sum_p |g_p|^2 10^((T(u_p) + A_rx(v_p)) / 10)

over the paths p of a pair, whose powers are added; g_p follows the materials, T and A are patterns in dB over the
direction of departure u in the transmitter's body and of arrival v at each receiver. (A loss per metre for furniture
was tried and left out: on held-out places it changed the error by less than 0.02 dB.)
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import InputError
from ..core.angles import FloatArray
from .result import TraceResult, recompute


@dataclass(frozen=True)
class Calibration:
    """Fitted values.

    Attributes:
        offset_db: of each receiver, shape [n_rx].
        tx_pattern_db: coefficients of T on real spherical harmonics from degree 1 on, shape [k]; k may be 0.
        rx_pattern_db: coefficients of each receiver's A, shape [n_rx, j]; j may be 0.
        materials: relative permittivity and conductivity (S/m) by the material's name in the scene.
    """

    offset_db: FloatArray
    tx_pattern_db: FloatArray
    rx_pattern_db: FloatArray
    materials: Mapping[str, tuple[float, float]]


def harmonics(directions: FloatArray, degree: int) -> NDArray[np.float32]:
    """Real spherical harmonics of degree 1 to ``degree`` of unit vectors [p, 3], shape [(degree + 1)^2 - 1, p].

    Source: Sloan, "Efficient spherical harmonic evaluation" (2013), JCGT 2(2), as in ``drjit.sh_eval``.
    """
    import drjit as dr
    import mitsuba as mi

    from ..backend.device import to_vectors

    if degree == 0 or not len(directions):
        return np.zeros(((degree + 1) ** 2 - 1, len(directions)), np.float32)
    values: Any = dr.sh_eval(to_vectors(directions, mi.Vector3f), degree)
    return np.stack([np.broadcast_to(np.asarray(value), len(directions)) for value in values[1:]])


def degree_of(count: int) -> int:
    """Degree of a pattern with so many coefficients."""
    return round(np.sqrt(count + 1)) - 1


def in_body(directions: FloatArray, heading_rad: FloatArray) -> FloatArray:
    """Directions [p, 3] (world) in a frame turned by a yaw [p] about +z."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    x, y, z = directions.T
    return np.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1)


@contextmanager
def with_materials(scene: Any, materials: Mapping[str, tuple[Any, Any]]) -> Iterator[None]:
    """Give materials of a ``sionna.rt.Scene`` other constants while the block lasts.

    Args:
        scene: ``sionna.rt.Scene``.
        materials: relative permittivity and conductivity (S/m) by name, numbers or Dr.Jit arrays with derivatives.

    Raises:
        InputError: the scene has no such material.
    """
    if unknown := [name for name in materials if name not in scene.radio_materials]:
        raise InputError(f"scene: no radio material {unknown[0]!r}; the calibration is of another scene")
    before = []
    for name, (permittivity, conductivity) in materials.items():
        material = scene.radio_materials[name]
        constants = material.relative_permittivity, material.conductivity
        before.append((material, material.frequency_update_callback, constants))
        material.frequency_update_callback = None
        material.relative_permittivity, material.conductivity = permittivity, conductivity
    try:
        yield
    finally:
        for material, callback, constants in before:
            material.relative_permittivity, material.conductivity = constants
            material.frequency_update_callback = callback


def calibrated_rssi(
    calibration: Calibration, trace: TraceResult, scene: Any, tx_heading_rad: ArrayLike | None = None
) -> FloatArray:
    """Signal strengths of traced paths as the instruments would report them.

    Args:
        calibration: from `wrf_mi.trace.calibrate`.
        trace: paths, with any materials.
        scene: they are of; it keeps its own materials.
        tx_heading_rad: yaw of each transmitter's body, shape [n_tx]; None: 0, which is right only where the fit had no
            headings either.

    Returns:
        dBm [n_rx, n_tx], NaN where no path arrives.

    Raises:
        InputError: another number of receivers, or materials that the scene has not.
    """
    paths = trace.paths
    if len(calibration.offset_db) != paths.n_rx:
        text = f"{len(calibration.offset_db)} receivers calibrated, {paths.n_rx} traced"
        raise InputError(f"calibration: {text}; calibrate anew")
    with with_materials(scene, calibration.materials):
        gain = recompute(trace, scene).paths.gain
    heading = np.zeros(paths.n_tx) if tx_heading_rad is None else np.asarray(tx_heading_rad, float)
    own = harmonics(in_body(paths.departure, heading[paths.tx]), degree_of(len(calibration.tx_pattern_db)))
    theirs = harmonics(paths.arrival, degree_of(calibration.rx_pattern_db.shape[1]))
    decibel = calibration.tx_pattern_db @ own + (calibration.rx_pattern_db[paths.rx].T * theirs).sum(axis=0)
    power = np.zeros((paths.n_rx, paths.n_tx))
    np.add.at(power, (paths.rx, paths.tx), np.abs(gain) ** 2 * 10 ** (decibel / 10))
    rssi = np.full(power.shape, np.nan)
    np.log10(power, out=rssi, where=power > 0)
    return 10 * rssi + calibration.offset_db[:, None]
