"""Fits of small fields to spectra that a known field made: whole runs, stopped ones, broken ones."""

from __future__ import annotations

import gc
import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from made_spectra import RECEIVERS, SIZE, small_field, spectra, true_field

from wrf_mi.backend import init

init()

import drjit as dr  # noqa: E402

from wrf_mi.baselines.idw import InverseDistance  # noqa: E402
from wrf_mi.core import InputError, Receiver, Record, Split, rotation_matrix  # noqa: E402
from wrf_mi.field import FIELDS, random_gaussians  # noqa: E402
from wrf_mi.fit.config import TrainConfig, with_settings  # noqa: E402
from wrf_mi.fit.device import to_float  # noqa: E402
from wrf_mi.fit.folder import load_predictor, read_checkpoint  # noqa: E402
from wrf_mi.fit.predictor import Predictor  # noqa: E402
from wrf_mi.fit.state import FitState  # noqa: E402
from wrf_mi.fit.trainer import NumericsError, Progress, Trainer  # noqa: E402
from wrf_mi.measure import load_split, make_splits, write_spectrum_folder  # noqa: E402
from wrf_mi.report.metrics import ssim  # noqa: E402
from wrf_mi.report.runs import Interrupted, Run, evaluate_run, resume, train  # noqa: E402

PARALLEL_TOLERANCE = 1e-3
"""Greys of two runs on several threads after 40 steps: sums of gradients differ in their last digit, 1e-7, and Adam
divides by their size; what was seen is 3e-7."""
FLOAT32_TOLERANCE = 1e-4
"""Greys of one field computed on two ways: float32 rounding, and footprints' cut-off, which is worth 0.01."""
RECOVERED = 0.97
"""Median similarity on transmitters never trained on. The nearest-neighbour blend stays below 0.91 there."""

QUICK = (
    "initial.gaussians=8",
    "initial.size_deg=15",
    "optimiser.warm_up=5",
    "optimiser.averaging=0.9",
    "density.every=0",
    "log_every=5",
    "validate_every=20",
)
"""Eight Gaussians in all tests, so that most find their kernels compiled."""


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    """Deterministic fits leave the process on one thread."""
    before = dr.thread_count()
    yield
    dr.set_thread_count(before)


@pytest.fixture(scope="module")
def two_gateways() -> Record:
    return spectra(receivers=2)[0]


@pytest.fixture(scope="module")
def one_gateway(two_gateways: Record) -> Record:
    return replace(two_gateways, receivers=RECEIVERS[:1], observation=two_gateways.observation[:1])


@pytest.fixture(scope="module")
def folder(one_gateway: Record, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_spectrum_folder(tmp_path_factory.mktemp("data") / "made-here", one_gateway, bits=16)


def settings(*own: str, model: str = "wrf-gs+") -> TrainConfig:
    return with_settings(TrainConfig(model=model), [*QUICK, *own])


def official(record: Record) -> Split:
    return make_splits(record, "official")[0]


def log_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]


def stop_after(steps: int) -> Callable[[], bool]:
    """A ``stop``, which is asked after each step but a run's last, that says yes when asked so often."""
    asked = iter(range(1, steps + 1))
    return lambda: next(asked) >= steps


@pytest.mark.parametrize("model", FIELDS)
def test_loss_falls_and_similarity_rises(model: str, one_gateway: Record) -> None:
    heard: list[Progress] = []
    split = official(one_gateway)
    trainer = Trainer(one_gateway, split, settings("steps=120", "hold_out=0.5", "validate_every=40", model=model))
    assert trainer.run(heard.append)
    assert [p.step for p in heard] == list(range(5, 121, 5))
    assert heard[-1].loss < 0.8 * heard[0].loss
    scores = [p.validation_ssim for p in heard if p.validation_ssim is not None]
    assert len(scores) == 3
    assert scores[-1] > scores[0] + 0.05
    assert [p.held_out for p in heard] == [p.step <= 60 for p in heard]
    assert all(a.seconds < b.seconds and a.left_s > b.left_s for a, b in zip(heard[:2], heard[-2:], strict=True))
    # What training calls its score is what scikit-image says of the same predictions.
    rows = split.validation
    expected = np.median(ssim(trainer.predictor()(one_gateway.tx_pos_m[rows]), one_gateway.observation[0, rows]))
    assert scores[-1] == pytest.approx(expected, abs=1e-5)


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    arrays = read_checkpoint(path)
    del arrays["seconds"]
    return arrays


