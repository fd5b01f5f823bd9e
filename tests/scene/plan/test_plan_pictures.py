"""Pictures of plans: kinds of pixels, the YAML of ROS maps, and the floor that their cells and measured places show."""

from typing import Any

import numpy as np
import pytest
import shapely
import shapely.affinity
from calling import refused
from made_plans import read_grid
from PIL import Image

from wrf_mi.core import InputError
from wrf_mi.scene.edit import read_surfaces
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import level_area
from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.plan.storey import plan_surfaces
from wrf_mi.scene.plan.walked import FREE, OUTSIDE, UNMAPPED, WALL, cells_at, mapped_part

CELL_M = 0.05
OCCUPIED, UNKNOWN, EMPTY = 0, 205, 254  # as map_saver writes them
LOW_M = np.array([-1.0, -5.0])  # corner of the picture
HALL, CLOSED, YARD = (0.1, 0.1, 7.9, 5.9), (8.0, 0.1, 11.9, 5.9), (2.0, -3.0, 5.0, 0.1)
"""A hall that was mapped, a room of the same building that was not, and free ground before a gap of 3 m in its wall."""
WALLS = [(0, 0, 2, 0.1), (5, 0, 12, 0.1), (0, 5.9, 12, 6), (0, 0, 0.1, 6), (11.9, 0, 12, 6), (7.9, 0, 8, 6)]
HALL_M2, AREA_ERROR_M2 = 7.9 * 5.9, 2 * 28 * CELL_M  # two cells along its outline
YAML = "image: map.png\nresolution: 0.05\norigin: [-1.0, -5.0, 0.0]\n"


def robot_map(mapped=(HALL, YARD), unknown=UNKNOWN, turned=0):
    """Grey picture [rows, columns] of the building, its first row on top."""
    grey = np.full((240, 280), unknown, np.uint8)
    for value, rectangles in ((EMPTY, mapped), (OCCUPIED, WALLS)):
        for x0, y0, x1, y1 in rectangles:
            (c0, r0), (c1, r1) = (np.round((np.array(p) - LOW_M) / CELL_M).astype(int) for p in ((x0, y0), (x1, y1)))
            grey[r0:r1, c0:c1] = value
    return np.rot90(grey[::-1], turned)


def write_map(folder, grey, sheet=YAML):
    Image.fromarray(grey).save(folder / "map.png")
    (folder / "map.yaml").write_text(sheet)
    return folder / "map.yaml"


def walked(folder, places):
    np.savetxt(folder / "walk.csv", places, "%.3f", ",", header="x,y", comments="")
    return folder / "walk.csv"


def rows_of_places(x0, y0, x1, y1, step=0.5):
    x, y = np.meshgrid(np.arange(x0, x1, step), np.arange(y0, y1, step))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def floor_area(folder):
    return level_area([surface for surface in read_surfaces(folder)[0] if surface.kind == "floor"])


IN_HALL = rows_of_places(0.5, 0.5, 7.5, 5.6)
IN_YARD = rows_of_places(2.5, -2.5, 4.8, -0.2)


# --- the floor


@pytest.mark.parametrize("unknown", [UNKNOWN, 128])
@pytest.mark.parametrize("with_sheet", [True, False])
def test_unmapped_cells_within_walls_are_no_floor(tmp_path, caplog, unknown, with_sheet):
    sheet = write_map(tmp_path, robot_map(mapped=(HALL,), unknown=unknown))
    if not with_sheet:
        sheet.unlink()
    plan = read_plan(sheet if with_sheet else tmp_path / "map.png", CELL_M)
    floor, ceiling, *_ = plan_surfaces(plan, height_m=2.7)
    assert floor.mesh.area == ceiling.mesh.area == pytest.approx(HALL_M2, abs=AREA_ERROR_M2)
    assert "m2 within the walls are unmapped, and are no floor" in caplog.text


def test_what_furniture_hides_is_floor():
    grid = robot_map(mapped=(HALL, CLOSED))[::-1]
    cells = {"occupied": grid == OCCUPIED, "free": grid == EMPTY}
    row, column = int((0.1 + 5) / CELL_M), int(3 / CELL_M)
    cells["free"][row : row + 12, column : column + 60] = False  # 0.6 m deep along a wall
    floor, *_ = plan_surfaces(PlanGrid(**cells, resolution_m=CELL_M, origin_m=LOW_M), height_m=2.7)
    assert floor.mesh.area == pytest.approx(12 * 6, abs=2 * AREA_ERROR_M2)


