"""Receivers with few training rows, none, or an unknown place: predicted by what the other receivers teach."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from calling import strength_commands
from commands import Command
from made_building import FITS, PLACES_M, TRAINED, WITH_INTERVALS, building, fitted
from made_walls import heard_through_walls

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.core.types import Inputs
from wrf_mi.datasets import load, make_splits, write_ble_folder
from wrf_mi.estimators import receiver_places
from wrf_mi.estimators.few_rows import SharedLaw
from wrf_mi.estimators.receiver_places import place_of_receiver, placed, placed_problem
from wrf_mi.models import MODELS, Problem
from wrf_mi.runs.api import open_run, resume, train
from wrf_mi.scene.make import make_scene
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tracing import load_trace

NAMES = list(PLACES_M)
SCARCE: dict[str, tuple[int, ...]] = {"attic": (3, 5, 41, 44, 47, 50), "cellar": tuple(range(TRAINED, TRAINED + 8))}
"""Rows of receivers with two training rows and with none."""
NOISE_DB = 1.0  # standard deviation of the noise of `made_building.building`
WORSE_DB = 0.05  # allowed difference of a mean absolute error: kriging learns its common terms from the few rows, too


def errors_db(folder: Path) -> dict[str, Any]:
    """Absolute errors of the test rows by the name of the receiver."""
    stored = np.load(folder / "predictions.npz")
    return dict(zip(stored["receiver_name"], np.abs(stored["prediction"] - stored["truth"]), strict=True))


@pytest.mark.parametrize("model", FITS)
def test_every_model_serves_them_and_the_others_are_as_without(model: str, tmp_path: Path) -> None:
    intervals = model in WITH_INTERVALS
    run = train(building(**SCARCE), model, out=tmp_path / "run", settings=FITS[model], intervals=intervals)
    assert run.metrics["receivers_with_few_rows"] == {"attic": 2, "cellar": 0}
    assert "receivers_left_out" not in run.metrics
    scarce, alone = errors_db(run.folder), errors_db(fitted(model).folder)
    assert list(scarce) == [*NAMES, "attic", "cellar"]
    assert np.mean([np.mean(scarce[name]) - np.mean(alone[name]) for name in NAMES]) < WORSE_DB
    # The law of the others and two rows with noise of 1 dB: three standard deviations of the mean of four errors.
    assert max(np.nanmean(scarce[name]) for name in ("attic", "cellar")) < 3 * NOISE_DB
    again = open_run(run.folder, building(**SCARCE))
    for name in ("lab", "cellar"):
        prediction = again.predict([[1, 2, 1.3], [5, 5, 1.3]], name)
        assert np.isfinite(prediction.mean).all()
        assert (prediction.std is not None) == (intervals or model in ("kriging", "hybrid"))


def noise_free(shift_db: dict[int, float]) -> Record:
    """The building without noise, by the law -40 - 25 log10 d, shifted for the receivers of some numbers."""
    record = building(**SCARCE)
    for number, receiver in enumerate(record.receivers):
        distance_m = np.linalg.norm(record.tx_pos_m - receiver.position_m, axis=1)
        received = np.isfinite(record.observation[number])
        power_dbm = -40 - 25 * np.log10(distance_m) + shift_db.get(number, 0.0)
        record.observation[number, received] = power_dbm[received]
    return record


def test_law_and_shift_of_data_without_noise_are_exact() -> None:
    law = SharedLaw.fit(noise_free({}), np.arange(TRAINED), np.array([3, 4]))
    np.testing.assert_allclose(law.law, [-40, -2.5], atol=1e-4)  # single precision
    np.testing.assert_allclose(law.shift_db, 0, atol=1e-4)


@pytest.mark.parametrize(("number", "expected_db"), [(3, 6.0), (4, 0.0)])
def test_shift_follows_the_rows_where_receivers_differ_more_than_rows(number: int, expected_db: float) -> None:
    """The shift of two exact rows is theirs, and without rows it is the mean of the others."""
    record = noise_free({0: -5.0, 1: 5.0, 3: 6.0})
    law, inputs = SharedLaw.fit(record, np.arange(TRAINED), np.array([number])), Inputs(record.tx_pos_m[:5])
    distance_m = np.linalg.norm(inputs.tx_pos_m - record.receivers[number].position_m, axis=1)
    error_db = law(inputs, number).mean - (-40 - 25 * np.log10(distance_m) + expected_db)
    # The exponent absorbs a part of the differences between receivers.
    assert np.abs(error_db).mean() < 1.5


def test_deviation_has_both_variances_and_a_receiver_at_an_unknown_place_the_mean_level() -> None:
    record = building(**SCARCE)
    record.observation[:3] += np.array([[-4.0], [0.0], [4.0]], np.float32)
    two_rows, none = SharedLaw.fit(record, np.arange(TRAINED), np.array([3, 4])).std_db
    # The variance between is that of three numbers, 16 dB^2, and within receivers noise of 1 dB and the law's misfit.
    assert none == pytest.approx(np.sqrt(16 + NOISE_DB**2), rel=0.25)
    assert two_rows == pytest.approx(np.sqrt(1.5) * NOISE_DB, rel=0.5)
    record = building(**SCARCE)
    lost = replace(record.receivers[4], position_m=np.full(3, np.nan))
    record = replace(record, receivers=(*record.receivers[:4], lost))
    predicted = SharedLaw.fit(record, np.arange(TRAINED), np.array([4]))(Inputs(record.tx_pos_m[:3]), 4)
    np.testing.assert_allclose(predicted.mean, np.nanmean(record.observation[:, :TRAINED]), atol=1.0)


def test_several_carriers_share_the_law(tmp_path: Path) -> None:
    record = building(**SCARCE)
    carriers_hz = np.where(np.arange(len(record)) % 2, 9e8, 2.4e9)
    record.observation[:] -= (20 * np.log10(carriers_hz / 2.4e9)).astype(np.float32)
    record = replace(record, frequencies_hz=None, carriers_hz=carriers_hz)
    run = train(record, "kriging", out=tmp_path / "run")
    low, high = (run.predict([[5, 5, 1.3]], "cellar", carriers_hz=[hz]).mean[0] for hz in (9e8, 2.4e9))
    assert low - high == pytest.approx(20 * np.log10(2.4e9 / 9e8), abs=1e-4)
    assert np.nanmean(errors_db(run.folder)["cellar"]) < 3 * NOISE_DB


def test_min_rows_leaves_receivers_out(tmp_path: Path) -> None:
    record = building(**SCARCE)
    for least, left in ((1, {"cellar": 0}), (3, {"attic": 2, "cellar": 0})):
        run = train(record, "mri", out=tmp_path / f"run{least}", min_rows=least)
        assert run.metrics["receivers_left_out"] == left
    with pytest.raises(InputError, match="min_rows -1: give a number of training rows, 0 or more"):
        train(record, "mri", out=tmp_path / "none", min_rows=-1)


UNKNOWN_M = np.full(3, np.nan)
ELLIPSE_90 = 4.605  # squared standard deviations that 90 % of a normal density in the plane are within


def unmapped(record: Record, *names: str) -> Record:
    """The record without the positions of some receivers."""
    receivers = tuple(
        replace(receiver, position_m=UNKNOWN_M) if receiver.name in names else receiver for receiver in record.receivers
    )
    return replace(record, receivers=receivers)


def shadowed(seed: int, rows: int = 80, noise_db: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows in a hall of 30 m x 20 m, their strengths by the law of exponent 2.8, and the receiver's position."""
    rng = np.random.default_rng(seed)
    tx_pos_m = np.column_stack([rng.uniform(0, 30, rows), rng.uniform(0, 20, rows), np.full(rows, 1.2)])
    place_m = np.array([rng.uniform(3, 27), rng.uniform(3, 17), 2.6])
    distance_m = np.linalg.norm(tx_pos_m - place_m, axis=1)
    apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
    shadow = np.linalg.cholesky(0.7 * np.exp(-apart_m / 2.0) + 0.3 * np.eye(rows)) @ rng.normal(size=rows)
    return tx_pos_m, -42 - 28 * np.log10(distance_m) + noise_db * shadow, place_m


