"""Measurements, traced paths and fields of Gaussians in files: read back without loss, and refused where damaged."""

import csv
import json
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import trimesh
from changed_folders import error_line, refusal
from commands import Command
from PIL import Image
from programs import installed
from scipy.constants import speed_of_light
from small_fits import settings
from spectrum_records import assert_same, full_record, make_record
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, image_lengths, write_xml

from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.apps.exports.fields import RANGE_DB, import_field
from wrf_mi.apps.exports.paths_table import read_paths
from wrf_mi.core import Paths, Record
from wrf_mi.core.angles import rotation_matrix
from wrf_mi.core.array_files import write_arrays
from wrf_mi.datasets import load, write_record_file
from wrf_mi.datasets.registry import data_home
from wrf_mi.runs.api import train
from wrf_mi.runs.run import open_run
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
    names, known = (
        [[paths.object_names[k] for k in row if k >= 0] for row in paths.objects] for paths in (read, written)
    )
    assert names == known


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


FIELDS = ("wrf-gs", "wrf-gs+", "factorised")
TX_M = np.array([[-0.3, 0.2, 0.5]])
SINGLE = 1e-5
"""Logarithms and logits are stored in single precision: 1e-7 of values up to 14."""
COMPRESSED_M = 1e-2
"""Compressed PLY stores positions of each 256 Gaussians in 11 or 10 bits of their box, here of some 8 m."""


