"""Data sets in the documented layouts, read back."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import call, refused
from changed_folders import refusal
from spectrum_records import assert_same, make_record

from wrf_mi.apps.exports import export
from wrf_mi.core import Antenna, Record
from wrf_mi.datasets import load, write_record_file
from wrf_mi.datasets.registry import data_home


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
    assert_same(load(file), record)
    # Exported again, from the folder that holds it, too.
    export(tmp_path, "npz", tmp_path / "two" / "again.npz")
    assert_same(load(tmp_path / "two"), record)


def test_array_of_an_earlier_version_is_not_read(tmp_path: Path) -> None:
    record = make_record()
    file = write_record_file(tmp_path / "one.npz", record)
    with np.load(file) as stored:
        np.savez(file, tx_velocity_mps=record.tx_pos_m, **stored)
    assert_same(load(file), record)


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
        refusal(load, file, message)


@pytest.mark.parametrize(
    ("name", "layout"), [("folder", "spectra"), ("flat_folder", "ble"), ("plain_flat_folder", "ble")]
)
def test_folders_read_back(name: str, layout: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    folder = request.getfixturevalue(name)
    export(folder, layout, tmp_path / "again")
    assert_same(load(tmp_path / "again"), load(folder), "name")


def test_channels_read_back(tmp_path: Path) -> None:
    record = replace(full_record(), folds=None, tx_heading_rad=None, n_readings=None, std=None, runs=None)
    channel = np.repeat(record.observation[:1, :, None], 5, axis=2)
    parts = {"observation": channel, "truth": channel, "uplink": channel[0] * 2}
    record = replace(record, receivers=record.receivers[:1], **parts)
    export(write_record_file(tmp_path / "csi.npz", record), "nerf2-csi", tmp_path / "csi")
    read = load(tmp_path / "csi")
    for name in ("observation", "uplink", "frequencies_hz", "tx_pos_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(record, name))


def test_layouts_that_do_not_fit_are_refused(folder: Path, flat_folder: Path, tmp_path: Path, capsys: Any) -> None:
    out = ["--out", tmp_path / "x"]
    (tmp_path / "x").mkdir()
    for dataset, layout, message in (
        (folder, "ble", "data set of spectrum, .* holds rssi; choose spectra, npz"),
        (flat_folder, "3dgs", "a data set; format 3dgs takes a run"),
        (flat_folder, "ble", "exists"),
    ):
        suffix = ".ply" if layout == "3dgs" else ""
        refused(["export", dataset, "--format", layout, "--out", f"{out[1]}{suffix}"], message, capsys)
    status, out_text, _ = call(["export", flat_folder, "--format", "ble", *out, "--replace", "--json"], capsys)
    assert (status, '"rows": 30' in out_text) == (0, True)


@pytest.mark.skipif(not (data_home() / "rfid-lab").is_dir(), reason="needs the data set rfid-lab")
def test_measured_spectra_read_back(tmp_path: Path) -> None:
    measured = load("rfid-lab")
    export("rfid-lab", "npz", tmp_path / "lab.npz")
    assert_same(load(tmp_path / "lab.npz"), measured)
    export("rfid-lab", "spectra", tmp_path / "lab")
    np.testing.assert_array_equal(load(tmp_path / "lab").observation, measured.observation)
