"""Fields of Gaussians in files: opened by viewers of 3D Gaussians, read back without loss, refused where damaged."""

import csv
import subprocess
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np
import pytest
import trimesh
from changed_folders import error_line
from commands import Command
from programs import installed
from small_fits import settings

from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.apps.exports.fields import RANGE_DB, import_field
from wrf_mi.core import Record
from wrf_mi.core.angles import rotation_matrix
from wrf_mi.core.array_files import write_arrays
from wrf_mi.runs.api import train
from wrf_mi.runs.run import open_run

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
    trained_gaussians, read = gaussians(runs[model]), exported(runs[model], tmp_path / "field.ply")
    properties = [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
    properties += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert list(read.dtype.names)[: len(properties)] == properties
    for k, axis in enumerate("xyz"):
        np.testing.assert_array_equal(read[axis], trained_gaussians.position[k].numpy())
        np.testing.assert_allclose(np.exp(read[f"scale_{k}"]), trained_gaussians.scale[k].numpy(), rtol=SINGLE)
    np.testing.assert_array_equal(read["signal_re_0"], trained_gaussians.signal[0].numpy())
    np.testing.assert_array_equal(read["signal_im_0"], trained_gaussians.signal[1].numpy())
    alpha = 1 / (1 + np.exp(-read["opacity"].astype(float)))
    if model == "wrf-gs":
        delta = np.array(trained_gaussians.attenuation)
        np.testing.assert_array_equal(np.stack([read["attenuation_re"], read["attenuation_im"]]), delta)
        np.testing.assert_allclose(alpha, 1 - np.hypot(*delta), rtol=0, atol=SINGLE)
    else:
        np.testing.assert_allclose(alpha, trained_gaussians.opacity.numpy(), rtol=0, atol=SINGLE)
    # Of the order w, x, y, z, normalised: the same rotations.
    ours = rotation_matrix(np.stack([read[f"rot_{k}"] for k in (1, 2, 3, 0)], axis=-1))
    np.testing.assert_allclose(ours, rotation_matrix(np.array(trained_gaussians.rotation).T), rtol=0, atol=SINGLE)
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
    read_positions, back = (np.stack([part[axis] for axis in "xyz"], axis=-1) for part in (read, rounded))
    distance_m = np.linalg.norm(read_positions[:, None] - back, axis=-1)
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
