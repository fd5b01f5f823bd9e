"""Positions of transmitters and maps by runs that trace a scene: what is traced, fitted, reported and left behind."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import Command
from traced_rooms import LENGTH, SHOEBOX, WIDTH, receiver
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.apps.maps import api, locate_calibration
from wrf_mi.apps.maps.api import radio_map
from wrf_mi.apps.maps.grid import candidates_of
from wrf_mi.apps.maps.locate import locate
from wrf_mi.apps.maps.locate_calibration import FILE, FOLDER
from wrf_mi.core import Record
from wrf_mi.datasets import write_ble_folder
from wrf_mi.models import Inputs
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.runs.api import open_run, train
from wrf_mi.runs.run import Run
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.materials import Materials
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.stages import strengths as of_strengths
from wrf_mi.stages.stage import Option
from wrf_mi.tracing import TraceOptions, power_map
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.session import Interrupted

HZ = np.array([2.44e9])
PLAIN = TraceOptions(transmission=True, depth=1, rays=1 << 12)
"""Options of the truth and of the fits, in place of those of `wrf_mi.stages.strengths`, which take seconds."""
FLOOR_M = 4.0  # the plan has a floor from 0 to here along x
HEIGHT_M = 1.3
ROWS, TRAINED = 60, 44
STEP_M = 0.5
SINGLE_DB = 1e-4  # rounding of predictions that are stored in single precision
NOISE_DB = 1.0


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    """Hybrid about the power traced at exact positions, in a room whose plan lacks a part of the floor."""
    folder, rng = tmp_path_factory.mktemp("located"), np.random.default_rng(5)
    parts = SHOEBOX | {"floor": ("itu_concrete", sheet(2, 0.0, (0.0, FLOOR_M), (0.0, WIDTH)))}
    surfaces = [Surface(name, "other", np.asarray(m.vertices), np.asarray(m.faces)) for name, (_, m) in parts.items()]
    materials = Materials(surfaces={name: material for name, (material, _) in parts.items()})
    scene = write_scene(folder / "room", surfaces, frame="the room's", source="test", materials=materials)
    # Two training rows and a located one beyond the floor.
    places = np.column_stack([rng.uniform(0.3, FLOOR_M - 0.3, ROWS), rng.uniform(0.3, WIDTH - 0.3, ROWS)])
    places[[3, 17]], places[-1] = [[5.1, 2.3], [4.9, 2.6]], [5.6, 0.4]
    tx_pos_m = np.column_stack([places, np.full(ROWS, HEIGHT_M)])
    receivers = tuple(
        receiver(at, f"anchor{number}") for number, at in enumerate(((0.4, 0.6, 2.2), (5.6, 1.0, 2.4), (2.9, 4.6, 2.0)))
    )
    traced = np.asarray(RayTracer(scene, Instrument("power", receivers, HZ), PLAIN)(tx_pos_m), float)
    observed = traced + rng.normal(0, NOISE_DB, traced.shape)
    record_fields: dict[str, Any] = {"frequencies_hz": HZ, "official": (np.arange(TRAINED), np.arange(TRAINED, ROWS))}
    record = Record("room", "rssi", tx_pos_m, receivers, observed.astype(np.float32), **record_fields)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(of_strengths, "TRACE", PLAIN)
        # Of a single room, held-out rows do not tell power at positions from its local means.
        options = of_strengths.Mean.options
        patch.setattr(of_strengths.Mean, "options", lambda *arguments: options(*arguments)[-1:])
        data = write_ble_folder(folder / "data", record)
        settings = ("stages=mean,residual",)
        trained = train(data, "hybrid", out=folder / "run", scene=str(scene), settings=settings)
        fitted: Any = trained.fitted
        assert fitted.parts["paths"].fitted.field.prior.traced.exact
        yield trained


@pytest.fixture
def traced(monkeypatch: pytest.MonkeyPatch) -> list[tuple[np.ndarray, int]]:
    """Positions and numbers of receivers of all traces from here on."""
    traces: list[tuple[np.ndarray, int]] = []
    trace_paths = power_map.trace_paths

    def counted(scene, tx_pos_m, receivers, *options, **more):
        traces.append((np.asarray(tx_pos_m), len(receivers)))
        return trace_paths(scene, tx_pos_m, receivers, *options, **more)

    monkeypatch.setattr(power_map, "trace_paths", counted)
    return traces


@pytest.fixture
def anew(run: Run) -> Run:
    """The run as another process opens it, without a choice of the likelihood."""
    (run.folder / FILE).unlink(missing_ok=True)
    return open_run(run.folder)


def observed_of(run: Run) -> np.ndarray:
    return np.asarray(run.problem.record.observation[:, TRAINED:], float)


def test_each_candidate_is_traced_once_for_all_receivers_and_folds(anew: Run, traced: list) -> None:
    located = locate(anew, observed_of(anew), step_m=STEP_M)
    assert located.calibration.rows > 0
    positions = np.concatenate([tx_pos_m for tx_pos_m, _ in traced])
    places, counts = np.unique(positions, axis=0, return_counts=True)
    np.testing.assert_array_equal(counts, 1)
    assert {count for _, count in traced} == {3}
    candidates = located.candidates.positions_m
    assert (np.abs(places[:, None] - candidates).max(axis=2).min(axis=0) == 0).all()


def test_no_stage_is_fitted_anew_to_choose_the_likelihood(anew: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate_calibration, "fit_fold", None)
    assert locate(anew, observed_of(anew), step_m=STEP_M).calibration.rows > 0


def test_estimates_of_chunks_are_those_of_predictions_one_by_one(anew, traced, monkeypatch):
    monkeypatch.setattr(locate_calibration, "TOGETHER", 7)
    observed = observed_of(anew)
    located = locate(anew, observed, step_m=STEP_M)
    assert len(located.candidates.positions_m) > 64
    assert max(len(tx_pos_m) for tx_pos_m, _ in traced) <= 7
    fitted, places = open_run(anew.folder).fitted, located.candidates.positions_m
    predictions = [fitted.predict(Inputs(places), number) for number in range(3)]
    mean, std = (np.stack(values)[None] for values in zip(*((p.mean, p.std) for p in predictions), strict=True))
    for row, strengths in enumerate(observed.T):
        near_m = None if located.neighbours_m is None else located.neighbours_m[row]
        of_field = located.calibration.likelihood.log(strengths, mean, std)
        probability = located.calibration.probabilities(of_field, near_m, located.candidates)
        np.testing.assert_allclose(located.probability[row], probability, atol=SINGLE_DB)
        expected_m = np.linalg.norm(places[:, None] - places, axis=2) @ probability
        np.testing.assert_allclose(located.tx_pos_m[row], places[expected_m.argmin()])


def test_chunks_of_a_map_are_small_only_where_paths_are_traced(run, tmp_path, monkeypatch):
    """Paths of all receivers are traced together; of a local mean that many chunks would take most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        direct = of_strengths.DIRECT
        patch.setattr(
            of_strengths.Mean, "options", lambda self, *arguments: [Option(direct, partial(self._fit, direct))]
        )
        data, scene = run.folder.parent / "data", str(run.problem.scene)
        settings = ("stages=mean,residual",)
        local = train(data, "hybrid", out=tmp_path / "run", scene=scene, settings=settings)
    of_chunk, sizes = api._of_chunk, list[int]()

    def counted(run: Run, fitted: Any, positions_m: np.ndarray, *more: Any) -> dict[str, Any]:
        sizes.append(len(positions_m))
        return of_chunk(run, fitted, positions_m, *more)

    monkeypatch.setattr(api, "_of_chunk", counted)
    monkeypatch.setattr(api, "CHUNK_SIZE", 30)
    for each, most in ((run, 10), (local, 30)):
        sizes.clear()
        mapped = radio_map(each, step_m=1.0)
        assert max(sizes) == most
        y, x = (axis.ravel() for axis in np.meshgrid(mapped["y"], mapped["x"], indexing="ij"))
        places = np.column_stack([x, y, np.full(len(x), float(mapped["height"]))])
        for number, power in enumerate(mapped["power_dbm"].values.reshape(3, -1)):
            np.testing.assert_allclose(each.predict(places, number).mean, power, atol=SINGLE_DB)


