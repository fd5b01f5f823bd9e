"""Edges and seams: closed rooms never hear each other, and positions of a grid hear what their neighbours hear."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from traced_rooms import HEIGHT, LENGTH, SHOEBOX, WIDTH, image_lengths, inside, receiver, room
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.chains import TRANSMISSION
from wrf_mi.tracing.search.surfaces import ENLARGED, OVERLAP, enlarged, find_planes

LONG, WIDE, HIGH, WALL = 8.0, 4.0, 2.5, 4.0  # Two rooms side by side, metres, and where the wall between them stands
OPAQUE = TraceOptions(transmission=False)
EXACT_M = 1e-12  # Lengths are float64 where the planes are
NEIGHBOUR_M = 2e-3  # Far enough from an edge that rays are sure, near enough that powers hardly change
SLOPE_DB = 0.1  # Change of a power over 2 mm: 0.01 dB at 1 m for the nearest path, with a margin of ten
SLOW = settings(max_examples=10, deadline=None)  # A trace of some twenty positions takes a tenth of a second


def rooms(material, turned_rad=0.0, pieces=8):
    """Two closed rooms of sheets that only touch: the wall between them, in pieces, stands on the floor of both."""
    size, sheets = (LONG, WIDE, HIGH), dict[str, trimesh.Trimesh]()
    for axis, (low, high) in enumerate((("west", "east"), ("south", "north"), ("floor", "ceiling"))):
        extents = [(0.0, size[k]) for k in range(3) if k != axis]
        sheets |= {low: sheet(axis, 0.0, *extents), high: sheet(axis, size[axis], *extents)}
    ends = np.linspace(0.0, WIDE, pieces + 1)
    for k, sill in enumerate([1.25, 1.0] * (pieces // 2)):  # seams that meet the middle of other pieces' ends
        for part, heights in {"lower": (0.0, sill), "upper": (sill, HIGH)}.items():
            sheets[f"wall{k}{part}"] = sheet(0, WALL, (ends[k], ends[k + 1]), heights)
    for mesh in sheets.values():
        mesh.apply_transform(turn(turned_rad))
    return {name: (material, mesh) for name, mesh in sheets.items()}


def turn(turned_rad):
    """Rotation [4, 4] about z."""
    return trimesh.transformations.rotation_matrix(turned_rad, [0, 0, 1])


@pytest.fixture(scope="module")
def closed(tmp_path_factory):
    """Metal rooms along the axes, and turned by 3 : 4 and by 30 degrees."""
    angles = (0.0, float(np.arctan2(3, 4)), np.pi / 6)
    return {a: room(tmp_path_factory.mktemp("closed"), rooms("itu_metal", a)) for a in angles}


def heard(scene, sources, targets, depth, turned_rad=0.0):
    """Paths from transmitters [n, 3] to receivers [m, 3] of the rooms before they were turned."""
    matrix = turn(turned_rad)[:3, :3].T
    devices = [receiver(np.asarray(p) @ matrix, f"rx{k}") for k, p in enumerate(targets)]
    options = replace(OPAQUE, depth=depth, rays=1 << 15)
    return trace_paths(scene, np.asarray(sources) @ matrix, devices, options, gains=False, check=False).paths


def power_db(paths):
    return 10 * np.log10(np.square(np.abs(paths.gain)).sum())


def test_places_on_a_grid_and_mirrored_ones_do_not_hear_the_other_room(closed):
    """Between places mirrored in the wall the floor and the ceiling reflect at its foot and at its top."""
    grid = np.array([*product(np.arange(0.5, WALL, 0.5), np.arange(0.5, WIDE, 0.5), (1.0,))])
    places = np.array([*product((0.5, 1.5, 3.0), (0.5, 2.0, 2.65), (0.5, 1.25))])
    for angle, scene in closed.items():
        assert not len(heard(scene, np.add(grid, [WALL, 0, 0]), [[1, 1, 2], [2.5, 3, 1.5]], 4, angle)), angle
        assert not len(heard(scene, places * [-1, 1, 1] + [2 * WALL, 0, 0], places, 3, angle)), angle


@SLOW
@given(data=st.data())
def test_closed_rooms_never_hear_each_other(closed, data):
    """At any places, of coarse and of fine grids."""
    step = data.draw(st.sampled_from([0.5, 0.25, 0.1, 1 / 3, 0.01, 1e-4]))
    angle = data.draw(st.sampled_from(sorted(closed)))

    def places(count):
        axes = [st.integers(1, int(size / step) - 1) for size in (WALL, WIDE, HIGH)]
        return [[step * data.draw(axis) for axis in axes] for _ in range(count)]

    sources, targets = np.array(places(8)), np.array(places(3))
    assert not len(heard(closed[angle], np.add(sources, [WALL, 0, 0]), targets, 4, angle))


def test_a_path_in_the_same_room_is_not_lost_for_the_wall(closed):
    """Of a room's own paths none is missing: those of the mirror images."""
    for source, target in (([1.0, 2, 1], [3.0, 2, 1]), ([0.5, 1, 0.5], [3.5, 3, 2]), ([2.0, 2, 1.25], [2.0, 2, 1.75])):
        paths = heard(closed[0.0], [source], [target], 2)
        assert len(paths) == 25, (source, target)


