"""Places of receivers that nobody mapped, estimated from the signal strengths that they received.

The law of distance P = T - 10 gamma log10 |x - p| is fitted to the training rows of each such receiver, rows at one
place averaged and shadowing correlated between places: its place p, power at one metre T and exponent gamma together,
by nonlinear least squares from several starts. A priori the exponent is that of indoor and urban measurements, the
place somewhere about the rows, and its height, which rows at one height hardly tell, `MOUNTED_M` above them. The
covariance is that of the linearised problem.

Source: Rappaport, "Wireless Communications" (2002), section 4.9 (law and exponents); Nocedal and Wright, "Numerical
Optimization" (2006), chapter 10.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares
from scipy.spatial.distance import cdist

from ..core import InputError, Record, Split
from ..core.angles import FloatArray
from ..core.antenna import AS_STATED
from ..core.files import listed, readable, write_atomically
from ..core.types import IntArray
from ..tasks import task_of
from .model import Problem

logger = logging.getLogger(__name__)

PLACES = "receiver_places.json"  # file of a run with estimated positions

EXPONENT = (3.0, 0.7)  # mean and standard deviation of the exponent a priori
MOUNTED_M = (1.0, 1.0)  # mean height above the transmitters a priori, as of receivers on walls and ceilings, and its sd
LEAST_M = 0.3  # least distance in the law: a receiver is not in the hand that holds the transmitter
NOISE_DB = 6.0  # standard deviation of the rows about the law, until their residuals tell
SHADOW_M, SHADOW_SHARE = 2.0, 0.05  # correlation length of shadowing, and its least share of the rows' extent
CORRELATED = 0.7  # share of the rows' deviation from the law that shadowing has
MOST_PLACES = 400  # places in the fit at most, evenly spaced
STARTS = 4  # places at the strongest rows, from which the search starts beside the middle of all
STATED_M = 0.01  # standard deviation of a coordinate that is stated
MARGIN_M = 0.1  # distance from the scene's box to which estimated coordinates beyond it are moved
AWAY_M = np.arange(0.05, 2.0, 0.05)  # distances at which a place outside of solids is searched for
LOUD_DB = 100.0  # standard deviation of the power at one metre, about the strongest row: any unit of decibels


def place_of_receiver(
    tx_pos_m: FloatArray, power_dbm: FloatArray, extent_m: float, stated_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position [3] of a receiver and its standard deviations [3], metres.

    Args:
        tx_pos_m: positions of the rows that it received [n, 3], metres, n at least 1.
        power_dbm: their signal strengths [n].
        extent_m: size of the area of all rows, metres, by which the place is uncertain a priori.
        stated_m: coordinates [3] that are known, such as a height; NaN for the others.
    """
    places, number = np.unique(tx_pos_m, axis=0, return_inverse=True)
    power = np.bincount(number.ravel(), power_dbm) / np.bincount(number.ravel())  # rows at one place share its shadow
    if len(places) > MOST_PLACES:
        spread = np.linspace(0, len(places) - 1, MOST_PLACES).round().astype(np.int64)
        places, power = places[spread], power[spread]
    # Neighbouring places share shadows: as if independent, they would promise decimetres.
    length_m = max(SHADOW_M, extent_m * SHADOW_SHARE)
    shared = CORRELATED * np.exp(-cdist(places, places) / length_m) + (1 - CORRELATED) * np.eye(len(places))
    lower = np.linalg.cholesky(shared)
    middle = places.mean(axis=0)
    middle[2] += MOUNTED_M[0]
    mean = np.array([*middle, np.max(power), EXPONENT[0]])
    deviation = np.array([extent_m, extent_m, MOUNTED_M[1], LOUD_DB, EXPONENT[1]])
    known = np.flatnonzero(np.isfinite(stated_m))
    middle[known] = mean[known] = stated_m[known]
    deviation[known] = STATED_M

    def distance(parameters: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.square(places - parameters[:3]).sum(axis=1) + LEAST_M**2))

    def residual(parameters: FloatArray, noise_db: float) -> FloatArray:
        law = parameters[3] - 10 * parameters[4] * np.log10(distance(parameters)) - power
        whitened = solve_triangular(lower, law, lower=True)
        return np.concatenate([whitened / noise_db, (parameters - mean) / deviation])

    def derivative(parameters: FloatArray, noise_db: float) -> FloatArray:
        away = distance(parameters)[:, None]
        slope = -10 * parameters[4] / np.log(10) * (parameters[:3] - places) / away**2
        law = np.column_stack([slope, np.ones(len(places)), -10 * np.log10(away)])
        return np.concatenate([solve_triangular(lower, law, lower=True) / noise_db, np.diag(1 / deviation)])

    strongest = np.argsort(-power, kind="stable")[:STARTS]
    # Beside the row, not at it, where the law has no slope.
    starts = [middle, *np.where(np.isfinite(stated_m), stated_m, places[strongest] + [0.1, 0.1, MOUNTED_M[0]])]
    noise_db, fits = NOISE_DB, []
    for place in starts:
        level = float(np.mean(power + 10 * EXPONENT[0] * np.log10(distance(place))))
        fits.append(least_squares(residual, np.array([*place, level, EXPONENT[0]]), derivative, args=(noise_db,)))
    best = min(fits, key=lambda fit: float(fit.cost))
    if len(places) > len(mean):
        # Once the law fits, its residuals state their deviation: few of them, no less than a third of the usual one.
        errors = residual(best.x, 1.0)[: len(places)]
        noise_db = max(float(np.sqrt(np.square(errors).sum() / (len(places) - len(mean)))), NOISE_DB / 3)
        best = least_squares(residual, best.x, derivative, args=(noise_db,))
    jacobian = derivative(best.x, noise_db)
    std_m = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))[:3])
    std_m[known] = 0.0
    return np.where(np.isfinite(stated_m), stated_m, best.x[:3]), std_m


