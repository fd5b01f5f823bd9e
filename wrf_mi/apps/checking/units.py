"""Units and scales: headings in degrees, positions in millimetres or degrees, linear powers, channels without phase."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core import Record
from ...core.angles import FloatArray
from ...core.files import listed

Found = Iterator[tuple[str, str]]  # name and text of suspicions

WIDEST_RAD = 80.0
"""Range of headings that is degrees rather than radians: a quarter turn of 90 degrees, or 13 turns in radians."""
CONTINUOUS_SHARE = 0.01
"""Largest share of steps above half a turn between consecutive rows of headings that count turns. In flat-ble it is
0.0004, and 0.24 in degrees."""
COURSE_ROWS, STRAIGHT = 5, 0.9
"""Steps of a stretch of the path whose course is used, and least share of its length from end to end."""
FEWEST_COURSES = 50
AGREEMENT = 0.5
"""Least resultant length of headings relative to courses (1: a constant angle between them, 0: any angle)."""

ROOM_M = 100.0  # median distance from transmitter to receiver above which positions are not those of a building
ALLOWED_DBM = 36.0
"""Largest radiated power without a licence (4 W, FCC 15.247). More would be needed over the stated distances."""
STRONGEST = 90  # percentile of the radiated powers: those of the direct path, without a few exceptional rows

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

LINEAR_RANGE = 30.0
"""Ratio of the 99th to the 1st percentile above which numbers are powers on a linear scale: in dB or dBm magnitudes
of, say, 20 to 120 differ by less."""


def heading_unit(record: Record) -> Found:
    """Headings in degrees or clockwise, by the course of the path or by their range."""
    heading = record.tx_heading_rad
    if heading is None or len(record) < 2 or not np.isfinite(heading).all():
        return
    text = f"headings range from {heading.min():.4g} to {heading.max():.4g}"
    in_degrees = "they are degrees; multiply them by pi / 180"
    clockwise = "they run clockwise, as of a compass, or the plan is mirrored; use pi / 2 - heading"
    both = "they are degrees and run clockwise, as of a compass; use pi / 2 - heading * pi / 180"
    readings = {in_degrees: np.radians(heading), clockwise: -heading, both: -np.radians(heading)}
    stretches, course = _courses(record.tx_pos_m[:, :2])
    if len(course) >= FEWEST_COURSES:

        def agreement(angles: FloatArray) -> float:
            return float(np.abs(np.exp(1j * (course - angles[stretches])).mean()))

        stated = agreement(heading)
        best = max(readings, key=lambda remedy: agreement(readings[remedy]))
        if agreement(readings[best]) >= AGREEMENT and stated <= agreement(readings[best]) / 2:
            share = f"their agreement with the path (resultant length) is {stated:.2f}"
            share += f", and {agreement(readings[best]):.2f}"
            yield "headings", f"{text}; {share} if {best}"
            return
        if stated >= AGREEMENT:
            return
    # Headings that count turns may exceed 2 pi, but change by less than half a turn from row to row.
    jumps = np.mean(np.abs(np.diff(heading)) > np.pi)
    if np.ptp(heading) >= WIDEST_RAD and jumps > CONTINUOUS_SHARE:
        yield "headings", f"{text}, and {jumps:.0%} of the steps between rows are above pi: {in_degrees}"


def _courses(xy_m: FloatArray) -> tuple[NDArray[np.int64], FloatArray]:
    """Middle rows and courses (rad) of the straight stretches of a path [n, 2]."""
    if len(xy_m) <= COURSE_ROWS:
        return np.zeros(0, np.int64), np.zeros(0)
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    length, way = along[COURSE_ROWS:] - along[:-COURSE_ROWS], xy_m[COURSE_ROWS:] - xy_m[:-COURSE_ROWS]
    # A transmitter that stands still moves by its position's noise alone.
    moves = length > np.median(length[length > 0]) / 2 if (length > 0).any() else np.zeros(len(length), bool)
    straight = np.flatnonzero(moves & (np.linalg.norm(way, axis=1) >= STRAIGHT * length))
    return straight + COURSE_ROWS // 2, np.arctan2(way[straight, 1], way[straight, 0])


def distances_m(record: Record) -> FloatArray:
    """Distance from each transmitter to each receiver [n_rx, n]; NaN where a position is not known."""
    places = np.stack([receiver.position_m for receiver in record.receivers])
    return np.linalg.norm(record.tx_pos_m[None] - places[:, None], axis=-1)


def position_unit(record: Record) -> Found:
    """Positions in centimetres or millimetres, by distances beyond a building's and by the power that they need."""
    distance = distances_m(record)
    known = np.isfinite(distance)
    if not known.any() or np.median(distance[known]) <= ROOM_M:
        return
    middle = float(np.median(distance[known]))
    evidence = f"the median distance from transmitter to receiver is {middle:.4g} m"
    hz = record.carriers_hz if record.carriers_hz is not None else record.frequencies_hz
    if record.task.name == "rssi" and hz is not None:
        loss_db = 20 * np.log10(4 * np.pi * distance * np.broadcast_to(hz, len(record)) / speed_of_light)
        received = known & np.isfinite(record.observation)
        radiated = np.percentile((record.observation + loss_db)[received], STRONGEST) if received.any() else 0.0
        if radiated <= ALLOWED_DBM:
            return
        evidence += f", over which the signal strengths need {radiated:.0f} dBm of radiated power"
    units = f"millimetres ({middle / 1e3:.3g} m)"
    if middle < 1e3:
        units = f"centimetres ({middle / 1e2:.3g} m) or {units}"
    yield "positions", f"{evidence}: positions are in {units}; give metres, of receivers and transmitters"


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
    """Powers on a linear scale, or decibels without their sign, in the training rows, the test rows or both."""
    if record.task.name != "rssi":
        return
    parts = {"training rows": np.arange(len(record)), "test rows": np.zeros(0, np.int64)}
    if record.official is not None:
        parts = dict(zip(parts, record.official, strict=True))
    wrong: dict[tuple[str, str], list[str]] = {}
    for receiver, observed in zip(record.receivers, record.observation, strict=True):
        above = [part for part, rows in parts.items() if is_above_0_dbm(observed[rows])]
        if above:
            scale = _scale(observed[np.concatenate([parts[part] for part in above])])
            wrong.setdefault((" and ".join(above), scale), []).append(receiver.name)
    for (part, scale), names in wrong.items():
        yield "strengths", f"signal strengths in {part} of {listed(names)} are {scale}"


