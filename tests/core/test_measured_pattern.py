"""Measured antenna patterns from files against closed forms, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal

from wrf_mi import backend
from wrf_mi.core import Antenna, AntennaOptions, Receiver, receiver_arrays, stored_receivers
from wrf_mi.core.angles import FloatArray
from wrf_mi.core.measured_pattern import MOST_EFFICIENCY, MeasuredPattern

INTERPOLATED = 5e-4
"""Share of the peak amplitude, 20 degrees from poles, where the beam depends on the azimuth: samples of 5 degrees."""
NEAR_POLE = 0.02
"""Share of the peak amplitude: a dipole's amplitude has a kink at the poles, which a smooth function rounds."""
POWER = 2e-3  # of the mean gain, by sums over steps of 5 degrees
SLOPE = 1e-6  # of derivatives, by central differences in float64

Gain = Callable[[Any, Any], Any]  # gain in dBi at zenith angle and azimuth, degrees
PEAK_DBI, ELEVATION = 8.0, -10.0


def beam(theta: Any, phi: Any) -> Any:
    """Beam that points 10 degrees down and falls slower to the right; attenuations of azimuth and elevation add up."""
    turn, tilt = np.radians(phi), np.radians(90 - np.asarray(theta, float) - ELEVATION)
    return PEAK_DBI - 15 * (1 - np.cos(turn)) * (1 + 0.5 * np.sin(turn)) - 30 * (1 - np.cos(tilt))


def half_wave(theta: Any, phi: Any) -> Any:
    zenith = np.clip(np.radians(np.asarray(theta, float)), 1e-3, np.pi - 1e-3) + np.zeros(np.shape(phi))
    return 10 * np.log10(1.643 * (np.cos(np.pi / 2 * np.cos(zenith)) / np.sin(zenith)) ** 2)


def sphere(path: Path, gain: Gain, step: float = 5, phase: Gain | None = None) -> Path:
    """A file of a sphere; rows are in no order, and azimuths from -180 to 180."""
    theta, phi = (np.ravel(a) for a in np.meshgrid(np.arange(0, 180.1, step), np.arange(-180, 180, step)))
    columns = [theta, phi, gain(theta, phi), *([] if phase is None else [phase(theta, phi)])]
    rows = np.random.default_rng(0).permutation(np.stack(columns, axis=-1))
    header = "theta,phi,gain_db" + ",phase" * (phase is not None)
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6f")
    return path


def cuts(path: Path, gain: Gain, step: float = 5) -> Path:
    theta, phi = np.arange(0, 180.1, step), np.arange(0, 360, step)
    rows = [(90, p) for p in phi] + [(t, p) for t in theta for p in (180, 0) if t != 90]
    np.savetxt(
        path,
        [(t, p, float(gain(t, p))) for t, p in rows],
        delimiter=",",
        header="theta,phi,gain_db",
        comments="",
        fmt="%.6f",
    )
    return path