RESUMED = (
    "steps=40",
    "checkpoint_every=8",
    "density.every=12",
    "density.start=0",
    "density.stop=1",
    "density.grow=0.3",
)


def stopped_and_resumed(folder: Path, out: Path, config: TrainConfig, at: int) -> None:
    with pytest.raises(Interrupted, match=rf"stopped after step {at} of 40; .* train --resume {out}"):
        train(folder, out, config, stop=stop_after(at))
    assert not (out / "metrics.json").exists()
    assert int(read_checkpoint(out)["step"]) == at
    assert [entry["step"] for entry in log_of(out)] == [s for s in range(5, 41, 5) if s <= at]
    resume(out)


def test_resumed_run_is_the_same_bit_for_bit(folder: Path, tmp_path: Path) -> None:
    """Stopped after a round of density control, and once more between two; parameters, moments, mean, scores."""
    config = settings(*RESUMED, "deterministic=true")
    train(folder, tmp_path / "whole", config)
    stopped_and_resumed(folder, tmp_path / "resumed", config, 17)
    whole, resumed = arrays_of(tmp_path / "whole"), arrays_of(tmp_path / "resumed")
    assert set(whole) == set(resumed)
    for name, values in whole.items():
        np.testing.assert_array_equal(resumed[name], values, err_msg=name)
    assert whole["param/position"].shape[1] > 8
    scores = [Run(tmp_path / name).metrics for name in ("whole", "resumed")]
    assert scores[0]["ssim"] == scores[1]["ssim"]
    assert [e["step"] for e in log_of(tmp_path / "resumed")] == list(range(5, 41, 5))
    for a, b in zip(log_of(tmp_path / "whole"), log_of(tmp_path / "resumed"), strict=True):
        assert a["validation_ssim"] == b["validation_ssim"]
        if a["step"] != 20:  # the mean loss over 16 to 20, of which the resumed run saw 18 to 20
            assert a["loss"] == b["loss"]


def test_resumed_run_on_several_threads_is_close(folder: Path, tmp_path: Path) -> None:
    dr.set_thread_count(max(2, dr.thread_count()))
    config = settings("steps=40", "checkpoint_every=8")
    train(folder, tmp_path / "whole", config)
    stopped_and_resumed(folder, tmp_path / "resumed", config, 17)
    greys = [np.load(tmp_path / name / "predictions.npz")["prediction"] for name in ("whole", "resumed")]
    np.testing.assert_allclose(greys[0], greys[1], atol=PARALLEL_TOLERANCE)


class PowerCut(BaseException):
    """Ends a run where it stands."""


def test_killed_run_goes_on_from_its_last_checkpoint(folder: Path, tmp_path: Path) -> None:
    """Lines logged after that checkpoint are not there twice."""
    config = settings("steps=40", "checkpoint_every=8", "deterministic=true")

    def kill(fold: str, steps: int, progress: Progress) -> None:
        if progress.step == 30:
            raise PowerCut

    with pytest.raises(PowerCut):
        train(folder, tmp_path / "killed", config, listen=kill)
    assert int(read_checkpoint(tmp_path / "killed")["step"]) == 24
    assert log_of(tmp_path / "killed")[-1]["step"] == 30
    resume(tmp_path / "killed")
    assert [e["step"] for e in log_of(tmp_path / "killed")] == list(range(5, 41, 5))
    train(folder, tmp_path / "whole", config)
    for name, values in arrays_of(tmp_path / "whole").items():
        np.testing.assert_array_equal(arrays_of(tmp_path / "killed")[name], values, err_msg=name)


def test_run_stopped_before_its_first_checkpoint_starts_anew(folder: Path, tmp_path: Path) -> None:
    def kill(fold: str, steps: int, progress: Progress) -> None:
        raise PowerCut

    with pytest.raises(PowerCut):
        train(folder, tmp_path / "run", settings("steps=10"), listen=kill)
    assert not (tmp_path / "run" / "checkpoint.npz").exists()
    with pytest.raises(InputError, match=r"no checkpoint\.npz, the run was stopped early"):
        load_predictor(tmp_path / "run")
    resume(tmp_path / "run")
    assert [e["step"] for e in log_of(tmp_path / "run")] == [5, 10]


def test_finished_run_is_only_scored_again(folder: Path, tmp_path: Path) -> None:
    before = train(folder, tmp_path / "run", settings("steps=10")).metrics
    arrays = arrays_of(tmp_path / "run")
    (tmp_path / "run" / "metrics.json").unlink()
    after = resume(tmp_path / "run").metrics
    assert after["ssim"] == before["ssim"]
    for name, values in arrays_of(tmp_path / "run").items():
        np.testing.assert_array_equal(values, arrays[name])


