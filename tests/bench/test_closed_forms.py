"""Closed forms of propagation, and traced channels that agree with them."""

import numpy as np
import pytest
from wrf_mi_bench import closed_forms
from wrf_mi_bench.closed_forms import FIELD, SIONNA, TRACED
from wrf_mi_bench.wave_formulas import half_plane, knife_edge, wedge

ASYMPTOTIC = 1e-4  # of the incident field: the diffracted one is exact to 1 / (k s), with s of 160 wavelengths
HZ = 140e9  # carrier at which single precision counts most
CASES = (
    *(closed_forms.free_space_errors, closed_forms.two_ray_errors, closed_forms.wall_errors),
    *(closed_forms.half_plane_errors, closed_forms.wedge_errors, closed_forms.scattering_errors),
)


@pytest.mark.parametrize("case", CASES)
def test_traced_channels_are_those_of_closed_forms(case, monkeypatch):
    """Attenuation in slabs of low loss among them, of which Sionna RT's square root leaves little."""
    monkeypatch.setattr(closed_forms, "CARRIERS_HZ", (HZ,))
    names = set()
    for name, _, hz, bound, errors in case():
        names.add(name)
        assert hz == HZ
        assert {TRACED, SIONNA} <= set(errors)
        for way in {TRACED, FIELD} & set(errors):
            assert errors[way].max() < bound, (name, way)
    assert names


def test_wedge_completes_geometrical_optics_to_the_exact_half_plane():
    """On both sides of the boundaries of shadow and reflection."""
    k, near, far, incidence, angle = 50.0, 20.0, 10.0, np.radians(60), np.radians(np.arange(2.3, 358, 1.7))

    def optics(psi):
        distance = np.sqrt(near**2 + far**2 - 2 * near * far * np.cos(psi))
        return np.where(psi < np.pi, np.exp(-1j * k * distance) / distance, 0)

    ends = near, far, incidence, angle
    direct, reflected = optics(angle - incidence), optics(angle + incidence)
    for sign, diffracted, exact in zip((-1, 1), wedge(2, k, *ends), half_plane(k, *ends), strict=True):
        error = direct + sign * reflected + diffracted - exact
        np.testing.assert_allclose(error * (near + far), 0, atol=ASYMPTOTIC)
    faces = half_plane(k, near, far, incidence, np.array([0.0, 2 * np.pi]))[0]
    np.testing.assert_allclose(faces, 0, atol=1e-12)  # no field along a conductor
    assert knife_edge(np.zeros(1), near, far, HZ) == pytest.approx(0.5)


def test_errors_beyond_a_bound_fail_the_benchmark(monkeypatch, tmp_path):
    monkeypatch.setattr(closed_forms, "PICTURE", tmp_path / "no-checkout" / "picture.png")
    errors = {TRACED: np.array([1e-7, 3e-7, 2e-4]), SIONNA: np.array([0.0, 0, 0])}
    cases = [("a", "", 1e9, 1e-3, errors), ("a", "", 2e9, 1e-3, errors), ("b", " dB", 1e9, np.inf, errors)]
    monkeypatch.setattr(closed_forms, "CASES", (lambda: iter(cases),))
    result = closed_forms.main()
    assert "failed" not in result
    assert result["rows"][0]["by_carrier"] == {hz: {TRACED: 2e-4, SIONNA: 0.0} for hz in ("1 GHz", "2 GHz")}
    lines = closed_forms.table(result["rows"]).splitlines()
    assert lines[2:] == ["| a | 2.0e-04 (3.0e-07) | 0 (0) | 0.001 |", "| b | 2.0e-04 dB (3.0e-07) | 0 dB (0) | - |"]
    monkeypatch.setattr(closed_forms, "CASES", (lambda: iter([("c", "", 1e9, 1e-4, errors)]),))
    assert closed_forms.main()["failed"] == "beyond its bound: c"
