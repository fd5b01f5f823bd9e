"""Rows of several carriers: refused by models of one, blended by carrier, traced at the carrier of each row."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call
from changed_folders import refusal
from made_channels import channels
from scipy.constants import speed_of_light

from wrf_mi.core import Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.carriers import by_carrier
from wrf_mi.datasets import load, write_ble_folder, write_nerf2_csi
from wrf_mi.models import MODELS
from wrf_mi.runs.api import open_run, plan_run, train
from wrf_mi.runs.folder import RunRequest
from wrf_mi.runs.references import reference_arrays
from wrf_mi.runs.results import read_run, reference_key
from wrf_mi.tasks import CARRIER, instrument_of
from wrf_mi.tracing import TraceOptions, load_trace
from wrf_mi.tracing.paths.result import join_traces, recompute
from wrf_mi.tracing.tracer import RayTracer, cross_polarized

LOW, HIGH = 1.1e9, 5.1e9
FLOAT32_DB = 1e-4
"""Predictions are stored as float32; gains come from float32 amplitudes."""
GREY = 2e-4
"""Of spectra in 0..1 from float32 gains, in which weak paths nearly cancel."""


def test_rows_keep_their_order_by_carrier() -> None:
    carriers = np.array([3.0, 1.0, 3.0, 2.0, 1.0])
    merged = by_carrier(carriers, lambda hz, rows: np.stack([rows, np.full(len(rows), hz)]), axis=1)
    np.testing.assert_array_equal(merged, [np.arange(5), carriers])


@pytest.fixture(scope="module")
def flat(flat_folder: Path) -> Record:
    """Signal strengths at two carriers in turn."""
    record = load(flat_folder)
    return record.at_carriers(np.where(np.arange(len(record)) % 3 > 0, HIGH, LOW))


SETTINGS = {
    "kriging": ["length_m=1", "noise=0.1", "heading_length=1"],
    "trees": ["trees=5"],
    "idw": ["neighbours=4"],
    "mri": [],
}


def of(record: Record, carrier_hz: float) -> tuple[Record, Split]:
    """The rows of one carrier alone, with their official split."""
    rows = np.flatnonzero(record.carriers_hz == carrier_hz)
    train_rows, test = (np.flatnonzero(np.isin(rows, part)) for part in record.official)
    heading, observation = record.tx_heading_rad[rows], record.observation[:, rows]
    carrier_record = replace(
        record.at_carrier(carrier_hz), tx_pos_m=record.tx_pos_m[rows], tx_heading_rad=heading, official=None
    )
    return replace(carrier_record, observation=observation), Split("own", 0, train_rows, train_rows[:0], test)


@pytest.mark.parametrize("name", [name for name in MODELS if not MODELS[name].several_carriers])
def test_models_of_one_carrier_refuse_several(name: str, flat: Record, one_gateway: Record, tmp_path: Path) -> None:
    several = one_gateway.at_carriers(np.arange(float(len(one_gateway))) % 2 + 1.0)
    for record in (flat, several):
        model = MODELS[name]
        if model.serves(record.task.name) and model.uplink != "required":
            message = rf"rows at 2 carriers, .* Hz; {re.escape(name)} serves one carrier"
            refusal(train, record, name, message, out=tmp_path / "run", seed=1)
            assert not (tmp_path / "run").exists()


def test_inconsistent_carriers_are_refused(flat: Record) -> None:
    message = r"choose another model \(wrf-gs, wrf-gs\+, factorised, hybrid, idw, kriging, tre"
    refusal(plan_run, flat, RunRequest("nerf2"), message)
    for changed, message in (
        (replace(flat, carriers_hz=np.ones(3)), r"carriers_hz \[3\]; give 30 positive"),
        (replace(flat, carriers_hz=np.zeros(len(flat))), r"carriers_hz \[30\]; give 30 positive"),
        (replace(flat, frequencies_hz=np.ones(1)), "set one of the two to None"),
    ):
        refusal(plan_run, changed, RunRequest("idw"), message)
    record = replace(channels(), frequencies_hz=None, carriers_hz=np.ones(30))
    refusal(plan_run, record, RunRequest("linear"), "carriers_hz belongs to spectra and signal strengths")


@pytest.mark.parametrize("name", SETTINGS)
def test_carriers_are_interpolated_separately(name: str, flat: Record, tmp_path: Path) -> None:
    run = train(flat, name, out=tmp_path / "run", settings=SETTINGS[name])
    read = read_run(run.folder)
    carriers = flat.carriers_hz[read.row]
    for carrier in (LOW, HIGH):
        record, split = of(flat, carrier)
        alone = read_run(train(record, name, out=tmp_path / f"{carrier}", split=split, settings=SETTINGS[name]).folder)
        np.testing.assert_array_equal(read.prediction[:, carriers == carrier], alone.prediction)
    again = open_run(run.folder, flat)
    heading = flat.tx_heading_rad[read.row] if name in ("kriging", "trees") else None
    predicted = again.predict(flat.tx_pos_m[read.row], 1, heading, carriers_hz=carriers).mean
    np.testing.assert_array_equal(predicted.astype(np.float32), read.prediction[1])


def test_predictions_of_several_carriers(flat: Record, flat_folder: Path, tmp_path: Path) -> None:
    run, place = train(flat, "idw", out=tmp_path / "run"), flat.tx_pos_m[:2]
    refusal(run.predict, place, r"its data have rows at 2 carriers, .* Hz; give frequency_hz for each position")
    message = r"2 positions and carriers \(1,\); give one positive frequency_hz for each"
    refusal(run.predict, place, message, carriers_hz=LOW)
    # Between carriers the prediction is linear in the logarithm of the frequency, beyond them constant.
    low, high = (run.predict(place, carriers_hz=[carrier] * 2).mean for carrier in (LOW, HIGH))
    between = run.predict(place, carriers_hz=[np.sqrt(LOW * HIGH)] * 2).mean
    np.testing.assert_allclose(between, (low + high) / 2, rtol=1e-6)
    beyond = run.predict(place, carriers_hz=[0.1 * LOW, 10 * HIGH]).mean
    np.testing.assert_array_equal(beyond, np.stack([low[:, 0], high[:, 1]], axis=1))
    single_carrier = train(flat_folder, "idw", out=tmp_path / "one")
    refusal(single_carrier.predict, place, "its data have one carrier; omit frequency_hz", carriers_hz=[LOW, LOW])


@pytest.mark.parametrize("name", SETTINGS)
def test_a_carrier_is_predicted_from_the_others(name: str, flat: Record, tmp_path: Path) -> None:
    """Free-space loss grows by 20 dB a decade: half way between two carriers lies the mean of both."""
    n, middle = len(flat), float(np.sqrt(LOW * HIGH))
    carriers = np.repeat([LOW, middle, HIGH], n)
    loss = 20 * np.log10(carriers / LOW)
    heading = np.tile(flat.tx_heading_rad, 3)
    three = replace(
        flat.at_carriers(carriers),
        tx_pos_m=np.tile(flat.tx_pos_m, (3, 1)),
        tx_heading_rad=heading,
        observation=(np.tile(flat.observation, 3) - loss).astype(np.float32),
        official=None,
    )
    results = read_run(
        train(three, name, out=tmp_path / "run", split="frequency-known:1", settings=SETTINGS[name]).folder
    )
    assert (carriers[results.row] == middle).all()
    step = results.references["idw"] - results.references[CARRIER]
    np.testing.assert_allclose(step, -20 * np.log10(middle / LOW), atol=FLOAT32_DB)  # the lower of two as near
    lowest = Split("lowest", 0, np.arange(n), np.zeros(0, np.int64), np.arange(2 * n, 3 * n))
    low = train(three, name, out=tmp_path / "low", split=lowest, settings=SETTINGS[name])
    turned = heading[results.row] if name in ("kriging", "trees") else None
    for receiver in range(len(flat.receivers)):
        low_dbm = low.predict(
            three.tx_pos_m[results.row], receiver, turned, carriers_hz=np.full(len(results.row), LOW)
        ).mean
        expected = low_dbm - 20 * np.log10(middle / LOW)
        np.testing.assert_allclose(results.prediction[receiver], expected, atol=FLOAT32_DB)


def test_predictions_take_and_state_carriers(flat: Record, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_ble_folder(tmp_path / "flat", flat)
    run = train(folder, "idw", out=tmp_path / "run")
    table = np.column_stack([flat.tx_pos_m[:4], [LOW, HIGH, HIGH, LOW]])
    np.savetxt(tmp_path / "tx.csv", table, "%.17g", ",", header="x,y,z,frequency_hz", comments="")
    np.savez(tmp_path / "tx.npz", tx_pos=table[:, :3], frequency_hz=table[:, 3])
    expected = [run.predict(table[:, :3], r, carriers_hz=table[:, 3]).mean for r in (0, 1)]
    for option, input_name, out in (("--tx", "tx.csv", "out.csv"), ("--input", "tx.npz", "out.npz")):
        status, _, err = call(["predict", run.folder, option, tmp_path / input_name, "--out", tmp_path / out], capsys)
        assert status == 0, err
    written = np.genfromtxt(tmp_path / "out.csv", delimiter=",", names=True)
    assert written.dtype.names == ("x", "y", "z", "frequency_hz", "anchor1_dbm", "anchor2_dbm")
    np.testing.assert_array_equal(written["frequency_hz"], table[:, 3])
    np.testing.assert_allclose(written["anchor2_dbm"], expected[1], atol=FLOAT32_DB)
    with np.load(tmp_path / "out.npz") as stored:
        np.testing.assert_array_equal(stored["frequency_hz"], table[:, 3])
        np.testing.assert_allclose(stored["prediction"], expected, atol=FLOAT32_DB)
    with np.load(run.folder / "predictions.npz") as stored:
        np.testing.assert_array_equal(stored["frequency_hz"], flat.carriers_hz[stored["row"]])


def test_direct_paths_have_the_free_space_loss_of_each_row(flat: Record, room: Path, tmp_path: Path) -> None:
    run = train(flat, "ray-tracing", out=tmp_path / "run", scene=room, settings=TraceOptions(reflection=False, depth=0))
    rx = np.stack([receiver.position_m for receiver in flat.receivers])
    distance = np.linalg.norm(flat.tx_pos_m - rx[:, None], axis=-1)
    loss = 20 * np.log10(speed_of_light / flat.carriers_hz / (4 * np.pi * distance))
    training_rows = flat.official[0]
    expected = loss + np.median((flat.observation - loss)[:, training_rows], axis=1, keepdims=True)
    read = read_run(run.folder)
    assert read.prediction == pytest.approx(expected[:, read.row], abs=FLOAT32_DB)
    # Traced anew at another carrier than any row had.
    shifted = open_run(run.folder, flat).predict(flat.tx_pos_m[:3], 0, carriers_hz=np.full(3, 2e9)).mean
    assert shifted == pytest.approx(expected[0, :3] + 20 * np.log10(flat.carriers_hz[:3] / 2e9), abs=FLOAT32_DB)


def spectra_of(record: Record) -> Record:
    """A record of spectra by arrays at the same receivers."""
    grey = np.zeros((len(record.receivers), len(record), 9, 24), np.float32)
    spectra = replace(record, task="spectrum", observation=grey, tx_heading_rad=None)
    return spectra.with_array(planar_array(3, 3, 0.05))


@pytest.mark.parametrize("make", [lambda record: record, spectra_of])
def test_reflections_equal_a_trace_at_the_carrier(make: Callable[[Record], Record], flat: Record, room: Path) -> None:
    record = make(flat)
    options, rows = TraceOptions(depth=2, transmission=True, rays=20000), np.arange(9)
    carriers, tx = record.carriers_hz[rows], record.tx_pos_m[rows]
    tracer = RayTracer(room, instrument_of(record.at_carrier(2.4e9)), options)
    traced = tracer.trace(tx, carriers_hz=carriers)
    observed = tracer.observe(traced)
    halves = [tracer.trace(tx[part], carriers_hz=carriers[part]) for part in (slice(4), slice(4, None))]
    np.testing.assert_allclose(tracer.observe(join_traces(halves)), observed, atol=FLOAT32_DB)
    for carrier in (LOW, HIGH):
        alone = RayTracer(room, instrument_of(record.at_carrier(carrier)), options)(tx)
        at_carrier = carriers == carrier
        tolerance = GREY if record.task.name == "spectrum" else FLOAT32_DB
        np.testing.assert_allclose(observed[:, at_carrier], alone[:, at_carrier], atol=tolerance)
        assert not np.allclose(observed[:, ~at_carrier], alone[:, ~at_carrier], atol=0.05)


def test_cross_polarisation_is_judged_at_one_carrier(flat: Record, room: Path) -> None:
    tracer = RayTracer(room, instrument_of(flat.at_carrier(LOW)), TraceOptions(depth=2, rays=20000))
    traced = tracer.trace(flat.tx_pos_m, carriers_hz=np.full(len(flat), 100 * LOW))
    recomputed = recompute(traced, tracer.scene)
    assert recomputed.carriers_hz is None
    direct = recomputed.paths.bounces == 0
    np.testing.assert_allclose(np.abs(recomputed.paths.gain / traced.paths.gain)[direct], 100, rtol=1e-4)
    # The turned antenna brings at LOW about what the stated one, which nothing is wrong with, brings at 100 LOW.
    assert cross_polarized(traced, tracer.scene) == {}


def test_stored_paths_keep_the_carriers(flat: Record, room: Path, tmp_path: Path) -> None:
    run = train(flat, "ray-tracing", out=tmp_path / "run", scene=room, settings=["depth=1", "rays=20000"])
    stored = load_trace(run.folder / "paths.npz")
    np.testing.assert_array_equal(stored.carriers_hz, flat.carriers_hz)
    read, again = read_run(run.folder), open_run(run.folder, flat)
    anew = again.predict(flat.tx_pos_m[read.row], 0, carriers_hz=flat.carriers_hz[read.row]).mean
    assert read.prediction[0] == pytest.approx(anew, abs=FLOAT32_DB)


def test_one_target_error_and_unknown_materials_are_refused(flat: Record, room: Path, tmp_path: Path) -> None:
    message = r"rows at 2 carriers, .* target_error_db serves one carrier"
    options = {"scene": room, "settings": ["target_error_db=1"]}
    refusal(train, flat, "ray-tracing", message, out=tmp_path / "run", **options)
    unknown = flat.at_carriers(np.where(np.arange(len(flat)) % 2, LOW, 1e8))
    refusal(train, unknown, "ray-tracing", r"not known at 0\.1 GHz", out=tmp_path / "run", scene=room)
    assert not (tmp_path / "run").exists()


def test_reference_interpolates_rows_of_the_same_carrier(flat: Record) -> None:
    training_rows, rows = flat.official
    key = reference_key("idw")
    split = Split("two", 0, training_rows, training_rows[:0], rows)
    reference = reference_arrays(flat, split)[key]
    shifted = replace(flat, observation=flat.observation + np.where(flat.carriers_hz == LOW, 30, 0).astype(np.float32))
    moved = reference_arrays(shifted, split)[key] - reference
    np.testing.assert_allclose(moved, [np.where(flat.carriers_hz[rows] == LOW, 30, 0)] * 2, atol=FLOAT32_DB)


def test_data_command_shows_carriers_readings_and_noise(flat: Record, tmp_path: Path, capsys: Any) -> None:
    shape = flat.observation.shape
    readings = np.ones(shape, np.int64)
    readings[:, ::2] = 5
    extended_record = replace(flat, n_readings=readings, std=np.linspace(1, 3, readings.size).reshape(shape))
    # Runs are shown in the order of their first rows, as they are read: training rows first.
    extended_record = replace(
        extended_record,
        runs=np.where(np.isin(np.arange(len(extended_record)), extended_record.official[1]), "early", "late"),
    )
    folder = write_ble_folder(tmp_path / "flat", extended_record)
    status, out, _ = call(["data", "info", folder, "--json"], capsys)
    shown = json.loads(out)
    assert (status, shown["carriers_hz"]) == (0, {str(LOW): 10, str(HIGH): 20})
    assert list(shown["runs"].items()) == [("late", 24), ("early", 6)]
    assert (shown["n_readings"], shown["std_db"]) == ([1, 3, 5], pytest.approx([1, 2, 3]))
    assert (shown["receivers"], shown["official"]) == ({"anchor1": 30, "anchor2": 30}, [24, 6])
    _, out, _ = call(["data", "info", folder], capsys)
    assert "carrier:          1100000000 Hz in 10 rows, 5100000000 Hz in 20 rows\n" in out
    assert "runs:             late 24, early 6\n" in out
    assert "readings per row: 1 to 5, median 3\nnoise:            1 to 3 dB, median 2 dB\n" in out
    status, _, err = call(["data", "info", tmp_path / "nothing"], capsys)
    assert (status, err.count("\n")) == (2, 1)


def test_data_command_shows_carriers_of_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_nerf2_csi(tmp_path / "stations", channels())
    status, out, _ = call(["data", "info", folder], capsys)
    assert status == 0
    assert "carrier:          2400000000 to 2403000000 Hz, 4 subcarriers\n" in out
    assert "known:            positions, uplink\n" in out
