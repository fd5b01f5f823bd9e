"""Traced channels compared with closed forms, for this project's two evaluations and for Sionna RT's own solver."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.constants import epsilon_0, speed_of_light
from wrf_mi_scenes.build_laboratory import box, sheet
from wrf_mi_scenes.mitsuba_xml import PERFECT, PERFECT_CONDUCTIVITY, PERFECT_THICKNESS_M

from wrf_mi.core import Antenna, Receiver
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.files import write_figure
from wrf_mi.core.types import FloatArray, IntArray
from wrf_mi.tracing import TraceOptions, set_frequency, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.sionna.scattering import scattering_materials

from .comparison import opened
from .declared import pivoted
from .sionna_reference import sionna_paths
from .wave_formulas import ComplexArray, free_space, half_plane, knife_edge, lambertian_power, slab, wedge

CARRIERS_HZ = 0.299e9, 2.4e9, 28e9, 140e9
TRACED, FIELD, SIONNA = "`trace_paths`", "`TracedField`", f"Sionna RT {version('sionna-rt')}"
WAYS = TRACED, FIELD, SIONNA
PICTURE = Path("docs/images/closed-forms.png")  # written only in a checkout of the project
SPECULAR = TraceOptions(depth=1, rays=1 << 13)
DIFFRACTED = replace(SPECULAR, transmission=False, diffraction=True)
Constants = tuple[float, float, float]  # relative permittivity, conductivity in S/m and thickness in m of a slab
MIRROR: Constants = (1.0, PERFECT_CONDUCTIVITY, PERFECT_THICKNESS_M)
SLABS: Sequence[Constants] = ((6.31, 0.02, 0.012), (5.24, 0.1, 0.25))  # a pane and a wall, the same at all carriers
GROUND: Constants = (15.0, 0.5, 2.0)  # so lossy that nothing returns from its lower face
ANGLES_DEG = np.concatenate([np.arange(0, 80, 2), np.arange(80, 89.5, 0.5), [89.8]])
NEAR_M, FAR_M, INCIDENCE = 20.0, 10.0, np.radians(60)  # of an edge: receiver, transmitters, receiver's angle
AROUND_DEG = np.arange(2.3, 358, 5)  # angles of transmitters about an edge, off the boundaries of shadows
HZ = 2.44e9  # carrier at which scenes are opened
ROUNDING = 1e-5  # bound of relative errors by single precision: some tens of roundings of 6e-8
SLAB = 1e-3
"""The same of slabs, whose phase of up to 1,700 rad at 140 GHz is rounded, and of whose reflection little is left where
both faces cancel."""
EXPECTED_DB = 1.0  # deviation of a conducting half plane from the knife edge, which has no polarisation
EDGE = 1e-3  # error of the asymptotic theory of diffraction, of the order of 1 / (k s), 10 m from an edge at 299 MHz
SAMPLED = 1e-2  # relative error of an integral over 20,000 directions


@dataclass
class Arrivals:
    """The p paths of a solver from n transmitters to a receiver."""

    row: IntArray  # transmitter of each path [p]
    gain: ComplexArray  # gains without exp(-j k length) [p]
    length_m: FloatArray  # lengths [p]
    point_m: FloatArray  # points of the first interactions [p, 3], NaN for none

    def select(self, index: NDArray[Any]) -> "Arrivals":
        """Select paths."""
        return Arrivals(*(values[index] for values in vars(self).values()))

    def last(self) -> "Arrivals":
        """The longest path of each transmitter."""
        order = np.lexsort((self.length_m, self.row))
        return self.select(order[np.append(np.diff(self.row[order]) > 0, True)])

    def channel(self, count: int, frequency_hz: float) -> ComplexArray:
        """Channels [n] of ``count`` transmitters."""
        waves = self.gain * np.exp(-2j * np.pi * frequency_hz / speed_of_light * self.length_m)
        return np.bincount(self.row, waves.real, count) + 1j * np.bincount(self.row, waves.imag, count)


def arrivals(
    way: str, scene: Any, tx_m: FloatArray, rx_m: FloatArray, options: TraceOptions, polarization: str = "V"
) -> Arrivals:
    """Paths between antennas of one polarisation by one of `WAYS`."""
    if way == SIONNA:
        return Arrivals(*sionna_paths(scene, tx_m, rx_m, options, polarization))
    antenna = Antenna(polarization=polarization)
    receiver = Receiver("rx", rx_m, np.array(UPRIGHT), antenna)
    if way == TRACED:
        paths = trace_paths(scene, tx_m, receiver, options, tx_antenna=antenna, check=False).paths
        point = paths.vertices_m[:, 0] if paths.vertices_m.shape[1] else np.full((len(paths), 3), np.nan)
        return Arrivals(paths.tx, paths.gain, paths.length_m, point)
    field = TracedField(scene, tx_m, receiver, TracedOptions(options, tx_antenna=antenna), prepared=Prepared(scene))
    evaluated = field({})
    row = np.repeat(np.arange(len(field)), len(field.exists) // len(field))
    gain, length_m = evaluated.gain[0].numpy() + 1j * evaluated.gain[1].numpy(), evaluated.length_m.numpy()
    return Arrivals(row, gain, length_m, np.full((len(row), 3), np.nan)).select(field.exists)


def at_carrier(scene: Any, frequency_hz: float, constants: Constants) -> None:
    """Set a carrier, and the constants of the only material."""
    (material,) = {id(o.radio_material): o.radio_material for o in scene.objects.values()}.values()
    for name, value in zip(("relative_permittivity", "conductivity", "thickness"), constants, strict=True):
        setattr(material, name, dr.opaque(mi.Float, value))
    set_frequency(scene, frequency_hz)


def coefficients(cosine: FloatArray, constants: Constants, frequency_hz: float) -> tuple[Any, Any]:
    """Reflected and transmitted shares [p] of a slab, TE and TM."""
    permittivity, conductivity, thickness_m = constants
    eta = permittivity - 1j * conductivity / (2 * np.pi * frequency_hz * epsilon_0)
    return slab(cosine, np.asarray(eta), np.asarray(thickness_m), frequency_hz)


Errors = tuple[str, str, float, float, dict[str, FloatArray]]
"""Case, unit ("" for relative), carrier in Hz, bound of this project's errors (inf: none), errors [p] by `WAYS`."""
# The azimuth's unit vectors of two antennas that face each other are opposite: horizontal ones have a sign.
SIGN = {"V": 1, "H": -1}


