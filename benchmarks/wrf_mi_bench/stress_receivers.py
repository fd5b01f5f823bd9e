"""Receivers under stress: what they report of random and of hard fields, float32 against NumPy in float64.

Pixels on the edge of a footprint are left out on both sides, see `stress_fields.ON_THE_EDGE`.

Waves that cancel leave the roundings of what they cancelled. Where a receiver reports a single sum over directions
(RSSI and CSI) its error is therefore counted in shares of the sum of the waves' magnitudes; that of element signals and
spectra, which are many such sums, in shares of their own norm.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.core import Paths, Receiver, pixel_directions, unit_vectors
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.types import SQUARED_MAGNITUDE_EPS
from wrf_mi.gaussians.footprint import Pose
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.combine import LEAST_POWER, ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from wrf_mi.graph.learned import hemisphere_pair, learned_field
from wrf_mi.graph.operator import ArrayOperator, SectorOperator, port_matrix
from wrf_mi.graph.ports import Ports, path_sum
from wrf_mi.receivers import array_response, bartlett_spectrum, csi, element_signals, minmax_scale
from wrf_mi.tracing.traced_field import TracedPaths

from .stress_fields import BLENDINGS, HARD, ComplexArray, Field, felt_values, gradient, made, on_device, pose, reference
from .stress_rows import GRADIENT, IMAGE, GradientWorst, Row, Worst, relative

SIZE = (30, 60)
CARRIER_HZ = 920e6
TONES_HZ = (CARRIER_HZ, 1.02 * CARRIER_HZ)
ELEMENTS_M = planar_array(4, 4, 0.16)
MODELS: dict[str, Any] = {
    "pixels": PixelReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ),
    "spectrum": ArrayReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ),
    "scaled spectrum": ArrayReceiver(*SIZE, ELEMENTS_M, CARRIER_HZ, instrument_scale=True),
    "RSSI": PowerReceiver(*SIZE, TONES_HZ),
    "CSI": CsiReceiver(*SIZE, TONES_HZ),
}
"""Of the physics model, in Dr.Jit: the ones that are trained through."""
DOUBLE: Any = dr.float64_array_t(mi.Float)


def _ordinary(rng: np.random.Generator) -> Field:
    return made(int(rng.integers(1, 100)), rng)


def _fields(random: int, of_each: int) -> Iterable[tuple[str, Field, str, int]]:
    """Family, field, blending and seed of each case."""
    for name, family, count in [("random", _ordinary, random), *((n, f, of_each) for n, f in HARD.items())]:
        for seed in range(count):
            field = family(np.random.default_rng(seed))
            for blending in BLENDINGS:
                yield name, field, blending, seed


def of_fields(random: int, of_each: int, families: Iterable[str] | None = None) -> list[Row]:
    """What each receiver reports of an image, float32 against float64.

    Args:
        random: ordinary fields.
        of_each: fields of each hard family.
        families: ``random`` and names of `HARD`; None: all.
    """
    chosen = None if families is None else set(families)
    worst: dict[str, Worst] = {}
    cases = 0
    for name, field, blending, _ in _fields(random, of_each):
        if chosen is not None and name not in chosen:
            continue
        cases += 1
        truth, clear = reference(field, blending, SIZE, sphere=True)
        seen = (truth * clear).reshape(-1)
        gaussians = on_device(field, blending, mi.Float)[0]
        for what, error in {**_by_model(gaussians, clear, seen), **_by_operator(gaussians, clear, seen, field)}.items():
            worst.setdefault(what, Worst()).add(error, name)
    return [one.row(f"receiver: {what}, {cases} cases", IMAGE) for what, one in worst.items()]


def _by_model(gaussians: Gaussians, clear: NDArray[np.bool_], seen: ComplexArray) -> dict[str, float]:
    """Errors of `MODELS`."""
    plane, half = perception_plane(*SIZE, mi.Float), seen.size // 2
    mask = to_device(clear.reshape(-1).astype(np.float32), mi.Float)
    re, im = (part * mask for part in learned_field(gaussians, pose(mi.Float), plane, sphere=True))
    upper = dr.arange(mi.UInt32, half)
    learned = {True: (re, im), False: tuple(dr.gather(mi.Float, part, upper) for part in (re, im))}
    found = {name: model(None, learned[model.sphere]).numpy().astype(float) for name, model in MODELS.items()}
    weight = np.tile(solid_angles(*SIZE), 2)
    wave, waves = (weight * seen).sum(), float((weight * np.abs(seen)).sum()) or 1.0
    directions = pixel_directions(*SIZE).reshape(-1, 3)
    h = (weight * seen)[:half] @ array_response(ELEMENTS_M, directions, CARRIER_HZ)
    spectrum = np.sqrt(bartlett_spectrum(h, ELEMENTS_M, CARRIER_HZ, *SIZE) ** 2 + SQUARED_MAGNITUDE_EPS)
    channel = np.tile([wave.real, wave.imag], len(TONES_HZ))
    amplitude = np.sqrt(np.abs(wave) ** 2 + LEAST_POWER)
    return {
        "pixels": relative(
            found["pixels"] - (pixels := np.sqrt(np.abs(seen[:half]) ** 2 + SQUARED_MAGNITUDE_EPS)), pixels
        ),
        "Bartlett spectrum": relative(found["spectrum"] - spectrum.ravel(), spectrum),
        "Bartlett spectrum, scaled": relative(
            found["scaled spectrum"] - (scaled := minmax_scale(spectrum).ravel()), scaled
        ),
        "RSSI": abs(float(10 ** (found["RSSI"][0] / 20)) - amplitude) / max(waves, amplitude),
        "CSI": float(np.abs(found["CSI"] - channel).max()) / waves,
    }


def _by_operator(gaussians: Gaussians, clear: NDArray[np.bool_], seen: ComplexArray, field: Field) -> dict[str, float]:
    """Errors of the operators, built once and applied to the signals."""
    plane, half = perception_plane(*SIZE, mi.Float), seen.size // 2
    directions, weight = hemisphere_pair(*SIZE), np.tile(solid_angles(*SIZE), 2) * clear.reshape(-1)
    ports = array_response(ELEMENTS_M, directions[:half], CARRIER_HZ).T * weight[:half]
    operator = ArrayOperator(port_matrix(gaussians, pose(mi.Float), plane, ports), ELEMENTS_M, CARRIER_HZ, *SIZE)
    h = ports @ seen[:half]
    spectrum = bartlett_spectrum(h, ELEMENTS_M, CARRIER_HZ, *SIZE)
    signal = field.signal[None]
    sectors = SectorOperator(port_matrix(gaussians, pose(mi.Float), plane, weight[None], sphere=True))
    waves, wave = float((weight * np.abs(seen)).sum()) or 1.0, (weight * seen).sum()
    amplitude = np.sqrt(np.abs(wave) ** 2 + LEAST_POWER)
    return {
        "element signals by the operator": relative(operator.signals(signal)[0] - h, h),
        "Bartlett spectrum by the operator": relative(operator.spectrum(signal)[0] - spectrum, spectrum),
        "RSSI by the operator": abs(float(10 ** (sectors.power_db(signal)[0] / 20)) - amplitude)
        / max(waves, amplitude),
    }


def derivatives(of_each: int, names: Iterable[str] = tuple(MODELS), families: Iterable[str] | None = None) -> list[Row]:
    """Derivatives of what receivers report by the Gaussians, float32 against float64.

    Args:
        of_each: fields of each family.
        names: of `MODELS`.
        families: ``random`` and names of `HARD`; None: all.
    """
    chosen = None if families is None else set(families)
    rows = []
    for name in names:
        worst, cases, model = GradientWorst(), 0, MODELS[name]

        def report(gaussians: Gaussians, at: Pose, model: Any = model) -> list[Any]:
            kind: Any = type(gaussians.position[0])
            plane = perception_plane(*SIZE, kind)
            return [model(None, learned_field(gaussians, at, plane, model.sphere))]

        for family, field, blending, seed in _fields(of_each, of_each):
            if chosen is not None and family not in chosen:
                continue
            # Scaling takes out nearly all that the parameters of a single Gaussian do; what is left is rounding.
            if len(field.signal) <= (name == "scaled spectrum"):
                continue
            single, double = (gradient(field, blending, SIZE, kind, seed, report) for kind in (mi.Float, DOUBLE))
            worst.add(single, double, felt_values(field, blending), family)
            cases += 1
        rows.append(worst.row(f"receiver: derivatives of {name}, {cases} cases", GRADIENT))
    return rows


def of_paths(count: int, each: int = 50) -> Row:
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
