"""Gains of paths are numbers at any position in and around generated buildings of plans, slabs and solids."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from traced_rooms import receiver, write_xml

from wrf_mi.scene.plan.sources import PlanGrid
from wrf_mi.scene.plan.storey import plan_surfaces
from wrf_mi.tracing import TraceOptions, open_scene, recompute, trace_paths
from wrf_mi.tracing.sionna.materials import itu_constants

CELL_M, LOWEST_HZ, HIGHEST_HZ, LOADED_HZ = 0.1, 0.4e9, 60e9, 3.5e9
ANGLES_RAD = 0.0, float(np.arctan2(3, 4)), np.pi / 6, 1.0
KINDS = {
    "specular": TraceOptions(depth=3, rays=1 << 10),
    "diffraction": TraceOptions(depth=2, diffraction=True, rays=1 << 7),
    "scattering": TraceOptions(depth=2, scattering=True, scattering_coefficient=0.4, rays=1 << 5),
}
MATERIALS, TRANSMITTERS, RECEIVERS = 4, 4, 40
BRIEF = {"deadline": None, "suppress_health_check": [HealthCheck.too_slow]}


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
    of_material = {name: [] for name in materials}
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


@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
@given(building=buildings(), seed=st.integers(0, 2**16))
@settings(max_examples=4, **BRIEF)
def test_gains_in_a_generated_building_are_numbers(building, options, seed):
    check(building, seed, options)


@pytest.mark.slow
@pytest.mark.parametrize("options", KINDS.values(), ids=KINDS)
@given(building=buildings(), seed=st.integers(0, 2**16))
@settings(max_examples=100, **BRIEF)
def test_gains_in_many_generated_buildings_are_numbers(building, options, seed):
    check(building, seed, options)
