"""Floor plans in DXF: walls drawn by both faces, windows, doors, units and layers."""

import numpy as np
import pytest
from made_plans import box, turn

from wrf_mi.core import InputError
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.plan.faces import middle_lines
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.plan.storey import plan_surfaces

ezdxf = pytest.importorskip("ezdxf", reason="needs wrf-mi[cad]")

# Two rooms of 8 m x 6 m with outer walls of 0.3 m, a partition of 0.1 m with a door, a window and an entrance.
OUTER = [(-0.3, -0.3, 1.5, -0.3), (3, -0.3, 8.3, -0.3), (-0.3, 6.3, 8.3, 6.3), (8.3, -0.3, 8.3, 6.3)]
INNER = [(0, 0, 1.5, 0), (3, 0, 4.9, 0), (5, 0, 8, 0), (0, 6, 4.9, 6), (5, 6, 8, 6), (8, 0, 8, 6)]
ENTRANCE = [(x, y0, x, y1) for x, ends in ((-0.3, (-0.3, 6.3)), (0, (0, 6))) for y0, y1 in ((ends[0], 3), (4, ends[1]))]
PARTITION = [(x, y0, x, y1) for x in (4.9, 5.0) for y0, y1 in ((0, 1), (1.9, 6))]
ENDS = [(1.5, -0.3, 1.5, 0), (3, -0.3, 3, 0), (-0.3, 3, 0, 3), (-0.3, 4, 0, 4), (4.9, 1, 5, 1), (4.9, 1.9, 5, 1.9)]
WINDOW = [(1.5, y, 3, y) for y in (-0.3, -0.16, -0.14, 0)]
FACES = [*OUTER, *INNER, *ENTRANCE, *PARTITION, *ENDS]
PLAIN: list[tuple[float, ...]] = [(0, 0, 0, 3), (0, 4, 0, 6), (0, 6, 8, 6), (8, 0, 8, 6), (0, 0, 1.5, 0), (3, 0, 8, 0)]
PLAIN += [(4.95, 0, 4.95, 1), (4.95, 1.9, 4.95, 6)]
SIDES = {"itu_plasterboard": PLAIN, "itu_glass": [(1.5, 0, 3, 0)], "itu_wood": [(0, 3, 0, 4), (4.95, 1, 4.95, 1.9)]}
LAYERS = ("A-WALL", "A-GLAZ", "A-DOOR")


def drawing(file, unit_m=0.001, insunits=4, layers=LAYERS, degrees=0.0, shift_m=(0.0, 0.0), more=()):
    """The flat above as CAD programs draw it: doors are blocks, whose parts are on layer 0."""
    document = ezdxf.new("R2010")
    document.header["$INSUNITS"] = insunits
    space, (wall, glass, door) = document.modelspace(), layers
    for layer, lines in ((wall, [*FACES, *more]), (glass, WINDOW), ("A-FURN", [(1, 5, 3, 5), (1, 5.6, 3, 5.6)])):
        for begin, end in turn(np.reshape(lines, (-1, 2, 2)), degrees, shift_m) / unit_m:
            space.add_line(begin, end, dxfattribs={"layer": layer})
    leaf = document.blocks.new("leaf")
    leaf.add_arc((0, 0), 1 / unit_m, 0, 90)
    leaf.add_line((0, 0), (1 / unit_m, 0))
    for place, angle, width in (((5, 1), 0, 0.9), ((0, 4), -90, 1.0)):
        at = turn(np.array([place]), degrees, shift_m)[0] / unit_m
        how = {"layer": door, "rotation": angle + degrees, "xscale": width, "yscale": width}
        space.add_blockref("leaf", at, dxfattribs=how)
    space.add_text("Kitchen", dxfattribs={"layer": "A-WALL-IDEN"})
    document.saveas(file)
    return file


def walls_of(file, **options):
    """Area of the floor, and ends [n, 2, 2] of walls and doors by material."""
    floor, _, *walls = plan_surfaces(read_plan(file, **options), height_m=2.5)
    ends: dict[str, list[np.ndarray]] = {}
    for wall in walls:
        material = wall.material or ("itu_wood" if wall.name.startswith("door") else "itu_plasterboard")
        ends.setdefault(material, []).append(wall.vertices_m[:2, :2])
    return floor.mesh.area, {material: np.array(parts) for material, parts in ends.items()}


def in_order(lines):
    """Lines [n, 2, 2] in an order that does not depend on that of lines and ends."""
    lines = np.round(np.reshape(lines, (-1, 2, 2)), 2) + 0.0
    return sorted(tuple(sorted(map(tuple, line))) for line in lines.tolist())


