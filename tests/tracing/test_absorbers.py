"""Sionna RT's absorbers: no reflection, no transmission, no constants, and none to fit."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from correction_rooms import TRUE_MATERIALS, channels, stated_scene
from traced_rooms import FREQUENCY_HZ, SHOEBOX, receiver, write_xml
from wrf_mi_scenes.mitsuba_xml import ABSORBER

from wrf_mi.cli.main import main
from wrf_mi.core import Paths
from wrf_mi.correction.correct import correct_scene, default_options
from wrf_mi.correction.page import write_page
from wrf_mi.datasets.splits import make_splits
from wrf_mi.scene.edit import Move, edit_scene
from wrf_mi.scene.materials import read_materials
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths

BRICK = '<bsdf type="diffuse" id="mat-itu_brick"/>'
SOAK = '<bsdf type="absorber-radio-material" id="mat-soak"><rgb name="color" value="0.1 0.2 0.3"/></bsdf>'
OPTIONS = TraceOptions(depth=2, transmission=True)


def absorbing(path: Path) -> Path:
    """The scene file with an absorber in the place of brick."""
    path.write_text(path.read_text().replace(BRICK, SOAK).replace("mat-itu_brick", "mat-soak"))
    return path


def paths_in(scene: Path) -> Paths:
    return trace_paths(open_scene(scene, FREQUENCY_HZ), [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), OPTIONS).paths


def test_absorbers_neither_reflect_nor_transmit(tmp_path: Path) -> None:
    """West and east walls alone are of brick, so that the room without them has the other paths."""
    room = absorbing(write_xml(tmp_path / "absorbing", SHOEBOX))
    walls = {name: part for name, part in SHOEBOX.items() if part[0] != "itu_brick"}
    paths, open_paths = paths_in(room), paths_in(write_xml(tmp_path / "open", walls))
    assert len(paths) > 8
    np.testing.assert_allclose(paths.gain, open_paths.gain, rtol=1e-6)
    screen = {"screen": ("itu_brick", SHOEBOX["west"][1].copy().apply_translation([3, 0, 0]))}
    assert not len(paths_in(absorbing(write_xml(tmp_path / "screen", {**SHOEBOX, **screen}))))


def test_paths_at_absorbers_are_dropped_without_their_gains(tmp_path: Path) -> None:
    scene = open_scene(absorbing(write_xml(tmp_path, SHOEBOX)), FREQUENCY_HZ)
    traced = trace_paths(scene, [[1.3, 2, 1]], receiver([4.4, 3.1, 1.7]), OPTIONS, gains=False)
    names = np.array([*traced.paths.object_names, ""])
    left = traced.paths
    assert len(left) == len(paths_in(tmp_path / "scene.xml"))
    assert not np.isin(names[left.objects], ["west", "east"]).any()


def test_absorbers_stay_in_exported_and_edited_scenes(tmp_path: Path) -> None:
    room, exported = absorbing(write_xml(tmp_path / "room", SHOEBOX)), tmp_path / "exported"
    facts = ["--frequency", str(FREQUENCY_HZ), "--out", str(exported)]
    assert main(["export", str(room), "--format", "sionna", *facts]) == 0
    assert json.loads((exported / "materials.json").read_text())["materials"][ABSORBER] == {"absorbs": True}
    np.testing.assert_allclose(paths_in(exported / "scene.xml").gain, paths_in(room).gain, rtol=1e-6)

    folder = stated_scene(tmp_path / "folder", {"board": ABSORBER})
    edited = edit_scene(folder, tmp_path / "edited", [Move(("board",), (0.1, 0.0, 0.0))])
    assert read_materials(edited).surfaces["board"] == ABSORBER
    for place in (folder, edited):
        assert open_scene(place, FREQUENCY_HZ).objects["board"].radio_material.name == ABSORBER


def test_correction_leaves_absorbers_alone(tmp_path: Path) -> None:
    true = stated_scene(tmp_path / "true", {**TRUE_MATERIALS, "wall_02": ABSORBER})
    stated = stated_scene(tmp_path / "stated", {"wall_02": ABSORBER})
    csi = channels(true, 70)
    power_db = 10 * np.log10(np.square(np.abs(csi.observation)).mean(axis=2)).astype(np.float32)
    record = replace(csi, task="rssi", observation=power_db, frequencies_hz=csi.frequencies_hz[:1])
    options = replace(default_options(record), rows=40, rays=4096, depth=2)
    correction = correct_scene(stated, record, make_splits(record, "official")[0], options)
    assert correction.kept == "materials+gain"
    assert {name.partition("/")[0] for name in correction.misfit.sides[0].slabs.names} == set(TRUE_MATERIALS) - {
        "wall_02"
    }
    write_page(correction, tmp_path / "page")
    assert read_materials(tmp_path / "page").surfaces["wall_02"] == ABSORBER
    assert open_scene(tmp_path / "page", FREQUENCY_HZ).objects["wall_02"].radio_material.name == ABSORBER
