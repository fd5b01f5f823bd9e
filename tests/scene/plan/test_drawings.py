"""Floor plans drawn as pictures: thickness of walls, thin lines, and rooms that are open to the outside."""

import numpy as np
import pytest
from made_plans import L_ROOM_M, box, distance, read_grid
from PIL import Image
from scipy import ndimage
from trimesh.transformations import rotation_matrix

from wrf_mi.core import InputError
from wrf_mi.scene.edit import read_surfaces
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import level_area
from wrf_mi.scene.plan.grid import PlanGrid
from wrf_mi.scene.plan.pictures import PlanDrawing
from wrf_mi.scene.plan.sources import plan_pixels, read_plan
from wrf_mi.scene.plan.storey import floor_of, layout_walls, plan_surfaces
from wrf_mi.scene.plan.walls import find_walls
from wrf_mi.scene.preview import draw_scene

CELL_M = 0.025
# Outer walls of 0.5 m about 6 m x 5 m, two inner walls of 0.1 m along a corridor, each with a door.
OUTER = [(0.5, 0.5, 7.5, 1), (0.5, 6, 7.5, 6.5), (0.5, 0.5, 1, 6.5), (7, 0.5, 7.5, 6.5)]
INNER = [(1, 2.9, 2, 3), (2.9, 2.9, 7, 3), (1, 4.4, 4, 4.5), (4.9, 4.4, 7, 4.5)]
ENTRANCE = (0.5, 3.2, 1, 4.2)
LEAF = (2, 3, 2 + CELL_M, 3.9)
FLOOR_M2, AREA_ERROR_M2 = 30.0, 22 * CELL_M
"""The error is a cell along the outline."""


def drawing(file, black, white=(), transposed=False):
    """Picture of 8 m x 7 m with rectangles x0, y0, x1, y1."""
    grey = np.full((280, 320), 255, np.uint8)
    for value, boxes in ((60, black), (255, white)):
        for x0, y0, x1, y1 in np.round(np.reshape(boxes, (-1, 4)) / CELL_M).astype(int):
            grey[y0:y1, x0:x1] = value
    Image.fromarray((grey.T if transposed else grey)[::-1]).save(file)
    return file


@pytest.mark.parametrize("transposed", [False, True])
def test_a_wall_is_one_sheet_at_its_inner_face_in_both_directions_and_an_entrance_keeps_the_floor(tmp_path, transposed):
    plan = read_plan(drawing(tmp_path / "plan.png", OUTER + INNER, ENTRANCE, transposed), CELL_M)
    floor, _, *walls = plan_surfaces(plan, height_m=2.7)
    assert floor.mesh.area == pytest.approx(FLOOR_M2, abs=AREA_ERROR_M2)
    ends = np.stack([wall.vertices_m[:2, :2] for wall in walls])
    ends = ends[..., ::-1] if transposed else ends
    assert len(ends) == 9  # the west wall and the inner walls are two each
    np.testing.assert_allclose([ends.min(axis=(0, 1)), ends.max(axis=(0, 1))], [[1, 1], [7, 6]], atol=CELL_M)
    inner = ends[np.isin(np.round(ends[:, :, 1], 1), [2.9, 3.0, 4.4, 4.5]).all(axis=1)]
    assert sorted(inner[:, 0, 1]) == pytest.approx([2.95, 2.95, 4.45, 4.45], abs=CELL_M)
    # The gap stays open.
    assert distance([1, 3.7], ends) > 0.4


def test_thin_lines_are_not_walls_unless_all_walls_are_lines(tmp_path, caplog):
    walls = find_walls(read_grid(drawing(tmp_path / "plan.png", [*OUTER, *INNER, LEAF]), CELL_M))
    assert "lines thinner than 0.05 m" in caplog.text
    assert distance([2, 3.5], walls) > 0.4
    thick = [(*LEAF[:2], LEAF[0] + 0.05, LEAF[3])]
    walls = find_walls(read_grid(drawing(tmp_path / "plan.png", OUTER + INNER + thick), CELL_M))
    assert distance([2, 3.5], walls) < 2 * CELL_M
    thin = [(x0, y0, x1 - 0.5 + CELL_M, y1 - 0.5 + CELL_M) for x0, y0, x1, y1 in OUTER]
    caplog.clear()
    walls = find_walls(read_grid(drawing(tmp_path / "plan.png", thin), CELL_M))
    assert "every line is a wall" in caplog.text
    assert len(walls) == 4


