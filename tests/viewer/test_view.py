"""Views of scenes, runs and maps: what they show is what these hold."""

import itertools
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from calling import SMALL, call, refused
from made_channels import channels

import wrf_mi
from wrf_mi.apps.viewer.content import ViewOptions
from wrf_mi.apps.viewer.layers import path_layer, power_db, representative, scene_content, surfaces_in
from wrf_mi.apps.viewer.map_layer import read_map, thinned
from wrf_mi.apps.viewer.view import view
from wrf_mi.core import InputError
from wrf_mi.estimators.ray_tracing import TracingSettings
from wrf_mi.runs.results import read_run
from wrf_mi.runs.run import open_run
from wrf_mi.tracing import load_trace, open_scene
from wrf_mi.tracing.search.surfaces import scene_surfaces

FLOAT32 = 1e-5
"""Relative rounding of float32."""


def trained(data: Path, make: pytest.TempPathFactory, model: str, **options: Any) -> Path:
    return wrf_mi.train(data, model, out=make.mktemp("runs") / model, **options).folder


@pytest.fixture(scope="module")
def traced(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = TracingSettings(depth=2, rays=4096)
    return trained(flat_folder, tmp_path_factory, "ray-tracing", scene=room, settings=settings)


@pytest.fixture(scope="module")
def joint(flat_folder: Path, room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = [*SMALL, "traced.depth=1", "traced.rays=4096", "patience=0"]
    return trained(flat_folder, tmp_path_factory, "wrf-gs+", scene=room, settings=settings)


@pytest.fixture(scope="module")
def field(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A field of spectra without a scene."""
    return trained(folder, tmp_path_factory, "wrf-gs+", settings=SMALL)


def write_map(path: Path, height_m: float = 1.0) -> Path:
    """A map as ``wrf-mi map`` writes it, in NetCDF."""
    xarray = pytest.importorskip("xarray")
    x, y = np.linspace(0, 2, 5), np.linspace(0, 1, 3)
    power = np.arange(30, dtype=np.float32).reshape(2, 3, 5) - 80
    data = {
        "power_dbm": (("receiver", "y", "x"), power, {"units": "dBm", "long_name": "received power"}),
        "best_receiver": (("y", "x"), np.zeros((3, 5), np.int32)),
        "spectrum": (("y", "x", "pixel"), np.zeros((3, 5, 4))),
    }
    coordinates = {"x": x, "y": y, "height": height_m, "receiver": ["anchor1", "anchor2"]}
    xarray.Dataset(data, coordinates).to_netcdf(path, engine="scipy")
    return path


def test_scenes_by_name_folder_file_and_object_show_every_triangle(room, tmp_path):
    scene = open_scene(room, 2.4e9)
    triangles = scene_surfaces(scene).triangles
    for source in (room, room / "scene.xml", scene):
        content = view(source).content
        assert content.counts == {"triangles": len(triangles)}
        shown = np.concatenate([mesh.corners_m for mesh in content.scene.meshes])
        assert np.sort(shown.ravel()) == pytest.approx(np.sort(triangles.ravel()), rel=FLOAT32)
        ceilings = [mesh for mesh in content.scene.meshes if mesh.ceiling]
        assert ceilings
        assert all(mesh.corners_m[..., 2] == pytest.approx(2.7) for mesh in ceilings)
    trimesh.creation.box((2, 3, 4)).export(tmp_path / "box.stl")
    for material, name in ((None, "no material"), ("concrete", "concrete")):
        page = view(tmp_path / "box.stl", material=material)
        assert page.counts == {"triangles": 12}
        assert {mesh.material for mesh in page.content.scene.meshes} == {name}
        assert len(page.content.scene.edges_m) == 12  # those of a box, without diagonals


def test_the_largest_triangles_are_kept(room):
    surfaces, looks = surfaces_in(open_scene(room, 2.4e9))
    content, note = scene_content(surfaces, looks, most=4)
    every = np.concatenate([surface.vertices_m[surface.faces] for surface in surfaces])
    corners_m = np.concatenate([mesh.corners_m for mesh in content.meshes])
    areas = np.sort(trimesh.triangles.area(every))[-4:]
    assert np.sort(trimesh.triangles.area(corners_m)) == pytest.approx(areas)
    assert note == f"Mesh: the largest 4 of {len(every)} triangles."


def test_a_traced_run_shows_its_held_out_rows_and_stored_paths(traced):
    results, content = read_run(traced), view(traced).content
    rows, paths = content.rows, content.paths
    np.testing.assert_array_equal(rows.row, results.row)
    np.testing.assert_array_equal(rows.score, results.score)
    assert rows.label == "absolute error (dB)"
    assert rows.observed["kind"] == "level"
    stored = load_trace(traced / "paths.npz")
    assert len(paths.tx) == np.isin(stored.paths.tx, results.row).sum()
    first = np.concatenate([[0], np.cumsum(paths.order + 2)])
    np.testing.assert_allclose(paths.corners_m[first[:-1]], rows.tx_pos_m[rows.stored][paths.tx])
    np.testing.assert_allclose(paths.corners_m[first[1:] - 1], content.receivers_m[paths.rx])
    legs = np.linalg.norm(np.diff(paths.corners_m, axis=0), axis=1)
    length = [legs[a : b - 1].sum() for a, b in itertools.pairwise(first)]
    assert paths.length_m == pytest.approx(length, rel=FLOAT32)
    assert set(paths.kinds) == {"line of sight", "reflection", "reflection, reflection"}


def test_the_strongest_paths_of_each_pair_are_kept(traced):
    stored = load_trace(traced / "paths.npz")
    strongest, every = path_layer(stored, 2), path_layer(stored, 10**6)
    for tx in range(stored.paths.n_tx):
        for rx in range(stored.paths.n_rx):
            best = np.sort(every.gain_db[(every.tx == tx) & (every.rx == rx)])[-2:]
            assert np.sort(strongest.gain_db[(strongest.tx == tx) & (strongest.rx == rx)]) == pytest.approx(best)


def test_a_joint_run_shows_gaussians_and_paths_of_its_settings(joint):
    shown = view(joint, transmitters=3, gaussians=5)
    content, run = shown.content, open_run(joint)
    gaussians = content.gaussians
    assert shown.counts["transmitters"] == 3
    assert (shown.counts["gaussians"], gaussians.total) == (5, run.metrics["gaussians"])
    positions_m = np.array(run.field.params["position"], float).T
    for at_m in gaussians.position_m:
        assert np.abs(positions_m - at_m).max(axis=1).min() < FLOAT32
    strength = (10 ** (gaussians.strength_db / 10)).mean(axis=0)
    assert (np.diff(strength) <= 0).all()
    assert content.paths.order.max() <= 1
    text = " ".join(content.notes)
    for words in ("3 of 6 held-out rows", f"the 5 of {gaussians.total} of", "at most 1 interactions"):
        assert words in text


def test_layers_of_two_runs_of_the_same_data_are_combined(traced, joint, field):
    both = view(traced, joint)
    assert {"triangles", "gaussians", "paths", "held_out_rows"} <= both.counts.keys()
    np.testing.assert_array_equal(both.content.rows.score, read_run(traced).score)
    other = view(traced, field).content
    assert other.gaussians is None
    assert "wrf-gs+: of other data than the first run; only its scene is shown." in other.notes


def test_a_field_of_spectra_shows_them(field):
    content, results = view(open_run(field)).content, read_run(field)
    observed = content.rows.observed
    assert observed["kind"] == "image"
    truth = results.truth[:, np.isin(results.row, content.rows.row[content.rows.stored])]
    assert observed["measured"] == pytest.approx(255 * truth, abs=0.5)
    assert observed["predicted"].shape == truth.shape
    assert content.scene is None
    assert content.gaussians.strength_db.shape == (len(content.rows.stored), 8)


def test_channels_are_curves_where_positions_are_known(tmp_path):
    record, unplaced = channels(True), channels(False)
    run = open_run(wrf_mi.train(record, "idw", out=tmp_path / "placed").folder, record)
    rows = view(run).content.rows
    assert rows.observed["kind"] == "curve"
    assert rows.observed["measured"].shape == (1, 10, 4)
    truth = read_run(tmp_path / "placed").truth
    assert power_db(truth) == pytest.approx(10 * np.log10(np.square(np.abs(truth)).mean(axis=2)))
    folder = wrf_mi.train(unplaced, "linear", out=tmp_path / "unplaced").folder
    with pytest.raises(InputError, match="neither scene nor positions are known"):
        view(open_run(folder, unplaced))


def test_representative_rows_span_the_scores():
    score = np.array([[5.0, 1.0, 3.0, np.nan, 2.0, 4.0], [5.0, 1.0, 3.0, np.nan, 2.0, np.nan]])
    np.testing.assert_array_equal(representative(score, 3), [0, 1, 2])  # best, worst and median
    np.testing.assert_array_equal(representative(score, 9), np.arange(6))
    np.testing.assert_array_equal(representative(np.full((1, 4), np.nan), 2), [0])


def test_maps_are_shown_with_their_heights_and_thinned_where_they_are_large(traced, tmp_path):
    files = [write_map(tmp_path / f"at{height}.nc", height) for height in (0.5, 1.5)]
    content = view(traced, *files).content
    assert content.counts["maps"] == 2
    assert [layer.height_m for layer in content.maps] == [0.5, 1.5]
    first = content.maps[0]
    assert first.labels == {"power_dbm": "received power (dBm)", "best_receiver": "best receiver"}
    shapes = {name: values.shape for name, values in first.values.items()}
    assert shapes == {"power_dbm": (2, 3, 5), "best_receiver": (1, 3, 5)}
    assert first.receivers == ("anchor1", "anchor2") == tuple(view(files[0]).content.receivers)
    assert any("spectrum not shown" in note for note in content.notes)
    (thin,), notes = thinned([first], most=20)
    assert len(notes) == 1
    np.testing.assert_array_equal(thin.values["power_dbm"], first.values["power_dbm"][:, ::2, ::2])
    np.testing.assert_array_equal(thin.x_m, first.x_m[::2])
    assert thinned([first])[0] == [first]


def test_maps_of_surfaces_and_datasets_are_points(tmp_path):
    xarray = pytest.importorskip("xarray")
    positions = np.random.default_rng(2).uniform(size=(3, 20))
    points = {axis: ("point", values) for axis, values in zip("xyz", positions, strict=True)}
    values = {"power_dbm": (("receiver", "point"), np.arange(20.0)[None])}
    layer, notes = read_map(xarray.Dataset(values, {**points, "receiver": ["a"]}))
    assert (layer.height_m, notes) == (None, [])
    assert layer.z_m == pytest.approx(positions[2])
    (thin,), (note,) = thinned([layer], most=6)
    np.testing.assert_array_equal(thin.values["power_dbm"], [[0, 4, 8, 12, 16]])
    assert note == "Maps: every 2th position along each axis (every 4th point of a surface)."


def test_a_chunk_that_ends_its_decompressor_is_refused_in_one_line(tmp_path):
    xarray, folder = pytest.importorskip("xarray"), tmp_path / "map.zarr"
    pytest.importorskip("zarr")
    power = np.random.default_rng(0).uniform(-90, -40, (2, 7, 8)).astype(np.float32)
    axes = {"x": np.arange(8.0), "y": np.arange(7.0), "height": 1.0, "receiver": ["a", "b"]}
    xarray.Dataset({"power_dbm": (("receiver", "y", "x"), power)}, axes).to_zarr(folder, zarr_format=2)
    layer, _ = read_map(folder)
    np.testing.assert_array_equal(layer.values["power_dbm"], power)
    assert (layer.name, layer.receivers, layer.height_m) == ("map.zarr", ("a", "b"), 1.0)
    chunk = folder / "power_dbm" / "0.0.0"
    head = chunk.read_bytes()[:14]  # of Blosc, but for the higher bytes of the compressed size
    chunk.write_bytes(head.ljust(500, b"\1"))
    with pytest.raises(InputError, match=r"^\S+map\.zarr: its content is damaged; make the map anew$"):
        read_map(folder)


def test_command_writes_one_file(traced, room, tmp_path, capsys):
    out = tmp_path / "new" / "view.html"
    status, printed, err = call(["view", traced, "--out", out, "--max-transmitters", 2, "--max-paths", 1], capsys)
    assert status == 0
    assert printed.splitlines()[-1] == f"view: {out} ({out.stat().st_size / 1e6:.1f} MB)"
    assert err.startswith("opening the scene\n")
    status, printed, _ = call(["view", room, "--out", out, "--json"], capsys)
    counts = json.loads(printed)
    assert (status, counts["bytes"], counts["notes"]) == (0, out.stat().st_size, [])
    assert counts["triangles"] > 0
    assert counts["bytes"] < 15e6


def test_command_refuses_in_one_line(traced, tmp_path, capsys, monkeypatch):
    out = tmp_path / "view.html"
    (tmp_path / "bad.nc").write_bytes(b"no map")
    for source, message in (
        ("no", "no: no such file; give a run folder, a map or a scene"),
        ("no.nc", "no.nc: no such file"),
        ("no.stl", "no.stl: no such file"),
        ("bad.nc", "bad.nc: not readable"),
    ):
        refused(["view", tmp_path / source, "--out", out], message, capsys)
    refused(["view", traced, "--out", tmp_path], "a folder; give the name of a file", capsys)
    refused(["view", traced, "--out", out, "--max-gaussians", 0], "setting gaussians: 0 is out of range", capsys)
    assert not out.exists()
    with pytest.raises(InputError, match="nothing to show"):
        view()
    (tmp_path / "bad.zarr").mkdir()
    for file, package in (("bad.nc", "h5py"), ("bad.zarr", "zarr"), ("bad.nc", "xarray")):
        monkeypatch.setitem(sys.modules, package, None)
        refused(["view", tmp_path / file, "--out", out], rf"need {package}: pip install '\.\[view\]'", capsys)


def test_options_have_the_documented_defaults():
    assert ViewOptions() == ViewOptions(transmitters=40, gaussians=1000, paths=200)
