"""Reports of receivers for random and ill-conditioned fields, float32 compared with NumPy in float64.

Pixels on the edge of a footprint are set to zero on both sides (`stress_fields.ON_THE_EDGE`). The error of a single sum
over directions (RSSI, CSI) is relative to the sum of magnitudes, as waves may cancel; that of element signals and
spectra is relative to their norm.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.backend.vectors import Pose
from wrf_mi.core import Paths, Receiver, unit_vectors
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers import antenna_csi, csi
from wrf_mi.receivers.device_paths import Ports, TracedPaths, path_sum
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver

from .stress_fields import HARD, SIZE, Family, cases, gradient_row, on_device, ordinary, pose, reference
from .stress_oracle import ReportOracle, report_error
from .stress_rows import DOUBLE, IMAGE, Row, Worst

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
"""Differentiable receiver models."""
ORACLE = ReportOracle(SIZE, ELEMENTS_M, CARRIER_HZ)
TITLES = {"pixels": "pixels", "spectrum": "Bartlett spectrum", "scaled spectrum": "Bartlett spectrum, scaled"}
FAMILIES: Mapping[str, Family] = {"random": ordinary, **HARD}


def of_fields(random: int, of_each: int, families: Iterable[str] = FAMILIES) -> list[Row]:
    """Reports of ``random`` random fields and ``of_each`` fields of each ill-conditioned family of `FAMILIES`."""
    worst: dict[str, Worst] = {}
    number = 0
    for family in families:
        for name, field, blending, _ in cases({family: FAMILIES[family]}, random if family == "random" else of_each):
            number += 1
            truth, clear = reference(field, blending, SIZE, sphere=True)
            field_on_sphere = (truth * clear).reshape(-1)
            gaussians = on_device(field, blending, mi.Float)[0]
            re, im = learned_field(gaussians, pose(mi.Float), perception_plane(*SIZE, mi.Float), sphere=True)
            mask = to_device(clear.reshape(-1).astype(np.float32), mi.Float)
            waves = np.array([(np.tile(solid_angles(*SIZE), 2) * np.abs(field_on_sphere)).sum() or 1.0])
            for what, model in MODELS.items():
                part = dr.arange(mi.UInt32, field_on_sphere.size // (1 if model.sphere else 2))
                report = model(None, tuple(dr.gather(mi.Float, side * mask, part) for side in (re, im)))
                none = np.zeros((1, len(TONES_HZ if model.sphere else ELEMENTS_M)), complex)
                expected = ORACLE.report(model, none, ORACLE.learned(model, field_on_sphere[None, : dr.width(part)]))
                error = report_error(model, report.numpy().astype(float), expected, waves)
                worst.setdefault(TITLES.get(what, what), Worst()).add(error, name)
    return [worst_of.row(f"receiver: {what}, {number} cases", IMAGE) for what, worst_of in worst.items()]


def derivatives(of_each: int, names: Iterable[str] = tuple(MODELS), families: Iterable[str] = FAMILIES) -> list[Row]:
    """Derivatives of the reports of `MODELS` by the Gaussians, for ``of_each`` fields of each family of `FAMILIES`."""
    rows = []
    for name in names:
        model = MODELS[name]

        def report(gaussians: Gaussians, at: Pose, model: Any = model) -> list[Any]:
            kind: Any = type(gaussians.position[0])
            plane = perception_plane(*SIZE, kind)
            return [model(None, learned_field(gaussians, at, plane, model.sphere))]

        # Instrument scaling cancels nearly all derivatives of a single Gaussian; rounding would remain.
        least = 2 if name == "scaled spectrum" else 1
        tried = cases({family: FAMILIES[family] for family in families}, of_each)
        rows.append(gradient_row(f"receiver: derivatives of {name}", tried, report, least=least))
    return rows


def of_paths(count: int, each: int = 50) -> list[Row]:
    """Row of element signals and CSI of paths of 1 m to 100 km at 28 GHz, Dr.Jit compared with NumPy in float64."""
    worst, carrier_hz = Worst(), 28e9
    array = Receiver("array", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
    elements, tones = planar_array(4, 4, 0.005), carrier_hz * np.linspace(0.98, 1.02, 16)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        length = 10 ** rng.uniform(0, 5, each)
        arrival = unit_vectors(rng.uniform(0, 2 * np.pi, each), rng.uniform(-1.5, 1.5, each))
        gain = 10 ** rng.uniform(-15, 15, each) * np.exp(2j * np.pi * rng.uniform(size=each))
        gains = DOUBLE(gain.real.copy()), DOUBLE(gain.imag.copy())
        directions = [DOUBLE(np.ascontiguousarray(column)) for column in arrival.T]
        traced = TracedPaths(gains, DOUBLE(length), directions, 1, each)
        first = np.zeros(each, np.int64)
        none: Any = (np.zeros((each, 0), np.uint8), np.zeros((each, 0, 3)), np.zeros((each, 0), np.int32), (), 1, 1)
        known = Paths(first, first, gain, length, -arrival, arrival, *none)
        for ports, truth in (
            (Ports(elements, np.full(16, carrier_hz)), antenna_csi(known, array, elements, carrier_hz)[..., 0]),
            (Ports(np.zeros((16, 3)), tones), csi(known, tones)),
        ):
            re, im = path_sum(traced, ports)
            off = np.abs(re.numpy() + 1j * im.numpy() - truth.ravel())
            worst.add(off.max() / np.abs(gain).sum())
    return [worst.row(f"receiver: elements and CSI of paths at 28 GHz, 1 m to 100 km, {2 * count} cases", IMAGE)]
