"""Generated homes, a phone's scan of them, and the scenes that are made from it."""

import numpy as np
import pytest
import shapely
from scipy.spatial import cKDTree
from trimesh import transform_points
from trimesh.sample import sample_surface
from wrf_mi_bench.phone_homes import home, phone_scan
from wrf_mi_bench.phone_scans import compared, table
from wrf_mi_scenes.build_laboratory import joined

from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene

SEED = 70


@pytest.mark.parametrize("flat", [False, True])
def test_rooms_of_a_home_are_disjoint_and_connected_by_doors(flat):
    place = home(SEED, flat)
    assert len(place.rooms) == 1 if not flat else 3 <= len(place.rooms) <= 6
    rooms = shapely.union_all(place.rooms)
    assert rooms.area == pytest.approx(sum(room.area for room in place.rooms))
    floor = joined([place.shell["floors"], *(mesh for name, mesh in place.shell.items() if name.startswith("opening"))])
    low = shapely.union_all(
        [shapely.polygons(corners[:, :2]) for corners in floor.triangles if np.ptp(corners[:, 2]) == 0]
    )
    assert len(shapely.get_parts(shapely.buffer(shapely.union_all([rooms, low]), 1e-6))) == 1


def test_a_scan_lies_on_the_surfaces_that_were_scanned():
    place = home(SEED, False)
    mesh, to_home, errors = phone_scan(place, SEED)
    points = transform_points(mesh.vertices, to_home)
    truth = joined([*place.shell.values(), *place.furniture, *place.clutter])
    away = cKDTree(sample_surface(truth, 400_000, seed=1)[0]).query(points[::20])[0]
    assert np.median(away) < 3 * errors.noise_m
    assert np.quantile(away, 0.9) < errors.edge_m


@pytest.mark.slow
def test_a_scene_from_a_phones_scan_has_the_floor_and_walls_of_the_room(tmp_path):
    place = home(SEED, False)
    mesh, to_home, _ = phone_scan(place, SEED)
    mesh.export(tmp_path / "scan.obj")
    with pytest.raises(InputError, match="--up y"):
        make_scene(tmp_path / "scan.obj", tmp_path / "scene")
    make_scene(tmp_path / "scan.obj", tmp_path / "scene", up="y")
    figures = compared(place, tmp_path / "scene", to_home, SEED)
    assert abs(figures["floor_error"]) < 0.05
    assert figures["wall_cm"] < 3
    assert figures["recall"] > 0.8
    row = {"what": "room", "seconds": 1.0, **figures}
    assert table([row]).splitlines()[2].startswith("| room |")
