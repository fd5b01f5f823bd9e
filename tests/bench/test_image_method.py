"""Comparison with MATLAB's image method in real rooms, and its checks."""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from traced_rooms import FREQUENCY_HZ, SHOEBOX, WAVELENGTH_M, inside, receiver, room
from wrf_mi_bench.trace import confirm_paths, image_method_agreement, match_paths
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.search.surfaces import scene_surfaces

DATA = Path(os.environ.get("WRF_MI_DATA", "")) / "newrf"
SHARE = 0.99
"""Share of MATLAB's paths; missing ones meet a face of square millimetres."""
CEA_DB = 30.0


@pytest.mark.parametrize("name", ["conference", "office"])
def test_paths_of_matlabs_image_method_are_found(name):
    if not (DATA / f"{name}.npz").is_file():
        pytest.skip("newrf is not in WRF_MI_DATA")
    found = image_method_agreement(DATA / f"{name}.npz", rays=1 << 17)
    assert found["share_found"] >= SHARE
    assert found["length_error_m"] < 1e-3
    assert found["cea_db"]["median"] >= CEA_DB
    assert found["cea_db_where_matlab_lacks_none"]["p10"] >= CEA_DB
    # What MATLAB lacks is there, by brute force in float64, but for paths that pass within 0.1 mm of an edge.
    assert found["of_these_confirmed"] >= 0.99 * found["paths_matlab_lacks"]


@pytest.mark.parametrize("reference", ["line of sight alone", "no path"])
def test_a_reference_that_lacks_a_path_at_every_position_is_compared(tmp_path, reference):
    mesh = trimesh.util.concatenate([part for _, part in SHOEBOX.values()])
    mesh.export(tmp_path / "room.stl")
    moving, fixed, k = inside(3), np.array([4.4, 3.1, 1.7]), 2 * np.pi / WAVELENGTH_M
    count = len(moving) if reference == "line of sight alone" else 0
    length = np.linalg.norm(moving - fixed, axis=1)[:count]
    gain = (WAVELENGTH_M / (4 * np.pi * length) * np.exp(-1j * k * length)).astype(complex)
    np.savez(
        tmp_path / "room.npz",
        tx_pos=fixed,
        rx_pos=moving,
        frequency_hz=FREQUENCY_HZ,
        csi=gain if count else np.zeros(len(moving), complex),
        line_of_sight=np.full(len(moving), count > 0),
        path_offsets=np.arange(len(moving) + 1) if count else np.zeros(len(moving) + 1, np.int64),
        path_gain=gain,
        path_last_point=np.tile(fixed, (count, 1)),
    )
    found = image_method_agreement(tmp_path / "room.npz", rays=1 << 12)
    assert found["receivers_matlab_lacks_paths"] == found["receivers"] == 3
    assert found["of_these_confirmed"] == found["paths_matlab_lacks"] > 50
    assert found["cea_db_where_matlab_lacks_none"] is None
    if count:
        assert found["share_found"] == 1
        assert found["cea_db"]["median"] < 10
    else:
        assert found["share_found"] is found["cea_db"] is None


def test_matching_is_one_to_one():
    length, point = np.array([1.0, 1.0004, 2.0]), np.zeros((3, 3))
    ours = np.array([0, 0, 1]), length, point
    theirs = np.array([0, 0, 1, 1]), np.array([1.0003, 1.0001, 2.0, 2.5]), np.zeros((4, 3))
    mine, other = match_paths(ours, theirs)
    assert sorted(zip(mine.tolist(), other.tolist(), strict=True)) == [(0, 1), (1, 0), (2, 2)]
    far = theirs[0], theirs[1], theirs[2] + 0.1
    assert not len(match_paths(ours, far)[0])


def test_confirmation_rejects_moved_and_obstructed_paths(tmp_path):
    partition = {"partition": ("itu_wood", sheet(0, 3.0, (0.0, 4.0), (0.0, 2.0)))}
    scene = room(tmp_path / "open", SHOEBOX)
    tx, rx = np.array([[1.3, 2, 1]]), np.array([4.4, 3.1, 1.7])
    paths = trace_paths(scene, tx, receiver(rx), TraceOptions(depth=2)).paths
    triangles = scene_surfaces(scene).triangles
    assert confirm_paths(paths, tx, rx, triangles).all()
    moved = replace(paths, vertices_m=paths.vertices_m + np.array([0.01, 0.02, 0.01]))
    np.testing.assert_array_equal(confirm_paths(moved, tx, rx, triangles), paths.bounces == 0)
    divided = scene_surfaces(room(tmp_path / "divided", {**SHOEBOX, **partition})).triangles
    kept = confirm_paths(paths, tx, rx, divided)
    assert not kept[0]
    assert kept.any()