def test_run_folder_says_all(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = train(folder, tmp_path / "run", settings("steps=10", "seed=3"), split="random", n_train=0.5)
    assert sorted(p.name for p in run.folder.iterdir()) == [
        "checkpoint.npz",
        "config.yaml",
        "log.jsonl",
        "metrics.json",
        "predictions.npz",
        "split.npz",
    ]
    config = yaml.safe_load((run.folder / "config.yaml").read_text())
    assert (config["dataset"], config["split"], config["n_train"], config["seed"]) == (str(folder), "random", 0.5, 3)
    assert config["settings"]["initial"]["gaussians"] == 8
    assert {"wrf-mi", "mitsuba", "drjit", "numpy", "backend"} <= set(config["versions"])
    split = load_split(run.folder / "split.npz")
    assert len(split.all_train) == 10
    m = run.metrics
    assert (m["task"], m["model"], m["split"], m["n_train"], m["n_test"]) == ("spectrum", "wrf-gs+", "random", 10, 5)
    assert set(m["ssim"]) == set(m["reference"]["idw4"]) == {"median", "mean", "p10", "p90"}
    assert m["train_seconds"] > 0
    assert m["ms_per_sample"] > 0
    assert m["peak_memory_mb"] > 50
    assert "receivers" not in m
    with np.load(run.folder / "predictions.npz") as stored:
        np.testing.assert_array_equal(stored["row"], split.test)
        np.testing.assert_array_equal(stored["tx_pos"], one_gateway.tx_pos_m[split.test])
        assert stored["prediction"].shape == (5, *SIZE)
        # 16 bits a grey.
        np.testing.assert_allclose(stored["truth"], one_gateway.observation[0, split.test], atol=1e-5)
        median = float(np.median(ssim(stored["prediction"], stored["truth"])))
    assert m["ssim"]["median"] == pytest.approx(median)
    # The stored field predicts what was scored.
    with np.load(run.folder / "predictions.npz") as stored:
        again = run.predictor()(one_gateway.tx_pos_m[split.test])
        np.testing.assert_allclose(again, stored["prediction"], atol=FLOAT32_TOLERANCE)


def test_density_rounds_within_a_run(one_gateway: Record) -> None:
    heard: list[Progress] = []
    own = (
        "steps=100", "density.every=10", "density.start=0", "density.stop=0.4", "density.grow=0.5", "density.most=20"
    )  # fmt: skip
    trainer = Trainer(one_gateway, official(one_gateway), settings(*own))
    trainer.run(heard.append)
    # 8, 12, 18, then no more than 20; unseen Gaussians may have been removed meanwhile.
    counts = {p.step: p.gaussians for p in heard}
    assert counts[5] == 8
    assert counts[10] > 8
    assert 12 < counts[100] <= 20
    assert counts[40] == counts[100]
    # Growth disturbs what was learned; after the last round it is learned again.
    losses = {p.step: p.loss for p in heard}
    assert losses[100] < 0.9 * losses[45]
    # The recordings are those for this number of Gaussians: a new predictor of the same parameters agrees.
    tx = one_gateway.tx_pos_m[:2]
    again = Predictor(trainer.field, trainer.state.mean_params(), RECEIVERS[:1], *SIZE)
    np.testing.assert_allclose(trainer.predictor()(tx), again(tx), atol=FLOAT32_TOLERANCE)


def test_a_round_that_changes_nothing_changes_nothing(one_gateway: Record) -> None:
    """Parameters, momentum and mean go through a round and a new recording as they are."""
    states = []
    for own in ("density.every=0", "density.every=10"):
        config = settings(
            "steps=30", "deterministic=true", own, "density.start=0", "density.stop=1", "density.grow=0"
        )  # fmt: skip
        trainer = Trainer(one_gateway, official(one_gateway), config)
        trainer.run()
        states.append(trainer.state.arrays())
    for name, values in states[0].items():
        if not name.startswith("urge"):
            np.testing.assert_array_equal(states[1][name], values, err_msg=name)


def test_opacity_reset_within_a_run(one_gateway: Record) -> None:
    """Opacities right after the reset, before a step changes them."""
    own = ("steps=11", "density.every=10", "density.start=0", "density.stop=1", "density.grow=0", "initial.opacity=0.5")
    trainer = Trainer(one_gateway, official(one_gateway), settings(*own, "density.reset_every=1"))
    trainer.run(stop=stop_after(10))
    opacity = 1 / (1 + np.exp(-trainer.state.params()["opacity"]))
    np.testing.assert_allclose(opacity, 0.05, rtol=1e-5)


def test_two_gateways_are_scored_each_and_together(two_gateways: Record, tmp_path: Path) -> None:
    data = write_spectrum_folder(tmp_path / "data", two_gateways, bits=16)
    run = train(data, tmp_path / "run", settings("steps=20"))
    m = run.metrics
    assert list(m["receivers"]) == ["gateway1", "gateway2"]
    with np.load(run.folder / "predictions.npz") as stored:
        prediction, truth = stored["prediction"], stored["truth"]
        assert list(stored["receiver_name"]) == ["gateway1", "gateway2"]
    assert prediction.shape == truth.shape == (2, 5, *SIZE)
    scores = ssim(prediction, truth)
    assert m["ssim"]["mean"] == pytest.approx(scores.mean())
    for r, name in enumerate(m["receivers"]):
        assert m["receivers"][name]["ssim"]["median"] == pytest.approx(np.median(scores[r]))
        assert set(m["receivers"][name]["reference"]["idw4"]) == {"median", "mean", "p10", "p90"}
    predictor = run.predictor()
    assert [r.name for r in predictor.receivers] == ["gateway1", "gateway2"]
    tx = two_gateways.tx_pos_m[load_split(run.folder / "split.npz").test]
    for r in range(2):
        np.testing.assert_allclose(predictor(tx, r), prediction[r], atol=FLOAT32_TOLERANCE)


def test_a_truth_that_is_not_a_number_is_reported(one_gateway: Record) -> None:
    broken = replace(one_gateway, observation=one_gateway.observation.copy())
    split = official(broken)
    row = split.train[3]
    broken.observation[0, row, 4, 5] = np.nan
    trainer = Trainer(broken, split, settings("steps=40"))
    with pytest.raises(NumericsError, match="not finite") as caught:
        trainer.run()
    assert "\n" not in str(caught.value)
    # Steps on that row were not taken; nothing has spread.
    for group in (trainer.state.params(), trainer.state.mean_params(), *trainer.state.moments()[:2]):
        for name, values in group.items():
            assert np.isfinite(values).all(), name
    assert np.isfinite(trainer.state.urge.numpy()).all()
    reached = int(trainer.schedule.rows[:, 0].tolist().index(row)) + 1
    assert reached <= trainer.state.step < reached + 5  # found at the next line of the log


def test_parameters_that_are_not_numbers_are_named(one_gateway: Record) -> None:
    trainer = Trainer(one_gateway, official(one_gateway), settings("steps=5"))
    params = trainer.state.params()
    params["signal"][0, 2] = np.inf
    trainer.state = FitState(params)
    with pytest.raises(NumericsError, match="step 5: parameters not finite: signal"):
        trainer.run()


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(folder, tmp_path_factory.mktemp("runs") / "finished", settings("steps=10"), n_train=10).folder


def copy_of(run: Path, to: Path) -> Path:
    to.mkdir()
    for file in run.iterdir():
        (to / file.name).write_bytes(file.read_bytes())
    return to


def test_damaged_checkpoints(finished: Path, tmp_path: Path) -> None:
    run = copy_of(finished, tmp_path / "run")
    path = run / "checkpoint.npz"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no archive"):
        path.write_bytes(content)
        for use in (load_predictor, resume, evaluate_run):
            with pytest.raises(InputError, match=r"checkpoint\.npz: not readable") as caught:
                use(run)
            assert "\n" not in str(caught.value)
    path.write_bytes(whole)
    with np.load(path) as stored:
        arrays = dict(stored)
    np.savez(path, **(arrays | {"format": np.asarray(99)}))
    with pytest.raises(InputError, match="format 99, this version reads 1"):
        load_predictor(run)
    path.unlink()
    with pytest.raises(InputError, match=r"no checkpoint\.npz"):
        load_predictor(run)


def test_damaged_configurations(finished: Path, tmp_path: Path) -> None:
    run = copy_of(finished, tmp_path / "run")
    path = run / "config.yaml"
    for content in ("settings: [1", "just text", "", "dataset: x\n"):
        path.write_text(content)
        with pytest.raises(InputError, match=r"config\.yaml: not readable") as caught:
            resume(run)
        assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"no config\.yaml, so not a run folder"):
        resume(tmp_path)


