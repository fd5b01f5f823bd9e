"""The page of a comparison: differences on common rows, what sorts, commands that repeat the runs."""

import json
import re
import shlex
import shutil
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SMALL
from commands import rows_of
from matplotlib.text import Text
from pages import PHONE, open_page
from playwright.sync_api import Browser
from test_compare import captured, edit_metrics, make_run

from wrf_mi.apps.commands.main import build_parser
from wrf_mi.apps.commands.train import training_request
from wrf_mi.core import AntennaOptions, Record, Split
from wrf_mi.models import Session
from wrf_mi.runs import figures
from wrf_mi.runs.api import plan_run, train
from wrf_mi.runs.baselines import warnings_of
from wrf_mi.runs.compare import compare
from wrf_mi.runs.compare_page import changed_settings, command
from wrf_mi.runs.compare_tables import (
    NO_GAIN,
    OTHER_ROWS,
    best_run,
    common,
    common_means,
    differences,
    first_differences,
    method_rows,
)
from wrf_mi.runs.folder import RunRequest, read_config, start_run
from wrf_mi.runs.results import Results
from wrf_mi.runs.run import open_run

pytestmark = pytest.mark.usefixtures("undrawn")


def strengths(
    name: str,
    error_db: Any,
    rows: Any = range(40),
    seed: int = 0,
    idw_db: float = 3.0,
    receivers: int = 1,
    path: Any = "",
    positions_m: Any = None,
    train: Any = (1000, 1001),
) -> Results:
    """Signal strengths with given absolute errors, [m] or [n_rx, m], and those of IDW."""
    rows = np.array(rows)
    truth = np.stack([-50.0 - rows - receiver for receiver in range(receivers)])
    prediction = truth + np.broadcast_to(error_db, truth.shape)
    block = {"median": 1.0, "mean": float(np.nanmean(np.abs(prediction - truth)))}
    metrics = {"abs_error_db": block, "split": "official", "model": name}
    names = tuple(f"anchor{k}" for k in range(receivers))
    positions_m = np.zeros((len(rows), 3)) if positions_m is None else positions_m
    header = (Path(path) / name, name, "rssi", "flat", metrics, seed, names)
    split = Split("official", seed, np.array(train, np.int64), np.zeros(0, np.int64), rows)
    idw: dict[str, Any] = {"idw": truth + idw_db}
    return Results(*header, rows, positions_m, prediction, truth, idw, None, None, {}, splits=[split])


def verdicts(runs: list[Results]) -> dict[tuple[str, str], str]:
    return {(difference.run, difference.against): difference.verdict for difference in differences(runs)}


def test_differences_have_the_sign_of_the_score_and_the_rule_of_the_interval() -> None:
    rng = np.random.default_rng(0)
    good, bad = strengths("good", rng.uniform(0.5, 1.5, 40)), strengths("bad", rng.uniform(3.5, 4.5, 40))
    close = strengths("close", np.abs(good.prediction - good.truth)[0] + rng.normal(0, 0.1, 40) + 0.001)
    runs = [bad, good, close]
    verdict_of = verdicts(runs)
    best = best_run(runs).name
    assert best in ("good", "close")
    other = {"good": "close", "close": "good"}[best]
    assert verdict_of["bad", best] == "worse"
    assert verdict_of[other, best] == "tie"
    reference = "IDW"
    assert {name: verdict_of[name, reference] for name in ("bad", "good")} == {"bad": "worse", "good": "better"}
    against = next(
        difference for difference in differences(runs) if (difference.run, difference.against) == ("bad", best)
    )
    expected = np.mean(np.abs(best_run(runs).prediction - good.truth) - np.abs(bad.prediction - bad.truth))
    assert against.low is not None
    assert against.high is not None
    assert against.difference == pytest.approx(expected)
    assert against.low < expected < against.high < 0


def test_only_rows_with_the_same_truth_and_both_predictions_are_compared() -> None:
    first_run, other = strengths("one", 1.0), strengths("other", 2.0, rows=range(30, 70))
    assert [row for _, row in common([first_run, strengths("equal", 2.0, rows=range(30, 70))])] == list(range(30, 40))
    other.truth[0, 0] = 7.0  # row 30 is another measurement
    other.truth[0, 1] = np.nan  # row 31 was not received
    shared = [row for _, row in common([first_run, other])]
    assert shared == list(range(32, 40))
    assert {difference.rows for difference in differences([first_run, other]) if difference.against == "one"} == {8}
    assert common_means([first_run, other]) == pytest.approx({"one": 1.0, "other": 2.0})
    apart = strengths("apart", 2.0, rows=range(90, 99))
    assert common_means([first_run, apart]) == {}
    assert verdicts([first_run, apart])["apart", "one"] == "too few rows"


