"""Radio maps of a run: power, coverage, best receiver and statistics of paths over a plane or a mesh.

Powers of a made-up receiver with noise of 2 dB, mapped by kriging with intervals:

    >>> import shutil, tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import wrf_mi
    >>> from wrf_mi.apps.maps.coverage import run_reliability
    >>> from wrf_mi.apps.maps.dataset import write_map
    >>> rng = np.random.default_rng(0)
    >>> positions_m = rng.uniform([1, 1, 1.3], [5, 4, 1.3], (40, 3))
    >>> rssi_dbm = -40 - 20 * np.log10(np.linalg.norm(positions_m, axis=1))[None] + rng.normal(0, 2, (1, 40))
    >>> receiver = wrf_mi.Receiver("anchor1", np.zeros(3), np.array([0.0, 0, 0, 1]))
    >>> known = {"frequencies_hz": np.array([2.44e9]), "official": (np.arange(30), np.arange(30, 40))}
    >>> record = wrf_mi.Record("made-up", "rssi", positions_m, (receiver,), rssi_dbm.astype("float32"), **known)
    >>> folder = Path(tempfile.mkdtemp())
    >>> run = wrf_mi.train(record, "kriging", out=folder / "run", intervals=True)
    >>> dataset = run.map(step_m=0.5, threshold_dbm=-52)
    >>> dict(dataset["power_dbm"].sizes), dataset["power_dbm"].units
    ({'receiver': 1, 'y': 8, 'x': 10}, 'dBm')
    >>> bool((dataset["coverage_probability"] <= 1).all())
    True
    >>> int(run_reliability(run.folder).count.sum())  # 10 test rows and 9 thresholds
    90
    >>> write_map(dataset, folder / "map.nc").name
    'map.nc'
    >>> planned = run.plan(count=2)
    >>> planned.tx_pos_m.shape, bool(planned.distance_m[2] < planned.distance_m[0])
    ((2, 3), True)
    >>> shutil.rmtree(folder)
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction
from ...core.angles import FloatArray
from ...core.carriers import FREQUENCY
from ...core.receivers import receiver_index
from ...models import Fitted, Inputs
from ...parallel import Scheduler, row_parts
from ...parallel.threads import on_threads
from ...receivers.spreads import PathStatistics
from ...runs.results import RECEPTION
from ...runs.run import Run, open_run
from ...tasks import Task
from ...training.session import OnProgress, quiet
from . import grid
from .coverage import coverage_probability
from .dataset import COVERAGE, POWER, STD, STD_OF_MEAN, map_dataset, maps_package

if TYPE_CHECKING:
    import xarray

THRESHOLD_DBM = -90.0
CHUNK_SIZE = 10_000
"""Largest number of positions in a chunk, each counted for each heading, and for each receiver if paths are traced."""
CHUNK_BYTES = 1 << 28  # bytes of a chunk's observations, with the copies that models make of them
VALUE_BYTES = 32  # of each value of an observation: mean and standard deviation in float64, and a copy of each


def radio_map(
    run: Run | str | Path,
    *,
    height_m: float | None = None,
    step_m: float | None = None,
    surface: str | Path | None = None,
    receivers: Sequence[int | str] | None = None,
    threshold_dbm: float | None = None,
    transmit_dbm: float = 0.0,
    heading_deg: float | None = None,
    frequency_hz: float | None = None,
    on_progress: OnProgress = quiet,
    scheduler: Scheduler | None = None,
) -> xarray.Dataset:
    """What the receivers of a run receive from a transmitter at the positions of a plane or a mesh.

    Args:
        run: run, or its folder, with one fitted model.
        height_m: z of a horizontal grid over the scene, or over the data where there is none; None: the median height
            of the transmitters in the data. With ``surface``, height above it; None: 0.
        step_m: spacing of the grid, or longest edge of a mesh's triangles, which are halved; None: 0.1 m, more for
            areas above a hectare, or the triangles as they are.
        surface: mesh at whose triangles' centres, or above them, the positions are, in place of the grid.
        receivers: names, or numbers from 0; None: all.
        threshold_dbm: received power above which a position counts as covered; None: -90 dBm, and no coverage for
            levels without a unit.
        transmit_dbm: transmit power, which separates path gain from received power.
        heading_deg: yaw of the transmitter; None: models that know it are averaged over 8 headings.
        frequency_hz: carrier, where the data have several.
        on_progress: progress callback: stage and fraction done.
        scheduler: computes parts of the positions; None: this process. Its workers must see the run folder, data set
            and scene under the same names.

    Returns:
        Dataset as `wrf_mi.apps.maps.dataset.map_dataset` describes it; ``docs/maps.md`` defines the variables.

    Raises:
        InputError: positions, receiver, heading or carrier that the run cannot be mapped with, or a missing package.
    """
    opened = run if isinstance(run, Run) else open_run(run)
    maps_package("xarray")
    task = opened.problem.record.task
    _check(opened, task, height_m, transmit_dbm, threshold_dbm)
    run_receivers = opened.receivers
    numbers = (
        range(len(run_receivers)) if receivers is None else [receiver_index(run_receivers, name) for name in receivers]
    )
    if task.level_kind != "relative" and threshold_dbm is None:
        threshold_dbm = THRESHOLD_DBM
    conditions = Conditions(threshold_dbm, transmit_dbm, _headings(opened, heading_deg), frequency_hz)
    places = _places(opened, height_m, step_m, surface)
    values = map_values(opened, places.positions_m, numbers, conditions, on_progress, scheduler)
    unit = "dB" if task.level_kind == "relative" else "dBm"
    attributes = _attributes(opened, task, conditions, heading_deg) | {"receiver_numbers": list(numbers)}
    return map_dataset(places, [run_receivers[number] for number in numbers], values, unit, attributes)


def _check(run: Run, task: Task, height_m: float | None, transmit_dbm: float, threshold: Any) -> None:
    if run.model.uplink == "required":
        raise InputError(f"{run.folder}: {run.config.model} predicts from the uplink, not from positions; no map of it")
    for name, value in (("height", height_m), ("transmit power", transmit_dbm), ("threshold", threshold)):
        if value is not None and not np.isfinite(value):
            raise InputError(f"{name} {value:g}: give a finite number")
    if task.level_kind == "relative" and transmit_dbm:
        raise InputError(f"{run.folder}: its {task.name} observations are not in dBm; omit the transmit power")


def _headings(run: Run, heading_deg: float | None) -> tuple[float, ...]:
    if heading_deg is not None and not np.isfinite(heading_deg):
        raise InputError(f"heading {heading_deg:g} degrees: give a finite number")
    if not run.fitted.depends_on_heading:
        if heading_deg is not None:
            raise InputError(f"{run.folder}: its predictions do not depend on the heading; omit it")
        return ()
    turns = np.arange(grid.HEADINGS) / grid.HEADINGS * 2 * np.pi if heading_deg is None else [np.radians(heading_deg)]
    return tuple(map(float, turns))


def _places(
    run: Run, height_m: float | None, step_m: float | None, surface: str | Path | None
) -> grid.Grid | grid.SurfaceMesh:
    tx_pos_m = run.problem.record.tx_pos_m
    if surface is not None:
        mesh = grid.surface_of(surface, step_m, height_m or 0.0)
        grid.warn_of_points_outside(run, mesh.positions_m, tx_pos_m)
        return mesh
    height = grid.usual_height(run, tx_pos_m) if height_m is None else height_m
    grid.check_height(run, height, tx_pos_m)
    area = grid.area_of(run, tx_pos_m)
    return grid.grid_over(*area, grid.usual_step(*area) if step_m is None else step_m, height)


def _attributes(run: Run, task: Task, conditions: Conditions, heading_deg: float | None) -> dict[str, Any]:
    config, headings, name = run.config, conditions.headings_rad, run.problem.record.name
    absolute = task.level_kind != "relative"
    attributes: dict[str, Any] = {"title": f"Radio map of {name} by {config.model}"}
    attributes["source"] = f"wrf_mi run {run.folder.resolve().name}: {config.model}, split {config.split}"
    attributes |= {"dataset": name, "model": config.model, "task": task.name}
    attributes |= {"level": task.level_note or task.quantity, "level_is_absolute": int(absolute)}
    if absolute:
        attributes["transmit_power_dbm"] = conditions.transmit_dbm
    if conditions.threshold_db is not None:
        attributes["threshold_dbm" if absolute else "threshold_db"] = conditions.threshold_db
    if headings:
        words = f"mean over {len(headings)} headings" if heading_deg is None else f"{heading_deg:g} degrees"
        attributes["transmitter_heading"] = words
    if conditions.frequency_hz is not None:
        attributes[FREQUENCY] = conditions.frequency_hz
    return attributes


@dataclass(frozen=True)
class Conditions:
    """Conditions common to all positions of a map, as the arguments of `radio_map`."""

    threshold_db: float | None
    transmit_dbm: float
    # headings of the transmitter that are averaged over; empty: the model does not know it
    headings_rad: tuple[float, ...] = ()
    frequency_hz: float | None = None

    def inputs(self, positions_m: FloatArray) -> Inputs:
        """Each position [m, 3] with all headings one after the other, at the carrier."""
        turns, hz = np.asarray(self.headings_rad), self.frequency_hz
        positions = np.repeat(positions_m, max(len(turns), 1), axis=0)
        headings = np.tile(turns, len(positions_m)) if len(turns) else None
        return Inputs(positions, headings, carriers_hz=None if hz is None else np.full(len(positions), hz))


def map_values(
    run: Run,
    positions_m: FloatArray,
    receivers: Sequence[int],
    conditions: Conditions,
    on_progress: OnProgress,
    scheduler: Scheduler | None = None,
) -> dict[str, NDArray[np.float32]]:
    """Variables [receivers, m] of `wrf_mi.apps.maps.dataset.VARIABLES` that a run's model states at positions [m, 3] in
    metres, computed chunk by chunk; NaN inside solid objects of the scene.

    `InputError`: inputs that the model does not predict from.
    """
    each = int(np.prod(run.problem.record.observation.shape[2:]))
    size = min(CHUNK_SIZE, CHUNK_BYTES // (VALUE_BYTES * each))
    if run.problem.scene is not None and run.fitted.traces:
        size = min(size, CHUNK_SIZE // len(run.receivers))
    size = max(1, size // max(len(conditions.headings_rad), 1))
    variables = dict[str, NDArray[np.float32]]()
    scene = run.problem.opened_scene
    outside = np.ones(len(positions_m), bool) if scene is None else grid.outside_solids(scene, positions_m)
    every = np.flatnonzero(outside)
    if not len(every):
        raise InputError(f"{run.folder}: all positions of the map lie in solid objects; give another height")
    workers, least = (1, size) if scheduler is None else (scheduler.workers, 1)
    rows = [every[part] for part in row_parts(len(every), workers, least, size)]

    def collect(part: int, mapped: list[dict[str, Any]]) -> None:
        for place, of_receiver in enumerate(mapped):
            for name, values in of_receiver.items():
                if name not in variables:
                    variables[name] = np.full((len(receivers), len(positions_m)), np.nan, np.float32)
                variables[name][place, rows[part]] = values
        mapped.clear()  # the scheduler keeps results to the end
        if scheduler is None:  # one with workers has a bar of its own
            on_progress("mapping", (part + 1) / len(rows))

    run.check_inputs(conditions.inputs(positions_m[every]))  # before a line of progress
    if scheduler is None:
        on_progress("mapping", 0.0)
    opener: Any = (
        (lambda: run)
        if scheduler is None
        else partial(open_run, run.folder, operator=run.operator, scene=run.scene, own=run.own)
    )
    chosen, sizes = [positions_m[part] for part in rows], list(map(len, rows))
    function = partial(_mapped_part, receivers, conditions)
    with _each_warning_once():
        (scheduler or Scheduler()).map(function, chosen, opener, what="mapping", sizes=sizes, each=collect, lines=True)
    return variables


def _mapped_part(
    receivers: Sequence[int], conditions: Conditions, run: Run, positions_m: FloatArray
) -> list[dict[str, Any]]:
    # A chunk is traced to all receivers together, unless these are more than the mapped ones.
    fitted = run.fitted.tracing_once() if len(receivers) == len(run.receivers) else run.fitted
    of_receiver = partial(_of_chunk, run, fitted, positions_m, conditions)
    # What traces is not for threads, and has threads of its own.
    return list(map(of_receiver, receivers)) if fitted.traces else on_threads(of_receiver, receivers)


def _of_chunk(
    run: Run, fitted: Fitted, positions_m: FloatArray, conditions: Conditions, receiver: int
) -> dict[str, Any]:
    task, count = run.problem.record.task, len(positions_m)
    inputs = conditions.inputs(positions_m)
    parts = fitted.decompose(inputs, receiver)
    added = conditions.transmit_dbm if task.level_kind == "gain" else 0.0

    def of_headings(values: Any) -> FloatArray:
        return np.asarray(values, float).reshape(count, -1)

    level = task.level(parts.prediction)
    means = of_headings(level.mean)
    variables: dict[str, Any] = {POWER: means.mean(axis=1) + added}
    if level.std is not None:
        # The law of total variance: within a heading, and between headings.
        def over_headings(std: Any) -> FloatArray:
            return np.sqrt(np.square(of_headings(std)).mean(axis=1) + means.var(axis=1))

        variables[STD] = std_db = over_headings(level.std)
        if level.std_mean is not None:
            variables[STD_OF_MEAN] = over_headings(level.std_mean)
        reception = parts.prediction.reception
        received = None if reception is None else of_headings(reception).mean(axis=1)
        if received is not None:
            variables[RECEPTION] = received
        if (limit := conditions.threshold_db) is not None:
            variables[COVERAGE] = coverage_probability(variables[POWER], std_db, limit, received)
    if parts.traced is not None and parts.learned is not None:
        components = parts.traced, parts.learned
        traced, learned = (of_headings(task.level(Prediction(each)).mean).mean(axis=1) + added for each in components)
        variables |= {"traced_share": traced, "learned_share": learned, "share_difference_db": traced - learned}
    if parts.paths is not None:
        names = [field.name for field in fields(PathStatistics)]
        variables |= {name: of_headings(getattr(parts.paths, name)).mean(axis=1) for name in names}
    if task.level_kind != "relative":
        variables["path_gain_db"] = variables[POWER] - conditions.transmit_dbm
    return variables


@contextmanager
def _each_warning_once() -> Iterator[None]:
    """Chunks would repeat the tracer's warnings of antennas near surfaces and outside the scene."""
    logger, messages = logging.getLogger("wrf_mi.tracing.search.devices"), set[str]()

    def new(record: logging.LogRecord) -> bool:
        is_repeated = record.msg in messages
        messages.add(record.msg)
        return not is_repeated

    logger.addFilter(new)
    try:
        yield
    finally:
        logger.removeFilter(new)