def free_space_errors() -> Iterator[Errors]:
    """Isotropic antennas, 1 m to 10 km apart, amplitude and channel."""
    scene, distance_m = opened(sheet(0, 0.0, (-1.0, 1.0), (-1.0, 1.0)), HZ, PERFECT), np.geomspace(1, 1e4, 60)
    tx_m = np.stack([1 + 0.6 * distance_m, 0.8 * distance_m, 0 * distance_m], axis=1)
    for hz in CARRIERS_HZ:
        at_carrier(scene, hz, MIRROR)
        truth, amplitude, channel = free_space(distance_m, hz), {}, {}
        for way in WAYS:
            traced = arrivals(way, scene, tx_m, np.array([1.0, 0, 0]), replace(SPECULAR, depth=0))
            amplitude[way] = np.abs(np.abs(traced.gain / truth) - 1)
            channel[way] = np.abs(traced.channel(len(truth), hz) / truth - 1)
        yield "free space, amplitude", "", hz, ROUNDING, amplitude
        yield "free space, channel with its phase", "", hz, ROUNDING, channel


def two_ray_errors() -> Iterator[Errors]:
    """Antennas 10 m and 1.5 m above a lossy ground, 5 m to 2 km apart, relative to free space."""
    scene, apart_m = opened(sheet(2, 0.0, (-20.0, 2020.0), (-50.0, 50.0)), HZ, PERFECT), np.geomspace(5, 2000, 60)
    tx_m = np.stack([apart_m, 0 * apart_m, np.full_like(apart_m, 10.0)], axis=1)
    direct_m, reflected_m = np.hypot(apart_m, 8.5), np.hypot(apart_m, 11.5)
    for hz in CARRIERS_HZ:
        at_carrier(scene, hz, GROUND)
        (te, _), (tm, _) = coefficients(11.5 / reflected_m, GROUND, hz)
        for polarization, share in (("V", tm), ("H", te)):
            truth = SIGN[polarization] * (free_space(direct_m, hz) + share * free_space(reflected_m, hz))
            errors = {}
            for way in WAYS:
                traced = arrivals(way, scene, tx_m, np.array([0.0, 0, 1.5]), SPECULAR, polarization)
                errors[way] = np.abs((traced.channel(len(tx_m), hz) - truth) / free_space(direct_m, hz))
            yield f"two rays over ground, {polarization}", "", hz, ROUNDING, errors


