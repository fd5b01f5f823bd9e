"""Receivers that a split holds out: hidden from fits, and scored alone."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import copied, without_seconds
from commands import arrays_in
from spectrum_records import make_record
from test_compare import captured

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.array_files import CHECKSUM
from wrf_mi.datasets import make_splits, write_ble_folder
from wrf_mi.estimators.held_out import held_out_predictions
from wrf_mi.estimators.model import Problem, Session, default_settings
from wrf_mi.models import MODELS
from wrf_mi.runs.api import evaluate_run, open_run, resume, train
from wrf_mi.runs.compare import compare
from wrf_mi.runs.results import read_run
from wrf_mi.runs.run import Run
from wrf_mi.scene.make import make_scene
from wrf_mi.tracing.tracer import fit_offsets
from wrf_mi.training.selection import HeldOut, hold_out

LAW_DBM, EXPONENT = -40.0, 2.5
ROUNDING_DB = 1e-4
"""Predictions are stored as float32."""


@pytest.fixture(scope="module")
def law() -> Record:
    """Signal strengths of four receivers that follow one path-loss law, but for an offset of each."""
    rng = np.random.default_rng(0)
    positions_m = rng.uniform(1, 5, (60, 3))
    places = np.array([[0.0, 0, 0], [6, 0, 1], [0, 6, 2], [6, 6, 0]])
    receivers = tuple(Receiver(f"anchor{k}", place, np.array([0.0, 0, 0, 1])) for k, place in enumerate(places))
    distance = np.linalg.norm(positions_m - places[:, None], axis=2)
    observation = LAW_DBM - 10 * EXPONENT * np.log10(distance) + np.array([-3.0, 1, 2, 9])[:, None]
    record_fields: dict[str, Any] = {
        "frequencies_hz": np.array([2.44e9]),
        "official": (np.arange(40), np.arange(40, 60)),
    }
    return Record("law", "rssi", positions_m, receivers, observation.astype(np.float32), **record_fields)


Fit = Callable[..., Run]


@pytest.fixture(scope="module")
def fitted(law: Record, tmp_path_factory: pytest.TempPathFactory) -> Fit:
    """Fits a model to the law's record with a split, once for all tests."""
    return cache(lambda model, split: train(law, model, out=tmp_path_factory.mktemp("runs") / "run", split=split))


def test_a_held_out_receiver_takes_the_law_of_the_others(law: Record, tmp_path: Path) -> None:
    folder = write_ble_folder(tmp_path / "law", law)
    run = train(folder, "mri", out=tmp_path / "run", split="receiver:3")
    results = read_run(run.folder)
    assert np.isnan(results.truth[:3]).all()
    assert np.isnan(results.prediction[:3]).all()
    np.testing.assert_array_equal(results.truth[3], law.observation[3, results.row])
    np.testing.assert_array_equal(results.prediction[3], results.references["law"][3])
    assert run.metrics["n_test"] == 20
    assert run.metrics["receivers"]["anchor3"]["n_test"] == 20
    # The mean offset of the three others, to which distances are not exactly alike, is 9 dB below.
    assert run.metrics["abs_error_db"]["median"] == pytest.approx(9, abs=1)
    assert evaluate_run(run.folder)["abs_error_db"] == run.metrics["abs_error_db"]
    assert train(folder, "mri", out=tmp_path / "all", split="receiver").metrics["n_test"] == 80


