"""Powers of paths in random rooms at 28 GHz from scans that are off by five wavelengths, stated and corrected.

Rooms, scans and rows are those of `wrf_mi_bench.rooms` with other seeds, on which nothing was tuned, a third of the
training rows and eight subcarriers over 400 MHz. A room's error is that of the sum of the powers of a test row's paths,
in dB against that in the true room: it has no phase.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.random_rooms import random_room

from wrf_mi.correction import default_options, write_page
from wrf_mi.correction.options import PHASES
from wrf_mi.datasets import make_splits
from wrf_mi.receivers.channel import rssi_dbm
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi_bench.random_room import OPTIONS, Survey, random_room_record

from .comparison import kept_work, line
from .declared import lined
from .rooms import clipped_cea_db
from .sources import fit_key, source_files

SEEDS = range(304, 308)
RUNS = Path("runs/bench/far-scans")
SUBCARRIERS_HZ = 28e9 + np.asarray(np.linspace(-200e6, 200e6, 8))
SURVEY = Survey(train=100, test=60)
SCAN, WITHOUT, WITH = "scan", "corrected", "corrected, with phases"


def measure_room(seed: int, folder: Path) -> dict[str, Any]:
    """Errors of powers and channels in the room of a seed by scene, and what the corrections kept."""
    room = random_room(seed)
    record, true, scan = random_room_record(seed, folder, SURVEY, SUBCARRIERS_HZ)
    split, options = make_splits(record, "official")[0], default_options(record)
    scenes, kept_groups = {"": true, SCAN: scan}, dict[str, str]()
    for name, groups in ((WITH, (*options.groups, PHASES)), (WITHOUT, options.groups)):
        scenes[name], kept_groups[name] = folder / name.replace(", ", "-").replace(" ", "-"), kept_groups.get(WITH, "")
        if name == WITHOUT and PHASES not in kept_groups[WITH]:
            scenes[name] = scenes[WITH]  # the same corrections were tried
            continue
        kept_groups[name] = write_page(
            correct_scene(scan, record, split, replace(options, groups=groups)), scenes[name]
        )["kept"]
    powers, channels = dict[str, Any](), dict[str, float]()
    for name, scene in scenes.items():
        tracer = RayTracer(scene, instrument_of(record), OPTIONS)
        traced = tracer.trace(record.tx_pos_m[split.test])
        powers[name] = rssi_dbm(traced.paths)[0]
        channels[name] = clipped_cea_db(tracer.observe(traced)[0], record.scored[0, split.test], record)
    errors = {name: np.abs(power - powers[""]) for name, power in powers.items() if name}
    median, mean = ({name: float(of(values)) for name, values in errors.items()} for of in (np.nanmedian, np.nanmean))
    what = f"{seed}: {' x '.join(f'{side:.1f}' for side in room.size_m)} m, {len(room.parts) - 6} pieces"
    value = f"{median[SCAN]:.2f} to {median[WITH]:.2f} dB"
    return {**line(what, value, "-"), "median_db": median, "mean_db": mean, "cea_db": channels, "kept": kept_groups}


def main() -> dict[str, Any]:
    """Measure all rooms; a room that this code has measured before is not measured again.

    Rows have, by scene, median and mean error of the powers in dB, the accuracy of channels, and what was ``kept``.
    """
    place = RUNS / fit_key(source_files())
    return {"rows": [kept_work(place, str(seed), partial(measure_room, seed)) for seed in SEEDS]}


table = lined(
    f"| room | {SCAN} | {WITHOUT} | {WITH} | kept |",
    "| {what} | "
    + " | ".join(f"{{median_db[{name}]:.2f}} ({{mean_db[{name}]:.2f}})" for name in (SCAN, WITHOUT, WITH))
    + f" | {{kept[{WITH}]}} |",
)
"""Median errors of powers by scene, mean errors in parentheses."""
