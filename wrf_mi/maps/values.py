"""Values of a radio map at given positions, computed chunk by chunk."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import InputError, Prediction
from ..core.angles import FloatArray
from ..models import Inputs
from ..receivers.spreads import PathStatistics
from ..runs.run import Run
from ..tasks import task_of
from ..training.session import OnProgress
from .coverage import coverage_probability
from .grid import outside_solids

CHUNK_SIZE = 10_000
"""Largest number of positions in a chunk, each counted for each heading, and with a scene for each receiver."""
CHUNK_BYTES = 1 << 28  # bytes of a chunk's observations, with the copies that models make of them
VALUE_BYTES = 32  # of each value of an observation: mean and standard deviation in float64, and a copy of each
HEADINGS = 8
"""Headings over which predictions, or likelihoods, are averaged where none is given, evenly over the circle."""

Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Conditions:
    """Conditions common to all positions of a map, as the arguments of `wrf_mi.radio_map`.

    Attributes:
        headings_rad: headings of the transmitter that are averaged over; empty: the model does not know it.
    """

    threshold_db: float | None
    transmit_dbm: float
    headings_rad: tuple[float, ...] = ()
    frequency_hz: float | None = None


def map_values(
    run: Run,
    positions_m: FloatArray,
    receivers: Sequence[int],
    conditions: Conditions,
    on_progress: OnProgress,
) -> Arrays:
    """Values of all variables of a map that a run's model states at positions [m, 3] in metres.

    Returns:
        Arrays [receivers, m] by the names of `wrf_mi.maps.dataset.VARIABLES`; NaN inside solid objects of the scene.

    Raises:
        InputError: inputs that the model does not predict from.
    """
    size = _chunk_size(run, len(conditions.headings_rad))
    found: Arrays = {}
    scene = run.problem.opened_scene
    outside = np.ones(len(positions_m), bool) if scene is None else outside_solids(scene, positions_m)
    with _each_warning_once():
        for start in range(0, len(positions_m), size):
            rows = start + np.flatnonzero(outside[start : start + size])
            if len(rows):
                for place, receiver in enumerate(receivers):
                    for name, values in _of_chunk(run, positions_m[rows], receiver, conditions).items():
                        if name not in found:
                            found[name] = np.full((len(receivers), len(positions_m)), np.nan, np.float32)
                        found[name][place, rows] = values
            on_progress("mapping", min(start + size, len(positions_m)) / len(positions_m))
    if not found:
        raise InputError(f"{run.folder}: all positions of the map lie in solid objects; give another height")
    return found


def _chunk_size(run: Run, headings: int) -> int:
    values = int(np.prod(run.problem.record.observation.shape[2:]))
    size = min(CHUNK_SIZE, CHUNK_BYTES // (VALUE_BYTES * values))
    size = size if run.problem.scene is None else min(size, CHUNK_SIZE // len(run.receivers))
    return max(1, size // max(headings, 1))


def _of_chunk(run: Run, positions_m: FloatArray, receiver: int, conditions: Conditions) -> dict[str, Any]:
    """Variables [m] at a receiver."""
    task, count = task_of(run.problem.record), len(positions_m)
    inputs = _inputs(positions_m, conditions)
    run.check_inputs(inputs)
    parts = run.fitted.decompose(inputs, receiver)
    added = conditions.transmit_dbm if task.level_kind == "gain" else 0.0

    def of_headings(values: Any) -> FloatArray:
        return np.asarray(values, float).reshape(count, -1)

    whole = task.level(parts.whole)
    means = of_headings(whole.mean)
    found: dict[str, Any] = {"power_dbm": means.mean(axis=1) + added}
    if whole.std is not None:
        # The law of total variance: within a heading, and between headings.
        variance = np.square(of_headings(whole.std)).mean(axis=1) + means.var(axis=1)
        found["power_std_db"] = np.sqrt(variance)
        if conditions.threshold_db is not None:
            given = found["power_dbm"], found["power_std_db"], conditions.threshold_db
            found["coverage_probability"] = coverage_probability(*given)
    if parts.traced is not None and parts.learned is not None:
        traced, learned = (
            of_headings(task.level(Prediction(side)).mean).mean(axis=1) + added
            for side in (parts.traced, parts.learned)
        )
        found |= {"traced_share": traced, "learned_share": learned, "share_difference_db": traced - learned}
    if parts.paths is not None:
        found |= {one.name: of_headings(getattr(parts.paths, one.name)).mean(axis=1) for one in fields(PathStatistics)}
    if task.level_kind != "relative":
        found["path_gain_db"] = found["power_dbm"] - conditions.transmit_dbm
    return found


def _inputs(positions_m: FloatArray, conditions: Conditions) -> Inputs:
    """Each position with all headings one after the other, at the carrier."""
    turns = np.asarray(conditions.headings_rad)
    positions = np.repeat(positions_m, max(len(turns), 1), axis=0)
    headings = np.tile(turns, len(positions_m)) if len(turns) else None
    hz = conditions.frequency_hz
    return Inputs(positions, headings, carriers_hz=None if hz is None else np.full(len(positions), hz))


@contextmanager
def _each_warning_once() -> Iterator[None]:
    """Chunks would repeat the tracer's warnings of antennas near surfaces and outside the scene."""
    logger, seen = logging.getLogger("wrf_mi.tracing.search.devices"), set[str]()

    def new(record: logging.LogRecord) -> bool:
        known = record.msg in seen
        seen.add(record.msg)
        return not known

    logger.addFilter(new)
    try:
        yield
    finally:
        logger.removeFilter(new)
