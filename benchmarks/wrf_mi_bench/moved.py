"""Fields that were trained before half of the furniture moved, predicted after, against measuring anew.

In each of eight random rooms spectra are measured before, with the scan of `wrf_mi_bench.random_room`. Then pieces of
furniture move; the parts of the scan that stand where a piece stood move with it, as a person states by
``wrf-mi edit``. Test rows are measured afterwards, at places that are free in both states. Rooms are those of the first
eight seeds from 401 on with at most eight pieces of furniture, whose fits take half a minute; nothing was tuned on
them.
"""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from wrf_mi_scenes.mitsuba_xml import write_scene
from wrf_mi_scenes.random_rooms import CLEAR_M as FROM_FURNITURE_M
from wrf_mi_scenes.random_rooms import GAP_M, RandomRoom, random_room

import wrf_mi
from wrf_mi.core import Record
from wrf_mi.core.angles import FloatArray
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.runs.run import Run
from wrf_mi.scene.edit import Move, edit_scene, parts_within
from wrf_mi.synthetic.searches import free_positions
from wrf_mi.tasks import SPECTRUM, TASKS, instrument_of
from wrf_mi.tasks.scores import bootstrap
from wrf_mi.tracing.sionna.scenes import open_scene
from wrf_mi.tracing.tracer import RayTracer

from .comparison import line, measured_on, say, stored_part
from .declared import lined
from .random_room import CLEAR_M, FROM_STATION_M, HIGH_M, LOW_M, OPTIONS, Survey, random_room_record
from .rooms import PREDICTION, array_at
from .sources import fit_key, source_files

RUNS = Path("runs/bench/moved")
SEEDS = 403, 404, 406, 407, 408, 411, 414, 415
CARRIER_HZ = 0.92e9
SIZE = 30, 120  # elevations and azimuths of a spectrum: a tenth of the width of the array's lobes
BEFORE, TEST = 40, 60  # rows measured before, and test rows
AT_LEAST_M = 0.8  # least displacement of a piece
NEAR_M = 0.15  # how far a scanned part may stand from its piece: errors of the survey, and thickness
DRAWS = 200  # places that are tried for a piece
SHELL = ("floor", "ceiling", "wall")  # beginnings of the names of parts that are no furniture
JOINT, HYBRID, KRIGING, TRACED = "joint", "hybrid", "kriging", "ray tracing"
MODELS: Mapping[str, tuple[str, str]] = {JOINT: ("wrf-gs+", "default"), HYBRID: ("hybrid", "fast")}
"""Model and preset of the fits before; the hybrid has no field, which the joint model has."""
ANEW: Mapping[str, Sequence[int]] = {KRIGING: (10, 30, 100), HYBRID: (10, 30)}
"""Numbers of rows measured after, by model; the hybrid is given the edited scan."""
POOL = max(max(counts) for counts in ANEW.values())
OURS = f"{HYBRID} from before, edited scene"


@dataclass(frozen=True)
class Room:
    """A room before and after: spectra, the scan's scene, and displacements in metres by the names of pieces."""

    room: RandomRoom
    before: Record
    after: Record
    scan: Path
    shifts_m: Mapping[str, FloatArray]


