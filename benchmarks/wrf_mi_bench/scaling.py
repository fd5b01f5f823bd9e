"""Growth of time and memory with the size of the work, and exponents of the growth."""

import gc
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import sionna.rt
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from threadpoolctl import threadpool_limits
from wrf_mi_scenes.divided import cluttered_room, divided_room

from wrf_mi.backend.device import to_tensor
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.files import write_figure
from wrf_mi.estimators.interpolation.strengths import fit_strengths
from wrf_mi.estimators.model import Inputs
from wrf_mi.gaussians import FIELDS
from wrf_mi.gaussians.parameters import gaussians_in_parts
from wrf_mi.graph.graph import Graph
from wrf_mi.receivers import antenna_csi, bartlett_spectrum
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.receivers.registry import PIXEL, ObservationSpec
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tasks.scores import Interval
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.search.surfaces import find_planes, scene_surfaces
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.fields import make_field
from wrf_mi.training.predictor import Predictor

from .comparison import line, opened
from .timing import Call, exponent, interleaved, larger_half, memory_mb, n_log_n
from .workloads import HEIGHT, WIDTH, field, integrator, parameters, size_deg, splatting, strengths, tracer

logger = logging.getLogger(__name__)

REPEATS, MOST_S = 7, 8.0
"""Timed calls of each size, and seconds after which no further call begins; three are timed in any case."""
CALL_S = 100.0  # expected seconds of a call, at growth as n^1.1, beyond which a size is skipped
SLOW_MS, FEW = 4000.0, 2  # milliseconds of a slow call, and timed calls of a slow one, without warm-up
GAUSSIANS, ELEMENTS = 1000, 16  # numbers where another size grows
SMALL = 90  # Gaussians of the field that predicts for thousands of transmitters
OPTIONS = TraceOptions(transmission=False, depth=2, rays=1 << 14)


@dataclass(frozen=True)
class Axis:
    """A call whose cost is measured while a size grows."""

    name: str  # name for JSON
    title: str  # what is called, for the table
    work: str  # what the size counts
    sizes: tuple[int, ...]  # ascending sizes
    make: Callable[[int], Call]  # makes the call of a size; its time does not count


def _splat(count: int, height: int = HEIGHT, width: int = WIDTH) -> Call:
    gaussians, receiver = field(count)
    return splatting(gaussians, receiver, height, width)


def _integrator(count: int) -> Call:
    return integrator(*field(count))


def _directions(make: Callable[..., Call], count: int, directions: int) -> Call:
    finer = round(np.sqrt(directions / (HEIGHT * WIDTH)))
    return make(count, HEIGHT * finer, WIDTH * finer)


def _networks(count: int) -> Call:
    """Geometry and signals of WRF-GS+ for one transmitter."""
    field = FIELDS["wrf-gs+"]()
    params = {name: to_tensor(values) for name, values in parameters(field, count, size_deg(count)).items()}
    tx = to_tensor(transmitter_path(1).T)
    return lambda: vars(gaussians_in_parts(field, params, tx))


def _field(transmitters: int) -> Call:
    tx = transmitter_path(transmitters)
    field = make_field(TrainConfig().resolved(tx))
    graph = Graph(field, [RECEIVER], ObservationSpec(PIXEL, (HEIGHT, WIDTH)))
    predictor = Predictor(graph, parameters(field, SMALL, size_deg(SMALL)))
    return lambda: predictor(tx)


def _tracer(transmitters: int) -> Call:
    return partial(tracer(OPTIONS), transmitter_path(transmitters))


def _array(elements: int) -> Any:
    side = int(np.sqrt(elements))
    return planar_array(side, side, SPACING_M)


@cache
def _paths() -> Any:
    scene = open_scene("laboratory", FREQUENCY_HZ)
    return trace_paths(scene, transmitter_path(64), RECEIVER, OPTIONS).paths


def _antennas_of_paths(elements: int) -> Call:
    array_m = _array(elements)
    return lambda: antenna_csi(_paths(), RECEIVER, array_m, FREQUENCY_HZ)[..., 0]


def _bartlett(elements: int, height: int = HEIGHT, width: int = WIDTH) -> Call:
    rng, array_m = np.random.default_rng(0), _array(elements)
    signals = rng.standard_normal((8, elements)) + 1j * rng.standard_normal((8, elements))
    return lambda: bartlett_spectrum(signals, array_m, FREQUENCY_HZ, height, width)


def opened_room(triangles: int, kind: str = "clutter") -> Any:
    """Scene of a cluttered room, or of one with divided walls, ``kind="walls"``."""
    near = np.concatenate([transmitter_path(1), RECEIVER.position_m[None]])
    mesh = divided_room(triangles) if kind == "walls" else cluttered_room(triangles, near)
    return opened(mesh, FREQUENCY_HZ, "concrete")


