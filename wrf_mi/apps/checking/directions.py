"""Spectra and the line of sight: image rows and columns, orientation and plan that are read wrongly.

The order of image rows is found without positions: all columns of the row at the zenith have the same direction. The
origin of columns is found by the line of sight: where it is free, spectra are bright in the direction of the
transmitter. Another reading is likely if the spectra are brighter there in all parts of the place, and if the bright
direction moves with the transmitter; lobes that do not move are those of reflectors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from ...core import Record
from ...core.angles import FloatArray, azimuth_elevation, solid_angles
from ...core.types import IntArray
from .plans import other_plans
from .units import Found

Images = Any  # spectra [n_rx, n, height, width], float32

POLE, EDGE = 0.5, 0.75
"""Largest ratio of a row's spread along the azimuth at the zenith, and least ratio at the horizon, to that of a row
`INWARDS` of the image's rows further in. Near the zenith the spread grows in proportion to the angle from it, so that
the ratio is 1/6 for images of 90 rows. At the horizon spectra of planar arrays, which do not tell their two sides, are
level. The known data sets have at most 0.35 and at least 0.97."""
INWARDS, FEWEST_HEIGHT = 1 / 16, 16
"""Share of the image's rows between the rows that are compared, and least number of rows."""
MOST = 0.5
"""Least share of the spectra that show another order of rows; those of the known data sets show the stated one."""
FEWEST_ROWS, MOST_ROWS = 40, 400  # rows that are needed, and rows that are used: near rows have similar spectra
GROUPS = 16
"""Groups of near positions, a power of two: the rows of a group count once, and as many positions have to differ."""
MOST_PIXELS = 10_000
"""Images are thinned to about this many pixels, 1.6 degrees apart, far below the width of an array's lobe."""
CHANCE = 0.5
"""Mean brightness of a direction that has nothing to do with the transmitter; it stands for directions below the
array's plane, which spectra do not show."""
BRIGHT, BRIGHTEST = 0.8, 0.95
"""Least mean brightness of the other reading, and largest one of the stated reading: as far as arrays resolve, a
reading is right if transmitters are in the brightest twentieth of the hemisphere, a cap 18 degrees wide."""
DARKER = 1.5  # least factor by which more of the hemisphere is brighter than the transmitter in the stated reading
STANDARD_ERRORS = 4.0
"""Least mean of the groups' gains in its standard errors: with 15 degrees of freedom one in 1700 by chance, and some
thirty readings are compared."""
OTHERS = 6  # transmitters of other groups that a row's own is compared with
REMEDY = "write images as docs/data.md states, row 0 at elevation 0, column 0 at azimuth 0, counter-clockwise"


def spectrum_axes(record: Record) -> Found:
    """Image rows, columns, orientation or plan in another reading than the stated one."""
    if record.task.name != "spectrum":
        return
    height, width = record.observation.shape[2:]
    if height > width:
        text = f"images have {height} rows and {width} columns, but rows are elevations over 90 degrees"
        yield "spectrum-axes", f"{text} and columns azimuths over 360 degrees: they are transposed; {REMEDY}"
        return
    share = reversed_share(record.observation)
    if share > MOST:
        evidence = f"in {share:.0%} of the spectra the first row is nearly constant, as a zenith is, the last is not"
        yield "spectrum-axes", f"image rows count from the zenith: {evidence}; {REMEDY}"
        record = replace(record, observation=record.observation[..., ::-1, :])
    yield from _line_of_sight(record)


def reversed_share(spectra: Images) -> float:
    """Share of spectra [n_rx, n, height, width] whose first row is at the zenith by its spread, and the last is not."""
    height = spectra.shape[2]
    if height < FEWEST_HEIGHT:
        return 0.0
    inwards = max(2, round(INWARDS * height))
    spread = spectra[:, :, [0, inwards, -1 - inwards, -1]].std(axis=-1)
    first, second, other, last = np.moveaxis(spread, -1, 0)
    return float(np.mean((first < POLE * second) & (last > EDGE * other)))


