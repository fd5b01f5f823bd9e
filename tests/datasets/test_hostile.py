"""Small files that would take gigabytes, and names that leave their folder."""

import io
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from changed_folders import error_line, refusal, text
from PIL import Image
from wrf_mi_scenes.mitsuba_xml import scene_xml

from wrf_mi.core.files import inside, one_line
from wrf_mi.core.yaml_files import read_yaml
from wrf_mi.datasets import load
from wrf_mi.scene.mesh.files import mesh_parts
from wrf_mi.scene.plan.sources import read_plan
from wrf_mi.scene.scan.points import read_points
from wrf_mi.scene.xml_file import read_scene_xml


def picture(size: int) -> bytes:
    stream = io.BytesIO()
    Image.new("1", (size, size)).save(stream, "png")
    return stream.getvalue()


def cloud(at: int) -> bytes:
    """A scan that states records without end at a place of its header."""
    scan, stream = laspy.LasData(laspy.LasHeader(point_format=6, version="1.4")), io.BytesIO()
    scan.xyz = np.zeros((5, 3))
    scan.write(stream)
    content = stream.getvalue()
    return content[:at] + b"\xff" * 4 + content[at + 4 :]


BOMB = ["a0: &a0 [x]", *(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10))]
REFUSED: list[tuple[Callable[..., Any], str, str | bytes, str]] = [  # reader, name and content of a file, and message
    (read_yaml, "bomb.yml", "\n".join(BOMB), "more than 1000000 values with its aliases written out"),
    (read_yaml, "own.yml", "a: &a [*a]", "an alias of what holds it"),
    (read_plan, "plan.png", picture(9_000), "9000 x 9000 pixels; at most 16,000,000 are read"),
    (mesh_parts, "bad.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "cannot be read as a mesh"),
    (mesh_parts, "flat.obj", "v 0 0\nv 1 0\nv 1 1\nf 1 2 3\n", r"line 1: a vertex of 2 numbers; expected 3"),
    (read_points, "cloud.las", cloud(100), "states 4294967295 records, and has"),
    (read_points, "cloud.las", cloud(243), "states 4294967295 extended records, and has"),
    *(
        (read_scene_xml, "scene.xml", content, message)
        for content, message in (
            ('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><scene>&b;</scene>', "document type or entities"),
            ('<scene><include filename="x.xml"/></scene>', "element <include> does not belong into a scene"),
            ('<scene><shape type="../evil"/></scene>', "plugin '../evil' of <shape>"),
            (
                '<scene><shape type="ply"><string name="filename" value="../x.ply"/></shape></scene>',
                "outside its folder",
            ),
            ("<scene/>", 'not with a scene and its version; write <scene version="3.0.0">'),
            ("<scene>" + "<transform>" * 80 + "</transform>" * 80 + "</scene>", "more than 64 levels"),
        )
    ),
]


@pytest.mark.parametrize(("read", "name", "content", "message"), REFUSED)
def test_files_that_mean_harm_are_refused(read: Any, name: str, content: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content.encode() if isinstance(content, str) else content)
    error_line(read, tmp_path / name, *([0.1] if read is read_plan else []), message)


def test_aliases_and_scenes_of_known_plugins_are_read(tmp_path: Path) -> None:
    (tmp_path / "fine.yml").write_text("a: &a [1, 2]\nb: *a")
    assert read_yaml(tmp_path / "fine.yml") == {"a": [1, 2], "b": [1, 2]}
    (tmp_path / "scene.xml").write_text(scene_xml({"floor": "itu_concrete", "wall": "perfect"}))
    assert read_scene_xml(tmp_path / "scene.xml").tag == "scene"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("^dataset_name", r"array: {rows: 100000, columns: 100000, spacing_m: 1}\ndataset_name", "give 16384 at most"),
        (r"^\w+:$", "..:", "cannot name a folder"),
    ],
)
def test_receivers_that_ask_for_too_much_are_refused(old: str, new: str, message: str, folder: Path, tmp_path: Path):
    copy = shutil.copytree(folder, tmp_path / "copy")
    text("gateway_info.yml", old, new)(copy)
    refusal(load, copy, message)


def test_names_stay_in_their_folder(tmp_path: Path) -> None:
    assert inside(tmp_path, "meshes/a.ply", tmp_path) == tmp_path / "meshes/a.ply"
    for name in ("../a", "/etc/passwd", "a/../../b", "", 5, None, "a" * 5000):
        refusal(inside, tmp_path, name, tmp_path / "scene.yml", r"outside its folder|no name of a file")


def test_messages_of_other_libraries_are_short() -> None:
    assert len(one_line(ValueError("1" * 5000))) < 500
