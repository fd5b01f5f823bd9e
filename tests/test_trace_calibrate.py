"""Calibration finds what made the measurements, and says what cannot be calibrated."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.special import sph_harm_y
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, inside, receiver, write_xml

from wrf_mi.core import InputError, Record
from wrf_mi.receive import rssi_dbm
from wrf_mi.trace import TraceOptions, TraceResult, open_scene, trace_paths
from wrf_mi.trace.calibrate import (
    OFFSETS_ALONE,
    CalibrationOptions,
    absolute_error_db,
    calibrate,
    choose_calibration,
)
from wrf_mi.trace.calibration import (
    Calibration,
    calibrated_rssi,
    harmonics,
    in_body,
    with_materials,
)

OPTIONS = TraceOptions(transmission=True, max_depth=3, max_reflections=1, rays=1 << 12)
OFFSET_DB = np.array([-31.0, -44.0])
TRUE_BRICK = (7.0, 0.2)
TRUE_PARTITION = (9.0, 1.0)
"""Relative permittivity and conductivity (S/m), far from those of plasterboard."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return open_scene(write_xml(tmp_path_factory.mktemp("room"), {**SHOEBOX, **PARTITION}), FREQUENCY_HZ)


@pytest.fixture(scope="module")
def traced(scene: Any) -> TraceResult:
    return trace_paths(scene, inside(120), [receiver(p, f"rx{k}") for k, p in enumerate(inside(2, 9))], OPTIONS)


def measured(traced: TraceResult, scene: Any, truth: Calibration, noise_db: float = 0.0) -> Record:
    heading = np.random.default_rng(3).uniform(-np.pi, np.pi, len(traced.tx_pos_m))
    strength = calibrated_rssi(truth, traced, scene, heading)
    strength += np.random.default_rng(4).normal(0, noise_db, strength.shape)
    strength[0, 5] = np.nan
    return Record(
        name="made",
        task="rssi",
        tx_pos_m=traced.tx_pos_m,
        receivers=traced.receivers,
        observation=strength.astype(np.float32),
        frequencies_hz=np.array([FREQUENCY_HZ]),
        tx_heading_rad=heading,
    )


def flat(**changes: Any) -> Calibration:
    plain = Calibration(OFFSET_DB, np.zeros(0), np.zeros((2, 0)), {})
    return replace(plain, **changes)


def test_offsets_alone(traced: TraceResult, scene: Any):
    record = measured(traced, scene, flat())
    found = calibrate(traced, scene, record, np.arange(60), OFFSETS_ALONE)
    np.testing.assert_allclose(found.offset_db, OFFSET_DB, atol=1e-4)  # of float32 measurements
    errors = absolute_error_db(found, traced, scene, record, np.arange(60, 120))
    assert errors.shape == (2, 60)
    assert np.nanmax(errors) < 1e-4
    np.testing.assert_allclose(
        calibrated_rssi(flat(), traced, scene), rssi_dbm(traced.paths) + OFFSET_DB[:, None], atol=1e-4
    )
    missing = absolute_error_db(found, traced, scene, record, np.array([5, 6]))
    assert np.isnan(missing).tolist() == [[True, False], [False, False]]


def test_patterns_are_found(traced: TraceResult, scene: Any):
    rng = np.random.default_rng(7)
    truth = flat(tx_pattern_db=rng.normal(0, 4, 8), rx_pattern_db=rng.normal(0, 4, (2, 3)))
    record = measured(traced, scene, truth)
    rows, held = np.arange(90), np.arange(90, 120)
    options = CalibrationOptions(materials=False, tx_degree=2, rx_degree=1, steps=400, batch=45, shrink=1e-5)
    before = calibrate(traced, scene, record, rows, OFFSETS_ALONE)
    after = calibrate(traced, scene, record, rows, options)
    errors = [np.nanmedian(absolute_error_db(c, traced, scene, record, held)) for c in (before, after)]
    assert errors[1] < 0.1 * errors[0]
    np.testing.assert_allclose(after.rx_pattern_db, truth.rx_pattern_db, atol=1.0)


def test_a_material_is_found_and_the_scene_keeps_its_own(traced: TraceResult, scene: Any):
    record = measured(traced, scene, flat(materials={"itu_brick": TRUE_BRICK, "itu_plasterboard": TRUE_PARTITION}))
    brick = scene.radio_materials["itu_brick"]
    callback, constant = brick.frequency_update_callback, float(np.ravel(brick.relative_permittivity)[0])
    options = CalibrationOptions(tx_degree=0, rx_degree=0, steps=60, learning_rate=0.05, batch=60)
    rows, held = np.arange(60), np.arange(60, 120)
    before = calibrate(traced, scene, record, rows, OFFSETS_ALONE)
    after = calibrate(traced, scene, record, rows, options)
    assert set(after.materials) == {"itu_concrete", "itu_brick", "itu_plasterboard"}
    errors = [np.nanmean(absolute_error_db(c, traced, scene, record, held)) for c in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    assert brick.frequency_update_callback is callback
    assert float(np.ravel(brick.relative_permittivity)[0]) == constant


def test_choice_is_made_on_held_out_places(traced: TraceResult, scene: Any):
    record = measured(traced, scene, flat(tx_pattern_db=np.array([6.0, 0, -5])), noise_db=0.5)
    right = CalibrationOptions(materials=False, tx_degree=1, rx_degree=0, steps=100)
    chosen, errors = choose_calibration(traced, scene, record, np.arange(100), [OFFSETS_ALONE, right], folds=2)
    assert chosen is right
    assert errors[1] < 0.5 * errors[0]


def test_harmonics_are_orthonormal_and_real():
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(200_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = harmonics(directions, 3)
    assert values.shape == (15, len(directions))
    product = 4 * np.pi * values @ values.T / len(directions)
    np.testing.assert_allclose(product, np.eye(15), atol=0.02)  # of a Monte Carlo mean
    theta, phi = np.arccos(directions[:5, 2]), np.arctan2(directions[:5, 1], directions[:5, 0])
    np.testing.assert_allclose(values[1, :5], sph_harm_y(1, 0, theta, phi).real, atol=1e-6)
    assert harmonics(directions, 0).shape == (0, len(directions))
    np.testing.assert_allclose(in_body(np.array([[0.0, 1, 0]]), np.array([np.pi / 2])), [[1, 0, 0]], atol=1e-12)


def test_what_cannot_be_calibrated(traced: TraceResult, scene: Any):
    record = measured(traced, scene, flat())
    rows = np.arange(50)
    with pytest.raises(InputError, match="needs signal strengths"):
        calibrate(traced, scene, replace(record, task="csi"), rows)
    short = replace(record, tx_pos_m=record.tx_pos_m[:60], observation=record.observation[:, :60])
    with pytest.raises(InputError, match="paths of 120 positions for 60 rows"):
        calibrate(traced, scene, short, rows)
    deaf = record.observation.copy()
    deaf[1] = np.nan
    with pytest.raises(InputError, match="rx1: no row to calibrate with"):
        calibrate(traced, scene, replace(record, observation=deaf), rows)
    with pytest.raises(InputError, match="no radio material 'itu_ice'"), with_materials(scene, {"itu_ice": (3, 0)}):
        pass
    with pytest.raises(InputError, match="1 receivers calibrated, 2 traced"):
        calibrated_rssi(Calibration(np.zeros(1), np.zeros(0), np.zeros((1, 0)), {}), traced, scene)
