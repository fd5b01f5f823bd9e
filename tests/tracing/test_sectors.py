"""Sectors of cells with azimuths, downtilts and carriers: traced power against Sionna RT's own solver."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from traced_rooms import SHOEBOX, write_xml

from wrf_mi.core import InputError, Record
from wrf_mi.datasets import read_ble_folder
from wrf_mi.models.checks import check_parts
from wrf_mi.models.model import Problem
from wrf_mi.models.ray_tracing import MODEL, TracingSettings
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, load_trace, open_scene, trace_paths
from wrf_mi.tracing.paths.result import recompute, save_trace
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.sionna.materials import CONSTANTS, at_frequency
from wrf_mi.tracing.tracer import RayTracer

POWER_DB = 0.01
"""Gains and lengths of Sionna RT are in single precision."""
SINGLE = 2e-6
"""Of the strongest path: constants of materials and gains in single precision."""
SECTORS = {"cell:A": (200, 8, 3.56e9), "cell B": (20, 0, 3.69e9), "c": (110, 15, 0.92e9)}
"""Azimuth and downtilt in degrees, carrier in Hz: the last below the range of ITU-R P.2040 for the room's materials."""
OPTIONS = TraceOptions(depth=2, transmission=False, rays=30_000)


@pytest.fixture(scope="module")
def xml(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xml(tmp_path_factory.mktemp("shoebox"), SHOEBOX)


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    folder = tmp_path_factory.mktemp("cells")
    receivers = ["id,x,y,z,azimuth_deg,downtilt_deg,frequency_hz,pattern"]
    receivers += [f"{name},3.{k},2.2,1.6,{a},{d},{hz},tr38901" for k, (name, (a, d, hz)) in enumerate(SECTORS.items())]
    places = np.random.default_rng(3).uniform([0.4, 0.4, 0.5], [5.0, 4.0, 2.2], (4, 3)).round(3)
    rows = [f"x,y,z,{','.join(f'rssi_{name}' for name in SECTORS)}", *(f"{x},{y},{z},-5,-6,-7" for x, y, z in places)]
    for name, lines in (("receivers", receivers), ("train", rows), ("test", rows)):
        (folder / f"{name}.csv").write_text("\n".join(lines) + "\n")
    return read_ble_folder(folder)


def sionna_power_db(xml: Path, tx_m: np.ndarray, record: Record, name: str) -> float:
    """Power of a link by Sionna RT alone: yaw and pitch of the device, carrier of the scene."""
    import mitsuba as mi
    from sionna import rt

    azimuth, downtilt, hz = SECTORS[name]
    scene = open_scene(xml, hz)
    scene.tx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="iso", polarization="V")
    scene.rx_array = rt.PlanarArray(num_rows=1, num_cols=1, pattern="tr38901", polarization="V")
    (place,) = [receiver.position_m for receiver in record.receivers if receiver.name == name]
    turn = mi.Point3f(*np.radians([azimuth, downtilt, 0]).tolist())
    scene.add(rt.Transmitter("tx", mi.Point3f(tx_m.tolist())))
    scene.add(rt.Receiver("rx", mi.Point3f(place.tolist()), orientation=turn))
    paths = rt.PathSolver(deterministic=True)(
        scene, max_depth=2, refraction=False, samples_per_src=30_000, max_num_paths_per_src=100_000, seed=1
    )
    real, imaginary = (part.numpy()[0, 0, 0, 0] for part in paths.a)
    return float(10 * np.log10((real**2 + imaginary**2)[paths.valid.numpy()[0, 0]].sum()))


def test_power_of_sectors_is_that_of_sionna_rt(xml: Path, record: Record):
    tracer = RayTracer(xml, instrument_of(record), OPTIONS)
    power_db = tracer(record.tx_pos_m[:4])
    expected = [[sionna_power_db(xml, tx, record, name) for tx in record.tx_pos_m[:4]] for name in SECTORS]
    np.testing.assert_allclose(power_db, expected, atol=POWER_DB)
    assert np.ptp(power_db, axis=0).min() > 1  # sectors differ


def test_receivers_of_one_trace_are_those_of_scenes_at_their_carriers(xml: Path, record: Record, tmp_path: Path):
    traced = trace_paths(open_scene(xml, 2e9), record.tx_pos_m, record.receivers, OPTIONS)
    stored = load_trace(save_trace(tmp_path / "paths.npz", traced))
    assert [receiver.frequency_hz for receiver in stored.receivers] == [hz for *_, hz in SECTORS.values()]
    for number, receiver in enumerate(record.receivers):
        alone = trace_paths(
            open_scene(xml, SECTORS[receiver.name][2]), record.tx_pos_m, replace(receiver, frequency_hz=None), OPTIONS
        )
        gain = stored.paths.gain[stored.paths.rx == number]
        np.testing.assert_allclose(gain, alone.paths.gain, rtol=0, atol=SINGLE * np.abs(gain).max())
    gain, again = stored.paths.gain, recompute(stored, open_scene(xml, 3e9)).paths.gain
    np.testing.assert_allclose(again, gain, rtol=0, atol=SINGLE * np.abs(gain).max())


def test_a_scene_is_left_as_it_was(xml: Path):
    scene = open_scene(xml, 0.92e9)

    def state(scene: Any) -> list[float]:
        materials = scene.radio_materials.values()
        return [float(scene.frequency[0]), *(float(getattr(m, name)[0]) for m in materials for name in CONSTANTS)]

    before = state(scene)
    with at_frequency(scene, 3.6e9):
        assert state(scene) == state(open_scene(xml, 3.6e9))
    assert state(scene) == before
    with pytest.raises(InputError, match="not known at"), at_frequency(scene, 0.1e9):
        pass
    assert state(scene) == before


def test_a_traced_field_has_the_carrier_of_its_receiver(xml: Path, record: Record):
    for receiver in record.receivers[:2]:
        options, tx = TracedOptions(OPTIONS), record.tx_pos_m[:4]
        shared = Prepared(open_scene(xml, 3.6e9))
        field = TracedField(shared.scene, tx, receiver, options, prepared=shared)
        assert field.frequency_hz == receiver.frequency_hz
        plain = replace(receiver, frequency_hz=None)
        alone = TracedField(open_scene(xml, SECTORS[receiver.name][2]), tx, plain, options)
        gains, expected = (np.stack([part.numpy() for part in each({}).gain]) for each in (field, alone))
        np.testing.assert_allclose(gains, expected, rtol=0, atol=SINGLE * np.abs(expected).max())


def test_carriers_of_receivers_are_checked(xml: Path, record: Record):
    first, *others = record.receivers
    for wrong, message in (
        (replace(record, receivers=(replace(first, frequency_hz=None), *others)), "some receivers have no positive"),
        (replace(record, carriers_hz=np.full(len(record), 1e9)), "state the carriers of receivers or of rows"),
    ):
        with pytest.raises(InputError, match=message):
            check_parts(wrong)
    low = replace(record, receivers=(replace(first, frequency_hz=0.1e9), *others))
    with pytest.raises(InputError, match=r"not known at 0\.1 GHz"):
        MODEL.check(Problem(low, TracingSettings(), 0, str(xml)), [])
