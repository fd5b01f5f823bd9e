"""Traced paths, alone and together with Gaussians, values and derivatives, float32 compared with float64.

Phases and delays of traced paths are compared with mirror images in closed form.

Reports and derivatives of a random functional by every parameter are compared. The reference for paths is
`stress_oracle` in NumPy with central differences, that for Gaussians the same code in float64. Errors of RSSI and CSI
are relative to the sum of the waves' magnitudes, those of spectra to their norm. Derivatives are weighed by a natural
step of each parameter: 1 / k for metres, 1 for rad and logarithms.
"""

import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from wrf_mi_scenes.build_laboratory import Mesh, sheet
from wrf_mi_scenes.mitsuba_xml import write_scene

from wrf_mi.backend.device import on_device
from wrf_mi.core import Antenna, Receiver
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Encoding, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.instrument_parameters import pattern_name, receiver_pose
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions

from .stress_fields import RECEIVER
from .stress_oracle import ComplexArray, OraclePaths, ReportOracle, TracedOracle, Values, report_error, slopes
from .stress_rows import DOUBLE, GRADIENT, IMAGE, PHASE, GradientWorst, Row, Worst, row

DELAY = 1e-6  # bound on the relative error of Sionna RT's delays: 17 roundings of float32
HALLS: tuple[tuple[float, tuple[float, float, float]], ...] = (
    (28e9, (100.0, 60.0, 12.0)),
    (915e6, (10_000.0, 4_000.0, 300.0)),
)
"""Carrier and size in metres."""
HZ = 920e6
ROOM = (6.0, 5.0, 3.0)  # size of the room in metres
WAVENUMBER = 2 * np.pi * HZ / speed_of_light
SIZE = (8, 24)
ELEMENTS_M = planar_array(3, 3, 0.16)
MODELS: Mapping[str, Any] = {
    "array": ArrayReceiver(*SIZE, ELEMENTS_M, HZ),
    "pixel": PixelReceiver(*SIZE, ELEMENTS_M, HZ),
    "RSSI": PowerReceiver(*SIZE, (HZ,)),
    "CSI": CsiReceiver(*SIZE, (HZ, 1.01 * HZ)),
}
ORACLE = ReportOracle(SIZE, ELEMENTS_M, HZ)
KINDS = ("itu_concrete", "itu_brick", "itu_plasterboard", "itu_glass", "itu_wood", "itu_metal")
THICKNESS_M = {"itu_concrete": 0.3, "itu_metal": 0.1, **dict.fromkeys(KINDS[1:5], 0.02), "itu_chipboard": 0.02}
GRAZING_M = 1e-3  # height of both antennas above the floor: 4e-4 rad at 5 m
LEFT = 0.01  # remaining share of the traced side where the learned side cancels it
MANY = 160  # transmitters, each with the 63 paths of up to three reflections in a box: 10,080 paths
STEP = 1e-5
"""Step of differences of the paths in natural steps (`_natural`): a tilt of 1e-5 rad is 1e-3 rad of phase 5 m away."""
PLACE = Receiver(
    "array",
    np.array([4.2, 2.9, 0.4]),
    Rotation.from_euler("zyx", (30, 20, 10), degrees=True).as_quat(),
    Antenna(frame="array"),
)
"""Receiver whose antenna turns with its array, so that reports depend on the rotation."""
NEAR_M = np.array([[1.9, 1.8, 1.3], [2.1, 1.7, 1.2]])  # two transmitters

COPLANAR, CANCELLING = "coplanar planes", f"T + L that cancel to {LEFT:.0%}"

TWO_BOUNCES = TraceOptions(transmission=False, depth=2, rays=1 << 13)
Parts = dict[str, tuple[str, Mesh]]


@dataclass(frozen=True)
class Case:
    """An ill-conditioned geometry."""

    parts: Parts = field(default_factory=dict)  # parts of the scene beside the room
    receiver: Receiver = PLACE  # receiver from which paths are searched
    tx_pos_m: FloatArray = field(default_factory=lambda: NEAR_M)  # positions of transmitters [n, 3]
    options: TraceOptions = TWO_BOUNCES  # options of the search
    values: Mapping[str, FloatArray] = field(default_factory=dict)  # given parameters by name
    cancels: bool = False  # whether the traced side's gain cancels the learned side at the first transmitter
    moved: bool = True  # whether planes are shifted by millimetres and tilted by 0.01 rad


