"""The comparison of runs, on run folders made here."""

import base64
import json
import re
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal, remove, write
from commands import arrays_in, rows_of
from matplotlib.figure import Figure
from PIL import Image

from wrf_mi.core import InputError, Split
from wrf_mi.core.array_files import write_arrays
from wrf_mi.core.files import write_figure
from wrf_mi.datasets import save_split
from wrf_mi.runs import figures
from wrf_mi.runs.compare import compare
from wrf_mi.runs.compare_tables import COLUMNS
from wrf_mi.runs.results import read_run
from wrf_mi.tasks.scores import ssim, summary

pytestmark = pytest.mark.usefixtures("undrawn")
SHAPE = (10, 24)


def make_run(
    path, *, model="wrf-gs+", split="official", rows=range(6), noise=0.1, trained=True, receivers=None, seed=7
):
    """A run folder with random truth that depends on the row alone."""
    path.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    lead = () if receivers is None else (receivers,)
    truth = np.stack([np.random.default_rng(r).random((*lead, *SHAPE)) for r in rows], axis=len(lead))
    truth = truth.astype(np.float32)
    prediction, blend = (np.clip(truth + s * rng.standard_normal(truth.shape), 0, 1) for s in (noise, 0.3))
    arrays = {
        **{"row": np.array(rows), "tx_pos": np.zeros((len(rows), 3)), "truth": truth},
        **{"prediction": prediction.astype(np.float32), "reference_idw": blend.astype(np.float32)},
        "receiver_name": [f"gateway{r}" for r in range(receivers or 1)],
    }
    write_arrays(path / "predictions.npz", arrays)
    score, reference = (summary(ssim(values, truth)) for values in (prediction, blend))
    metrics = {
        **{"task": "spectrum", "dataset": "made/room", "model": model, "split": split, "seed": seed},
        **{"n_train": 20, "n_test": len(rows), "ssim": score, "reference": {"idw": {"median": reference["median"]}}},
        **{"ms_per_sample": 3.25, "train_seconds": 61.5 if trained else 0.0, "peak_memory_mb": 512.0},
    }
    (path / "metrics.json").write_text(json.dumps(metrics))
    train, validation, test = (np.array(part, int) for part in ([1000], [], rows))
    save_split(path / "split.npz", Split(split, seed, train, validation, test))
    if trained:
        write_log(path)
    return path


def write_log(path):
    path.mkdir(exist_ok=True)
    with (path / "log.jsonl").open("w") as file:
        # The last score is of rows that are trained on by then: it belongs in no picture.
        for step in range(5):
            entry = {"step": step, "seconds": 10.0 * step, "loss": 1.0, "gaussians": 5, "held_out": step < 4}
            file.write(json.dumps(entry | {"validation_score": 0.2 * step if step else None}) + "\n")


def test_table_contains_the_metrics_of_the_runs(tmp_path):
    good, bad = make_run(tmp_path / "good", seed=3), make_run(tmp_path / "bad", model="idw", noise=0.5, trained=False)
    page = compare([good, bad], tmp_path / "out")
    table = rows_of(tmp_path / "out" / "compare.csv")
    assert list(table[0]) == list(COLUMNS)
    metrics = json.loads((good / "metrics.json").read_text())
    medians = [float(row["median"]) for row in table]
    ranks = [int(row["rank"]) for row in table]
    assert sorted(ranks) == [1, 2, 3, 4]
    by_rank = [medians[ranks.index(rank)] for rank in (1, 2, 3, 4)]
    assert by_rank == sorted(medians, reverse=True)  # SSIM
    assert [row["run"] for row in table][:2] == ["good", "bad"]  # as given
    by_run = {row["run"]: row for row in table}
    assert [by_run[name]["model"] for name in ("good", "bad")] == ["wrf-gs+", "idw"]
    assert [by_run[name]["seed"] for name in ("good", "bad")] == ["3", "7"]
    for key in ("median", "mean", "p10", "p90"):
        assert float(by_run["good"][key]) == metrics["ssim"][key]
    assert metrics["reference"]["idw"]["median"] in medians
    assert float(by_run["good"]["ms_per_sample"]) == 3.25
    assert float(by_run["good"]["median"]) > float(by_run["bad"]["median"])
    assert page == tmp_path / "out" / "index.html"