def wall_errors() -> Iterator[Errors]:
    """Reflection at and transmission through walls at angles of incidence up to 89.8 degrees, both polarisations."""
    scene, rx_m = opened(sheet(0, 0.0, (-200.0, 200.0), (-50.0, 50.0)), HZ, PERFECT), np.array([0.25, 0.0, 0.0])
    along_m = 0.5 * np.tan(np.radians(ANGLES_DEG))
    length_m = np.hypot(0.5, along_m)
    for hz, constants in ((hz, constants) for hz in CARRIERS_HZ for constants in (MIRROR, *SLABS)):
        at_carrier(scene, hz, constants)
        waves = zip(("V", "H"), ("TE", "TM"), coefficients(0.5 / length_m, constants, hz), strict=True)
        for polarization, name, shares in waves:
            for side, what, share in zip((1, -1), ("reflection", "transmission"), shares, strict=True):
                if constants is MIRROR and side < 0:
                    continue  # nothing arrives
                truth = SIGN[polarization] * share * np.abs(free_space(length_m, hz))
                tx_m = np.stack([np.full_like(along_m, side * rx_m[0]), along_m, 0 * along_m], axis=1)
                errors = {}
                for way in WAYS:
                    traced = arrivals(way, scene, tx_m, rx_m, SPECULAR, polarization).last()
                    errors[way] = np.abs(traced.gain / truth - 1)
                kind, bound = ("mirror", ROUNDING) if constants is MIRROR else ("slab", SLAB)
                yield f"{kind}, {what}, {name}", "", hz, bound, errors


def about_edge(radius_m: float, angle_rad: Any) -> FloatArray:
    """Points [p, 3] at angles from the face y < 0 of an edge along the z axis, towards +x."""
    angle = np.asarray(angle_rad, float)
    return radius_m * np.stack([np.sin(angle), -np.cos(angle), 0 * angle], axis=-1)


def screen() -> Any:
    """Scene of a conducting half plane at x = 0, y < 0, with other edges far away."""
    return opened(sheet(0, 0.0, (-30.0, 0.0), (-20.0, 20.0)), HZ, PERFECT)


def edge_field(way: str, scene: Any, tx_m: FloatArray, rx_m: FloatArray, hz: float, polarization: str) -> ComplexArray:
    """Channels [n] by all paths but those by the other edges of `screen`."""
    traced = arrivals(way, scene, tx_m, rx_m, DIFFRACTED, polarization)
    other = (np.abs(traced.point_m[:, 2]) > 1) | (traced.point_m[:, 1] < -29)
    return SIGN[polarization] * traced.select(~other).channel(len(tx_m), hz)


def knife_edge_errors() -> Iterator[Errors]:
    """Antennas 50 m from both sides of a screen whose edge is 2 m below to 3 m above the line between them, dB."""
    scene, rx_m = screen(), np.array([50.0, 0, 0])
    tx_m = np.stack([np.full(26, -50.0), np.linspace(4, -6, 26), np.zeros(26)], axis=1)
    length_m = np.linalg.norm(tx_m - rx_m, axis=1)
    height_m = -tx_m[:, 1] / 2 * 100 / length_m  # across the line
    off = np.abs(tx_m[:, 1]) > 0.01  # the line through the edge itself is lit or not by chance
    for hz in CARRIERS_HZ[:2]:
        at_carrier(scene, hz, MIRROR)
        truth = knife_edge(height_m, length_m / 2, length_m / 2, hz) * np.abs(free_space(length_m, hz))
        for polarization in "VH":
            fields = {way: edge_field(way, scene, tx_m, rx_m, hz, polarization) for way in (TRACED, SIONNA)}
            errors = {way: np.abs(20 * np.log10(np.abs(field) / truth))[off] for way, field in fields.items()}
            yield f"knife edge, {polarization}", " dB", hz, EXPECTED_DB, errors