def test_map_without_free_cells_within_its_walls_is_refused(tmp_path):
    grid = read_grid(write_map(tmp_path, robot_map(mapped=(YARD,))))
    with pytest.raises(InputError, match="no cell within its walls is known to be free"):
        mapped_part(shapely.box(*CLOSED), grid, "map")


def test_floor_contains_places_in_free_cells_that_no_wall_encloses(tmp_path):
    sheet, places = write_map(tmp_path, robot_map()), np.concatenate([IN_HALL, IN_YARD])
    options: dict[str, Any] = {"height_m": 2.7, "replace": True}
    make_scene(sheet, tmp_path / "scene", **options)
    without = floor_area(tmp_path / "scene")
    assert not shapely.contains_xy(without, IN_YARD).any()
    make_scene(sheet, tmp_path / "scene", positions=walked(tmp_path, places), **options)
    area = floor_area(tmp_path / "scene")
    assert shapely.contains_xy(area, places).all()
    assert area.area - without.area == pytest.approx(3 * 3, abs=0.6)
    assert not shapely.intersects(area, shapely.box(8.2, 0.2, 11.8, 5.8))


def test_places_without_free_cells_are_named(tmp_path, caplog):
    odd = [(10.0, 3.0), (11.95, 3.0), (14.0, 3.0)]
    sheet, places = write_map(tmp_path, robot_map()), walked(tmp_path, [*IN_HALL, *odd])
    make_scene(sheet, tmp_path / "scene", height_m=2.7, positions=places)
    first = len(IN_HALL) + 1
    text = f"3 of {first + 2} positions: 1 in unmapped cells (rows {first}), 1 in walls (rows {first + 1}), "
    assert text + f"1 outside of the picture (rows {first + 2}); check --origin and --resolution" in caplog.text
    assert shapely.contains_xy(floor_area(tmp_path / "scene"), [10.0, 11.95, 14.0], [3.0, 3.0, 3.0]).tolist() == [
        True,  # someone walked there
        False,
        False,
    ]


def test_cells_of_places_allow_for_the_blur_of_walls():
    grid = robot_map()[::-1]
    plan = PlanGrid(grid == OCCUPIED, grid == EMPTY, CELL_M, LOW_M)
    places = np.array([[1, 1], [0.05, 1], [11.95, 3], [10, 3], [-0.5, 0], [13.5, 0], [1, -9]])
    expected = [FREE, FREE, WALL, UNMAPPED, UNMAPPED, OUTSIDE, OUTSIDE]
    assert cells_at(plan, places).tolist() == expected


# --- pixels


def pictures(dark):
    """The same drawing, dark where the mask is set, in the kinds of pixels of PNG and JPEG, by their names."""
    white = np.where(dark, 0, 255).astype(np.uint8)
    clear = np.where(dark, 255, 0).astype(np.uint8)
    black = np.zeros_like(white)
    palette = Image.fromarray(np.where(dark, 1, 0).astype(np.uint8))
    palette = palette.convert("L").convert("P")
    palette.putpalette([0, 0, 0, 10, 10, 10])
    palette.putdata(np.where(dark, 1, 0).ravel().tolist())
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by 90 degrees clockwise
    return {
        "rgba.png": (Image.fromarray(np.stack([black] * 3 + [clear], axis=-1)), {}),
        "la.png": (Image.fromarray(np.stack([black, clear], axis=-1)), {}),
        "palette.png": (palette, {"transparency": 0}),
        "grey-16.png": (Image.fromarray(white.astype(np.uint16) * 257), {}),
        "grey-16-key.png": (Image.fromarray(np.where(dark, 300, 7).astype(np.uint16)), {"transparency": 7}),
        "bits.png": (Image.fromarray(white).convert("1"), {}),
        "inks.jpg": (Image.fromarray(white).convert("RGB").convert("CMYK"), {"quality": 95}),
        "turned.jpg": (Image.fromarray(np.rot90(white)), {"exif": exif, "quality": 95}),
    }


DARK = np.zeros((64, 96), bool)
DARK[8:56, 8:16] = DARK[48:56, 8:88] = True


@pytest.mark.parametrize("name", pictures(DARK))
def test_kinds_of_pixels_show_the_same_walls(tmp_path, name):
    picture, options = pictures(DARK)[name]
    picture.save(tmp_path / name, **options)
    grid = read_grid(tmp_path / name, CELL_M)
    np.testing.assert_array_equal(grid.occupied, DARK[::-1])
    np.testing.assert_array_equal(grid.free, ~DARK[::-1])


