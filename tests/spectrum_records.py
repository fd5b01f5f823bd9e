"""Made-up records of spectra and of channels, and their comparison."""

from dataclasses import fields, replace

import numpy as np

from wrf_mi.core import Antenna, Receiver, Record


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


def full_record() -> Record:
    """Two receivers with everything that a record may state."""
    rng = np.random.default_rng(1)
    base = make_record(rows=6, gateways=2)
    array_m = rng.normal(size=(5, 3))
    channel = (rng.normal(size=(2, 6, 3)) + 1j * rng.normal(size=(2, 6, 3))).astype(np.complex64)
    return replace(
        base,
        task="csi",
        receivers=(replace(base.receivers[0], array_m=array_m, antenna=Antenna("dipole")), base.receivers[1]),
        observation=channel,
        truth=channel + np.complex64(1),
        frequencies_hz=np.array([1e9, 1.1e9, 1.2e9]),
        tx_heading_rad=rng.normal(size=6),
        tx_antenna=Antenna("dipole", "H"),
        uplink=channel[0, :, None],
        uplink_hz=np.array([0.7e9, 0.8e9, 0.9e9]),
        n_readings=np.arange(12).reshape(2, 6),
        std=rng.random((2, 6)),
        runs=np.array(list("aabbcc")),
    )


def assert_same(read: Record, written: Record, *but: str) -> None:
    """All attributes are equal, to the last bit and in their types, but for the source and those that are named."""
    for name in {field.name for field in fields(Record)} - {"source", *but}:
        ours, theirs = ([*map(vars, r.receivers)] if name == "receivers" else getattr(r, name) for r in (read, written))
        np.testing.assert_equal(ours, theirs, err_msg=name)
        assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None), name
