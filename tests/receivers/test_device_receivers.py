"""Dr.Jit twins of receiver models against NumPy in float64, and their derivatives against central differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.constants import speed_of_light

from wrf_mi.backend.device import to_float
from wrf_mi.core.arrays import planar_array
from wrf_mi.receivers import Lags, Pattern
from wrf_mi.receivers.device import LagMatrix, with_gains
from wrf_mi.receivers.device import gaussian_signals as device_signals
from wrf_mi.receivers.footprints import gaussian_signals

pytestmark = pytest.mark.all_threads

Float64 = dr.float64_array_t(mi.Float)
Tensor64 = dr.tensor_t(Float64)
FREQUENCY_HZ = 920e6
WAVENUMBER = 2 * np.pi * FREQUENCY_HZ / speed_of_light
EXACT = 1e-12
"""Relative, sums of a few hundred terms in float64."""
SLOPE = 1e-6
"""Relative, central differences in float64 with a step of 1e-6."""


def check_slopes(loss: Callable[[dict[str, Any]], Any], values: dict[str, np.ndarray]) -> None:
    parameters = {name: Float64(value.ravel()) for name, value in values.items()}
    for p in parameters.values():
        dr.enable_grad(p)
    dr.backward(loss(parameters))
    rng = np.random.default_rng(9)
    for name, value in values.items():
        way = rng.normal(size=value.size)
        ends = []
        for sign in (1, -1):
            moved = {n: Float64(v.ravel() + (sign * 1e-6 * way if n == name else 0)) for n, v in values.items()}
            ends.append(float(loss(moved)[0]))
        numeric = (ends[0] - ends[1]) / 2e-6
        assert float(dr.grad(parameters[name]).numpy() @ way) == pytest.approx(numeric, rel=SLOPE), name


@pytest.mark.gradcheck
def test_signals_of_footprints():
    rng = np.random.default_rng(1)
    batch, count, elements = 2, 7, planar_array(2, 3, 0.16) + np.array([0.01, 0.02, 0.03])
    n = rng.normal(size=(batch * count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    axes = 0.2 * rng.normal(size=(batch * count, 3, 3))
    re, im = rng.normal(size=(2, batch * count))
    expected = gaussian_signals(n, np.einsum("nki,nkj->nij", axes, axes), elements, FREQUENCY_HZ)
    expected = ((re + 1j * im)[:, None] * expected).reshape(batch, count, -1).sum(axis=1)
    values = {"re": re, "im": im, "n": n.T.copy(), "axes": axes.transpose(1, 2, 0).copy(), "p": elements.T.copy()}
    values["k"] = np.array([WAVENUMBER])
    weight = rng.normal(size=(2, batch * len(elements)))

    def signals(v: dict[str, Any]) -> tuple[Any, Any]:
        def part(name: str, i: int, size: int) -> Any:
            return dr.gather(Float64, v[name], i * size + dr.arange(mi.UInt32, size))

        size = batch * count
        direction = [part("n", i, size) for i in range(3)]
        three = [[part("axes", 3 * k + i, size) for i in range(3)] for k in range(3)]
        places = [part("p", i, len(elements)) for i in range(3)]
        return device_signals((v["re"], v["im"]), direction, three, places, v["k"], batch)

    found = signals({name: Float64(value.ravel()) for name, value in values.items()})
    np.testing.assert_allclose(found[0].numpy() + 1j * found[1].numpy(), expected.ravel(), rtol=1e-10)
    check_slopes(lambda v: sum(dr.sum(s * Float64(w)) for s, w in zip(signals(v), weight, strict=True)), values)


@pytest.mark.gradcheck
def test_gains_of_elements():
    rng = np.random.default_rng(4)
    h, gain = (rng.normal(size=(2, n)) for n in (15, 5))
    values = {"h": h, "gain": gain}
    weight = Float64(rng.normal(size=15))

    def halves(flat: Any) -> tuple[Any, Any]:
        size = dr.width(flat) // 2
        return tuple(dr.gather(Float64, flat, dr.arange(mi.UInt32, size) + size * i) for i in (0, 1))

    re, im = with_gains(halves(Float64(h.ravel())), halves(Float64(gain.ravel())))
    expected = (h[0] + 1j * h[1]).reshape(3, 5) * (gain[0] + 1j * gain[1])
    np.testing.assert_allclose(re.numpy() + 1j * im.numpy(), expected.ravel(), rtol=1e-10)
    check_slopes(lambda v: dr.sum(sum(with_gains(halves(v["h"]), halves(v["gain"]))) * weight), values)


@pytest.mark.gradcheck
def test_lags_and_squared_spectra():
    rng = np.random.default_rng(2)
    lags = Lags(planar_array(2, 3, 0.15), FREQUENCY_HZ, 6, 20)
    matrix = LagMatrix(lags)
    h = rng.normal(size=(3, 6)) + 1j * rng.normal(size=(3, 6))
    values = {"re": h.real.copy(), "im": h.imag.copy()}
    weight = Float64(rng.normal(size=3 * 120))
    found = matrix.of_signals((Float64(h.real.ravel()), Float64(h.imag.ravel())))
    np.testing.assert_allclose(found.numpy().reshape(3, -1), lags.of_signals(h), rtol=1e-10, atol=EXACT)
    squared = matrix.squared(found).numpy().reshape(3, 6, 20)
    np.testing.assert_allclose(squared, lags.squared(lags.of_signals(h)), rtol=1e-9, atol=1e-11)
    check_slopes(lambda v: dr.sum(matrix.squared(matrix.of_signals((v["re"], v["im"]))) * weight), values)
    single = matrix.of_signals((to_float(h.real), to_float(h.imag)))
    np.testing.assert_allclose(single.numpy(), found.numpy(), rtol=1e-5, atol=1e-5)  # float32


def test_patterns_are_those_that_are_trained():
    """The same coefficients give the same factor here and in `wrf_mi.tracing.pattern_parameters`."""
    from wrf_mi.tracing.pattern_parameters import pattern_factor

    rng = np.random.default_rng(3)
    n = rng.normal(size=(50, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    for degree in (1, 4, 8):
        coefficients = rng.normal(size=(2, (degree + 1) ** 2 - 1)) / degree
        re, im = pattern_factor(Tensor64(coefficients), [Float64(c) for c in n.T.copy()])
        np.testing.assert_allclose(Pattern(coefficients=coefficients)(n), re.numpy() + 1j * im.numpy(), rtol=1e-5)