def test_wave_is_blocked_by_a_seam_and_by_a_free_edge(tmp_path):
    """Of two pieces of a wall, through their common edge, and of a board at its top, end and corner exactly."""
    wall = {"a": ("itu_metal", sheet(0, 2.0, (0.0, 2.0), (0.0, 2.5)))}
    both = wall | {"b": ("itu_metal", sheet(0, 2.0, (2.0, 4.0), (0.0, 2.5)))}
    direct = replace(OPAQUE, reflection=False)

    def passes(scene, source, target):
        ways = (source, target), (target, source)
        (number,) = {len(trace_paths(scene, [a], receiver(b), direct, check=False).paths) for a, b in ways}
        return number == 1

    assert not passes(room(tmp_path / "both", both), [0.5, 2.65, 1.25], [3.5, 1.35, 1.25])
    board = room(tmp_path / "one", wall)
    edges: tuple[tuple[Any, Any], ...] = (
        ([2, 1, 2.5], [0, 0, 2e-3]),
        ([2, 2, 1], [0, 2e-3, 0]),
        ([2, 2, 2.5], [0, 2e-3, 0]),
    )
    for (at, beyond), away in product(edges, ([1.5, 0.0, 0.0], [1.5, 0.5, 0.25], [1.5, -0.3, 0.7])):
        source, target = np.subtract(at, away), np.add(at, away)
        assert not passes(board, source, target), (at, away)
        assert passes(board, source + beyond, target + beyond), (at, away)


def test_no_path_over_a_floor_leads_under_the_wall_on_it(tmp_path):
    floor, wall = sheet(2, 0.0, (0.0, 4.0), (0.0, 3.0)), sheet(0, 2.0, (0.0, 3.0), (0.0, 2.5))
    scene = room(tmp_path, {"floor": ("itu_metal", floor), "wall": ("itu_metal", wall)})
    places = np.array([*product((0.5, 1.0, 1.5), (0.5, 1.0, 1.7), (0.5, 1.0))])
    targets = [receiver(p, f"rx{k}") for k, p in enumerate(places * [-1, 1, 1] + [4, 0, 0])]
    assert not len(trace_paths(scene, places, targets, replace(OPAQUE, depth=2), check=False).paths)


