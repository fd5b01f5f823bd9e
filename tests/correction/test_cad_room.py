"""Rooms of CAD programs: furniture of 100,000 facets, each in a plane of its own, costs next to nothing."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import Parts, write_scene

from wrf_mi.core import Receiver, Record
from wrf_mi.core.antenna import UPRIGHT
from wrf_mi.core.arrays import planar_array
from wrf_mi.correction import CorrectionOptions, write_page
from wrf_mi.correction.misfit import Misfit
from wrf_mi.correction.state import LEAST_PATHS
from wrf_mi.datasets import make_splits, read_spectrum_folder, write_spectrum_folder
from wrf_mi.stages.correct import correct_scene
from wrf_mi.tasks import instrument_of
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.tracer import RayTracer

CARRIER_HZ = 920e6
LENGTH, WIDTH, HEIGHT = 5.0, 4.0, 2.6
WALLS = ("itu_concrete", "itu_plasterboard", "itu_brick", "itu_brick", "itu_wood", "itu_wood")
"""Stated materials of floor, ceiling and walls."""
TRUE_WALLS = ("itu_wood", "itu_metal", "itu_plasterboard", "itu_brick", "itu_concrete", "itu_glass")


def cushion(low: tuple[float, ...], high: tuple[float, ...], count: int, roundness: float = 0.35) -> trimesh.Trimesh:
    """A closed body of 2 count (2 count - 1) or so facets between two corners [3], metres: a superellipsoid.

    Exponents below 1 flatten its sides; all facets but those about the poles differ in their planes.
    """
    sphere = trimesh.creation.uv_sphere(count=[count, 2 * count])
    points = np.sign(sphere.vertices) * np.abs(sphere.vertices) ** roundness
    # A bulge without symmetry, so that the two triangles of a quadrilateral are not in one plane.
    points += 0.01 * np.sin(3.1 * points[:, [1, 2, 0]] + [0.3, 0.7, 1.1])
    return trimesh.Trimesh(np.add(high, low) / 2 + np.subtract(high, low) / 2 * points, sphere.faces, process=False)


def handle(x: float, y: float, z: float, sections: int) -> trimesh.Trimesh:
    """A horizontal handle of a drawer, a capsule of 12 cm."""
    mesh = trimesh.creation.capsule(0.12, 0.008, count=[sections, sections])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    mesh.apply_translation([x, y, z])
    return mesh


def furniture(detail: int = 33) -> Parts:
    """Name of each piece with its material and mesh; about 94 detail^2 facets."""
    join = trimesh.util.concatenate
    mattress = cushion((0.3, 0.2, 0.3), (2.3, 1.8, 0.55), 2 * detail, 0.2)
    pillows = [cushion((0.35, y, 0.55), (0.8, y + 0.6, 0.7), detail, 0.6) for y in (0.3, 1.1)]
    seats = [cushion((x, 3.1, 0.25), (x + 0.7, 3.8, 0.5), detail, 0.3) for x in (0.4, 1.15, 1.9)]
    backs = [cushion((x, 3.6, 0.5), (x + 0.7, 3.9, 1.0), detail, 0.4) for x in (0.4, 1.15, 1.9)]
    drawers = [trimesh.creation.box(bounds=((4.2, y, 0.05), (4.9, y + 0.75, 0.9))) for y in (0.4, 1.2, 2.0)]
    handles = [handle(4.19, y + 0.3, z, detail // 4) for y in (0.4, 1.2, 2.0) for z in (0.25, 0.5, 0.75)]
    lamp = trimesh.creation.cone(0.2, 0.25, sections=4 * detail)
    lamp.apply_translation([2.6, 2.0, 2.0])
    return {
        "mattress": ("itu_plasterboard", mattress),
        "pillows": ("itu_plasterboard", join(pillows)),
        "bed": ("itu_wood", trimesh.creation.box(bounds=((0.25, 0.15, 0.05), (2.35, 1.85, 0.3)))),
        "seats": ("itu_wood", join(seats)),
        "backs": ("itu_wood", join(backs)),
        "cabinets": ("itu_chipboard", join(drawers)),
        "handles": ("itu_metal", join(handles)),
        "lamp": ("itu_metal", lamp),
    }


def parts(detail: int = 33, walls: Sequence[str] = WALLS) -> Parts:
    """The furniture in six walls of given materials."""
    x, y, z = (0.0, LENGTH), (0.0, WIDTH), (0.0, HEIGHT)
    sheets = [sheet(2, at, x, y) for at in z] + [sheet(0, at, y, z) for at in x] + [sheet(1, at, x, z) for at in y]
    names = ("floor", "ceiling", "west", "east", "south", "north")
    return {**dict(zip(names, zip(walls, sheets, strict=True), strict=True)), **furniture(detail)}


def write_room(folder: Path, detail: int = 33, walls: Sequence[str] = WALLS) -> Path:
    """The room as a scene folder."""
    return write_scene(folder, parts(detail, walls), "Room of a CAD program", "tests.test_cad_room").parent


def observed(truth: Path, task: str, rows: int = 15) -> Record:
    """Observations in a room from places between the furniture, those of the last rows for tests: spectra of a 4 x 4
    array, signal strengths, or channels of one antenna on eight subcarriers.
    """
    hz = CARRIER_HZ + (np.linspace(-20e6, 20e6, 8) if task == "csi" else np.zeros(1))
    array_m = planar_array(4, 4, 0.16) if task == "spectrum" else None
    receiver = Receiver("gateway", np.array([3.2, 0.5, 1.4]), np.array(UPRIGHT), array_m=array_m)
    shape, dtype = {"spectrum": ((90, 360), "f4"), "rssi": ((), "f4"), "csi": ((8,), "c8")}[task]
    places = np.random.default_rng([0, 2]).uniform([0.4, 1.95, 1.1], [4.0, 3.6, 2.3], (rows, 3)).round(3)
    official = np.arange(rows - rows // 5), np.arange(rows - rows // 5, rows)
    empty = np.zeros((1, rows, *shape), dtype)
    record = Record("cad-room", task, places, (receiver,), empty, frequencies_hz=hz, official=official)
    tracer = RayTracer(truth, instrument_of(record), TraceOptions(transmission=True, depth=3))
    return replace(record, observation=tracer(places).astype(dtype))


SECONDS, MEBIBYTES = 60, 2048
"""Most processor time and memory of a command with 15 rows, on a machine that does nothing else."""
BUSY = 3
"""Factor on times: processors that others share are slower."""
ROUNDING = 1e-6
"""Of residuals in single precision."""


def with_spectra(folder: Path, detail: int) -> Path:
    """The room with stated materials, and spectra in it with others."""
    write_room(folder / "room", detail)
    truth = write_room(folder / "truth", 8, TRUE_WALLS)
    write_spectrum_folder(folder / "spectra", observed(truth, "spectrum"), bits=16)
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """With 24,000 facets; what costs little with them does with four times as many, as slow tests show."""
    return with_spectra(tmp_path_factory.mktemp("cad"), 16)


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return with_spectra(tmp_path_factory.mktemp("large"), 33)


@pytest.fixture(scope="module")
def corrected(folder):
    record = read_spectrum_folder(folder / "spectra", "cad-room")
    options = CorrectionOptions(("materials", "planes", "frame"), depth=2, rays=1 << 14, steps=2)
    return correct_scene(folder / "room", record, make_splits(record, "official")[0], options)


def test_only_surfaces_that_paths_meet_have_parameters(corrected):
    """Of 24,000 surfaces; held-out spectra are explained by the walls' materials."""
    surfaces, misfit = corrected.misfit.traced_fields[0].surfaces, corrected.misfit
    assert len(surfaces.triangles) > 22_000
    assert len(surfaces.normal) > 20_000
    assert len(corrected.vector) < 5_000
    assert (misfit.counts()[1] >= LEAST_PATHS).sum() >= 6
    assert np.nanmean(corrected.scores[corrected.kept]) > np.nanmean(corrected.scores[""]) + 0.1


