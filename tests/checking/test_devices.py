"""Receivers and transmitters inside solids of a scene, and beside its floor."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import trimesh

from wrf_mi.apps.checking.devices import DEEP_M, device_findings, in_solid
from wrf_mi.apps.checking.scene_geometry import ShapePart


def test_solids_are_those_of_the_solid_angle():
    """A box, and a ring whose middle is air."""
    places = np.random.default_rng(0).uniform(-1, 2, (400, 3))
    box = np.asarray(trimesh.creation.box(bounds=[[0.0, 0, 0], [1, 0.4, 2]]).triangles)
    deep = DEEP_M
    true = ((places >= deep) & (places <= np.array([1, 0.4, 2]) - deep)).all(axis=1)
    assert true.any()
    np.testing.assert_array_equal(in_solid(places, box), true)
    ring = np.asarray(trimesh.creation.annulus(r_min=0.5, r_max=0.8, height=2.0).triangles)
    radius, height = np.hypot(places[:, 0], places[:, 1]), np.abs(places[:, 2])
    edge = deep + 0.02  # sides are flat
    inside = in_solid(places, ring)
    within = (radius > 0.5 + edge) & (radius < 0.8 - edge) & (height < 1 - edge)
    assert within.any()
    assert inside[within].all()
    assert not inside[(radius < 0.5 - edge) | (radius > 0.8) | (height > 1)].any()


def test_positions_of_a_scene_without_floor_below_are_named():
    """A floor of 4 m x 2 m and a wall along the 8 m of the scene; a third of the positions is beside the floor."""
    floor = [[[0, 0, 0], [4, 0, 0], [4, 2, 0]], [[0, 0, 0], [4, 2, 0], [0, 2, 0]]]
    wall = [[[0, 0, 0], [8, 0, 0], [8, 0, 3]], [[0, 0, 0], [8, 0, 3], [0, 0, 3]]]
    parts = [ShapePart("room", "wood", Path("room.ply"), np.array([*floor, *wall], float))]
    inside, beside = [[1, 1, 1], [3, 0.5, 1], [2, 1, 1], [3.5, 1.5, 2]], [[6, 0, 1], [7, 0, 1]]
    receivers = [SimpleNamespace(position_m=np.array([1.0, 1, 2]))]
    cases = [np.array(rows, float) for rows in (inside + beside, [*inside, [30, 0, 1]], beside)]
    records: list[Any] = [SimpleNamespace(tx_pos_m=rows, receivers=receivers) for rows in cases]
    findings = [list(device_findings(parts, Path("room"), record)) for record in records]
    assert [[finding.kind for finding in each] for each in findings] == [["no-floor"], [], []]
    assert "2 of 6 transmitters inside the scene, first number 5, have no floor" in findings[0][0].text
