"""Time against error of this package's evaluations and of others', of the same task on the same machine.

* Paths: `wrf_mi.tracing.trace_paths` and Sionna RT's ``PathSolver``, from one source to many targets.
* Maps: paths to the centres of cells and Sionna RT's ``RadioMapSolver``, which averages over cells by random rays.
* Fields: splatting, operator and Mitsuba integrator, and the integrator ``volprim_rf_basic``, of one field.

Calls are warm and interleaved. Received power is the sum of the powers of paths, without interference.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from matplotlib.figure import Figure
from wrf_mi_scenes import scenes

from wrf_mi.core import Paths, Receiver
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.files import write_figure
from wrf_mi.core.types import FloatArray, IntArray
from wrf_mi.gaussians.operator import PixelOperator, pixel_weights
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.synthetic.laboratory import RECEIVER, transmitter_path
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.surfaces import scene_surfaces

from .comparison import Row, kept, line
from .declared import lined
from .sionna_reference import as_paths
from .sources import fit_key, source_files
from .stress_fields import RECEIVER as FIELD_RECEIVER
from .stress_fields import made, on_device, placed, pose, truth
from .timing import Call, Within, interleaved
from .trace import confirm_paths, match_paths
from .traced import LARGEST_ERROR, LOWEST_SSIM, StockRenderer, against_splatted, rgb_variant, worst
from .workloads import HEIGHT, WIDTH, integrator, size_deg, splatting

RUNS, PICTURE = Path("runs/bench/side-by-side"), Path("docs/images/side-by-side.png")
HZ = 3.5e9
RAYS = (1_000, 10_000, 100_000, 1_000_000)  # from the source, of both tracers
REFERENCE_RAYS = 1 << 22
OPTIONS = TraceOptions(depth=3, transmission=False)
CITY_SOURCE_M, CITY_HALF_M, STREET_M = {"etoile": (60.0, 40.0, 30.0), "munich": (8.5, 21.0, 27.0)}, 100.0, 1.5
"""Sources in scenes of Sionna RT, and targets: in a square around the source, at this height."""
ROUTES = (("laboratory", 1), ("laboratory", 16), ("munich", 32))  # scenes, with numbers of targets
CELLS, MAP_RAYS, MAP_SAMPLES, MAP_REFERENCE = 100, (10_000, 100_000), (1_000_000, 10_000_000), 100_000_000
"""Cells along a side of the map, rays of our tracer, and samples of ``RadioMapSolver``."""
GAUSSIANS, BATCH, ORACLE_ROWS = (1_000, 10_000), 64, 6  # every 6th row of a spectrum is computed in float64
LEAST_ERROR = 1e-7  # in the picture, whose axes are logarithmic
REPEATS, FIELD_REPEATS = 3, 7
SEEDS = count(1)  # a process keeps what rays of a seed found, so each call has a seed of its own
OURS, SOLVER, MAP_SOLVER, VOLPRIM = "`trace_paths`", "`PathSolver`", "`RadioMapSolver`", "`volprim_rf_basic`"


def powers(paths: Paths) -> FloatArray:
    """Sum of the paths' powers at each target [n], the many of the two ends; 0: no path."""
    return np.asarray(np.bincount(paths.tx + paths.rx, np.abs(paths.gain) ** 2, max(paths.n_tx, paths.n_rx)), float)