def test_strengths_locate_the_receiver_stated_coordinates_remain_and_a_single_row_says_little() -> None:
    """The law's least distance of 0.3 m moves them by centimetres, and so do errors of the height."""
    for seed in range(5):
        tx_pos_m, power_dbm, place_m = shadowed(seed)
        found_m, std_m = place_of_receiver(tx_pos_m, power_dbm, 36.0, UNKNOWN_M)
        np.testing.assert_allclose(found_m[:2], place_m[:2], atol=0.1)
        assert (std_m > 0).all()
    tx_pos_m, power_dbm, place_m = shadowed(0)
    found_m, std_m = place_of_receiver(tx_pos_m, power_dbm, 36.0, np.array([np.nan, np.nan, 2.6]))
    assert (found_m[2], std_m[2]) == (2.6, 0)
    np.testing.assert_allclose(found_m[:2], place_m[:2], atol=0.1)
    found_m, std_m = place_of_receiver(np.array([[3.0, 4.0, 1.0]]), np.array([-60.0]), 20.0, UNKNOWN_M)
    assert np.isfinite(found_m).all()
    assert (std_m[:2] > 5).all()


def test_ellipses_of_90_percent_cover_receivers_behind_walls() -> None:
    """Of 120 receivers in buildings that nothing was tuned on 90 % would vary by 3 %, one standard deviation."""
    inside = []
    for seed in range(1000, 1120):
        tx_pos_m, power_dbm, extent_m, place_m = heard_through_walls(seed)
        found_m, std_m = place_of_receiver(tx_pos_m, power_dbm, extent_m, UNKNOWN_M)
        inside.append(np.square((found_m - place_m) / std_m)[:2].sum() < ELLIPSE_90)
    assert 0.8 < np.mean(inside) < 0.97


