"""Means of readings and their noise, and numbers for "not heard"."""

import numpy as np
import pytest

from wrf_mi.apps.importing.readings import Readings, mean_strengths, normal_id, without_not_heard

NOISE_DB = 4.0
RATIO = 0.03
"""Relative error of a root mean square of 8000 errors: 1 / sqrt(16000), four times."""


def readings(dbm: np.ndarray, receivers: int = 1) -> Readings:
    """Readings [rows, receivers] in the order of the rows."""
    row, receiver = np.divmod(np.arange(dbm.size), receivers)
    ids = tuple(f"ap{number}" for number in range(receivers))
    return Readings(ids, row, receiver, np.asarray(dbm, float).ravel())


@pytest.mark.parametrize(("average", "expected"), [("db", -55.0), ("mw", 10 * np.log10((1e-5 + 1e-6) / 2))])
def test_means_in_db_and_in_mw(average: str, expected: float) -> None:
    means = mean_strengths(readings(np.array([-50.0, -60.0, -70.0])), np.array([0, 0, 2]), 3, average)
    np.testing.assert_allclose(means.dbm, [[expected, np.nan, -70.0]])
    np.testing.assert_array_equal(means.count, [[2, 0, 1]])
    np.testing.assert_array_equal(np.isnan(means.std), [[False, True, False]])


def test_mean_in_db_does_not_depend_on_the_number_of_readings() -> None:
    """The mean in mW does: it is above the typical strength, the more so the more readings there are."""
    rng = np.random.default_rng(0)
    count = np.repeat([2, 50], 4000)
    place = np.repeat(np.arange(len(count)), count)
    strengths = readings(-70 + NOISE_DB * rng.standard_normal(len(place)))
    few, many = (slice(0, 4000), slice(4000, None))
    in_db, in_mw = (mean_strengths(strengths, place, len(count), average).dbm[0] for average in ("db", "mw"))
    assert abs(in_db[few].mean() - in_db[many].mean()) < 0.2
    assert in_mw[many].mean() - in_mw[few].mean() > 0.5


def test_stated_noise_is_that_of_the_means() -> None:
    """Errors over the stated standard deviation are standard, at places with few readings and with many."""
    rng = np.random.default_rng(1)
    for count in (1, 2, 20):
        place = np.repeat(np.arange(8000), count)
        others = np.repeat(np.arange(8000, 8200), 30)  # places that tell the noise of a reading
        place = np.concatenate([place, others])
        means = mean_strengths(readings(NOISE_DB * rng.standard_normal(len(place))), place, 8200, "db")
        error = means.dbm[0, :8000] / np.sqrt(np.mean(means.std[0, :8000] ** 2))
        assert np.sqrt(np.mean(error**2)) == pytest.approx(1, abs=RATIO)


@pytest.mark.parametrize("mark", [-200.0, -101.0, -100.0, 0.0, 1.0, 100.0])
def test_numbers_for_not_heard_are_found(mark: float) -> None:
    rng = np.random.default_rng(2)
    dbm = np.round(rng.normal(-65, 8, (300, 3)))
    silent = rng.random(dbm.shape) < 0.3
    dbm[silent] = mark
    part, notes, numbers = without_not_heard(readings(dbm, 3), None)
    assert numbers == [mark]
    assert len(part.dbm) == np.count_nonzero(~silent)
    assert notes == [f"{mark:g} is not heard: {np.count_nonzero(silent)} readings are empty fields"]


def test_other_numbers_that_pile_up_are_kept() -> None:
    rng = np.random.default_rng(3)
    clipped = np.maximum(np.round(rng.normal(-80, 8, (1000, 1))), -87)
    part, notes, numbers = without_not_heard(readings(clipped), None)
    assert (len(part.dbm), numbers) == (1000, [])
    assert "--not-heard -87 leaves it out" in notes[0]
    assert len(without_not_heard(readings(clipped), [-87.0])[0].dbm) == np.count_nonzero(clipped > -87)
    # A customary number that one receiver of several has often, and measured strengths.
    weak = np.concatenate([np.full(50, -100.0), np.repeat(np.arange(-99.0, -89), 9)])
    dbm = np.concatenate([weak, np.round(rng.normal(-70, 5, 3000))])
    both = Readings(("weak", "strong"), np.arange(len(dbm)), np.repeat([0, 1], [len(weak), 3000]), dbm)
    alone = Readings(("weak",), np.arange(len(weak)), np.zeros(len(weak), int), weak)
    assert without_not_heard(alone, None)[2] == [-100]
    assert without_not_heard(both, None)[2] == []
    for _ in range(20):
        assert without_not_heard(readings(np.round(rng.normal(-70, 9, (200, 4))), 4), None)[2] == []


def test_ids_are_those_that_the_layout_reads() -> None:
    ids = {"007": "7", "7.0": "7", " 12 ": "12", "AP 1": "AP 1", "a/b": "a-b", "00:11:22:33:44:55": "00:11:22:33:44:55"}
    assert {text: normal_id(text) for text in ids} == ids
