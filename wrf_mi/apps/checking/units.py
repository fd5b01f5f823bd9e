"""Units and scales: degrees for metres, receivers and transmitters in different units, strengths that are not dBm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core import Record
from ...core.angles import FloatArray
from ...core.files import listed

Found = Iterator[tuple[str, str]]  # name and text of suspicions

LONGITUDE, LATITUDE = 180.0, 90.0
WIDEST_DEG = 1.0  # largest extent of a place in degrees, 111 km of latitude
AWAY = 20.0
"""Least distance from the origin in extents of the place: 1 km at 0.2 degrees. A room of metres whose origin is twenty
of its lengths away is not less than a metre wide."""
MILLIMETRES = 1e3  # degrees of a place have five decimals or more, metres of a survey three at most
FINE_SHARE = 0.5  # least share of coordinates with a fraction of a millimetre
ROUNDING = 1e-6  # of a coordinate in millimetres, which a file states in decimals
APART_M = 20.0  # least distance between receivers and transmitters where the ones are in degrees and the others are not
RESOLUTION_M = 1e-3  # resolution of single precision from which positions are said to be far from the origin
METRES_PER_DEGREE = 111e3


def degrees(record: Record) -> Found:
    """Positions in longitude and latitude, in either order, of receivers, of transmitters or of both."""
    receivers = np.stack([receiver.position_m for receiver in record.receivers])[:, :2]
    for what, xy in _in_degrees(receivers, record.tx_pos_m[:, :2]).items():
        low, high = xy.min(axis=0), xy.max(axis=0)
        order = "longitude, latitude" if np.abs(high[1]) <= LATITUDE else "latitude, longitude"
        if np.abs(high).max() <= LATITUDE:
            order = "longitude and latitude"  # either order is possible
        extent_m = float((high - low).max()) * METRES_PER_DEGREE
        text = f"{what} have x from {low[0]:.6f} to {high[0]:.6f} and y from {low[1]:.6f} to {high[1]:.6f}"
        remedy = "project them to metres, of a local origin or UTM (pyproj), receivers and transmitters alike"
        yield "degrees", f"{text}: {order} in degrees, of a place some {extent_m:.2g} m wide; {remedy}"


def _in_degrees(receivers: FloatArray, transmitters: FloatArray) -> dict[str, FloatArray]:
    """Distinct coordinates [n, 2] that are in degrees, of both together or of the ones where both are apart."""
    groups = {"receivers": receivers, "transmitters": transmitters}
    groups = {what: np.unique(xy[np.isfinite(xy).all(axis=1)], axis=0) for what, xy in groups.items()}
    if all(map(len, groups.values())):
        both = np.concatenate(list(groups.values()))
        if _is_in_degrees(both):
            return {"receivers and transmitters": both}
        first, second = (np.median(xy, axis=0) for xy in groups.values())
        if np.linalg.norm(first - second) < APART_M:
            return {}
    return {what: xy for what, xy in groups.items() if _is_in_degrees(xy)}


def _is_in_degrees(xy: FloatArray) -> bool:
    """Whether distinct coordinates [n, 2] look like degrees of a place: fine, close together, and far from zero."""
    if len(xy) < 2:
        return False
    extent, largest = float(np.ptp(xy, axis=0).max()), np.abs(xy).max(axis=0)
    in_range = largest.max() <= LONGITUDE and largest.min() <= LATITUDE
    thousandths = xy * MILLIMETRES
    fine = np.mean(np.abs(thousandths - np.round(thousandths)) > ROUNDING)
    return bool(in_range and 0 < extent <= WIDEST_DEG and largest.max() >= AWAY * extent and fine >= FINE_SHARE)


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


def strength_scale(record: Record) -> Found:
    """Signal strengths of receivers that are nowhere below 0 dBm, 1 mW: a few metres from a strong transmitter."""
    if record.task != "rssi":
        return
    pairs = zip(record.receivers, record.observation, strict=True)
    if names := [receiver.name for receiver, observed in pairs if is_above_0_dbm(observed)]:
        what = "powers on a linear scale, per cent (in Windows dBm = quality / 2 - 100), or lack a sign"
        yield "strengths", f"no signal strength of {listed(names)} is below 0 dBm: they are {what}; give dBm"


def is_above_0_dbm(observed: NDArray[Any]) -> bool:
    """Whether strengths [n] are nowhere below 0 dBm, and not all 0."""
    values = observed[np.isfinite(observed)]
    return bool(len(values) and values.min() >= 0 and values.any())