CASES: Mapping[str, Case] = {
    # A door and a panel in a wall's plane, and a partition of two layers 2 cm apart with transmission.
    COPLANAR: Case(
        {
            "door": ("itu_wood", sheet(0, 0.0, (1.0, 3.5), (0.0, 2.1))),
            "panel": ("itu_metal", sheet(1, ROOM[1], (1.5, 4.5), (0.2, 2.0))),
            "partition": ("itu_chipboard", sheet(0, 3.1, (0.0, 2.6), (0.0, 2.0))),
            "layer": ("itu_plasterboard", sheet(0, 3.12, (0.0, 2.6), (0.0, 2.0))),
        },
        options=TraceOptions(depth=3, reflections=2, transmission=True, rays=1 << 13),
    ),
    # Line of sight and reflection cancel to a thousandth.
    "grazing paths": Case(
        receiver=replace(PLACE, position_m=np.array([5.6, 2.9, GRAZING_M])),
        tx_pos_m=np.array([[0.6, 1.8, GRAZING_M], [0.5, 2.9, 2 * GRAZING_M]]),
        moved=False,
    ),
    # Searched 2 cm in front of a wall and evaluated on it, where its reflection and the direct path coincide.
    "antenna on a wall": Case(
        receiver=replace(PLACE, position_m=np.array([ROOM[0] - 0.02, 2.9, 1.4])),
        values={"receiver.array.position": np.array([np.float32(0.02), 0.0, 0.0])},
        moved=False,
    ),
    CANCELLING: Case(tx_pos_m=NEAR_M[:1], cancels=True),
}


def joint(many: int = MANY, names: Iterable[str] | None = None, models: Iterable[str] = tuple(MODELS)) -> list[Row]:
    """Values and derivatives of `CASES` and of ``many`` transmitters, the worst of the receiver models."""
    tx_pos_m = np.random.default_rng(5).uniform(0.15, 0.85, (many, 3)) * ROOM
    cases = {
        **CASES,
        "many paths": Case(tx_pos_m=tx_pos_m, options=TraceOptions(transmission=False, depth=3, rays=1 << 15)),
    }
    rows = []
    for name in cases if names is None else names:
        with tempfile.TemporaryDirectory() as work:
            rows += _Joint(cases[name], Path(work)).rows(name, models)
    return rows


