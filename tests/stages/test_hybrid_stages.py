"""The stages of a fit in a scene: what is kept, restored, resumed and refused, for every task."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from calling import contents, refused
from traced_rooms import HEIGHT, SHOEBOX, WIDTH, write_xml
from wrf_mi_scenes.build_laboratory import sheet

import wrf_mi
from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.datasets import write_spectrum_folder
from wrf_mi.datasets.ble_folder import write_ble_folder
from wrf_mi.stages import paths
from wrf_mi.stages import scene as scene_stage
from wrf_mi.stages.engine import Engine, Fold
from wrf_mi.stages.scene import STAGES
from wrf_mi.stages.stage import Stage
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.training.selection import hold_out
from wrf_mi.training.session import Interrupted
from wrf_mi.training.validation import HeldOutObservations

HZ = 920e6
SHAPES = {"spectrum": (24, 48), "rssi": (), "csi": (6,)}
TRACE = TraceOptions(depth=2, rays=1 << 12)
QUICK = ("steps=20",)
STOPPED_IN = (
    ("paths: choices", "(calibrated)"),
    ("paths: least squares", "(calibrated)"),
    ("paths: choices", "(corrected)"),
    ("paths: choices", "(corrected, paths found anew)"),
    ("paths: calibrated", ""),
    ("paths: training surfaces", "(surfaces)"),
    ("paths: training field", "(field)"),
    ("paths: least squares", "parameters"),
    ("kriging, held-out rows: signals", ""),
    ("choosing weights", ""),
)
"""Beginnings and ends of progress after which a fit of spectra is stopped, in their order."""
STRENGTHS_STOPPED_IN = (
    ("paths: choices", "(calibrated)"),
    ("paths: least squares", "(calibrated)"),
    ("paths: tracing a map", "(exact)"),
    ("paths: search", "(searched)"),
    ("paths: none", ""),
    ("paths: all rows", ""),
    ("kriging: search", "(searched)"),
    ("kriging: none", ""),
    ("choosing weights", ""),
)
"""The same of signal strengths."""
FLOAT32_GREY = 1e-4  # of greys that a batch of transmitters and a single one give: sums in single precision
CLEAR_DB = 0.3  # of strengths without noise in the true scene; the constant level and slope are fitted to 30 rows
CLEAR_GREY = 0.05  # gain of the mean SSIM by the true materials of three of six walls: 0.1 with 30 rows


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A room, and what is thought of it: walls of wood."""
    folder = tmp_path_factory.mktemp("rooms")
    thought = {name: ("itu_wood", mesh) for name, (_, mesh) in SHOEBOX.items()}
    return {"true": write_xml(folder / "true", SHOEBOX), "thought": write_xml(folder / "thought", thought)}


def parts_of(run: Any) -> Any:
    return run.fitted.parts


def measured(scenes: dict[str, Path], task: str, train: int = 30) -> tuple[Record, Split]:
    """Observations traced by Sionna RT in the true room, and a split with test rows on one side."""
    near, far = ([1.7, 2.6, 1.4], [2.1, 3.0, 1.5]) if task == "csi" else ([1.2, 2.0, 1.2], [4.5, 3.8, 1.9])
    tx = np.random.default_rng(4).uniform(near, far, (60, 3))
    tx = tx[np.argsort(tx[:, 0])]
    array = planar_array(4, 4, 0.16) if task == "spectrum" else None
    receiver = Receiver("rx0", np.array([5.2, 2.4, 1.1]), np.asarray(UPRIGHT), array_m=array)
    unknown: Any = np.zeros((1, len(tx), *SHAPES[task]), np.complex64 if task == "csi" else np.float32)
    hz = HZ + 1e6 * np.arange(6.0) if task == "csi" else np.array([HZ])
    record = Record("room", task, tx, (receiver,), unknown, frequencies_hz=hz)
    paths = trace_paths(open_scene(scenes["true"], HZ), tx, (receiver,), TRACE).paths
    record = replace(record, observation=instrument_of(record).observe(paths).astype(unknown.dtype))
    rows = np.random.default_rng(0).permutation(np.arange(12, 60))
    return record, Split("side", 0, np.sort(rows[:train]), rows[:0], np.arange(12))


def assert_restored(run: wrf_mi.Run, record: Record) -> wrf_mi.Run:
    again, position = wrf_mi.open_run(run.folder, record), record.tx_pos_m[:3]
    assert again.predict(position).mean == pytest.approx(run.predict(position).mean, rel=1e-4)
    return again


def written(folder: Path, write: Any, scenes: dict[str, Path], task: str, rows: int = 30) -> str:
    """A data set with the split as the official one."""
    record, split = measured(scenes, task, rows)
    return str(write(folder, replace(record, official=(split.train, split.test))))


