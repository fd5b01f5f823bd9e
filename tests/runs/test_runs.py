"""Run folders: whole runs, stopped and resumed ones, damaged ones, and their scores."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import yaml
from calling import contents, copied, stored
from made_spectra import SIZE
from small_fits import official, settings, stop_after

from wrf_mi.apps.commands.main import main
from wrf_mi.backend import set_threads
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import load, load_split, make_splits, save_split, write_spectrum_folder
from wrf_mi.runs.api import Interrupted, Run, evaluate_run, open_run, resume, train
from wrf_mi.runs.folder import FORMAT
from wrf_mi.tasks.scores import ssim
from wrf_mi.tasks.spectrum import Spectrum
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.checkpoint import read_checkpoint
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.events import EVENTS
from wrf_mi.training.loop import Progress
from wrf_mi.training.trainer import Trainer

PARALLEL_TOLERANCE = 3e-3
"""Mean difference of greys of two runs on several threads after 40 steps. Sums of gradients differ in their last digit,
which is 1e-7 in most runs; where a gradient is but that digit, Adam makes a whole step of it: one run in six, by 5e-4
(6e-3 in single cells). Four steps fewer are 7e-3, another seed is 5e-2."""
FLOAT32_TOLERANCE = 1e-4
"""Greys of one field computed on two ways: float32 rounding, and footprints' cut-off, which is worth 0.01."""


def log_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (path / "log.jsonl").read_text().splitlines()]


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    return open_run(path).field.arrays()


RESUMED = ["steps=40", "checkpoint_every=8", "density.every=12", "density.start=0", "density.stop=1"]
DETERMINISTIC = settings(*RESUMED, "density.growth_fraction=0.3", "deterministic=true")


def keep_checkpoint(run: Path, progress: Progress) -> None:
    """Keep the checkpoint of step 32, which is removed when the training has ended."""
    if progress.step == 35:
        (run / "kept").mkdir()
        shutil.copy(run / "checkpoint.npz", run / "kept")


def checkpoint_of(run: Path) -> dict[str, np.ndarray]:
    arrays = read_checkpoint(run / "kept")
    del arrays["seconds"]
    return arrays


