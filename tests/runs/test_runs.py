"""Run folders: whole runs, stopped and resumed ones, damaged ones, and their scores."""

from __future__ import annotations

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

from wrf_mi.backend import set_threads
from wrf_mi.core import InputError, Record, Split
from wrf_mi.datasets import load, load_split, make_splits, write_spectrum_folder
from wrf_mi.runs.api import Interrupted, Run, evaluate_run, open_run, resume, train
from wrf_mi.runs.folder import FORMAT
from wrf_mi.tasks.scores import ssim
from wrf_mi.tasks.task import Spectrum
from wrf_mi.training.adam import NumericsError
from wrf_mi.training.checkpoint import read_checkpoint
from wrf_mi.training.config import TrainConfig
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


RESUMED = (
    "steps=40",
    "checkpoint_every=8",
    "density.every=12",
    "density.start=0",
    "density.stop=1",
    "density.growth_fraction=0.3",
)


def keep_checkpoint(run: Path, progress: Progress) -> None:
    """Keep the checkpoint of step 32, which is removed when the training has ended."""
    if progress.step == 35:
        (run / "kept").mkdir()
        shutil.copy(run / "checkpoint.npz", run / "kept")


def checkpoint_of(run: Path) -> dict[str, np.ndarray]:
    arrays = read_checkpoint(run / "kept")
    del arrays["seconds"]
    return arrays


def stopped_and_resumed(folder: Path, out: Path, config: TrainConfig, at: int) -> None:
    with pytest.raises(Interrupted, match=rf"stopped after step {at} of 40; .* train --resume {out}"):
        train(folder, out, "wrf-gs+", settings=config, stop=stop_after(at))
    assert not (out / "metrics.json").exists()
    assert int(read_checkpoint(out)["step"]) == at
    assert [entry["step"] for entry in log_of(out)] == [s for s in range(5, 41, 5) if s <= at]
    heard: list[int] = []

    def on_progress(stage: str, share: float, progress: Progress) -> None:
        heard.append(progress.step)
        keep_checkpoint(out, progress)

    resume(out, on_progress=on_progress)
    assert heard == [s for s in range(5, 41, 5) if s > at]  # it went on, and did not start anew


def test_resumed_run_is_bit_identical(folder: Path, tmp_path: Path) -> None:
    """Parameters, moments, running mean and scores, of a run stopped after a round of density control."""
    config = settings(*RESUMED, "deterministic=true")
    train(
        folder,
        tmp_path / "whole",
        "wrf-gs+",
        settings=config,
        on_progress=lambda *said: keep_checkpoint(tmp_path / "whole", said[2]),
    )
    stopped_and_resumed(folder, tmp_path / "resumed", config, 17)
    for arrays in (checkpoint_of, arrays_of):
        whole, resumed = arrays(tmp_path / "whole"), arrays(tmp_path / "resumed")
        assert set(whole) == set(resumed)
        for name, values in whole.items():
            np.testing.assert_array_equal(resumed[name], values, err_msg=name)
        assert whole["param/position"].shape[1] > 8
    assert {"first/position", "second/position", "mean/position"} <= set(checkpoint_of(tmp_path / "whole"))
    assert not (tmp_path / "whole" / "checkpoint.npz").exists()
    scores = [Run(tmp_path / name).metrics for name in ("whole", "resumed")]
    assert scores[0]["ssim"] == scores[1]["ssim"]
    assert [e["step"] for e in log_of(tmp_path / "resumed")] == list(range(5, 41, 5))
    for a, b in zip(log_of(tmp_path / "whole"), log_of(tmp_path / "resumed"), strict=True):
        assert a["validation_score"] == b["validation_score"]
        if a["step"] != 20:  # the mean loss over 16 to 20, of which the resumed run saw 18 to 20
            assert a["loss"] == b["loss"]