def test_deviation_contains_the_mirror_image_beside_a_straight_walk() -> None:
    tx_pos_m = np.column_stack([np.linspace(0, 30, 60), np.full(60, 4.0), np.full(60, 1.2)])
    place_m = np.array([12.0, 10.0, 2.2])
    power_dbm = -40 - 30 * np.log10(np.linalg.norm(tx_pos_m - place_m, axis=1))
    found_m, std_m = place_of_receiver(tx_pos_m, power_dbm, 30.0, UNKNOWN_M)
    np.testing.assert_allclose(abs(found_m[1] - 4), 6, atol=1.0)  # either side
    assert 1.645 * std_m[1] > 11  # to the other side
    assert std_m[0] < 2


def test_standard_deviations_cover_the_errors_under_correlated_shadowing() -> None:
    """Of 60 receivers 68 % lie within one deviation in x and in y: of 120 numbers 0.59 to 0.76 in 95 % of draws."""
    inside = []
    for seed in range(60):
        tx_pos_m, power_dbm, place_m = shadowed(seed, noise_db=5.0)
        found_m, std_m = place_of_receiver(tx_pos_m, power_dbm, 36.0, UNKNOWN_M)
        inside += list(np.abs(found_m - place_m)[:2] < std_m[:2])
    assert 0.55 < np.mean(inside) < 0.85


def test_places_come_from_the_rows_that_are_named_and_others_stay() -> None:
    record = unmapped(building(), "lab")
    before = placed(record, np.arange(TRAINED))
    record.observation[:, TRAINED:] = -50
    after = placed(record, np.arange(TRAINED))
    np.testing.assert_array_equal(before.receivers[2].position_m, after.receivers[2].position_m)
    assert [receiver.is_surveyed for receiver in after.receivers] == [True, True, False]
    # Estimated again from fewer rows, nothing of the first estimate remains.
    fewer = placed(after, np.arange(10))
    np.testing.assert_array_equal(fewer.receivers[2].position_m, placed(record, np.arange(10)).receivers[2].position_m)
    cellar = placed(unmapped(building(cellar=()), "cellar"), np.arange(TRAINED)).receivers[3]
    assert np.isnan(cellar.position_m).all(), "no row was received"


