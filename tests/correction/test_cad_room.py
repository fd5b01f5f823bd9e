"""Rooms of CAD programs: furniture of 100,000 facets, each in a plane of its own, costs next to nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cad_room
import numpy as np
import pytest
from cad_room import CARRIER_HZ

from wrf_mi.correction import Correction, CorrectionOptions, correct_scene, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import LEAST_PATHS
from wrf_mi.datasets import make_splits, read_spectrum_folder, write_spectrum_folder
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT
from wrf_mi.tracing.paths.solve import Prepared

SECONDS, MEBIBYTES = 60, 2048
"""Most processor time and memory of a command with 15 rows, on a machine that does nothing else."""
BUSY = 3
"""Factor on times: processors that others share are slower."""
ROUNDING = 1e-6
"""Of residuals in single precision."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The room with stated materials, and spectra in it with others."""
    folder = tmp_path_factory.mktemp("cad")
    cad_room.write_room(folder / "room")
    truth = cad_room.write_room(folder / "truth", 8, cad_room.TRUE_WALLS)
    write_spectrum_folder(folder / "spectra", cad_room.record(truth, "spectrum"), bits=16)
    return folder


@pytest.fixture(scope="module")
def corrected(folder: Path) -> Correction:
    record = read_spectrum_folder(folder / "spectra", "cad-room")
    options = CorrectionOptions(("materials", "planes", "frame"), depth=2, rays=1 << 14, steps=2)
    return correct_scene(folder / "room", record, make_splits(record, "official")[0], options)


def test_only_surfaces_that_paths_meet_have_parameters(corrected: Correction) -> None:
    """Of 100,000 surfaces; held-out spectra are explained by the walls' materials."""
    surfaces, misfit = corrected.misfit.sides[0].surfaces, corrected.misfit
    assert len(surfaces.triangles) > 100_000
    assert len(surfaces.normal) > 90_000
    assert len(corrected.vector) < 5_000
    assert (misfit.counts()[1] >= LEAST_PATHS).sum() >= 6
    assert np.nanmean(corrected.scores[corrected.kept]) > np.nanmean(corrected.scores[""]) + 0.1


def test_unmet_facets_stay_one_object_of_the_written_scene(corrected: Correction, tmp_path: Path) -> None:
    """Each changed surface is an object; of the furniture's 100,000 facets few are."""
    facts = write_page(corrected, tmp_path / "scene")
    parts = {path.stem for path in (tmp_path / "scene" / "meshes").glob("*.ply")}
    assert {"mattress", "north", "floor"} <= parts
    assert len(parts) < 100
    assert facts["surfaces"] > 90_000
    assert len(facts["materials"]) == len(corrected.misfit.slabs)
    written = open_scene(tmp_path / "scene", CARRIER_HZ)
    absent = list(corrected.state.absent())
    present = ~np.isin(corrected.misfit.tables.slab_of_face, absent)
    assert sum(thing.mi_mesh.face_count() for thing in written.objects.values()) == present.sum()
    assert (tmp_path / "scene" / "correction.json").stat().st_size < 2e6


def test_residuals_do_not_depend_on_surfaces_that_no_path_meets(tmp_path: Path) -> None:
    """With parameters of all surfaces or of those that paths meet, also where planes and materials have changed."""
    truth = cad_room.write_room(tmp_path / "room", 4)
    record = cad_room.record(truth, "spectrum", 6)
    options, rows = CorrectionOptions(depth=2, rays=4096), np.arange(6)
    opened = open_scene(truth, CARRIER_HZ)
    every = Misfit(record, rows, Prepared(opened), options)
    none = np.zeros(0, np.int64)
    few = Misfit(record, rows, Prepared(opened), options, surfaces=(none, none))
    assert len(few.start) < len(every.start) / 2
    vector = few.start + np.random.default_rng(0).normal(0, 2e-3, len(few.start))
    parameters = few.of_scene(vector)
    assert len(parameters[SHIFT]) == len(every.planes)
    np.testing.assert_array_equal(few.vector_of(parameters), vector)
    np.testing.assert_allclose(few.residual(vector), every.residual(every.vector_of(parameters)), atol=ROUNDING)


def used(*arguments: str | Path) -> tuple[float, float]:
    """Processor time in s and peak memory in MiB of a command that succeeds."""
    words = [sys.executable, "-m", "wrf_mi.cli.main", *map(str, arguments)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0, words
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "wait4"), reason="memory of a child process is known on Unix alone")
def test_commands_need_a_minute_and_two_gibibytes(folder: Path, tmp_path: Path) -> None:
    room, spectra, run = folder / "room", folder / "spectra", tmp_path / "traced"
    (tmp_path / "places.csv").write_text("x,y,z\n1.0,2.2,1.5\n3.0,2.5,1.3\n")
    commands = [
        ("correct", room, spectra, "--out", tmp_path / "corrected"),
        ("trace", room, spectra, "--out", run),
        ("train", spectra, "--model", "wrf-gs+", "--scene", room, "--set", "steps=300", "--out", tmp_path / "trained"),
        ("predict", run, "--tx", tmp_path / "places.csv", "--out", tmp_path / "predicted.npz"),
        ("map", run, "--out", tmp_path / "map.nc"),
        ("view", run, "--out", tmp_path / "view.html"),
        ("export", run, "--format", "paths", "--out", tmp_path / "paths.csv"),
        ("export", room, "--format", "glb", "--out", tmp_path / "room.glb"),
    ]
    for command in commands:
        seconds, mebibytes = used(*command)
        assert seconds < BUSY * SECONDS, command
        assert mebibytes < MEBIBYTES, command


@pytest.mark.slow
@pytest.mark.parametrize("task", ["rssi", "csi"])
def test_strengths_and_channels_correct_the_room(folder: Path, task: str) -> None:
    record = cad_room.record(folder / "truth", task)
    found = correct_scene(folder / "room", record, make_splits(record, "official")[0])
    assert len(found.vector) < 5_000
    # Three held-out strengths may not tell a change from chance; then the scene stays.
    assert found.kept or task == "rssi"
    assert np.isfinite(found.vector).all()
