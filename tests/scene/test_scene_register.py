"""Registration recovers known motions, and refuses ambiguous data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_plans import L_ROOM_M, TWO_ROOMS_M, box, turn
from scipy.spatial.transform import Rotation

from wrf_mi.core import InputError
from wrf_mi.scene.plan.storey import layout_walls, plan_surfaces
from wrf_mi.scene.register import (
    best_scale,
    distance_to_walls,
    read_pairs,
    register_pairs,
    register_walls,
    sample_walls,
    wall_points,
)

L_WALLS = layout_walls(L_ROOM_M)
EXACT_M = 1e-9
"""Closed form in float64 over some metres."""
FITTED_M = 5e-3
"""Robust fit of points that lie on the walls exactly; it stops when the cost changes by 1e-8."""

shifts = st.floats(-50, 50)
angles = st.floats(-180, 180)


def moved(matrix, points):
    """Points [..., 2] or [..., 3] moved by a matrix [4, 4]."""
    n = points.shape[-1]
    return points @ matrix[:n, :n].T + matrix[:n, 3]


@given(st.lists(st.tuples(shifts, shifts, shifts), min_size=3, max_size=3), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_pairs_give_back_any_rigid_motion(rows, seed):
    rng = np.random.default_rng(seed)
    source = rng.uniform(-5, 5, (6, 3))
    rotation, shift = Rotation.random(rng=rng).as_matrix(), np.array(rows[0])
    found = register_pairs(source, source @ rotation.T + shift)
    assert np.allclose(found[:3, :3], rotation, atol=EXACT_M)
    assert np.allclose(found[:3, 3], shift, atol=1e-8)
    assert np.allclose(moved(found, source), source @ rotation.T + shift, atol=1e-8)


@given(angles, shifts, shifts)
@settings(max_examples=40, deadline=None)
def test_pairs_in_a_plane_turn_about_z(degrees, x, y):
    source = np.array([[0, 0], [4, 0], [1, 3]], float)
    target = turn(source, degrees, (x, y))
    found = register_pairs(source, target)
    assert np.allclose(moved(found, source), target, atol=1e-8)
    assert found[2].tolist() == [0, 0, 1, 0]
    # Two points are enough in a plane.
    assert np.allclose(moved(register_pairs(source[:2], target[:2]), source), target, atol=1e-8)


def test_pairs_with_errors_give_a_motion_near_the_true_one():
    source = np.array([[0, 0, 0], [4, 0, 0], [0, 4, 0], [0, 0, 2]], float)
    noise = np.random.default_rng(0).normal(0, 0.02, source.shape)
    found = register_pairs(source, source + np.array([1, 2, 3]) + noise)
    assert np.abs(moved(found, source) - source - [1, 2, 3]).max() < 0.05


@pytest.mark.parametrize(
    ("source", "target", "line"),
    [
        (np.zeros((1, 2)), np.zeros((1, 2)), "1 pairs; give at least 2"),
        (np.eye(3)[:2], np.eye(3)[:2], "2 pairs; give at least 3"),
        (np.ones((4, 2)), np.ones((4, 2)), "at one place"),
        (np.arange(12.0).reshape(4, 3), np.arange(12.0).reshape(4, 3), "on one line"),
        (np.eye(3) * 5, np.eye(3) * 6, r"disagree by .* lengths times 1.200 would fit better \(0.00 m rms\)"),
        (np.array([[0, 0], [5, 0], [0, 5.0]]), np.array([[0, 0], [0, 5.0], [5, 0]]), "pair 1 by 4.71 m: check this"),
        (np.zeros((3, 2)), np.zeros((3, 3)), "are no pairs"),
    ],
)
def test_unsuitable_pairs_are_refused(source, target, line):
    with pytest.raises(InputError, match=line) as caught:
        register_pairs(source, target, name="pairs.csv")
    assert str(caught.value).startswith("pairs.csv: ")


def test_pairs_from_a_file(tmp_path):
    file = tmp_path / "pairs.csv"
    file.write_text("x,y,to_x,to_y\n0,0,1,1\n2,0,1,3\n")
    source, target = read_pairs(file)
    assert source.tolist() == [[0, 0], [2, 0]]
    assert target.tolist() == [[1, 1], [1, 3]]
    file.write_text("x,y,z,to_x,to_y,to_z\n0,0,0,1,1\n")
    with pytest.raises(InputError, match=r"pairs.csv: row 1: 5 fields, but the header has 6"):
        read_pairs(file)
    file.write_text("a,b\n1,2\n")
    with pytest.raises(InputError, match=r"line 1: header is .a,b.; it must be x,y,z,to_x,to_y,to_z or x,y,to_x,to_y"):
        read_pairs(file)


@given(angles, shifts, shifts)
@settings(max_examples=3, deadline=None)
def test_walls_give_back_any_turn_and_shift(degrees, x, y):
    points = turn(sample_walls(L_WALLS), degrees, (x, y))
    found = register_walls(points, L_WALLS)
    corners = turn(L_ROOM_M, degrees, (x, y))
    assert np.abs(moved(found, corners) - L_ROOM_M).max() < FITTED_M
    assert best_scale(moved(found, points), np.zeros(3), L_WALLS)[0] == pytest.approx(1, abs=1e-3)


def test_walls_fit_in_spite_of_noise_furniture_and_what_is_missing():
    rng = np.random.default_rng(1)
    seen = np.concatenate([TWO_ROOMS_M[1:], box(0.5, 0.5, 1.0, 0.6)])
    points = sample_walls(seen) + rng.normal(0, 0.03, (len(sample_walls(seen)), 2))
    found = register_walls(turn(points, 140, (2, -3)), TWO_ROOMS_M)
    corners = turn(TWO_ROOMS_M.reshape(-1, 2), 140, (2, -3))
    # 3 cm of noise on some 200 points.
    assert np.abs(moved(found, corners) - TWO_ROOMS_M.reshape(-1, 2)).max() < 0.02


def test_walls_of_surfaces_are_sampled():
    surfaces = plan_surfaces(L_ROOM_M, height_m=2.5)
    points = wall_points(surfaces)
    assert distance_to_walls(points, L_WALLS).max() < EXACT_M
    assert len(points) == pytest.approx(19 / 0.1, abs=7)
    with pytest.raises(InputError, match="no wall"):
        wall_points(surfaces[:2])


@pytest.mark.parametrize(
    ("points", "walls", "line"),
    [
        (sample_walls(box(0, 0, 4, 4)), box(0, 0, 4, 4), "two poses fit the walls alike, .* degrees apart"),
        (sample_walls(box(0, 0, 6, 4)), box(0, 0, 6, 4), "two poses fit the walls alike, 180 degrees"),
        (sample_walls(L_WALLS) * [-1, 1], L_WALLS, "mirror image fits the walls better"),
        (sample_walls(L_WALLS) * 1.4, L_WALLS, r"agreement .* lengths times 0.71 would fit better \(agreement 1.00\)"),
        (sample_walls(L_WALLS) * 0.5, L_WALLS, "does not fit the walls: agreement"),
        (
            np.random.default_rng(0).uniform(0, 5, (300, 2)),
            L_WALLS,
            "other lengths fit no better",
        ),
        (np.zeros((2, 2)), L_WALLS, "needs points and walls"),
        (np.zeros((9, 2)), np.zeros((0, 2, 2)), "needs points and walls"),
    ],
)
def test_ambiguous_and_poor_fits_are_refused(points, walls, line):
    with pytest.raises(InputError, match=line) as caught:
        register_walls(points, walls, name="map.npz")
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("map.npz: ")
