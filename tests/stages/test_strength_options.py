"""What is added to the mean of signal strengths: kriging, trees or nothing, chosen by held-out rows."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from wrf_mi.core import Receiver, Record, Split
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.models import MODELS, Problem, Session
from wrf_mi.models.interpolation.strengths import DEFAULT, LIKELIHOOD, NONE, TREES, Strengths
from wrf_mi.models.model import Inputs, default_settings, inputs_of
from wrf_mi.tasks.scores import REAL_90
from wrf_mi.tracing.power_map import PowerMap

ROWS, TESTS, NOISE_DB, EXTENT_M = 300, 100, 2.0, 16.0
KRIGING = DEFAULT, LIKELIHOOD
COVERED = (0.84, 0.96)
"""Share inside 90 % of 300 errors in a dozen cells of shadowing: 0.9 within three standard errors of 2 %."""


def shadows(kind: str, tx_pos_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Shadowing in dB [n]: a level for each room of 4 m, smooth over 8 m, or none."""
    if kind == "rooms":
        x, y = (tx_pos_m[:, :2] // 4).astype(int).T
        return rng.normal(0, 8, (4, 4))[x, y]
    if kind == "smooth":
        apart_m = np.linalg.norm(tx_pos_m[:, None] - tx_pos_m, axis=2)
        return 8 * np.linalg.cholesky(np.exp(-apart_m / 8) + 1e-9 * np.eye(len(tx_pos_m))) @ rng.normal(size=len(apart_m))
    return np.zeros(len(tx_pos_m))


def made(kind: str, seed: int = 0, headings: bool = False) -> Record:
    """Strengths by a law of exponent 2.5, shadowing and noise at three receivers; the last rows are tests."""
    rng = np.random.default_rng(seed)
    rows = ROWS + TESTS
    tx_pos_m = np.column_stack([rng.uniform(0, EXTENT_M, (rows, 2)), np.full(rows, 1.3)])
    places_m = np.array([[0, 0, 2.5], [15, 2, 2.5], [4, 14, 2.5]])
    law = -45 - 25 * np.log10(np.linalg.norm(places_m[:, None] - tx_pos_m, axis=2))
    observed = law + np.stack([shadows(kind, tx_pos_m, rng) for _ in law]) + rng.normal(0, NOISE_DB, law.shape)
    heading = rng.uniform(-3, 3, rows) if headings else None
    receivers = tuple(Receiver(f"r{k}", place_m, np.array(UPRIGHT)) for k, place_m in enumerate(places_m))
    record = Record("made", "rssi", tx_pos_m, receivers, observed.astype(np.float32), tx_heading_rad=heading)
    return replace(record, official=(np.arange(ROWS), np.arange(ROWS, rows)), frequencies_hz=np.array([2.4e9]))


def fit(record: Record, folder: Path, *settings: str) -> Strengths:
    entry = MODELS["kriging"].serving("rssi", False)
    stated = {text.partition("=")[0] for text in settings}
    problem = Problem(record, default_settings(entry, settings, {}), stated=stated)
    split = Split("official", 0, record.official[0], np.zeros(0, np.int64), record.official[1])
    with threadpool_limits(1, "blas"):  # as in runs
        fitted = entry.fit(problem, split, Session(folder, folder))
    assert isinstance(fitted, Strengths)
    return fitted


def relative_errors(fitted: Strengths, record: Record) -> np.ndarray:
    """Errors of the test rows in standard deviations of a reading."""
    test = record.official[1]
    predictions = [fitted.predict(inputs_of(record, test), k) for k in range(len(record.receivers))]
    return np.stack([(p.mean - record.observation[k, test]) / p.stated_std for k, p in enumerate(predictions)])


@pytest.mark.parametrize(("kind", "expected"), [("rooms", (TREES,)), ("smooth", KRIGING), ("none", (NONE, LIKELIHOOD))])
def test_held_out_rows_choose_the_shadowing(kind: str, expected: tuple[str, ...], tmp_path: Path) -> None:
    record = made(kind)
    fitted = fit(record, tmp_path)
    assert fitted.shadowing in expected
    assert {report["option"] for report in fitted.options} == {*KRIGING, TREES, NONE}
    assert COVERED[0] < np.mean(np.abs(relative_errors(fitted, record)) < REAL_90) < COVERED[1]
