"""Prediction by operator compared with direct evaluation: time, memory and difference; times of networks."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import to_tensor
from wrf_mi.backend.recorded import Recorded
from wrf_mi.core import Receiver
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.types import SQUARED_MAGNITUDE_EPS
from wrf_mi.gaussians import Factorised, Gaussians, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.operator import PixelOperator
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.static_signals import FactorisedSignals
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.combine import ArrayReceiver, PowerReceiver
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.graph.operator import ArrayOperator, SectorOperator
from wrf_mi.runs.timing import bootstrap, interleaved, memory_mb, ratio
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.step import device_pose

from .comparison import Row, line
from .stress_rows import relative

GAUSSIANS, HEIGHT, WIDTH, BATCH = 10_000, 90, 360, 64
SIZE_DEG = 3.0
"""Angular standard deviation of each Gaussian: 115 weights a pixel."""
ELEMENTS, CARRIER_HZ = planar_array(4, 4, 0.16), 920e6
SECTORS = (6, 4)
SMALL = 270
"""Gaussians of the default fit."""
REPEATS = 15
RECEIVER = Receiver("array", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def random_field(
    field: Any, count: int = GAUSSIANS, size_deg: float = SIZE_DEG, seed: int = 0
) -> dict[str, NDArray[np.float32]]:
    """Parameters of a field of ``count`` Gaussians of random shapes and rotations around the receiver."""
    rng = np.random.default_rng(seed)
    params = field.init(random_gaussians([RECEIVER], count, rng, size_deg=size_deg), rng)
    params["log_scale"] += rng.normal(0, 0.3, (3, count)).astype(np.float32)
    params["rotation"] = rng.standard_normal((4, count)).astype(np.float32)
    return dict(params)


def processor_ms(call: Callable[[], Any], repeats: int = REPEATS) -> float:
    """Median processor time of a call, which depends little on other processes."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(1e3 * (time.process_time() - start))
    return float(np.median(times))


class Direct:
    """Direct evaluation of a field for one transmitter, as a recorded network and recorded splatting."""

    def __init__(self, field: Any, params: Mapping[str, NDArray[np.float32]]) -> None:
        self.params = {name: to_tensor(values) for name, values in params.items()}
        self.pose, self.plane = device_pose(RECEIVER), perception_plane(HEIGHT, WIDTH, mi.Float)
        self._product = field.blending == "product"

        @Recorded
        def network(params: Any, tx_pos: Any) -> Any:
            with dr.suspend_grad():
                g = field.gaussians(params, tx_pos)
                return g.position, g.scale, g.rotation, g.signal, g.attenuation if self._product else [g.opacity]

        @Recorded
        def splatted(parts: Any, pose: Any, plane: Any) -> Any:
            with dr.suspend_grad():
                return splat(self.gaussians(parts), pose, plane)

        self._network, self._splatted = network, splatted

    def parts(self, tx_pos_m: NDArray[Any]) -> Any:
        """Geometry, signals and attenuation for a transmitter [3]."""
        return self._network(self.params, to_tensor(np.reshape(tx_pos_m, (3, 1))))

    def gaussians(self, parts: Any) -> Gaussians:
        """Gaussians of `parts`."""
        position, scale, rotation, signal, last = (list(part) for part in parts)
        alpha, delta = (None, last) if self._product else (last[0], None)
        return Gaussians(position, scale, rotation, signal, alpha, delta, 1)

    def splat(self, parts: Any) -> Any:
        """Complex field on the directions."""
        return self._splatted(parts, self.pose, self.plane)

    def pixels(self, tx_pos_m: NDArray[Any]) -> NDArray[Any]:
        """Magnitudes [pixels]."""
        re, im = self.splat(self.parts(tx_pos_m))
        return dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS).numpy()