@pytest.fixture(scope="module")
def spectra(scenes: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> tuple[wrf_mi.Run, Record]:
    """A deterministic fit to a data set in a folder."""
    folder = tmp_path_factory.mktemp("runs")
    data = written(folder / "room", write_spectrum_folder, scenes, "spectrum", 16)
    run = wrf_mi.train(data, out=folder / "run", scene=scenes["thought"], settings=QUICK, deterministic=True)
    return run, run.record


def test_stages_are_reported_in_their_order_and_kept_where_they_gain(spectra: tuple[wrf_mi.Run, Record]) -> None:
    reports = {report["stage"]: report for report in spectra[0].metrics["stages"]}
    assert list(reports) == [stage for stage in STAGES if stage in reports]
    assert reports["mean"]["kept"]
    corrected = max(reports[stage]["held_out"] for stage in ("calibration", "correction"))
    assert corrected > reports["mean"]["held_out"] + CLEAR_GREY
    assert {"surfaces", "field", "residual"} <= set(reports)
    kept = [report for report in reports.values() if report["kept"]]
    # Test rows lie in the same part of the wrong scene.
    assert kept[0]["test"] + CLEAR_GREY < kept[-1]["test"] == pytest.approx(spectra[0].metrics["ssim"]["mean"])
    assert all(report["ms"] > 0 for report in kept)


def test_hybrid_of_a_wrong_scene_is_above_its_trace_and_interpolation(spectra, scenes, tmp_path) -> None:
    run, record = spectra
    for model, scene in (("ray-tracing", scenes["thought"]), ("kriging", None)):
        other = wrf_mi.train(record, model, out=tmp_path / model, scene=scene, split=measured(scenes, "spectrum")[1])
        assert run.metrics["ssim"]["mean"] > other.metrics["ssim"]["mean"]


def test_fit_in_a_scene_is_restored_with_its_components(spectra: tuple[wrf_mi.Run, Record]) -> None:
    run, record = spectra
    again = wrf_mi.open_run(run.folder, record)
    position = record.tx_pos_m[:4]
    every = again.predict(position)
    np.testing.assert_allclose(every.mean, run.predict(position).mean, atol=FLOAT32_GREY)
    singles = [again.predict(place[None]).mean[0] for place in position]
    np.testing.assert_allclose(every.mean, np.stack(singles), atol=FLOAT32_GREY)
    assert every.std is not None
    scene = run.folder / "parts" / "paths" / "scene"
    assert (scene / "correction.md").exists()
    # Training alone could find the materials in the stated scene, too.
    assert all(parts_of(opened)["paths"].problem.scene == str(scene) for opened in (run, again))


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_stopped_fit_goes_on_bit_for_bit_at_every_stage(task, spectra, scenes, tmp_path, monkeypatch) -> None:
    """Stopped in each option of the scene and of what follows, with all rows, and while it interpolates, in turn."""
    config_of = paths.config_of
    monkeypatch.setattr(paths, "config_of", lambda *given: replace(config_of(*given), log_every=1))
    how: dict[str, Any] = {"scene": scenes["thought"], "deterministic": True}
    stopped_in: Any = STOPPED_IN if task == "spectrum" else STRENGTHS_STOPPED_IN
    if task == "spectrum":
        uninterrupted, how["settings"] = spectra[0], QUICK
        data = uninterrupted.record.source
    else:
        data = written(tmp_path / "room", write_ble_folder, scenes, task, 48)
        uninterrupted = wrf_mi.train(data, out=tmp_path / "whole", **how)
    out = tmp_path / "stopped"
    sitting = partial(wrf_mi.train, data, out=out, **how)
    for begin, end in stopped_in:
        stages = [""]

        def stop(stages: list[str] = stages, begin: str = begin, end: str = end) -> bool:
            return stages[-1].startswith(begin) and stages[-1].endswith(end)

        with pytest.raises(Interrupted):
            sitting(on_progress=lambda stage, *_, stages=stages: stages.append(stage), stop=stop)
        assert stages[-1].startswith(begin)
        sitting = partial(wrf_mi.resume, out)
    position = uninterrupted.record.tx_pos_m[:6]
    np.testing.assert_array_equal(sitting().predict(position).mean, uninterrupted.predict(position).mean)


def taken(run: wrf_mi.Run) -> list[tuple[str, str, str]]:
    """Parts, stages and options that held-out rows chose."""
    chosen = [report for report in run.metrics["options"] if report["taken"]]
    return [(report["part"], report["stage"], report["option"]) for report in chosen]


def test_first_stage_of_a_training_that_went_further_is_continued_with_all_rows(scenes, tmp_path, monkeypatch) -> None:
    """As if nothing had been trained after it: a resumed fit, which trains that anew, ends in the same model."""
    judged = Engine._scores

    def favouring(engine: Engine, fold: Fold, plan: tuple[str, ...], stage: Stage) -> np.ndarray:
        return judged(engine, fold, plan, stage) + 10.0 * (plan[-1] == "calibrated") + 9.0 * (plan[-1] == "surfaces")

    monkeypatch.setattr(Engine, "_scores", favouring)
    data = written(tmp_path / "room", write_spectrum_folder, scenes, "spectrum", 16)
    settings, out = ("stages=mean,calibration,surfaces", "steps=20"), tmp_path / "stopped"
    how: dict[str, Any] = {"scene": scenes["thought"], "settings": settings, "deterministic": True}
    whole = wrf_mi.train(data, out=tmp_path / "whole", **how)
    assert taken(whole)[-1] == ("paths", "paths", "calibrated")
    assert "correction" not in [report["stage"] for report in whole.metrics["stages"]], "it is not wanted"
    log = (whole.folder / "parts" / "paths" / "log.jsonl").read_text().splitlines()
    assert json.loads(log[-1])["step"] == 6  # a quarter of 20 steps without the held-out rows, and one with all rows
    reports = [""]
    with pytest.raises(Interrupted):
        wrf_mi.train(
            data,
            out=out,
            on_progress=lambda what, *_: reports.append(what),
            stop=lambda: reports[-1].startswith("paths: least squares") and reports[-1].endswith("parameters"),
            **how,
        )
    position = whole.record.tx_pos_m[:6]
    with monkeypatch.context() as ended:
        ended.setattr("wrf_mi.runs.api.write_fitted", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            wrf_mi.resume(out)
    # The training has ended and its log has its place, but nothing is stored.
    np.testing.assert_array_equal(wrf_mi.resume(out).predict(position).mean, whole.predict(position).mean)


def test_predictions_of_held_out_rows_are_those_of_a_fit_without_them() -> None:
    rows, predicted = np.array([7, 3, 5]), np.arange(3.0)
    held_out = HeldOutObservations(np.array([0, 0, 1]), rows, predicted)
    told = dict.fromkeys(("receivers", "uses_heading", "carriers_hz", "run_sd_db"))
    graph: Any = SimpleNamespace(**told, traces=True, held_out=held_out)
    scene_model = paths.FittedPaths(graph, None)
    assert scene_model.predict_rows(np.array([3, 7]), 0) is None, "a fit to all rows has other predictions"
    scene_model.held_out = held_out
    np.testing.assert_array_equal(scene_model.predict_rows(np.array([3, 7]), 0).mean, [1, 0])
    assert scene_model.predict_rows(np.array([3, 5]), 0) is None
    assert scene_model.predict_rows(np.array([3, 8]), 0) is None


@pytest.mark.parametrize("task", ["rssi", "csi"])
def test_strengths_and_channels_are_fitted_in_stages(task: str, scenes: dict[str, Path], tmp_path: Path) -> None:
    record, split = measured(scenes, task)
    # Nothing is trained for powers of uncertain positions. Corrections by channels are those of `test_correct`.
    settings = (*QUICK, "stages=mean,calibration,surfaces,residual") if task == "csi" else ()
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scenes["thought"], split=split, settings=settings)
    names = [report["stage"] for report in run.metrics["stages"]]
    assert (names[0], names[-1]) == ("mean", "residual")
    assert ("surfaces" in names) == (task == "csi")
    assert_restored(run, record)


def test_field_beside_paths_is_a_part_of_strengths_where_it_is_named(scenes: dict[str, Path], tmp_path: Path) -> None:
    record, split = measured(scenes, "rssi")
    settings = ("stages=mean,field,residual", "steps=20")
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scenes["thought"], split=split, settings=settings)
    assert set(run.metrics["held_out"]) == {"paths", "field-scene", "kriging", "hybrid"}
    assert_restored(run, record)