def _trace(kind: str, triangles: int) -> Call:
    """One transmitter in an opened mesh whose planes are known: rays, paths and gains."""
    scene, tx = opened_room(triangles, kind), transmitter_path(1)
    return lambda: len(trace_paths(scene, tx, RECEIVER, OPTIONS).paths)


def _planes(kind: str, triangles: int) -> Call:
    surfaces = scene_surfaces(opened_room(triangles, kind))
    return lambda: len(find_planes(surfaces.names, surfaces.shape_ids, surfaces.first_face, surfaces.triangles).normal)


def _fit(rows: int = 200, receivers: int = 4) -> Call:
    """Kriging of signal strengths with calibrated intervals."""
    record = strengths(rows, receivers)
    return lambda: fit_strengths(record, np.arange(rows)).widen


def _map(points: int) -> Call:
    """Means and standard deviations of a receiver's strengths, kriged from 200 rows."""
    fitted = fit_strengths(strengths(200, 4), np.arange(200))
    inputs = Inputs(strengths(points, 1).tx_pos_m)
    return lambda: fitted.predict(inputs, 0).stated_std


def _carriers(carriers: int) -> Call:
    """Channels of transmitters by traced paths whose materials depend on the carrier."""
    instrument = Instrument("csi", (RECEIVER,), FREQUENCY_HZ * np.linspace(0.9, 1.1, carriers + 1)[1:])
    return partial(RayTracer("laboratory", instrument, OPTIONS), transmitter_path(16))


def _city(triangles: int) -> Call:
    """One transmitter in the middle of a city, 70 m from a receiver on a roof or mast."""
    scene = open_scene(Path(str(getattr(sionna.rt.scene, CITIES[triangles]))), CITY_HZ)
    middle_m = scene_surfaces(scene).centre_m
    tx_m, mast = middle_m + np.array([60, 30, 0]), replace(RECEIVER, position_m=middle_m + np.array([0, 0, 20]))
    return lambda: len(trace_paths(scene, tx_m, mast, OPTIONS).paths)


CITY_HZ = 3.5e9
CITIES = {13_098: "etoile", 38_936: "munich", 268_041: "san_francisco"}
"""Cities of Sionna RT by their numbers of triangles."""
ROWS, RECEIVERS, POINTS = (10, 100, 1000, 3000, 10_000), (1, 10, 100, 1000), (10**3, 10**4, 10**5, 10**6)
CARRIERS = (1, 4, 16, 64)
TENS, HALF_TENS = (10**3, 10**4, 10**5, 300_000, 10**6), (1000, 3000, 10_000, 30_000, 100_000)
DIRECTIONS = tuple(HEIGHT * WIDTH * k for k in (1, 4, 9, 16))
ANTENNAS, TRANSMITTERS = (16, 64, 256, 1024), (1, 16, 256, 4096)
TRIANGLES = (10**2, 10**3, 10**4, 10**5, 10**6)

AXES: list[Axis] = [
    Axis("gaussians-splat", "splatting", "Gaussians", TENS, _splat),
    Axis("gaussians-integrator", "Mitsuba integrator, geometry new", "Gaussians", HALF_TENS, _integrator),
    Axis("gaussians-networks", "networks of WRF-GS+", "Gaussians", HALF_TENS, _networks),
    Axis("directions-splat", "splatting", "directions", DIRECTIONS, partial(_directions, _splat, GAUSSIANS)),
    Axis("directions-array", "Bartlett spectrum", "directions", DIRECTIONS, partial(_directions, _bartlett, ELEMENTS)),
    Axis("antennas-paths", "paths", "antennas", ANTENNAS, _antennas_of_paths),
    Axis("antennas-spectrum", "Bartlett spectrum", "antennas", ANTENNAS, _bartlett),
    Axis("transmitters-field", "WRF-GS+ of 90 Gaussians", "transmitters", TRANSMITTERS, _field),
    Axis("transmitters-tracer", "ray tracer", "transmitters", TRANSMITTERS, _tracer),
    Axis("triangles-planes", "finding planes, divided walls", "triangles", TRIANGLES, partial(_planes, "walls")),
    Axis("triangles-walls", "one trace, divided walls", "triangles", TRIANGLES, partial(_trace, "walls")),
    Axis("triangles-clutter", "one trace, clutter", "triangles", TRIANGLES, partial(_trace, "clutter")),
    Axis("triangles-cities", "one trace, cities", "triangles", tuple(CITIES), _city),
    Axis("rows-strengths", "kriging of 4 receivers", "rows", ROWS, _fit),
    Axis("receivers-strengths", "kriging of 200 rows", "receivers", RECEIVERS, partial(_fit, 200)),
    Axis("points-map", "map of a receiver", "points", POINTS, _map),
    Axis("carriers-tracer", "ray tracer", "carriers", CARRIERS, _carriers),
]
"""All axes. Networks and integrator end at 1e5 Gaussians, as ten times as many take gigabytes."""