def placed(record: Record, rows: IntArray) -> Record:
    """The record with estimated positions of receivers that have none, by some rows; NaN remains without any row."""
    lacking = [number for number, receiver in enumerate(record.receivers) if not receiver.is_surveyed]
    if not lacking or not task_of(record).in_decibel:
        return record
    receivers, tx_pos_m = list(record.receivers), record.tx_pos_m[rows]
    extent_m = max(float(np.linalg.norm(np.ptp(tx_pos_m[:, :2], axis=0))), 1.0) if len(rows) else 1.0
    for number in lacking:
        observed = np.asarray(record.observation[number, rows], float)
        received = np.isfinite(observed)
        if received.any():
            receiver = receivers[number]
            stated_m = np.asarray(receiver.position_m, float)
            if receiver.position_std_m is not None:  # estimated from more rows, from which nothing may remain
                stated_m = np.where(receiver.position_std_m > 0, np.nan, stated_m)
            place_m, std_m = place_of_receiver(tx_pos_m[received], observed[received], extent_m, stated_m)
            receivers[number] = replace(receiver, position_m=place_m, position_std_m=std_m)
    return replace(record, receivers=tuple(receivers))


def placed_problem(problem: Problem, rows: IntArray) -> Problem:
    """The problem of `placed` receivers, in a scene where antennas can be; the problem itself where all are known."""
    located = _with_record(problem, placed(problem.record, rows))
    if located is problem or problem.scene is None:
        return located
    return _with_record(located, _in_scene(located.record, located.opened_scene))


