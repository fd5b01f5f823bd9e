"""Plans before a fit: `check` reads them, and offers the command that makes a scene."""

import json

import pytest

from wrf_mi.apps.checking import check_scene

LAYOUT = "x,y\n0,0\n6,0\n6,5\n0,5\n0,0\n"


def test_a_plan_that_needs_no_option_is_noted_with_its_command(tmp_path):
    (tmp_path / "layout.csv").write_text(LAYOUT)
    report = check_scene(tmp_path / "layout.csv")
    (finding,) = report.findings
    assert (finding.kind, finding.level, report.shapes) == ("plan", "note", 6)
    assert finding.text == "a plan of 6.0 m x 5.0 m, 4 walls"
    assert finding.remedy.endswith("layout.csv --out SCENE --wall-height METRES")


def test_a_plan_that_needs_an_option_is_a_fault_that_names_it(tmp_path, command):
    from PIL import Image

    Image.new("L", (40, 40)).save(tmp_path / "plan.png")
    ended = command(["check", tmp_path / "plan.png"])
    assert ended.status == 2
    assert "fault    unclear-plan       a picture has no resolution; give the side of a pixel" in ended.out
    assert f"(--resolution): wrf-mi mesh {tmp_path / 'plan.png'}" in ended.out
    command.refused(["check", tmp_path / "plan.png", "--repair", tmp_path / "out"], "make a scene of it by wrf-mi mesh")


def test_buildings_without_heights_are_a_fault(tmp_path):
    pytest.importorskip("pyproj", reason="needs wrf-mi[cad]")
    ring = [[13, 52], [13.0002, 52], [13.0002, 52.0001], [13, 52.0001], [13, 52]]
    outline = {"type": "Polygon", "coordinates": [ring]}
    for height, kind in ({"height": "9"}, "plan"), ({}, "unclear-plan"):
        tags = {"building": "yes"} | height
        (tmp_path / "a.json").write_text(json.dumps({"type": "Feature", "geometry": outline, "properties": tags}))
        assert [finding.kind for finding in check_scene(tmp_path / "a.json").findings] == [kind]