@pytest.mark.parametrize(
    ("name", "split"),
    [("mri", "receiver:3"), ("kriging", "receiver:3")]
    + [(name, "receiver+12:3") for name in ("kriging", "mri", "hybrid")],
)
def test_what_new_receivers_observed_changes_no_fit_but_in_rows_left(name, split, law, fitted, tmp_path):
    """The last receiver is held out, but for twelve rows in some cases."""
    left = make_splits(law, split)[0].left[:, 1]
    observation = law.observation.copy()
    hidden = np.setdiff1d(np.arange(40), left)
    observation[3, hidden] = 1e6 * (1 + hidden)
    expected = fitted(name, split)
    broken = train(replace(law, observation=observation), name, out=tmp_path / "broken", split=split)
    arrays, broken_arrays = (arrays_in(run.folder / "model.npz") for run in (expected, broken))
    for key in arrays:
        if not key.startswith("run/") and key != CHECKSUM:
            np.testing.assert_array_equal(
                without_seconds(broken_arrays[key]), without_seconds(arrays[key]), err_msg=key
            )
    np.testing.assert_array_equal(read_run(broken.folder).prediction, read_run(expected.folder).prediction)
    assert broken.metrics["reference"] == expected.metrics["reference"]


def test_a_common_law_with_offsets_is_stated_with_its_uncertainty(fitted: Fit) -> None:
    """The model's receivers share a law, and each has an offset of 4 dB a priori: 9 dB lie inside 90 % hardly."""
    inner, outer = (
        arrays_in(fitted("kriging", split).folder / "predictions.npz")["std"][3] for split in ("official", "receiver:3")
    )
    assert outer.mean() > inner.mean() + 1
    near, far = (fitted("kriging", split).metrics for split in ("receiver:1", "receiver:3"))
    assert near["inside_90"] == 1
    assert near["abs_error_db"]["median"] < far["abs_error_db"]["median"]


def test_the_hybrid_chooses_on_receivers_that_are_held_out(law: Record, fitted: Fit) -> None:
    """Offsets of the receivers are unlike: a law with an offset of each is as good as one law at a new receiver."""
    run = fitted("hybrid", "receiver:1")
    assert set(run.metrics["held_out"]) == {"kriging", "hybrid"}
    assert run.metrics["held_out"]["hybrid"] < 10  # an offset of 9 dB
    assert run.metrics["inside_90"] == 1
    results = read_run(run.folder)
    again = open_run(run.folder, law).predict(law.tx_pos_m[results.row], "anchor1")
    np.testing.assert_allclose(again.mean, results.prediction[1], atol=ROUNDING_DB)
    fold = hold_out(law, make_splits(law, "receiver:1")[0])
    assert fold is not None
    assert fold.held_receivers in ((1, 0), (1, 2), (1, 3))


def test_few_rows_at_a_new_receiver_give_its_offset(fitted: Fit) -> None:
    """Five rows: the offset of 9 dB is known; the distances, from the rows of the others."""
    few, error_db = fitted("kriging", "receiver+5:3"), lambda run: run.metrics["abs_error_db"]["median"]
    assert error_db(few) < 1 < 5 < error_db(fitted("kriging", "receiver:3"))
    assert few.metrics["receivers"]["anchor3"]["n_test"] == 20
    assert error_db(fitted("hybrid", "receiver+5:3")) < 1


def test_a_part_of_the_rows_left_to_new_receivers_is_held_out(law: Record) -> None:
    (split,) = make_splits(law, "receiver+12:3")
    record = law.seen(split)
    fold = hold_out(record, split)
    assert fold is not None
    held_out = HeldOut.of(record, fold, 0)
    (other,) = (receiver for receiver in fold.held_receivers if receiver != 3)
    assert (fold.left[:, 0] == other).sum() == 12
    training_pairs = {tuple(pair) for pair in fold.left.tolist()}
    assert not training_pairs & set(zip(held_out.receiver.tolist(), held_out.row.tolist(), strict=True))
    assert set(held_out.receiver.tolist()) == {3, other}
    left_rows = held_out.row[held_out.receiver == 3]
    assert set(left_rows) < set(split.left[:, 1])  # the others train