def test_page_shows_every_picture_that_was_written(tmp_path, monkeypatch):
    monkeypatch.setattr("wrf_mi.runs.compare.write_figure", write_figure)  # draws
    make_run(tmp_path / "a<b")
    page = compare([tmp_path / "a<b"], tmp_path / "out").read_text()
    assert "a&lt;b" in page
    assert "a<b" not in page
    names = [f"room-{what}.png" for what in ("cdf", "samples", "errors", "training")]
    shown = re.findall(r'src="([^"]+)"', page)
    assert len(shown) == len(names)
    for source, name in zip(shown, names, strict=True):
        # The page carries its pictures: it can be sent as one file.
        kind, _, data = source.partition(",")
        assert kind == "data:image/png;base64"
        assert base64.b64decode(data) == (tmp_path / "out" / name).read_bytes()
        with Image.open(tmp_path / "out" / name) as picture:
            assert np.ptp(np.asarray(picture.convert("L"))) > 100
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(
        [*names, "compare.csv", "differences.csv", "index.html"]
    )


def test_training_is_drawn_of_trained_runs_and_of_the_folds_of_a_blocked_one(tmp_path):
    run = make_run(tmp_path / "blocked", split="blocked", trained=False)
    assert "<h3>Training</h3>" not in compare([run], tmp_path / "untrained").read_text()
    assert not (tmp_path / "untrained" / "room-training.png").exists()
    write_log(run / "fold0")
    write_log(run / "fold1")
    curve = [(10.0, 0.2), (20.0, 0.4), (30.0, pytest.approx(0.6))]
    assert read_run(run).validation == {"fold0": curve, "fold1": curve}
    assert "<h3>Training</h3>" in compare([run], tmp_path / "out").read_text()


def captured(monkeypatch, name):
    """Arguments of the last call of a drawing function, which still draws."""
    calls = []
    draw = getattr(figures, name)

    def spy(*args, **kwargs):
        calls.append(args)
        return draw(*args, **kwargs)

    monkeypatch.setattr(figures, name, spy)
    return calls


def test_pictures_show_rows_that_all_runs_predict(tmp_path, monkeypatch):
    calls = captured(monkeypatch, "spectrum_table")
    few, many = make_run(tmp_path / "few", rows=[8, 2, 4]), make_run(tmp_path / "many", rows=range(9), split="blocked")
    compare([many, few], tmp_path / "out")
    rows, columns = calls[-1]
    assert {name for name, _ in rows} == {"row 2", "row 4", "row 8"}
    assert columns[:3] == ["measured", "many", "few"]
    for name, (truth, of_many, of_few, _) in rows:
        r = int(name.split()[1])
        assert np.array_equal(truth, np.random.default_rng(r).random(SHAPE).astype(np.float32))
        assert np.array_equal(of_many, read_run(many).prediction[0, r])
        assert np.array_equal(of_few, read_run(few).prediction[0, [8, 2, 4].index(r)])
    scores = [read_run(many).score[0, int(name.split()[1])] for name, _ in rows]
    assert scores == sorted(scores)


def test_runs_without_common_rows_leave_plots_empty(tmp_path, monkeypatch):
    calls = captured(monkeypatch, "spectrum_table")
    compare([make_run(tmp_path / "a", rows=[0, 1]), make_run(tmp_path / "b", rows=[5, 6])], tmp_path / "out")
    for _, (_, of_a, of_b, _) in calls[-1][0]:
        assert of_a is not None
        assert of_b is None


def test_reference_is_drawn_once_for_equal_rows(tmp_path, monkeypatch):
    calls = captured(monkeypatch, "score_cdf")
    runs = [make_run(tmp_path / "a"), make_run(tmp_path / "b", noise=0.2), make_run(tmp_path / "c", rows=[3, 4])]
    compare(runs, tmp_path / "out")
    scores, references, label = calls[-1]
    assert label == "SSIM"
    assert list(scores) == ["a", "b", "c"]
    assert list(references) == ["IDW, official", "IDW, official of c"]


def test_several_receivers_are_pooled_and_named(tmp_path, monkeypatch):
    calls, pictures = captured(monkeypatch, "score_cdf"), captured(monkeypatch, "spectrum_table")
    run = make_run(tmp_path / "two", receivers=2)
    score = read_run(run).score
    assert score.shape == (2, 6)
    compare([run], tmp_path / "out")
    np.testing.assert_array_equal(np.sort(np.ravel(calls[-1][0]["two"])), np.sort(score.ravel()))
    row = rows_of(tmp_path / "out" / "compare.csv")[0]
    assert float(row["median"]) == pytest.approx(np.median(score), abs=1e-3)
    assert all(re.fullmatch(r"row \d, gateway[01]", name) for name, _ in pictures[-1][0])