@pytest.fixture(scope="module")
def whole(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run with rounds of density control that nothing interrupts."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    options: dict[str, Any] = {"settings": DETERMINISTIC, "on_progress": lambda *told: keep_checkpoint(out, told[2])}
    return train(folder, "wrf-gs+", out=out, **options).folder


def assert_same_arrays(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert set(found) == set(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name)


def stopped_and_resumed(folder: Path, out: Path, config: TrainConfig, at: int) -> None:
    with pytest.raises(Interrupted, match=rf"stopped after step {at} of 40; .* train --resume {out}"):
        train(folder, "wrf-gs+", out=out, settings=config, stop=stop_after(at))
    assert not (out / "metrics.json").exists()
    assert int(read_checkpoint(out)["step"]) == at
    assert [entry["step"] for entry in log_of(out)] == [s for s in range(5, 41, 5) if s <= at]
    heard: list[int] = []

    def on_progress(stage: str, share: float, progress: Progress | None = None) -> None:
        heard.append(progress.step)
        keep_checkpoint(out, progress)

    resume(out, on_progress=on_progress)
    assert heard == [s for s in range(5, 41, 5) if s > at]  # it went on, and did not start anew


def test_resumed_run_is_bit_identical(folder: Path, whole: Path, tmp_path: Path) -> None:
    """Parameters, moments, running mean and scores, of a run stopped after a round of density control."""
    resumed = tmp_path / "resumed"
    stopped_and_resumed(folder, resumed, DETERMINISTIC, 17)
    for arrays in (checkpoint_of, arrays_of):
        assert_same_arrays(arrays(resumed), arrays(whole))
    assert arrays_of(whole)["params/position"].shape[1] > 8
    assert {"first/position", "second/position", "mean/position"} <= set(checkpoint_of(whole))
    assert not (whole / "checkpoint.npz").exists()
    assert Run(whole).metrics["ssim"] == Run(resumed).metrics["ssim"]
    assert [entry["step"] for entry in log_of(resumed)] == list(range(5, 41, 5))
    for expected, entry in zip(log_of(whole), log_of(resumed), strict=True):
        assert entry["validation_score"] == expected["validation_score"]
        if entry["step"] != 20:  # the mean loss over 16 to 20, of which the resumed run saw 18 to 20
            assert entry["loss"] == expected["loss"]


def test_resumed_run_on_several_threads_is_close(folder: Path, tmp_path: Path) -> None:
    set_threads(max(2, dr.thread_count()))
    config = settings("steps=40", "checkpoint_every=8")
    train(folder, "wrf-gs+", out=tmp_path / "whole", settings=config)
    stopped_and_resumed(folder, tmp_path / "resumed", config, 17)
    greys = [stored(tmp_path / name)["prediction"] for name in ("whole", "resumed")]
    assert np.abs(greys[0] - greys[1]).mean() < PARALLEL_TOLERANCE


class PowerCut(BaseException):
    """Ends a run where it stands."""


def kill_at(step: int) -> Any:
    def kill(stage: str, share: float, progress: Progress) -> None:
        if progress.step == step:
            raise PowerCut

    return kill


def test_killed_run_goes_on_from_its_last_checkpoint(folder: Path, whole: Path, tmp_path: Path) -> None:
    """The log has no line twice."""
    killed = tmp_path / "killed"
    with pytest.raises(PowerCut):
        train(folder, "wrf-gs+", out=killed, settings=DETERMINISTIC, on_progress=kill_at(30))
    assert int(read_checkpoint(killed)["step"]) == 24
    assert log_of(killed)[-1]["step"] == 30
    resume(killed)
    assert [entry["step"] for entry in log_of(killed)] == list(range(5, 41, 5))
    assert_same_arrays(arrays_of(killed), arrays_of(whole))


def test_a_fit_that_breaks_keeps_its_last_checkpoint_and_goes_on(folder, whole, tmp_path, monkeypatch):
    """The loss of one row is NaN; with finite losses the resumed run equals an uninterrupted run."""
    paper = Spectrum.loss

    def loss(task: Spectrum, prediction: Any, truth: Any, *shape: int, ssim_weight: float) -> Any:
        value = paper(task, prediction, truth, *shape, ssim_weight=ssim_weight)
        return dr.select(dr.max(truth) > 1.5, np.nan, value)

    record, broken = load(folder), tmp_path / "broken"  # keeps its source, which is what a resumed run reads
    reached = Trainer(record, official(record), DETERMINISTIC).schedule.rows[:, 0].tolist()
    row = next(row for row in reached if reached.index(row) > 8)
    step = reached.index(row) + 1
    record.observation[0, row, 4, 5] = 2
    with monkeypatch.context() as patched:
        patched.setattr(Spectrum, "loss", loss)
        with pytest.raises(NumericsError, match=f"^step {step}: not finite: loss"):
            train(record, "wrf-gs+", out=broken, settings=DETERMINISTIC)
    assert int(read_checkpoint(broken)["step"]) == (step - 1) // 8 * 8
    resume(broken)
    assert_same_arrays(arrays_of(broken), arrays_of(whole))


def test_run_stopped_before_its_first_checkpoint_starts_anew(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(PowerCut):
        train(folder, "wrf-gs+", out=tmp_path / "run", settings=settings("steps=10"), on_progress=kill_at(5))
    assert not (tmp_path / "run" / "checkpoint.npz").exists()
    with pytest.raises(InputError, match=r"model\.npz: missing, the fit was stopped; finish it with train"):
        open_run(tmp_path / "run").predictor()
    resume(tmp_path / "run")
    assert [entry["step"] for entry in log_of(tmp_path / "run")] == [5, 10]


def test_run_folder_is_complete(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    options: dict[str, Any] = {"settings": settings("steps=10", "seed=3"), "split": "random", "n_train": 0.5}
    run = train(folder, "wrf-gs+", out=tmp_path / "run", **options)
    files = {"config.yaml", "log.jsonl", "metrics.json", "model.npz", "predictions.npz", "split.npz"}
    assert contents(run.folder) - {EVENTS} == files
    config = yaml.safe_load((run.folder / "config.yaml").read_text())
    assert (config["dataset"], config["split"], config["n_train"], config["seed"]) == (str(folder), "random", 0.5, 3)
    assert config["settings"]["initial"]["gaussians"] == 8
    assert {"wrf-mi", "mitsuba", "drjit", "numpy", "backend"} <= set(config["versions"])
    split = load_split(run.folder / "split.npz")
    assert len(split.all_train) == 10
    m = run.metrics
    assert (m["task"], m["model"], m["split"], m["n_train"], m["n_test"]) == ("spectrum", "wrf-gs+", "random", 10, 5)
    assert set(m["ssim"]) == {"median", "mean", "p10", "p90"} < set(m["reference"]["idw"])
    assert m["train_seconds"] > 0
    assert m["ms_per_sample"] > 0
    assert m["peak_memory_mb"] > 50
    assert "receivers" not in m
    run_arrays = stored(run.folder)
    np.testing.assert_array_equal(run_arrays["row"], split.test)
    np.testing.assert_array_equal(run_arrays["tx_pos"], one_gateway.tx_pos_m[split.test])
    assert run_arrays["prediction"].shape == (5, *SIZE)
    # 16 bits a grey.
    np.testing.assert_allclose(run_arrays["truth"], one_gateway.observation[0, split.test], atol=1e-5)
    assert m["ssim"]["median"] == pytest.approx(float(np.median(ssim(run_arrays["prediction"], run_arrays["truth"]))))
    # The stored field predicts what was scored.
    again = run.predictor()(one_gateway.tx_pos_m[split.test])
    np.testing.assert_allclose(again, run_arrays["prediction"], atol=FLOAT32_TOLERANCE)


def test_two_gateways_are_scored_each_and_together(two_gateways: Record, tmp_path: Path) -> None:
    data = write_spectrum_folder(tmp_path / "data", two_gateways, bits=16)
    run = train(data, "wrf-gs+", out=tmp_path / "run", settings=settings("steps=10"))
    m = run.metrics
    assert list(m["receivers"]) == ["gateway1", "gateway2"]
    run_arrays = stored(run.folder)
    prediction, truth = run_arrays["prediction"], run_arrays["truth"]
    assert list(run_arrays["receiver_name"]) == ["gateway1", "gateway2"]
    assert prediction.shape == truth.shape == (2, 5, *SIZE)
    scores, predictor = ssim(prediction, truth), run.predictor()
    assert m["ssim"]["mean"] == pytest.approx(scores.mean())
    assert [receiver.name for receiver in predictor.receivers] == list(m["receivers"])
    tx = two_gateways.tx_pos_m[load_split(run.folder / "split.npz").test]
    for r, block in enumerate(m["receivers"].values()):
        assert block["ssim"]["median"] == pytest.approx(np.median(scores[r]))
        assert set(block["reference"]["idw"]) == {"median", "mean", "p10", "p90"}
        np.testing.assert_allclose(predictor(tx, r), prediction[r], atol=FLOAT32_TOLERANCE)


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "finished"
    return train(folder, "wrf-gs+", out=out, settings=settings("steps=10"), n_train=10).folder


def test_finished_run_is_only_scored_again(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    (run / "metrics.json").unlink()
    assert resume(run).metrics["ssim"] == Run(finished).metrics["ssim"]
    assert_same_arrays(arrays_of(run), arrays_of(finished))


def test_damaged_configurations_are_refused(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    earlier = rf"config\.yaml: format {FORMAT - 1}, this version reads {FORMAT}"
    for content, message in (
        *((content, r"config\.yaml: not ") for content in ("settings: [1", "just text", "")),
        (f"format: {FORMAT}\ndataset: x\n", r"config\.yaml: not "),
        (f"format: {FORMAT - 1}\ndataset: x\n", earlier),
    ):
        (run / "config.yaml").write_text(content)
        with pytest.raises(InputError, match=message) as caught:
            resume(run)
        assert "\n" not in str(caught.value)


def test_evaluation_reproduces_the_scores(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    before = json.loads((run / "metrics.json").read_text())
    (run / "predictions.npz").unlink()
    for content in (None, "{", "[]", ""):  # damaged metrics are written anew
        if content is not None:
            (run / "metrics.json").write_text(content)
        after = evaluate_run(run)
        assert json.loads((run / "metrics.json").read_text()) == after
        assert after.keys() == before.keys()
        for key in before.keys() - {"ms_per_sample", "ssim", "reference"}:
            assert content is not None or after[key] == before[key], key
        assert (after["train_seconds"], after["gaussians"]) == (before["train_seconds"], before["gaussians"])
        assert after["ssim"] == pytest.approx(before["ssim"], abs=1e-5)
    assert (run / "predictions.npz").exists()


def test_scores_on_another_split_exclude_training_rows(finished: Path, one_gateway: Record) -> None:
    before = (finished / "metrics.json").read_bytes()
    split, other = load_split(finished / "split.npz"), make_splits(one_gateway, "random")[0]
    unseen = np.setdiff1d(other.test, split.all_train)
    assert 0 < len(unseen) < len(other.test)
    scores = evaluate_run(finished, "random")
    assert scores["n_test"] == len(unseen)
    assert scores["split"] == "random (rows unseen by official)"
    assert (finished / "metrics.json").read_bytes() == before


def test_split_without_unseen_rows_is_refused(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    """Official training rows hold all test rows of this random split."""
    run, split = copied(finished, tmp_path / "run"), official(one_gateway)
    assert np.isin(make_splits(one_gateway, "random")[0].test, split.all_train).all()
    save_split(run / "split.npz", split)
    with pytest.raises(InputError, match="trained on all test rows of split random; nothing is left to score"):
        evaluate_run(run, "random")


def test_rows_beyond_the_record_are_refused(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    """Reading beyond the data would give anything."""
    split = official(one_gateway)
    for wrong in (replace(split, train=np.append(split.train, 24)), replace(split, test=np.array([-1]))):
        with pytest.raises(InputError, match=r"split official: row (24|-1), but made-here has rows 0 to 23"):
            train(one_gateway, "wrf-gs+", out=tmp_path / "run", settings=settings("steps=5"), split=wrong)
    assert not (tmp_path / "run").exists()
    # A data set that has become shorter since.
    run = copied(finished, tmp_path / "copy")
    arrays: dict[str, Any] = {"tx_pos_m": one_gateway.tx_pos_m[:20], "observation": one_gateway.observation[:, :20]}
    data = write_spectrum_folder(tmp_path / "short", replace(one_gateway, **arrays, official=None, folds=None))
    config = yaml.safe_load((run / "config.yaml").read_text()) | {"dataset": str(data)}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    for use in (resume, evaluate_run):
        with pytest.raises(InputError, match=r"split\.npz: row 2., but short has rows 0 to 19"):
            use(run)


def test_blocked_run_pools_its_folds(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = train(folder, "wrf-gs+", out=tmp_path / "run", settings=settings("steps=5"), split="blocked")
    m = run.metrics
    assert (m["split"], m["n_train"], m["n_test"]) == ("blocked", 16, 24)
    parts = [Run(run.folder / f"fold{k}").metrics for k in range(3)]
    assert [p["split"] for p in parts] == ["blocked:0", "blocked:1", "blocked:2"]
    assert m["train_seconds"] == pytest.approx(sum(p["train_seconds"] for p in parts))
    run_arrays = stored(run.folder)
    assert sorted(run_arrays["row"]) == list(range(24))
    scores, folds = ssim(run_arrays["prediction"], run_arrays["truth"]), one_gateway.folds[run_arrays["row"]]
    assert m["ssim"]["median"] == pytest.approx(np.median(scores))
    for k, part in enumerate(parts):
        assert part["ssim"]["mean"] == pytest.approx(scores[folds == k].mean())
    again = evaluate_run(run.folder)
    assert again["ssim"]["median"] == pytest.approx(m["ssim"]["median"], abs=1e-5)
    assert again["train_seconds"] == m["train_seconds"]
    with pytest.raises(InputError, match="every row is held out in one of its folds"):
        evaluate_run(run.folder, "random")
    with pytest.raises(InputError, match="one model for each block; choose one"):
        run.predictor()
    assert Run(run.folder / "fold1").predictor()(one_gateway.tx_pos_m[:1]).shape == (1, *SIZE)


def test_blocked_run_goes_on_in_the_fold_where_it_was_stopped(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    with pytest.raises(Interrupted, match=rf"stopped after step 4 of 5; .* train --resume {run}"):
        train(folder, "wrf-gs+", out=run, settings=settings("steps=5"), split="blocked", stop=stop_after(8))
    assert [(run / f"fold{k}" / "metrics.json").exists() for k in (0, 1)] == [True, False]
    with pytest.raises(InputError, match=r"fold1.model\.npz: missing, the fit was stopped; finish it with train"):
        evaluate_run(run)
    assert resume(run).metrics["n_test"] == 24
    assert [entry["step"] for entry in log_of(run / "fold1")] == [5]


def test_folders_with_content_are_refused(folder: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "mine.txt").write_text("mine")
    for out, split in ((run, "official"), (run, "blocked"), (run / "mine.txt", "official")):
        with pytest.raises(InputError, match="exists and is not empty"):
            train(folder, "wrf-gs+", out=out, settings=settings("steps=5"), split=split)
    assert contents(run) == {"mine.txt"}


def test_positions_where_predictions_are_wanted_are_kept_with_the_split(flat_folder: Path, tmp_path: Path) -> None:
    (tmp_path / "there.csv").write_text("x,y,z\n1,2,1\n3,1,2\n")
    words = ["train", str(flat_folder), "--model", "kriging", "--for", str(tmp_path / "there.csv")]
    assert main([*words, "--out", str(tmp_path / "run")]) == 0
    split = load_split(tmp_path / "run" / "split.npz")
    np.testing.assert_array_equal(split.wanted_m, [[1, 2, 1], [3, 1, 2]])


def test_wanted_positions_of_other_tasks_or_files_are_refused(flat_folder: Path, folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds spectrum; positions shape the hold-out of rssi"):
        train(folder, out=tmp_path / "run", wanted=np.zeros((2, 3)))
    with pytest.raises(InputError, match=r"positions \(0, 3\); give finite x, y, z"):
        train(flat_folder, out=tmp_path / "run", wanted=np.zeros((0, 3)))
    assert not (tmp_path / "run").exists()