PAIRS = (
    *(([1.0, 2, 1], [4.0, 2, 1]), ([1.0, 2.5, 1.5], [5.0, 2.5, 1.5]), ([1.0, 1, 1], [2.0, 2, 1])),
    *(([1.0, 1, 1], [2.0, 2, 2]), ([1.0, 1, 1], [2.0, 1, 2]), ([2.0, 2, 1], [4.0, 3, 1])),
    ([1.5, 1.25, 0.75], [2.4, 2.0, 1.2]),
)
"""Pairs with paths through edges of the shoebox, in which two reflections coincide."""


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_reflections_in_an_edge_count_once(shoebox, source, target):
    """With the gains of positions nearby, and in both directions the same paths."""
    ways = (source, target), (np.add(source, [7e-4, 1e-3, 4e-4]), target), (target, source)
    paths, near, back = (trace_paths(shoebox, [a], receiver(b), replace(OPAQUE, depth=3)).paths for a, b in ways)
    np.testing.assert_allclose(paths.length_m, image_lengths(np.array(source), np.array(target), 3), atol=EXACT_M)
    assert power_db(paths) == pytest.approx(power_db(near), abs=SLOPE_DB)
    order, mine = (np.lexsort((np.abs(each.gain), each.length_m.round(9))) for each in (back, paths))
    np.testing.assert_allclose(back.gain[order], paths.gain[mine], atol=2e-3 * np.abs(paths.gain).max())


def test_reflections_on_the_diagonal_of_a_rectangle_are_not_lost(shoebox):
    """Floor and ceiling reflect at their diagonal, along which both triangles of a rectangle meet."""
    shares = np.linspace(0.05, 0.95, 24)[:, None]
    for start, end in (([0, 0], [LENGTH, WIDTH]), ([LENGTH, 0], [0, WIDTH])):
        source = np.hstack([start + shares * np.subtract(end, start), np.full((24, 1), 1.0)])
        for target in (np.add(source, [0, 0, 1.0]), np.add(source[::-1], [0, 0, 0.5])):
            for row in range(0, 24, 5):
                paths = trace_paths(shoebox, source[[row]], receiver(target[row]), replace(OPAQUE, depth=1)).paths
                assert len(paths) == 7 - (np.abs(source[row] - target[row]) < 1e-9).all()


def test_ceiling_lets_nothing_pass_at_its_diagonal(shoebox):
    options = replace(OPAQUE, reflection=False)
    for share in np.linspace(0.05, 0.95, 24):
        below, above = ([share * LENGTH, share * WIDTH, z] for z in (1.0, HEIGHT + 1.0))
        assert not len(trace_paths(shoebox, [below], receiver(above), options, check=False).paths), share


def test_places_on_a_grid_hear_what_their_neighbours_hear(tmp_path):
    """In rooms whose walls let waves pass: no cell of a map stands out."""
    scene, rng = room(tmp_path, rooms("itu_concrete")), np.random.default_rng(1)
    grid = np.array([*product(np.arange(0.5, LONG, 0.5), np.arange(0.5, WIDE), [1.0])])
    grid = grid[grid[:, 0] != WALL]
    options = TraceOptions(depth=3, transmission=True, rays=1 << 15)
    for target in ([1.0, 1, 2], [2.5, 3, 1.5]):
        # At an edge neighbours on both sides differ: the grid is like some of them.
        moves = rng.uniform(-NEIGHBOUR_M, NEIGHBOUR_M, (9, *grid.shape)) * (np.arange(9) > 0)[:, None, None]
        traces = (trace_paths(scene, grid + move, receiver(target), options).paths for move in moves)
        on, *near = (10 * np.log10(np.bincount(p.tx, np.square(np.abs(p.gain)), len(grid))) for p in traces)
        assert (on > np.min(near, axis=0) - SLOPE_DB).all()
        assert (on < np.max(near, axis=0) + SLOPE_DB).all()