def test_resumed_run_on_several_threads_is_close(folder: Path, tmp_path: Path) -> None:
    set_threads(max(2, dr.thread_count()))
    config = settings("steps=40", "checkpoint_every=8")
    train(folder, tmp_path / "whole", "wrf-gs+", settings=config)
    stopped_and_resumed(folder, tmp_path / "resumed", config, 17)
    greys = [stored(tmp_path / name)["prediction"] for name in ("whole", "resumed")]
    assert np.abs(greys[0] - greys[1]).mean() < PARALLEL_TOLERANCE


class PowerCut(BaseException):
    """Ends a run where it stands."""


def test_killed_run_goes_on_from_its_last_checkpoint(folder: Path, tmp_path: Path) -> None:
    """The log has no line twice."""
    config = settings("steps=40", "checkpoint_every=8", "deterministic=true")

    def kill(stage: str, share: float, progress: Progress) -> None:
        if progress.step == 30:
            raise PowerCut

    with pytest.raises(PowerCut):
        train(folder, tmp_path / "killed", "wrf-gs+", settings=config, on_progress=kill)
    assert int(read_checkpoint(tmp_path / "killed")["step"]) == 24
    assert log_of(tmp_path / "killed")[-1]["step"] == 30
    resume(tmp_path / "killed")
    assert [e["step"] for e in log_of(tmp_path / "killed")] == list(range(5, 41, 5))
    train(folder, tmp_path / "whole", "wrf-gs+", settings=config)
    for name, values in arrays_of(tmp_path / "whole").items():
        np.testing.assert_array_equal(arrays_of(tmp_path / "killed")[name], values, err_msg=name)


