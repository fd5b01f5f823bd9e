"""Transmitters in a mirrored or turned plan are suspected where signal strengths follow a distance law."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from checked_records import channels, strengths
from scipy.spatial.distance import cdist

from wrf_mi.checking.plans import distance_law, explained, levels_db, placements
from wrf_mi.checking.units import distances_m
from wrf_mi.core import Record


def shadowed(record: Record, seed: int, deviation_db: float = 8.0, length_m: float = 3.0) -> Record:
    """Walls: for each receiver a random field over the place in place of the distance law."""
    rng = np.random.default_rng(seed)
    covariance = np.exp(-cdist(record.tx_pos_m, record.tx_pos_m) / length_m) + 1e-6 * np.eye(len(record))
    root = np.linalg.cholesky(covariance)
    fields = deviation_db * (root @ rng.normal(size=(len(record), len(record.receivers)))).T
    return replace(record, observation=(-60 + fields).astype(np.float32))


def test_a_distance_law_explains_what_it_made() -> None:
    record = strengths(noise_db=0)
    share, exponent = explained(levels_db(record), distances_m(record))
    assert share == pytest.approx(1, abs=1e-5)
    assert exponent == pytest.approx(2, abs=1e-3)
    assert explained(-levels_db(record), distances_m(record)) == (0, 0)
    observation = record.observation.copy()
    observation[0] = np.nan
    observation[1, :50] = np.nan
    share, exponent = explained(observation.astype(float), distances_m(record))
    assert exponent == pytest.approx(2, abs=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_the_stated_plan_is_not_suspected(seed: int) -> None:
    for receivers in (1, 2, 4):
        record = strengths(seed=seed, receivers=receivers)
        assert list(distance_law(record)) == []
    assert list(distance_law(channels(seed=seed))) == []


@pytest.mark.parametrize("receivers", [1, 2, 4])
def test_shading_alone_suggests_no_other_plan(receivers: int) -> None:
    """Strengths that have nothing to do with distance, in random fields of some metres."""
    record = strengths(receivers=receivers)
    alarms = [any(True for _ in distance_law(shadowed(record, seed))) for seed in range(100)]
    assert np.mean(alarms) <= 0.06


def test_other_plans_are_suspected() -> None:
    record = strengths()
    hall_m = np.array([6.0, 4.0])
    for placement in itertools.islice(placements(record.tx_pos_m, hall_m), 7):
        wrong = replace(record, tx_pos_m=placement.positions_m)
        ((name, text),) = distance_law(wrong)
        assert name == "plan"
        undone = {"by 90": "by -90", "by -90": "by 90"}
        turn = next((part for part in ("by 90", "by -90") if part in placement.motion), "")
        motion = placement.motion.replace(turn, undone[turn]) if turn else placement.motion
        assert text.startswith(f"transmitters are in another plan than receivers, {motion}: distance then explains ")
        assert "of the variance of the signal strengths, as stated" in text


def test_placements_state_what_they_do() -> None:
    xy = np.array([[1.0, 2.0, 0.5], [3.0, 5.0, 0.5]])
    names = {"x": 0, "y": 1}
    for placement in placements(xy, np.array([2.0, 3.0])):
        formulas = placement.remedy.removeprefix("use ").split(", ")
        for formula, column in zip(formulas, placement.positions_m[:, :2].T, strict=True):
            source = formula.partition("= ")[2]
            values = eval(source, {name: xy[:, k] for name, k in names.items()})
            np.testing.assert_allclose(values, column, atol=0.01)
        np.testing.assert_array_equal(placement.positions_m[:, 2], xy[:, 2])