def half_plane_errors() -> Iterator[Errors]:
    """Total fields about a conducting half plane, relative to the incident field at the distance over the edge."""
    scene, angle = screen(), np.radians(AROUND_DEG)
    rx_m, tx_m = about_edge(NEAR_M, INCIDENCE), about_edge(FAR_M, angle)
    for hz in CARRIERS_HZ:
        at_carrier(scene, hz, MIRROR)
        scale = speed_of_light / hz / (4 * np.pi)
        k = 2 * np.pi * hz / speed_of_light
        for polarization, truth in zip("VH", half_plane(k, NEAR_M, FAR_M, INCIDENCE, angle), strict=True):
            unit = np.abs(free_space(NEAR_M + FAR_M, hz))
            errors = {
                way: np.abs(edge_field(way, scene, tx_m, rx_m, hz, polarization) - scale * truth) / unit
                for way in (TRACED, SIONNA)
            }
            name = "along" if polarization == "V" else "across"
            yield f"half plane, field {name} the edge", "", hz, EDGE, errors


def wedge_errors() -> Iterator[Errors]:
    """Waves diffracted by the edge of a conducting block, relative to free space over the edge."""
    scene = opened(box((-20.0, -20.0, -20.0), (0.0, 0.0, 20.0)), HZ, PERFECT)
    angle = np.radians(AROUND_DEG[AROUND_DEG < 269])
    rx_m, tx_m = about_edge(NEAR_M, INCIDENCE), about_edge(FAR_M, angle)
    options = replace(DIFFRACTED, line_of_sight=False, reflection=False)
    for hz in CARRIERS_HZ:
        at_carrier(scene, hz, MIRROR)
        k, scale, errors = 2 * np.pi * hz / speed_of_light, speed_of_light / hz / (4 * np.pi), {}
        for polarization, truth in zip("VH", wedge(1.5, k, NEAR_M, FAR_M, INCIDENCE, angle), strict=True):
            for way in (TRACED, SIONNA):
                traced = arrivals(way, scene, tx_m, rx_m, options, polarization)
                edge = traced.select(np.linalg.norm(traced.point_m, axis=1) < 0.01)
                field = SIGN[polarization] * edge.channel(len(tx_m), hz)
                errors[way] = np.abs(field - scale * truth) / np.abs(free_space(NEAR_M + FAR_M, hz))
            name = "along" if polarization == "V" else "across"
            yield f"wedge of 90°, field {name} the edge", "", hz, EDGE, dict(errors)


def scattering_errors() -> Iterator[Errors]:
    """Power that a conducting wall of 10 m x 10 m scatters diffusely, relative."""
    size, share = ((-5.0, -5.0), (5.0, 5.0)), 0.5
    scene = opened(sheet(0, 0.0, (-5.0, 5.0), (-5.0, 5.0)), HZ, PERFECT)
    tx_m, rx_m = np.array([[2.0, 0, 0], [1, 4, 1], [6, -3, 2], [12, 8, -3]]), np.array([3.0, 1, -0.5])
    options = replace(SPECULAR, line_of_sight=False, reflection=False, transmission=False, rays=1 << 16)
    options = replace(options, scattering=True, scattering_coefficient=share)
    for hz in CARRIERS_HZ:
        at_carrier(scene, hz, MIRROR)
        truth, errors = np.array([lambertian_power(tx, rx_m, *size, share, hz) for tx in tx_m]), {}
        for way in (TRACED, SIONNA):
            with scattering_materials(scene, options):
                traced = arrivals(way, scene, tx_m, rx_m, options)
            power = np.bincount(traced.row, np.abs(traced.gain) ** 2, len(tx_m))
            errors[way] = np.abs(power / truth - 1)
        yield "wall that scatters, power", "", hz, SAMPLED, errors