@pytest.mark.parametrize("model", sorted({*FITS} - {"nerf2", "trees"}))
def test_every_model_runs(model: str, tmp_path: Path) -> None:
    record = unmapped(building(cellar=(41, 42)), "lab", "stairs", "cellar")
    settings, intervals = FITS[model], model == "mri"
    run = train(record, model, out=tmp_path / "run", settings=settings, intervals=intervals)
    places = run.metrics["receiver_places"]
    assert list(places) == ["stairs", "lab"]
    # Noise of 1 dB over 40 rows in a hall of 12 m x 8 m.
    np.testing.assert_allclose(places["lab"]["position_m"][:2], [6.0, 7.5], atol=1.0)
    again = open_run(run.folder, record)
    np.testing.assert_array_equal(again.receivers[2].position_m, places["lab"]["position_m"])
    for name in ("lab", "cellar"):
        assert np.isfinite(again.predict([[1, 2, 1.3], [5, 5, 1.3]], name).mean).all()
    if model in ("kriging", "mri", "hybrid"):
        heard_run = train(
            building(cellar=(41, 42)), model, out=tmp_path / "known", settings=settings, intervals=intervals
        )
        assert run.metrics["abs_error_db"]["mean"] - heard_run.metrics["abs_error_db"]["mean"] < 0.5


def test_maps_state_the_deviation_of_estimated_places(tmp_path: Path) -> None:
    run = train(unmapped(building(), "lab"), "mri", out=tmp_path / "run")
    mapped, place = run.map(step_m=1.0), run.metrics["receiver_places"]["lab"]
    for axis, std_m in zip("xyz", place["std_m"], strict=True):
        np.testing.assert_array_equal(mapped[f"receiver_{axis}_std"], [0, 0, std_m])


def test_folds_locate_by_their_own_rows(tmp_path: Path) -> None:
    run = train(unmapped(building(), "lab"), "mri", out=tmp_path / "run", split="blocked")
    files = sorted(run.folder.glob("fold*/receiver_places.json"))
    places = {tuple(json.loads(file.read_text())["lab"]["position_m"]) for file in files}
    assert len(places) == len(files) > 1


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The building's outer walls, a floor and a ceiling at 2.7 m."""
    folder = tmp_path_factory.mktemp("scene")
    (folder / "plan.csv").write_text("x,y\n-1,-1\n13,-1\n13,9\n-1,9\n-1,-1\n")
    return make_scene(folder / "plan.csv", folder / "room", height_m=2.7).folder


@pytest.mark.parametrize(
    ("model", "split", "settings"),
    [("ray-tracing", "none", ("depth=1", "rays=4096")), ("hybrid", "official", ("stages=mean,residual",))],
)
def test_a_scene_is_traced_to_estimated_places(model, split, settings, room: Path, tmp_path: Path) -> None:
    record = unmapped(building(), "lab")
    run = train(record, model, out=tmp_path / "run", scene=room, split=split, settings=settings)
    place = run.metrics["receiver_places"]["lab"]
    np.testing.assert_allclose(place["position_m"][:2], [6.0, 7.5], atol=1.0)
    again = open_run(run.folder, record)
    np.testing.assert_array_equal(again.problem.record.receivers[2].position_m, place["position_m"])
    assert run.metrics["abs_error_db"]["mean"] < 3.0  # noise of 1 dB about a law that is not the scene's
    tx_pos_m = [[1, 2, 1.3], [5, 5, 1.3]]
    before = again.predict(tx_pos_m, "lab").mean
    if model == "ray-tracing":
        for folder in (run.folder, run.folder / "fold0"):  # paths lead to the places of each fold
            stored = json.loads((folder / "receiver_places.json").read_text())["lab"]["position_m"]
            np.testing.assert_array_equal(load_trace(folder / "paths.npz").receivers[2].position_m, stored)
        (run.folder / "model.npz").unlink()  # as if stopped
        np.testing.assert_allclose(resume(run.folder, record=record).predict(tx_pos_m, "lab").mean, before)


def located(record: Record, scene: Path) -> Receiver:
    """The third receiver as a model in a scene is given it."""
    problem = Problem(record, None, scene=str(scene), material="concrete" if scene.suffix else None)
    split = make_splits(record, "official")[0]
    return placed_problem(problem, split, MODELS["ray-tracing"]).record.receivers[2]


def test_estimates_in_a_scene_are_beneath_its_ceiling(room: Path) -> None:
    record, rows = unmapped(building(), "lab"), np.arange(TRAINED)
    # Estimated a metre above the rows, over the ceiling.
    high = replace(record, tx_pos_m=record.tx_pos_m + np.array([0, 0, 0.8]))
    assert placed(high, rows).receivers[2].position_m[2] > 2.7
    assert 2.1 < located(high, room).position_m[2] < 2.7