def planet(path: Path, gain: Gain, gain_line: str = f"GAIN {PEAK_DBI:g} dBi") -> Path:
    """MSI Planet: clockwise from the boresight, and from the boresight downwards over the back."""
    angles = np.arange(360)
    vertical = [
        float(gain(a + 90 if a <= 90 else a - 270 if a >= 270 else 270 - a, 180 * (90 < a < 270))) for a in angles
    ]
    lines = ["NAME beam", "FREQUENCY 890", gain_line]
    for name, values in (("HORIZONTAL", [float(gain(90, -a)) for a in angles]), ("VERTICAL", vertical)):
        lines += [f"{name} 360", *(f"{a} {PEAK_DBI - value:.6f}" for a, value in zip(angles, values, strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


def directions(count: int = 400) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Zenith angles and azimuths in degrees, the poles among them, and unit vectors [count, 3]."""
    rng = np.random.default_rng(1)
    theta, phi = np.degrees(np.arccos(rng.uniform(-1, 1, count))), rng.uniform(-180, 180, count)
    theta[:2] = 0, 180
    t, p = np.radians(theta), np.radians(phi)
    return theta, phi, np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def close(antenna: Antenna, gain: Gain, tolerance: float, away: float = 0) -> None:
    """Amplitudes of directions ``away`` from the poles, degrees, within a tolerance of the peak."""
    theta, phi, unit = directions()
    expected = 10 ** (gain(theta, phi) / 20)
    error = np.abs(np.linalg.norm(antenna.field(unit), axis=-1) - expected) / expected.max()
    assert error[np.abs(theta - 90) <= 90 - away].max() < tolerance


def test_sphere_is_interpolated(tmp_path: Path) -> None:
    close(Antenna(str(sphere(tmp_path / "beam.csv", beam))), beam, INTERPOLATED, away=20)
    dipole = Antenna(str(sphere(tmp_path / "dipole.CSV", half_wave)))
    close(dipole, half_wave, NEAR_POLE)
    assert dipole.measured is not None
    assert dipole.measured.efficiency == pytest.approx(1, abs=POWER)


@pytest.mark.parametrize("write", [cuts, planet])
def test_attenuations_of_two_cuts_add_up(write: Callable[[Path, Gain], Path], tmp_path: Path) -> None:
    """Down remains down and left remains left."""
    path = tmp_path / ("cuts.msi" if write is planet else "cuts.csv")
    antenna = Antenna(str(write(path, beam)))
    close(antenna, beam, INTERPOLATED, away=20)
    assert antenna.measured is not None
    assert antenna.measured.peak_deg == (0, ELEVATION)
    assert antenna.measured.frequency_hz == (890e6 if write is planet else None)


def test_gains_of_planet_files_are_over_a_dipole_by_default(tmp_path: Path) -> None:
    antennas = [
        Antenna(str(planet(tmp_path / "a.pln", beam, line))) for line in ("GAIN 5", "GAIN 5.0 dBd", "GAIN 7.15 dBi")
    ]
    assert {round(a.measured.peak_dbi, 6) for a in antennas if a.measured} == {7.15}


def test_derivatives_and_phases_with_drjit(tmp_path: Path) -> None:
    """Field and derivatives of a pattern with phase are those of NumPy."""
    backend.init()
    import drjit as dr

    from wrf_mi.backend.vectors import Float64
    from wrf_mi.tracing.paths.field_calculator import pattern_tables

    path = sphere(tmp_path / "phase.csv", beam, 10, phase=lambda t, p: 40 * np.cos(np.radians(t)) + 0 * p)
    antenna = Antenna(str(path), "H", "array")
    unit = directions(50)[2][2:]  # at a pole the azimuth has no derivative
    field = antenna.field(unit)
    assert np.iscomplexobj(field)
    angle = np.degrees(np.angle(field[:, :2].sum(axis=-1) / field[:, :2].sum(axis=-1).real))
    np.testing.assert_allclose(angle, 40 * unit[:, 2], atol=0.5)  # degrees, from samples of 10 degrees
    x, y, z = (Float64(column) for column in unit.T)
    dr.enable_grad(x, y, z)
    real, imaginary = antenna.components(dr, x, y, z, pattern_tables(antenna, Float64))
    np.testing.assert_allclose(np.stack([part.numpy() for part in real], axis=-1), field.real, atol=1e-12)
    dr.backward(dr.sum(real[0]) + 2 * dr.sum(imaginary[1]))
    for axis, variable in enumerate((x, y, z)):
        step = 1e-6 * np.eye(3)[axis]
        up, down = antenna.field(unit + step), antenna.field(unit - step)
        slope = ((up - down).real[:, 0] + 2 * (up - down).imag[:, 1]) / 2e-6
        np.testing.assert_allclose(variable.grad.numpy(), slope, atol=SLOPE * np.abs(slope).max())


def test_power(tmp_path: Path) -> None:
    even = np.zeros((19, 36))
    assert MeasuredPattern.of_gains(even - 3).efficiency == pytest.approx(10**-0.3, rel=1e-12)
    assert MeasuredPattern.of_gains(even + 0.4).efficiency < MOST_EFFICIENCY
    refusal(MeasuredPattern.of_gains, even + 0.6, "add up to 0.60 dB more power")
    path = sphere(tmp_path / "strong.csv", lambda t, p: half_wave(t, p) + 3)
    refusal(Antenna, str(path), r"strong\.csv: gains add up to 3\.0\d dB more power than is accepted .* exceeds 4 pi")


def test_gains_relative_to_the_maximum_are_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    narrow = sphere(tmp_path / "narrow.csv", lambda t, p: np.maximum(8 * (beam(t, p) - PEAK_DBI), -40))
    assert Antenna(str(narrow)) == Antenna(str(narrow))
    assert caplog.text.count("gains relative to the maximum? give them in dBi") == 1


def test_file_is_part_of_the_antenna(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Antennas of other content differ, a changed file is refused, and options name it from anywhere."""
    path = planet(tmp_path / "beam.msi", beam)
    antenna = Antenna(str(path), frame="array")
    receiver = Receiver("a", np.zeros(3), np.array([0, 0, 0, 1.0]), antenna)
    arrays = receiver_arrays([receiver, replace(receiver, antenna=Antenna())])
    assert [each.antenna for each in stored_receivers(arrays)] == [antenna, Antenna()]
    monkeypatch.chdir(tmp_path)
    options = AntennaOptions(rx_pattern="beam.msi", tx_pattern="iso")
    assert options.rx_pattern == str(path)
    other = options.replaced(antenna, "rx")
    assert other == antenna
    assert options.replaced(antenna, "tx") == Antenna(frame="array")
    planet(path, half_wave)
    refusal(stored_receivers, arrays, "beam.msi: changed since")
    assert options.replaced(antenna, "rx") != antenna


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        (
            "sphere.csv",
            "theta,phi",
            "phi,theta",
            "line 1: header is .*; give theta,phi,gain_db and, if measured, phase",
        ),
        ("sphere.csv", "gain_db\n", "gain_db\n1,2\n", "row 1: not 3 finite numbers"),
        ("sphere.csv", "gain_db\n", "gain_db\n0,0,nan\n", "row 1: not 3 finite numbers"),
        ("sphere.csv", "gain_db\n", "gain_db\n-90,0,1\n", "row 1: theta is -90; give zenith angles of 0 to 180"),
        ("sphere.csv", "gain_db\n", "gain_db\n90,360,1\n", "another gain than an earlier row of this direction"),
        ("sphere.csv", "gain_db\n", "gain_db\n41,0,1\n", "no sphere and no two cuts; give equal steps"),
        ("sphere.csv", "gain_db\n", "gain_db\n90,1,1\n90,181,1\n", "azimuths are not in equal steps"),
        ("cuts.csv", "\n30.000000,0.000000", "\n30.000000,180.000000", "another gain than an earlier row"),
        ("cuts.csv", "\n30.000000,0.000000", "\n30.000000,90.000000", "no gain at theta 30, phi 0; give a sphere, or"),
        ("cuts.csv", "\n30.000000,180.000000", "\n30.000000,90.000000", "no gain at theta 5, phi 5; give a sphere, or"),
        ("beam.msi", "GAIN", "PAIN", "no antenna pattern of MSI Planet; give GAIN in dBd or dBi"),
        ("beam.msi", "VERTICAL 360", "VERTICAL", "line 365: 'VERTICAL' has no number of angles; give 360"),
        ("beam.msi", "8 dBi", "80000 dBi", "beam.msi: gains beyond 300 dB; give gains in dBi"),
        ("beam.msi", "VERTICAL 360", "VERTICAL 362", "line 365: 362 angles; give 360"),
        ("beam.msi", "\n8 ", "\n8 -", "line 13: '8 -.*' is no angle and attenuation"),
        ("beam.msi", "\n8 ", "\n9 ", "line 4: no attenuation at 8 degrees in these 360"),
    ],
)
def test_wrong_files_are_refused(name: str, old: str, new: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    writers: dict[str, Callable[..., object]] = {"sphere.csv": sphere, "cuts.csv": cuts, "beam.msi": planet}
    writers[name](path, beam)
    path.write_text(path.read_text().replace(old, new, 1))
    refusal(Antenna, str(path), message)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    refusal(Antenna, str(tmp_path / "none.msi"), "none.msi: no such file or folder")
    refusal(Antenna, "horn.txt", r"or a file \*\.csv, \*\.msi, \*\.pln")
