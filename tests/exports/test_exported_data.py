"""Measurements and traced paths in files: read back without loss, and refused where damaged."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from changed_folders import refusal
from commands import Command
from PIL import Image
from scipy.constants import speed_of_light
from spectrum_records import assert_same, full_record, make_record
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, image_lengths, write_xml

from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.apps.exports.paths_table import read_paths
from wrf_mi.core import Paths, Record
from wrf_mi.datasets import load, write_record_file
from wrf_mi.datasets.registry import data_home
from wrf_mi.runs.api import train
from wrf_mi.tracing import TraceOptions, load_trace


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


def test_layouts_that_do_not_fit_are_refused(folder: Path, flat_folder: Path, tmp_path: Path, command: Command) -> None:
    out = ["--out", tmp_path / "x"]
    (tmp_path / "x").mkdir()
    for dataset, layout, message in (
        (folder, "ble", "data set of spectrum, .* holds rssi; choose spectra, npz"),
        (flat_folder, "3dgs", "a data set; format 3dgs takes a run"),
        (flat_folder, "ble", "exists"),
    ):
        suffix = ".ply" if layout == "3dgs" else ""
        command.refused(["export", dataset, "--format", layout, "--out", f"{out[1]}{suffix}"], message)
    assert '"rows": 30' in command.done(["export", flat_folder, "--format", "ble", *out, "--replace", "--json"])


@pytest.mark.skipif(not (data_home() / "rfid-lab").is_dir(), reason="needs the data set rfid-lab")
def test_measured_spectra_read_back(tmp_path: Path) -> None:
    measured = load("rfid-lab")
    export("rfid-lab", "npz", tmp_path / "lab.npz")
    assert_same(load(tmp_path / "lab.npz"), measured)
    export("rfid-lab", "spectra", tmp_path / "lab")
    np.testing.assert_array_equal(load(tmp_path / "lab").observation, measured.observation)


ROUNDED = 1e-14
"""Directions go through angles in degrees and back, with float64's rounding of each step."""
SINGLE_M = 1e-5
"""Lengths are of the mesh, whose corners are in single precision."""


@pytest.fixture(scope="module")
def run(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("traced") / "run"
    return train(flat_folder, "ray-tracing", out=out, scene=room, settings=TraceOptions(depth=2)).folder


def assert_same_paths(read: Paths, written: Paths) -> None:
    for name in ("tx", "rx", "gain", "length_m", "interactions", "vertices_m"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))
    for name in ("departure", "arrival"):
        np.testing.assert_allclose(getattr(read, name), getattr(written, name), rtol=0, atol=ROUNDED)
    names, written_names = (
        [[paths.object_names[k] for k in row if k >= 0] for row in paths.objects] for paths in (read, written)
    )
    assert names == written_names


