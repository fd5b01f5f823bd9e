"""The common motion of all planes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from correction_rooms import CARRIER_HZ, stated_scene
from scipy.spatial.transform import Rotation

from wrf_mi.correction.state import rigid_motion, rigid_motions
from wrf_mi.tracing import open_scene
from wrf_mi.tracing.search.surfaces import Surfaces, scene_surfaces

SECOND_ORDER = 5e-5
"""Metres and rad: a rotation of 1.4 mrad times a displacement of 37 mm, or its square times 5 m."""


@pytest.fixture(scope="module")
def planes(tmp_path_factory: pytest.TempPathFactory) -> Surfaces:
    return scene_surfaces(open_scene(stated_scene(tmp_path_factory.mktemp("room") / "scene"), CARRIER_HZ))


def test_motions_are_those_of_the_moved_room(planes: Any) -> None:
    """Shifted and tilted planes are the planes of the room after a small rotation and translation."""
    motion = np.array([0.01, -0.02, 0.03, 1e-3, -5e-4, 8e-4])
    count, centre = len(planes.normal), planes.plane_centres_m
    change = rigid_motions(planes) @ motion
    normal, offset = planes.moved_planes(change[:count], change[count:].reshape(count, 2))
    turn, middle = Rotation.from_rotvec(motion[3:]), centre.mean(axis=0)
    np.testing.assert_allclose(normal, turn.apply(planes.normal), atol=SECOND_ORDER)
    there = turn.apply(centre - middle) + middle + motion[:3]
    np.testing.assert_allclose((normal * there).sum(axis=1), offset, atol=SECOND_ORDER)


def test_a_motion_is_found_again_with_its_uncertainty(planes: Any) -> None:
    motion = np.array([0.01, -0.02, 0.03, 1e-3, -5e-4, 8e-4])
    rng, deviation = np.random.default_rng(0), 1e-3
    change = rigid_motions(planes) @ motion
    found = [
        rigid_motion(planes, change + rng.normal(0, deviation, len(change)), np.full(len(change), deviation**-2.0))
        for _ in range(200)
    ]
    values, stated = np.array([one[0] for one in found]), found[0][1]
    np.testing.assert_allclose(values.mean(axis=0), motion, atol=4 * stated.max() / np.sqrt(200))
    np.testing.assert_allclose(values.std(axis=0), stated, rtol=0.25)


def test_a_motion_that_no_plane_fixes_has_no_bound(planes: Any) -> None:
    count = len(planes.normal)
    precision = np.zeros(3 * count)
    upright = np.abs(planes.normal[:, 2]) > 0.9
    precision[:count][upright] = 1.0  # floor and ceiling alone
    _, deviation = rigid_motion(planes, np.zeros(3 * count), precision)
    assert np.isinf(deviation[:2]).all()
    assert np.isfinite(deviation[2])