def test_ground_of_a_coloured_drawing_is_not_unmapped(tmp_path, caplog):
    colours = np.full((64, 96, 3), (119, 168, 178), np.uint8)
    colours[DARK] = 0
    Image.fromarray(colours).save(tmp_path / "plan.png")
    assert not read_grid(tmp_path / "plan.png", CELL_M).unmapped.any()
    share = 100 * DARK.mean()
    assert f"{share:.2g} % of its pixels, those darker than grey 89, count as walls" in caplog.text


# --- YAML of ROS maps


@pytest.mark.parametrize(
    ("lines", "grey", "occupied", "free"),
    [
        ("", [0, 205, 254], [1, 0, 0], [0, 0, 1]),
        ("free_thresh: 0.25\n", [0, 205, 254], [1, 0, 0], [0, 0, 1]),  # unmapped whatever the threshold
        ("free_thresh: 0.25\n", [0, 200, 254], [1, 0, 0], [0, 1, 1]),
        ("occupied_thresh: 0.4\n", [0, 140, 254], [1, 1, 0], [0, 0, 1]),
        ("negate: 1\n", [0, 100, 254], [0, 0, 1], [1, 0, 0]),
        ("mode: raw\n", [0, 100, 255], [0, 1, 0], [1, 0, 0]),
        ("mode: scale\n", [0, 128, 255], [1, 0, 0], [0, 0, 1]),
    ],
)
def test_thresholds_and_modes_of_a_ros_map_are_those_of_map_server(tmp_path, lines, grey, occupied, free):
    grid = read_grid(write_map(tmp_path, np.array([grey], np.uint8), YAML + lines))
    assert (grid.occupied[0].tolist(), grid.free[0].tolist()) == ([*map(bool, occupied)], [*map(bool, free)])


def test_transparent_cells_of_mode_scale_are_unmapped(tmp_path):
    pixels = np.array([[[0, 255], [255, 255], [255, 0]]], np.uint8)
    grid = read_grid(write_map(tmp_path, pixels, YAML + "mode: scale\n"))
    assert grid.unmapped.tolist() == [[False, False, True]]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("origin: [0, 0, nan]", "origin is .*nan.; give finite x and y in metres and a yaw in radians"),
        ("origin: [0, .inf, 0]", "origin is .* give finite x and y"),
        ("origin: [0, 0]", r"setting origin: expected a list of 3 values, got \[0"),
        ("origin: 0", "setting origin: expected a list of 3 values, got 0"),
        ("origin:", "it needs origin"),
        ("resolution: -0.05", "resolution: -0.05 is out of range, choose more than 0"),
        ("resolution: .nan", "resolution: nan is out of range, choose more than 0"),
        ("resolution: true", "setting resolution: expected float, got True"),
        ("resolution:", "it needs resolution"),
        ("negate: 2", "setting negate: 2; choose from 0, 1"),
        ("negate: .nan", "setting negate: nan; choose from 0, 1"),
        ("mode: ternary", "setting mode: 'ternary'; choose from trinary, scale, raw"),
        ("occupied_thresh: .nan", "occupied_thresh: nan is out of range, choose more than 0 and less than 1"),
        ("occupied_thresh: 65", "occupied_thresh: 65.0 is out of range, choose more than 0 and less than 1"),
        ("free_thresh: 0.7", "free_thresh is 0.7 and occupied_thresh 0.65; give that of free cells first"),
        ("image: [1]", r"setting image: expected string, got \[1"),
    ],
)
def test_values_of_a_ros_map_that_are_unusable_are_refused_by_name(tmp_path, line, message, capsys):
    sheet = write_map(tmp_path, np.array([[0, 205, 254]], np.uint8), f"{YAML}{line}\n")
    with pytest.raises(InputError, match=message):
        read_plan(sheet)
    refused(["mesh", sheet, "--wall-height", "2.5", "--out", tmp_path / "scene"], message, capsys)


def test_the_yaw_of_a_ros_map_turns_it_about_its_lower_left_corner(tmp_path):
    plan = write_map(tmp_path, robot_map())
    straight = floor_area(make_scene(plan, tmp_path / "straight", height_m=2.5).folder)
    turned_map = write_map(tmp_path, robot_map(), YAML.replace("[-1.0, -5.0, 0.0]", "[2.0, 3.0, 0.4]"))
    turned = floor_area(make_scene(turned_map, tmp_path / "turned", height_m=2.5).folder)
    expected = shapely.affinity.rotate(straight, 0.4, origin=tuple(LOW_M), use_radians=True)
    expected = shapely.affinity.translate(expected, *(np.array([2.0, 3.0]) - LOW_M))
    assert shapely.symmetric_difference(turned, expected).area < 1e-3 * expected.area
