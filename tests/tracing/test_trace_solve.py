"""Traced paths against closed forms and Sionna RT, reciprocity, and independence from chunks and seeds."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from scipy.constants import epsilon_0, speed_of_light
from scipy.optimize import linear_sum_assignment
from traced_rooms import (
    FREQUENCY_HZ,
    HEIGHT,
    LENGTH,
    THICKNESS_M,
    WAVELENGTH_M,
    WIDTH,
    image_lengths,
    inside,
    receiver,
    room,
    write_xml,
)
from wrf_mi_bench.sionna_reference import sionna_paths
from wrf_mi_bench.wave_formulas import slab
from wrf_mi_scenes.build_laboratory import sheet
from wrf_mi_scenes.mitsuba_xml import PERFECT

from wrf_mi.core import InputError
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.paths import solve as solve_module
from wrf_mi.tracing.search import chains as search_module
from wrf_mi.tracing.search import images as images_module
from wrf_mi.tracing.sionna.materials import perfect_reflector
from wrf_mi.tracing.sionna.path_solver import corrected

SINGLE = 2e-4  # Relative; Sionna RT's gains are single precision
EXACT_M = 1e-12  # Lengths are float64 where the planes are: those of the shoebox are whole numbers
OFF_SURFACE = 2e-3  # Of the largest gain; Sionna RT's points are some 1e-4 m off the surfaces
EDGE_OF_TWO = 0.05  # Of the largest gain; the face of an edge that diffracts depends on the first ray
UPRIGHT = TraceOptions(transmission=False)


def equal(a, b):
    np.testing.assert_equal(vars(a), vars(b))


def test_free_space_gain_is_that_of_friis(empty):
    tx = np.array([[3.0, 4.0, 0.0], [0.0, 30.0, 0.0]])
    paths = trace_paths(empty, tx, receiver([0, 0, 0]), UPRIGHT).paths
    np.testing.assert_allclose(paths.length_m, [5, 30], atol=EXACT_M)
    np.testing.assert_allclose(np.abs(paths.gain), WAVELENGTH_M / (4 * np.pi * paths.length_m), rtol=SINGLE)
    np.testing.assert_allclose(paths.departure, -paths.arrival, atol=EXACT_M)
    np.testing.assert_allclose(paths.arrival[0], [0.6, 0.8, 0], atol=EXACT_M)
    assert paths.interactions.shape == (2, 3)
    assert (paths.objects == -1).all()
    assert np.isnan(paths.vertices_m).all()


def traced(scene, tx, rx, **options):
    return trace_paths(scene, tx, rx, replace(UPRIGHT, **options)).paths


def receivers(count, seed):
    return [receiver(p, f"rx{k}") for k, p in enumerate(inside(count, seed))]


def test_lengths_in_a_shoebox_are_those_of_the_mirror_images(shoebox):
    tx, rx = inside(4, 11), receivers(2, 12)
    paths = traced(shoebox, tx, rx)
    for i, k in product(range(4), range(2)):
        length = paths.length_m[(paths.tx == i) & (paths.rx == k)]
        np.testing.assert_allclose(length, image_lengths(tx[i], rx[k].position_m, 3), atol=EXACT_M)
    np.testing.assert_array_equal(np.lexsort((paths.length_m, paths.tx, paths.rx)), np.arange(len(paths)))


@pytest.mark.parametrize(("hz", "size_m"), [(28e9, (100.0, 60.0, 12.0)), (915e6, (10_000.0, 4_000.0, 300.0))])
def test_phases_in_large_halls_are_those_of_the_mirror_images(hz, size_m, tmp_path):
    """Within a thousandth of a radian, of which lengths in float32 would leave some hundredths."""
    parts = {}
    for axis, side in product(range(3), (0, 1)):
        spans = [(0.0, size_m[other]) for other in range(3) if other != axis]
        parts[f"wall{axis}{side}"] = "itu_metal", sheet(axis, side * size_m[axis], *spans)
    scene = open_scene(write_xml(tmp_path, parts), hz)
    tx, rx = np.split(np.random.default_rng(0).uniform(0.1, 0.9, (6, 3)) * size_m, [5])
    paths, wavenumber = traced(scene, tx, receiver(rx[0]), depth=2, rays=1 << 14), 2 * np.pi * hz / speed_of_light
    for row, position_m in enumerate(tx):
        exact, lengths_m = image_lengths(position_m, rx[0], 2, size_m), np.sort(paths.length_m[paths.tx == row])
        np.testing.assert_allclose(wavenumber * (lengths_m - exact), 0, atol=1e-3)
        assert wavenumber * np.abs(exact.astype(np.float32) - exact).max() > 1e-3


def test_points_of_reflection_lie_on_their_walls(shoebox):
    paths = traced(shoebox, inside(3), receiver([1.0, 1.0, 1.5]))
    walls = {"floor": (2, 0), "ceiling": (2, HEIGHT), "west": (0, 0), "east": (0, LENGTH)}
    walls |= {"south": (1, 0), "north": (1, WIDTH)}
    for index, name in enumerate(paths.object_names):
        axis, at = walls[name]
        points_m = paths.vertices_m[paths.objects == index]
        assert len(points_m)
        np.testing.assert_allclose(points_m[:, axis], at, atol=EXACT_M)
    assert (np.isnan(paths.vertices_m[..., 0]) == (paths.interactions == 0)).all()


def test_gains_over_a_perfect_ground_are_those_of_two_rays(tmp_path):
    """A vertical field keeps its sign in the image below a perfect conductor."""
    from sionna import rt

    scene = room(tmp_path, {"ground": ("itu_metal", sheet(2, 0.0, (-300.0, 300.0), (-300.0, 300.0)))})
    ground = scene.objects["ground"]
    ground.radio_material = perfect_reflector()
    assert (type(ground.radio_material), ground.radio_material.name) == (rt.RadioMaterial, PERFECT)
    paths, lengths = traced(scene, [[200.0, 0, 1.5]], receiver([0, 0, 2.0])), np.hypot(200, [0.5, 3.5])
    np.testing.assert_allclose(paths.length_m, lengths, atol=EXACT_M)
    np.testing.assert_allclose(paths.gain, WAVELENGTH_M / (4 * np.pi * lengths), rtol=10 * SINGLE)


def test_gains_at_a_slab_at_normal_incidence(tmp_path):
    """A vertical field is parallel to the wall: the phase is that of the coefficient."""
    scene = room(tmp_path, {"wall": ("itu_brick", sheet(0, 0.0, (-50.0, 50.0), (-50.0, 50.0)))})
    brick = scene.radio_materials["itu_brick"]
    constants = float(brick.relative_permittivity[0]), float(brick.conductivity[0])
    options = {"transmission": True, "depth": 1}
    beside, behind = (traced(scene, [[x, 0.0, 0.0]], receiver([2.0, 0, 0]), **options) for x in (4.0, -4.0))
    assert beside.interactions.tolist() == [[0], [1]]
    assert behind.interactions.tolist() == [[4]]
    eta = constants[0] - 1j * constants[1] / (2 * np.pi * FREQUENCY_HZ * epsilon_0)
    across, _ = slab(np.ones(1), eta, THICKNESS_M["itu_brick"], FREQUENCY_HZ)
    for gain, (factor,) in zip((beside.gain[1], behind.gain[0]), across, strict=True):
        assert abs(gain) == pytest.approx(WAVELENGTH_M / (4 * np.pi * 6) * abs(factor), rel=SINGLE)
        assert np.angle(gain / factor) == pytest.approx(0, abs=SINGLE)


def test_paths_pass_walls_with_transmission_only(divided):
    tx, rx = [[1.0, 1.0, 1.0]], receiver([5.0, 1.0, 1.0])
    assert (traced(divided, tx, rx, depth=1).interactions == 1).all()  # over the partition and round it
    opened = traced(divided, tx, rx, transmission=True, depth=2)
    straight = opened.length_m == opened.length_m.min()
    assert opened.interactions[straight].tolist() == [[4, 0]]
    np.testing.assert_allclose(opened.vertices_m[straight][0, 0], [3, 1, 1], atol=EXACT_M)
    through = opened.select((opened.interactions == 4).any(axis=1))
    assert {tuple(types) for types in through.interactions} == {(4, 0), (1, 4), (4, 1)}
    few = traced(divided, tx, rx, transmission=True, depth=3, reflections=1)
    assert (few.interactions == 1).sum(axis=1).max() == 1
    for passes in (False, True):  # it is an interaction
        assert not len(traced(divided, [[1.3, 2.0, 1.0]], receiver([4.4, 3.1, 1.7]), transmission=passes, depth=0))


@pytest.mark.parametrize("transmission", [False, True])
def test_paths_are_reciprocal(divided, transmission):
    a, b, options = receivers(5, 3), receivers(3, 4), replace(UPRIGHT, transmission=transmission)
    ways = (a, b), (b, a)
    forth, back = (trace_paths(divided, [r.position_m for r in tx], rx, options) for tx, rx in ways)
    assert forth.from_receivers == back.from_receivers
    a, b = forth.paths, back.paths
    order = np.lexsort((b.length_m, b.rx, b.tx))
    np.testing.assert_allclose(b.length_m[order], a.length_m, atol=1e-9)
    np.testing.assert_allclose(b.gain[order], a.gain, atol=10 * SINGLE * np.abs(a.gain).max())
    np.testing.assert_allclose(b.arrival[order], a.departure, atol=1e-6)
    np.testing.assert_array_equal(np.count_nonzero(b.interactions[order], axis=1), a.bounces)


def test_paths_of_a_seed_do_not_depend_on_chunks(divided, monkeypatch):
    ends, options = (inside(6, 5), receivers(2, 6)), {"transmission": True, "depth": 2, "rays": 1 << 12}
    all_paths = traced(divided, *ends, **options)
    equal(traced(divided, *ends, **options), all_paths)
    monkeypatch.setattr(solve_module, "PAIRS_TOGETHER", 4)
    monkeypatch.setattr(images_module, "CANDIDATES_PER_CHUNK", 37)
    monkeypatch.setattr(search_module, "PAIRS_PER_CHUNK", 100)
    monkeypatch.setattr(search_module, "RAYS_PER_CHUNK", 1000)
    monkeypatch.setattr("wrf_mi.tracing.sionna.path_solver.PATHS_PER_CHUNK", 50)
    parts = traced(divided, *ends, **options)
    np.testing.assert_allclose(parts.gain, all_paths.gain, rtol=1e-5)  # other widths of vector instructions
    equal(replace(parts, gain=all_paths.gain), all_paths)


def test_kinds_that_are_off_are_not_searched(shoebox, empty, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("searched")

    monkeypatch.setattr(search_module, "_shoot", refuse)
    monkeypatch.setattr(solve_module, "sampled_paths", refuse)
    tx, rx = inside(2), receiver([1.0, 1.0, 1.0])
    assert len(traced(shoebox, tx, rx, reflection=False)) == 2
    assert len(traced(shoebox, tx, rx, depth=0)) == 2
    assert len(traced(empty, tx, rx, scattering=True, rays="auto")) == 2
    with pytest.raises(AssertionError, match="searched"):
        traced(shoebox, tx, receiver([1.2, 0.9, 1.1]))  # whose chains are not kept
    assert not len(traced(shoebox, tx, rx, line_of_sight=False, reflection=False))


def test_rays_are_shot_once_for_a_geometry(shoebox, divided, monkeypatch):
    """Another trace of equal surfaces shoots none; another receiver, seed or geometry does; memory is bounded."""
    shots, shoot = [], search_module._shoot

    def counted(*arguments):
        shots.append(arguments)
        return shoot(*arguments)

    monkeypatch.setattr(search_module, "_shoot", counted)
    tx, rx = inside(3), receiver([1.3, 0.8, 1.2])

    def shot(scene, at=rx, seed=11):
        before = len(shots)
        trace_paths(scene, tx, at, replace(UPRIGHT, seed=seed))
        return len(shots) - before

    assert shot(shoebox) > 0
    assert shot(shoebox) == 0
    assert shot(divided) > 0
    assert shot(shoebox, receiver([1.3, 0.8, 1.25])) > 0
    assert shot(shoebox, seed=12) > 0
    monkeypatch.setattr(search_module, "MOST_KEPT", 1)
    assert shot(shoebox, seed=13) > 0
    assert len(search_module._kept) == 1
    assert shot(shoebox) > 0


@pytest.mark.parametrize(("planes", "reflections"), [(5, 3), (200_000, 8)])  # beyond 64 bits: ranks
def test_distinct_chains_are_those_of_numpy(planes, reflections):
    rng = np.random.default_rng(0)
    rows = rng.integers(-1, planes, (300, reflections))[rng.integers(0, 300, 1000)]
    np.testing.assert_array_equal(search_module._unique_rows(rows), np.unique(rows, axis=0))
    assert search_module._unique_rows(rows[:0]).shape == (0, reflections)


def test_number_of_rays_converges(shoebox):
    ends = inside(5), receiver([1.0, 1.0, 1.0])
    trace_result = trace_paths(shoebox, *ends, replace(UPRIGHT, rays="auto", depth=2))
    assert trace_result.rays == solve_module.FIRST_RAYS  # a shoebox is easy
    assert trace_result.options.rays == "auto"
    equal(trace_result.paths, traced(shoebox, *ends, rays=trace_result.rays, depth=2))


def all_found(paths, length, gain, tolerance):
    near = np.abs(paths.length_m[None] - length[:, None])
    apart = np.where(near < 1e-4, np.abs(paths.gain[None] - gain[:, None]), np.inf)  # its lengths are float32
    ours, theirs = linear_sum_assignment(np.minimum(apart, 1.0))[::-1]
    assert len(ours) == len(length)
    assert apart[theirs, ours].max() < tolerance * np.abs(gain).max()


@pytest.mark.parametrize("transmission", [False, True])
def test_every_path_of_sionna_rt_is_found(divided, transmission):
    tx, rx = np.array([1.1, 2.3, 1.2]), np.array([4.6, 1.7, 1.9])
    _, gain, length, _ = sionna_paths(divided, tx, rx, replace(UPRIGHT, transmission=transmission, rays=30_000))
    all_found(traced(divided, tx[None], receiver(rx), transmission=transmission), length, gain, OFF_SURFACE)


def test_diffracted_paths_are_those_of_sionna_rt(divided):
    """With the corrected fields."""
    tx, rx = np.array([1.1, 1.3, 1.2]), np.array([4.6, 1.7, 1.9])
    options = replace(UPRIGHT, diffraction=True, rays=30_000)
    with corrected():
        _, gain, length, _ = sionna_paths(divided, tx, rx, options)
    trace_result = trace_paths(divided, np.array([tx, [2.0, 2.0, 1.0]]), receiver(rx), options)
    paths = trace_result.paths.select(trace_result.paths.tx == 0)
    assert (paths.interactions == 8).any(axis=1).sum() > 10
    assert not trace_result.from_receivers
    all_found(paths, length, gain, EDGE_OF_TWO)
    np.testing.assert_allclose(recompute(trace_result, divided).paths.gain, trace_result.paths.gain, rtol=1e-6)
    # The bent wave reaches where nothing else does.
    dark = trace_paths(divided, [[2.9, 1.0, 0.5]], receiver([3.1, 1.0, 0.5]), replace(options, depth=1)).paths
    assert (dark.interactions == 8).any()


def test_wrong_arguments_are_refused(empty):
    for wrong in ([[1.0, 2]], [[1.0, 2, np.nan]]):
        with pytest.raises(ValueError, match="finite"):
            trace_paths(empty, wrong, receiver([0, 0, 0]))
    for tx, rx in (([[0.0, 0, 1]], []), (np.zeros((0, 3)), [receiver([0, 0, 0])])):
        with pytest.raises(InputError, match="give one at least"):
            trace_paths(empty, tx, rx)
    wrong_values: dict[str, tuple[Any, ...]] = {
        "depth": (-1, 99),
        "reflections": (-1,),
        "rays": (0, "many"),
        "seed": (-1,),
    }
    for name, values in (wrong_values | {"scattering_coefficient": (-0.1, 1.1)}).items():
        for value in values:
            with pytest.raises(InputError, match=name):
                TraceOptions(**{name: value})