def _line_of_sight(record: Record) -> Found:
    """The best other reading, if it is clearly better than the stated one."""
    poses = np.array([[*receiver.position_m, *receiver.orientation_xyzw] for receiver in record.receivers])
    if not record.has_positions or len(record) < FEWEST_ROWS or not np.isfinite(poses).all():
        return
    rows = np.unique(np.linspace(0, len(record) - 1, MOST_ROWS).astype(int))
    part = _thinned(replace(record, tx_pos_m=record.tx_pos_m[rows], observation=record.observation[:, rows]))
    if len(np.unique(part.tx_pos_m, axis=0)) < GROUPS:
        return
    yield from list(_behind(record)) or _best_reading(part)


def _best_reading(record: Record) -> Found:
    """The other reading in which spectra are brightest in the direction of the transmitter."""
    stated, groups = brightness(record), _groups(record.tx_pos_m)
    better = [] if stated.mean() > BRIGHTEST else list(_better_readings(record, stated, groups))
    if not better:
        return
    # Several readings may put transmitters where they are in the best one: the first of these is named.
    best = max((shares for *_, shares in better), key=np.mean)
    equal = [reading for reading in better if not _is_brighter(best, reading[-1], groups)]
    (name, what, remedy, shares), *others = equal
    evidence = f"{shares.mean():.0%} of the hemisphere is then darker than the direction of the transmitter"
    also = [text for other, text, *_ in others if other != name]
    hint = f" (or: {also[0]})" if also else ""
    yield name, f"{what}: {evidence}, as stated {stated.mean():.0%}; {remedy}{hint}"


def _better_readings(
    record: Record, stated: FloatArray, groups: IntArray
) -> Iterator[tuple[str, str, str, FloatArray]]:
    """Readings that are clearly brighter than the stated one: suspicion, what is wrong, remedy and brightness."""
    for name, what, remedy, reading in _readings(record):
        shares = brightness(reading)
        if shares.mean() >= BRIGHT and _is_brighter(shares, stated, groups) and _moves(reading, shares, groups):
            yield name, what, remedy, shares


def _behind(record: Record) -> Found:
    """Receivers that look away from all transmitters."""
    for receiver in record.receivers:
        to_tx = record.tx_pos_m - receiver.position_m
        if not (to_tx @ receiver.to_world[:, 2] < 0).all():
            continue
        text = f"all transmitters are behind the array of receiver {receiver.name}, outside the hemisphere of spectra"
        remedy = "state the rotation from the array's frame to the world's, whose z axis is the side that receives"
        for reading, turn in ORIENTATIONS.items():
            turned = replace(receiver, orientation_xyzw=turn(receiver.orientation_xyzw))
            if (to_tx @ turned.to_world[:, 2] > 0).all():
                remedy = f"they are in front if {reading}"
                break
        yield "orientation", f"{text}; {remedy}"


def brightness(record: Record) -> FloatArray:
    """Share of the hemisphere that is darker than the direction of the transmitter, [n_rx, n]; `CHANCE` below it."""
    height, width = record.observation.shape[2:]
    weight = solid_angles(height, width).astype(np.float32)
    weight /= weight.sum()
    darker = np.full((len(record.receivers), len(record)), CHANCE)
    for receiver, spectra, shares in zip(record.receivers, record.observation, darker, strict=True):
        azimuth, elevation = azimuth_elevation((record.tx_pos_m - receiver.position_m) @ receiver.to_world)
        # The zenith lies half a pixel or more above the last row.
        row = np.minimum(np.rint(elevation * (2 * height / np.pi)).astype(int), height - 1)
        column = np.rint(azimuth * (width / (2 * np.pi))).astype(int) % width
        for k in np.flatnonzero(elevation >= 0):
            image, value = spectra[k].ravel(), spectra[k, row[k], column[k]]
            shares[k] = weight[image < value].sum() + weight[image == value].sum() / 2
    return darker


