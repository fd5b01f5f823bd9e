"""`predict` and `trace` on two workers of which one is lost: the same files as of one process."""

import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import xarray
from commands import arrays_in
from made_flat import write_flat
from made_waves import wave_record
from small_fits import official, settings
from worker_tasks import Lossy

from wrf_mi import parallel
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, write_spectrum_folder
from wrf_mi.estimators import ray_tracing
from wrf_mi.parallel import Scheduler
from wrf_mi.runs.api import predict_to_file, train
from wrf_mi.tracing import TraceOptions

PRODUCTS = 1e-5
"""Share of the largest value by which kriging and operators may differ: a product of matrices adds in an order
that depends on how many columns it has. Splatted fields and traces are bit-identical."""
POSITIONS = 12


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Signal strengths at a few places."""
    return write_flat(tmp_path_factory.mktemp("data") / "flat", rows=6, held_out=2)


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Several parts of few positions."""
    monkeypatch.setattr(ray_tracing, "TRACED_AT_LEAST", 2)


def positions(record: Record, rows: int = POSITIONS) -> np.ndarray:
    """New places among those of a record."""
    low, high = record.tx_pos_m.min(axis=0), record.tx_pos_m.max(axis=0)
    return np.random.default_rng(6).uniform(low, high, (rows, 3))


Arrays = dict[str, np.ndarray]


def both(run: Path, tx_pos_m: np.ndarray, two: Any, folder: Path, heading: Any = None) -> tuple[Arrays, Arrays]:
    """Predictions of one process, and of two workers."""
    predict_to_file(run, tx_pos_m, folder / "serial.npz", heading)
    predict_to_file(run, tx_pos_m, folder / "parallel.npz", heading, two)
    serial, parallel = arrays_in(folder / "serial.npz"), arrays_in(folder / "parallel.npz")
    assert serial.keys() == parallel.keys()
    np.testing.assert_array_equal(parallel["row"], np.arange(len(tx_pos_m)))
    np.testing.assert_array_equal(parallel["tx_pos"], tx_pos_m)
    return serial, parallel


def assert_same_bits(one: Arrays, other: Arrays) -> None:
    assert one.keys() == other.keys()
    for key in one:
        assert one[key].dtype == other[key].dtype, key
        np.testing.assert_array_equal(one[key], other[key], err_msg=key)


def assert_close(one: Arrays, other: Arrays, *keys: str) -> None:
    for key in keys:
        np.testing.assert_allclose(other[key], one[key], rtol=0, atol=PRODUCTS * np.abs(one[key]).max(), err_msg=key)


@pytest.mark.parametrize("model", ["wrf-gs+", "wrf-gs"])
def test_parallel_prediction_of_a_field_equals_serial(model, two_gateways, two, tmp_path):
    """One is splatted; the other is a product of matrices."""
    folder = write_spectrum_folder(tmp_path / "made-here", two_gateways, bits=16)
    record, fit = load(folder), settings("steps=4", model=model)
    run = train(record, model, out=tmp_path / "run", settings=fit, split=official(record)).folder
    lossy = Lossy(two, tmp_path)
    serial, parallel = both(run, positions(record), lossy, tmp_path)
    lossy.assert_one_was_lost()
    assert serial["prediction"].shape == (2, POSITIONS, *record.observation.shape[-2:])
    assert np.ptp(serial["prediction"]) > 0
    if model == "wrf-gs":
        assert_close(serial, parallel, "prediction")
    else:
        assert_same_bits(serial, parallel)


def test_parallel_trace_and_its_prediction_equal_serial(flat: Path, room: Path, two: Scheduler, tmp_path: Path) -> None:
    """The number of rays is chosen by the search, which uses all positions."""
    options: dict[str, Any] = {"scene": room, "settings": TraceOptions(depth=1, rays="auto")}
    serial = train(flat, "ray-tracing", out=tmp_path / "serial", **options).folder
    lossy: Any = Lossy(two, tmp_path)
    parallel = train(flat, "ray-tracing", out=tmp_path / "parallel", scheduler=lossy, **options).folder
    lossy.assert_one_was_lost()
    for file in ("paths.npz", "predictions.npz", "split.npz"):
        assert_same_bits(arrays_in(serial / file), arrays_in(parallel / file))
    assert_same_bits(*both(serial, positions(load(flat)), two, tmp_path))