@pytest.mark.parametrize(
    ("unit_m", "insunits", "options"), [(0.001, 4, {}), (0.0254, 1, {}), (0.01, 0, {"units": "cm"}), (1.0, 6, {})]
)
def test_walls_are_sheets_within_a_centimetre_whatever_the_unit(tmp_path, unit_m, insunits, options):
    area_m2, walls = walls_of(drawing(tmp_path / "plan.dxf", unit_m, insunits), **options)
    assert area_m2 == pytest.approx(48, abs=0.1)
    assert {material: in_order(lines) for material, lines in walls.items()} == {
        material: in_order(lines) for material, lines in SIDES.items()
    }


def test_a_plan_turned_in_a_national_grid_has_the_same_walls(tmp_path):
    shift = np.array([701300.0, 4485500.0])
    area_m2, walls = walls_of(drawing(tmp_path / "plan.dxf", degrees=33, shift_m=shift))
    assert area_m2 == pytest.approx(48, abs=0.1)
    for material, lines in SIDES.items():
        back = turn(walls[material] - shift, -33)
        np.testing.assert_allclose(in_order(back), in_order(lines), atol=0.01)


def test_a_window_takes_the_place_of_wall_lines_that_go_on_behind_it(tmp_path):
    _, walls = walls_of(drawing(tmp_path / "plan.dxf", more=[(1.5, -0.3, 3, -0.3), (1.5, 0, 3, 0)]))
    assert in_order(walls["itu_glass"]) == in_order(SIDES["itu_glass"])
    assert in_order(walls["itu_plasterboard"]) == in_order(SIDES["itu_plasterboard"])


def test_layers_are_known_by_the_words_of_their_names(tmp_path):
    names = ("ROHBAU - Wände - Mauerwerk", "FENSTER", "AUSBAU - Türen")
    _, walls = walls_of(drawing(tmp_path / "plan.dxf", layers=names))
    assert {material: len(lines) for material, lines in walls.items()} == {
        "itu_brick": 8,
        "itu_glass": 1,
        "itu_wood": 2,
    }


def test_unclear_layers_and_units_are_asked_for_by_their_options(tmp_path, command):
    odd = drawing(tmp_path / "odd.dxf", layers=("Layer1", "Layer3", "Layer2"))
    ask = ["mesh", odd, "--wall-height", 2.5, "--out", tmp_path / "out"]
    command.refused(ask, r"no layer is named as one of walls; .*--layers NAME,NAME, of 'Layer1' \(\d+ m\)")
    command.refused([*ask, "--layers", "Walls"], r"no layer Walls; .*'Layer1'")
    assert "8 wall" in command.done([*ask, "--layers", "Layer1"])
    for name, insunits, message in (("a", 0, "does not state the unit"), ("b", 1, "its doors 24.1 m; give the unit")):
        with pytest.raises(InputError, match=rf"{message}.*--units"):
            read_plan(drawing(tmp_path / f"{name}.dxf", insunits=insunits))
    (tmp_path / "damaged.dxf").write_text("0\nSECTION\n2\nENT")
    with pytest.raises(InputError, match="not a DXF that can be read"):
        read_plan(tmp_path / "damaged.dxf")


def test_a_scene_of_a_drawing_states_its_materials(tmp_path):
    new_scene = make_scene(drawing(tmp_path / "plan.dxf"), tmp_path / "scene", height_m=2.5)
    materials = new_scene.materials.by_surface()
    assert [materials[name] for name in ("wall_01", "wall_09", "door_01")] == [
        "itu_plasterboard",
        "itu_glass",
        "itu_wood",
    ]


def test_a_plan_of_single_lines_keeps_them():
    """A closet of 0.5 m between single lines is no wall."""
    lines = np.concatenate([box(0, 0, 6, 4), [[[0, 0.5], [1, 0.5]], [[1, 0.5], [1, 0]]]])
    middles, thick_m = middle_lines(lines)
    assert len(middles) == 6
    assert not thick_m.any()


@pytest.mark.parametrize("gap_m", [0.1, 0.4])
def test_layers_of_a_wall_are_one_wall_and_walls_about_a_niche_are_two(gap_m):
    offsets = [0, 0.1, 0.1 + gap_m, 0.2 + gap_m]
    middles, thick_m = middle_lines(np.array([[[0, y], [5, y]] for y in offsets]))
    assert sorted(thick_m) == pytest.approx([0.3] if gap_m == 0.1 else [0.1, 0.1])
    assert sorted(middles[:, 0, 1]) == pytest.approx([0.15] if gap_m == 0.1 else [0.05, 0.55])
