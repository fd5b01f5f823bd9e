"""Channels over time and delay-Doppler spectra: closed forms, scenes and data sets in motion, refusals."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command, arrays_in, rows_of
from random_paths import paths_of
from scipy.constants import speed_of_light
from spectrum_records import assert_same, make_record
from traced_rooms import FREQUENCY_HZ, WAVELENGTH_M
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import Paths
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.datasets.record_file import write_record_file
from wrf_mi.receivers import Sampling, csi, csi_over_time, delay_doppler_spectrum
from wrf_mi.runs.api import train
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import TraceOptions, open_scene

SINGLE = 2e-5
"""Relative: points are in single precision."""
RX = "10,3,1"


@pytest.fixture
def mirror(tmp_path: Path) -> Path:
    """A scene folder with one large mirror, the plane y = 0."""
    mesh = sheet(1, 0.0, (-50.0, 50.0), (-50.0, 50.0))
    plane = Surface("mirror", "other", np.asarray(mesh.vertices), np.asarray(mesh.faces))
    return write_scene(tmp_path / "scene", [plane], frame="the test's", source="test")


def walk(file: Path, *columns: str, rows: int = 3) -> Path:
    """A track along x from (0, 2, 1) at 3 m/s, with some columns."""
    seconds = 0.1 * np.arange(rows) ** 2
    values = {"x": 3 * seconds, "y": 0 * seconds + 2, "z": 0 * seconds + 1, "t": seconds}
    values |= dict(zip(("vx", "vy", "vz"), ([speed] * rows for speed in (3, 0, 0)), strict=True))
    table = np.column_stack([values[name] for name in ("x", "y", "z", *columns)])
    np.savetxt(file, table, "%.17g", ",", header=",".join(["x", "y", "z", *columns]), comments="")
    return file


def words(scene: Path, form: str, out: Path, *tx: Any, rx: str = RX) -> list[Any]:
    where = [word for end in tx for word in ("--tx", end)]
    return [
        "export",
        scene,
        "--format",
        form,
        *where,
        "--rx",
        rx,
        "--frequency",
        FREQUENCY_HZ,
        "--depth",
        1,
        "--out",
        out,
    ]


def test_path_in_the_middle_of_a_bin_has_the_power_of_its_gain() -> None:
    def made(rates: Any) -> Paths:
        arrival, none = np.tile([1.0, 0, 0], (2, 1)), np.zeros(2, np.int64)
        paths = paths_of(none, none, np.array([0, 0.3 + 0.4j]), 5 * speed_of_light / 1e6 * np.ones(2), arrival, 1, 1)
        return replace(paths, length_rate_mps=np.array(rates, float))

    sampling = Sampling.of_paths(made([-9, 0]), FREQUENCY_HZ, 1e6)
    assert sampling.dopplers_hz.max() > 9 / WAVELENGTH_M
    rate = -sampling.dopplers_hz[40] * WAVELENGTH_M  # towards the receiver: a positive shift
    paths = made([-9, rate])
    channel = csi_over_time(paths, sampling)
    np.testing.assert_allclose(channel[:, :, 0], csi(paths, sampling.frequencies_hz), rtol=1e-6)
    power = delay_doppler_spectrum(channel)[0, 0]
    assert power.shape == (len(sampling.delays_s), len(sampling.dopplers_hz))
    assert np.unravel_index(power.argmax(), power.shape) == (5, 40)
    assert power[5, 40] == pytest.approx(0.25, rel=1e-4)
    assert sampling.delays_s[5] == pytest.approx(5e-6)


def test_scene_in_motion(mirror: Path, tmp_path: Path, command: Command) -> None:
    moving = tmp_path / "moving"
    command.done(["edit", mirror, "--velocity", "mir*:0,-1.5,2", "--out", moving])
    assert command.json(["edit", moving])["parts"][0]["velocity_mps"] == [0, -1.5, 2]
    assert "moving at [0.0, -1.5, 2.0] m/s" in command.done(["edit", moving])
    velocity = open_scene(moving, FREQUENCY_HZ).objects["mirror"].velocity
    np.testing.assert_allclose(np.ravel(velocity), [0, -1.5, 2])
    command.done(["edit", moving, "--velocity", "mirror:0,0,0", "--out", tmp_path / "stopped"])
    assert command.json(["edit", tmp_path / "stopped"])["parts"][0]["velocity_mps"] == [0, 0, 0]
    # The direct path has v / lambda times a cosine, the mirrored path also twice the mirror's part along its normal.
    file = tmp_path / "paths.csv"
    command.done(words(moving, "paths", file, "0,2,1,3,0,0", rx=f"{RX},0,0.5,0"))
    direct, mirrored = np.hypot(10, [1, 5])
    expected = [(3 * 10 - 0.5 * 1) / direct, (3 * 10 - 0.5 * 5 - 2 * 1.5 * 5) / mirrored]
    shifts = [float(row["doppler_hz"]) for row in rows_of(file)]
    np.testing.assert_allclose(shifts, np.array(expected) / WAVELENGTH_M, rtol=SINGLE)


def test_track_by_velocity_and_by_time(mirror: Path, tmp_path: Path, command: Command) -> None:
    facts = command.json(words(mirror, "doppler", tmp_path / "v.npz", walk(tmp_path / "v.csv", "vx", "vy", "vz")))
    assert facts["rows"] == 3
    assert Path(facts["picture"]) == tmp_path / "v.png"
    assert (tmp_path / "v.png").stat().st_size > 10_000
    command.done(words(mirror, "doppler", tmp_path / "t.npz", walk(tmp_path / "t.csv", "t")))
    arrays, by_time = arrays_in(tmp_path / "v.npz"), arrays_in(tmp_path / "t.npz")
    for name, values in arrays.items():
        if values.dtype.kind in "fc":
            np.testing.assert_allclose(by_time[name], values, rtol=1e-4, atol=1e-4 * np.abs(values).max(), err_msg=name)
    times, subcarriers = len(arrays["time_s"]), len(arrays["frequency_hz"])
    assert arrays["channel"].shape == (1, 3, times, subcarriers)
    assert arrays["delay_doppler"].shape == (1, 3, subcarriers, times)
    assert np.ptp(arrays["frequency_hz"]) == pytest.approx(100e6 * (1 - 1 / subcarriers))
    delay, shift = np.unravel_index(arrays["delay_doppler"][0, 0].argmax(), (subcarriers, times))
    direct_m = np.hypot(10, 1)
    assert abs(arrays["delay_s"][delay] - direct_m / speed_of_light) <= 1 / 100e6
    bin_hz = arrays["doppler_hz"][1] - arrays["doppler_hz"][0]
    assert abs(arrays["doppler_hz"][shift] - 3 * 10 / direct_m / WAVELENGTH_M) <= bin_hz


def test_data_sets_state_velocities(flat_folder: Path, room: Path, tmp_path: Path, command: Command) -> None:
    made = make_record()
    made = replace(made, runs=np.full(12, "a"), tx_velocity_mps=made.tx_pos_m + 0.1)
    folder = write_spectrum_folder(tmp_path / "made-up", made)
    assert_same(load(folder), made)
    np.savetxt(folder / "tx_pos.csv", np.arange(48.0).reshape(12, 4), "%.17g", ",", header="x,y,z,t", comments="")
    np.testing.assert_allclose(load(folder).tx_velocity_mps, 1.0)  # x, y, z and t grow alike
    # A traced run has the shifts of its rows.
    flat = replace(load(flat_folder), tx_velocity_mps=np.tile([0.5, -1.0, 0.0], (30, 1)))
    file = write_record_file(tmp_path / "flat.npz", flat)
    assert "velocities" in command.done(["data", "info", file])
    command.refused(["export", file, "--format", "ble", "--out", tmp_path / "ble"], "has tx_velocity_mps, which")
    run = train(file, "ray-tracing", out=tmp_path / "run", scene=room, settings=TraceOptions(depth=1)).folder
    out = tmp_path / "run.npz"
    facts = command.json(["export", run, "--format", "doppler", "--bandwidth", "20e6", "--out", out])
    assert (facts["rows"], facts["receivers"]) == (30, 2)
    assert arrays_in(out)["delay_s"][1] == pytest.approx(1 / 20e6)
    command.done(["export", run, "--format", "paths", "--out", tmp_path / "paths.csv"])
    row = next(row for row in rows_of(tmp_path / "paths.csv") if not row["interactions"])
    way = np.array([float(row[f"rx_{axis}"]) - float(row[f"tx_{axis}"]) for axis in "xyz"])
    expected = np.dot(flat.tx_velocity_mps[0], way / np.linalg.norm(way)) * float(row["frequency_hz"]) / speed_of_light
    assert float(row["doppler_hz"]) == pytest.approx(expected, rel=SINGLE)


def test_motion_that_is_none_is_refused(mirror: Path, tmp_path: Path, command: Command) -> None:
    out, track = tmp_path / "out.npz", tmp_path / "track.csv"
    command.refused(words(mirror, "doppler", out, "0,2,1"), "nothing moves; give vx,vy,vz or t")
    command.refused(words(mirror, "doppler", out, "0,2,1,3"), "give three numbers X,Y,Z in metres, six with a velocity")
    command.refused(words(mirror, "doppler", out, "0,2,1,3e8,0,0"), "transmitter 1: its velocity is")
    command.refused([*words(mirror, "doppler", out, "0,2,1,3,0,0"), "--bandwidth", "0"], "bandwidth 0 Hz: give")
    command.refused([*words(mirror, "paths", tmp_path / "p.csv", "0,2,1"), "--bandwidth", "1e6"], "does not belong")
    command.refused(words(mirror, "doppler", out, walk(track, "vx", "vy")), "has no column vz")
    command.refused(words(mirror, "doppler", out, walk(track, "t", rows=1)), "a single row with t states no velocity")
    track.write_text("x,y,z,t\n0,2,1,0\n1,2,1,0\n")
    command.refused(words(mirror, "doppler", out, track), "row 2: t is 0, not after the row before; order")
    command.refused(["edit", mirror, "--velocity", "mirror:1,2", "--out", out], "give names, a colon, and VX,VY,VZ")
    command.refused(["edit", mirror, "--velocity", "mirror:1,2,inf", "--out", out], "velocity of mirror is")
    with (mirror / "materials.yml").open("a") as file:
        file.write("velocities_mps: {mirror: [1, 2]}\n")
    command.refused(["edit", mirror], "velocities_mps: mirror is .1, 2.; give three numbers of m/s")
    assert not out.exists()
