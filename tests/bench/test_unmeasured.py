"""Benchmark of new carriers and receivers: rows left to new receivers alone, and gains over seeds."""

import numpy as np
import pytest
from wrf_mi_bench.unmeasured import HYBRID, LAW, gains, only

from wrf_mi.core import Receiver, Record
from wrf_mi.datasets import make_splits


def test_new_receivers_alone_see_the_rows_left_to_them():
    receivers = tuple(Receiver(f"rx{k}", np.array([k, 0.0, 1.0]), np.array([0.0, 0, 0, 1])) for k in range(3))
    observed = -np.arange(180, dtype=np.float32).reshape(3, 60)
    rows = np.arange(40), np.arange(40, 60)
    record = Record("made-up", "rssi", np.random.default_rng(0).uniform(1, 5, (60, 3)), receivers, observed, rows)
    (split,) = make_splits(record, "receiver+5:1")
    alone, these = only(record, split)
    assert [receiver.name for receiver in alone.receivers] == ["rx1"]
    np.testing.assert_array_equal(these.train, split.left[:, 1])
    np.testing.assert_array_equal(these.test, split.test)
    known = np.flatnonzero(np.isfinite(alone.observation[0]))
    np.testing.assert_array_equal(known, np.union1d(split.left[:, 1], split.test))
    np.testing.assert_array_equal(alone.observation[0, known], observed[1, known])


def test_seeds_that_score_the_same_rows_do_not_narrow_an_interval():
    errors = np.random.default_rng(1).uniform(1, 3, (2, 50))
    pairs = [["rx", row] for row in range(50)]
    one = {HYBRID: errors[0].tolist(), LAW: errors[1].tolist(), "pairs": pairs, "inside_90": 0.9, "crps": 1.0}
    once, thrice = (gains([{**one, "task": "rssi"}] * count)[LAW] for count in (1, 3))
    assert once[2].value == pytest.approx((errors[1] - errors[0]).mean())
    assert (thrice[2].low, thrice[2].high) == pytest.approx((once[2].low, once[2].high))
    assert thrice[:2] == pytest.approx(once[:2])