def test_table_of_a_run_reads_back(run: Path, tmp_path: Path) -> None:
    facts = export(run, "paths", tmp_path / "paths.csv")
    traced = load_trace(run / "paths.npz")
    assert facts == {"paths": len(traced.paths), "transmitters": 30, "receivers": 2}
    assert_same_paths(read_paths(tmp_path / "paths.csv"), traced.paths)
    with (tmp_path / "paths.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    row, paths = rows[-1], traced.paths
    assert row["receiver"] == traced.receivers[paths.rx[-1]].name == "anchor2"
    assert float(row["delay_s"]) == paths.length_m[-1] / speed_of_light
    assert [float(row[f"tx_{axis}"]) for axis in "xyz"] == traced.tx_pos_m[paths.tx[-1]].tolist()
    assert {float(row["frequency_hz"]) for row in rows} == {2.44e9}
    # The last vertex is seen from the receiver under the angle of arrival.
    bent = next(row for row in rows if row["interactions"] == "R")
    way = np.array([float(x) for x in bent["vertices_m"].split()]) - [float(bent[f"rx_{axis}"]) for axis in "xyz"]
    azimuth = np.degrees(np.arctan2(way[1], way[0])) % 360
    assert float(bent["arrival_azimuth_deg"]) == pytest.approx(azimuth, abs=1e-3)


def test_table_of_a_scene_has_the_image_methods_lengths(tmp_path: Path) -> None:
    xml = write_xml(tmp_path / "room", SHOEBOX)
    tx, rx = np.array([[1.0, 1.5, 1.2], [4.0, 2.0, 0.7]]), np.array([[5.0, 4.0, 2.0]])
    options = ExportOptions(tx_pos_m=tx, rx_pos_m=rx, frequency_hz=FREQUENCY_HZ, depth=2)
    export(xml, "paths", tmp_path / "paths.csv", options)
    read = read_paths(tmp_path / "paths.csv")
    assert (read.n_tx, read.n_rx) == (2, 1)
    for k in range(2):
        expected = image_lengths(tx[k], rx[0], 2)
        np.testing.assert_allclose(np.sort(read.length_m[read.tx == k]), expected, rtol=0, atol=SINGLE_M)
    direct = export(xml, "paths", tmp_path / "direct.csv", replace(options, kinds="line-of-sight"))
    assert direct["paths"] == 2
    walls = write_xml(tmp_path / "walls", {**SHOEBOX, **PARTITION})
    export(walls, "paths", tmp_path / "through.csv", replace(options, kinds="line-of-sight,reflection,transmission"))
    through = read_paths(tmp_path / "through.csv")
    assert {1, 4} <= set(through.interactions.ravel().tolist())
    assert "partition" in through.object_names
    refusal(export, xml, "paths", tmp_path / "x.csv", replace(options, rx_pos_m=None), r"a scene; .* give --rx")


def test_scenario_of_deepmimo_is_a_data_set(run: Path, tmp_path: Path) -> None:
    export(run, "deepmimo", tmp_path / "scenario")
    refusal(export, run, "deepmimo", tmp_path / "scenario", "exists")
    export(run, "deepmimo", tmp_path / "scenario", ExportOptions(replace=True))
    (tmp_path / "scenario" / "channel_params.yml").write_text("base_stations: all\n")
    record = load(tmp_path / "scenario")
    assert (record.task.name, len(record), len(record.receivers)) == ("csi", 30, 2)


def test_scenario_of_a_scene_has_users_at_any_height(tmp_path: Path) -> None:
    """Users at 1.2 and 2 m, which no run was traced at: the channel of the line of sight has Friis' gain."""
    xml = write_xml(tmp_path / "room", SHOEBOX)
    tx, rx = np.array([[1.0, 1.5, 1.2], [1.0, 1.5, 2.0]]), np.array([[5.0, 4.0, 2.0]])
    options = ExportOptions(tx_pos_m=tx, rx_pos_m=rx, frequency_hz=FREQUENCY_HZ, kinds="line-of-sight")
    assert export(xml, "deepmimo", tmp_path / "scenario", options)["users"] == 2
    record = load(tmp_path / "scenario")
    np.testing.assert_allclose(record.tx_pos_m, tx, atol=1e-5)
    distance_m = np.linalg.norm(tx - rx, axis=1)
    ratio = np.abs(record.observation[0, 0]).ravel()[0] / np.abs(record.observation[0, 1]).ravel()[0]
    assert ratio == pytest.approx(distance_m[1] / distance_m[0], rel=0.1)


@pytest.mark.parametrize("record", [make_record(), full_record()], ids=["plain", "full"])
def test_pictures_of_spectra_state_their_limits(record: Record, tmp_path: Path) -> None:
    file = write_record_file(tmp_path / "one.npz", record)
    if record.task.name != "spectrum":
        refusal(export, file, "png", tmp_path / "pictures", "format png takes spectra")
        return
    export(file, "png", tmp_path / "pictures")
    limits = json.loads((tmp_path / "pictures" / "limits.json").read_text())
    for number, receiver in enumerate(record.receivers):
        with Image.open(tmp_path / "pictures" / receiver.name / "00002.png") as picture:
            grey = np.asarray(picture, float)
        level_db = limits["black_db"] + grey / limits["white"] * (limits["white_db"] - limits["black_db"])
        with np.errstate(divide="ignore"):
            stated_db = 20 * np.log10(record.observation[number, 1])
        step_db = (limits["white_db"] - limits["black_db"]) / 255
        np.testing.assert_allclose(level_db, stated_db.clip(limits["black_db"]), atol=0.51 * step_db)
    assert limits["white_db"] == pytest.approx(20 * np.log10(record.observation.max()))


def test_damaged_tables_are_refused(run: Path, tmp_path: Path, command: Command) -> None:
    file = tmp_path / "paths.csv"
    export(run, "paths", file)
    lines = file.read_text().splitlines()
    row = next(k for k, line in enumerate(lines) if ",R," in line)
    for change, message in (
        (lambda text: text.replace(",R,", ",X,"), rf"row {row}: interactions, vertices and objects do not fit"),
        (lambda text: text.replace(",R,", ",R;R,"), rf"row {row}: interactions, vertices and objects do not fit"),
        (lambda text: text.rpartition(",")[0], rf"row {row}: .* fields"),
    ):
        file.write_text("\n".join([*lines[:row], change(lines[row]), *lines[row + 1 :]]) + "\n")
        refusal(read_paths, file, message)
    words = ["export", run, "--format", "paths", "--depth", "1", "--out", file]
    command.refused(words, "omit --depth, or give its scene")