def test_a_fit_that_breaks_keeps_its_last_checkpoint_and_goes_on(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The loss of one row is NaN; with finite losses the resumed run equals an uninterrupted run."""
    paper = Spectrum.loss

    def loss(task: Spectrum, prediction: Any, truth: Any, *shape: int, ssim_weight: float) -> Any:
        found = paper(task, prediction, truth, *shape, ssim_weight=ssim_weight)
        return dr.select(dr.max(truth) > 1.5, np.nan, found)

    config = settings("steps=20", "checkpoint_every=2", "log_every=20", "validate_every=20", "deterministic=true")
    broken = load(folder)  # keeps its source, which is what a resumed run reads
    split = official(broken)
    reached = Trainer(broken, split, config).schedule.rows[:, 0].tolist()
    row = next(r for r in reached if reached.index(r) % 2 == 0 and reached.index(r) > 8)
    step = reached.index(row) + 1
    broken.observation[0, row, 4, 5] = 2
    monkeypatch.setattr(Spectrum, "loss", loss)
    with pytest.raises(NumericsError, match=f"^step {step}: not finite: loss"):
        train(broken, tmp_path / "broken", "wrf-gs+", settings=config)
    monkeypatch.undo()
    assert int(read_checkpoint(tmp_path / "broken")["step"]) == step - 1
    resume(tmp_path / "broken")
    train(folder, tmp_path / "whole", "wrf-gs+", settings=config)
    for name, values in arrays_of(tmp_path / "whole").items():
        np.testing.assert_array_equal(arrays_of(tmp_path / "broken")[name], values, err_msg=name)


def test_run_stopped_before_its_first_checkpoint_starts_anew(folder: Path, tmp_path: Path) -> None:
    def kill(stage: str, share: float, progress: Progress) -> None:
        raise PowerCut

    with pytest.raises(PowerCut):
        train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=10"), on_progress=kill)
    assert not (tmp_path / "run" / "checkpoint.npz").exists()
    with pytest.raises(InputError, match=r"model\.npz: missing, the fit was stopped; finish it with train"):
        open_run(tmp_path / "run").predictor()
    resume(tmp_path / "run")
    assert [e["step"] for e in log_of(tmp_path / "run")] == [5, 10]


def test_finished_run_is_only_scored_again(folder: Path, tmp_path: Path) -> None:
    before = train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=10")).metrics
    arrays = arrays_of(tmp_path / "run")
    (tmp_path / "run" / "metrics.json").unlink()
    after = resume(tmp_path / "run").metrics
    assert after["ssim"] == before["ssim"]
    for name, values in arrays_of(tmp_path / "run").items():
        np.testing.assert_array_equal(values, arrays[name])


def test_run_folder_is_complete(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = train(
        folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=10", "seed=3"), split="random", n_train=0.5
    )
    files = {"config.yaml", "log.jsonl", "metrics.json", "model.npz", "predictions.npz", "split.npz"}
    assert contents(run.folder) == files
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
    held = stored(run.folder)
    np.testing.assert_array_equal(held["row"], split.test)
    np.testing.assert_array_equal(held["tx_pos"], one_gateway.tx_pos_m[split.test])
    assert held["prediction"].shape == (5, *SIZE)
    # 16 bits a grey.
    np.testing.assert_allclose(held["truth"], one_gateway.observation[0, split.test], atol=1e-5)
    assert m["ssim"]["median"] == pytest.approx(float(np.median(ssim(held["prediction"], held["truth"]))))
    # The stored field predicts what was scored.
    again = run.predictor()(one_gateway.tx_pos_m[split.test])
    np.testing.assert_allclose(again, held["prediction"], atol=FLOAT32_TOLERANCE)


def test_two_gateways_are_scored_each_and_together(two_gateways: Record, tmp_path: Path) -> None:
    data = write_spectrum_folder(tmp_path / "data", two_gateways, bits=16)
    run = train(data, tmp_path / "run", "wrf-gs+", settings=settings("steps=20"))
    m = run.metrics
    assert list(m["receivers"]) == ["gateway1", "gateway2"]
    held = stored(run.folder)
    prediction, truth = held["prediction"], held["truth"]
    assert list(held["receiver_name"]) == ["gateway1", "gateway2"]
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


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return train(
        folder, tmp_path_factory.mktemp("runs") / "finished", "wrf-gs+", settings=settings("steps=10"), n_train=10
    ).folder


def predictor(run: Path) -> Any:
    return open_run(run).predictor()


def test_damaged_models_are_refused(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    path = run / "model.npz"
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], b"", b"no archive"):
        path.write_bytes(content)
        for use in (predictor, resume, evaluate_run):
            with pytest.raises(InputError, match=r"model\.npz: not readable") as caught:
                use(run)
            assert "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(InputError, match=r"model\.npz: missing"):
        predictor(run)


def test_damaged_configurations_are_refused(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    path = run / "config.yaml"
    for content in ("settings: [1", "just text", "", f"format: {FORMAT}\ndataset: x\n"):
        path.write_text(content)
        with pytest.raises(InputError, match=r"config\.yaml: not ") as caught:
            resume(run)
        assert "\n" not in str(caught.value)
    path.write_text(f"format: {FORMAT - 1}\ndataset: x\n")
    with pytest.raises(InputError, match=rf"config\.yaml: format {FORMAT - 1}, this version reads {FORMAT}"):
        resume(run)
    with pytest.raises(InputError, match=r"no config\.yaml, so not a run folder"):
        resume(tmp_path)


def test_evaluation_reproduces_the_scores(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    run = copied(finished, tmp_path / "run")
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


def test_scores_on_another_split_exclude_training_rows(finished: Path, one_gateway: Record) -> None:
    before = (finished / "metrics.json").read_bytes()
    split, other = load_split(finished / "split.npz"), make_splits(one_gateway, "random")[0]
    unseen = np.setdiff1d(other.test, split.all_train)
    assert 0 < len(unseen) < len(other.test)
    scores = evaluate_run(finished, "random")
    assert scores["n_test"] == len(unseen)
    assert scores["split"] == "random (rows unseen by official)"
    assert (finished / "metrics.json").read_bytes() == before


def test_split_without_unseen_rows_is_refused(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    """Official training rows hold all test rows of this random split."""
    split, other = official(one_gateway), make_splits(one_gateway, "random")[0]
    assert np.isin(other.test, split.all_train).all()
    train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=1"))
    with pytest.raises(InputError, match="trained on all test rows of split random; nothing is left to score"):
        evaluate_run(tmp_path / "run", "random")


def test_unfinished_runs_have_no_scores(folder: Path, tmp_path: Path) -> None:
    """Metrics mark a run as finished."""
    with pytest.raises(Interrupted):
        train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=40"), stop=stop_after(10))
    with pytest.raises(InputError, match=r"run.model\.npz: missing, the fit was stopped; finish it with train"):
        evaluate_run(tmp_path / "run")
    assert not (tmp_path / "run" / "metrics.json").exists()


def test_damaged_metrics_are_written_anew(finished: Path, tmp_path: Path) -> None:
    run = copied(finished, tmp_path / "run")
    before = json.loads((run / "metrics.json").read_text())
    for content in ("{", "[]", ""):
        (run / "metrics.json").write_text(content)
        after = evaluate_run(run)
        assert json.loads((run / "metrics.json").read_text()) == after
        assert after["train_seconds"] == before["train_seconds"]
        assert after["gaussians"] == before["gaussians"]
        assert after.keys() == before.keys()


def test_rows_beyond_the_record_are_refused(finished: Path, tmp_path: Path, one_gateway: Record) -> None:
    """Reading beyond the data would give anything."""
    split = official(one_gateway)
    for own in (replace(split, train=np.append(split.train, 24)), replace(split, test=np.array([-1]))):
        with pytest.raises(InputError, match=r"split official: row (24|-1), but made-here has rows 0 to 23"):
            train(one_gateway, tmp_path / "run", "wrf-gs+", settings=settings("steps=5"), split=own)
    assert not (tmp_path / "run").exists()
    # A data set that has become shorter since.
    run = copied(finished, tmp_path / "copy")
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
    run = train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=5"), split="blocked")
    m = run.metrics
    assert (m["split"], m["n_train"], m["n_test"]) == ("blocked", 16, 24)
    parts = [Run(run.folder / f"fold{k}").metrics for k in range(3)]
    assert [p["split"] for p in parts] == ["blocked:0", "blocked:1", "blocked:2"]
    assert m["train_seconds"] == pytest.approx(sum(p["train_seconds"] for p in parts))
    held = stored(run.folder)
    assert sorted(held["row"]) == list(range(24))
    scores, folds = ssim(held["prediction"], held["truth"]), one_gateway.folds[held["row"]]
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
    with pytest.raises(Interrupted, match=rf"stopped after step 4 of 5; .* train --resume {tmp_path / 'run'}"):
        train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=5"), split="blocked", stop=stop_after(8))
    assert (tmp_path / "run" / "fold0" / "metrics.json").exists()
    assert not (tmp_path / "run" / "fold1" / "metrics.json").exists()
    with pytest.raises(InputError, match=r"fold1.model\.npz: missing, the fit was stopped; finish it with train"):
        evaluate_run(tmp_path / "run")
    m = resume(tmp_path / "run").metrics
    assert m["n_test"] == 24
    assert [e["step"] for e in log_of(tmp_path / "run" / "fold1")] == [5]


def test_folders_with_content_are_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine.txt").write_text("mine")
    for split in ("official", "blocked"):
        with pytest.raises(InputError, match="exists and is not empty"):
            train(folder, tmp_path / "run", "wrf-gs+", settings=settings("steps=5"), split=split)
    assert contents(tmp_path / "run") == {"mine.txt"}
    with pytest.raises(InputError, match="exists and is not empty"):
        train(folder, tmp_path / "run" / "mine.txt", "wrf-gs+", settings=settings("steps=5"))


def test_custom_split_is_trained(one_gateway: Record, tmp_path: Path) -> None:
    """A record in memory and a split by hand, without validation rows."""
    split = Split("mine", 0, np.arange(10), np.arange(0), np.arange(20, 24))
    run = train(one_gateway, tmp_path / "run", "wrf-gs+", settings=settings("steps=5"), split=split)
    assert (run.metrics["split"], run.metrics["n_train"], run.metrics["n_test"]) == ("mine", 10, 4)
    # Standard JSON knows no NaN.
    for name in ("log.jsonl", "metrics.json"):
        assert "NaN" not in (run.folder / name).read_text()