def test_strengths_at_exact_positions_are_those_of_the_trace(scenes: dict[str, Path], tmp_path: Path) -> None:
    """Local means are off by the ripple of two paths and more, 1 to 3 dB at 920 MHz."""
    record, split = measured(scenes, "rssi")
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scenes["true"], split=split)
    assert ("paths", "mean", "exact") in taken(run)
    assert run.metrics["abs_error_db"]["median"] < CLEAR_DB
    assert_restored(run, record)


def test_strengths_at_exact_positions_without_a_path_are_restored(scenes: dict[str, Path], tmp_path: Path) -> None:
    """A wall that nothing passes; each half of the room has a receiver."""
    screen = {"screen": ("soak", sheet(0, 3.0, (0.0, WIDTH), (0.0, HEIGHT)))}
    scene, record = write_xml(tmp_path / "halves", {**SHOEBOX, **screen}), measured(scenes, "rssi")[0]
    stated, absorber = scene.read_text(), '"absorber-radio-material" id="mat-soak"'
    scene.write_text(stated.replace('"diffuse" id="mat-soak"', absorber))
    other = replace(record.receivers[0], name="rx1", position_m=np.array([0.8, 2.6, 1.1]))
    record = replace(record, receivers=(*record.receivers, other), observation=np.repeat(record.observation, 2, axis=0))
    paths = trace_paths(open_scene(scene, HZ), record.tx_pos_m, record.receivers, TRACE).paths
    record = replace(record, observation=instrument_of(record).observe(paths).astype(np.float32))
    assert 0.2 < np.isnan(record.observation).mean() < 0.8
    rows = np.random.default_rng(0).permutation(60)
    split = Split("both", 0, np.sort(rows[:40]), rows[:0], np.sort(rows[40:]))
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scene, split=split, settings=("stages=mean",))
    assert ("paths", "mean", "exact") in taken(run)
    assert_restored(run, record)