def test_unmet_facets_stay_one_object_of_the_written_scene(corrected, tmp_path):
    """Each changed surface is an object; of the furniture's facets few are."""
    facts = write_page(corrected, tmp_path / "scene")
    parts = {path.stem for path in (tmp_path / "scene" / "meshes").glob("*.ply")}
    assert {"mattress", "north", "floor"} <= parts
    assert len(parts) < 100
    assert facts["surfaces"] > 20_000
    assert len(facts["materials"]) == len(corrected.misfit.slabs)
    written = open_scene(tmp_path / "scene", CARRIER_HZ)
    absent = list(corrected.state.absent())
    present = ~np.isin(corrected.misfit.tables.slab_of_face, absent)
    assert sum(thing.mi_mesh.face_count() for thing in written.objects.values()) == present.sum()
    assert (tmp_path / "scene" / "correction.json").stat().st_size < 2e6


def test_residuals_do_not_depend_on_surfaces_that_no_path_meets(tmp_path):
    """With parameters of all surfaces or of those that paths meet, also where planes and materials have changed."""
    truth = write_room(tmp_path / "room", 4)
    record = observed(truth, "spectrum", 6)
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
    words = [sys.executable, "-m", "wrf_mi.apps.commands.main", *map(str, arguments)]
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as child:
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    assert child.returncode == 0, words
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "wait4"), reason="memory of a child process is known on Unix alone")
def test_commands_need_a_minute_and_two_gibibytes(large, tmp_path):
    room, spectra, run, places = large / "room", large / "spectra", tmp_path / "traced", tmp_path / "places.csv"
    places.write_text("x,y,z\n1.0,2.2,1.5\n3.0,2.5,1.3\n")
    commands = [
        ("correct", spectra, "--scene", room, "--out", tmp_path / "corrected"),
        ("trace", spectra, "--scene", room, "--out", run),
        ("train", spectra, "--model", "wrf-gs+", "--scene", room, "--set", "steps=300", "--out", tmp_path / "trained"),
        ("predict", run, "--tx", places, "--out", tmp_path / "predicted.npz"),
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
def test_strengths_and_channels_correct_the_room(large, task):
    record = observed(large / "truth", task)
    correction = correct_scene(large / "room", record, make_splits(record, "official")[0])
    assert len(correction.misfit.traced_fields[0].surfaces.triangles) > 100_000
    assert len(correction.misfit.traced_fields[0].surfaces.normal) > 90_000
    assert len(correction.vector) < 5_000
    # Three held-out strengths may not tell a change from chance; then the scene stays.
    assert correction.kept or task == "rssi"
    assert np.isfinite(correction.vector).all()