class _Joint:
    """Both sides of a case, and their parameters rounded to float32."""

    def __init__(self, case: Case, work: Path) -> None:
        self._case, rng = case, np.random.default_rng(7)
        room = {name: (kind, wall) for kind, (name, wall) in zip(KINDS, box_sheets(ROOM).items(), strict=True)}
        scene = open_scene(write_scene(work, room | case.parts, "Stress"), HZ, THICKNESS_M)
        options = TracedOptions(case.options, 2, materials="surface", planes=True)
        self._traced = TracedField(scene, case.tx_pos_m, case.receiver, options)
        self._oracle = TracedOracle(self._traced)
        # Encoded positions are detached, so the functional may hardly depend on them.
        encoding = Encoding(position_octaves=1, position_scale_m=1e6, tx_octaves=2)
        self._field = WrfGsPlus(encoding=encoding, layers=2, width=16, skip=1)
        start = self._field.init(random_gaussians([case.receiver], 25, rng, opacity=0.4, signal=0.5), rng)
        values = {f"field.{name}": value.astype(float) for name, value in start.items()}
        values["field.rotation"] = rng.normal(size=values["field.rotation"].shape)
        values |= {name: value.astype(float) for name, value in self._traced.parameters().items()}
        values[self._traced.gain_name] += [np.log(100.0), 0.0]
        deviation = {pattern_name(case.receiver): 0.01, "pattern.transmitter": 0.01}
        if case.moved:
            deviation |= {"plane.shift": 1e-3, "plane.tilt": 0.01}
        for name, size in deviation.items():
            values[name] = values[name] + rng.normal(0, size, values[name].shape)
        values |= {name: np.asarray(value, float) for name, value in case.values.items()}
        self._values = _rounded(values)
        if case.cancels:
            name, wave = self._traced.gain_name, self.learned(MODELS["RSSI"])[0, 0]
            traced_wave = self._oracle(self._values).at(np.zeros((1, 3)), np.array([HZ]))[0, 0]
            factor = -wave / traced_wave * (1 + LEFT)
            gain = self._values[name] + [np.log(np.abs(factor)), np.angle(factor)]
            self._values = _rounded({**self._values, name: gain})

    def rows(self, name: str, models: Iterable[str]) -> list[Row]:
        """Values and derivatives of the receiver models."""
        value, slope = Worst(), GradientWorst()
        references = {kind: _Reference(self, MODELS[kind]) for kind in models}
        counts = {kind: len(self._traced) * int(np.prod(MODELS[kind].shape)) for kind in references}
        weights = {kind: np.random.default_rng(3).normal(size=n).astype(np.float32) for kind, n in counts.items()}

        def functionals(values: Values) -> FloatArray:
            paths = self._oracle(values)
            return np.array([references[kind].report(paths) @ weights[kind].astype(float) for kind in references])

        paths = self._oracle(self._values)
        steps = {key: STEP * _natural(key) for key in self._values if not key.startswith("field.")}
        of_paths = slopes(functionals, self._values, steps)
        for number, (kind, reference) in enumerate(references.items()):
            report, single = self._by_graph(MODELS[kind], weights[kind], mi.Float)
            _, double = self._by_graph(MODELS[kind], weights[kind], DOUBLE, learned_alone=True)
            value.add(reference.error(report, paths), kind)
            truth = {key: part + (of_paths[key][number] if key in steps else 0) for key, part in double.items()}
            slope.add(single, truth, {key: self._felt(key) for key in truth}, kind)
        what = f"{name}, {int(self._traced.exists.sum())} paths, {len(references)} cases"
        return [value.row(f"joint: {what}", IMAGE), slope.row(f"joint: derivatives, {what}", GRADIENT)]

    def _felt(self, name: str) -> FloatArray:
        """Factors of a parameter's derivatives that make them comparable."""
        if name.startswith("field."):
            values = self._values[name]
            return values - self._case.receiver.position_m[:, None] if name == "field.position" else values
        return np.full(self._values[name].shape, _natural(name))

    def learned(self, model: Any) -> ComplexArray:
        """Learned signals [n, directions or ports] in float64."""
        re, im = self._learned(model, self._params(DOUBLE), DOUBLE)
        return ORACLE.learned(model, (re.numpy() + 1j * im.numpy()).reshape(len(self._traced), -1))

    def _params(self, kind: Any) -> dict[str, Any]:
        return {name: _tensor(value, kind) for name, value in self._values.items()}

    def _learned(self, model: Any, params: Mapping[str, Any], kind: Any) -> Any:
        weights = {name.removeprefix("field."): v for name, v in params.items() if name.startswith("field.")}
        gaussians = self._field.gaussians(weights, _tensor(self._case.tx_pos_m.T, kind))
        pose = receiver_pose(self._case.receiver, params, kind)
        return learned_field(gaussians, pose, perception_plane(*SIZE, kind), model.sphere)

    def _by_graph(
        self, model: Any, weight: Any, kind: Any, learned_alone: bool = False
    ) -> tuple[FloatArray, dict[str, FloatArray]]:
        """Report, and derivatives of its weighted sum, by both sides or with constant paths."""
        params = self._params(kind)
        dr.enable_grad(params)
        paths = self._traced({name: dr.detach(p) for name, p in params.items()} if learned_alone else params)
        report = model(paths, self._learned(model, params, kind))
        dr.backward(dr.sum(report * on_device(weight, kind)))
        values = dr.detach(report).numpy().astype(float)
        return values, {name: np.asarray(dr.grad(p).numpy(), float) for name, p in params.items()}


class _Reference:
    """Report in NumPy as a function of the paths, with the learned side of Dr.Jit's float64."""

    def __init__(self, joint: _Joint, model: Any) -> None:
        self._model, self._there = model, joint.learned(model)

    def report(self, paths: OraclePaths) -> FloatArray:
        model, ports = self._model, (ELEMENTS_M, np.full(len(ELEMENTS_M), HZ))
        if isinstance(model, CsiReceiver):
            ports = np.zeros((len(model.frequencies_hz), 3)), np.array(model.frequencies_hz)
        return ORACLE.report(model, paths.at(*ports), self._there)

    def error(self, report: FloatArray, paths: OraclePaths) -> float:
        waves = np.abs(paths.gain).reshape(len(self._there), -1).sum(axis=1) + np.abs(self._there).max(axis=1)
        return report_error(self._model, report, self.report(paths), waves)


def _natural(name: str) -> float:
    """A step of a parameter that changes phases or logarithms by about 1."""
    return 1 / WAVENUMBER if name.endswith((".position", ".shift")) else 1.0


def _tensor(value: FloatArray, kind: Any) -> Any:
    array = np.ascontiguousarray(value)
    tensor: Any = dr.tensor_t(kind)
    return tensor(on_device(array.ravel(), kind), array.shape)


def _rounded(values: Values) -> dict[str, FloatArray]:
    return {name: np.asarray(value, np.float32).astype(float) for name, value in values.items()}


