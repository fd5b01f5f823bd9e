"""Units and scales: degrees for metres, receivers and transmitters in different units, strengths that are not dBm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record
from ...core.files import listed
from ...scene.coordinates import LATITUDE, is_geographic

NamedTexts = Iterator[tuple[str, str]]  # names and texts of suspicions

MILLIMETRES = 1e3  # degrees of a place have five decimals or more, metres of a survey three at most
FINE_SHARE = 0.5  # least share of coordinates with a fraction of a millimetre
ROUNDING = 1e-6  # of a coordinate in millimetres, which a file states in decimals
RESOLUTION_M = 1e-3  # resolution of single precision from which positions are said to be far from the origin
METRES_PER_DEGREE = 111e3


def degrees(record: Record) -> NamedTexts:
    """Positions of receivers and transmitters in longitude and latitude, in either order."""
    places = np.stack([receiver.position_m for receiver in record.receivers])[:, :2]
    xy = np.concatenate([places, record.tx_pos_m[:, :2]])
    xy = np.unique(xy[np.isfinite(xy).all(axis=1)], axis=0)
    thousandths = xy * MILLIMETRES
    fine = np.mean(np.abs(thousandths - np.round(thousandths)) > ROUNDING) if len(xy) > 1 else 0.0
    if fine < FINE_SHARE or not is_geographic(xy):
        return
    low, high = xy.min(axis=0), xy.max(axis=0)
    order = "longitude, latitude" if np.abs(high[1]) <= LATITUDE else "latitude, longitude"
    if np.abs(high).max() <= LATITUDE:
        order = "longitude and latitude"  # either order is possible
    what = "receivers and transmitters" if np.isfinite(places).any() else "transmitters"
    text = f"{what} have x from {low[0]:.6f} to {high[0]:.6f} and y from {low[1]:.6f} to {high[1]:.6f}"
    extent_m = float((high - low).max()) * METRES_PER_DEGREE
    remedy = "project them to metres, of a local origin or UTM (pyproj), receivers and transmitters alike"
    yield "degrees", f"{text}: {order} in degrees, of a place some {extent_m:.2g} m wide; {remedy}"


def far_from_origin(record: Record) -> str | None:
    """Note about positions that single precision resolves coarsely, as those of a map projection; None without."""
    places = np.concatenate([record.tx_pos_m, np.stack([receiver.position_m for receiver in record.receivers])])
    largest = float(np.nanmax(np.abs(places), initial=0.0))
    resolution_m = float(np.spacing(np.float32(largest)))
    if resolution_m < RESOLUTION_M:
        return None
    text = f"positions are up to {largest:.4g} m from the origin, as of a map projection"
    what = f"ray tracing and fields of Gaussians, in single precision, resolve {resolution_m:.2g} m there"
    return f"{text}: {what}; subtract a common origin from receivers, transmitters and scene"


def strength_scale(record: Record) -> NamedTexts:
    """Signal strengths of receivers that are nowhere below 0 dBm, 1 mW: a few metres from a strong transmitter."""
    if record.task.name != "rssi":
        return
    pairs = zip(record.receivers, record.observation, strict=True)
    if names := [receiver.name for receiver, observed in pairs if is_above_0_dbm(observed)]:
        what = "powers on a linear scale, per cent (in Windows dBm = quality / 2 - 100), or lack a sign"
        yield "strengths", f"no signal strength of {listed(names)} is below 0 dBm: they are {what}; give dBm"


def is_above_0_dbm(observed: NDArray[Any]) -> bool:
    """Whether strengths [n] are nowhere below 0 dBm, and not all 0."""
    values = observed[np.isfinite(observed)]
    return bool(len(values) and values.min() >= 0 and values.any())
