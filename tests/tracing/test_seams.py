"""Edges and seams: closed rooms never hear each other, and positions of a grid hear what their neighbours hear."""

from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from traced_rooms import HEIGHT, LENGTH, SHOEBOX, WIDTH, Parts, image_lengths, receiver, room
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.backend.device import to_vectors
from wrf_mi.core import Paths
from wrf_mi.tracing import TraceOptions, trace_paths
from wrf_mi.tracing.paths.solve import Prepared
from wrf_mi.tracing.search.chains import TRANSMISSION
from wrf_mi.tracing.search.images import displaced
from wrf_mi.tracing.search.surfaces import ENLARGED, OVERLAP, enlarged, find_planes, screens

LONG, WIDE, HIGH, WALL = 8.0, 4.0, 2.5, 4.0
"""Two rooms side by side, metres, and where the wall between them stands."""
EXACT_M = 1e-12
"""Lengths are float64 where the planes are."""
NEIGHBOUR_M = 2e-3
"""Far enough from an edge that rays are sure, near enough that powers hardly change."""
SLOPE_DB = 0.1
"""Change of a power over 2 mm: 0.01 dB at 1 m for the nearest path, with a margin of ten."""
SLOW = settings(max_examples=10, deadline=None)
"""A trace of some twenty positions takes a tenth of a second."""