def box_sheets(size_m: tuple[float, float, float]) -> dict[str, Any]:
    """Meshes of the six sides of a box."""
    spans = [(0.0, side) for side in size_m]
    return {
        f"{axis}{at:g}": sheet(axis, at, *(span for other, span in enumerate(spans) if other != axis))
        for axis in range(3)
        for at in (0.0, size_m[axis])
    }


def phases(count: int = 30) -> list[Row]:
    """Rows of traced phases and of Sionna RT's float32 delays, compared with mirror images in closed form."""
    return [row for frequency_hz, size_m in HALLS for row in _phases(frequency_hz, size_m, count)]


def _phases(frequency_hz: float, size_m: tuple[float, float, float], count: int) -> list[Row]:
    """Rows of a metal hall with up to two reflections."""
    rng = np.random.default_rng(0)
    tx, rx = rng.uniform(0.1, 0.9, (count, 3)) * size_m, rng.uniform(0.1, 0.9, 3) * size_m
    with tempfile.TemporaryDirectory() as work:
        parts = {name: ("itu_metal", wall) for name, wall in box_sheets(size_m).items()}
        scene = open_scene(write_scene(Path(work), parts, "Hall of metal"), frequency_hz)
        options = TraceOptions(transmission=False, depth=2, rays=1 << 14)
        paths = trace_paths(scene, tx, replace(RECEIVER, position_m=rx), options).paths
        delays_s = _sionna_delays(scene, tx, rx)
    worst, single, delay = Worst(), Worst(), Worst()
    metres, counted = 0.0, 0
    for index, position_m in enumerate(tx):
        lengths_m, exact = np.sort(paths.length_m[paths.tx == index]), _mirror_images(position_m, rx, np.array(size_m))
        theirs = speed_of_light * delays_s[index]
        for lengths, errors in ((lengths_m, worst), (lengths_m.astype(np.float32), single)):
            errors.add(np.abs(lengths - exact).max() if len(lengths) == len(exact) else np.inf)
        # Sionna RT finds some paths of large halls two or three times, by both triangles of a wall.
        off = np.abs(theirs[:, None] - exact) if len(theirs) else np.full((1, len(exact)), np.inf)
        counted += len(theirs)
        metres = max(metres, float(off.min(axis=0).max()), float(off.min(axis=1).max()))
        delay.add(max((off.min(axis=0) / exact).max(), (off / exact).min(axis=1).max()))
    wavenumber = 2 * np.pi * frequency_hz / speed_of_light
    where = f"{frequency_hz / 1e9:g} GHz in {size_m[0]:g} m"
    more = f" rad; with lengths in float32 {wavenumber * single.error:.0e} rad"
    phase = row(f"phase at {where}, {len(paths)} paths", wavenumber * worst.error, PHASE, more)
    more = f" of the delay: {metres * 1e3:.2g} mm, {wavenumber * metres:.0e} rad"
    return [phase, row(f"Sionna RT's own delays at {where}, {counted} paths", delay.error, DELAY, more)]


def _sionna_delays(scene: Any, tx_pos_m: FloatArray, rx_pos_m: FloatArray) -> list[FloatArray]:
    """Delays of Sionna RT's own solver in s, for each transmitter: up to two reflections."""
    from sionna import rt

    scene.tx_array = scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.add(rt.Receiver("rx", mi.Point3f(*map(float, rx_pos_m))))
    delays = []
    for place in tx_pos_m:
        scene.add(rt.Transmitter("tx", mi.Point3f(*map(float, place))))
        paths = rt.PathSolver()(scene, max_depth=2, samples_per_src=1 << 15, refraction=False, seed=1)
        tau = np.asarray(paths.tau.numpy(), float).ravel()
        delays.append(tau[np.asarray(paths.valid.numpy(), bool).ravel()])
        scene.remove("tx")
    scene.remove("rx")
    return delays


def _mirror_images(tx: FloatArray, rx: FloatArray, size: FloatArray, depth: int = 2) -> FloatArray:
    """Lengths of all paths of up to ``depth`` reflections in a box, sorted.

    Source: Allen and Berkley, "Image method for efficiently simulating small-room acoustics" (1979), JASA 65(4).
    """
    numbers = np.array(np.meshgrid(*[np.arange(-depth, depth + 1)] * 3)).reshape(3, -1).T
    numbers = numbers[np.abs(numbers).sum(axis=1) <= depth]
    image = np.where(numbers % 2 == 0, numbers * size + tx, (numbers + 1) * size - tx)
    return np.sort(np.linalg.norm(image - rx, axis=1))