def test_estimates_are_as_near_as_noise_allows(anew: Run) -> None:
    located = locate(anew, observed_of(anew), step_m=0.25)
    assert np.median(located.error_m(anew.problem.record.tx_pos_m[TRAINED:])) < 1.0


def test_refit_does_not_know_the_rows_that_are_left_out(run: Run) -> None:
    record, rows = run.problem.record, np.arange(TRAINED - 12)
    changed = record.observation.copy()
    changed[:, TRAINED - 12 :] += 20
    at = Inputs(record.tx_pos_m[TRAINED - 12 : TRAINED])
    refit = [run.fitted.refit(each, rows) for each in (record, replace(record, observation=changed))]
    for number in range(3):
        (mean, std), (other, other_std) = ((p.mean, p.std) for p in (fit.predict(at, number) for fit in refit))
        np.testing.assert_array_equal(mean, other)
        np.testing.assert_array_equal(std, other_std)
        assert np.abs(run.fitted.predict(at, number).mean - mean).max() > SINGLE_DB


def test_refit_to_all_rows_is_the_fit(run: Run) -> None:
    record = run.problem.record
    at = Inputs(record.tx_pos_m[TRAINED:])
    refit = run.fitted.refit(record, np.arange(TRAINED))
    for number in range(3):
        expected, prediction = (fit.predict(at, number) for fit in (run.fitted, refit))
        np.testing.assert_allclose(prediction.mean, expected.mean, atol=SINGLE_DB)
        np.testing.assert_allclose(prediction.std, expected.std, atol=SINGLE_DB)


