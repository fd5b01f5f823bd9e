"""What a person waits for: fits, corrections, single predictions, maps, first calls, processes side by side.

Every row runs commands as a user does, each in a process of its own, and states scores beside times, since a fit that
is fast and worse is not fast. Rows are kept by the content of the packages' files; a stopped call goes on.
"""

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes import floor_plans
from wrf_mi_scenes.divided import cluttered_room
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.core.arrays import planar_array
from wrf_mi.core.files import write_atomically
from wrf_mi.datasets import make_splits, write_ble_folder, write_spectrum_folder
from wrf_mi.estimators.receiver_places import placed
from wrf_mi.runs.folder import METRICS
from wrf_mi.synthetic import load_record
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.synthetic.stored import SCAN
from wrf_mi.tasks import TASKS, instrument_of
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.tracer import RayTracer

from .bench import FLAT, RFID
from .buildings import MALL, PLANS, measured_set, source_folder
from .comparison import Row, command, data_folder, kept_work, line
from .declared import lined
from .sources import fit_key, source_files
from .workloads import record, strengths

RUNS = Path("runs/bench/waits")
SEEDS = (0, 1, 2)
OFFICE_M, OFFICE_ROWS = (
    (18.0, 10.0),
    540,
)  # extent of an office floor, and positions of a walk there, of which a fifth test
CALLS = 3  # timed first calls, whose median is stated
CAD_TRIANGLES, CAD_ROWS, CAD_TRAINING = 100_000, 24, 15
MAP_POSITIONS = 100_000
MALL_STEP_M = 1.02  # of the map of a floor of 219 m x 237 m: 50,000 positions
SIDE_STEPS = 2000  # steps of a fit beside another one, half a minute
Figures = dict[str, Any]
Measure = Callable[[Path], Figures]


def scored(folder: Path, task: str = "spectrum") -> Figures:
    """Median score, time of training and of a single prediction, and memory of a run."""
    metrics = json.loads((folder / METRICS).read_text())
    names = ("train_seconds", "ms_per_sample", "peak_memory_mb")
    return {"score": metrics[TASKS[task].block]["median"], **{name: metrics[name] for name in names}}


def field(preset: str, folder: Path) -> Figures:
    """WRF-GS+ on measured spectra by a preset, three seeds."""
    fits = []
    for seed in SEEDS:
        run = folder / str(seed)
        command("train", RFID, "--model", "wrf-gs+", "--preset", preset, "--seed", str(seed), "--out", run)
        fits.append(scored(run))
    return {"fits": fits}


def _scan_scene(name: str, folder: Path) -> Path:
    """Scene of a data set's scan."""
    scan = Path(load_record(name).source) / SCAN
    command("mesh", scan, "--out", folder / "scene")
    return folder / "scene"


def joint(name: str, folder: Path) -> Figures:
    """Paths and Gaussians on the spectra of a room with its scan."""
    scene, run = _scan_scene(name, folder), folder / "joint"
    seconds = command("train", name, "--model", "wrf-gs+", "--scene", scene, "--out", run)
    return {"seconds": seconds, **scored(run)}


def cad(folder: Path) -> Figures:
    """A hybrid of few spectra in a cluttered room of many triangles, and its single predictions."""
    folder.mkdir(parents=True)
    places = transmitter_path(CAD_ROWS)
    mesh = folder / "room.ply"
    cluttered_room(CAD_TRIANGLES, np.concatenate([places[:1], RECEIVER.position_m[None]])).export(mesh)
    receiver = replace(RECEIVER, array_m=planar_array(4, 4, SPACING_M))
    rows = replace(record(CAD_ROWS), tx_pos_m=places, receivers=(receiver,), frequencies_hz=np.array([FREQUENCY_HZ]))
    tracer = RayTracer(mesh, instrument_of(rows), TraceOptions(depth=2), "concrete")
    spectra = np.asarray(tracer(places), np.float32)
    test = np.arange(0, CAD_ROWS, 4)
    rows = replace(rows, observation=spectra, official=(np.setdiff1d(np.arange(CAD_ROWS), test), test))
    write_spectrum_folder(folder / "data", rows, bits=16)
    options = ("--scene", mesh, "--material", "concrete", "--n-train", str(CAD_TRAINING))
    command("train", folder / "data", *options, "--out", folder / "hybrid")
    return scored(folder / "hybrid")


def correction(folder: Path) -> Figures:
    """A scanned, furnished room corrected by 400 spectra."""
    scene = _scan_scene("traced-room", folder)
    seconds = command("correct", "traced-room", "--scene", scene, "--n-train", "400", "--out", folder / "corrected")
    page = json.loads((folder / "corrected" / "correction.json").read_text())
    return {"seconds": seconds, "kept": page["kept"]}


