"""Reports of receivers for random and ill-conditioned fields, float32 compared with NumPy in float64.

Pixels on the edge of a footprint are set to zero on both sides (`stress_fields.ON_THE_EDGE`). The error of a single sum
over directions (RSSI, CSI) is relative to the sum of magnitudes, as waves may cancel; that of element signals and
spectra is relative to their norm.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from wrf_mi.backend.device import on_device as to_device
from wrf_mi.core import pixel_directions
from wrf_mi.core.angles import solid_angles
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.types import SQUARED_MAGNITUDE_EPS
from wrf_mi.gaussians.footprint import Pose
from wrf_mi.gaussians.parameters import Gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.combine import LEAST_POWER, ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from wrf_mi.graph.learned import hemisphere_pair, learned_field
from wrf_mi.graph.operator import ArrayOperator, SectorOperator, port_matrix
from wrf_mi.receivers import Array, Pattern, array_response, bartlett_spectrum, minmax_scale

from .stress_fields import (
    HARD,
    SIZE,
    ComplexArray,
    Family,
    Field,
    cases,
    gradient_row,
    on_device,
    ordinary,
    pose,
    reference,
)
from .stress_rows import IMAGE, Row, Worst, relative

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
TITLES = {"pixels": "pixels", "spectrum": "Bartlett spectrum", "scaled spectrum": "Bartlett spectrum, scaled"}
FAMILIES: Mapping[str, Family] = {"random": ordinary, **HARD}


@cache
def _array() -> Array:
    """Array with element gains, an element pattern and a mounting rotation."""
    rng = np.random.default_rng(0)
    gain = np.exp(rng.normal(0, 0.2, 16) + 1j * rng.uniform(-0.5, 0.5, 16))
    turn = np.array([0.02, -0.03, 0.05, 1.0])
    return Array(ELEMENTS_M, CARRIER_HZ, gain, Pattern(1.2), turn / np.linalg.norm(turn))


def of_fields(random: int, of_each: int, families: Iterable[str] = FAMILIES) -> list[Row]:
    """Reports of ``random`` random fields and ``of_each`` fields of each ill-conditioned family of `FAMILIES`."""
    worst: dict[str, Worst] = {}
    number = 0
    for family in families:
        for name, field, blending, _ in cases({family: FAMILIES[family]}, random if family == "random" else of_each):
            number += 1
            truth, clear = reference(field, blending, SIZE, sphere=True)
            seen = (truth * clear).reshape(-1)
            gaussians = on_device(field, blending, mi.Float)[0]
            errors = _by_model(gaussians, clear, seen) | _by_operator(gaussians, clear, seen, field)
            for what, error in errors.items():
                worst.setdefault(what, Worst()).add(error, name)
    return [one.row(f"receiver: {what}, {number} cases", IMAGE) for what, one in worst.items()]


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
    expected = {
        "pixels": np.sqrt(np.abs(seen[:half]) ** 2 + SQUARED_MAGNITUDE_EPS),
        "spectrum": spectrum.ravel(),
        "scaled spectrum": minmax_scale(spectrum).ravel(),
    }
    errors = {TITLES[name]: relative(found[name] - truth, truth) for name, truth in expected.items()}
    return errors | {
        "RSSI": abs(float(10 ** (found["RSSI"][0] / 20)) - amplitude) / max(waves, amplitude),
        "CSI": float(np.abs(found["CSI"] - channel).max()) / waves,
    }


def _by_operator(gaussians: Gaussians, clear: NDArray[np.bool_], seen: ComplexArray, field: Field) -> dict[str, float]:
    """Errors of the operators."""
    plane, half, array = perception_plane(*SIZE, mi.Float), seen.size // 2, _array()
    directions, weight = hemisphere_pair(*SIZE), np.tile(solid_angles(*SIZE), 2) * clear.reshape(-1)
    ports = array.response(directions[:half]).T * weight[:half]
    operator = ArrayOperator(port_matrix(gaussians, pose(mi.Float), plane, ports), array, *SIZE)
    h = ports @ seen[:half]
    spectrum = array.image(h, *SIZE)
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
        given = cases({family: FAMILIES[family] for family in families}, of_each)
        rows.append(gradient_row(f"receiver: derivatives of {name}", given, report, least=least))
    return rows
