"""Parts of receivers that compute in any Dr.Jit float, float32 against float64: values and derivatives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.constants import speed_of_light

from wrf_mi.backend.device import on_device
from wrf_mi.core import Paths, Receiver, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.arrays import planar_array
from wrf_mi.graph.ports import Ports, path_sum
from wrf_mi.receivers import Lags, csi, element_signals
from wrf_mi.receivers.device import LagMatrix, with_gains
from wrf_mi.receivers.device import gaussian_signals as device_signals
from wrf_mi.receivers.footprints import gaussian_signals
from wrf_mi.tracing.traced_field import TracedPaths

from .stress_fields import Rng
from .stress_rows import DOUBLE, GRADIENT, IMAGE, GradientWorst, Row, Worst, relative

CARRIER_HZ = 920e6
WAVENUMBER = 2 * np.pi * CARRIER_HZ / speed_of_light
ELEMENTS_M = planar_array(4, 4, 0.16)
Inputs = Mapping[str, FloatArray]
Function = Callable[[Mapping[str, Any]], Sequence[Any]]
"""Function from flat arrays of one float type, by name, to flat arrays of that type."""


def twins(count: int) -> list[Row]:
    """Rows of all parts, ``count`` cases of each kind of input."""
    rows = []
    for name, kinds, function in (
        ("closed-form footprints", FOOTPRINTS, _footprints),
        ("lags, squared spectra and gains", SIGNALS, _lags),
    ):
        value, slope = Worst(), GradientWorst()
        for kind, make in kinds.items():
            for seed in range(count):
                _compare(function, make(np.random.default_rng(seed)), seed, kind, value, slope)
        cases = f"{count * len(kinds)} cases"
        rows += [
            value.row(f"receiver: {name}, {cases}", IMAGE),
            slope.row(f"receiver: derivatives of {name}, {cases}", GRADIENT),
        ]
    return [*rows, _against_numpy(count), paths(count)]


def _compare(function: Function, inputs: Inputs, seed: int, kind: str, value: Worst, slope: GradientWorst) -> None:
    held = {name: np.asarray(v, np.float32).astype(float) for name, v in inputs.items()}
    found, slopes = {}, {}
    for float_type in (mi.Float, DOUBLE):
        arrays = {name: on_device(v, float_type) for name, v in held.items()}
        dr.enable_grad(arrays)
        parts = function(arrays)
        rng, total = np.random.default_rng(seed), float_type(0)
        for part in parts:
            total = total + dr.sum(part * on_device(rng.normal(size=dr.width(part)).astype(np.float32), float_type))
        dr.backward(total)
        found[float_type] = np.concatenate([dr.detach(part).numpy().astype(float) for part in parts])
        slopes[float_type] = {name: dr.grad(a).numpy().astype(float) for name, a in arrays.items()}
    value.add(relative(found[mi.Float] - found[DOUBLE], found[DOUBLE]), kind)
    slope.add(slopes[mi.Float], slopes[DOUBLE], {name: v.ravel() for name, v in held.items()}, kind)


def _parts(flat: Any, count: int) -> list[Any]:
    """Rows of an array [count * n], each [n]."""
    size = dr.width(flat) // count
    return [dr.gather(type(flat), flat, dr.arange(mi.UInt32, size) + i * size) for i in range(count)]


def _spread(rng: Rng, deviations: Any) -> dict[str, FloatArray]:
    """Footprints with three axes of these standard deviations, rad."""
    n = 20
    direction = rng.normal(size=(n, 3))
    turn = np.linalg.qr(rng.normal(size=(n, 3, 3)))[0]
    axes = turn * np.broadcast_to(deviations, (n, 3))[:, :, None]
    return {
        "direction": (direction / np.linalg.norm(direction, axis=1, keepdims=True)).T,
        "axes": axes.transpose(1, 2, 0),
        "signal": rng.normal(size=(2, n)),
    }


FOOTPRINTS: Mapping[str, Callable[[Rng], Inputs]] = {
    "random": lambda r: _spread(r, r.uniform(0.01, 0.3, (20, 3))),
    "sizes of 1e-6 to 1 rad": lambda r: _spread(r, 10 ** r.uniform(-6, 0, (20, 1))),
    "each axis of 1e-6 to 1 rad": lambda r: _spread(r, 10 ** r.uniform(-6, 0, (20, 3))),
    "needles, 1e6 to 1": lambda r: _spread(r, [0.3, 3e-7, 3e-7]),
    "discs, 1e6 to 1": lambda r: _spread(r, [0.3, 0.3, 3e-7]),
}


def _footprints(given: Mapping[str, Any]) -> Sequence[Any]:
    direction, signal = _parts(given["direction"], 3), _parts(given["signal"], 2)
    flat = _parts(given["axes"], 9)
    kind: Any = type(given["signal"])
    elements = [on_device(column, kind) for column in ELEMENTS_M.T]
    # Normalised in this precision, as a vector of unit length in float32 is not one in float64.
    norm = dr.rsqrt(sum((c * c for c in direction[1:]), direction[0] * direction[0]))
    direction = [c * norm for c in direction]
    axes = [flat[0:3], flat[3:6], flat[6:9]]
    return device_signals((signal[0], signal[1]), direction, axes, elements, kind(WAVENUMBER))


SIGNALS: Mapping[str, Callable[[Rng], Inputs]] = {
    "random": lambda r: {"h": r.normal(size=(2, 48)), "gain": r.normal(size=(2, 16))},
    "signals of 1e-15 to 1e15": lambda r: {
        "h": r.normal(size=(2, 48)) * 10 ** r.uniform(-15, 15, 48),
        "gain": r.normal(size=(2, 16)),
    },
}


@cache
def _lag_matrix() -> LagMatrix:
    return LagMatrix(Lags(ELEMENTS_M, CARRIER_HZ, 15, 30))


def _lags(given: Mapping[str, Any]) -> Sequence[Any]:
    h, gain = (tuple(_parts(given[name], 2)) for name in ("h", "gain"))
    return [_lag_matrix().squared(_lag_matrix().of_signals(with_gains(h, gain)))]


def _against_numpy(count: int) -> Row:
    """Row of the closed form in Dr.Jit's float64 compared with NumPy, up to the rounding of covariance matrices."""
    worst = Worst()
    for seed in range(count):
        inputs = FOOTPRINTS["random"](np.random.default_rng(seed))
        n, axes = np.asarray(inputs["direction"]).T, np.asarray(inputs["axes"])
        re, im = inputs["signal"]
        arrays = {name: DOUBLE(np.ascontiguousarray(v.ravel())) for name, v in inputs.items()}
        found = _footprints(arrays)
        covariance = np.einsum("kin,kjn->nij", axes, axes)
        truth = (re + 1j * im) @ gaussian_signals(n, covariance, ELEMENTS_M, CARRIER_HZ)
        worst.add(relative(found[0].numpy() + 1j * found[1].numpy() - truth, truth))
    return worst.row(f"receiver: closed-form footprints in float64 against NumPy, {count} cases", 1e-9)