def test_runs_of_equal_names_get_different_names(tmp_path):
    compare([make_run(tmp_path / "x" / "run"), make_run(tmp_path / "y" / "run")], tmp_path / "out")
    assert [row["run"] for row in rows_of(tmp_path / "out" / "compare.csv")][:2] == ["x/run", "y/run"]


def edit_metrics(**changes):
    def edit(run):
        metrics = json.loads((run / "metrics.json").read_text()) | changes
        (run / "metrics.json").write_text(json.dumps({k: value for k, value in metrics.items() if value is not ...}))

    return edit


def edit_arrays(change):
    def edit(run):
        arrays: dict[str, Any] = arrays_in(run / "predictions.npz")
        change(arrays)
        write_arrays(run / "predictions.npz", arrays)

    return edit


UNFINISHED_LOG = '{"step": 1, "seconds": 1, "validation_score": 1, "held_out": true}\n{"st'


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (remove("metrics.json"), "no metrics.json, so no finished run"),
        (remove("predictions.npz"), "predictions.npz: missing"),
        (write("metrics.json", "{"), "not readable"),
        (write("predictions.npz", "not a zip"), "predictions.npz: not readable"),
        (write("log.jsonl", UNFINISHED_LOG), "line 2 is no log entry"),
        (write("config.yaml", "seed: 1"), "format not stated, this version reads 5; train it anew"),
        (edit_metrics(task="rssi"), "no abs_error_db or no reference idw"),
        (edit_metrics(n_test=...), "no n_test"),
        (edit_metrics(reference={}), "no reference idw"),
        (edit_arrays(lambda arrays: arrays.pop("reference_idw")), "reference_idw"),
        (edit_metrics(task="colour"), "task 'colour'; known are spectrum, rssi, csi"),
        *(
            (edit_arrays(change), "shapes do not fit together .*; run evaluate to write it anew")
            for change in (
                lambda arrays: arrays.update(truth=arrays["truth"][:-1]),
                lambda arrays: arrays.update(prediction=arrays["prediction"][..., None]),
                lambda arrays: arrays.update(receiver_name=np.repeat(arrays["receiver_name"], 2)),
                lambda arrays: arrays.update(tx_pos=arrays["tx_pos"][:, :2]),
            )
        ),
    ],
)
def test_damaged_run_is_named_in_one_line_and_nothing_is_written(tmp_path, damage, message):
    run = make_run(tmp_path / "run")
    damage(run)
    assert str(run) in refusal(lambda run: compare([run], tmp_path / "out"), run, message)
    assert not (tmp_path / "out").exists()


def test_missing_repeated_or_other_folders_are_refused(tmp_path):
    run = make_run(tmp_path / "run")
    for runs, message in (
        ([], "nothing to compare"),
        ([run, tmp_path / "no"], "no such folder"),
        ([run, run], "twice"),
    ):
        with pytest.raises(InputError, match=message):
            compare(runs, tmp_path / "out")
    with pytest.raises(InputError, match="something else than a comparison"):
        compare([run], run)
    assert (run / "metrics.json").is_file()


def test_polar_picture_puts_a_lobe_at_its_azimuth_and_elevation(tmp_path):
    """A bright spot at azimuth 90, elevation 60 is drawn straight above the centre, a third of the way out."""
    spectrum = np.zeros((90, 360))
    spectrum[55:66, 85:96] = 1
    figure = Figure(figsize=(3, 3))
    axes = figure.add_axes((0, 0, 1, 1), projection="polar")
    figures.polar_spectrum(axes, spectrum)
    axes.set_axis_off()
    with Image.open(write_figure(tmp_path / "polar.png", figure)) as picture:
        green = np.asarray(picture.convert("RGB")).astype(int)
    middle = len(green) / 2
    yellow = (green[..., 0] > 200) & (green[..., 1] > 200) & (green[..., 2] < 120)
    row, column = np.argwhere(yellow).mean(axis=0)
    assert column == pytest.approx(middle, abs=2)
    assert row == pytest.approx(middle * (1 - 30 / 90), abs=2)


def test_comparison_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    run, out = make_run(tmp_path / "run"), tmp_path / "out"
    compare([run], out)
    (out / "old.png").write_bytes(b"")
    page = compare([run], out).read_text()
    assert not (out / "old.png").exists()

    def fail(*_):
        raise RuntimeError("no picture")

    monkeypatch.setattr("wrf_mi.runs.compare.write_figure", fail)
    for folder in (out, tmp_path / "new"):
        with pytest.raises(RuntimeError, match="no picture"):
            compare([run], folder)
    assert (out / "index.html").read_text() == page
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "run"]