def test_runs_of_other_training_rows_have_no_verdict() -> None:
    good, bad, few = strengths("good", 1.0), strengths("bad", 2.0), strengths("few", 3.0, train=[1000])
    verdict_of = verdicts([good, bad, few])
    assert verdict_of["bad", "good"] == "worse"
    assert (verdict_of["few", "good"], verdict_of["bad", "few"]) == (OTHER_ROWS, OTHER_ROWS)
    assert verdict_of["few", "IDW"] == "tie"  # the reference of the same training rows
    assert all(gain.low is None for gain in differences([good, bad, few]) if gain.verdict == OTHER_ROWS)


def test_all_pairs_follow_those_of_the_best_run() -> None:
    runs = [strengths(name, error) for name, error in (("c", 3.0), ("a", 1.0), ("b", 2.0), ("d", 4.0))]
    gains = differences(runs)
    reference = "IDW"
    first = [("c", "a"), ("c", reference), ("a", reference), ("b", "a"), ("b", reference), ("d", "a"), ("d", reference)]
    assert [(gain.run, gain.against) for gain in first_differences(runs, gains)] == first
    others = {(gain.run, gain.against): gain.verdict for gain in gains[len(first) :]}
    assert others == {("c", "b"): "worse", ("c", "d"): "better", ("b", "d"): "better"}


def test_intervals_of_rows_along_a_path_are_those_of_its_stretches() -> None:
    """The standard error of a mean is that of 20 independent stretches of 10 equal rows, in any order of the rows."""
    rng, rows = np.random.default_rng(0), np.arange(200)
    stretch = rng.permutation(20)
    error, x_m = np.repeat(rng.uniform(1, 3, 20), 10), 10.0 * np.repeat(stretch, 10) + np.tile(np.arange(10), 20) / 10
    place_m = np.stack([x_m, 0 * x_m, 0 * x_m], axis=1)
    expected = 2 * 1.96 * np.std(error[::10]) / np.sqrt(20)
    orders = rows, rng.permutation(rows)
    widths = []
    for order in orders:
        gain = differences([strengths("walk", error[order], rows, idw_db=2.0, positions_m=place_m[order])])[0]
        assert gain.blocks == 20
        widths.append(gain.high - gain.low)
    assert widths == pytest.approx([expected] * 2, rel=0.1)  # 2,000 resamples: 3 % of a quantile
    unknown = differences([strengths("walk", error, rows, idw_db=2.0, positions_m=place_m * np.nan)])[0]
    assert unknown.high - unknown.low == pytest.approx(expected, rel=0.1)


def test_receivers_of_a_row_count_as_one_observation() -> None:
    """Their errors are not independent: two copies of a receiver leave the interval as it is."""
    error = np.random.default_rng(1).uniform(1, 3, 40)
    single = differences([strengths("a", error, idw_db=2.0)])[0]
    double = differences([strengths("a", np.stack([error, error]), idw_db=2.0, receivers=2)])[0]
    assert (single.rows, double.rows) == (40, 40)
    assert (single.low, single.high) == (double.low, double.high)