def paths(count: int, each: int = 50) -> Row:
    """Element signals and CSI of paths of 1 m to 100 km at 28 GHz, Dr.Jit against NumPy, both with float64 phases."""
    worst, carrier_hz = Worst(), 28e9
    here = Receiver("array", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    elements, tones = planar_array(4, 4, 0.005), carrier_hz * np.linspace(0.98, 1.02, 16)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        length = 10 ** rng.uniform(0, 5, each)
        arrival = unit_vectors(rng.uniform(0, 2 * np.pi, each), rng.uniform(-1.5, 1.5, each))
        gain = 10 ** rng.uniform(-15, 15, each) * np.exp(2j * np.pi * rng.uniform(size=each))
        traced = TracedPaths(
            (DOUBLE(gain.real.copy()), DOUBLE(gain.imag.copy())),
            DOUBLE(length),
            [DOUBLE(np.ascontiguousarray(c)) for c in arrival.T],
            1,
            each,
        )
        none = np.zeros((each, 0))
        known = Paths(
            tx=np.zeros(each, np.int64),
            rx=np.zeros(each, np.int64),
            gain=gain,
            length_m=length,
            departure=-arrival,
            arrival=arrival,
            interactions=none.astype(np.int32),
            vertices_m=np.zeros((each, 0, 3)),
            objects=none.astype(np.int32),
            object_names=(),
            n_tx=1,
            n_rx=1,
        )
        for ports, truth in (
            (Ports(elements, np.full(16, carrier_hz)), element_signals(known, here, elements, carrier_hz)),
            (Ports(np.zeros((16, 3)), tones), csi(known, tones)),
        ):
            re, im = path_sum(traced, ports)
            off = np.abs(re.numpy() + 1j * im.numpy() - truth.ravel())
            worst.add(off.max() / np.abs(gain).sum())
    return worst.row(f"receiver: elements and CSI of paths at 28 GHz, 1 m to 100 km, {2 * count} cases", IMAGE)