def room() -> tuple[Any, FloatArray, FloatArray]:
    """A closed concrete room of 6 x 5 x 2.5 m with three boxes in it, and 60 pairs of free positions [60, 3] each."""
    rng = np.random.default_rng(0)
    walls = np.array([(0, 0, 0), (6, 5, 2.5)])
    low_m = np.array([(1.5, 1.7, 0), (3.7, 2.5, 0), (2.9, 0.6, 0)])
    pieces = np.stack([low_m, [(2.5, 2.3, 1.2), (4.3, 3.5, 2), (4.1, 1.4, 0.8)]], axis=1)
    ends = rng.uniform([0.3, 0.3, 0.3], [5.7, 4.7, 2.3], (400, 3))
    solid = np.any([((ends > piece[0]) & (ends < piece[1])).all(axis=1) for piece in pieces], axis=0)
    boxes: Any = trimesh.util.concatenate([trimesh.creation.box(bounds=corners) for corners in (walls, *pieces)])
    tx_pos_m, rx_pos_m = np.split(ends[~solid][:120], 2)
    return opened(boxes, HZ, "concrete"), tx_pos_m, rx_pos_m


def consistency_errors() -> Iterator[Errors]:
    """Channels of a furnished room after exchanging the ends, of receivers alone, and of transmitters in batches."""
    scene, tx_m, rx_m = room()
    tx_m, rx_m = tx_m[:20], np.concatenate([rx_m, rx_m + 0.01])[:100]
    channels = partial(channel_matrix, scene, options=replace(SPECULAR, depth=2, rays=1 << 17))
    forth, scale = channels(tx_m, rx_m)

    def errors(other: ComplexArray) -> dict[str, FloatArray]:
        return {TRACED: (np.abs(other - forth) / scale).ravel()}

    hz = float(scene.frequency[0])
    yield "antennas exchanged", "", hz, ROUNDING, errors(channels(rx_m, tx_m)[0].T)
    alone = np.concatenate([channels(tx_m, place[None])[0] for place in rx_m])
    yield f"{len(rx_m)} receivers at once or alone", "", hz, ROUNDING, errors(alone)
    parts = np.concatenate([channels(tx_m[k : k + 7], rx_m)[0] for k in range(0, len(tx_m), 7)], axis=1)
    yield "transmitters in batches", "", hz, ROUNDING, errors(parts)


def channel_matrix(
    scene: Any, tx_m: FloatArray, rx_m: FloatArray, *, options: TraceOptions
) -> tuple[ComplexArray, FloatArray]:
    """Channels [receivers, transmitters], and the sums of the paths' amplitudes."""
    receivers = [Receiver(f"rx{number}", place, np.array(UPRIGHT)) for number, place in enumerate(rx_m)]
    paths = trace_paths(scene, tx_m, receivers, options, check=False).paths
    pair, shape = paths.rx * len(tx_m) + paths.tx, (len(rx_m), len(tx_m))
    path_arrivals = Arrivals(pair, paths.gain, paths.length_m, np.full((len(paths), 3), np.nan))
    amplitudes = np.asarray(np.bincount(pair, np.abs(path_arrivals.gain), shape[0] * shape[1]), float)
    return path_arrivals.channel(len(amplitudes), float(scene.frequency[0])).reshape(shape), amplitudes.reshape(shape)


CASES = (
    free_space_errors,
    two_ray_errors,
    wall_errors,
    knife_edge_errors,
    half_plane_errors,
    wedge_errors,
    scattering_errors,
    consistency_errors,
)


def main() -> dict[str, Any]:
    """Errors of all cases, and a picture of two."""
    cases = [result for case in CASES for result in case()]
    if PICTURE.parent.is_dir():
        write_figure(PICTURE, picture(cases))
    rows = [summary(name, [case for case in cases if case[0] == name]) for name in dict.fromkeys(c[0] for c in cases)]
    above = [row["what"] for row in rows if max(row["greatest"].get(way, 0) for way in (TRACED, FIELD)) > row["bound"]]
    rows = [{**row, "bound": row["bound"] if np.isfinite(row["bound"]) else None} for row in rows]
    return {"rows": rows} | ({"failed": f"beyond its bound: {'; '.join(above)}"} if above else {})


