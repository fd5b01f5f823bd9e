"""The table of radio fields: entries of any program, their checks, and the page."""

import json
import re
import shutil
from html import unescape
from pathlib import Path

import numpy as np
import pytest
from documents import CHECKOUT
from pages import PHONE, open_page
from playwright.sync_api import Browser

import wrf_mi
from wrf_mi.apps.commands.main import main
from wrf_mi.apps.table.add import KEPT, add_entry, check_table
from wrf_mi.apps.table.entries import Entry, read_entries, read_entry, write_entry
from wrf_mi.apps.table.page import BUILDINGS, FEW, QUESTIONS, REGIONS, group_rows, question_of, table_page, verdict
from wrf_mi.apps.table.sources import FOLDER, read_sources
from wrf_mi.core import InputError, Record
from wrf_mi.datasets import write_ble_folder

RNG = np.random.default_rng(5)
ROWS = 40


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of strengths of two receivers in a folder."""
    receivers = tuple(
        wrf_mi.Receiver(f"r{k}", np.array([4.0 * k, 1.0, 2.0]), np.array([0.0, 0, 0, 1])) for k in range(2)
    )
    place_m = RNG.uniform(0, 6, (ROWS, 3)) * [1, 1, 0] + [0, 0, 1.2]
    range_m = np.linalg.norm(place_m - np.stack([receiver.position_m for receiver in receivers])[:, None], axis=2)
    observed = -40 - 20 * np.log10(range_m) + RNG.normal(0, 1, range_m.shape)
    official = np.arange(30), np.arange(30, ROWS)
    record = Record(
        "flat", "rssi", place_m, receivers, observed.astype(np.float32), official, frequencies_hz=np.array([2.4e9])
    )
    return Path(write_ble_folder(tmp_path_factory.mktemp("data") / "flat", record))


@pytest.fixture
def table(flat: Path, tmp_path: Path) -> Path:
    """A table with that data set."""
    place = tmp_path / "table"
    arguments = ["--name", "flat", "--licence", "MIT", "--origin", "made", "--get", "none", "--table", str(place)]
    assert main(["table", "dataset", str(flat), *arguments, "--split", "official", "--split", "blocked"]) == 0
    return place


@pytest.fixture
def predictions(flat: Path, tmp_path: Path) -> Path:
    """Predictions of the test rows by another program: a law of distance."""
    record = wrf_mi.load(flat)
    assert record.official is not None
    test = record.official[1]
    prediction = record.observation[:, test] + np.array([[1.0], [-3.0]])
    np.savez(tmp_path / "mine.npz", row=test, prediction=prediction, ms_per_sample=2.0)
    return tmp_path / "mine.npz"


def test_predictions_of_another_program_become_an_entry(
    table: Path, flat: Path, predictions: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--dataset", str(flat), "--method", "mine", "--origin", "https://example.org", "--train-seconds", "12"]
    assert main(["table", "add", str(predictions), *words, "--table", str(table)]) == 0
    (entry,) = read_entries(table).values()
    assert (entry.method, entry.dataset, entry.split, entry.n_test) == ("mine", "flat", "official", 10)
    # Errors of 1 dB at one receiver and -3 dB at the other.
    assert entry.score["mean"] == pytest.approx(2.0, abs=1e-4)
    assert entry.score["bias"] == pytest.approx(-1.0, abs=1e-4)
    assert entry.score["rmse"] == pytest.approx(np.sqrt(5), abs=1e-4)
    assert entry.mean_interval == pytest.approx([2.0, 2.0], abs=1e-4)  # each row has both errors
    assert (entry.train_seconds, entry.ms_per_sample, entry.origin) == (12.0, 2.0, "https://example.org")
    assert entry.constant is not None
    assert entry.reference is not None
    with np.load(table / KEPT / f"{entry.name}.npz") as stored:
        assert set(stored) == {"row", "receiver_name", "prediction"}  # the measurements stay with their authors
    assert main(["table", "check", "--table", str(table)]) == 0
    capsys.readouterr()
    assert main(["table", "add", str(predictions), *words, "--table", str(table)]) == 2
    assert "exists; give --replace" in capsys.readouterr().err


def test_a_run_folder_becomes_an_entry_whose_command_has_no_place(table: Path, flat: Path, tmp_path: Path) -> None:
    run = wrf_mi.train(str(flat), "idw", out=tmp_path / "idw", n_train=12)
    entry = read_entry(add_entry(table, run.folder, None, None, label="IDW"))
    assert entry.name == "rssi-flat-official-idw-12rows-seed0"
    assert entry.score["median"] == run.metrics["abs_error_db"]["median"]
    assert entry.command == "wrf-mi train flat --model idw --split official --n-train 12 --out RUN"
    assert main(["table", "add", str(run.folder), "--split", "random", "--table", str(table)]) == 2  # it has its own
    assert check_table(table).faults == []


def test_what_differs_from_the_table_is_found(table: Path, flat: Path, predictions: Path, tmp_path: Path) -> None:
    path = add_entry(table, predictions, str(flat), "mine")
    home = tmp_path / "home"
    shutil.copytree(flat, home / "flat")
    source = table / FOLDER / "flat.yml"
    # Another split, and a score that its predictions do not have; the data set is found by its folder's name.
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(home)
        before = check_table(table)
        assert (before.entries, before.scored, before.absent, before.faults) == (1, 1, [], [])
        text = source.read_text()
        source.write_text(re.sub(r"(official: )\w+", r"\g<1>0123456789abcdef", text))
        content = json.loads(path.read_text())
        content["score"]["median"] += 0.01
        path.write_text(json.dumps(content))
        faults = check_table(table).faults
    assert any("split official" in fault and "0123456789abcdef" in fault for fault in faults)
    assert any("median" in fault and "its predictions score" in fault for fault in faults)
    assert len(faults) == 2


def test_other_observations_and_unknown_data_are_refused(table: Path, flat: Path, predictions: Path) -> None:
    with pytest.raises(InputError, match="not among the table's data sets; add it by `wrf-mi table dataset laboratory"):
        add_entry(table, predictions, "laboratory", "mine")
    with pytest.raises(InputError, match="need --dataset and --method"):
        add_entry(table, predictions, None, "mine")
    source = table / FOLDER / "flat.yml"
    source.write_text(re.sub(r"(observations: )\w+", r"\g<1>0123456789abcdef", source.read_text()))
    with pytest.raises(InputError, match="not among"):
        add_entry(table, predictions, str(flat), "mine")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"method": None}, "lacks method"),
        ({"colour": "red"}, "unknown field colour"),
        ({"task": "light"}, "task 'light'; give one of"),
        ({"seed": 3}, "its fields are of rssi-a-official-b-100-seed3; rename or correct it"),
    ],
)
def test_entries_that_cannot_be_read_are_named(tmp_path: Path, change: dict[str, object], words: str) -> None:
    path = write_entry(tmp_path, made("b", 3.0))
    content = {key: value for key, value in (json.loads(path.read_text()) | change).items() if value is not None}
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=re.escape(words)):
        read_entries(tmp_path)


def test_a_table_that_is_not_there_and_data_that_are_not_here_are_named(
    table: Path, flat: Path, predictions: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["table", "page", "--out", str(tmp_path / "x.html"), "--table", str(tmp_path / "no")]) == 2
    assert "no such folder" in capsys.readouterr().err
    add_entry(table, predictions, str(flat), "mine")
    assert main(["table", "check", "--table", str(table)]) == 0
    out = capsys.readouterr().out
    assert "1 entries, 0 with predictions that were scored again" in out
    assert "not on this machine, and not checked: flat" in out


def made(method: str, median: float, **more: object) -> Entry:
    score = {"median": median, "mean": median, "p10": median - 1, "p90": median + 1}
    facts = {"method": method, "label": method, "task": "rssi", "dataset": "a", "split": "official", "score": score}
    return Entry(**{**facts, "date": "2026-01-01", **more})  # type: ignore[arg-type]


def test_constant_and_simple_models_stand_beside_methods() -> None:
    constant = {"median": 9.0, "words": "the mean"}
    entries = [made("field", 3.0, constant=constant), made("field", 5.0, seed=1), made("kriging", 3.5)]
    entries[2] = made("kriging", 3.5, reference={"idw": {"median": 8.0, "neighbours": [16]}})
    rows = group_rows(entries)
    assert [(row["method"], row["median"]) for row in rows] == [
        ("kriging", 3.5),
        ("field", 4.0),  # mean over its seeds
        ("IDW of 16 nearest (reference)", 8.0),
        ("constant: the mean", 9.0),
    ]
    assert [row["rank"] for row in rows] == [1, 2, 3, 4]
    assert "behind the best simple model: kriging, 3.5; constant: the mean, 9" in verdict(rows, "error")
    level = group_rows([made("field", 3.501), made("kriging", 3.5)])
    assert "level with the best simple model" in verdict(level, "error")
    pooled = [*entries, made("field", 2.0, seed=None)]
    assert [row["median"] for row in group_rows(pooled) if row["kind"] == "field"] == [2.0]


def test_questions_follow_from_split_rows_and_data(table: Path) -> None:
    sources = read_sources(CHECKOUT / "benchmarks" / "table")
    assert question_of(made("b", 1, split="blocked", share=40), sources) == REGIONS
    assert question_of(made("b", 1, share=40), sources) == FEW
    assert question_of(made("b", 1, dataset="mall-f3"), sources) == BUILDINGS


def test_stored_table_has_nothing_wrong_and_its_page_fits_a_telephone(browser: Browser, tmp_path: Path) -> None:
    place = CHECKOUT / "benchmarks" / "table"
    assert {entry.dataset for entry in read_entries(place).values()} - {"random-room"} <= set(read_sources(place))
    page = tmp_path / "table.html"
    page.write_text(table_page(place), encoding="utf-8")
    text = unescape(page.read_text(encoding="utf-8"))
    assert all(f">{question}</h2>" in text for question in QUESTIONS)
    assert "Stated by papers, for other data" in text
    view = open_page(browser, page, PHONE)
    assert view.page.evaluate("document.documentElement.scrollWidth") == PHONE[0]
    assert view.complaints == []
    view.page.close()


@pytest.mark.slow
def test_stored_predictions_score_as_their_entries_state() -> None:
    assert check_table(CHECKOUT / "benchmarks" / "table").faults == []