class Route:
    """A scene in both tracers, with a source [3] and targets [n, 3] in metres."""

    def __init__(self, name: str, targets: int) -> None:
        from sionna import rt

        if name in scenes():
            self.source_m, self.targets_m = RECEIVER.position_m, transmitter_path(targets)
            self.scene, self.theirs = open_scene(name, HZ), open_scene(name, HZ)
        else:
            self.source_m, file = np.array(CITY_SOURCE_M[name]), getattr(rt.scene, name)
            beside = np.random.default_rng(0).uniform(-CITY_HALF_M, CITY_HALF_M, (targets, 2))
            self.targets_m = np.column_stack([self.source_m[:2] + beside, np.full(targets, STREET_M)])
            # Sionna RT opens it as by default, with surfaces of one material merged.
            self.scene, self.theirs = open_scene(file, HZ), rt.load_scene(file)
        self.theirs.frequency, self.surfaces = HZ, scene_surfaces(self.scene)
        self.theirs.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
        self.theirs.rx_array = self.theirs.tx_array
        self.theirs.add(rt.Transmitter("source", mi.Point3f(*self.source_m.tolist())))
        for number, target in enumerate(self.targets_m.tolist()):
            self.theirs.add(rt.Receiver(f"target{number}", mi.Point3f(*target)))

    def traced(self, rays: int, targets_m: FloatArray | None = None) -> Paths:
        """Paths of this package, by rays of a new seed: no call profits from the search of another one."""
        source, places_m = (
            Receiver("source", self.source_m, np.array(UPRIGHT)),
            self.targets_m if targets_m is None else targets_m,
        )
        options, prepared = replace(OPTIONS, rays=rays, seed=next(SEEDS)), Prepared(self.scene, self.surfaces)
        return trace_paths(self.scene, places_m, source, options, prepared=prepared, check=False).paths

    def solved(self, samples: int) -> Paths:
        """Paths of ``PathSolver`` from the source, which is the transmitter here, to the targets."""
        from sionna import rt

        how = {"max_depth": OPTIONS.depth, "refraction": OPTIONS.transmission, "seed": next(SEEDS)}
        return as_paths(rt.PathSolver()(self.theirs, samples_per_src=samples, **how))

    def mapped(self, samples: int, centre_m: FloatArray, size_m: float) -> FloatArray:
        """Powers in the cells of a square [CELLS, CELLS] by ``RadioMapSolver``."""
        from sionna import rt

        where = {"center": mi.Point3f(*centre_m.tolist()), "orientation": mi.Point3f(0), "size": mi.Point2f(size_m)}
        how = {"samples_per_tx": samples, "max_depth": OPTIONS.depth, "refraction": False, "seed": next(SEEDS)}
        solved = rt.RadioMapSolver()(self.theirs, cell_size=mi.Point2f(size_m / CELLS), **where, **how)
        return np.asarray(solved.path_gain.numpy()[0], float)

    def reference(self, rays: int) -> tuple[FloatArray, dict[str, Any]]:
        """Powers [n] of the confirmed paths that either tracer finds with many rays, and where the two differ."""
        ours, theirs = self.traced(rays), self.solved(rays)
        same, others = self.pairs(ours, theirs)
        mine, also = without(ours, same), without(theirs, others)
        other = without(also, self.pairs(ours, also)[1])  # what equals one of ours again, they have twice
        valid = confirm_paths(mine, self.targets_m, self.source_m, self.surfaces.triangles)
        others_valid = confirm_paths(other, self.source_m[None], self.targets_m, self.surfaces.triangles)
        counts = {"theirs_lacks": valid, "ours_lacks": others_valid}
        counts |= {"not_confirmed": ~valid, "theirs_not_confirmed": ~others_valid}
        figures = {name: int(mask.sum()) for name, mask in counts.items()}
        figures |= {"paths": len(ours) + figures["ours_lacks"], "theirs_repeated": len(also) - len(other)}
        right = powers(ours) - powers(mine.select(~valid)) + powers(other.select(others_valid))
        return right, {**figures, "references_differ_db": error_db(powers(theirs), powers(ours))[0]}

    def pairs(self, ours: Paths, theirs: Paths) -> Any:
        """Indices of equal paths of both, by target, length, and interaction point next to the source."""
        keys = []
        for paths, last in ((ours, ours.bounces - 1), (theirs, 0)):
            point = np.where(paths.bounces[:, None] == 0, self.source_m, paths.vertices_m[np.arange(len(paths)), last])
            keys.append((paths.tx + paths.rx, paths.length_m, point))
        return match_paths(*keys)


def without(paths: Paths, which: IntArray) -> Paths:
    """Paths but those of some indices."""
    return paths.select(np.setdiff1d(np.arange(len(paths)), which))