def summary(name: str, cases: Sequence[Errors]) -> dict[str, Any]:
    """Row of one case over all carriers, materials and polarisations: greatest and median error of each solver."""
    unit, bound = cases[0][1], cases[0][3]
    errors = {way: np.concatenate([case[4][way] for case in cases]) for way in WAYS if way in cases[0][4]}
    greatest = {way: float(values.max()) for way, values in errors.items()}
    median = {way: float(np.median(values)) for way, values in errors.items()}
    carriers: dict[str, dict[str, float]] = {f"{hz / 1e9:g} GHz": {} for _, _, hz, *_ in cases}
    for _, _, hz, _, by_way in cases:
        entry = carriers[f"{hz / 1e9:g} GHz"]
        entry |= {way: max(entry.get(way, 0.0), float(values.max())) for way, values in by_way.items()}
    shown = {way: f"{shown_error(greatest[way])}{unit} ({shown_error(median[way])})" for way in errors}
    row = {"what": name, "value": "; ".join(f"{way} {text}" for way, text in shown.items())}
    row["asked"] = f"{bound:g}{unit}" if np.isfinite(bound) else "-"
    return {**row, "errors": shown, "bound": bound, "greatest": greatest, "median": median, "by_carrier": carriers}


def shown_error(value: float) -> str:
    """Error with one digit after its first."""
    return "0" if value == 0 else f"{value:.1e}"


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Markdown table: greatest error, with the median in brackets, of each solver, and the bound of this project's."""
    pairs = [{**row, "way": way, "error": error} for row in rows for way, error in row["errors"].items()]
    return pivoted("| case | ... | asked |", "| {what} | ... | {asked} |", "what", "way", "{error}")(pairs)


def picture(cases: Sequence[Errors]) -> Figure:
    """Errors of transmission through the thicker slab by angle, and fields about the half plane."""
    figure = Figure(figsize=(10, 3.8), layout="constrained", facecolor="white")
    left, right = figure.subplots(1, 2)
    through = [case for case in cases if case[0] == "slab, transmission, TE"][1::2]
    for number, (_, _, hz, _, errors) in enumerate(through):
        for way, style in zip(WAYS, ("-", ":", "--"), strict=True):
            label = f"{way.strip('`')}, {hz / 1e9:g} GHz" if number in (1, 3) else None
            if label:
                left.semilogy(ANGLES_DEG, errors[way], style, color=f"C{number}", label=label)
    left.set(xlabel="angle of incidence (degrees)", ylabel="relative error", title="transmission through 25 cm, TE")
    left.legend(fontsize=7)
    hz, scene = CARRIERS_HZ[1], screen()
    at_carrier(scene, hz, MIRROR)
    fine, unit = np.radians(np.arange(1, 359, 0.5)), 1 / (NEAR_M + FAR_M)
    for number, (polarization, name) in enumerate((("V", "along"), ("H", "across"))):
        truth = half_plane(2 * np.pi * hz / speed_of_light, NEAR_M, FAR_M, INCIDENCE, fine)[number]
        ends = about_edge(FAR_M, np.radians(AROUND_DEG)), about_edge(NEAR_M, INCIDENCE)
        right.plot(np.degrees(fine), 20 * np.log10(np.abs(truth) / unit), color=f"C{number}", label=f"exact, {name}")
        for way, marker in ((TRACED, "o"), (SIONNA, "x")):
            field = np.abs(edge_field(way, scene, *ends, hz, polarization) / free_space(1 / unit, hz))
            label = f"{way.strip('`')}, {name}"
            right.plot(AROUND_DEG, 20 * np.log10(field), marker, ms=4, color=f"C{number}", label=label)
    right.set(xlabel="angle from the face (degrees)", ylabel="relative to free space (dB)")
    right.set(xlim=(180, 360), ylim=(-50, 5))
    right.set_title("shadow of a half plane, field along and across its edge")
    right.legend(fontsize=7)
    for axes in (left, right):
        axes.grid(alpha=0.3)
    return figure