@pytest.fixture(scope="module")
def seeds(flat_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders with the configurations of three seeds."""
    out = tmp_path_factory.mktemp("seeds")
    for seed in range(3):
        _, config, splits = plan_run(flat_folder, RunRequest("trees", seed=seed))
        start_run(out / f"seed{seed}", config, splits)
    return [out / f"seed{seed}" for seed in range(3)]


def test_all_seeds_must_agree(seeds: list[Path]) -> None:
    runs = [
        strengths(path.name, error, seed=k, path=path.parent)
        for k, (path, error) in enumerate(zip(seeds, (1.0, 1.0, 3.5), strict=True))
    ]
    runs.append(strengths("worst", 5.0))
    verdict_of = verdicts(runs)
    reference = "IDW"
    assert {verdict_of[path.name, reference] for path in seeds} == {"tie"}  # one of three seeds is worse
    assert verdict_of["worst", reference] == "worse"
    assert verdict_of["worst", "seed0"] == "worse"
    assert verdict_of["seed2", "seed0"] == "another seed"
    assert ("seed1", "seed2") not in verdict_of  # a method is not compared with itself
    best, worst = method_rows(runs)
    assert (best["method"], best["seeds"]) == ("seed0, seed1, seed2", 3)
    assert (worst["method"], worst["mean_sd"]) == ("worst", None)
    assert (best["mean"], best["mean_sd"]) == pytest.approx((5.5 / 3, np.std([1, 1, 3.5], ddof=1)))
    assert (worst["difference"], worst["low"], best["difference"]) == pytest.approx((5.5 / 3 - 5, 5.5 / 3 - 5, 0))
    elsewhere = method_rows([*runs[:3], strengths("other", 5.0, train=(1, 2))])[1]
    assert elsewhere["difference"] is None  # trained on other rows
    assert not method_rows([runs[0], runs[3]])  # no method of several seeds


def test_predictions_of_another_program_are_seeds_of_one_method() -> None:
    def mine(name: str, seed: int) -> Results:
        run = strengths(name, 1.0, seed=seed)
        return replace(run, metrics={**run.metrics, "model": "mine", "predictions": f"{name}.npz"})

    assert [row["method"] for row in method_rows([mine("a", 0), mine("b", 1), strengths("c", 2.0)])] == ["a, b", "c"]
    drawn = [mine("a", 0), replace(mine("b", 1), splits=strengths("b", 1.0, seed=1, train=(3, 4)).splits)]
    assert [row["difference"] for row in method_rows([*drawn, strengths("c", 2.0)])] == [0, None]  # seeds draw rows
    assert not method_rows([mine("a", 0), mine("b", 0)])  # what differs is not stated


def every_run(folder: Path, flat_folder: Path) -> list[tuple[Path, dict[str, Any]]]:
    """Data and arguments of `plan_run` that differ much from the defaults."""
    antennas, scene = AntennaOptions(rx_pattern="dipole", tx_polarization="H"), {"scene": flat_folder / "room"}
    fitted = {"settings": [*SMALL[:-1], "steps=7"], "seed": 3, "split": "random", "n_train": 0.5}
    pixel = {"settings": ["loss.ssim_weight=0.25"], "receiver": "pixel", "deterministic": True}
    return [
        (folder, {"model": "wrf-gs+", **fitted}),
        (folder, {"model": "wrf-gs", **pixel}),
        (folder, {"model": "factorised", "evaluation": "splatted", "split": "blocked:1"}),
        (flat_folder, {"model": "kriging", "intervals": True, "n_train": 20}),
        (flat_folder, {"model": "hybrid", "antennas": antennas, **scene}),
        (flat_folder, {"model": "ray-tracing", "settings": ["depth=1", "rays=4096"], **scene}),
        (flat_folder, {"model": "wrf-gs+", "settings": ["traced.depth=1"], **scene}),
        (folder, {"model": "wrf-gs+", "preset": "fast", "settings": ["steps=9", "validate_every=1000"]}),
        (folder, {"model": "wrf-gs", "preset": "paper"}),
        (flat_folder, {"model": "hybrid", "preset": "fast"}),
    ]


def test_commands_parse_and_give_the_same_configuration(folder: Path, flat_folder: Path, tmp_path: Path) -> None:
    from wrf_mi.scene.make import make_scene

    flat = Path(shutil.copytree(flat_folder, tmp_path / "a flat"))
    make_scene(flat / "layout.csv", flat / "room", height_m=2.7)
    for dataset, arguments in every_run(folder, flat):
        _, config, _ = plan_run(str(dataset), RunRequest(**arguments))
        line = command(config, tmp_path / "it's a run")
        program, *words = shlex.split(line)
        assert program == "wrf-mi"
        parsed = build_parser().parse_args(words)
        assert parsed.out == str(tmp_path / "it's a run")
        again = plan_run(parsed.dataset, training_request(parsed))[1]
        assert again == config, line


def test_run_that_the_command_calls_no_better_than_a_constant_is_not_praised(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name, noise=noise) for name, noise in (("constant", 0.1), ("fine", 0.1))]
    block = {"median": 0.9, "mean": 0.9, "p10": 0.8, "p90": 1.0, "gain": 0.0, "gain_error": 0.1}
    for run, beaten in zip(runs, (False, True), strict=True):
        edit_metrics(constant=block | {"beaten": beaten})(run)
    text = unescape(compare(runs, tmp_path / "out").read_text())
    verdicts = {
        row["run"]: row["verdict"] for row in rows_of(tmp_path / "out" / "differences.csv") if "IDW" in row["against"]
    }
    assert verdicts == {"constant": NO_GAIN, "fine": "better"}
    assert text.count('class="better"') == 1
    lines = [warnings_of(json.loads((run / "metrics.json").read_text())) for run in runs]
    assert lines[1] == []
    assert f"constant: {lines[0][0]}" in text


def test_settings_of_a_run_are_those_that_differ(folder: Path, tmp_path: Path, one_gateway: Record) -> None:
    steps = [*SMALL, "loss.ssim_weight=0.25"]
    run = train(folder, "wrf-gs+", out=tmp_path / "run", settings=steps, seed=2).folder
    changed = changed_settings(read_config(run))
    resolved = "encoding.tx_scale_m"  # found from the data, which the command leaves to be found again
    assert set(changed) - {resolved} == {setting.partition("=")[0] for setting in steps}
    parsed = build_parser().parse_args(shlex.split(command(read_config(run), tmp_path / "again"))[1:])
    problem, config, splits = plan_run(parsed.dataset, training_request(parsed))
    settings = config.entry.prepare(problem, splits, Session(run, run))
    assert replace(config, settings=settings) == open_run(run).config
    page = compare([run], tmp_path / "out").read_text()
    assert command(read_config(run), run) in unescape(page)
    assert "loss.ssim_weight=0.25" in page
    assert "deformation network" in page
    assert "mitsuba 3" in page


class Tags(HTMLParser):
    """Tags that are not closed in order, and addresses that a browser would load."""

    ALONE = ("meta", "img", "br", "p", "dt", "dd", "html")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.addresses += [value for name, value in attrs if name in ("src", "href") and value]
        if tag not in self.ALONE:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.ALONE:
            assert self.open.pop() == tag


def test_page_is_one_well_formed_file_of_several_data_sets(tmp_path: Path) -> None:
    runs = [make_run(tmp_path / "a<b>&"), make_run(tmp_path / "second", noise=0.4, model="idw")]
    other = make_run(tmp_path / "other")
    edit_metrics(dataset="another/<place>")(other)
    page = compare([*runs, other], tmp_path / "out").read_text()
    tags = Tags()
    tags.feed(page)
    assert tags.open == []
    assert {address.partition(",")[0] for address in tags.addresses} == {"data:image/png;base64", "#room", "#_place_"}
    assert "a<b>" not in page
    assert "<place>" not in page
    assert page.count("<h2 ") == 2
    assert "6 test rows are common to all runs" in page
    assert "higher is better" in page
    rows = rows_of(tmp_path / "out" / "differences.csv")
    assert [(row["run"], row["against"], row["verdict"]) for row in rows] == [
        ("a<b>&", "IDW", "better"),
        ("second", "a<b>&", "worse"),
        ("second", "IDW", "worse"),
        ("other", "IDW", "better"),
    ]


def test_a_click_sorts_the_table_in_a_browser(browser: Browser, tmp_path: Path) -> None:
    runs = [make_run(tmp_path / name, noise=noise) for name, noise in (("m", 0.2), ("a", 0.4), ("z", 0.1))]
    view = open_page(browser, compare(runs, tmp_path / "out"), PHONE)
    table = view.page.locator("table.sorts").first
    median = table.locator("button", has_text=re.compile("^median$"))

    def names() -> list[str]:
        cells = table.locator("tbody tr td:first-child").all_inner_texts()
        return [name for name in cells if name in ("a", "m", "z")]

    median.click()
    assert names() == ["a", "m", "z"]
    median.click()
    assert names() == ["z", "m", "a"]
    assert view.page.evaluate("document.documentElement.scrollWidth") == PHONE[0]  # wide tables and pictures scroll
    assert view.complaints == []
    view.page.close()


def test_maps_show_errors_and_the_best_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls, errors, times = (captured(monkeypatch, name) for name in ("choice_map", "position_table", "time_scatter"))
    good, bad = make_run(tmp_path / "good", rows=range(9)), make_run(tmp_path / "bad", noise=0.5)
    compare([good, bad], tmp_path / "out")
    best, names, _ = calls[-1]
    assert names == ["good", "bad"]
    assert best.tolist() == [0] * 6 + [-1] * 3  # three rows are predicted by one run alone
    (rows, columns, _, label) = errors[-1]
    assert (columns, label) == (["good", "bad"], "SSIM")
    assert np.isnan(rows[0][1][1]).tolist() == [False] * 6 + [True] * 3
    panels, scores, _ = times[-1]
    assert panels["ms per sample"] == {"good": 3.25, "bad": 3.25}
    assert scores["good"] > scores["bad"]
    texts = [text.get_text() for text in figures.time_scatter(*times[-1]).findobj(Text)]
    assert not any("$" in text for text in texts)
