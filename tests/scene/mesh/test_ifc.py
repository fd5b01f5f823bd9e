"""Building models in IFC: elements become surfaces with kinds, names and materials, in metres."""

import numpy as np
import pytest

from wrf_mi.apps.checking import check_scene
from wrf_mi.scene.edit import read_surfaces
from wrf_mi.scene.make import make_scene
from wrf_mi.scene.mesh.surfaces import box_of

ifcopenshell = pytest.importorskip("ifcopenshell", reason="needs wrf-mi[bim]")
for part in ("context", "feature", "geometry", "material", "project", "root", "spatial", "unit"):
    __import__(f"ifcopenshell.api.{part}")
api = ifcopenshell.api

OUTLINE_M = [(-0.2, -0.2), (6.2, -0.2), (6.2, 4.2), (-0.2, 4.2), (-0.2, -0.2)]


def model(path, version="IFC4", metres=False, shift_m=(0.0, 0.0, 0.0)):
    """A room of 6 m x 4 m x 2.5 m with walls of 0.2 m, a door in an opening, a window, a column and a table."""
    file = api.project.create_file(version)
    project = api.root.create_entity(file, "IfcProject")
    metre = {"length": {"is_metric": True, "raw": "METERS"}} if metres else {}
    api.unit.assign_unit(file, **metre)
    space = api.context.add_context(file, "Model")
    body = api.context.add_context(file, "Model", "Body", "MODEL_VIEW", space)
    assert project

    def box(length, height, thick):
        return api.geometry.add_wall_representation(file, body, length=length, height=height, thickness=thick)

    def slab():
        return api.geometry.add_slab_representation(file, body, depth=0.2, polyline=OUTLINE_M)

    def put(kind, shape, place_m, names=(), turned=False, **more):
        element = api.root.create_entity(file, kind, name=kind, **more)
        matrix = np.eye(4)
        matrix[:2, :2] = [[0, -1], [1, 0]] if turned else np.eye(2)
        matrix[:3, 3] = np.add(place_m, shift_m)
        api.geometry.edit_object_placement(file, element, matrix)
        api.geometry.assign_representation(file, element, shape)
        if names:
            layers = api.material.add_material_set(file, set_type="IfcMaterialLayerSet")
            for thick, name in names:
                layer = api.material.add_layer(file, layers, api.material.add_material(file, name=name))
                api.material.edit_layer(file, layer, {"LayerThickness": thick})
            api.material.assign_material(file, [element], material=layers)
        return element

    concrete = [(0.02, "Gipsputz"), (0.18, "Stahlbeton C30/37")]
    south = put("IfcWall", box(6.4, 2.5, 0.2), (-0.2, -0.2, 0), concrete)
    put("IfcWall", box(6.4, 2.5, 0.2), (-0.2, 4, 0), [(0.1, "Metal Stud Layer")])
    put("IfcWall", box(4, 2.5, 0.2), (0, 0, 0), [(0.2, "Backstein XY")], turned=True)
    put("IfcWall", box(4, 2.5, 0.2), (6.2, 0, 0), turned=True)
    put("IfcSlab", slab(), (0, 0, -0.2), concrete, predefined_type="FLOOR")
    put("IfcSlab", slab(), (0, 0, 2.5), predefined_type="FLOOR")
    opening = put("IfcOpeningElement", box(1, 2, 0.2), (1, -0.2, 0))
    api.feature.add_feature(file, opening, south)
    put("IfcDoor", box(1, 2, 0.05), (1, -0.1, 0), [(0.05, "Holz")])
    put("IfcWindow", box(1, 1, 0.02), (3, 3.9, 1))
    put("IfcColumn", box(0.3, 2.5, 0.3), (5, 1, 0))
    put("IfcFurniture", box(1.5, 0.7, 0.8), (2, 2, 0))
    put("IfcSpace", box(6, 2.4, 4), (0, 0, 0))
    file.write(str(path))
    return path


@pytest.mark.parametrize(("version", "metres"), [("IFC4", False), ("IFC4X3", True)])
def test_elements_are_surfaces_in_metres_with_materials_by_their_names(tmp_path, caplog, version, metres):
    new_scene = make_scene(model(tmp_path / "a.ifc", version, metres), tmp_path / "scene")
    surfaces = {surface.name: surface for surface in read_surfaces(new_scene.folder)[0]}
    kinds = {name: surface.kind for name, surface in surfaces.items()}
    walls = {f"wall_0{number}": "wall" for number in range(1, 5)}
    others = dict.fromkeys(["door", "window", "column", "furniture"], "other")
    # The upper slab is of the class of floors, and nothing stands on it.
    assert kinds == walls | others | {"floor": "floor", "ceiling": "ceiling"}
    materials = new_scene.materials.by_surface()
    assert [materials[f"wall_0{number}"] for number in range(1, 5)] == ["itu_concrete", *["itu_plasterboard"] * 3]
    assert [materials[name] for name in ("door", "window", "column")] == ["itu_wood", "itu_glass", "itu_concrete"]
    assert "Backstein XY" in caplog.text
    boxes_m = {"wall_04": [6, 0, 0, 6.2, 4, 2.5], "floor": [-0.2, -0.2, -0.2, 6.2, 4.2, 0]}
    for name, box_m in boxes_m.items():
        assert box_of([surfaces[name]]).ravel() == pytest.approx(box_m, abs=1e-6)
    # The opening is cut out: both sides without it, its reveals, the ends, top and the rest of the foot.
    assert surfaces["wall_01"].mesh.area == pytest.approx(2 * (6.4 * 2.5 - 2) + 0.2 * (2 * 2 + 1 + 2 * 2.5 + 6.4 + 5.4))


def test_a_model_in_a_national_grid_gets_an_origin(tmp_path):
    new_scene = make_scene(model(tmp_path / "a.ifc", shift_m=(701300.0, 4485500.0, 30.0)), tmp_path / "scene")
    assert new_scene.origin_m == (701200, 4485400, 0)
    assert box_of(read_surfaces(new_scene.folder)[0])[0] == pytest.approx([99.8, 99.8, 29.8], abs=1e-3)


def test_the_floor_is_counted_once_and_options_that_the_file_states_are_refused(tmp_path, command):
    words = ["mesh", model(tmp_path / "a.ifc"), "--out", tmp_path / "scene"]
    command.refused([*words, "--units", "mm"], "states its unit and has z up; leave out --units and --up")
    assert "floor: 28.2 m2" in command.done(words)
    (tmp_path / "b.ifc").write_text("ISO-10303-21;")
    command.refused(["mesh", tmp_path / "b.ifc", "--out", tmp_path / "out"], "not an IFC that can be read")


def test_check_opens_a_model_without_alarm(tmp_path):
    report = check_scene(model(tmp_path / "a.ifc"))
    assert report.ok
    assert report.shapes == 10