def test_paths_of_a_pair_are_the_same_alone_in_a_batch_and_in_any_order(tmp_path):
    """However many transmitters and receivers there are, with few rays, which miss paths from each side."""
    scene = room(tmp_path, {**SHOEBOX, "board": ("itu_brick", sheet(1, 2.6, (0.4, 1.1), (0.6, 1.2)))})
    options, places = TraceOptions(depth=4, transmission=True, rays=500), inside(7, 4)
    tx, rx = places[:2], [receiver(p, f"rx{k}") for k, p in enumerate(places[2:])]
    batch = trace_paths(scene, tx, rx, options).paths
    turned = trace_paths(scene, tx[::-1], rx[::-1], options).paths
    few = trace_paths(scene, np.repeat(tx, 4, axis=0), rx[3], options, prepared=Prepared(scene)).paths
    for i, k in product(range(2), range(5)):
        alone = trace_paths(scene, tx[[i]], rx[k], options).paths
        for others, a, b in ((batch, i, k), (turned, 1 - i, 4 - k), *[(few, 4 * i + 1, 0)] * (k == 3)):
            paths = others.select((others.tx == a) & (others.rx == b))
            np.testing.assert_array_equal(paths.length_m, alone.length_m)
            np.testing.assert_allclose(paths.gain, alone.gain, rtol=1e-5)  # other widths of vector instructions


def test_direct_path_is_traced_at_any_distance_but_none(shoebox):
    for distance, count in ((9e-3, 7), (1e-3, 7), (1e-5, 7), (0.0, 6)):
        paths = trace_paths(shoebox, [[2.0, 2, 1]], receiver([2.0 + distance, 2, 1]), replace(OPAQUE, depth=1)).paths
        assert len(paths) == count
        assert count == 6 or paths.length_m.min() == pytest.approx(distance, rel=1e-9)
        assert np.isfinite(paths.gain).all()


SCALE_M = 5.0  # Scale of a room of four metres


def test_faces_are_enlarged_at_free_and_sharp_edges_alone():
    """A rectangle grows on each side; a ball of many facets does not; a sliver does not become long."""
    margin, grown = ENLARGED * SCALE_M, enlarged(sheet(2, 1.0, (0.0, 3.0), (0.0, 2.0)).triangles, SCALE_M)
    # At the diagonal corners slide along it, a little farther than the margin.
    for excess in (-grown.min(axis=(0, 1))[:2], grown.max(axis=(0, 1))[:2] - [3, 2]):
        assert ((excess > 0.99 * margin) & (excess < 2.5 * margin)).all()
    np.testing.assert_array_equal(grown[..., 2], 1)
    ball, cube = trimesh.creation.icosphere(4).triangles, trimesh.creation.box((1, 1, 1)).triangles
    np.testing.assert_allclose(enlarged(ball, SCALE_M), ball, atol=5 * OVERLAP * SCALE_M)
    assert (np.ptp(enlarged(cube, SCALE_M), axis=(0, 1)) > 1 + 1.99 * margin).all()
    sliver, point = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 1e-5, 0]]]), np.ones((1, 3, 3))
    assert np.abs(enlarged(sliver, SCALE_M) - sliver).max() < 10 * margin
    np.testing.assert_array_equal(enlarged(point, SCALE_M), point)
    assert enlarged(point[:0], SCALE_M).shape == (0, 3, 3)


def slab(*extent):
    return "itu_concrete", sheet(*extent)