def error_db(power: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Mean error in dB where both have a value, and share of the reference's values that are lacking."""
    valued = reference > 0
    both = valued & (power > 0)
    error = np.abs(10 * np.log10(power[both] / reference[both]))
    return float(error.mean()) if both.any() else np.inf, 1 - float(both.sum() / max(valued.sum(), 1))


def entry(case: str, method: str, ms: float, error: float, unit: str = "", lacks: str = "") -> dict[str, Any]:
    """Row of a method with its time and its error in a case."""
    row = {"case": case, "method": method, "ms": ms, "error": error, "text": f"{error:.2g}{unit}", "lacks": lacks}
    return {**line(f"{case}: {method}", f"{ms:.3g} ms, {row['text']}"), **row}


def timed(calls: Mapping[str, Callable[[], Any]]) -> tuple[Mapping[str, float], Mapping[str, list[Any]]]:
    """Median milliseconds of calls, and what each of `REPEATS` timed ones returned."""
    results: dict[str, list[Any]] = {name: [] for name in calls}

    def recorded(name: str) -> Call:
        return lambda: results[name].append(calls[name]())

    times = interleaved({name: recorded(name) for name in calls}, REPEATS, warm_up=1)
    return {name: float(np.median(ms)) for name, ms in times.items()}, {
        name: values[1:] for name, values in results.items()
    }


def measure_paths(name: str, targets: int, rays: Sequence[int] = RAYS, most: int = REFERENCE_RAYS) -> dict[str, Any]:
    """Rows of both tracers at several numbers of rays, and how their references differ."""
    at, case = Route(name, targets), f"paths, {name}, {targets} target{'s'[: targets > 1]}"
    right, differences = at.reference(most)
    ways: dict[str, Callable[[int], Paths]] = {OURS: at.traced, SOLVER: at.solved}
    calls = {f"{tool}, {number:,} rays": partial(way, number) for number in rays for tool, way in ways.items()}
    times, results = timed(calls)
    rows = []
    for method, ms in times.items():
        error, lacks = np.mean([error_db(powers(paths), right) for paths in results[method]], axis=0).tolist()
        rows.append(entry(case, method, ms, error, " dB", f"{lacks:.1%}"))
    return {"rows": rows, "reference": {"case": case, **differences}}


def measure_map(name: str = "etoile") -> dict[str, Any]:
    """Rows of both maps: errors against the average in each cell, by very many samples, and by 3 x 3 points."""
    at, side = Route(name, 0), 2 * CITY_HALF_M
    centre, cell = np.array([*at.source_m[:2], STREET_M]), side / CELLS
    steps = (np.arange(CELLS) - (CELLS - 1) / 2) * cell
    grid = centre + np.stack([*np.meshgrid(steps, steps), np.zeros((CELLS, CELLS))], axis=-1).reshape(-1, 3)

    def traced(rays: int, dx: float = 0.0, dy: float = 0.0) -> FloatArray:
        return powers(at.traced(rays, grid + np.array([dx, dy, 0]))).reshape(CELLS, CELLS)

    calls: dict[str, Callable[[], FloatArray]] = {f"{OURS}, {n:,} rays": partial(traced, n) for n in MAP_RAYS}
    calls |= {f"{MAP_SOLVER}, {n:,} samples": partial(at.mapped, n, centre, side) for n in MAP_SAMPLES}
    times, results = timed(calls)
    thirds = (-cell / 3, 0.0, cell / 3)
    points = np.mean([traced(MAP_RAYS[-1], dx, dy) for dx in thirds for dy in thirds], axis=0)
    cells, case = at.mapped(MAP_REFERENCE, centre, side), f"map, {name}, {CELLS**2:,} cells"
    rows = []
    for method, ms in times.items():
        (error, lacks), (other, _) = (error_db(results[method][0], right) for right in (cells, points))
        rows.append(entry(case, method, ms, error, f" ({other:.2g}) dB", f"{lacks:.1%}"))
    error, lacks = error_db(points, cells)
    return {"rows": rows, "reference": {"case": case, "references_differ_db": error, "points_lack": lacks}}


def field_of(number: int) -> Any:
    """Random field of Gaussians whose overlap does not depend on their number."""
    rng = np.random.default_rng(0)
    position = placed(rng.uniform(0, 2 * np.pi, number), np.arcsin(rng.uniform(0, 1, number)), rng, (2.0, 8.0))
    distance = np.linalg.norm(position - FIELD_RECEIVER.position_m, axis=1)
    scale = np.radians(size_deg(number)) * distance[:, None] * 2.0 ** -rng.uniform(0, 1, (number, 3))
    return made(number, rng, position_m=position, scale_m=scale, opacity=rng.uniform(0.05, 0.4, number))


def field_calls(random_field: Any) -> dict[str, Call]:
    """Calls that evaluate a field; integrators get its geometry anew, of which Mitsuba builds a BVH."""
    gaussians = on_device(random_field, "alpha", mi.Float)[0]
    stock = StockRenderer(FIELD_RECEIVER, HEIGHT, WIDTH)
    weights = pixel_weights(gaussians, pose(mi.Float), perception_plane(HEIGHT, WIDTH, mi.Float))
    operator, signal = PixelOperator(weights, HEIGHT, WIDTH), random_field.signal.astype(np.complex64)[None]
    return {
        "splatting": splatting(gaussians, FIELD_RECEIVER),
        "operator": partial(operator.field, signal),
        f"operator, {BATCH} at once": partial(operator.field, np.repeat(signal, BATCH, axis=0)),
        "`wrf_traced`": integrator(gaussians, FIELD_RECEIVER),
        VOLPRIM: Within(partial(stock.field, gaussians), rgb_variant),
    }


def as_image(result: Any) -> Any:
    """Complex image of what a call of `field_calls` returns."""
    if isinstance(result, tuple):  # real and imaginary part
        return (result[0].numpy() + 1j * result[1].numpy()).reshape(HEIGHT, WIDTH)
    values = np.asarray(result if isinstance(result, np.ndarray) else result.numpy())
    return values @ [1, 1j] if values.shape[-1] == 2 else values.reshape(-1, HEIGHT, WIDTH)[0]


def measure_field(number: int) -> dict[str, Any]:
    """Rows of a field's evaluations; integrators take a Gaussian's largest response on the ray, as their reference."""
    random_field, case, rows = field_of(number), f"field, {number:,} Gaussians", list[dict[str, Any]]()
    calls, size = field_calls(random_field), (HEIGHT, WIDTH)
    exact = [truth(random_field, "alpha", size, on_rays, every=ORACLE_ROWS) for on_rays in (False, True)]
    for method, ms in interleaved(calls, FIELD_REPEATS).items():
        right, clear = exact["`" in method]
        error = np.abs(as_image(calls[method]())[::ORACLE_ROWS] - right)[clear].max() / np.abs(right).max()
        at_once = BATCH if "at once" in method else 1
        rows.append(entry(case, method, float(np.median(ms)) / at_once, float(error)))
    return {"rows": rows}


def picture(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Time against error, a panel for each case."""
    cases = list(dict.fromkeys(row["case"] for row in rows))
    programs = list(dict.fromkeys(row["method"].split(", ")[0] for row in rows))
    figure = Figure(figsize=(12, 6.5), layout="constrained", facecolor="white")
    shown = dict[str, Any]()
    for axes, case in zip(figure.subplots(2, -(-len(cases) // 2)).flat, cases, strict=True):
        of_field = case.startswith("field")
        for number, program in enumerate(programs):
            of = [row for row in rows if row["case"] == case and row["method"].split(", ")[0] == program]
            if of:
                at = [row["ms"] for row in of], [max(row["error"], LEAST_ERROR) for row in of]
                shown[program.strip("`")] = axes.plot(*at, " " if of_field else "-", marker="o", color=f"C{number}")[0]
        error = "largest error, relative" if of_field else "mean error (dB)"
        axes.set(xscale="log", yscale="log", title=case, xlabel="time (ms)", ylabel=error)
        axes.tick_params(axis="x", which="minor", labelsize=6, labelrotation=30)
        axes.grid(alpha=0.3)
    figure.legend(shown.values(), shown, loc="outside lower center", ncols=len(shown), fontsize=9)
    return figure


def main() -> dict[str, Any]:
    """Rows of all cases, kept by the content of the packages' files, and their picture."""
    place = RUNS / fit_key(source_files())
    parts = [
        *(kept(place / f"{name}-{targets}.json", partial(measure_paths, name, targets)) for name, targets in ROUTES),
        kept(place / "map.json", measure_map),
        *(kept(place / f"field-{number}.json", partial(measure_field, number)) for number in GAUSSIANS),
    ]
    rows: list[Row] = [row for part in parts for row in part["rows"]]
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, picture(rows))
    small = kept(place / "small.json", lambda: worst(against_splatted()))
    text = f"SSIM {small['lowest_ssim']:.4f}, L2 error {small['largest_complex_error']:.2%}"
    what = "`wrf_traced` against splatting, worst of 40 renders of random fields of small Gaussians"
    rows.append(line(what, text, f"{LOWEST_SSIM:g}, {100 * LARGEST_ERROR:g} %"))
    return {"rows": rows, "references": [part["reference"] for part in parts if "reference" in part], "small": small}


table = lined(
    "| case | method | time | error | without a value |",
    "| {case} | {method} | {ms:.3g} ms | {text} | {lacks} |",
    lambda row: row if "case" in row else None,
)
"""Time and error of each method in each case."""