def rooms(material: str, turned_rad: float = 0.0, pieces: int = 8) -> dict[str, tuple[str, trimesh.Trimesh]]:
    """Two closed rooms of sheets that only touch: the wall between them, in pieces, stands on the floor of both."""
    sheets = {
        "floor": sheet(2, 0.0, (0.0, LONG), (0.0, WIDE)),
        "ceiling": sheet(2, HIGH, (0.0, LONG), (0.0, WIDE)),
        "west": sheet(0, 0.0, (0.0, WIDE), (0.0, HIGH)),
        "east": sheet(0, LONG, (0.0, WIDE), (0.0, HIGH)),
        "south": sheet(1, 0.0, (0.0, LONG), (0.0, HIGH)),
        "north": sheet(1, WIDE, (0.0, LONG), (0.0, HIGH)),
    }
    ends = np.linspace(0.0, WIDE, pieces + 1)
    for k, sill in enumerate([1.25, 1.0] * (pieces // 2)):  # seams that meet the middle of other pieces' ends
        for part, (low, high) in {"lower": (0.0, sill), "upper": (sill, HIGH)}.items():
            sheets[f"wall{k}{part}"] = sheet(0, WALL, (ends[k], ends[k + 1]), (low, high))
    for mesh in sheets.values():
        mesh.apply_transform(turn(turned_rad))
    return {name: (material, mesh) for name, mesh in sheets.items()}


def turn(turned_rad: float) -> np.ndarray:
    """Rotation [4, 4] about z."""
    return trimesh.transformations.rotation_matrix(turned_rad, [0, 0, 1])


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Mapping[float, Any]:
    """Metal rooms along the axes, and turned by 3 : 4 and by 30 degrees."""
    angles = (0.0, float(np.arctan2(3, 4)), np.pi / 6)
    return {a: room(tmp_path_factory.mktemp("closed"), rooms("itu_metal", a)) for a in angles}


def heard(scene: Any, sources: Any, targets: Any, depth: int, turned_rad: float = 0.0) -> Paths:
    """Paths from transmitters [n, 3] to receivers [m, 3] of the rooms before they were turned."""
    matrix = turn(turned_rad)[:3, :3].T
    devices = [receiver(np.asarray(p) @ matrix, f"rx{k}") for k, p in enumerate(targets)]
    options = TraceOptions(depth=depth, rays=1 << 15)
    return trace_paths(scene, np.asarray(sources) @ matrix, devices, options, gains=False, check=False).paths


def test_places_on_a_grid_do_not_hear_the_other_room(closed: Mapping[float, Any]):
    x, y = np.meshgrid(np.arange(0.5, WALL, 0.5), np.arange(0.5, WIDE, 0.5))
    grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    for angle, scene in closed.items():
        assert not len(heard(scene, np.add(grid, [WALL, 0, 0]), [[1, 1, 2], [2.5, 3, 1.5]], 4, angle))


def test_places_mirrored_in_the_wall_do_not_hear_each_other(closed: Mapping[float, Any]):
    """The floor and the ceiling reflect at the foot and at the top of the wall."""
    places = np.array([*product((0.5, 1.5, 3.0), (0.5, 2.0, 2.65), (0.5, 1.25))])
    for angle, scene in closed.items():
        assert not len(heard(scene, places * [-1, 1, 1] + [2 * WALL, 0, 0], places, 3, angle))


@SLOW
@given(data=st.data())
def test_closed_rooms_never_hear_each_other(closed: Mapping[float, Any], data: st.DataObject):
    """At any places, of coarse and of fine grids."""
    step = data.draw(st.sampled_from([0.5, 0.25, 0.1, 1 / 3, 0.01, 1e-4]))
    angle = data.draw(st.sampled_from(sorted(closed)))

    def places(count: int) -> list[list[float]]:
        axes = [st.integers(1, int(size / step) - 1) for size in (WALL, WIDE, HIGH)]
        return [[step * data.draw(axis) for axis in axes] for _ in range(count)]

    sources, targets = np.array(places(8)), np.array(places(3))
    assert not len(heard(closed[angle], np.add(sources, [WALL, 0, 0]), targets, 4, angle))


def test_a_path_in_the_same_room_is_not_lost_for_the_wall(closed: Mapping[float, Any]):
    """Of a room's own paths none is missing: those of the mirror images."""
    for source, target in (([1.0, 2, 1], [3.0, 2, 1]), ([0.5, 1, 0.5], [3.5, 3, 2]), ([2.0, 2, 1.25], [2.0, 2, 1.75])):
        paths = heard(closed[0.0], [source], [target], 2)
        assert len(paths) == 25, (source, target)


def test_wave_is_blocked_by_a_seam_and_by_a_free_edge(tmp_path: Path):
    """Of two pieces of a wall, through their common edge, and of a board at its top, end and corner exactly."""
    wall = {"a": ("itu_metal", sheet(0, 2.0, (0.0, 2.0), (0.0, 2.5)))}
    both = wall | {"b": ("itu_metal", sheet(0, 2.0, (2.0, 4.0), (0.0, 2.5)))}
    direct = TraceOptions(reflection=False)

    def passes(scene: Any, source: list[float], target: list[float]) -> bool:
        ways = (source, target), (target, source)
        numbers = {len(trace_paths(scene, [a], receiver(b), direct, check=False).paths) for a, b in ways}
        assert len(numbers) == 1  # the same both ways
        return numbers == {1}

    scene = room(tmp_path / "both", both)
    assert not passes(scene, [0.5, 2.65, 1.25], [3.5, 1.35, 1.25])
    scene = room(tmp_path / "one", wall)
    for at, beyond in (([2, 1, 2.5], [0, 0, 2e-3]), ([2, 2, 1], [0, 2e-3, 0]), ([2, 2, 2.5], [0, 2e-3, 0])):
        for away in ([1.5, 0.0, 0.0], [1.5, 0.5, 0.25], [1.5, -0.3, 0.7]):
            assert not passes(scene, (np.array(at) - away).tolist(), (np.array(at) + away).tolist())
            source, target = np.array(at) - away + beyond, np.array(at) + away + beyond
            assert passes(scene, source.tolist(), target.tolist())


def test_no_path_over_a_floor_leads_under_the_wall_on_it(tmp_path: Path):
    parts: Parts = {
        "floor": ("itu_metal", sheet(2, 0.0, (0.0, 4.0), (0.0, 3.0))),
        "wall": ("itu_metal", sheet(0, 2.0, (0.0, 3.0), (0.0, 2.5))),
    }
    scene = room(tmp_path, parts)
    places = np.array([*product((0.5, 1.0, 1.5), (0.5, 1.0, 1.7), (0.5, 1.0))])
    targets = [receiver(p, f"rx{k}") for k, p in enumerate(places * [-1, 1, 1] + [4, 0, 0])]
    assert not len(trace_paths(scene, places, targets, TraceOptions(depth=2), check=False).paths)


@pytest.fixture(scope="module")
def shoebox(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("shoebox"))


PAIRS = (
    ([1.0, 2, 1], [4.0, 2, 1]),
    ([1.0, 2.5, 1.5], [5.0, 2.5, 1.5]),
    ([1.0, 1, 1], [2.0, 2, 1]),
    ([1.0, 1, 1], [2.0, 2, 2]),
    ([1.0, 1, 1], [2.0, 1, 2]),
    ([2.0, 2, 1], [4.0, 3, 1]),
    ([1.5, 1.25, 0.75], [2.4, 2.0, 1.2]),
)
"""Pairs with paths through edges of the shoebox, in which two reflections coincide."""


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_reflections_in_an_edge_count_once(shoebox: Any, source: list[float], target: list[float]):
    """With the gains of positions nearby, and in both directions the same paths."""
    options = TraceOptions(depth=3)
    paths = trace_paths(shoebox, [source], receiver(target), options).paths
    np.testing.assert_allclose(paths.length_m, image_lengths(np.array(source), np.array(target), 3), atol=EXACT_M)
    near = trace_paths(shoebox, [np.add(source, [7e-4, 1e-3, 4e-4])], receiver(target), options).paths
    power = [10 * np.log10(np.square(np.abs(some.gain)).sum()) for some in (paths, near)]
    assert power[0] == pytest.approx(power[1], abs=SLOPE_DB)
    back = trace_paths(shoebox, [target], receiver(source), options).paths
    order = np.lexsort((np.abs(back.gain), back.length_m.round(9)))
    mine = np.lexsort((np.abs(paths.gain), paths.length_m.round(9)))
    np.testing.assert_allclose(back.gain[order], paths.gain[mine], atol=2e-3 * np.abs(paths.gain).max())


def test_reflections_on_the_diagonal_of_a_rectangle_are_not_lost(shoebox: Any):
    """Floor and ceiling reflect at their diagonal, along which both triangles of a rectangle meet."""
    shares = np.linspace(0.05, 0.95, 24)[:, None]
    for start, end in (([0, 0], [LENGTH, WIDTH]), ([LENGTH, 0], [0, WIDTH])):
        at = np.array(start) + shares * (np.array(end) - start)
        source = np.hstack([at, np.full((24, 1), 1.0)])
        for target in (np.add(source, [0, 0, 1.0]), np.add(source[::-1], [0, 0, 0.5])):
            for row in range(0, 24, 5):
                paths = trace_paths(shoebox, source[[row]], receiver(target[row]), TraceOptions(depth=1)).paths
                assert len(paths) == 7 - (np.abs(source[row] - target[row]) < 1e-9).all()


def test_ceiling_lets_nothing_pass_at_its_diagonal(shoebox: Any):
    shares = np.linspace(0.05, 0.95, 24)[:, None]
    at = shares * [LENGTH, WIDTH]
    below, above = (np.hstack([at, np.full((24, 1), z)]) for z in (1.0, HEIGHT + 1.0))
    options = TraceOptions(reflection=False)
    for row in range(24):
        assert not len(trace_paths(shoebox, below[[row]], receiver(above[row]), options, check=False).paths)


def test_places_on_a_grid_hear_what_their_neighbours_hear(tmp_path: Path):
    """In rooms whose walls let waves pass: no cell of a map stands out."""
    scene = room(tmp_path, rooms("itu_concrete"))
    x, y = np.meshgrid(np.arange(0.5, LONG, 0.5), np.arange(0.5, WIDE, 1.0))
    grid = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)
    grid = grid[grid[:, 0] != WALL]
    options = TraceOptions(depth=3, transmission=True, rays=1 << 15)
    rng = np.random.default_rng(1)

    def power_db(places: np.ndarray, target: np.ndarray) -> np.ndarray:
        paths = trace_paths(scene, places, receiver(target), options).paths
        return 10 * np.log10(np.bincount(paths.tx, np.square(np.abs(paths.gain)), len(places)))

    for target in (np.array([1.0, 1, 2]), np.array([2.5, 3, 1.5])):
        on = power_db(grid, target)
        # At an edge neighbours on both sides differ: the grid is like some of them.
        moves = rng.uniform(-NEIGHBOUR_M, NEIGHBOUR_M, (8, *grid.shape))
        near = np.array([power_db(grid + move, target) for move in moves])
        assert (on > near.min(axis=0) - SLOPE_DB).all()
        assert (on < near.max(axis=0) + SLOPE_DB).all()


def test_paths_of_a_pair_are_the_same_alone_in_a_batch_and_in_any_order(tmp_path: Path):
    """However many transmitters and receivers there are, with few rays, which miss paths from each side."""
    parts: Parts = {**SHOEBOX, "board": ("itu_brick", sheet(1, 2.6, (0.4, 1.1), (0.6, 1.2)))}
    scene, rng = room(tmp_path, parts), np.random.default_rng(4)
    places = rng.uniform([0.3, 0.3, 0.3], [LENGTH - 0.3, WIDTH - 0.3, HEIGHT - 0.3], (7, 3))
    options = TraceOptions(depth=4, transmission=True, rays=500)
    tx, rx = places[:2], [receiver(p, f"rx{k}") for k, p in enumerate(places[2:])]
    batch = trace_paths(scene, tx, rx, options).paths
    turned = trace_paths(scene, tx[::-1], rx[::-1], options).paths
    few = trace_paths(scene, np.repeat(tx, 4, axis=0), rx[3], options, prepared=Prepared(scene)).paths
    for i, k in product(range(2), range(5)):
        alone = trace_paths(scene, tx[[i]], rx[k], options).paths
        for others, a, b in ((batch, i, k), (turned, 1 - i, 4 - k), (few, 4 * i + 1, 0)):
            if others is few and k != 3:
                continue
            some = others.select((others.tx == a) & (others.rx == b))
            np.testing.assert_array_equal(some.length_m, alone.length_m)
            np.testing.assert_allclose(some.gain, alone.gain, rtol=1e-5)  # other widths of vector instructions


def test_direct_path_is_traced_at_any_distance_but_none(shoebox: Any):
    options = TraceOptions(depth=1)
    for distance in (9e-3, 1e-3, 1e-5):
        paths = trace_paths(shoebox, [[2.0, 2, 1]], receiver([2.0 + distance, 2, 1]), options).paths
        assert len(paths) == 7
        assert paths.length_m.min() == pytest.approx(distance, rel=1e-9)
        assert np.isfinite(paths.gain).all()
    assert len(trace_paths(shoebox, [[2.0, 2, 1]], receiver([2.0, 2, 1]), options).paths) == 6


def test_displacement_is_that_of_the_pair_in_both_directions():
    a, b = np.random.default_rng(0).integers(-3, 4, (2, 50, 3)).astype(float)
    there, back = displaced(5.0, a, b), displaced(5.0, b, a)
    different = (a != b).any(axis=1)
    np.testing.assert_array_equal(there[0][different], back[1][different])
    np.testing.assert_array_equal(there[1][different], back[0][different])
    assert np.linalg.norm(there[0] - a, axis=1).max() < 5 * 1.5 * 1e-5


SCALE_M = 5.0
"""Scale of a room of four metres."""


def test_faces_are_enlarged_at_free_and_sharp_edges_alone():
    """A rectangle grows on each side; a ball of many facets does not; a sliver does not become long."""
    rectangle = sheet(2, 1.0, (0.0, 3.0), (0.0, 2.0)).triangles
    margin = ENLARGED * SCALE_M
    grown = enlarged(rectangle, SCALE_M)
    # At the diagonal corners slide along it, a little farther than the margin.
    for excess in (-grown.min(axis=(0, 1))[:2], grown.max(axis=(0, 1))[:2] - [3, 2]):
        assert (excess > 0.99 * margin).all()
        assert (excess < 2.5 * margin).all()
    np.testing.assert_array_equal(grown[..., 2], 1)
    ball = trimesh.creation.icosphere(4).triangles
    np.testing.assert_allclose(enlarged(ball, SCALE_M), ball, atol=5 * OVERLAP * SCALE_M)
    cube = trimesh.creation.box((1, 1, 1)).triangles
    assert (np.ptp(enlarged(cube, SCALE_M), axis=(0, 1)) > 1 + 1.99 * ENLARGED * SCALE_M).all()
    sliver = np.array([[[0.0, 0, 0], [1, 0, 0], [1, 1e-5, 0]]])
    assert np.abs(enlarged(sliver, SCALE_M) - sliver).max() < 10 * ENLARGED * SCALE_M
    point = np.ones((1, 3, 3))
    np.testing.assert_array_equal(enlarged(point, SCALE_M), point)
    assert enlarged(point[:0], SCALE_M).shape == (0, 3, 3)


def test_no_ray_passes_at_an_edge_within_a_surface():
    """Aimed at the diagonals of rectangles, along the axes and askew, whose corners are moved and rounded."""
    import mitsuba as mi

    rng, count = np.random.default_rng(0), 5000
    for along_axes in (True, False) * 3:
        frame = np.eye(3) if along_axes else np.linalg.qr(rng.normal(size=(3, 3)))[0]
        u, v, normal = frame[1], frame[2], frame[0]
        a, b = np.round(rng.uniform(0.5, 5, 2), 1)
        corner = np.round(rng.uniform(-3, 3, 3), 1)
        outline = corner + np.array([0 * u, a * u, a * u + b * v, b * v])
        scene = screens(outline[[[0, 1, 2], [0, 2, 3]]], 2 * SCALE_M)
        at = outline[0] + rng.uniform(0, 1, (count, 1)) * (outline[2] - outline[0])
        away = rng.normal(size=(count, 3))
        away = away[np.abs(away @ normal) > 0.2]
        ray = mi.Ray3f(to_vectors(at[: len(away)] - 3 * away, mi.Point3f), to_vectors(away, mi.Vector3f))
        assert scene.ray_intersect_preliminary(ray, coherent=False).is_valid().numpy().all()


BLOCK = ("itu_concrete", trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 2.6)]))
JUNCTIONS: Mapping[str, tuple[Parts, list[float], list[float], int]] = {
    "antenna on a partition": (
        {"room": BLOCK, "wall": ("itu_concrete", sheet(0, 4.0, (0.0, 4.0), (0.0, 2.6)))},
        [1.7, 2.2, 1.3],
        [4.0, 1.0, 2.0],
        7,
    ),
    "antenna on a cabinet, over its edge": (
        {"room": BLOCK, "cabinet": ("itu_wood", trimesh.creation.box(bounds=[(1, 1, 0), (2, 2, 1)]))},
        [3.0, 3.0, 0.5],
        [1.5, 1.5, 1.0],
        7,
    ),
    "reflection where two walls meet": (
        {
            "wall": ("itu_concrete", sheet(0, 4.0, (0.0, 4.0), (0.0, 2.7))),
            "other": ("itu_concrete", sheet(1, 2.0, (4.0, 8.0), (0.0, 2.7))),
            "floor": ("itu_concrete", sheet(2, 0.0, (0.0, 8.0), (0.0, 4.0))),
        },
        [4.5, 3.5, 1.0],
        [4.5, 0.5, 0.5],
        3,
    ),
    "transmission where two walls cross": (
        {
            "wall": ("itu_concrete", sheet(1, 3.0, (0.0, 8.0), (0.0, 2.7))),
            "other": ("itu_concrete", sheet(0, 4.0, (0.0, 6.0), (0.0, 2.7))),
        },
        [7.5, 5.5, 1.35],
        [0.5, 0.5, 1.35],
        1,
    ),
}
"""Parts, both antennas, and the number of paths at least, with one reflection at most."""


