"""Gains of paths are numbers, wherever antennas are and whatever surfaces are made of, also in generated buildings."""

import logging
import re
import tempfile
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from double_precision import Tensor64
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from traced_rooms import FREQUENCY_HZ, HEIGHT, LENGTH, PARTITION, SHOEBOX, THICKNESS_M, WIDTH, receiver, write_xml

from wrf_mi.backend.vectors import Float64
from wrf_mi.core import InputError
from wrf_mi.core.antenna import ANTENNA
from wrf_mi.scene.materials import SINGLE_MAX
from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.storey import plan_surfaces
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.paths import result as result_module
from wrf_mi.tracing.paths import traced_field as traced_field_module
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.search.chains import TRANSMISSION, PathInteractions
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.tracing.sionna.materials import CONSTANTS, itu_constants
from wrf_mi.tracing.sionna.path_solver import SHORT, Devices, apart
from wrf_mi.tracing.slabs import slab

ROUNDING = {mi.Float: 1e-5, Float64: 1e-12}  # of a power: some ten operations on numbers of about 1
SINGLE = 2e-4  # of coefficients in single precision: the phase across up to three wavelengths

DIRECTION_RAD = 2e-3  # of legs as short as `SHORT`, whose ends are single precision
SLIVER = 3  # number of the triangle of the building's floor that has no area

X = (0, 3, LENGTH, 2.4, 1e-9, 3 + 1e-7, -30, 1e4)  # corners, the partition, inside, beside a wall, far outside
Y = (0, 4, WIDTH, 1.1, 1e-8, -2, 1e4)
Z = (0, 2.5, HEIGHT, 1.3, 1e-7, 1e4)  # the floor, the partition's upper edge, the ceiling
# Inside, on the partition, in a corner, on the block, and where numbers of single precision are 1 mm apart.
ENDS = ((4, 2, 1.5), (3, 2, 1.5), (0, 0, 0), (1.5, 3.5, 1), (1e4, 1e4, 1e4))
KINDS = {
    "specular": TraceOptions(depth=3, rays=1 << 12),
    "diffraction": TraceOptions(depth=2, diffraction=True, rays=1 << 9),
    "scattering": TraceOptions(depth=2, scattering=True, rays=1 << 8),
}
SLABS = {  # relative permittivity, conductivity, thickness
    "as air": (1.0, 0.0, 0.1),
    "almost as air": (1 + 1e-6, 1e-12, 0.1),
    "film": (2.7, 0.01, 1e-9),
    "conducting film": (1.0, 1e7, 1e-9),
    "no thickness": (2.7, 0.01, 0.0),
    "thick": (5.0, 0.1, 1e4),
    "thick without loss": (5.0, 0.0, 1e8),
    "largest": (SINGLE_MAX, SINGLE_MAX, SINGLE_MAX),
}


def coefficients(constants, kind):
    """Reflection of TE and TM, then transmission [4, p], of slabs' constants by column: cosine, ..., carrier."""
    c = slab(*map(kind, constants))
    parts = c.reflected_te, c.reflected_tm, c.transmitted_te, c.transmitted_tm
    return np.stack([part.real.numpy() + 1j * part.imag.numpy().astype(complex) for part in parts])


positive = st.floats(-12, 38).map(lambda exponent: float(10.0**exponent))
CONSTANTS_OF_ANY = st.tuples(
    st.floats(0, 1) | st.floats(-12, 0).map(lambda exponent: 10.0**exponent),
    st.just(1.0) | positive.map(lambda more: 1 + more),
    st.just(0.0) | positive,
    st.just(0.0) | positive,
    st.floats(8, 12).map(lambda exponent: 10.0**exponent),
)


@pytest.mark.parametrize("kind", [mi.Float, Float64])
@given(constants=CONSTANTS_OF_ANY)
@settings(deadline=None, max_examples=200)
def test_slab_sends_on_no_more_power_than_it_receives(kind, constants):
    reflected, transmitted = np.split(np.abs(coefficients([[value] for value in constants], kind)) ** 2, 2)
    assert (reflected + transmitted <= 1 + ROUNDING[kind]).all()  # NaN is not, either