def test_scores_are_found_again(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = copy_of(finished, tmp_path / "run")
    before = json.loads((run / "metrics.json").read_text())
    (run / "predictions.npz").unlink()
    after = evaluate_run(run)
    assert after.keys() == before.keys()
    for key in before.keys() - {"ms_per_sample", "ssim", "reference"}:
        assert after[key] == before[key], key
    for key in ("median", "mean", "p10", "p90"):
        assert after["ssim"][key] == pytest.approx(before["ssim"][key], abs=1e-5)
    assert (run / "predictions.npz").exists()
    assert json.loads((run / "metrics.json").read_text()) == after


def test_scores_on_another_split_leave_out_what_was_trained_on(finished: Path, one_gateway: Record) -> None:
    before = (finished / "metrics.json").read_bytes()
    split, other = load_split(finished / "split.npz"), make_splits(one_gateway, "random")[0]
    unseen = np.setdiff1d(other.test, split.all_train)
    assert 0 < len(unseen) < len(other.test)
    scores = evaluate_run(finished, "random")
    assert scores["n_test"] == len(unseen)
    assert scores["split"] == "random (rows unseen by official)"
    assert (finished / "metrics.json").read_bytes() == before


def test_no_unseen_row(finished: Path) -> None:
    split = load_split(finished / "split.npz")
    own = Split("rest", 0, split.train, split.validation, split.train[:1])
    np.testing.assert_array_equal(np.setdiff1d(own.test, own.all_train), [])
    with pytest.raises(InputError, match="no such fold"):
        evaluate_run(finished, "blocked:7")


def test_unfinished_runs_have_no_scores(folder: Path, tmp_path: Path) -> None:
    """Metrics mark a run as finished."""
    with pytest.raises(Interrupted):
        train(folder, tmp_path / "run", settings("steps=40"), stop=stop_after(10))
    with pytest.raises(InputError, match="run: stopped after step 10 of 40; finish it with train --resume"):
        evaluate_run(tmp_path / "run")
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_damaged_metrics_are_written_anew(finished: Path, tmp_path: Path) -> None:
    run = copy_of(finished, tmp_path / "run")
    before = json.loads((run / "metrics.json").read_text())
    for content in ("{", "[]", ""):
        (run / "metrics.json").write_text(content)
        after = evaluate_run(run)
        assert json.loads((run / "metrics.json").read_text()) == after
        assert after["train_seconds"] == before["train_seconds"]
        assert after["gaussians"] == before["gaussians"]
        assert after.keys() == before.keys()


def test_rows_that_the_record_has_not(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    """Reading beyond the data would give anything."""
    split = official(one_gateway)
    for own in (replace(split, train=np.append(split.train, 24)), replace(split, test=np.array([-1]))):
        with pytest.raises(InputError, match=r"split official: row (24|-1), but made-here has rows 0 to 23"):
            train(one_gateway, tmp_path / "run", settings("steps=5"), split=own)
    assert not (tmp_path / "run").exists()
    # A data set that has become shorter since.
    run = copy_of(finished, tmp_path / "copy")
    short = replace(
        one_gateway, tx_pos_m=one_gateway.tx_pos_m[:20], observation=one_gateway.observation[:, :20],
        official=None, folds=None,
    )  # fmt: skip
    data = write_spectrum_folder(tmp_path / "short", short)
    config = yaml.safe_load((run / "config.yaml").read_text()) | {"dataset": str(data)}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    for use in (resume, evaluate_run):
        with pytest.raises(InputError, match=r"split\.npz: row 2., but short has rows 0 to 19"):
            use(run)


def test_blocked_run_pools_its_folds(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = train(folder, tmp_path / "run", settings("steps=5"), split="blocked")
    m = run.metrics
    assert (m["split"], m["n_train"], m["n_test"]) == ("blocked", 16, 24)
    parts = [Run(run.folder / f"fold{k}").metrics for k in range(3)]
    assert [p["split"] for p in parts] == ["blocked:0", "blocked:1", "blocked:2"]
    assert m["train_seconds"] == pytest.approx(sum(p["train_seconds"] for p in parts))
    with np.load(run.folder / "predictions.npz") as stored:
        assert sorted(stored["row"]) == list(range(24))
        scores = ssim(stored["prediction"], stored["truth"])
        folds = one_gateway.folds[stored["row"]]
    assert m["ssim"]["median"] == pytest.approx(np.median(scores))
    for k, part in enumerate(parts):
        assert part["ssim"]["mean"] == pytest.approx(scores[folds == k].mean())
    again = evaluate_run(run.folder)
    assert again["ssim"]["median"] == pytest.approx(m["ssim"]["median"], abs=1e-5)
    assert again["train_seconds"] == m["train_seconds"]
    with pytest.raises(InputError, match="every row is held out in one of its folds"):
        evaluate_run(run.folder, "random")
    with pytest.raises(InputError, match="one field for each block; choose one"):
        run.predictor()
    assert Run(run.folder / "fold1").predictor()(one_gateway.tx_pos_m[:1]).shape == (1, *SIZE)


def test_blocked_run_goes_on_in_the_fold_where_it_was_stopped(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(Interrupted, match=rf"stopped after step 4 of 5; .* train --resume {tmp_path / 'run'}"):
        train(folder, tmp_path / "run", settings("steps=5"), split="blocked", stop=stop_after(8))
    assert (tmp_path / "run" / "fold0" / "metrics.json").exists()
    assert not (tmp_path / "run" / "fold1" / "metrics.json").exists()
    with pytest.raises(InputError, match="fold1: stopped after step 4 of 5; finish it with train --resume"):
        evaluate_run(tmp_path / "run")
    m = resume(tmp_path / "run").metrics
    assert m["n_test"] == 24
    assert [e["step"] for e in log_of(tmp_path / "run" / "fold1")] == [5]


def test_folders_that_hold_something_are_left_alone(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("mine")
    for split in ("official", "blocked"):
        with pytest.raises(InputError, match="exists and is not empty"):
            train(folder, tmp_path / "run", settings("steps=5"), split=split)
    assert [p.name for p in (tmp_path / "run").iterdir()] == ["mine.txt"]
    with pytest.raises(InputError, match="exists and is not empty"):
        train(folder, tmp_path / "run" / "mine.txt", settings("steps=5"))


def test_rows_of_ones_own_train(one_gateway: Record, tmp_path: Path) -> None:
    """A record in memory and a split by hand, without validation rows."""
    split = Split("mine", 0, np.arange(10), np.arange(0), np.arange(20, 24))
    run = train(one_gateway, tmp_path / "run", settings("steps=5"), split=split)
    assert (run.metrics["split"], run.metrics["n_train"], run.metrics["n_test"]) == ("mine", 10, 4)
    # Standard JSON knows no NaN.
    for name in ("log.jsonl", "metrics.json"):
        assert "NaN" not in (run.folder / name).read_text()


def still(params: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Parameters of a WRF-GS+ whose network says nothing: the same field for all transmitters."""
    heads = ("deform.signal.", "deform.rotation.", "deform.scale.")
    return {k: np.zeros_like(v) if k.startswith(heads) else v for k, v in params.items()}


def product(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Quaternion product q p, order x, y, z, w."""
    v, w = np.cross(q[:3], p[:3]) + q[3] * p[:3] + p[3] * q[:3], q[3] * p[3] - q[:3] @ p[:3]
    return np.append(v, w)


def test_only_the_pose_between_field_and_receiver_counts() -> None:
    """Field and receiver moved and turned together give the same spectrum."""
    field, params = true_field("wrf-gs+")
    params = still(params)
    rng = np.random.default_rng(3)
    params["rotation"] = rng.standard_normal(params["rotation"].shape).astype(np.float32)
    turn, shift = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5]), np.array([3.0, -2.0, 5.0])
    before = Receiver("a", np.array([0.1, 0.2, -0.1]), np.array([0.0, 0.6, 0.0, 0.8]))
    after = Receiver("b", rotation_matrix(turn) @ before.position_m + shift, product(turn, before.orientation_xyzw))
    moved = params | {
        "position": (rotation_matrix(turn) @ params["position"] + shift[:, None]).astype(np.float32),
        "rotation": np.stack([product(turn, q) for q in params["rotation"].T], axis=1).astype(np.float32),
    }
    tx = np.zeros((1, 3))
    expected = Predictor(field, params, [before], *SIZE)(tx)
    assert expected.max() > 0.1
    np.testing.assert_allclose(Predictor(field, moved, [after], *SIZE)(tx), expected, atol=FLOAT32_TOLERANCE)


def test_predictor_of_other_receivers_and_sizes() -> None:
    field, params = true_field("wrf-gs")
    tx = np.random.default_rng(5).uniform(-1, 1, (3, 3))
    both = Predictor(field, params, RECEIVERS, *SIZE)
    for r, receiver in enumerate(RECEIVERS):
        alone = Predictor(field, params, [receiver], *SIZE)(tx)
        np.testing.assert_array_equal(both(tx, r), alone)
        # Pixels are points: twice the size has the same directions at every other pixel.
        double = Predictor(field, params, [receiver], 2 * SIZE[0], 2 * SIZE[1])(tx)
        np.testing.assert_allclose(double[:, ::2, ::2], alone, atol=FLOAT32_TOLERANCE)
    assert np.abs(both(tx, 0) - both(tx, 1)).max() > 0.01
    # One by one or together.
    np.testing.assert_array_equal(np.concatenate([both(t[None], 0) for t in tx]), both(tx, 0))


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        (np.zeros(3), r"expected shape \[m, 3\], got \[3\]"),
        (np.zeros((2, 4)), r"expected shape \[m, 3\], got \[2, 4\]"),
        (np.array([[0, 0, 0], [0, np.nan, 0]]), "row 2: not a finite number"),
    ],
)
def test_positions_that_cannot_be_predicted(positions: np.ndarray, message: str) -> None:
    field, params = true_field("wrf-gs+")
    with pytest.raises(InputError, match=message):
        Predictor(field, params, RECEIVERS, *SIZE)(positions)


@pytest.mark.parametrize("model", FIELDS)
def test_nothing_is_compiled_after_the_first_steps(model: str, two_gateways: Record) -> None:
    """Twenty further steps, at either receiver, run kernels that are there already, from one recording."""
    own = ("steps=40", "log_every=1000", "validate_every=1000")
    trainer = Trainer(two_gateways, official(two_gateways), settings(*own, model=model))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):  # a recording belongs to such flags
        trainer.run(stop=stop_after(10))
        recordings = trainer._step.n_recordings
        dr.kernel_history_clear()
        trainer.run(stop=stop_after(20))
        history = dr.kernel_history([dr.KernelType.JIT])
    assert trainer.state.step == 30
    assert len(history) >= 20
    assert [entry["hash"] for entry in history if not entry["cache_hit"]] == []
    assert trainer._step.n_recordings == recordings


def test_predictions_are_recorded_once(one_gateway: Record) -> None:
    """For one transmitter or many, before training and after."""
    trainer = Trainer(one_gateway, official(one_gateway), settings("steps=5"))
    predictor = trainer.predictor()
    before = predictor(one_gateway.tx_pos_m[:3])
    trainer.run()
    assert trainer.predictor() is predictor
    after = predictor(one_gateway.tx_pos_m[:3])
    assert np.abs(after - before).max() > 0
    assert predictor._predict.n_recordings <= 2  # new ones for other memory layouts are no harm


def test_every_part_can_be_replaced(one_gateway: Record) -> None:
    """A model, starting values and a loss of one's own."""
    rng = np.random.default_rng(0)
    start = random_gaussians(RECEIVERS[:1], 8, rng, size_deg=20.0)
    calls = []

    def squares(prediction: Any, truth: Any, batch: int, height: int, width: int) -> Any:
        calls.append((batch, height, width))
        return dr.mean(dr.square(prediction - truth))

    heard: list[Progress] = []
    config = settings("steps=1", "batch=2", "log_every=1", "hold_out=1")
    split = official(one_gateway)
    trainer = Trainer(one_gateway, split, config, field=small_field("wrf-gs"), initial=start, loss=squares)
    np.testing.assert_allclose(trainer.state.params()["position"].T, start.position_m, rtol=1e-6)
    rows = trainer.schedule.rows[0]
    greys = trainer.predictor()(one_gateway.tx_pos_m[rows])
    trainer.run(heard.append)
    assert calls == [(2, *SIZE)]
    expected = np.mean((greys - one_gateway.observation[0, rows]) ** 2)
    assert heard[0].loss == pytest.approx(expected, rel=1e-4)


def test_loss_of_a_step_is_the_papers(two_gateways: Record) -> None:
    """On the batch's rows at the batch's receiver, before the step."""
    heard: list[Progress] = []
    trainer = Trainer(two_gateways, official(two_gateways), settings("steps=4", "batch=3", "log_every=1"))
    expected = []
    for t in range(4):
        rows, r = trainer.schedule.rows[t], int(trainer.schedule.receiver[t])
        field, params = trainer.field, trainer.state.params()
        greys = Predictor(field, params, two_gateways.receivers, *SIZE)(two_gateways.tx_pos_m[rows], r)
        truth = two_gateways.observation[r, rows]
        expected.append(0.8 * np.abs(greys - truth).mean() + 0.2 * (1 - ssim(greys, truth).mean()))
        trainer.run(heard.append, stop=stop_after(1))
    np.testing.assert_allclose([p.loss for p in heard], expected, rtol=1e-4)


def test_data_of_another_kind_are_refused(one_gateway: Record) -> None:
    with pytest.raises(InputError, match="task 'rssi'; this trainer fits spectra"):
        Trainer(replace(one_gateway, task="rssi"), official(one_gateway), settings())
    with pytest.raises(InputError, match="model 'nerf2' cannot be trained here"):
        Trainer(one_gateway, official(one_gateway), settings("model=nerf2"))


def test_points_as_a_start(one_gateway: Record, tmp_path: Path) -> None:
    cloud = np.random.default_rng(0).normal((0, 0, 3), size=(30, 3))
    np.savez(tmp_path / "cloud.npz", points=cloud)
    own = (f"initial.points={tmp_path / 'cloud.npz'}", "initial.opacity=0.3", "steps=1")
    trainer = Trainer(one_gateway, official(one_gateway), settings(*own))
    position = trainer.state.params()["position"].T
    assert np.abs(position[:, None] - cloud).sum(axis=2).min(axis=1).max() < 1e-6
    np.testing.assert_allclose(1 / (1 + np.exp(-trainer.state.params()["opacity"])), 0.3, rtol=1e-6)


def test_device_memory_is_not_numpys() -> None:
    """What is wrapped instead of copied changes with its source."""
    values = np.arange(6, dtype=np.float32)
    own = to_float(values)
    values[:] = 7
    np.testing.assert_array_equal(own.numpy(), np.arange(6))


def recover(model: str, steps: int, rows: int, **size: Any) -> tuple[float, float, float]:
    """Median similarity on held-out transmitters before and after training, and the blend's.

    Training starts from the parameters that made the spectra, each disturbed by a tenth of its group's spread
    (centres: 5 cm of 1 to 4 m; log scales, rotations and logits: 0.1).
    """
    record, field, params = spectra(model, rows=rows, **size)
    split = Split("own", 0, np.arange(rows - 14), np.arange(rows - 14, rows - 10), np.arange(rows - 10, rows))
    config = with_settings(
        TrainConfig(model=model),
        [f"steps={steps}", "batch=4", "hold_out=1", "density.every=0", "optimiser.network=3e-4",
         "optimiser.averaging=0.99", "log_every=500"],
    )  # fmt: skip
    trainer = Trainer(record, split, config, field=field)
    rng = np.random.default_rng(7)
    spread = {"position": 0.5, "log_scale": 1.0, "rotation": 1.0, "opacity": 1.0}
    trainer.state = FitState(
        {
            name: (values + 0.1 * spread.get(name, values.std()) * rng.standard_normal(values.shape)).astype(np.float32)
            for name, values in params.items()
        }
    )
    trainer.record_functions()
    truth, tx = record.observation[0, split.test], record.tx_pos_m

    def score() -> float:
        return float(np.median(ssim(trainer.predictor()(tx[split.test]), truth)))

    before = score()
    trainer.run()
    known = split.all_train
    blend = InverseDistance().fit(tx[known], record.observation[0, known]).predict(tx[split.test])
    return before, score(), float(np.median(ssim(blend, truth)))


@pytest.mark.parametrize("model", FIELDS)
def test_recovery(model: str) -> None:
    """A field is recovered from its spectra, where its neighbours' spectra would not do."""
    before, after, blend = recover(model, steps=1500, rows=94)
    assert before < 0.93
    assert blend < 0.93
    assert after > RECOVERED


@pytest.mark.slow
@pytest.mark.parametrize(("model", "width"), [("wrf-gs", 128), ("wrf-gs+", 256)])
def test_recovery_at_the_papers_widths(model: str, width: int) -> None:
    """More Gaussians, layers as wide as the paper's, and pixels of two degrees: a minute for the two."""
    before, after, blend = recover(model, steps=2500, rows=94, size=(45, 180), count=24, width=width)
    assert before < 0.93
    assert after > max(RECOVERED, blend + 0.015)


def test_garbage_waits_while_a_function_is_recorded(one_gateway: Record) -> None:
    """A user's array that wraps NumPy's memory, freed then by Python's collector, would end the process."""
    seen: list[bool] = []

    def watch(phase: str, info: dict[str, int]) -> None:
        if phase == "start":
            seen.append(dr.flag(dr.JitFlag.FreezingScope))

    trainer = Trainer(one_gateway, official(one_gateway), settings("steps=2", "log_every=1", "validate_every=1"))
    before = gc.get_threshold()
    gc.callbacks.append(watch)
    gc.set_threshold(1)
    try:
        trainer.run()
    finally:
        gc.set_threshold(*before)
        gc.callbacks.remove(watch)
    assert len(seen) > 100
    assert not any(seen)