def test_held_out_predictions_are_those_of_their_receivers(law: Record, tmp_path: Path) -> None:
    """Two receivers a fold, in an order of its own: a prediction stands beside what its receiver observed."""
    places = np.concatenate([[receiver.position_m for receiver in law.receivers], [[3.0, 0, 1], [0, 3, 1], [3, 6, 1]]])
    receivers = tuple(replace(law.receivers[0], name=f"anchor{k}", position_m=place) for k, place in enumerate(places))
    distance = np.linalg.norm(law.tx_pos_m - places[:, None], axis=2)
    observed = (LAW_DBM - 10 * EXPONENT * np.log10(distance)).astype(np.float32)
    record = replace(law, receivers=receivers, observation=observed)
    entry, split = MODELS["mri"], make_splits(record, "receiver:0")[0]
    problem = Problem(record, default_settings(entry, (), {})).seen(split)
    fold = hold_out(problem.record, split)
    assert fold is not None
    assert len(fold.held_receivers) > 2
    fold = replace(fold, held_receivers=tuple(reversed(fold.held_receivers)))
    held_out = HeldOut.of(problem.record, fold, 0)
    predicted = held_out_predictions(entry, problem, fold, held_out, Session(tmp_path, tmp_path), "mri").mean
    np.testing.assert_allclose(predicted, held_out.observed(record), atol=0.05)  # one law without noise; dB


def test_intervals_of_any_model_at_new_receivers(law: Record, tmp_path: Path) -> None:
    run = train(law, "mri", out=tmp_path / "run", split="receiver", intervals=True)
    # Offsets of -3, 1, 2 and 9 dB: one receiver of three is held out, whose error says little of the fourth's.
    assert run.metrics["inside_90"] >= 0.5
    two = Split("two", 0, np.arange(40), np.zeros(0, np.int64), np.arange(40, 60), (0, 1, 2))
    with pytest.raises(InputError, match="one receiver trains; intervals at others need two at least"):
        train(law, "mri", out=tmp_path / "two", split=two, intervals=True)


def test_a_stopped_run_goes_on_without_the_held_out_receivers(law: Record, fitted: Fit, tmp_path: Path) -> None:
    finished = fitted("mri", "receiver:1")
    run = copied(finished.folder, tmp_path / "run")
    (run / "model.npz").unlink()
    (run / "metrics.json").unlink()
    assert resume(run, record=law).metrics["abs_error_db"] == finished.metrics["abs_error_db"]


def test_traced_strengths_take_the_mean_gain_or_offset(law: Record, tmp_path: Path) -> None:
    """In a hall around the receivers, of which one is held out."""
    (tmp_path / "layout.csv").write_text("x,y\n-3,-3\n9,-3\n9,9\n-3,9\n-3,-3\n")
    hall = make_scene(tmp_path / "layout.csv", tmp_path / "scene", height_m=8.0).folder
    traced: dict[str, Any] = {"model": "ray-tracing", "scene": hall, "split": "receiver:2"}
    plain = train(law, out=tmp_path / "run", settings=["depth=1"], **traced).folder
    offset_db = arrays_in(plain / "model.npz")["offsets/offset_db"]
    assert offset_db[2] == pytest.approx(offset_db[[0, 1, 3]].mean())
    settings = ["depth=1", "calibration=gain", "steps=40", "validate_every=20"]
    run = train(law, out=tmp_path / "calibrated", settings=settings, **traced).folder
    gain = [arrays_in(run / "model.npz")[f"params/receiver.anchor{k}.gain"] for k in range(4)]
    np.testing.assert_allclose(gain[2], np.mean([gain[0], gain[1], gain[3]], axis=0), rtol=1e-6)
    assert np.isfinite(read_run(run).prediction[2]).all()
    assert np.ptp([gain[k][0] for k in (0, 1, 3)]) > 0.3  # offsets of -3, 1 and 9 dB