def differences(field: Any, params: Mapping[str, NDArray[np.float32]], tx_pos_m: NDArray[Any]) -> dict[str, float]:
    """Relative L2 difference of the operators from direct evaluation for one transmitter; in dB for sectors."""
    direct = Direct(field, params)
    gaussians = direct.gaussians(direct.parts(tx_pos_m))
    pose, plane = direct.pose, direct.plane
    signal = (gaussians.signal[0].numpy() + 1j * gaussians.signal[1].numpy())[None]
    array = ArrayReceiver(HEIGHT, WIDTH, ELEMENTS, CARRIER_HZ)(None, splat(gaussians, pose, plane)).numpy()
    power = PowerReceiver(HEIGHT, WIDTH, (CARRIER_HZ,))(None, learned_field(gaussians, pose, plane, True)).numpy()
    spectrum = ArrayOperator.of(gaussians, pose, plane, ELEMENTS, CARRIER_HZ).spectrum(signal)[0]
    magnitude = PixelOperator.of(gaussians, pose, plane).magnitude(signal, SQUARED_MAGNITUDE_EPS)[0]
    pixels, power_db = direct.pixels(tx_pos_m), SectorOperator.of(gaussians, pose, plane).power_db(signal)
    return {
        "array": relative(spectrum.ravel() - array.ravel(), array),
        "pixels": relative(magnitude.ravel() - pixels.ravel(), pixels),
        "rssi_db": float(np.abs(power_db - power).max()),
    }