def displacements(room: RandomRoom, seed: int) -> dict[str, FloatArray]:
    """Displacements [3], metres, of half of the pieces, to places that are free once those before have moved."""
    rng = np.random.default_rng([seed, 4])
    boxes = {name: np.array(mesh.bounds) for name, (_, mesh) in room.parts.items() if name.startswith("piece")}
    station_m, shifts = np.array(room.station_m), dict[str, FloatArray]()
    for name in rng.permutation(sorted(boxes)).tolist():
        box, others = boxes[name], [other for key, other in boxes.items() if key != name]
        for _ in range(DRAWS if len(shifts) < len(boxes) // 2 else 0):
            first = rng.uniform(GAP_M, np.array(room.size_m[:2]) - GAP_M - (box[1] - box[0])[:2])
            shift = np.append(first - box[0, :2], 0.0)
            low, high = box + shift
            apart = all(((low > bounds[1] + GAP_M) | (bounds[0] > high + GAP_M))[:2].any() for bounds in others)
            near = ((station_m > low - FROM_FURNITURE_M) & (station_m < high + FROM_FURNITURE_M)).all()
            if apart and not near and np.linalg.norm(shift) > AT_LEAST_M:
                boxes[name], shifts[name] = box + shift, shift
                break
    return shifts


def furnished(seed: int, folder: Path) -> Room:
    """The room of a seed, measured before and after its furniture moves; all files go into a folder."""
    room, survey = random_room(seed), Survey(train=BEFORE, test=1)
    shifts_m = displacements(room, seed)
    channels, true, scan = random_room_record(seed, folder, survey)
    new = {name: (room.parts[name][0], room.parts[name][1].copy().apply_translation(m)) for name, m in shifts_m.items()}
    old = {f"{name}_before": room.parts[name] for name in shifts_m}
    moved, both = (
        write_scene(folder / name, {**room.parts, **parts}, f"Random room {seed}", "wrf_mi_scenes.random_rooms").parent
        for name, parts in (("moved", new), ("both", new | old))
    )
    # Free in both states, as the field from before is asked for the same positions.
    bounds, rng = np.array([[0.0, 0.0, LOW_M], [*room.size_m[:2], HIGH_M]]), np.random.default_rng([seed, 5])
    scene, apart = open_scene(both, CARRIER_HZ), (np.array(room.station_m), FROM_STATION_M)
    positions_m = free_positions(scene, bounds, POOL + TEST, CLEAR_M, rng, seed, apart)
    carriers_hz = np.array([CARRIER_HZ])
    instrument = Instrument("array", (array_at(channels.receivers[0], CARRIER_HZ),), carriers_hz, size=SIZE)

    def record(scene: Path, train_m: FloatArray) -> Record:
        places_m = np.concatenate([train_m, positions_m[-TEST:]])
        spectra = RayTracer(scene, instrument, OPTIONS)(places_m).astype(np.float32)
        rows, count = np.arange(len(places_m)), len(train_m)
        split = rows[:count], rows[count:]
        return Record(
            scene.name, SPECTRUM, places_m, instrument.receivers, spectra, official=split, frequencies_hz=carriers_hz
        )

    before = record(true, channels.tx_pos_m[:BEFORE])
    return Room(room, before, record(moved, positions_m[:-TEST]), scan, shifts_m)


def edited(scene: Path, room: Room, out: Path) -> Path:
    """A scene of the room with the parts of the moved pieces at their new places."""
    moves, moved_parts = list[Move](), set[str]()
    for name, shift_m in room.shifts_m.items():
        low, high = room.room.parts[name][1].bounds
        parts = {part for part in parts_within(scene, low - NEAR_M, high + NEAR_M) if not part.startswith(SHELL)}
        if parts := parts - moved_parts:
            moves.append(Move(tuple(sorted(parts)), (float(shift_m[0]), float(shift_m[1]), 0.0)))
            moved_parts |= parts
    return edit_scene(scene, out, moves) if moves else scene


def measure(seed: int, place: Path) -> dict[str, Any]:
    """Mean SSIM of each prediction of the test rows after the move, in the room of a seed."""
    folder = place / str(seed)
    shutil.rmtree(folder, ignore_errors=True)  # of a stopped measurement
    room = furnished(seed, folder)
    assert room.after.official is not None
    test, scores = room.after.official[1], dict[str, float]()
    places_m, truth = room.after.tx_pos_m[test], room.after.observation[0, test]

    def score(name: str, spectra: Any) -> None:
        scores[name] = float(np.mean(TASKS["spectrum"].score(np.asarray(spectra), truth)))
        say("moved", f"{seed}: {name}: {scores[name]:.3f}")

    def fit(name: str, record: Record, model: Any, **more: Any) -> Run:
        return wrf_mi.train(record, model, out=folder / name.replace(" ", "-"), **more)

    scan = edited(room.scan, room, folder / "edited")
    tracer = partial(RayTracer, instrument=instrument_of(room.after), options=PREDICTION)
    score(f"{TRACED}, edited scan", tracer(scan)(places_m)[0])
    for name, (model, preset) in MODELS.items():
        run = fit(name, room.before, model, scene=room.scan, preset=preset)
        score(f"{name} from before", run.predict(places_m).mean)
        corrected = run.folder / "parts" / "paths" / "scene"
        scene = edited(corrected, room, folder / f"edited-{name}") if corrected.exists() else scan
        score(f"{name} from before, edited scene", run.in_scene(scene).predict(places_m).mean)
        if name == HYBRID:
            score(f"{TRACED}, its edited scene", tracer(scene)(places_m)[0])
    score(f"{KRIGING} from before", fit(KRIGING, room.before, KRIGING).predict(places_m).mean)
    for name, counts in ANEW.items():
        options = {"scene": scan, "preset": MODELS[name][1]} if name in MODELS else {}
        for count in counts:
            run = fit(f"{name} {count}", room.after, name, n_train=count, **options)
            score(anew(name, count), run.predict(places_m).mean)
    size = " x ".join(f"{side:.1f}" for side in room.room.size_m)
    return {"room": f"{size} m, {len(room.shifts_m)} of {len(room.room.parts) - 6} pieces moved", "ssim": scores}


def anew(model: str, count: int) -> str:
    """Name of the predictions of a model of rows that were measured after the move."""
    return f"{model} anew, {count} rows"


def main() -> dict[str, Any]:
    """Measure all rooms that are not stored.

    Rows have, of each prediction, ``ssim`` by room, and ``mean`` over rooms and ``gain``, that of the hybrid in the
    edited scene over it, with their intervals. ``failed`` is there where this gain over ray tracing in the edited
    scan, or over the hybrid as it was, is not clearly above zero.
    """
    place = RUNS / fit_key(source_files())
    parts = {seed: stored_part("moved", str(seed), partial(measure, seed, place)) for seed in SEEDS}
    scores = {name: np.array([part["ssim"][name] for part in parts.values()]) for name in parts[SEEDS[0]]["ssim"]}
    gains = {name: bootstrap(scores[OURS] - ssim, statistic=np.mean) for name, ssim in scores.items()}
    rows = list[dict[str, Any]]()
    for name, ssim in scores.items():
        mean, gain = bootstrap(ssim, statistic=np.mean), gains[name]
        figures = {"ssim": ssim.tolist(), "mean": astuple(mean), "gain": astuple(gain)}
        rows.append({**line(name, f"mean SSIM {mean}", "" if name == OURS else f"{OURS} better by {gain}"), **figures})
    result: dict[str, Any] = {"rows": rows, "saved": saved(rows), "measured": measured_on(parts.values())}
    result["rooms"] = {str(seed): part["room"] for seed, part in parts.items()}
    worse = [name for name in (f"{TRACED}, edited scan", f"{HYBRID} from before") if gains[name].low <= 0]
    return result | ({"failed": f"{OURS}: not clearly better than {', '.join(worse)}"} if worse else {})


def saved(rows: Sequence[Mapping[str, Any]]) -> dict[str, int | None]:
    """Fewest rows measured anew with which a model is as good in the mean as `OURS`, by model; None: more."""
    means = {row["what"]: row["mean"][0] for row in rows}
    return {
        name: next((count for count in counts if means[anew(name, count)] >= means[OURS]), None)
        for name, counts in ANEW.items()
    }


table = lined(
    "| prediction | mean SSIM | gain of the hybrid in the edited scene |",
    "| {what} | {mean[0]:.3f} | {shown} |",
    lambda row: {**row, "shown": "" if row["what"] == OURS else "{:.3f} ({:.3f} to {:.3f})".format(*row["gain"])},
)
"""Mean SSIM of each prediction, and what the hybrid in the edited scene gains over it."""
