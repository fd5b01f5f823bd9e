"""Random rooms predicted from their scans: channels, and spectra with several phase errors of reflections.

Channels of twelve rooms are predicted from scans as they are, from corrected ones, and without a scene.

A room's accuracy is the mean over test rows of the channel estimation accuracy (CEA), limited to 0 to 40 dB: below, a
prediction is worse than none, and above, errors do not matter to a receiver. Rooms are those of the seeds 0 to 11;
nothing was tuned on them. A mesh from a scan knows the powers of paths better than their phases; no other figure uses
the seeds of the rooms of the spectra.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light
from wrf_mi_scenes.random_rooms import random_room

import wrf_mi
from wrf_mi.core import Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.correction import write_page
from wrf_mi.datasets import make_splits
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import TASKS, instrument_of
from wrf_mi.tracing import TraceResult
from wrf_mi.tracing.options import TraceOptions
from wrf_mi.tracing.sionna.path_solver import sionna_diffraction
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi_bench.random_room import CARRIER_HZ, DEFAULT, OPTIONS, Survey, random_room_record

from .comparison import kept_work, line
from .declared import lined, pivoted
from .scene import match
from .sources import fit_key, source_files

SEEDS = range(12)
RUNS = Path("runs/bench/rooms")
LIMITS_DB = 0.0, 40.0
SCAN, CORRECTED = "trace, scan", "trace, corrected"
MODELS: Mapping[str, tuple[str, str]] = {"kriging": ("kriging", ""), "hybrid, scan": ("hybrid", "scan")}
"""Model, and the scene that it is given or "", by the column of the table."""
COLUMNS = (SCAN, CORRECTED, *MODELS)
ASKED_DB = 3.0  # least median gain of the corrected scene


def clipped_cea_db(prediction: NDArray[Any], truth: NDArray[Any], record: Record) -> float:
    """Mean over rows of the CEA of channels [n, subcarriers], limited to `LIMITS_DB`."""
    return float(np.clip(record.task.score(prediction, truth), *LIMITS_DB).mean())


def disagreement(truth: TraceResult, scan: TraceResult) -> dict[str, float]:
    """How far the paths of a scan's scene are from those of the true one, between the same ends.

    Paths are the same where directions at both ends and lengths agree (`wrf_mi_bench.scene.match`); the scan's are
    right where the length is, too, within a quarter of the wavelength, as other phases add up to another channel.
    ``missing`` is the share of the true paths that the scan lacks; ``wrong`` that of the scan's paths that are not
    there or not right; ``phase_error_rad`` the root mean square error of reflected paths that are the same.
    """
    ours, theirs = match(truth.paths, scan.paths)
    longer = np.abs(truth.paths.length_m[ours] - scan.paths.length_m[theirs])
    wavelength = speed_of_light / CARRIER_HZ
    phase = 2 * np.pi / wavelength * longer[truth.paths.bounces[ours] > 0]
    return {
        "missing": 1 - len(ours) / max(len(truth.paths), 1),
        "wrong": 1 - int((longer < wavelength / 4).sum()) / max(len(scan.paths), 1),
        "phase_error_rad": float(np.sqrt(np.square(phase).mean())),
    }


def measure_room(seed: int, folder: Path, survey: Survey = DEFAULT) -> dict[str, Any]:
    """Accuracy of every prediction in the room of a seed; all files go into a folder."""
    room = random_room(seed)
    record, true, scan = random_room_record(seed, folder, survey)
    split = make_splits(record, "official")[0]
    corrected = folder / "corrected"
    page = write_page(correct_scene(scan, record, split), corrected, replace=True)
    rows, instrument = split.test, instrument_of(record)
    truth = record.scored[0, rows]
    traced, scores = {}, {}
    for name, opened in (("true", true), (SCAN, scan), (CORRECTED, corrected)):
        tracer = RayTracer(opened, instrument, OPTIONS)
        traced[name] = tracer.trace(record.tx_pos_m[rows])
        scores[name] = clipped_cea_db(tracer.observe(traced[name])[0], truth, record)
    scenes = {"": None, "scan": scan, "corrected": corrected}
    for column, (model, scene_name) in MODELS.items():
        run = wrf_mi.train(record, model, out=folder / "runs" / column.replace(", ", "-"), scene=scenes[scene_name])
        predicted = wrf_mi.open_run(run.folder, record).predict(record.tx_pos_m[rows]).mean
        scores[column] = clipped_cea_db(np.asarray(predicted), truth, record)
    size = " x ".join(f"{side:.1f}" for side in room.size_m)
    what = f"{seed}: {size} m, {len(room.parts) - 6} pieces, {room.mount}{', perfect' if room.perfect else ''}"
    row = line(what, f"{scores[SCAN]:.1f} to {scores[CORRECTED]:.1f} dB", "-")
    facts = {key: page[key] for key in ("kept", "seconds", "rows", "paths")}
    facts |= {"surfaces": len(page["materials"]), "planes": len(page["planes"])}
    scan_facts = disagreement(traced["true"], traced[SCAN])
    return {**row, "cea_db": scores, "scan": scan_facts, "correction": facts}


def main() -> dict[str, Any]:
    """Measure all rooms; a room that this code has measured before is not measured again.

    Rows have, of each room and of the median over rooms, ``cea_db`` by column, and for each room how wrong its ``scan``
    is and sizes and duration of its ``correction``.
    """
    place = RUNS / fit_key(source_files())
    rows = [kept_work(place, str(seed), partial(measure_room, seed)) for seed in SEEDS]
    gains = [row["cea_db"][CORRECTED] - row["cea_db"][SCAN] for row in rows]
    medians = {column: float(np.median([row["cea_db"][column] for row in rows])) for column in COLUMNS}
    text = f"{np.median(gains):.1f} dB ({min(gains):.1f} to {max(gains):.1f} dB)"
    median = line("median gain of the corrected scene (range over rooms)", text, f"{ASKED_DB:.0f} dB, aim 15 dB")
    return {"rows": [*rows, {**median, "cea_db": medians}]}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Smallest, median and largest accuracy over the rooms, and duration of the correction."""
    measured = [row for row in rows if "correction" in row]
    values = {name: [row["cea_db"][name] for row in measured] for name in measured[0]["cea_db"] if name != "true"}
    cells = " | ".join(f"{{{name}:.1f}}" for name in values)
    head = f"| mean CEA, dB | {' | '.join(values)} | duration of the correction |"
    values["seconds"] = [row["correction"]["seconds"] for row in measured]
    shown = ("smallest", np.min), ("median", np.median), ("largest", np.max)
    statistics = [{"what": what, **{name: of(each) for name, each in values.items()}} for what, of in shown]
    return lined(head, f"| {{what}} of {len(measured)} rooms | {cells} | {{seconds:.0f}} s |")(statistics)


