"""Made-up records of spectra, and their comparison."""

from dataclasses import fields

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


def assert_same(read: Record, written: Record, *but: str) -> None:
    """All attributes are equal, to the last bit and in their types, but for the source and those that are named."""
    for name in {field.name for field in fields(Record)} - {"source", *but}:
        ours, theirs = ([*map(vars, r.receivers)] if name == "receivers" else getattr(r, name) for r in (read, written))
        np.testing.assert_equal(ours, theirs, err_msg=name)
        assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None), name
