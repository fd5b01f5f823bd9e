"""Small files that would take gigabytes, and names that leave their folder."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from PIL import Image
from wrf_mi_scenes.mitsuba_xml import scene_xml

from wrf_mi.core import InputError
from wrf_mi.core.files import inside, one_line
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.datasets import load
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.scan.points import read_points
from wrf_mi.scene.xml_file import read_scene_xml


def test_aliases_of_aliases_are_refused(tmp_path: Path) -> None:
    lines = ["a0: &a0 [x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10))]
    (tmp_path / "bomb.yml").write_text("\n".join(lines))
    with pytest.raises(InputError, match="more than 1000000 values with its aliases written out"):
        read_yaml(tmp_path / "bomb.yml")
    (tmp_path / "own.yml").write_text("a: &a [*a]")
    with pytest.raises(InputError, match="an alias of what holds it"):
        read_yaml(tmp_path / "own.yml")
    (tmp_path / "fine.yml").write_text("a: &a [1, 2]\nb: *a")
    assert read_yaml(tmp_path / "fine.yml") == {"a": [1, 2], "b": [1, 2]}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("dataset_name", "array: {rows: 100000, columns: 100000, spacing_m: 0.1}\ndataset_name", "give 16384 at most"),
        ("gateway1:", "..:", "cannot name a folder"),
    ],
)
def test_a_receivers_file_that_asks_for_too_much_is_refused(
    old: str, new: str, message: str, folder: Path, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    data.symlink_to(folder)
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in folder.iterdir():
        if path.name != "gateway_info.yml":
            (copy / path.name).symlink_to(path)
    text = (folder / "gateway_info.yml").read_text()
    name = next(line for line in text.splitlines() if line.endswith(":"))
    (copy / "gateway_info.yml").write_text(text.replace(name if old == "gateway1:" else old, new, 1))
    with pytest.raises(InputError, match=message):
        load(copy)


def test_pictures_are_measured_before_they_are_decoded(tmp_path: Path) -> None:
    Image.new("1", (9_000, 9_000)).save(tmp_path / "plan.png")
    with pytest.raises(InputError, match="9000 x 9000 pixels; at most 16,000,000 are read"):
        read_plan(tmp_path / "plan.png", 0.1)


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    assert inside(tmp_path, "meshes/a.ply", tmp_path) == tmp_path / "meshes/a.ply"
    for name in ("../a", "/etc/passwd", "a/../../b", "", 5, None, "a" * 5000):
        with pytest.raises(InputError, match=r"outside its folder|no name of a file"):
            inside(tmp_path, name, tmp_path / "scene.yml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><scene>&b;</scene>', "document type or entities"),
        ('<scene><include filename="x.xml"/></scene>', "element <include> does not belong into a scene"),
        ('<scene><shape type="../evil"/></scene>', "plugin '../evil' of <shape>"),
        ('<scene><shape type="ply"><string name="filename" value="../x.ply"/></shape></scene>', "outside its folder"),
        ("<scene/>", 'not with a scene and its version; write <scene version="3.0.0">'),
        ("<scene>" + "<transform>" * 80 + "</transform>" * 80 + "</scene>", "more than 64 levels"),
    ],
)
def test_scene_files_name_known_plugins_and_their_own_files(content: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "scene.xml"
    file.write_text(content)
    with pytest.raises(InputError, match=message):
        read_scene_xml(file)
    file.write_text(scene_xml({"floor": "itu_concrete", "wall": "perfect"}))
    assert read_scene_xml(file).tag == "scene"


def test_faces_without_their_vertices_are_refused(tmp_path: Path) -> None:
    (tmp_path / "bad.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n")
    with pytest.raises(InputError, match="cannot be read as a mesh"):
        mesh_parts(tmp_path / "bad.obj")


def test_vertices_of_two_coordinates_are_refused(tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0\nv 1 0\nv 1 1\nf 1 2 3\n")
    with pytest.raises(InputError, match=r"line 1: a vertex of 2 numbers; expected 3"):
        mesh_parts(tmp_path / "flat.obj")


@pytest.mark.parametrize(("at", "what"), [(100, "records"), (243, "extended records")])
def test_a_scan_that_states_records_without_end_is_refused(at: int, what: str, tmp_path: Path) -> None:
    cloud = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4"))
    cloud.xyz = np.zeros((5, 3))
    cloud.write(tmp_path / "cloud.las")
    content = bytearray((tmp_path / "cloud.las").read_bytes())
    content[at : at + 4] = b"\xff" * 4
    (tmp_path / "cloud.las").write_bytes(content)
    with pytest.raises(InputError, match=f"states 4294967295 {what}, and has"):
        read_points(tmp_path / "cloud.las")


def test_messages_of_other_libraries_are_short() -> None:
    assert len(one_line(ValueError("1" * 5000))) < 500