@pytest.mark.slow
def test_parallel_trace_of_random_paths_equals_serial(flat, room, two, tmp_path, monkeypatch):
    """Diffuse reflections and diffraction, both searched for from transmitters."""
    monkeypatch.setattr(ray_tracing, "TRACED_AT_LEAST", 4)  # one part for each worker
    for kind, code in (("scattering", 2), ("diffraction", 8)):
        options: dict[str, Any] = {
            "scene": room,
            "settings": TraceOptions(depth=1, rays=1 << 8, scattering_coefficient=0.3, **{kind: True}),
        }
        serial = train(flat, "ray-tracing", out=tmp_path / f"{kind}-serial", **options).folder
        parallel = train(flat, "ray-tracing", out=tmp_path / f"{kind}-parallel", scheduler=two, **options).folder
        arrays = arrays_in(serial / "paths.npz")
        assert (arrays["interactions"] == code).any()
        assert_same_bits(arrays, arrays_in(parallel / "paths.npz"))


def test_parallel_prediction_of_kriging_equals_serial(flat: Path, two: Scheduler, tmp_path: Path) -> None:
    waves = write_spectrum_folder(tmp_path / "waves", wave_record(24, 6))
    for name, data, model_settings in (("strengths", flat, ()), ("spectra", waves, ("directions=20", "lengths=2"))):
        folder = tmp_path / name
        run = train(data, "kriging", out=folder / "run", settings=model_settings).folder
        places = positions(load(data))
        heading = np.linspace(-3, 3, len(places)) if name == "strengths" else None
        serial, parallel = both(run, places, two, folder, heading)
        assert_close(serial, parallel, "prediction", "std")
        if name == "strengths":
            alone, spread = (radio_map(run, step_m=2.0, scheduler=scheduler) for scheduler in (None, two))
            xarray.testing.assert_allclose(alone, spread)


def test_errors_of_parts_name_the_row_of_the_whole_input(flat, two, tmp_path, command, monkeypatch):
    """A cabinet stands where the last transmitter is."""
    box = trimesh.creation.box((0.3, 0.3, 0.3))
    box.apply_translation((50.0, 50.0, 1.0))
    box.export(tmp_path / "box.ply")
    options: dict[str, Any] = {"scene": tmp_path / "box.ply", "material": "concrete"}
    direct = TraceOptions(reflection=False, depth=0)
    run = train(flat, "ray-tracing", out=tmp_path / "run", settings=direct, **options).folder
    places = np.concatenate([positions(load(flat)), [[50.0, 50.0, 1.0]]])
    with pytest.raises(InputError, match=f"^transmitter {POSITIONS + 1} at .* is inside the solid 'box'"):
        predict_to_file(run, places, tmp_path / "p.npz", scheduler=two)
    assert not (tmp_path / "p.npz").exists()
    np.savez(tmp_path / "tx.npz", tx_pos=places[-1:])
    monkeypatch.setattr(parallel, "open_scheduler", lambda text: nullcontext(two))
    words = ["--input", tmp_path / "tx.npz", "--out", tmp_path / "p.npz", "--scheduler", "local"]
    command.refused(["predict", run, *words], "transmitter 1 at .* is inside the solid 'box'; move one of them")
    np.savez(tmp_path / "tx.npz", tx_pos=places[:3])
    status, out, err = command(["predict", run, *words])
    assert status == 0
    assert re.fullmatch("predicting: 3 of 3, [12] workers?", err.splitlines()[-1])
    assert out.startswith("3 predictions: ")
    scene = ["--scene", tmp_path / "box.ply", "--material", "concrete", "--paths", "line-of-sight"]
    status, _, err = command(["trace", flat, *scene, "--out", tmp_path / "again", "--scheduler", "local"])
    assert status == 0
    assert re.fullmatch("tracing: 8 of 8, [12] workers?", err.splitlines()[-1])
    assert_same_bits(arrays_in(run / "predictions.npz"), arrays_in(tmp_path / "again" / "predictions.npz"))