@pytest.mark.parametrize("name", JUNCTIONS)
def test_paths_at_junctions_are_those_of_the_other_direction(tmp_path: Path, name: str):
    parts, a, b, least = JUNCTIONS[name]
    scene = room(tmp_path, parts)
    options = TraceOptions(depth=3, reflections=1, transmission=True)
    there, back = (trace_paths(scene, [x], receiver(y), options).paths for x, y in ((a, b), (b, a)))
    assert len(there) == len(back) >= least
    for unit in (there.departure, there.arrival):
        np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1, atol=EXACT_M)
    passed = [np.sort((paths.interactions == TRANSMISSION).sum(axis=1)) for paths in (there, back)]
    np.testing.assert_array_equal(*passed)
    if "cross" in name:
        assert passed[0].tolist() == [2]
    power = [10 * np.log10(np.square(np.abs(paths.gain)).sum()) for paths in (there, back)]
    assert power[0] == pytest.approx(power[1], abs=SLOPE_DB)


def test_halls_of_round_sizes_do_not_leak(tmp_path: Path):
    """Places at which displacements of a rational ratio cancel at the end of the wall between both halls."""
    for number, (size, source, target) in enumerate(
        (((80, 40, 27), [2.5, 12.5, 10], [60, 20, 13.5]), ((48, 24, 16.2), [1.5, 7.5, 8.1], [36, 12, 3]))
    ):
        wall = sheet(0, size[0] / 2, (0.0, float(size[1])), (0.0, float(size[2])))
        hall = trimesh.creation.box(bounds=[(0, 0, 0), size])
        scene = room(tmp_path / str(number), {"hall": ("itu_metal", hall), "wall": ("itu_metal", wall)})
        for a, b in ((source, target), (target, source)):
            paths = trace_paths(scene, [a], receiver(b), TraceOptions(depth=3), gains=False, check=False).paths
            assert not len(paths)