@pytest.fixture(scope="module")
def runs(two_gateways: Record, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A run of each field, after very few steps."""
    out = tmp_path_factory.mktemp("runs")
    return {
        name: train(folder, name, out=out / name, settings=settings("steps=4", model=name)).folder for name in FIELDS
    }


def gaussians(run: Path) -> Any:
    with dr.suspend_grad():
        return open_run(run).predictor().gaussians(TX_M)


def exported(run: Path, out: Path) -> np.ndarray:
    """Vertices of the exported file as trimesh reads them."""
    export(run, "3dgs", out, ExportOptions(tx_pos_m=TX_M))
    stored: np.ndarray = trimesh.load(out).metadata["_ply_raw"]["vertex"]["data"]
    return stored


@pytest.mark.parametrize("model", FIELDS)
def test_ply_has_the_properties_of_3dgs_and_the_gaussians(runs: dict[str, Path], tmp_path: Path, model: str) -> None:
    found, read = gaussians(runs[model]), exported(runs[model], tmp_path / "field.ply")
    known = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    known += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(read.dtype.names)[: len(known)] == known
    for k, axis in enumerate("xyz"):
        np.testing.assert_array_equal(read[axis], found.position[k].numpy())
        np.testing.assert_allclose(np.exp(read[f"scale_{k}"]), found.scale[k].numpy(), rtol=SINGLE)
    np.testing.assert_array_equal(read["signal_re_0"], found.signal[0].numpy())
    np.testing.assert_array_equal(read["signal_im_0"], found.signal[1].numpy())
    alpha = 1 / (1 + np.exp(-read["opacity"].astype(float)))
    if model == "wrf-gs":
        delta = np.array(found.attenuation)
        np.testing.assert_array_equal(np.stack([read["attenuation_re"], read["attenuation_im"]]), delta)
        np.testing.assert_allclose(alpha, 1 - np.hypot(*delta), rtol=0, atol=SINGLE)
    else:
        np.testing.assert_allclose(alpha, found.opacity.numpy(), rtol=0, atol=SINGLE)
    # Of the order w, x, y, z, normalised: the same rotations.
    ours = rotation_matrix(np.stack([read[f"rot_{k}"] for k in (1, 2, 3, 0)], axis=-1))
    np.testing.assert_allclose(ours, rotation_matrix(np.array(found.rotation).T), rtol=0, atol=SINGLE)
    np.testing.assert_allclose(sum(np.square(read[f"rot_{k}"]) for k in range(4)), 1, atol=SINGLE)


def test_strong_gaussians_are_bright(runs: dict[str, Path], tmp_path: Path) -> None:
    """Viridis is the brighter the higher; the strongest Gaussian is yellow, those 40 dB below it dark."""
    read = exported(runs["wrf-gs+"], tmp_path / "field.ply")
    strength = np.hypot(read["signal_re_0"], read["signal_im_0"])
    colour = 0.5 + 0.28209479177387814 * np.stack([read[f"f_dc_{k}"] for k in range(3)])
    assert colour.min() >= -SINGLE
    assert colour.max() <= 1 + SINGLE
    luminance = np.array([0.2126, 0.7152, 0.0722]) @ colour
    assert (np.diff(luminance[np.argsort(strength)]) >= -SINGLE).all()
    assert colour[:, strength.argmax()] == pytest.approx([0.993, 0.906, 0.144], abs=1e-3)
    assert RANGE_DB == 40


def test_open3d_reads_the_attributes(runs: dict[str, Path], tmp_path: Path) -> None:
    open3d = pytest.importorskip("open3d", reason="needs wrf-mi[lidar]")
    read = exported(runs["wrf-gs"], tmp_path / "field.ply")
    points = open3d.t.io.read_point_cloud(str(tmp_path / "field.ply")).point
    np.testing.assert_array_equal(points.positions.numpy(), np.stack([read[axis] for axis in "xyz"], axis=-1))
    np.testing.assert_array_equal(points.opacity.numpy().ravel(), read["opacity"])


@pytest.mark.parametrize("model", ["wrf-gs", "wrf-gs+"])
def test_splat_transform_converts_it_and_back(runs: dict[str, Path], tmp_path: Path, model: str) -> None:
    splat_transform = installed("splat-transform")
    read = exported(runs[model], tmp_path / "field.ply")

    def convert(source: str, out: str) -> Path:
        asked = [splat_transform, "-q", "-w", str(tmp_path / source), str(tmp_path / out)]
        done = subprocess.run(asked, capture_output=True, text=True, timeout=120, check=False)
        assert done.returncode == 0, done.stderr
        return tmp_path / out

    # A PLY of theirs keeps every property and number.
    again = trimesh.load(convert("field.ply", "again.ply")).metadata["_ply_raw"]["vertex"]["data"]
    assert again.dtype.names == read.dtype.names
    for name in read.dtype.names:
        np.testing.assert_array_equal(again[name], read[name])
    with convert("field.ply", "field.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    np.testing.assert_array_equal([np.float32(row["rot_3"]) for row in table], read["rot_3"])
    # Through the compressed form, theirs or ours, the attributes come back rounded, in another order.
    convert("field.ply", "theirs.compressed.ply")
    export(runs[model], "3dgs", tmp_path / "ours.compressed.ply", ExportOptions(tx_pos_m=TX_M))
    for name in ("theirs", "ours"):
        again = convert(f"{name}.compressed.ply", "rounded.ply")
        assert_rounded(trimesh.load(again).metadata["_ply_raw"]["vertex"]["data"], read)


def assert_rounded(rounded: np.ndarray, read: np.ndarray) -> None:
    """Whether vertices of a compressed PLY are others in another order, to the precision of its bits."""
    there, back = (np.stack([part[axis] for axis in "xyz"], axis=-1) for part in (read, rounded))
    distance_m = np.linalg.norm(there[:, None] - back, axis=-1)
    assert distance_m.min(axis=1).max() < COMPRESSED_M
    same = distance_m.argmin(axis=1)
    alpha = [1 / (1 + np.exp(-part["opacity"].astype(float))) for part in (rounded[same], read)]
    np.testing.assert_allclose(alpha[0], alpha[1], atol=1 / 255)
    turns = [np.stack([part[f"rot_{k}"] for k in range(4)]) for part in (rounded[same], read)]
    np.testing.assert_allclose(np.abs((turns[0] * turns[1]).sum(axis=0)), 1, atol=1e-5)
    for column, bits in [(f"scale_{k}", 10) for k in range(3)] + [(f"f_dc_{k}", 8) for k in range(3)]:
        width = np.ptp(read[column]) / (2**bits - 1)
        np.testing.assert_allclose(rounded[column][same], read[column], atol=0.51 * width + SINGLE)


def test_compressed_ply_holds_the_gaussians_in_bits(runs: dict[str, Path], tmp_path: Path) -> None:
    """Unpacked as its format states: x in the highest 11 bits of a share of the chunk's box, and so on."""
    read = exported(runs["wrf-gs+"], tmp_path / "field.ply")
    export(runs["wrf-gs+"], "3dgs", tmp_path / "field.compressed.ply", ExportOptions(tx_pos_m=TX_M))
    header, _, content = (tmp_path / "field.compressed.ply").read_bytes().partition(b"end_header\n")
    words = [line.split() for line in header.decode().splitlines() if line.startswith("property")]
    names = [name for _, kind, name in words if kind == "float"]
    chunk = dict(zip(names, np.frombuffer(content, "<f4", len(names)).astype(float), strict=True))
    packed = np.frombuffer(content[4 * len(names) :], [(name, "<u4") for _, kind, name in words if kind == "uint"])

    def share(name: str, low: int, bits: int) -> np.ndarray:
        return (packed[f"packed_{name}"] >> low & (2**bits - 1)) / (2**bits - 1)

    def spread(name: str, shares: np.ndarray) -> np.ndarray:
        return np.asarray(chunk[f"min_{name}"] + shares * (chunk[f"max_{name}"] - chunk[f"min_{name}"]))

    assert names[:12:3] == ["min_x", "max_x", "min_scale_x", "max_scale_x"]
    assert len(packed) == len(read)
    columns = {}
    for k, (axis, low, bits) in enumerate((("x", 21, 11), ("y", 11, 10), ("z", 0, 11))):
        columns[axis] = spread(axis, share("position", low, bits))
        columns[f"scale_{k}"] = spread(f"scale_{axis}", share("scale", low, bits))
        columns[f"f_dc_{k}"] = (spread("rgb"[k], share("color", 24 - 8 * k, 8)) - 0.5) / 0.28209479177387814
    alpha = share("color", 0, 8).clip(1e-6, 1 - 1e-6)
    parts = np.stack([(share("rotation", low, 10) - 0.5) * np.sqrt(2) for low in (20, 10, 0)])
    largest = packed["packed_rotation"] >> 30
    full = np.sqrt(1 - np.square(parts).sum(axis=0))
    rotations = [np.insert(parts[:, row], largest[row], full[row]) for row in range(len(packed))]
    columns |= {f"rot_{k}": np.array(rotations)[:, k] for k in range(4)} | {"opacity": np.log(alpha / (1 - alpha))}
    unpacked = np.array(list(zip(*columns.values(), strict=True)), dtype=[(name, "f8") for name in columns])
    assert_rounded(unpacked, read)


@pytest.mark.parametrize("model", FIELDS)
def test_imported_field_predicts_the_same_bits(runs: dict[str, Path], tmp_path: Path, model: str) -> None:
    export(runs[model], "field", tmp_path / "field.npz")
    run = import_field(tmp_path / "field.npz", tmp_path / "run")
    before = open_run(runs[model])
    assert run.config == before.config
    assert run.metrics == before.metrics
    expected = before.predict(TX_M).mean
    assert np.ptp(expected) > 0
    np.testing.assert_array_equal(run.predict(TX_M).mean, expected)
    for name, values in before.field.params.items():
        np.testing.assert_array_equal(run.field.params[name], values)
    with np.load(tmp_path / "field.npz", allow_pickle=False) as stored:
        assert stored["params/position"].shape == (3, 8)


def test_damaged_and_other_files_are_refused(runs: dict[str, Path], tmp_path: Path) -> None:
    file = tmp_path / "field.npz"
    error_line(import_field, file, tmp_path / "run", "missing")
    export(runs["wrf-gs+"], "field", file)
    with np.load(file) as stored:
        arrays = dict(stored)
    for change, message in (
        ({"export/format": np.array(9)}, "format 9, this version reads 2"),
        ({"export/format": None}, "not written by export"),
        ({"export/config": None}, "incomplete"),
        (
            {"params/position": np.full_like(arrays["params/position"], np.nan)},
            "params/position has numbers that are not",
        ),
    ):
        write_arrays(file, {key: values for key, values in (arrays | change).items() if values is not None})
        error_line(import_field, file, tmp_path / "run", message)
    file.write_bytes(b"no zip")
    error_line(import_field, file, tmp_path / "run", "not readable")
    assert not (tmp_path / "run").exists()


def test_command_exports_and_imports(runs: dict[str, Path], tmp_path: Path, command: Command) -> None:
    run, exporting = runs["wrf-gs+"], ["export", runs["wrf-gs+"], "--format"]
    # A negative coordinate is no option.
    out = command.done([*exporting, "3dgs", "--tx", "-0.3,0.2,5e-1", "--out", tmp_path / "a.ply"])
    assert out == f"Gaussians 8, properties 19: {tmp_path / 'a.ply'}\n"
    stored = trimesh.load(tmp_path / "a.ply").metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(stored, exported(run, tmp_path / "b.ply"))
    command.done([*exporting, "field", "--out", tmp_path / "f.npz"])
    assert command.done(["import", tmp_path / "f.npz", "--out", tmp_path / "run"]).endswith(f": {tmp_path / 'run'}\n")
    command.done(["evaluate", tmp_path / "run"])
    for words, suffix, message in (
        ("3dgs", ".ply", "choose one by --tx X,Y,Z"),
        ("3dgs --tx 1,2", ".ply", "--tx 1,2: give three numbers"),
        ("3dgs --tx 1,2,3 --frequency 1e9", ".ply", "have one carrier"),
        ("3dgs --tx 1,2,3", ".txt", "format 3dgs is a file .ply"),
        ("field --tx 1,2,3", ".npz", "--tx does not belong to format field"),
        ("paths", ".csv", "stores no paths"),
        ("glb", ".glb", "without a scene"),
        ("ble", "", "format ble takes a data set; choose from 3dgs, field, "),
    ):
        command.refused([*exporting, *words.split(), "--out", tmp_path / f"c{suffix}"], message)
    command.refused(["import", tmp_path / "f.npz", "--out", tmp_path / "run"], "exists and is not empty")