def _is_brighter(shares: FloatArray, stated: FloatArray, groups: IntArray) -> bool:
    """Whether one brightness [n_rx, n] is clearly above another one, in most groups [n] of rows."""
    darker = 1 - stated.mean() >= DARKER * (1 - shares.mean())
    return bool(darker) and _is_positive(shares - stated, groups)


def _moves(record: Record, shares: FloatArray, groups: IntArray) -> bool:
    """Whether spectra are brighter in the direction of their own transmitter than in those of other transmitters."""
    rng = np.random.default_rng(0)
    gain = np.zeros_like(shares)
    for _ in range(OTHERS):
        # A transmitter of another group: from the rows in the order of their groups, more than a group away.
        order = np.argsort(groups, kind="stable")
        size = int(np.bincount(groups).max())
        shift = int(rng.integers(size, len(order) - size + 1))
        other = np.empty_like(order)
        other[order] = np.roll(order, shift)
        gain += (shares - brightness(replace(record, tx_pos_m=record.tx_pos_m[other]))) / OTHERS
    return _is_positive(gain, groups)


def _is_positive(gain: FloatArray, groups: IntArray) -> bool:
    """Whether the mean gain [n_rx, n] over groups [n] is positive beyond chance."""
    means = np.array([gain[:, groups == group].mean() for group in range(GROUPS)])
    return bool(means.mean() > STANDARD_ERRORS * means.std(ddof=1) / np.sqrt(GROUPS))


def _thinned(record: Record) -> Record:
    spectra: Images = record.observation
    height, width = spectra.shape[2:]
    step = max(1, int(np.sqrt(height * width / MOST_PIXELS)))
    while height % step or width % step:  # angles of thinned pixels stay those of a spectrum
        step -= 1
    return replace(record, observation=np.ascontiguousarray(spectra[..., ::step, ::step]))


def _groups(positions_m: FloatArray) -> IntArray:
    """Group of each position [n], of equal sizes, by halving along the longer axis (the leaves of a k-d tree)."""
    groups = [np.arange(len(positions_m))]
    while len(groups) < GROUPS:
        halves = []
        for rows in groups:
            axis = int(np.ptp(positions_m[rows], axis=0).argmax())
            ordered = rows[np.argsort(positions_m[rows, axis], kind="stable")]
            halves += np.array_split(ordered, 2)
        groups = halves
    number = np.empty(len(positions_m), np.int64)
    for k, rows in enumerate(groups):
        number[rows] = k
    return number


def _readings(record: Record) -> Iterator[tuple[str, str, str, Record]]:
    """Other readings: name of the suspicion, what is wrong, the remedy, and the record so read."""
    for text, image in COLUMNS.items():
        yield "spectrum-axes", text, REMEDY, replace(record, observation=image(record.observation))
    for text, turn in ORIENTATIONS.items():
        receivers = tuple(replace(r, orientation_xyzw=turn(r.orientation_xyzw)) for r in record.receivers)
        what, _, remedy = text.partition("; ")
        yield "orientation", what, remedy, replace(record, receivers=receivers)
    for placement in other_plans(record):
        what = f"transmitters are in another plan than receivers, {placement.motion}"
        yield "plan", what, placement.remedy, replace(record, tx_pos_m=placement.positions_m)


COLUMNS: dict[str, Callable[[Images], Images]] = {
    "image columns count from -180 degrees": lambda images: np.roll(images, images.shape[-1] // 2, axis=-1),
    "image columns count clockwise": lambda images: np.roll(images[..., ::-1], 1, axis=-1),
    "image columns count clockwise from 180 degrees": (
        lambda images: np.roll(images[..., ::-1], 1 - images.shape[-1] // 2, axis=-1)
    ),
}
"""Other readings of image columns, and how each one becomes the stated one."""
ORIENTATIONS: dict[str, Callable[[FloatArray], FloatArray]] = {
    "orientations are in the order w, x, y, z; write x, y, z, w": lambda q: np.roll(q, -1),
    "orientations turn the world's frame to the array's; write the inverse, -x, -y, -z, w": (
        lambda q: q * np.array([-1, -1, -1, 1])
    ),
}
"""Other readings of quaternions, and how each one becomes the stated one."""