PHASE_SEEDS = range(101, 105)
CARRIERS_HZ = 0.92e9, 2.4e9, 5.0e9
PHASE_ERRORS_RAD = 0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.5
PHASE_RUNS = Path("runs/bench/phase-error")
PHASE_SURVEY = Survey(train=40, test=5)  # rows are positions of transmitters here; no model is fitted
SIZE = 45, 180  # elevations and azimuths of a spectrum
ELEMENTS = 4  # elements along each side of the square array, half a wavelength apart
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
CEILING_M = 1.8  # height above which an array looks down, metres; one below looks up
TRUTH = TraceOptions(
    transmission=True, diffraction=True, scattering=True, scattering_coefficient=0.3, depth=3, rays=1 << 13
)
"""Search for the true paths, with diffuse reflection and diffraction."""
PREDICTION = TraceOptions(transmission=True, depth=3, rays=1 << 16)


def array_at(station: Receiver, carrier_hz: float) -> Receiver:
    """A square array in the place of a single antenna, its boresight vertical."""
    elements_m = planar_array(ELEMENTS, ELEMENTS, speed_of_light / carrier_hz / 2)
    pose = DOWN if station.position_m[2] > CEILING_M else station.orientation_xyzw
    return replace(station, array_m=elements_m, orientation_xyzw=pose)


def measure_phase_errors(seed: int, folder: Path) -> list[list[float]]:
    """Mean SSIM [carriers, phase errors] in the room of a seed; all files go into a folder."""
    record, true, scan = random_room_record(seed, folder, PHASE_SURVEY)
    means = []
    for hz in CARRIERS_HZ:
        instrument = Instrument("array", (array_at(record.receivers[0], hz),), np.array([hz]), size=SIZE)
        tracer = RayTracer(true, instrument, TRUTH)
        with sionna_diffraction():
            truth = tracer.observe(tracer.trace(record.tx_pos_m))[0]
        paths = RayTracer(scan, instrument, PREDICTION).trace(record.tx_pos_m).paths
        spectra = [replace(instrument, phase_error=rad).observe(paths)[0] for rad in PHASE_ERRORS_RAD]
        means.append([float(np.mean(TASKS["spectrum"].score(predicted, truth))) for predicted in spectra])
    return means


def phase_errors() -> dict[str, Any]:
    """Measure all rooms; a room that this code has measured before is not measured again.

    Rows have, of each carrier, ``ssim`` by phase error, the mean over rooms.
    """
    place = PHASE_RUNS / fit_key(source_files())
    rooms = [kept_work(place, str(seed), partial(measure_phase_errors, seed)) for seed in PHASE_SEEDS]
    rows = []
    for hz, means in zip(CARRIERS_HZ, np.mean(rooms, axis=0).tolist(), strict=True):
        best = PHASE_ERRORS_RAD[int(np.argmax(means))]
        what = f"{hz / 1e9:g} GHz, {len(PHASE_SEEDS)} rooms"
        text = f"SSIM {max(means):.3f} at {best:g} rad, {means[0]:.3f} without"
        rows.append({**line(what, text, "-"), "ssim": means})
    return {"rows": rows}


def phase_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of the mean SSIM by phase error; the best of each carrier is bold."""
    pairs = [
        {"what": row["what"], "rad": f"{rad:g}", "ssim": ssim}
        for row in rows
        for rad, ssim in zip(PHASE_ERRORS_RAD, row["ssim"], strict=True)
    ]
    return pivoted("| phase error, rad | ... |", "| {what} | ... |", "what", "rad", "{ssim:.3f}", best=max)(pairs)
