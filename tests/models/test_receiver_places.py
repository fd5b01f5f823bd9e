"""Receivers at unknown places are located by their training rows, and every model of strengths runs."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from calling import call, strength_commands
from made_building import FITS, TRAINED, building
from made_walls import heard_through_walls

from wrf_mi.core import InputError, Receiver, Record
from wrf_mi.datasets import load, make_splits, write_ble_folder
from wrf_mi.estimators import receiver_places
from wrf_mi.estimators.receiver_places import place_of_receiver, placed, placed_problem
from wrf_mi.models import MODELS, Problem
from wrf_mi.runs.api import open_run, resume, train
from wrf_mi.scene.make import make_scene
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tracing import load_trace

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
        *heard, place_m = heard_through_walls(seed)
        found_m, std_m = place_of_receiver(*heard, UNKNOWN_M)
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


@pytest.mark.parametrize("model", FITS)
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
        known = train(building(cellar=(41, 42)), model, out=tmp_path / "known", settings=settings, intervals=intervals)
        assert run.metrics["abs_error_db"]["mean"] - known.metrics["abs_error_db"]["mean"] < 0.5


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


@pytest.mark.parametrize(("model", "split"), [("ray-tracing", "none"), ("hybrid", "official")])
def test_a_scene_is_traced_to_estimated_places(model: str, split: str, room: Path, tmp_path: Path) -> None:
    record = unmapped(building(), "lab")
    run = train(record, model, out=tmp_path / "run", scene=room, split=split)
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
def test_models_without_a_law_of_distance_do_not_wait_for_places(
    model: str, settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_commands_take_a_folder_without_positions(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    office = write_ble_folder(tmp_path / "office", building())
    (office / "receivers.csv").write_text("id,x,y,z\nhall,,,\nstairs,11.5,0.5,\nlab,,,2.5\n")
    heights = [receiver.position_m[2] for receiver in load(office).receivers]
    np.testing.assert_array_equal(heights, [np.nan, np.nan, 2.5])
    run, heard = tmp_path / "run", {"hall": "-60", "stairs": "-70", "lab": "-65"}
    status, out, _ = call(["train", office, "--model", "kriging", "--out", run], capsys)
    assert status == 0
    assert "receiver stairs: position estimated at x 11.5 m as stated, y 0.5 m as stated, z" in out
    of_data = [["data", "info", office], ["data", "check", office]]
    for command in of_data + strength_commands(run, tmp_path, heard):
        status, _, err = call(command, capsys)
        assert status == 0, (command, err)
    again = load(write_ble_folder(tmp_path / "written", unmapped(building(), "lab")))
    assert [receiver.is_surveyed for receiver in again.receivers] == [True, True, False]