def scale(axis: Axis, repeats: int = REPEATS, most_s: float = MOST_S, call_s: float = CALL_S) -> dict[str, Any]:
    """Times and memory of one call at each size.

    ``sizes`` were measured, not those ``left_out``; ``ms`` and ``memory_mb`` are of each, ``exponent`` is that of time
    with its interval, ``limit`` that of n log n at the same sizes, both of two sizes or more.
    """
    sizes, times, memory = list[int](), list[Any](), list[float]()
    for size in axis.sizes:
        if sizes and 1e-3 * float(np.median(times[-1])) * (size / sizes[-1]) ** 1.1 > call_s:
            break
        call = axis.make(size)
        # Before any time: kernels are compiled here.
        start = time.perf_counter()
        memory.append(memory_mb(call))
        slow = 1e3 * (time.perf_counter() - start) > SLOW_MS
        sizes.append(size)
        often, warm_up = (min(FEW, repeats), 0) if slow else (repeats, 1)
        times.append(interleaved({"call": call}, often, warm_up, most_s)["call"])
        logger.info("%s %d: %.1f ms, %.0f MB", axis.name, size, np.median(times[-1]), memory[-1])
        del call
        gc.collect()
    result: dict[str, Any] = {"name": axis.name, "title": axis.title, "work": axis.work, "sizes": sizes}
    result |= {"left_out": list(axis.sizes[len(sizes) :]), "ms": [float(np.median(ms)) for ms in times]}
    growth = {"exponent": vars(exponent(sizes, times)), "limit": n_log_n(sizes)} if len(sizes) > 1 else {}
    return result | {"memory_mb": memory} | growth


def verdict(growth: Interval, limit: float) -> str:
    """Whether growth is at most that of the limit; it fails only where its whole interval lies above."""
    if growth.low > limit:
        return "does not hold"
    return "holds" if growth.high <= limit else "holds within its interval"


def rows(results: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    lines = []
    for result in results:
        slope, sizes = Interval(**result["exponent"]), result["sizes"]
        larger = sizes[larger_half(len(sizes))]
        missing = f", {result['left_out'][0]:,} left out: too slow" if result["left_out"] else ""
        growth = [f"{ms:.3g} ms" for ms in result["ms"]]
        memory = [f"{mb:.0f}" for mb in result["memory_mb"]]
        value = f"exponent {slope.value:.2f} ({slope.low:.2f} to {slope.high:.2f}) from {larger[0]:,}"
        what = f"{sizes[0]:,} to {sizes[-1]:,} {result['work']}, {result['title']}{missing}"
        asked = f"at most n log n ({result['limit']:.2f}): {verdict(slope, result['limit'])}"
        lines.append(line(what, f"{value}; {', '.join(growth)}; {', '.join(memory)} MB", asked))
    return lines


def growth_figure(results: Sequence[dict[str, Any]]) -> Figure:
    """Time and memory of each axis against its size, both logarithmic, with a line of n log n."""
    columns = 4
    count = -(-len(results) // columns)
    figure = Figure(figsize=(3 * columns, 2.4 * count), layout="constrained", facecolor="white")
    panels = figure.subplots(count, columns, squeeze=False).ravel()
    for panel in panels[len(results) :]:
        panel.set_axis_off()
    for panel, result in zip(panels, results, strict=False):
        sizes, ms = np.array(result["sizes"], float), np.array(result["ms"])
        bound = sizes * np.log(np.maximum(sizes, 2))
        panel.loglog(sizes, bound / bound[-1] * ms[-1], "--", color="0.6", label="n log n")
        panel.loglog(sizes, ms, "o-", color="C0", label="time (ms)")
        # Less than a megabyte is what the allocator keeps, not the call's.
        panel.loglog(sizes, np.maximum(result["memory_mb"], 1), "s:", color="C1", label="memory (MB)")
        panel.set_title(result["title"], fontsize=9)
        panel.set_xlabel(result["work"], fontsize=8)
        panel.tick_params(which="both", labelsize=7)
        panel.xaxis.set_minor_formatter(NullFormatter())
        panel.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


PICTURE = Path("docs/images/scaling.png")  # written only in a checkout of the project


def main() -> dict[str, Any]:
    """All axes, five minutes on two cores."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    with threadpool_limits(1, "blas"):
        results = [scale(axis) for axis in AXES]
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, growth_figure(results))
    return {"rows": rows(results), "axes": results}