def test_scale_is_bounded_far_from_the_origin():
    """By the size of the scene, so that a room in a national grid keeps its doors."""
    corners = trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 3)]).triangles
    for away_m, expected in ((0.0, 7.0), (50.0, 57.0), (1e4, 100.0)):
        moved = corners + away_m
        surfaces = find_planes(("box",), np.zeros(1, np.uint32), np.array([0, len(moved)]), moved)
        assert surfaces.scale_m == pytest.approx(expected)


def test_reflections_in_edges_of_turned_rooms_count_once(tmp_path: Path):
    """Corners of files in single precision are not quite square: by less than displacements."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(29), [1, 1, 3])
    matrix[:3, 3] = [20, -10, 3]
    box = trimesh.creation.box(bounds=[(0, 0, 0), (6, 4, 3)])
    scene = room(tmp_path, {"room": ("itu_metal", box.apply_transform(matrix))})
    for source, target in (([1, 1, 0.75], [3, 1, 0.75]), ([1, 1, 0.75], [2, 2, 1.5]), ([2, 1, 1.5], [3, 2, 1.5])):
        ends = trimesh.transform_points(np.array([source, target], float), matrix)
        options = TraceOptions(depth=3)
        assert len(trace_paths(scene, ends[:1], receiver(ends[1]), options, gains=False).paths) == 63
