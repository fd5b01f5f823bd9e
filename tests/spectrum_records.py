"""Made-up records of spectra, and their comparison."""

import numpy as np

from wrf_mi.core import Receiver, Record


def make_record(rows: int = 12, gateways: int = 1, height: int = 5, width: int = 8) -> Record:
    rng = np.random.default_rng(7)
    receivers = tuple(
        Receiver(f"gateway{i + 1}", rng.normal(size=3), np.array([0.0, 0.6, 0.0, 0.8])) for i in range(gateways)
    )
    order = rng.permutation(rows)
    return Record(
        name="made-up",
        task="spectrum",
        tx_pos_m=rng.normal(size=(rows, 3)),
        receivers=receivers,
        observation=(rng.integers(0, 256, (gateways, rows, height, width)) / 255).astype(np.float32),
        official=(order[3:], order[:3]),
        folds=np.arange(rows) % 3,
    )


def assert_same(read: Record, written: Record) -> None:
    np.testing.assert_array_equal(read.tx_pos_m, written.tx_pos_m)
    np.testing.assert_array_equal(read.observation, written.observation)
    for ours, theirs in zip(read.receivers, written.receivers, strict=True):
        assert ours.name == theirs.name
        np.testing.assert_array_equal(ours.position_m, theirs.position_m)
        np.testing.assert_array_equal(ours.orientation_xyzw, theirs.orientation_xyzw)
    assert read.official is not None
    assert written.official is not None
    for ours, theirs in zip(read.official, written.official, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(read.folds, written.folds)