def strength_map(folder: Path) -> Figures:
    """A map of a hybrid of signal strengths in the walls of a flat's plan."""
    flat = data_folder(FLAT)
    command("mesh", flat / "layout.csv", "--wall-height", "2.7", "--out", folder / "scene")
    command("train", FLAT, "--scene", folder / "scene", "--n-train", "400", "--out", folder / "hybrid")
    places = load_record(FLAT).tx_pos_m
    area = float(np.prod(np.ptp(places[:, :2], axis=0)))
    step = f"{np.sqrt(area / MAP_POSITIONS):.4f}"
    seconds = command("map", folder / "hybrid", "--step", step, "--receiver", "anchor1", "--out", folder / "map.nc")
    return {"seconds": seconds, "step_m": float(step)}


def office(receivers: int, step_m: float, folder: Path) -> Figures:
    """A fast hybrid with a map and positions on an office floor, of receivers at unknown places."""
    plan, rows = floor_plans.office(), strengths(OFFICE_ROWS, receivers, *OFFICE_M)
    scene = write_scene(folder / "scene", {name: plan.parts[name] for name in plan.bare}, "an office without furniture")
    unknown = tuple(replace(each, position_m=np.full(3, np.nan)) for each in rows.receivers)
    walk, run = write_ble_folder(folder / "walk", replace(rows, receivers=unknown)), folder / "run"
    options = ("--split", "random", "--scene", scene, "--preset", "fast")
    return {
        "fit": command("train", walk, *options, "--out", run),
        f"map of {round(np.prod(OFFICE_M) / step_m**2):,} points": command(
            "map", run, "--step", str(step_m), "--out", folder / "map.nc"
        ),
        f"positions of {round(OFFICE_ROWS / 5)} rows": command("locate", run, "--out", folder / "places.csv"),
        **scored(run, "rssi"),
    }


def shopping_centre(folder: Path) -> Figures:
    """Fits, a map and positions of phones on a floor with 129 receivers at unknown places, with its plan or without."""
    walk = measured_set(folder, MALL)
    plan, height_m = PLANS[MALL]
    (split,) = make_splits(walk, "official")
    begun = time.perf_counter()
    placed(walk, split.all_train)
    of_places = time.perf_counter() - begun
    command("mesh", source_folder(MALL) / plan, "--wall-height", str(height_m), "--out", folder / "scene")
    fast = ("train", folder / MALL, "--preset", "fast")
    alone = command(*fast, "--out", folder / "alone")
    with_plan = command(*fast, "--scene", folder / "scene", "--out", folder / "planned")
    step = ("--step", str(MALL_STEP_M))
    return {
        "places of the receivers": of_places,
        "fit": alone,
        "fit with the plan": with_plan,
        "map of 50,000 places with the plan": command("map", folder / "planned", *step, "--out", folder / "map.nc"),
        "positions of 931 phones": command("locate", folder / "alone", "--out", folder / "places.csv"),
        "peak_memory_mb": scored(folder / "planned", "rssi")["peak_memory_mb"],
    }


def first_calls(folder: Path) -> Figures:
    """Commands in fresh processes, kernels cached on disk by the call before."""
    train = ("train", "laboratory", "--model", "wrf-gs+", "--set", "steps=50", "--out")
    command(*train, folder / "run")
    write_atomically(folder / "places.csv", "x,y,z\n2.2,3.0,1.7\n")
    predict = ("predict", folder / "run", "--tx", folder / "places.csv", "--out")

    def median_s(call: Callable[[int], Sequence[str | Path]]) -> float:
        return float(np.median([command(*call(k)) for k in range(CALLS)]))

    return {
        "--help": median_s(lambda _: ("--help",)),
        "train of 50 steps": median_s(lambda k: (*train, folder / f"run-{k}")),
        "predict of one row": median_s(lambda k: (*predict, folder / f"predicted-{k}.npz")),
    }


def side_by_side(folder: Path) -> Figures:
    """A fit alone, two of a sweep on two workers, and two commands that know nothing of each other."""
    fit = ("laboratory", "--model", "wrf-gs+", "--set", f"steps={SIDE_STEPS}", "--set", "density.every=0")

    def train(name: str) -> tuple[str | Path, ...]:
        return "train", *fit, "--out", folder / name

    sweep = ("sweep", *fit, "--vary", "seed=0,1", "--scheduler", "local:2", "--out", folder / "sweep")
    alone, swept = command(*train("alone")), command(*sweep)
    return {"alone_s": alone, "sweep_s": swept, "two_s": command(*train("first"), beside=[train("second")])}