@pytest.mark.parametrize(
    ("corridor_m", "open_m", "corridor"), [(1.5, 1.5, True), (2.4, 2.4, True), (3.0, 1.0, True), (3.0, 3.0, False)]
)
def test_rooms_behind_gaps_of_at_most_two_and_a_half_metres_have_floor(corridor_m, open_m, corridor):
    """Two rooms of 8 m x 3 m, and between them a corridor that is open in the west."""
    side = (corridor_m - open_m) / 2
    top = 3 + corridor_m
    stubs = [[[0, 3], [0, 3 + side]], [[0, top - side], [0, top]]] if side else np.empty((0, 2, 2))
    walls = np.concatenate([box(0, 0, 8, 3), box(0, top, 8, 3), [[[8, 3], [8, top]]], stubs])
    assert floor_of(walls).area == pytest.approx(48 + (8 * corridor_m if corridor else 0), abs=1e-6)


def test_niches_and_spaces_between_both_faces_of_a_wall_have_no_floor():
    niche = [(0, 0), (3, 0), (3, 1), (5, 1), (5, 0), (8, 0), (8, 4), (0, 4), (0, 0)]
    assert floor_of(layout_walls(np.array(niche, float))).area == pytest.approx(30)
    faces = [(0, 0), (3, 0), (3, 4), (3.2, 4), (3.2, 0), (6, 0), (6, 4.5), (0, 4.5), (0, 0)]
    assert floor_of(layout_walls(np.array(faces, float))).area == pytest.approx(27 - 0.2 * 4)


def test_positions_in_a_room_that_is_open_to_the_outside_are_named(tmp_path):
    """In a building that is its own mirror image, positions on a corridor without floor are no matter of the frame."""
    x, y = np.meshgrid(np.arange(0.25, 8, 0.5), [1.0, 4.0, 5.0, 8.0])
    np.savetxt(tmp_path / "walk.csv", np.stack([x.ravel(), y.ravel()], axis=1), "%.2f", ",", header="x,y", comments="")
    # The path doubles back along the corridor, 3 m wide and open in the west.
    corners = [(0, 0), (8, 0), (8, 9), (0, 9), (0, 6), (8, 6), (8, 3), (0, 3), (0, 0)]
    np.savetxt(tmp_path / "plan.csv", corners, "%.2f", ",", header="x,y", comments="")
    with pytest.raises(InputError, match=r"32 of 64 positions have no floor below; .* open to the outside"):
        make_scene(tmp_path / "plan.csv", tmp_path / "scene", height_m=2.7, positions=tmp_path / "walk.csv")


FURNISHED = [(x, y, x + 0.04, y + 1.2) for x, y in ((1.1, 4.6), (2.0, 4.6))] + [
    (1.1, 4.6, 2.0, 4.64),
    (1.1, 5.8, 2.0, 5.84),
]
LETTERS = [(5 + 0.3 * letter, 3.4, 5.06 + 0.3 * letter, 3.8) for letter in range(6)]


