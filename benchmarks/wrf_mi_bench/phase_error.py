"""Spectra of random rooms, predicted from scans with several phase errors of reflections.

A mesh from a scan knows the powers of paths better than their phases. No other
figure uses the seeds of these rooms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from wrf_mi.core import Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.receivers.instruments import SpectrumInstrument
from wrf_mi.runs.sweep import markdown_table
from wrf_mi.tasks import TASKS
from wrf_mi.tracing.options import TraceOptions
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi_bench.random_room import Survey, random_room_record

from .comparison import kept_work, line
from .fit_key import fit_key, source_files

SEEDS = range(101, 105)
CARRIERS_HZ = 0.92e9, 2.4e9, 5.0e9
PHASE_ERRORS_RAD = 0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 2.5
RUNS = Path("runs/bench/phase-error")
SURVEY = Survey(train=40, test=5)  # rows are positions of transmitters here; no model is fitted
SIZE = 45, 180  # elevations and azimuths of a spectrum
ELEMENTS = 4  # elements along each side of the square array, half a wavelength apart
DOWN = np.array([1.0, 0.0, 0.0, 0.0])
CEILING_M = 1.8  # height above which an array looks down, metres; one below looks up
TRUTH = TraceOptions(transmission=True, diffraction=True, scattering=True, depth=3, rays=1 << 13)
"""Search for the true paths, with diffuse reflection and diffraction."""
PREDICTION = TraceOptions(transmission=True, depth=3, rays=1 << 16)


def array_at(station: Receiver, carrier_hz: float) -> Receiver:
    """A square array in the place of a single antenna, its boresight vertical."""
    steps = (np.arange(ELEMENTS) - (ELEMENTS - 1) / 2) * speed_of_light / carrier_hz / 2
    x, y = np.meshgrid(steps, steps, indexing="ij")
    elements: FloatArray = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    pose = DOWN if station.position_m[2] > CEILING_M else station.orientation_xyzw
    return replace(station, array_m=elements, orientation_xyzw=pose)


def measure_room(seed: int, folder: Path) -> list[list[float]]:
    """Mean SSIM [carriers, phase errors] in the room of a seed; all files go into a folder."""
    record, true, scan = random_room_record(seed, folder, SURVEY)
    means = []
    for hz in CARRIERS_HZ:
        instrument = SpectrumInstrument((array_at(record.receivers[0], hz),), np.array([hz]), size=SIZE)
        tracer = RayTracer(true, instrument, TRUTH)
        truth = tracer.observe(tracer.trace(record.tx_pos_m))[0]
        paths = RayTracer(scan, instrument, PREDICTION).trace(record.tx_pos_m).paths
        spectra = [replace(instrument, phase_error=rad).observe(paths)[0] for rad in PHASE_ERRORS_RAD]
        means.append([float(np.mean(TASKS["spectrum"].score(predicted, truth))) for predicted in spectra])
    return means


def main() -> dict[str, Any]:
    """Measure all rooms; a room that this code has measured before is not measured again.

    Rows have, of each carrier, ``ssim`` by phase error, the mean over rooms.
    """
    place = RUNS / fit_key(source_files())
    rooms = [kept_work(place, str(seed), partial(measure_room, seed)) for seed in SEEDS]
    rows = []
    for hz, means in zip(CARRIERS_HZ, np.mean(rooms, axis=0).tolist(), strict=True):
        best = PHASE_ERRORS_RAD[int(np.argmax(means))]
        what = f"{hz / 1e9:g} GHz, {len(SEEDS)} rooms"
        text = f"SSIM {max(means):.3f} at {best:g} rad, {means[0]:.3f} without"
        rows.append({**line(what, text, "-"), "ssim": means})
    return {"rows": rows}


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table of the mean SSIM by phase error; the best of each carrier is bold."""
    lines = []
    for row in rows:
        cells = (f"**{ssim:.3f}**" if ssim == max(row["ssim"]) else f"{ssim:.3f}" for ssim in row["ssim"])
        lines.append([row["what"], *cells])
    return markdown_table(["phase error, rad", *(f"{rad:g}" for rad in PHASE_ERRORS_RAD)], lines)