def test_thin_slab_of_single_precision_is_that_of_double_at_grazing_incidence():
    """The equations of ITU-R P.2040 as they stand give magnitudes above 1 there, and 0 / 0."""
    rng = np.random.default_rng(0)
    exponents = rng.uniform([-7, -6, -12, -9, 8], [0, 1, 7, -3, 10], (4000, 5)).T
    constants = (10**exponents + np.array([0, 1, 0, 0, 0])[:, None]).astype(np.float32)
    single, double = (coefficients(constants, kind) for kind in (mi.Float, Float64))
    np.testing.assert_allclose(single, double, atol=SINGLE, rtol=0)


def test_wave_passes_a_slab_of_air_at_any_angle():
    """Along the slab, too, where its Fresnel coefficients are 0 / 0."""
    cosine = np.array([0.0, 1e-12, 1e-4, 0.5, 1.0])
    for kind in (mi.Float, Float64):
        c = coefficients([cosine, *(np.full(5, value) for value in (1.0, 0.0, 0.2, FREQUENCY_HZ))], kind)
        np.testing.assert_allclose(np.abs(c), [[0] * 5] * 2 + [[1] * 5] * 2, atol=ROUNDING[mi.Float])


@pytest.fixture(scope="module")
def building(tmp_path_factory):
    """The shoebox with a partition and a solid block; its floor has a triangle whose corners are in a line."""
    block = trimesh.creation.box((1, 1, 1))
    block.apply_translation((1.5, 3.5, 0.5))
    corners = [[0.0, 0, 0], [LENGTH, 0, 0], [LENGTH, WIDTH, 0], [0, WIDTH, 0], [LENGTH / 2, WIDTH / 2, 0]]
    # As a triangulation of an outline with a corner in line: the sliver lies on the diagonal of the floor.
    floor = trimesh.Trimesh(corners, [[0, 1, 2], [0, 4, 3], [4, 2, 3], [0, 2, 4]], process=False)
    parts = {**SHOEBOX, **PARTITION, "block": ("itu_concrete", block), "floor": ("itu_concrete", floor)}
    return open_scene(write_xml(tmp_path_factory.mktemp("building"), parts), FREQUENCY_HZ, THICKNESS_M)


@contextmanager
def made_of(scene, constants):
    """All surfaces of one slab while the block lasts."""
    original_constants = [(m, {name: getattr(m, name) for name in CONSTANTS}) for m in scene.radio_materials.values()]
    for material, _ in original_constants:
        for name, value in zip(CONSTANTS, constants, strict=True):
            setattr(material, name, dr.opaque(mi.Float, value))
    try:
        yield
    finally:
        for material, values in original_constants:
            for name, value in values.items():
                setattr(material, name, value)


def traced_everywhere(scene, options):
    """Paths to positions in, on and around the building, among them the transmitters' own and the nearest ones."""
    near = [np.asarray(ENDS, float) + step for step in ([0, 0, 0], [1e-9, 0, 0], [0, 1e-7, 1e-5])]
    places = np.concatenate([*near, np.array(list(product(X, Y, Z)))])
    receivers = [receiver(place, f"rx{number}") for number, place in enumerate(places)]
    return trace_paths(scene, np.array(ENDS), receivers, options, check=False, search_from="transmitters")


def assert_numbers(traced):
    assert traced.lost == 0
    assert len(traced.paths) > 100
    assert np.isfinite(traced.paths.gain).all()
    assert np.isfinite(traced.paths.length_m).all()
    assert np.isfinite([traced.paths.departure, traced.paths.arrival]).all()


@pytest.mark.parametrize("constants", SLABS.values(), ids=SLABS)
@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
def test_gains_in_any_slab_are_numbers_at_any_position(building, options, constants):
    with made_of(building, constants):
        assert_numbers(traced_everywhere(building, options))


def test_derivatives_are_numbers_for_a_transmitter_at_the_receiver(building):
    """It has fewer paths than others, and its place holders have no direction."""
    traced = TracedField(building, ENDS[:4], receiver(ENDS[0]), TracedOptions(KINDS["specular"]))
    parameters = {name: Tensor64(np.asarray(value, float)) for name, value in traced.parameters().items()}
    dr.enable_grad(*parameters.values())
    paths = traced(parameters)
    dr.backward(sum(dr.sum(dr.square(part)) for part in (*paths.gain, paths.length_m)))
    for values in (*paths.gain, paths.length_m, *paths.arrival, *map(dr.grad, parameters.values())):
        assert np.isfinite(values.numpy()).all()


