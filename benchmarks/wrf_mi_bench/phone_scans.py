"""Scenes made from scans of a phone by the command ``mesh``, against the rooms and flats that were scanned.

Homes and scans are drawn from seeds (`wrf_mi_bench.phone_homes`), on none of which anything was chosen. The scene is
moved to the frame of the home by the known motion of the phone's frame; no error of drift but the mean is taken out.
"""

import resource
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from wrf_mi_scenes.build_laboratory import joined
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import InputError
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.scene.coordinates import turned
from wrf_mi.scene.folder import FACTS_FILE, read_scene_folder
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import Surface, level_area, moved

from .comparison import command, kept_work, line, opened, say
from .declared import lined
from .phone_homes import Home, home, phone_scan, places_of
from .scene import CLEAR_M, path_agreement
from .sources import fit_key, source_files

ROOMS, FLATS = range(1000, 1020), range(1000, 1003)
RUNS = Path("runs/bench/phone-scans")
FREQUENCY_HZ = 2.4e9
DEVICES_M = 0.5, 2.0  # heights of devices
DEVICES = 12  # positions in each room, beside that of the other end
RAYS = 1 << 17
OF_WALL_M, OF_WALL_DEG, OF_WALL_SHARE = 0.3, 5.0, 0.3
"""Largest distance and angle, and least common share of the length, of a true wall and the one made of it."""
WITHIN_M = 0.03
ASKED = "5 % of the floor, 3 cm, 90 %"


def measure(seed: int, flat: bool, folder: Path) -> dict[str, Any]:
    """Errors of the scene that the command ``mesh`` makes of a scan of the home of a seed, and its time and memory."""
    place = home(seed, flat)
    mesh, to_home, errors = phone_scan(place, seed)
    folder.mkdir(parents=True)
    file, out = folder / "scan.obj", folder / "scene"
    mesh.export(file)
    try:
        make_scene(file, out)
        asked = ""
    except InputError as error:
        asked = str(error)
    if "--up y" not in asked:
        raise InputError(f"bench phone-scans: {file} with y up was read as if z were up")
    start = time.perf_counter()
    command("mesh", file, "--up", "y", "--out", out)
    seconds = time.perf_counter() - start
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3  # of the largest so far
    figures = compared(place, out, to_home, seed)
    value = "{floor_error:+.1%}, {wall_cm:.1f} cm, {recall:.1%}".format_map(figures)
    what = f"{'flat' if flat else 'room'} {seed}: {sum(room.area for room in place.rooms):.0f} m2, "
    what += f"{len(place.furniture)} pieces"
    facts = {"triangles": len(mesh.faces), "seconds": seconds, "peak_memory_mb": peak_mb}
    say("phone-scans", f"{what}: {value}, {seconds:.0f} s")
    noise = {"noise_mm": 1e3 * errors.noise_m, "tilt_deg": float(np.degrees(errors.tilt_rad))}
    return {**line(what, value, ASKED), "flat": flat, **noise, **facts, **figures}


def compared(place: Home, folder: Path, to_home: FloatArray, seed: int) -> dict[str, Any]:
    """Errors of a scene folder; ``to_home`` is the motion [4, 4] from the file's frame."""
    facts = read_yaml(folder / FACTS_FILE)
    registration = np.eye(4) if facts["registration"] is None else np.array(facts["registration"])
    to_z_up = np.eye(4)
    to_z_up[:3, :3] = turned(np.eye(3), "y").T
    motion = to_home @ np.linalg.inv(registration @ to_z_up)
    kinds = read_scene_folder(folder).materials.surfaces
    surfaces = list[Surface]()
    for name in kinds:
        mesh = trimesh.load_mesh(folder / "meshes" / f"{name}.ply", process=False)
        kind: Any = next(kind for kind in ("floor", "ceiling", "wall", "other") if kinds[name] == kind)
        surfaces.append(Surface(name, kind, np.asarray(mesh.vertices, float), np.asarray(mesh.faces)))
    surfaces = moved(surfaces, motion)
    floors = [surface for surface in surfaces if surface.kind == "floor"]
    true_m2 = place.area_m2
    floor_m2 = level_area(floors).area if floors else 0.0
    offsets = [_offset(wall, surfaces) for wall in place.walls]
    met = [offset for offset in offsets if offset is not None]
    agreement = path_agreement(
        opened(joined([*place.shell.values(), *place.furniture]), FREQUENCY_HZ, PERFECT),
        opened(joined([surface.mesh for surface in surfaces]), FREQUENCY_HZ, PERFECT),
        _devices(place, seed),
        seed,
        RAYS,
    )
    return {
        "floor_m2": true_m2,
        "floor_error": floor_m2 / true_m2 - 1,
        "walls": len(offsets),
        "walls_found": len(met),
        "wall_cm": 100 * float(np.median(met)) if met else np.nan,
        "walls_within": sum(offset < WITHIN_M for offset in met),
        "recall": agreement["recall"]["power"],
        "precision": agreement["precision"]["power"],
        "paths": agreement,
        "surfaces": len(surfaces),
    }


def _offset(wall: FloatArray, surfaces: list[Surface]) -> float | None:
    """Mean distance of the ends of a true wall's common stretch [2, 2] from the nearest wall made, metres."""
    along = (wall[1] - wall[0]) / np.linalg.norm(wall[1] - wall[0])
    across, length = np.array([-along[1], along[0]]), np.linalg.norm(wall[1] - wall[0])
    best = None
    for surface in surfaces:
        if surface.kind != "wall":
            continue
        flat = surface.vertices_m[:, :2] - wall[0]
        t, s = flat @ along, flat @ across
        common = min(t.max(), length) - max(t.min(), 0.0)
        if common < OF_WALL_SHARE * length:
            continue
        slope, level = np.polyfit(t, s, 1)
        if abs(slope) > np.tan(np.radians(OF_WALL_DEG)):
            continue
        offset = abs(level + slope * np.clip([t.min(), t.max()], 0, length)).mean()
        if offset < OF_WALL_M and (best is None or offset < best):
            best = float(offset)
    return best


def _devices(place: Home, seed: int) -> list[tuple[FloatArray, FloatArray]]:
    """In each room a fixed end [3] and positions [n, 3] of the other, clear of walls and furniture."""
    rng, ends = np.random.default_rng([seed, 9]), []
    for area in place.free:
        flat = places_of(shapely.buffer(area, -2 * CLEAR_M), DEVICES + 1, rng)
        heights = rng.uniform(*DEVICES_M, len(flat))
        if len(flat) > 1:
            ends.append((np.array([*flat[0], DEVICES_M[1]]), np.column_stack([flat, heights])[1:]))
    return ends


def main() -> dict[str, Any]:
    """Measure all homes; a home that this code has measured before is not measured again."""
    place = RUNS / fit_key(source_files())
    rows = [kept_work(place, f"room-{seed}", partial(measure, seed, False)) for seed in ROOMS]
    rows += [kept_work(place, f"flat-{seed}", partial(measure, seed, True)) for seed in FLATS]
    return {"rows": rows}


table = lined(
    "| scan | floor area | walls | power found again (of that predicted, right) | s |",
    "| {what} | {floor_error:+.1%} | {wall_cm:.1f} cm ({walls_within} of {walls}) | {recall:.1%} ({precision:.1%}) | "
    "{seconds:.0f} |",
)
"""Errors of the scenes."""