def test_few_rows_train_paths_and_hold_two_out(scenes: dict[str, Path], tmp_path: Path) -> None:
    record, split = measured(scenes, "spectrum", 5)
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scenes["thought"], split=split, settings=QUICK)
    assert [report["stage"] for report in run.metrics["stages"]] == ["surfaces", "residual"]
    assert run.metrics["inside_90"] > 0.5


def test_rows_that_are_too_few_to_judge_train_all_the_same(scenes, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(paths, "LEAST_ROWS", 99)
    record, split = measured(scenes, "spectrum", 16)
    settings = ("stages=mean,calibration", "steps=20")
    run = wrf_mi.train(record, out=tmp_path / "run", scene=scenes["thought"], split=split, settings=settings)
    assert taken(run)[-1] == ("paths", "paths", "trained")
    assert parts_of(run)["paths"].fitted.params


def test_regions_alone_judge_a_scene_that_rows_near_by_correct(scenes, tmp_path, monkeypatch) -> None:
    """No test row and no row of a region is seen by a correction, but all others are."""
    seen = list[np.ndarray]()

    def noted(place: str, record: Record, split: Split, *_: object) -> None:
        seen.append(split.all_train)
        raise InputError("noted")

    monkeypatch.setattr(scene_stage, "TracedScene", noted)
    record, split = measured(scenes, "spectrum", 24)
    split = replace(split, train=np.sort(split.train)[::2], validation=np.sort(split.train)[1::2])
    wrf_mi.train(record, out=tmp_path / "run", scene=scenes["thought"], split=split, settings=("steps=20",))
    fold = hold_out(record, split)
    judged = fold.test[scene_stage.SceneStage().judging(split, fold.test)]
    assert len(judged)
    assert len(judged) < len(fold.test)
    assert all(set(rows) == set(split.all_train) - set(judged) for rows in seen)


def test_scene_as_stated_is_kept_where_a_training_in_it_is_better(scenes, tmp_path, monkeypatch) -> None:
    """Stages that are not wanted are not fitted."""
    stated, judged = str(scenes["thought"]), Engine._scores
    best = ("calibrated in the scene as stated", "surfaces in the scene as stated")

    def favouring(engine: Engine, fold: Fold, plan: tuple[str, ...], stage: Stage) -> np.ndarray:
        scene, paths = plan
        return judged(engine, fold, plan, stage) + 10.0 * (paths in best) + 1.0 * (scene == "calibrated")

    monkeypatch.setattr(Engine, "_scores", favouring)
    record, split = measured(scenes, "spectrum", 16)
    settings = ("stages=mean,correction,surfaces", "steps=20")
    run = wrf_mi.train(record, out=tmp_path / "run", scene=stated, split=split, settings=settings)
    again = assert_restored(run, record)
    assert taken(run) == [("paths", "scene", "calibrated"), ("paths", "paths", best[1])]
    assert all(parts_of(opened)["paths"].problem.scene == stated for opened in (run, again))
    assert not (run.folder / "parts" / "paths" / "scene").exists()
    reports = {report["stage"]: report for report in run.metrics["stages"]}
    assert list(reports) == ["mean", "calibration", "correction", "surfaces"]
    assert reports["calibration"]["kept"]
    assert not reports["correction"]["kept"]
    assert list(run.metrics["held_out"]) == ["paths", "hybrid"]


def test_unknown_stages_and_stages_of_other_models_are_refused(flat_folder: Path, tmp_path: Path, capsys) -> None:
    for words, message in (
        (["--stages", "mean,sixth"], "'sixth' is unknown"),
        (["--stages", "mean", "--model", "idw"], "belongs to --model hybrid"),
        (["--preset", "fast", "--model", "idw"], "has no presets"),
        (["--preset", "paper"], "has the presets fast, default"),
    ):
        refused(["train", flat_folder, *words, "--out", tmp_path / "run"], message, capsys)
    assert not contents(tmp_path)