def furnished(file, grey=40, faces=False):
    """The plan above at 2 cm a pixel, with rooms in colours, the outline of a bed and letters."""
    cell = 0.02
    colours = np.full((350, 400, 3), 255, np.uint8)

    def fill(box, colour):
        x0, y0, x1, y1 = np.round(np.array(box) / cell).astype(int)
        colours[y0:y1, x0:x1] = colour

    fill((1, 1, 7, 2.9), (250, 235, 200))
    fill((1, 4.5, 7, 6), (205, 225, 245))
    solid = np.zeros((350, 400), bool)
    for box_m in [*OUTER, *INNER]:
        x0, y0, x1, y1 = np.round(np.array(box_m) / cell).astype(int)
        solid[y0:y1, x0:x1] = True
    x0, y0, x1, y1 = np.round(np.array(ENTRANCE) / cell).astype(int)
    solid[y0:y1, x0:x1] = False
    inside = ndimage.binary_erosion(solid)
    colours[solid] = 0 if faces else grey
    if faces:
        colours[inside] = 255
    for box_m in [*FURNISHED, *LETTERS]:
        fill(box_m, 0)
    Image.fromarray(colours[::-1]).save(file)
    return file


@pytest.mark.parametrize(("name", "options"), [("a.png", {}), ("b.jpg", {"grey": 150}), ("c.png", {"grey": 200})])
def test_walls_of_any_grey_are_told_from_furniture_letters_and_rooms_in_colours(tmp_path, caplog, name, options):
    plan = read_plan(furnished(tmp_path / name, **options), 0.02)
    floor, _, *walls = plan_surfaces(plan, height_m=2.7)
    assert floor.mesh.area == pytest.approx(FLOOR_M2, abs=22 * 0.02)
    assert len(walls) == 9
    assert ("darker than grey 89" in caplog.text) == (not options)


def test_walls_drawn_by_both_faces_are_filled(tmp_path, caplog):
    floor, _, *walls = plan_surfaces(read_plan(furnished(tmp_path / "a.png", faces=True), 0.02), height_m=2.7)
    assert "walls are drawn by both faces" in caplog.text
    assert floor.mesh.area == pytest.approx(FLOOR_M2, abs=22 * 0.02)
    ends = np.stack([wall.vertices_m[:2, :2] for wall in walls])
    assert distance([4, 1], ends) < 0.021
    assert distance([5, 2.95], ends) < 0.021


def test_the_picture_of_a_scene_shows_its_plan_materials_and_positions(tmp_path):
    plan = read_plan(drawing(tmp_path / "plan.png", OUTER + INNER, ENTRANCE), CELL_M)
    assert isinstance(plan, PlanGrid)
    turn = np.array(rotation_matrix(0.5, [0, 0, 1]))
    pixels = plan_pixels(tmp_path / "plan.png", plan, 200)
    assert pixels.shape == (175, 200, 3)
    below = PlanDrawing(pixels, np.array([[0, 0], [8, 7]]), motion=turn)
    surfaces = plan_surfaces(L_ROOM_M, height_m=2.5)
    materials = {surface.name: "itu_glass" if surface.name == "wall_01" else "itu_brick" for surface in surfaces}
    figure = draw_scene(surfaces, materials=materials, drawing_below=below, positions_m=[[1, 2, np.nan]])
    axes = figure.axes[1]
    (image,) = axes.images
    corner = axes.transData.inverted().transform(image.get_transform().transform([8, 7]))
    np.testing.assert_allclose(corner, (turn @ [8, 7, 0, 1])[:2], atol=1e-9)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels == ["floor: itu_brick", "wall: itu_glass", "wall: itu_brick", "position"]


def test_paper_around_a_drawing_is_no_floor_though_a_position_stands_in_an_entrance(tmp_path):
    drawing(tmp_path / "plan.png", OUTER + INNER, ENTRANCE)
    x, y = np.meshgrid(np.arange(1.25, 7, 0.5), [2.0, 5.0])
    places = np.concatenate([np.stack([x.ravel(), y.ravel()], axis=1), [[0.7, 3.7], [1.2, 3.7], [1.9, 3.7]]])
    np.savetxt(tmp_path / "walk.csv", places, "%.2f", ",", header="x,y", comments="")
    how = {"height_m": 2.7, "resolution_m": CELL_M, "positions": tmp_path / "walk.csv"}
    new_scene = make_scene(tmp_path / "plan.png", tmp_path / "scene", **how)
    assert level_area([read_surfaces(new_scene.folder)[0][0]]).area == pytest.approx(FLOOR_M2 + 0.3, abs=1)
