"""Numbers for "not heard", zeros and nearly silent receivers are suspected, measured strengths are not."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calling import call
from checked_records import channels, spectra, strengths
from hypothesis import given, settings
from hypothesis import strategies as st
from made_building import TRAINED, building, silent_in
from scipy.stats import truncnorm

from wrf_mi.checking import check_data
from wrf_mi.checking.rows import few_rows, not_heard
from wrf_mi.core import Record
from wrf_mi.datasets import write_ble_folder
from wrf_mi.datasets.sentinels import suspicious_values
from wrf_mi.runs.api import train

DRAWS = np.random.default_rng(0)
SENTINELS = (-999.0, -200.0, -127.0, -110.0, -101.0, -100.0, -1.0, 0.0, 1.0, 100.0, 127.0)


def marked(share: float, mark: float, *receivers: int, whole_db: bool = True) -> Record:
    """Strengths of a building, where some receivers state a number in their weakest rows, a share of all."""
    record = building()
    observed = np.round(record.observation, 0 if whole_db else 1)
    for receiver in receivers:
        count = max(round(share * len(record)), 1)
        observed[receiver, np.argsort(observed[receiver])[:count]] = mark
    return replace(record, observation=observed)


@pytest.mark.parametrize("share", [0.04, 0.3, 0.6, 0.9])
@pytest.mark.parametrize("mark", SENTINELS)
@pytest.mark.parametrize("whole_db", [True, False])
def test_numbers_for_not_heard_are_named_with_receiver_share_and_rows(
    mark: float, share: float, whole_db: bool
) -> None:
    record = marked(share, mark, 1, whole_db=whole_db)
    rows, count = len(record), int((record.observation[1] == mark).sum())
    ((name, text),) = list(not_heard(record))
    assert name == "not-heard"
    assert text.startswith(f"{mark:g} dBm, apart from all other strengths: a number for 'not heard'")
    assert f": stairs {100 * count / rows:.2g} % ({count} of {rows} rows); leave the field empty" in text


def test_a_number_that_each_receiver_has_once_shows_in_all_together() -> None:
    record = building()
    for receiver in range(3):
        record.observation[receiver, 7 * receiver] = -100
    ((_, text),) = list(not_heard(record))
    assert text.startswith("-100 dBm, apart from")
    assert "hall 1.9 % (1 of 52 rows), stairs 1.9 % (1 of 52 rows), lab 1.9 % (1 of 52 rows)" in text


@pytest.mark.parametrize("mark", [-200, 0, 100])
def test_a_receiver_that_states_it_in_every_row_is_named_with_the_others(mark: float) -> None:
    record = marked(0.3, mark, 0)
    record.observation[2] = mark
    ((_, text),) = list(not_heard(record))
    assert "hall 31 % (16 of 52 rows), lab 100 % (52 of 52 rows)" in text


def test_several_numbers_are_named_each() -> None:
    record = marked(0.2, -200, 0)
    record.observation[1, :9] = 100
    record.observation[2, ::5] = 0
    texts = [text.partition(" dBm")[0] for _, text in not_heard(record)]
    assert texts == ["-200", "0", "100"]


def test_strengths_clipped_at_the_sensitivity_are_told_from_marks() -> None:
    record = building()
    observed = np.round(record.observation)
    floor_dbm = np.sort(observed[0])[25]
    observed[0] = np.maximum(observed[0], floor_dbm)
    ((name, text),) = list(not_heard(replace(record, observation=observed)))
    assert name == "not-heard"
    assert text.startswith(
        f"{floor_dbm:g} dBm, far more often than the strengths next to it: clipped at the sensitivity"
    )
    assert "hall" in text
    assert "stairs" not in text


@settings(deadline=None, max_examples=150)
@given(st.integers(0, 10**6), st.floats(2, 12), st.sampled_from([0.0, 0.1, 0.5, 1.0]), st.sampled_from([60, 300, 2000]))
def test_quantised_strengths_are_seldom_suspected(seed: int, spread_db: float, step_db: float, rows: int) -> None:
    """Of twenty receivers, which a whole building may have, none or one."""
    values = np.random.default_rng(seed).normal(-65, spread_db, (20, rows))
    values = step_db * np.round(values / step_db) if step_db else values
    assert sum(bool(suspicious_values(one)) for one in values) <= 1


@pytest.mark.parametrize(
    "values",
    [
        np.round(DRAWS.normal(-65, 0.6, 500)),
        np.round(-82 + 9 * truncnorm.rvs(-1, 3, size=800, random_state=0)),
        np.round(-40 - 25 * np.log10(DRAWS.uniform(1, 20, 300))),
        np.round(-60 + 20 * np.log10(DRAWS.rayleigh(1, 1000))),
    ],
    ids=["standing still", "empty below the sensitivity", "path-loss law", "fading"],
)
def test_measured_strengths_are_not_suspected(values: np.ndarray) -> None:
    assert suspicious_values(values) == []


def test_strengths_without_sign_are_of_another_scale() -> None:
    record = building()
    assert list(not_heard(replace(record, observation=-record.observation))) == []


def test_channels_and_spectra_of_zeros_are_named() -> None:
    for record, what in ((channels(), "channels"), (spectra(rows=30), "spectra")):
        assert list(not_heard(record)) == []
        observation = record.observation.copy()
        observation[0, [2, 5, 9]] = 0
        silent = replace(record, observation=observation)
        ((name, text),) = list(not_heard(silent))
        share = f"{300 / len(record):.2g} % of the rows (3 of {len(record)}): rows 3, 6, 10"
        assert (name, text.partition(";")[0]) == (
            "not-heard",
            f"receiver {record.receivers[0].name}: {what} of zeros in {share}",
        )


def test_nearly_silent_receivers_are_named() -> None:
    assert list(few_rows(building(attic=(1, 2, 3, 4, 5)))) == []
    ((name, text),) = list(few_rows(building(attic=(3, 45, 46), cellar=())))
    assert name == "few-rows"
    assert text.startswith("fewer than 5 training rows were received by attic (1), cellar (0): fits predict these")
    ((_, text),) = list(few_rows(silent_in(building(), list(range(TRAINED)), "hall", "stairs", "lab")))
    assert "nothing was received in the training rows by any receiver" in text


def test_fits_warn_of_them(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_ble_folder(tmp_path / "office", marked(0.3, -101, 0, 1, 2))
    (suspicion,) = check_data(folder).suspicions
    with caplog.at_level(logging.WARNING):
        train(folder, tmp_path / "run", "idw")
    messages = [record.getMessage() for record in caplog.records if "suspicion" in record.getMessage()]
    assert messages == [f"office: suspicion not-heard: {suspicion.text} (wrf-mi data check)"]
    assert call(["data", "check", folder, "--strict"], capsys)[0] == 1
    assert call(["data", "check", folder, "--strict", "--ignore", "not-heard"], capsys)[0] == 0
    caplog.clear()
    train(strengths(), tmp_path / "clean", "idw")
    assert not [record for record in caplog.records if "suspicion" in record.getMessage()]
