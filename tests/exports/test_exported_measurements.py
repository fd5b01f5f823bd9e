"""Data sets in the documented layouts, read back."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from spectrum_records import make_record

from wrf_mi.core import Antenna, InputError, Record
from wrf_mi.datasets import load, write_record_file
from wrf_mi.datasets.registry import data_home, stated_task
from wrf_mi.exports import export


def assert_equal_records(read: Record, written: Record) -> None:
    """All attributes are equal, to the last bit."""
    for field in fields(Record):
        ours, theirs = getattr(read, field.name), getattr(written, field.name)
        if field.name == "source":
            continue
        if field.name == "receivers":
            for one, other in zip(ours, theirs, strict=True):
                assert (one.name, one.antenna) == (other.name, other.antenna)
                for key in ("position_m", "orientation_xyzw", "array_m"):
                    np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
        elif field.name == "official" and theirs is not None:
            for one, other in zip(ours, theirs, strict=True):
                np.testing.assert_array_equal(one, other)
        else:
            np.testing.assert_array_equal(ours, theirs)
            assert getattr(ours, "dtype", None) == getattr(theirs, "dtype", None)


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


@pytest.mark.parametrize("record", [make_record(), full_record()], ids=["plain", "full"])
def test_npz_holds_a_record_without_loss(record: Record, tmp_path: Path) -> None:
    file = write_record_file(tmp_path / "one.npz", record)
    assert_equal_records(load(file), record)
    assert stated_task(file) == record.task
    # Exported again, from the folder that holds it, too.
    export(tmp_path, "npz", tmp_path / "two" / "again.npz")
    assert_equal_records(load(tmp_path / "two"), record)


def test_damaged_npz_is_refused(tmp_path: Path) -> None:
    file = write_record_file(tmp_path / "one.npz", make_record())
    with np.load(file) as stored:
        arrays = dict(stored)
    changes: list[tuple[dict[str, Any], str]] = [
        ({"record_format": np.array(2)}, "format 2, this version reads 1"),
        ({"observation": None}, "not readable"),
        ({"tx_pos_m": arrays["tx_pos_m"][:-1]}, "do not fit together"),
    ]
    for change, message in changes:
        np.savez(file, **{key: v for key, v in (arrays | change).items() if v is not None})
        with pytest.raises(InputError, match=message):
            load(file)


def test_spectra_keep_their_grey_levels(folder: Path, tmp_path: Path) -> None:
    export(folder, "spectra", tmp_path / "again")
    read, written = (replace(load(path), name="x") for path in (tmp_path / "again", folder))
    assert_equal_records(read, written)


@pytest.mark.parametrize("name", ["flat_folder", "plain_flat_folder"])
def test_strengths_read_back(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    folder = request.getfixturevalue(name)
    export(folder, "ble", tmp_path / "flat")
    assert_equal_records(replace(load(tmp_path / "flat"), name="x"), replace(load(folder), name="x"))


def test_channels_read_back(tmp_path: Path) -> None:
    record = replace(full_record(), folds=None, tx_heading_rad=None, n_readings=None, std=None, runs=None)
    first = record.receivers[0]
    channel = np.repeat(record.observation[:1, :, None], 5, axis=2)
    record = replace(record, receivers=(first,), observation=channel, truth=channel, uplink=channel[0] * 2)
    file = write_record_file(tmp_path / "csi.npz", record)
    export(file, "nerf2-csi", tmp_path / "csi")
    read = load(tmp_path / "csi")
    np.testing.assert_array_equal(read.observation, record.observation)
    np.testing.assert_array_equal(read.uplink, record.uplink)
    np.testing.assert_array_equal(read.frequencies_hz, record.frequencies_hz)
    np.testing.assert_array_equal(read.tx_pos_m, record.tx_pos_m)


def test_layouts_that_do_not_fit_are_refused_in_one_line(
    folder: Path, flat_folder: Path, tmp_path: Path, capsys
) -> None:
    out = ["--out", tmp_path / "x"]
    refused(
        ["export", folder, "--format", "ble", *out], "data set of spectrum, .* holds rssi; choose spectra, npz", capsys
    )
    refused(
        ["export", flat_folder, "--format", "3dgs", "--out", "x.ply"], "a data set; format 3dgs takes a run", capsys
    )
    (tmp_path / "x").mkdir()
    refused(["export", flat_folder, "--format", "ble", *out], "exists", capsys)
    status, out_text, _ = call(["export", flat_folder, "--format", "ble", *out, "--replace", "--json"], capsys)
    assert status == 0
    assert '"rows": 30' in out_text


@pytest.mark.skipif(not (data_home() / "rfid-lab").is_dir(), reason="needs the data set rfid-lab")
def test_measured_spectra_read_back(tmp_path: Path) -> None:
    export("rfid-lab", "npz", tmp_path / "lab.npz")
    assert_equal_records(load(tmp_path / "lab.npz"), load("rfid-lab"))
    export("rfid-lab", "spectra", tmp_path / "lab")
    np.testing.assert_array_equal(load(tmp_path / "lab").observation, load("rfid-lab").observation)