def test_estimates_beyond_the_outer_walls_of_a_scene_remain_there(room: Path) -> None:
    record = unmapped(building(), "lab")
    beyond_m = np.array([18.0, 4.0, 2.3])  # the wall is at 13 m
    record.observation[2] = -40 - 30 * np.log10(np.linalg.norm(record.tx_pos_m - beyond_m, axis=1))
    receiver = located(record, room)
    assert receiver.position_m[0] > 14
    assert (np.abs(receiver.position_m - beyond_m)[:2] < 2 * receiver.position_std_m[:2]).all()


def test_estimates_are_outside_of_solids_with_a_deviation_that_contains_the_move(tmp_path: Path) -> None:
    record, rows = unmapped(building(), "lab"), np.arange(TRAINED)
    before = placed(record, rows).receivers[2]
    box = trimesh.creation.box((1.0, 1.0, 9.0), trimesh.transformations.translation_matrix(before.position_m))
    box.export(tmp_path / "shaft.ply")
    after = located(record, tmp_path / "shaft.ply")
    shift_m = after.position_m - before.position_m
    np.testing.assert_allclose(np.linalg.norm(shift_m), 0.5, atol=0.06)
    np.testing.assert_allclose(
        after.position_std_m, np.hypot(before.position_std_m, shift_m), rtol=1e-3
    )  # heights in the box


@pytest.mark.parametrize(("model", "settings"), [("idw", ()), ("trees", ()), ("kriging", ("trend=constant",))])
def test_models_without_a_law_of_distance_do_not_wait_for_places(model, settings, tmp_path, monkeypatch):
    monkeypatch.setattr(receiver_places, "place_of_receiver", None)  # whose call would fail
    run = train(unmapped(building(), "lab"), model, out=tmp_path / "run", settings=settings, intervals=True)
    assert "receiver_places" not in run.metrics


def test_estimation_of_places_shows_progress(tmp_path: Path) -> None:
    shown: list[tuple[str, float]] = []

    def show(stage: str, share: float, *_: object) -> None:
        shown.append((stage, share))

    train(unmapped(building(), "hall", "lab"), "mri", out=tmp_path / "run", on_progress=show)
    assert [share for stage, share in shown if stage == "places of receivers"][:2] == [0.5, 1.0]


def test_a_receiver_in_a_scene_without_position_and_rows_is_refused(room: Path, tmp_path: Path) -> None:
    record = unmapped(building(cellar=(41, 42)), "cellar")
    with pytest.raises(InputError, match=r"receiver cellar unknown, without a training row in split official; give x"):
        train(record, "ray-tracing", out=tmp_path / "run", scene=room)
    with pytest.raises(InputError, match=r"receiver cellar unknown; give x, y, z, or wrf-mi train --scene"):
        correct_scene(room, record, make_splits(record, "official")[0])


@pytest.mark.usefixtures("undrawn")
def test_commands_take_receivers_without_positions_and_with_few_rows(tmp_path: Path, command: Command) -> None:
    office = write_ble_folder(tmp_path / "office", building(**SCARCE))
    lines = (office / "receivers.csv").read_text().splitlines()
    lines[1:4] = "hall,,,", "stairs,11.5,0.5,", "lab,,,2.5"
    (office / "receivers.csv").write_text("\n".join(lines) + "\n")
    heights = [receiver.position_m[2] for receiver in load(office).receivers]
    np.testing.assert_array_equal(heights[:3], [np.nan, np.nan, 2.5])
    run, heard = tmp_path / "run", {"hall": "-60", "stairs": "-70", "lab": "-65", "attic": "-80", "cellar": ""}
    out = command.done(["train", office, "--model", "kriging", "--out", run])
    assert "receivers with few training rows (number): attic (2), cellar (0)" in out
    assert "receiver stairs: position estimated at x 11.5 m as stated, y 0.5 m as stated, z" in out
    of_data = [["data", "info", office], ["data", "check", office]]
    for words in of_data + strength_commands(run, tmp_path, heard):
        command.done(words)
    again = load(write_ble_folder(tmp_path / "written", unmapped(building(), "lab")))
    assert [receiver.is_surveyed for receiver in again.receivers] == [True, True, False]