def is_above_0_dbm(observed: NDArray[Any]) -> bool:
    """Whether strengths [n] are nowhere below 0 dBm, which is 1 mW: a few metres from a strong transmitter."""
    values = observed[np.isfinite(observed)]
    return bool(len(values) and values.min() >= 0 and values.any())


def _scale(observed: NDArray[Any]) -> str:
    """What strengths [n] are that are nowhere below zero."""
    values = observed[np.isfinite(observed)]
    low, high = np.percentile(values[values > 0], [1, 99])  # zero is nothing on a linear scale
    if high < 1 or high > LINEAR_RANGE * low:
        return "powers on a linear scale; give dBm, 10 log10 of the milliwatts"
    if high <= 100:
        quality = "they are a quality in per cent (dBm = quality / 2 - 100 in Windows)"
        return (
            f"above 0 dBm everywhere: the minus sign is missing, {quality}, or they are dB above a microvolt; give dBm"
        )
    return "above 0 dBm everywhere: the minus sign is missing, or they are dB above a microvolt; give dBm"


def channel_phase(record: Record) -> Found:
    """Channels that hold magnitudes or decibels in place of complex coefficients."""
    if record.task.name != "csi":
        return
    parts = {"channel": record.observation, "uplink": record.uplink}
    for name, values in parts.items():
        if values is None:
            continue
        real = values.real[np.isfinite(values)]
        if not len(real) or values.imag[np.isfinite(values)].any():
            continue
        if (real <= 0).all() and real.any():
            what = "decibels; give complex coefficients, 10^(value / 20) times their phase factor"
        elif (real >= 0).all():
            what = "magnitudes without phase; give complex coefficients"
        else:
            what = "without imaginary part; give complex coefficients"
        yield "channels", f"all {name} coefficients are real, {real.min():.4g} to {real.max():.4g}: {what}"
