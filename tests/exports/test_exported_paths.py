"""Tables of paths: read back, against the paths of a run and of a scene."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import refused
from changed_folders import refusal
from scipy.constants import speed_of_light
from traced_rooms import FREQUENCY_HZ, PARTITION, SHOEBOX, image_lengths, write_xml

from wrf_mi.apps.exports import ExportOptions, export
from wrf_mi.apps.exports.paths_table import read_paths
from wrf_mi.core import Paths
from wrf_mi.datasets import load
from wrf_mi.runs.api import train
from wrf_mi.tracing import TraceOptions, load_trace

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
    names = ([[paths.object_names[k] for k in row if k >= 0] for row in paths.objects] for paths in (read, written))
    np.testing.assert_equal(*names)


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


def test_damaged_tables_are_refused(run: Path, tmp_path: Path, capsys: Any) -> None:
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
    refused(
        ["export", run, "--format", "paths", "--depth", "1", "--out", file], "omit --depth, or give its scene", capsys
    )