def test_path_that_meets_a_sliver_has_the_gain_of_its_plane(building):
    """Sionna RT takes the normal from the corners of the triangle, which has none."""
    options = TraceOptions(depth=1, transmission=False, rays=1 << 12)
    traced = trace_paths(building, [[1.0, 1.0, 1.0]], receiver([2.5, 2.5, 1.5]), options)
    on_floor = traced.paths.objects == traced.paths.object_names.index("floor")
    assert on_floor.any()
    met = replace(traced, primitives=np.where(on_floor, SLIVER, traced.primitives))
    again = recompute(met, building)
    np.testing.assert_array_equal(again.paths.gain, traced.paths.gain)
    assert again.lost == 0


@given(gaps_m=st.lists(st.floats(0, 4e-3), min_size=1, max_size=3), seed=st.integers(0, 2**16))
@settings(deadline=None, max_examples=200)
def test_short_legs_become_longer_and_keep_all_directions(building, gaps_m, seed):
    """PathInteractions of a straight path through sheets, in single precision."""
    surfaces, rng = scene_surfaces(building), np.random.default_rng(seed)
    source, target = rng.uniform(0.2, [[2, 2, 2], [6, 5, 3]])
    direction = (target - source) / np.linalg.norm(target - source)
    vertices = source + np.cumsum([rng.uniform(0, 4e-3), *gaps_m])[:, None] * direction
    types = np.full((1, len(vertices)), TRANSMISSION, np.uint8)
    met: Any = types, np.zeros(types.shape, np.int64), vertices[None], np.ones(types.shape, np.float32), {}
    begin, end = (Devices(place[None], (ANTENNA.mounted(),)) for place in (source, target))
    moved = apart(PathInteractions(np.zeros(1, int), np.zeros(1, int), *met), surfaces, (begin, end))
    legs = np.diff(np.concatenate([source[None], moved.vertices_m[0], target[None]]).astype(np.float32), axis=0)
    length = np.linalg.norm(legs, axis=1)
    assert length.min() > 0.99 * SHORT * surfaces.scale_m
    assert np.linalg.norm(legs / length[:, None] - direction, axis=1).max() < DIRECTION_RAD


def losing(monkeypatch, lost):
    """Let the field calculator find no number for paths of some numbers."""
    gains = result_module.path_gains

    def broken(*arguments):
        gain = gains(*arguments)
        gain[lost] = np.nan
        return gain

    monkeypatch.setattr(result_module, "path_gains", broken)


def test_paths_without_a_gain_are_left_out_and_counted(building, monkeypatch, caplog):
    places, rx = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]], receiver(ENDS[0])
    options = KINDS["specular"]
    complete_trace = trace_paths(building, places, rx, options)
    losing(monkeypatch, [0, 3])
    with caplog.at_level(logging.WARNING):
        traced = trace_paths(building, places, rx, options)
        again = recompute(complete_trace, building)
    count = len(complete_trace.paths)
    for part in (traced, again):
        assert (part.lost, len(part.paths)) == (2, count - 2)
        assert np.isfinite(part.paths.gain).all()
    assert caplog.text.count(f"2 of {count} paths are left out: their gains are not numbers") == 2


def test_trace_without_any_gain_is_refused(building, monkeypatch):
    losing(monkeypatch, slice(None))
    with pytest.raises(InputError, match="gains that are not numbers"):
        trace_paths(building, [[1.0, 1.0, 1.0]], receiver(ENDS[0]), KINDS["specular"])


@pytest.mark.parametrize("faint", [0.0, 1e-3])
def test_differentiable_paths_without_a_gain_are_left_out_and_counted(building, faint, monkeypatch, caplog):
    options = TracedOptions(KINDS["specular"], faint=faint)
    of_near = building, [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0]], receiver(ENDS[0]), options
    complete_field, evaluate = TracedField(*of_near), traced_field_module.evaluate_paths

    def broken(chains, *more):
        """No number for the paths of the first transmitter whose last interaction is a reflection."""
        (real, imaginary), *other = evaluate(chains, *more)
        lost = chains.levels[-1].reflects & (chains.source_m[0] == 1) & (chains.exists > 0)
        return (dr.select(lost, np.nan, real), imaginary), *other

    reflected = (
        complete_field.chains.levels[-1].reflects.numpy()
        & (complete_field.chains.source_m[0].numpy() == 1)
        & complete_field.exists
    )
    assert 0 < reflected.sum() < complete_field.exists.sum()
    monkeypatch.setattr(traced_field_module, "evaluate_paths", broken)
    with caplog.at_level(logging.WARNING):
        traced = TracedField(*of_near)
    lost = int(re.search(r"(\d+) of \d+ paths are left out: their gains are not numbers", caplog.text)[1])
    assert lost >= reflected.sum()
    if not faint:
        assert (lost, traced.exists.sum()) == (reflected.sum(), complete_field.exists.sum() - reflected.sum())
    assert np.isfinite([part.numpy() for part in traced({}).gain]).all()


