"""Paths in a scene whose planes have moved, and corners of its faces."""

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, HEIGHT, LENGTH, WIDTH, true_scene

from wrf_mi.core import Receiver
from wrf_mi.scene.folder import write_scene
from wrf_mi.scene.mesh.surfaces import Surface
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.paths.corrected_scene import moved_search, moved_triangles
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT, slabs_of_faces
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.surfaces import scene_surfaces

RECEIVER = Receiver("anchor", np.array([1.0, 1.1, 2.2]), np.array([0, 0, 0, 1.0]))
OPTIONS = TraceOptions(transmission=True, depth=3, rays=1 << 15)
POSITIONS = np.random.default_rng(0).uniform([0.4, 0.4, 0.4], [LENGTH - 0.4, WIDTH - 0.4, HEIGHT - 0.4], (40, 3))
AT_EDGES = 0.005  # Share of paths that meet a surface within the rounding of its single-precision corners from an edge
ROUNDED_M = 1e-4  # Lengths of paths through a scene that was written and read, and through one that was moved in memory


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """The room as stated, twice, as it is, and the parameters of its planes."""
    folder = tmp_path_factory.mktemp("moved")
    true, shift, tilt = true_scene(folder)
    base_scene, copy, moved = (open_scene(place, CARRIER_HZ) for place in (folder / "base", folder / "base", true))
    return base_scene, copy, moved, {SHIFT: shift.astype(np.float32), TILT: tilt.astype(np.float32)}


def traced(prepared):
    return trace_paths(prepared.scene, POSITIONS, RECEIVER, OPTIONS, prepared=prepared)


def shared(one, other):
    """Share of the paths of the longer of two lists that both have: kinds and objects met, and equal lengths."""

    def names(trace):
        met = np.stack([trace.paths.interactions.astype(int), trace.paths.objects], axis=-1)
        rows = np.concatenate([trace.paths.tx[:, None], met.reshape(len(met), -1)], axis=1)
        return [tuple(row) for row in rows]

    lengths = dict(zip(names(other), other.paths.length_m, strict=True))
    pairs = zip(names(one), one.paths.length_m, strict=True)
    both = sum(abs(lengths.get(name, np.inf) - length) < ROUNDED_M for name, length in pairs)
    return both / max(len(one.paths), len(other.paths))


def test_paths_are_those_of_the_scene_with_its_planes_moved(scenes):
    base_scene, copy, moved, planes = scenes
    before = Prepared(base_scene)
    moved_paths = traced(moved_search(copy, before.surfaces, planes).prepared)
    assert shared(traced(Prepared(moved)), moved_paths) > 1 - AT_EDGES
    assert shared(traced(before), moved_paths) < 0.5


def test_a_surface_that_is_absent_is_not_met(scenes):
    base_scene, copy, _, planes = scenes
    surfaces = Prepared(base_scene).surfaces
    board = surfaces.names.index("board")
    slab = slabs_of_faces(base_scene, surfaces, "surface")[1][surfaces.first_face[board]]
    for absent, met in (((), True), ((slab,), False)):
        paths = traced(moved_search(copy, surfaces, planes, absent).prepared).paths
        assert (paths.objects == board).any() == met


def test_a_scene_is_moved_from_where_it_was_stated_and_back(scenes):
    base_scene, copy, _, planes = scenes
    before = Prepared(base_scene)
    moved_search(copy, before.surfaces, planes, (0,))
    assert shared(traced(before), traced(moved_search(copy, before.surfaces, {}).prepared)) == 1


SHIFT_M = 0.03
STORED_M = 1e-5  # Meshes are stored in single precision
QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def upright(begin, end):
    """Corners [4, 3] of a wall 2.7 m high over a line in plan."""
    return np.array([[*begin, 0], [*end, 0], [*end, 2.7], [*begin, 2.7]], float)


def walls(folder, angle_deg):
    """A wall of 4 m whose plane moves, and one of 0.2 m that goes on at an angle: their corners, moved, [2, 3, 3]."""
    turn = np.radians(angle_deg)
    parts = [upright((0, 0), (4, 0)), upright((4, 0), (4 + 0.2 * np.cos(turn), 0.2 * np.sin(turn)))]
    surfaces = [Surface(f"wall_0{k}", "wall", part, QUAD) for k, part in enumerate(parts, 1)]
    planes = scene_surfaces(open_scene(write_scene(folder, surfaces, frame="made up", source="made up"), CARRIER_HZ))
    large = int(np.argmax(np.abs(planes.normal[:, 1]) > 0.999))
    shift = SHIFT_M * planes.normal[:, 1].round() * (np.arange(len(planes.normal)) == large)
    moved = moved_triangles(planes, {SHIFT: shift})
    return moved[planes.plane == large], moved[planes.plane != large]


def test_a_wall_stays_flat_at_a_small_face_almost_parallel_to_it_and_meets_others_at_the_new_intersection(tmp_path):
    """The common corners follow the wall, the larger of the two."""
    wall, face = walls(tmp_path / "parallel", 8)
    common = np.isclose(face[..., 0], 4, atol=STORED_M)
    assert common.sum() == 3  # of the corners of two triangles
    angled, _ = walls(tmp_path / "angled", 30)
    for y in (wall[..., 1], face[common][:, 1], angled[..., 1]):
        np.testing.assert_allclose(y, SHIFT_M, atol=STORED_M)
    assert np.isclose(angled[..., 0].max(), 4 + SHIFT_M / np.tan(np.radians(30)), atol=STORED_M)