BLOCK = ("itu_concrete", trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 2.6)]))
CABINET = ("itu_wood", trimesh.creation.box(bounds=[(1, 1, 0), (2, 2, 1)]))
PARTITION = slab(0, 4.0, (0.0, 4.0), (0.0, 2.6))
CORNER = {"wall": slab(0, 4.0, (0.0, 4.0), (0.0, 2.7)), "other": slab(1, 2.0, (4.0, 8.0), (0.0, 2.7))}
CORNER |= {"floor": slab(2, 0.0, (0.0, 8.0), (0.0, 4.0))}
CROSS = {"wall": slab(1, 3.0, (0.0, 8.0), (0.0, 2.7)), "other": slab(0, 4.0, (0.0, 6.0), (0.0, 2.7))}
JUNCTIONS = {
    "antenna on a partition": ({"room": BLOCK, "wall": PARTITION}, [1.7, 2.2, 1.3], [4.0, 1.0, 2.0], 7),
    "antenna on a cabinet, over its edge": ({"room": BLOCK, "cabinet": CABINET}, [3.0, 3.0, 0.5], [1.5, 1.5, 1.0], 7),
    "reflection where two walls meet": (CORNER, [4.5, 3.5, 1.0], [4.5, 0.5, 0.5], 3),
    "transmission where two walls cross": (CROSS, [7.5, 5.5, 1.35], [0.5, 0.5, 1.35], 1),
}
"""Parts, both antennas, and the number of paths at least, with one reflection at most."""


@pytest.mark.parametrize("name", JUNCTIONS)
def test_paths_at_junctions_are_those_of_the_other_direction(tmp_path, name):
    parts, a, b, least = JUNCTIONS[name]
    scene = room(tmp_path, parts)
    options = TraceOptions(depth=3, reflections=1, transmission=True)
    forward, back = (trace_paths(scene, [x], receiver(y), options).paths for x, y in ((a, b), (b, a)))
    assert len(forward) == len(back) >= least
    for unit in (forward.departure, forward.arrival):
        np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, atol=EXACT_M)
    passed, passed_back = (np.sort((paths.interactions == TRANSMISSION).sum(axis=1)) for paths in (forward, back))
    np.testing.assert_array_equal(passed, passed_back)
    if "cross" in name:
        assert passed.tolist() == [2]
    assert power_db(forward) == pytest.approx(power_db(back), abs=SLOPE_DB)


@pytest.mark.parametrize(
    ("size", "ends"),
    [((80, 40, 27), ([2.5, 12.5, 10], [60, 20, 13.5])), ((48, 24, 16.2), ([1.5, 7.5, 8.1], [36, 12, 3]))],
)
def test_halls_of_round_sizes_do_not_leak(tmp_path, size, ends):
    """Places at which displacements of a rational ratio cancel at the end of the wall between both halls."""
    wall = sheet(0, size[0] / 2, (0.0, float(size[1])), (0.0, float(size[2])))
    hall = trimesh.creation.box(bounds=[(0, 0, 0), size])
    scene = room(tmp_path, {"hall": ("itu_metal", hall), "wall": ("itu_metal", wall)})
    for a, b in (ends, ends[::-1]):
        assert not len(trace_paths(scene, [a], receiver(b), replace(OPAQUE, depth=3), gains=False, check=False).paths)


def test_scale_is_bounded_far_from_the_origin():
    """By the size of the scene, so that a room in a national grid keeps its doors."""
    corners = trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 3)]).triangles
    for away_m, expected in ((0.0, 7.0), (50.0, 57.0), (1e4, 100.0)):
        ends = np.array([0, len(corners)])
        assert find_planes(("box",), np.zeros(1, np.uint32), ends, corners + away_m).scale_m == pytest.approx(expected)


def test_reflections_in_edges_of_turned_rooms_count_once(tmp_path):
    """Corners of files in single precision are not quite square: by less than displacements."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(29), [1, 1, 3])
    matrix[:3, 3] = [20, -10, 3]
    box = trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 3)])
    scene = room(tmp_path, {"room": ("itu_metal", box.apply_transform(matrix))})
    for pair in (([1, 1, 0.75], [3, 1, 0.75]), ([1, 1, 0.75], [2, 2, 1.5]), ([2, 1, 1.5], [3, 2, 1.5])):
        source, target = trimesh.transform_points(np.array(pair, float), matrix)
        paths = trace_paths(scene, [source], receiver(target), replace(OPAQUE, depth=3), gains=False).paths
        assert len(paths) == 63, pair