def test_differentiable_paths_without_any_gain_are_refused(building, monkeypatch):
    evaluate = traced_field_module.evaluate_paths

    def broken(*arguments):
        (real, imaginary), *other = evaluate(*arguments)
        return (real * np.nan, imaginary), *other

    monkeypatch.setattr(traced_field_module, "evaluate_paths", broken)
    with pytest.raises(InputError, match="gains that are not numbers"):
        TracedField(building, [[1.0, 1.0, 1.0]], receiver(ENDS[0]), TracedOptions(KINDS["specular"]))


CELL_M, LOWEST_HZ, HIGHEST_HZ, LOADED_HZ = 0.1, 0.4e9, 60e9, 3.5e9
ANGLES_RAD = 0.0, float(np.arctan2(3, 4)), np.pi / 6, 1.0
FEW_RAYS = {
    "specular": TraceOptions(depth=3, rays=1 << 10),
    "diffraction": TraceOptions(depth=2, diffraction=True, rays=1 << 7),
    "scattering": TraceOptions(depth=2, scattering=True, scattering_coefficient=0.4, rays=1 << 5),
}
MATERIALS, TRANSMITTERS, RECEIVERS = 4, 4, 40
BRIEF: dict[str, Any] = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}


@st.composite
def plans(draw):
    """A plan of rooms behind walls of any thickness, with a door in each inner wall."""
    rows, columns = draw(st.integers(30, 60)), draw(st.integers(30, 80))
    occupied, outer = np.zeros((rows, columns), bool), draw(st.integers(1, 4))
    occupied[:outer] = occupied[-outer:] = occupied[:, :outer] = occupied[:, -outer:] = True
    for cells in (occupied, occupied.T):  # walls along both axes, the second of which are views of the same cells
        for at in draw(st.lists(st.integers(12, len(cells) - 12), max_size=2)):
            thick, door = draw(st.integers(1, 3)), draw(st.integers(6, cells.shape[1] - 15))
            cells[at : at + thick, :door] = cells[at : at + thick, door + 9 :] = True
    return PlanGrid(occupied, ~occupied, CELL_M, np.zeros(2))


@st.composite
def buildings(draw):
    """Parts, thickness of materials in metres, and carrier: storeys of a plan with solids, turned and moved.

    Floors of upper storeys lie on the ceiling below or a slab above it, and solids stand on the floor, against a wall,
    or reach through both.
    """
    plan, height_m, slab_m = draw(plans()), draw(st.floats(2.2, 4.0)), draw(st.sampled_from([0.0, 0.25]))
    meshes = []
    for storey in range(draw(st.integers(1, 2))):
        surfaces = plan_surfaces(plan, height_m=height_m, floor_m=storey * (height_m + slab_m))
        meshes += [surface.mesh for surface in surfaces]
    size_m = CELL_M * np.array([*plan.occupied.shape[::-1], height_m / CELL_M])
    for _ in range(draw(st.integers(0, 2))):
        low = draw(st.tuples(*(st.sampled_from([0.0, 0.3 * side, 0.6 * side]) for side in size_m)))
        meshes.append(trimesh.creation.box(bounds=[low, np.add(low, draw(st.floats(0.05, 1.5)))]))
    turn, moved_m = draw(st.sampled_from(ANGLES_RAD)), draw(st.sampled_from([0.0, 1e3, 1e4]))
    for mesh in meshes:
        mesh.vertices = Rotation.from_euler("z", turn).apply(mesh.vertices) + np.array([moved_m, -moved_m / 3, 0])
        mesh.vertices = mesh.vertices.astype(np.float32)  # as in files, so that positions are on the faces
    hz = 10 ** draw(st.floats(np.log10(LOWEST_HZ), np.log10(HIGHEST_HZ)))
    # Sionna RT opens no file with vacuum, nor with materials that are unknown at the carrier at which it loads scenes.
    names = [f"itu_{name}" for name in itu_constants(hz) if name != "vacuum" and name in itu_constants(LOADED_HZ)]
    materials = draw(st.permutations(names))[:MATERIALS]
    chosen = [*materials, *(draw(st.sampled_from(materials)) for _ in range(len(meshes) - MATERIALS))]
    # One part of each material: kernels are compiled anew for another number of parts or of materials.
    of_material: dict[str, list[trimesh.Trimesh]] = {name: [] for name in materials}
    for mesh, name in zip(meshes, chosen, strict=True):
        of_material[name].append(mesh)
    parts = {f"of_{name}": (name, trimesh.util.concatenate(same)) for name, same in of_material.items()}
    return parts, {name: 10 ** draw(st.floats(-4, 1)) for name in materials}, hz