def test_gaussians_are_seen_from_the_pose_of_a_new_receiver(law: Record, tmp_path: Path) -> None:
    """A copy of a trained receiver, held out: the same Gaussians from the same place, with the mean level of all."""
    receivers = (*law.receivers, replace(law.receivers[1], name="copy"))
    record = replace(law, receivers=receivers, observation=np.concatenate([law.observation, law.observation[1:2]]))
    split = replace(make_splits(law, "official")[0], held_receivers=(4,))
    settings = ["steps=20", "validate_every=10", "initial.gaussians=40", "network.layers=2", "network.width=16"]
    run = train(record, "wrf-gs+", out=tmp_path / "run", split=split, settings=settings)
    level = arrays_in(run.folder / "model.npz")["params/level"][0]
    assert level[4] == pytest.approx(level[:4].mean(), rel=1e-6)
    model = open_run(run.folder, record)
    clone, original = (model.predict(law.tx_pos_m[40:], receiver).mean for receiver in ("copy", "anchor1"))
    np.testing.assert_allclose(clone - original, 20 / np.log(10) * (level[4] - level[1]), atol=1e-2)
    broken = np.where(np.arange(5)[:, None] == 4, 1e6, record.observation).astype(np.float32)
    record = replace(record, observation=broken)
    again = train(record, "wrf-gs+", out=tmp_path / "broken", split=split, settings=settings)
    np.testing.assert_allclose(arrays_in(again.folder / "model.npz")["params/level"][0], level, rtol=1e-3)


def test_offsets_of_receivers_that_heard_nothing() -> None:
    traced = np.array([[-50.0, -60], [-50, -60], [-50, np.nan]])
    offsets = fit_offsets(traced, [[-53.0, -63], [np.nan, np.nan], [-59.0, -80]])
    np.testing.assert_allclose(offsets.offset_db, [-3, -6, -9])
    np.testing.assert_allclose(offsets.floor_dbm, [-63, -80, -80])
    with pytest.raises(InputError, match="receiver 0: no training row is both received and reached"):
        fit_offsets([[np.nan], [-50.0]], [[-53.0], [-50.0]])


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if not model.new_receivers])
def test_models_of_trained_receivers_refuse(name: str, law: Record, tmp_path: Path) -> None:
    if MODELS[name].serves("rssi") and MODELS[name].scene != "required":
        with pytest.raises(InputError, match=f"receiver:0: {name.replace('+', '.')} predicts for the receivers it is"):
            train(law, name, out=tmp_path / "run", split="receiver")
        assert not (tmp_path / "run").exists()


def test_kriging_of_each_receiver_alone_refuses_receivers_without_rows(law: Record, tmp_path: Path) -> None:
    for record, settings in ((replace(law, frequencies_hz=None), ()), (law, ("generic=true",))):
        with pytest.raises(InputError, match=r"split receiver:3: kriging of each receiver alone.*; choose mri"):
            train(record, "kriging", out=tmp_path / "run", split="receiver:3", settings=settings)
        assert not (tmp_path / "run").exists()
    few = train(law, "kriging", out=tmp_path / "few", split="receiver+5:3", settings=("generic=true",))
    assert few.metrics["receivers"]["anchor3"]["n_test"] == 20


def test_receivers_of_spectra_are_not_held_out(tmp_path: Path) -> None:
    record = make_record(gateways=2)
    with pytest.raises(InputError, match="holds spectrum; split receiver:0 serves signal strengths, so choose another"):
        train(record, "kriging", out=tmp_path / "run", split="receiver")


def test_all_receivers_held_out_are_refused(law: Record, tmp_path: Path) -> None:
    rows = np.arange(40), np.zeros(0, np.int64), np.arange(40, 60)
    for held_receivers in ((0, 1, 2, 3), (4,)):
        with pytest.raises(InputError, match=r"split mine holds out receivers .* of 4; leave some to train on"):
            train(law, "mri", out=tmp_path / "run", split=Split("mine", 0, *rows, held_receivers))


def test_pictures_of_a_comparison_show_the_receivers_that_were_held_out(fitted, tmp_path, monkeypatch):
    maps = captured(monkeypatch, "position_table")
    compare([fitted("mri", "receiver:3").folder], tmp_path / "compare")
    shown = [[name for name, _ in rows] for rows, *_ in maps]
    assert ["anchor3"] in shown
    assert not any("anchor0" in names for names in shown)