def of_networks(rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Times of a prediction, ms: network, splatting, both, and by operator."""
    found = {}
    tx = rng.uniform(-2, 2, (BATCH, 3)).astype(np.float32)
    cases: dict[str, tuple[Any, int, float]] = {
        "WRF-GS, 270 Gaussians": (WrfGs(), SMALL, 7.0),
        "WRF-GS, 10,000 Gaussians": (WrfGs(), GAUSSIANS, SIZE_DEG),
        "WRF-GS+, 270 Gaussians": (WrfGsPlus(), SMALL, 7.0),
        "factorised, 270 Gaussians": (Factorised(), SMALL, 7.0),
    }
    for name, (field, count, size) in cases.items():
        params = random_field(field, count, size)
        direct = Direct(field, params)
        parts = direct.parts(tx[0])
        calls: dict[str, Callable[[], Any]] = {
            "network": lambda d=direct: d.parts(tx[0]),  # type: ignore[misc]
            "splatting": lambda d=direct, p=parts: d.splat(p),  # type: ignore[misc]
            "both": lambda d=direct: d.pixels(tx[0]),  # type: ignore[misc]
        }
        if field.static_geometry:
            predictor = Predictor(field, params, [RECEIVER], HEIGHT, WIDTH, operator=True)
            calls["operator"] = lambda p=predictor: p(tx[:1])  # type: ignore[misc]
            calls[f"operator, {BATCH}"] = lambda p=predictor: p(tx)  # type: ignore[misc]
        times = interleaved(calls, REPEATS, most_s=30)
        found[name] = {key: bootstrap(t / (BATCH if key.endswith(str(BATCH)) else 1)) for key, t in times.items()}
    return found


def main() -> dict[str, Any]:
    """Times, memory and differences, with rows for the table."""
    rng = np.random.default_rng(0)
    field = Factorised()
    params = random_field(field)
    direct = Direct(field, params)
    tx = rng.uniform(-2, 2, (BATCH, 3)).astype(np.float32)
    gaussians = direct.gaussians(direct.parts(tx[0]))
    pose, plane = direct.pose, direct.plane
    model = ArrayReceiver(HEIGHT, WIDTH, ELEMENTS, CARRIER_HZ)
    build: dict[str, Callable[[], Any]] = {
        "array": lambda: ArrayOperator.of(gaussians, pose, plane, ELEMENTS, CARRIER_HZ),
        "pixels": lambda: PixelOperator.of(gaussians, pose, plane),
        "sectors": lambda: SectorOperator.of(gaussians, pose, plane, *SECTORS),
    }
    built = {name: bootstrap(t) for name, t in interleaved(build, 5).items()}
    memory = {name: memory_mb(call) for name, call in build.items()}
    by_array, pixels, sectors = build["array"](), build["pixels"](), build["sectors"]()
    signals = FactorisedSignals(field, params)
    assert signals.factors is not None
    factors = signals.factors
    small, images = by_array.composed(factors), pixels.composed(factors)
    power = sectors.composed(factors)
    given = (signals.coefficients(tx) @ factors.T).astype(np.complex64)

    def each(one: Callable[[NDArray[Any]], Any], rows: NDArray[Any]) -> tuple[Callable[[], Any], Callable[[], Any]]:
        return lambda: one(rows[:1]), lambda: one(rows)

    pairs = {
        "array": each(lambda at: small.spectrum(signals.coefficients(at)), tx),
        "array, scaled": each(lambda at: small.spectrum(signals.coefficients(at), scale=True), tx),
        "array, signals of 10,000 given": each(by_array.spectrum, given),
        "pixels": each(lambda at: images.magnitude(signals.coefficients(at), SQUARED_MAGNITUDE_EPS), tx),
        "pixels, signals of 10,000 given": each(lambda s: pixels.magnitude(s, SQUARED_MAGNITUDE_EPS), given),
        "RSSI of 24 sectors": each(lambda at: power.power_db(signals.coefficients(at)), tx),
    }
    calls: dict[str, Callable[[], Any]] = {
        "direct, array": lambda: model(None, direct.splat(direct.parts(tx[0]))).numpy(),
        "direct, pixels": lambda: direct.pixels(tx[0]),
    }
    for name, (one, many) in pairs.items():
        calls |= {f"{name}, 1": one, f"{name}, {BATCH}": many}
    raw = interleaved(calls, REPEATS, most_s=120)
    per = {name: BATCH if name.endswith(f", {BATCH}") else 1 for name in calls}
    times = {name: bootstrap(t / per[name]) for name, t in raw.items()}
    processor = {name: processor_ms(call) / per[name] for name, call in calls.items()}
    gain = {
        kind: ratio(raw[f"direct, {kind}"], raw[f"{kind}, {count}"] / per[f"{kind}, {count}"])
        for kind, count in (("array", 1), ("pixels", 1))
    }
    gain |= {f"{kind}, {BATCH}": ratio(raw[f"direct, {kind}"], raw[f"{kind}, {BATCH}"] / BATCH) for kind in gain}
    product = WrfGs()
    apart = {
        "alpha blending": differences(field, params, tx[0]),
        "product blending": differences(product, random_field(product), tx[0]),
    }
    networks = of_networks(rng)
    size = {
        "array": by_array.matrix.nbytes / 1e6,
        "pixels": pixels.nbytes / 1e6,
        "pixels, composed": images.table.nbytes / 1e6,
        "sectors": sectors.matrix.nbytes / 1e6,
    }
    asked = {"array, 1": "1 ms", f"array, {BATCH}": "0.15 ms, aim 0.05"}
    rows: list[Row] = []
    for name, found in times.items():
        kind, _, count = name.rpartition(", ")
        what = {"1": f"{kind}, one transmitter", str(BATCH): f"{kind}, each of {BATCH}"}.get(count, name)
        rows.append(line(what, f"{found} ms; processors {processor[name]:.3g} ms", asked.get(name, "")))
    rows += [line(f"times faster than direct: {name}", str(interval)) for name, interval in gain.items()]
    rows += [
        line(f"building: {name}", f"{ms} ms, {memory[name]:.0f} MB beside its result") for name, ms in built.items()
    ]
    rows += [line(f"size: {name}", f"{megabytes:.2g} MB") for name, megabytes in size.items()]
    for name, errors in apart.items():
        text = f"array {errors['array']:.1e}, pixels {errors['pixels']:.1e}, RSSI {errors['rssi_db']:.1e} dB"
        rows.append(line(f"relative L2 difference from direct, {name}", text, "1e-4"))
    for name, shares in networks.items():
        text = "; ".join(f"{key} {interval}" for key, interval in shares.items())
        rows.append(line(f"ms of one spectrum, {name}", text))
    return {"rows": rows, "times_ms": {name: str(t) for name, t in times.items()}, "weights": int(pixels.weights.nnz)}
