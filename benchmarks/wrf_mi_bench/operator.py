"""Prediction by operator compared with direct evaluation: time, memory and difference; times of networks."""

from collections.abc import Mapping
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import Recorded, to_tensor
from wrf_mi.gaussians import Factorised, Gaussians, WrfGs, WrfGsPlus
from wrf_mi.gaussians.blend import splat
from wrf_mi.gaussians.operator import PixelOperator, pixel_weights, static_signals
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.receivers.reports import SQUARED_MAGNITUDE_EPS
from wrf_mi.synthetic.laboratory import RECEIVER
from wrf_mi.tasks.scores import bootstrap
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.step import device_pose

from .comparison import line
from .stress_rows import relative
from .timing import Call, interleaved, memory_mb, ratio
from .workloads import HEIGHT, WIDTH, parameters

GAUSSIANS, BATCH = 10_000, 64
SIZE_DEG = 3.0  # angular standard deviation of each Gaussian: 115 weights a pixel
SMALL = 270  # Gaussians of the default fit
REPEATS = 15


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
        position, scale, rotation, signal, last = (list(part) for part in parts)
        alpha, delta = (None, last) if self._product else (last[0], None)
        return Gaussians(position, scale, rotation, signal, alpha, delta, 1)

    def operator(self, gaussians: Gaussians) -> PixelOperator:
        weights = pixel_weights(gaussians, self.pose, self.plane)
        return PixelOperator(weights, self.plane.height, self.plane.width)

    def splat(self, parts: Any) -> Any:
        """Complex field on the directions."""
        return self._splatted(parts, self.pose, self.plane)

    def pixels(self, tx_pos_m: NDArray[Any]) -> NDArray[Any]:
        """Magnitudes [pixels] for a transmitter [3]."""
        re, im = self.splat(self.parts(tx_pos_m))
        return dr.sqrt(re * re + im * im + SQUARED_MAGNITUDE_EPS).numpy()


def difference(field: Any, params: Mapping[str, NDArray[np.float32]], tx_pos_m: NDArray[Any]) -> float:
    """Relative L2 difference of the operator's magnitudes from direct evaluation for one transmitter."""
    direct = Direct(field, params)
    gaussians = direct.gaussians(direct.parts(tx_pos_m))
    signal = (gaussians.signal[0].numpy() + 1j * gaussians.signal[1].numpy())[None]
    magnitudes = direct.operator(gaussians).magnitude(signal, SQUARED_MAGNITUDE_EPS)
    pixels = direct.pixels(tx_pos_m)
    return relative(magnitudes.ravel() - pixels, pixels)


def of_networks(rng: np.random.Generator) -> dict[str, dict[str, Any]]:
    """Times of a prediction, ms: network, splatting, both, and by operator."""
    times_of = {}
    tx = rng.uniform(-2, 2, (BATCH, 3)).astype(np.float32)
    cases: dict[str, tuple[Any, int, float]] = {
        "WRF-GS, 270 Gaussians": (WrfGs(), SMALL, 7.0),
        "WRF-GS, 10,000 Gaussians": (WrfGs(), GAUSSIANS, SIZE_DEG),
        "WRF-GS+, 270 Gaussians": (WrfGsPlus(), SMALL, 7.0),
        "factorised, 270 Gaussians": (Factorised(), SMALL, 7.0),
    }
    for name, (field, count, size) in cases.items():
        params = parameters(field, count, size)
        direct = Direct(field, params)
        calls: dict[str, Call] = {
            "network": partial(direct.parts, tx[0]),
            "splatting": partial(direct.splat, direct.parts(tx[0])),
            "both": partial(direct.pixels, tx[0]),
        }
        if field.static_geometry:
            predictor = Predictor.of_field(field, params, [RECEIVER], HEIGHT, WIDTH, operator=True)
            calls |= {"operator": partial(predictor, tx[:1]), f"operator, {BATCH}": partial(predictor, tx)}
        times = interleaved(calls, REPEATS, most_s=30)
        times_of[name] = {key: bootstrap(t / (BATCH if key.endswith(str(BATCH)) else 1)) for key, t in times.items()}
    return times_of


def main() -> dict[str, Any]:
    """Times, memory and differences, with rows for the table."""
    rng, field = np.random.default_rng(0), Factorised()
    params = parameters(field, GAUSSIANS, SIZE_DEG)
    direct = Direct(field, params)
    tx = rng.uniform(-2, 2, (BATCH, 3)).astype(np.float32)
    gaussians = direct.gaussians(direct.parts(tx[0]))

    build = partial(direct.operator, gaussians)
    built, built_mb, pixels = bootstrap(interleaved({"": build}, 5)[""]), memory_mb(build), build()
    factors, coefficients = static_signals(field, params)
    assert factors is not None
    images, weights = pixels.composed(factors), pixels.weights
    weights_parts = weights.data, weights.indices, weights.indptr
    signals = (coefficients(tx) @ factors.T).astype(np.complex64)

    def spectra(tx_pos_m: NDArray[Any]) -> NDArray[Any]:
        return images.magnitude(coefficients(tx_pos_m), SQUARED_MAGNITUDE_EPS)

    calls: dict[str, tuple[Call, int]] = {"direct, pixels": (partial(direct.pixels, tx[0]), 1)}
    for count, many in (("one transmitter", 1), (f"each of {BATCH}", BATCH)):
        calls[f"pixels, {count}"] = partial(spectra, tx[:many]), many
        stated = partial(pixels.magnitude, signals[:many], SQUARED_MAGNITUDE_EPS)
        calls[f"pixels, signals of {GAUSSIANS:,} given, {count}"] = stated, many
    alone = {name: call for name, (call, _) in calls.items()}
    raw, processor = interleaved(alone, REPEATS, most_s=120), interleaved(alone, REPEATS, most_s=60, processor=True)
    each = {name: raw[name] / many for name, (_, many) in calls.items()}
    times = {name: bootstrap(ms) for name, ms in each.items()}
    rows = [
        line(name, f"{times[name]} ms; processors {np.median(processor[name]) / many:.3g} ms")
        for name, (_, many) in calls.items()
    ]
    for what, name in (("pixels", "pixels, one transmitter"), (f"pixels, {BATCH}", f"pixels, each of {BATCH}")):
        rows.append(line(f"times faster than direct: {what}", str(ratio(each["direct, pixels"], each[name]))))
    rows += [
        line("building: pixels", f"{built} ms, {built_mb:.0f} MB beside its result"),
        line("size: pixels", f"{sum(part.nbytes for part in weights_parts) / 1e6:.2g} MB"),
        line("size: pixels, composed", f"{images.table.nbytes / 1e6:.2g} MB"),
    ]
    for name, kind in (("alpha", field), ("product", WrfGs())):
        error = difference(kind, parameters(kind, GAUSSIANS, SIZE_DEG), tx[0])
        rows.append(line(f"relative L2 difference from direct, {name} blending", f"pixels {error:.1e}", "1e-4"))
    for name, shares in of_networks(rng).items():
        text = "; ".join(f"{key} {interval}" for key, interval in shares.items())
        rows.append(line(f"ms of one spectrum, {name}", text))
    return {"rows": rows, "times_ms": {name: str(t) for name, t in times.items()}, "weights": int(pixels.weights.nnz)}
