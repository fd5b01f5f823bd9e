"""Doors, furniture and images of mirrors among planes, and floors and walls completed behind things."""

import numpy as np
import pytest
import shapely

from wrf_mi.core import InputError
from wrf_mi.scene.coordinates import require_clear_up
from wrf_mi.scene.mesh.furnishings import furnishings, reached
from wrf_mi.scene.mesh.outline import Raster, levels_completed, shadows
from wrf_mi.scene.mesh.planes import Face, Plane, with_axes
from wrf_mi.scene.mesh.surfaces import Kind


def face(normal, offset_m, *corners_m):
    """The rectangle of a plane about points of it."""
    plane = with_axes(Plane(np.array(normal, float), offset_m, np.empty((0, 4, 3)), np.zeros(3), 0.0))
    return Face(plane, shapely.envelope(shapely.multipoints(plane.flat(np.array(corners_m, float)))))


def level(z, x0, y0, x1, y1):
    return face((0, 0, 1), z, (x0, y0, z), (x1, y1, z))


def across_x(x, y0, y1, low, high):
    return face((1, 0, 0), x, (x, y0, low), (x, y1, high))


FLOOR, CEILING, WALL = level(0.0, 0, 0, 5, 4), level(2.5, 0, 0, 5, 4), across_x(0.0, 0, 4, 0.0, 2.5)


@pytest.mark.parametrize(
    ("piece", "name"),
    [
        (across_x(-0.06, 1.0, 1.85, 0.0, 2.05), "door"),
        (across_x(0.6, 1.0, 2.2, 0.0, 2.1), "other"),  # the front of a wardrobe
        (across_x(0.6, 1.0, 2.2, 0.0, 2.5), "wall"),  # up to the ceiling
        (across_x(-0.06, 1.0, 3.5, 0.0, 2.05), "wall"),  # as wide as no door, and no floor behind it
    ],
)
def test_upright_planes_below_the_ceiling_are_named(piece, name):
    faces = [FLOOR, CEILING, WALL, piece]
    assert furnishings(faces, ["floor", "ceiling", "wall", "wall"]) == ["floor", "ceiling", "wall", name]


def test_an_image_in_a_mirror_adjoins_no_floor():
    image = level(0.0, -4, 1, -1, 2), across_x(-4.0, 1, 2, 0.0, 2.5)
    both = Face(FLOOR.plane, shapely.union_all([FLOOR.area, image[0].area]))
    reached_parts = reached([both, WALL, image[1]], ["floor", "wall", "wall"])
    assert [part.area.area for part in reached_parts] == pytest.approx([20, 10, 0])


def test_floors_are_completed_below_the_ceiling_but_not_above_a_stairwell():
    bed, stairs = shapely.box(0, 0, 2, 1.5), shapely.box(4, 3, 5, 4)
    holes = shapely.transform(shapely.union_all([bed, stairs]), lambda xy: FLOOR.plane.flat(np.c_[xy, 0 * xy[:, :1]]))
    visible_floor = shapely.difference(FLOOR.area, holes)
    steps = np.random.default_rng(1).uniform((4, 3, -1.5), (5, 4, -0.2), (2000, 3))
    planes, roles = [FLOOR.plane, CEILING.plane], list[Kind](("floor", "ceiling"))
    floor, ceiling = levels_completed(planes, [visible_floor, CEILING.area], roles, steps, 0.03)
    assert floor.area == pytest.approx(19, abs=0.02)
    assert ceiling.area == pytest.approx(20, abs=0.02)


def test_things_before_a_wall_hide_it():
    raster = Raster.around(shapely.get_coordinates(WALL.area))
    front = np.random.default_rng(1).uniform((0.6, 1.0, 0.0), (0.61, 2.2, 2.0), (5000, 3))
    hidden = shadows(raster, WALL.plane, "wall", front, 0.01).sum() * raster.cell_m**2
    assert hidden == pytest.approx(1.2 * 2.0, rel=0.1)
    assert not shadows(raster, WALL.plane, "wall", front + np.array([2.0, 0, 0]), 0.01).any()


def on_box(x, y, z, count=20_000):
    """Points on the sides of a box."""
    rng = np.random.default_rng(1)
    points = rng.uniform(0, (x, y, z), (count, 3))
    axis = rng.choice(3, count, p=np.array([y * z, x * z, x * y]) / (y * z + x * z + x * y))
    points[np.arange(count), axis] = rng.integers(0, 2, count) * np.array([x, y, z])[axis]
    return points


@pytest.mark.parametrize("size", [(5, 2.6, 3), (3, 2.6, 2.4), (5, 2.6, 1.5)])
def test_a_phones_scan_whose_height_may_be_y_is_asked_for(size):
    with pytest.raises(InputError, match="--up y or --up z"):
        require_clear_up(on_box(*size), "scan.obj", None)
    require_clear_up(on_box(*size), "scan.obj", "z")
    require_clear_up(on_box(*size), "scan.usdz", None)


@pytest.mark.parametrize("size", [(5, 4.5, 2.6), (6, 3.6, 2.5)])
def test_a_phones_scan_that_is_clearly_upright_is_read(size):
    require_clear_up(on_box(*size), "scan.obj", None)