def positions(parts, rng):
    """Positions [n, 3] on, in and near the faces of a building, in their planes, in its air, and far away."""
    triangles = np.concatenate([np.asarray(mesh.triangles) for _, mesh in parts.values()])
    corner, first, second = np.moveaxis(triangles[rng.integers(len(triangles), size=60)], 1, 0)
    shares = np.concatenate([np.zeros((10, 2)), rng.dirichlet(np.ones(3), 10)[:, :2], rng.uniform(-3, 3, (20, 2))])
    shares = np.concatenate([shares, np.stack([rng.uniform(-0.5, 1.5, 20), np.zeros(20)], axis=1)])  # along edges
    sides = first - corner, second - corner
    in_planes = corner + sum(share[:, None] * side for share, side in zip(shares.T, sides, strict=True))
    normal = np.cross(*sides) / np.maximum(np.linalg.norm(np.cross(*sides), axis=1), 1e-12)[:, None]
    near = in_planes + 10 ** rng.uniform(-9, -2, (60, 1)) * normal * rng.choice([-1, 1], (60, 1))
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    air = rng.uniform(low - 5, high + 5, (20, 3))
    bodies = [body for _, mesh in parts.values() for body in mesh.split(only_watertight=True)]
    within = np.array([body.bounds.mean(axis=0) for body in bodies])
    far = low + rng.standard_normal((10, 3)) * 10 ** rng.uniform(3, 5, (10, 1))
    everywhere = np.concatenate([in_planes, near, air, within.reshape(-1, 3), far])
    # Coordinates of others: the same height, the plane of a wall, a line along an edge.
    mixed = [rng.permutation(column) for column in everywhere.T]
    return np.concatenate([everywhere, np.stack(mixed, axis=1)])


def check(building, seed, options):
    parts, thickness, hz = building
    rng = np.random.default_rng(seed)
    places = rng.permutation(positions(parts, rng))
    transmitters, others = places[:TRANSMITTERS], places[TRANSMITTERS : TRANSMITTERS + RECEIVERS]
    others = np.concatenate([transmitters, transmitters[:2] + np.array([[1e-9, 0, 0], [0, 1e-7, 1e-5]]), others])
    receivers = [receiver(place, f"rx{number}") for number, place in enumerate(others)]
    with tempfile.TemporaryDirectory() as folder:
        scene = open_scene(write_xml(Path(folder), parts), hz, thickness)
    traced = trace_paths(scene, transmitters, receivers, options, check=False, search_from="transmitters")
    for part in (traced, recompute(traced, scene)):
        paths = part.paths
        assert part.lost == 0
        assert np.isfinite(paths.gain).all()
        assert np.isfinite(paths.length_m).all()
        assert np.isfinite([paths.departure, paths.arrival]).all()
    return len(traced.paths)


@pytest.mark.parametrize("options", FEW_RAYS.values(), ids=FEW_RAYS)
@given(building=buildings(), seed=st.integers(0, 2**16))
@settings(max_examples=4, **BRIEF)
def test_gains_in_a_generated_building_are_numbers(building, options, seed):
    check(building, seed, options)


@pytest.mark.slow
@pytest.mark.parametrize("options", FEW_RAYS.values(), ids=FEW_RAYS)
@given(building=buildings(), seed=st.integers(0, 2**16))
@settings(max_examples=100, **BRIEF)
def test_gains_in_many_generated_buildings_are_numbers(building, options, seed):
    check(building, seed, options)