def demo(folder: Path) -> Figures:
    """The demonstration, without set-up."""
    return {"seconds": command("demo", "--out", folder / "demo"), **scored(folder / "demo" / "hybrid")}


def _field_row(preset: str, asked: str, of: Figures) -> Row:
    times = ", ".join(f"{fit['train_seconds']:.0f} s to {fit['score']:.4f}" for fit in of["fits"])
    return line(f"WRF-GS+, rfid-lab, {preset} preset, seeds 0 to 2: time to median SSIM", times, asked)


def main() -> dict[str, Any]:
    """Measure all rows; each states what is asked on two idle cores."""
    data_folder(RFID), data_folder(FLAT)  # missing data are reported first
    place = RUNS / fit_key(source_files())

    def of(name: str, measure: Measure) -> Figures:
        return dict(kept_work(place, name, measure))

    rows = [
        _field_row(preset, asked, of(f"field-{preset}", partial(field, preset)))
        for preset, asked in (("fast", "45 s to 0.965"), ("default", "90 s to 0.970"))
    ]
    fit = of("joint", partial(joint, "laboratory"))
    rows.append(line("joint fit, 160 spectra of a scan", f"{fit['train_seconds']:.0f} s to {fit['score']:.4f}", "60 s"))
    rows.append(line("single joint prediction in a scan", f"{fit['ms_per_sample']:.1f} ms", "7 ms"))
    fit = of("cad", cad)
    what, text = f"{CAD_TRAINING} spectra, {CAD_TRIANGLES:,} triangles", f"{fit['train_seconds']:.0f} s"
    rows.append(line(f"hybrid, {what}", f"{text} to {fit['score']:.4f}", "60 s"))
    rows.append(line(f"single prediction of that hybrid, {what}", f"{fit['ms_per_sample']:.1f} ms", "40 ms"))
    rows.append(line("correct, 400 spectra", f"{of('correction', correction)['seconds']:.0f} s", "100 s"))
    fit = of("memory", partial(joint, "traced-room"))
    text = f"{fit['peak_memory_mb'] / 1000:.1f} GB, {fit['seconds']:.0f} s to {fit['score']:.4f}"
    rows.append(line("joint fit, 1,600 spectra: memory", text, "2.5 GB"))
    text = f"{of('map', strength_map)['seconds']:.0f} s"
    rows.append(line(f"map of about {MAP_POSITIONS:,} strengths, hybrid with a scene", text, "30 s"))
    for receivers, step_m, asked in ((25, 0.2, ("90 s", "", "60 s")), (100, 0.1, ("300 s", "", ""))):
        figures = of(f"office-{receivers}", partial(office, receivers, step_m))
        what, memory = f"office floor, {receivers} receivers", f"{figures['peak_memory_mb'] / 1000:.1f} GB"
        for name, bound in zip(list(figures)[:3], asked, strict=True):
            rows.append(line(f"{what}: {name}", f"{figures[name]:.0f} s", bound))
        rows.append(line(f"{what}: memory of the fit", memory, "4 GB"))
    times = of("shopping-centre", shopping_centre)
    memory = f"{times.pop('peak_memory_mb') / 1000:.1f} GB"
    bounds = ("3 s", "60 s", "300 s", "30 s", "")
    for (name, s), bound in zip(times.items(), bounds, strict=True):
        rows.append(line(f"shopping centre, 129 receivers: {name}", f"{s:.2g} s", bound))
    rows.append(line("shopping centre, 129 receivers: memory of the fit with the plan", memory, "2 GB"))
    rows += [line(f"first call: {name}", f"{s:.2f} s") for name, s in of("first-calls", first_calls).items()]
    times = of("side-by-side", side_by_side)
    for what, key in (("a sweep on two workers", "sweep_s"), ("two commands at once", "two_s")):
        text = f"{times[key] / times['alone_s']:.2f} times as long as one"
        rows.append(line(f"two fits side by side: {what}", text, "2.2 times"))
    fit = of("demo", demo)
    rows.append(line("demo, without set-up", f"{fit['seconds']:.0f} s", "150 s"))
    text = f"{fit['train_seconds']:.0f} s to {fit['score']:.4f}"
    rows.append(line("demo: hybrid of 40 spectra of a scan, a region held out", text, "60 s"))
    return {"rows": rows}


table = lined("| what | measured | bound |", "| {what} | {value} | {asked} |")
"""Measured durations and their bounds."""