def test_progress_begins_before_anything_is_traced(anew: Run, traced: list, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(locate_calibration, "TOGETHER", 16)
    reports: list[tuple[str, float, int]] = []
    locate(
        anew, observed_of(anew), step_m=STEP_M, on_progress=lambda what, at, *_: reports.append((what, at, len(traced)))
    )
    assert reports[0][1:] == (0.0, 0)
    stages = {what for what, *_ in reports[1:]}
    assert len(stages) == 4
    for stage in stages:
        shares = [share for what, share, _ in reports if what == stage]
        assert len(shares) >= 5
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1)


def test_stopped_search_leaves_nothing(anew: Run) -> None:
    files = set(anew.folder.rglob("*"))
    calls = iter(range(1000))
    with pytest.raises(Interrupted):
        locate(anew, observed_of(anew), step_m=STEP_M, stop=lambda: next(calls) > 3)
    assert set(anew.folder.rglob("*")) == files
    assert not (anew.folder / FOLDER).exists()


def test_places_of_training_rows_beyond_the_floor_are_searched(run: Run) -> None:
    candidates = candidates_of(run, 0.25)
    record = run.problem.record
    assert not candidates.outside(record.tx_pos_m[:TRAINED]).any()
    assert candidates.outside(record.tx_pos_m[-1:]).all()
    x_m = candidates.positions_m[:, 0]
    assert (x_m > FLOOR_M + 0.25).sum() < 40
    # Beside the missing floor and at the walls.
    border = candidates.positions_m[candidates.at_border]
    within = candidates.positions_m[~candidates.at_border]
    assert (np.abs(border[:, 0] - FLOOR_M) < 0.2).any()
    assert within[:, 0].min() > 0.25
    assert within[:, 0].max() < LENGTH - 0.25


def test_positions_outside_of_the_floor_are_counted(anew: Run, tmp_path: Path, command: Command) -> None:
    words = ["locate", anew.folder, "--step", str(STEP_M), "--out", tmp_path / "out.csv"]
    figures = command.json(words)
    assert figures["outside"] == 1
    assert figures["training_rows_outside"] == 0
    assert figures["at_border"] >= 1
    text = command.done(words)
    assert (
        f"border of the searched area: {figures['at_border']} of 16 estimates; outside of it: training rows 0, " in text
    )
    assert "true positions 1\n" in text


def test_map_traces_a_chunk_for_all_receivers_together(anew: Run, traced: list) -> None:
    mapped = anew.map(step_m=STEP_M)
    assert {count for _, count in traced} == {3}
    assert sum(len(tx_pos_m) for tx_pos_m, _ in traced) <= mapped["power_dbm"][0].size
    single_map = anew.map(step_m=STEP_M, receivers=["anchor1"])
    np.testing.assert_allclose(single_map["power_dbm"][0], mapped["power_dbm"][1], atol=SINGLE_DB)
    assert {count for _, count in traced} == {1, 3}