def _in_scene(record: Record, scene: Any) -> Record:
    """The record with estimated positions inside the scene's box, by two deviations at most, and outside of solids."""
    from ..scene.mesh.surfaces import bounds  # imported where there is a scene
    from ..tracing.paths.solve import Prepared
    from ..tracing.search.devices import solid_around

    surfaces, receivers = Prepared(scene).surfaces, list(record.receivers)
    box = bounds(surfaces.triangles)
    low, high = box[0] + MARGIN_M, box[1] - MARGIN_M
    # A ceiling above all rows is above their receivers, too; the height of the ground bounds nothing.
    encloses = (low <= np.nanmin(record.tx_pos_m, axis=0)) & (np.nanmax(record.tx_pos_m, axis=0) <= high)
    angle = np.arange(0, 2 * np.pi, np.pi / 8)
    around = AWAY_M[:, None, None] * np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=1)
    around = np.concatenate([np.zeros((1, 3)), around.reshape(-1, 3)])
    for number, receiver in enumerate(receivers):
        if (std_m := receiver.position_std_m) is not None and np.isfinite(receiver.position_m).all():
            inside_m = np.clip(receiver.position_m, low, high)
            near = encloses & (np.abs(inside_m - receiver.position_m) <= 2 * std_m)
            tried_m = np.where(near, inside_m, receiver.position_m) + around * (std_m > 0)
            outside = int(np.argmax(solid_around(surfaces, tried_m) < 0))  # the first: the nearest
            receivers[number] = replace(receiver, position_m=tried_m[outside])
    return replace(record, receivers=tuple(receivers))


def _with_record(problem: Problem, record: Record) -> Problem:
    if record is problem.record:
        return problem
    changed = replace(problem, dataset=record, antennas=AS_STATED, left_out=())
    if "opened_scene" in vars(problem):  # which would be opened anew
        vars(changed)["opened_scene"] = problem.opened_scene
    return changed


def write_places(folder: Path, record: Record) -> None:
    """Write estimated positions and their standard deviations, by the receiver's name, into a run's folder."""
    places = {
        receiver.name: {"position_m": receiver.position_m.tolist(), "std_m": receiver.position_std_m.tolist()}
        for receiver in record.receivers
        if receiver.position_std_m is not None
    }
    if places:
        write_atomically(folder / PLACES, json.dumps(places, indent=1) + "\n")


def stored_places(folder: Path) -> dict[str, dict[str, list[float]]]:
    """Estimated positions and standard deviations that `write_places` stored; empty where all are stated."""
    path = folder / PLACES
    with readable(path, f"{path}: missing", "train the run anew"):
        places: dict[str, dict[str, list[float]]] = json.loads(path.read_text()) if path.exists() else {}
    return places


def stored_problem(problem: Problem, folder: Path) -> Problem:
    """The problem with the positions that a run in a folder has estimated."""
    if not (places := stored_places(folder)):
        return problem  # whose data need not be on this machine
    receivers = list(problem.record.receivers)
    for number, receiver in enumerate(receivers):
        if place := places.get(receiver.name):
            position_m, std_m = np.array(place["position_m"]), np.array(place["std_m"])
            receivers[number] = replace(receiver, position_m=position_m, position_std_m=std_m)
    return _with_record(problem, replace(problem.record, receivers=tuple(receivers)))


def check_placeable(problem: Problem, splits: Sequence[Split]) -> None:
    """Refuse receivers in a scene at unknown places that no training row of a split tells.

    Raises:
        InputError: naming them.
    """
    record = problem.record
    for split in splits if problem.scene is not None and task_of(record).in_decibel else ():
        received = np.isfinite(record.seen(split).observation[:, split.all_train])
        lacking = [k for k, receiver in enumerate(record.receivers) if not (receiver.is_surveyed or received[k].any())]
        if lacking:
            names = listed(record.receivers[number].name for number in lacking)
            text = f"position of receiver {names} unknown, without a training row in split {split.name}"
            raise InputError(f"{record.source or record.name}: {text}; give x, y, z, or omit --scene")


def tell_places(problem: Problem) -> None:
    """Log the estimated positions of receivers in a scene."""
    for receiver in problem.record.receivers if problem.scene is not None else ():
        if receiver.position_std_m is not None:
            x, y, z = receiver.position_m
            deviations = ", ".join(f"{std:.1f}" for std in receiver.position_std_m)
            text = "receiver %s: position estimated at x %.1f, y %.1f, z %.1f m, deviations %s m, used in the scene"
            logger.warning(text, receiver.name, x, y, z, deviations)
