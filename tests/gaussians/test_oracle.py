"""The NumPy oracle against closed forms, symmetries and sampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.core import Receiver, pixel_directions, rotation_matrix, unit_vectors
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M

EXACT = 1e-12
"""A few roundings of float64 on values near one."""
POSED = 1e-9
"""As EXACT, after turning and moving everything by metres; footprints amplify by up to d / (s_min) m ~ 1e3."""
SAMPLED = 0.02
"""A variance of 200,000 samples scatters by sqrt(2 / n) = 0.3 %, and the tangent plane leaves (s / d)^2 = 1e-4."""

ORIGIN = Receiver("origin", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
PLAIN = np.array([[0.0, 0.0, 0.0, 1.0]])


def at(azimuth_deg, elevation_deg):
    return unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg))


def single(direction, depth_m, scale_m, quaternion=PLAIN):
    """Projection of one Gaussian; ``scale_m`` a number or three."""
    return oracle.project(np.atleast_2d(direction) * depth_m, np.broadcast_to(scale_m, (1, 3)), quaternion, ORIGIN)


def random_field(rng, n):
    mean, scale, quaternion, re, im = (rng.standard_normal((n, k)) for k in (3, 3, 4, 1, 1))
    scale = np.clip(0.25 * np.exp(0.6 * scale), 0.05, 0.6)
    return {
        "mean_m": 2 * mean + [0, 0, 1.5],
        "scale_m": scale,
        "quaternion_xyzw": quaternion,
        "signal": (re + 1j * im)[:, 0],
    }


def image_of(field, receiver=ORIGIN, size=(9, 36), **blending):
    return oracle.render(**field, receiver=receiver, directions=pixel_directions(*size), **blending)


def random_delta(rng, n):
    return rng.uniform(0, 1, n) * np.exp(1j * rng.uniform(0, 6, n))


def turned(field, quaternion, shift):
    """The field after the rigid motion x -> R x + shift."""
    turn = rotation_matrix(quaternion)
    x, y, z, w = quaternion
    product = np.array([[w, -z, y, x], [z, w, -x, y], [-y, x, w, z], [-x, -y, -z, w]])
    return field | {"mean_m": field["mean_m"] @ turn.T + shift, "quaternion_xyzw": field["quaternion_xyzw"] @ product.T}


@pytest.mark.parametrize("centre_deg", [(0, 0), (359.5, 20), (123, 78), (40, 90), (200, -5)])
@pytest.mark.parametrize(("scale_m", "depth_m"), [(0.1, 2.0), (0.5, 1.0), (0.02, 8.0)])
def test_isotropic_gaussian_has_the_closed_form(centre_deg, scale_m, depth_m):
    directions = pixel_directions(45, 90)
    cosine = directions @ at(*centre_deg)
    tangent_squared = np.maximum(1 / cosine**2 - 1, 0)
    squared = tangent_squared / ((scale_m / depth_m) ** 2 + LOW_PASS_RAD**2)
    expected = np.where((cosine > MIN_COSINE) & (squared < CUTOFF**2), np.exp(-squared / 2), 0)
    assert oracle.footprint(single(at(*centre_deg), depth_m, scale_m), 0, directions) == pytest.approx(
        expected, abs=POSED
    )


def test_footprint_is_cut_at_three_standard_deviations():
    sigma = 0.1
    gaussian = single([1, 0, 0], 1.0, np.sqrt(sigma**2 - LOW_PASS_RAD**2))
    for factor, expected in [(2.999, np.exp(-(2.999**2) / 2)), (3.001, 0.0)]:
        azimuth = np.degrees(np.arctan(factor * sigma))
        assert oracle.footprint(gaussian, 0, at(azimuth, 0)) == pytest.approx(expected, abs=EXACT)


def test_footprint_axes_follow_the_gaussian_axes():
    """At azimuth 90 the eastward axis is -x and the zenithward one z; the radial one (y) does not matter."""
    quarter = np.array([[0, np.sin(np.pi / 4), 0, np.cos(np.pi / 4)]])  # about y: swaps x and z
    expected = np.diag([0.1**2, 0.03**2]) + LOW_PASS_RAD**2 * np.eye(2)
    for turn, covariance in ((PLAIN, expected), (quarter, expected[::-1, ::-1])):
        gaussian = single([0, 1, 0], 2.0, [0.2, 5.0, 0.06], turn)
        assert gaussian.covariance[0] == pytest.approx(covariance, abs=EXACT)


def test_covariance_is_that_of_sampled_directions():
    rng, mean = np.random.default_rng(0), np.array([1.0, 2.0, 3.0])
    scale, quaternion = np.array([[0.01, 0.03, 0.02]]), rng.standard_normal((1, 4))
    projected = oracle.project(mean[None], scale, quaternion, ORIGIN)
    points = mean + rng.standard_normal((200_000, 3)) * scale @ rotation_matrix(quaternion[0]).T
    plane = points @ projected.basis[0].T / (points @ projected.direction[0])[:, None]
    expected = projected.covariance[0] - LOW_PASS_RAD**2 * np.eye(2)
    assert np.cov(plane.T) == pytest.approx(expected, abs=SAMPLED * expected.max())


def test_large_gaussian_does_not_reach_behind():
    directions = pixel_directions(30, 60)
    reached = oracle.footprint(single([1, 0, 0], 1.0, 50.0), 0, directions) > 0
    assert np.array_equal(reached, directions[..., 0] > MIN_COSINE)


def test_only_gaussians_nearer_than_the_limit_are_skipped():
    near, far = single([0, 0, 1], NEAR_M * 0.999, 1.0), single([0, 0, 1], NEAR_M * 1.001, 1.0)
    assert len(near.order) == 0
    assert not oracle.footprint(near, 0, pixel_directions(10, 10)).any()
    assert oracle.footprint(far, 0, at(0, 90)) == pytest.approx(1, abs=EXACT)
    at_receiver = oracle.project(np.zeros((1, 3)), np.ones((1, 3)), PLAIN, ORIGIN)
    assert len(at_receiver.order) == 0


def test_centre_below_the_horizon_reaches_above_it():
    image = oracle.footprint(single(at(30, -3), 1.0, 0.1), 0, pixel_directions(90, 360))
    assert image.max() == image[0, 30] > 0.8


def test_footprint_is_round_at_the_zenith_and_crosses_it_nearby():
    overhead = oracle.footprint(single([0, 0, 1], 1.0, 0.1), 0, pixel_directions(90, 360))
    assert np.ptp(overhead, axis=1) == pytest.approx(0, abs=EXACT)
    beyond = oracle.footprint(single(at(10, 88), 1.0, 0.1), 0, at(190, 88))
    assert beyond == pytest.approx(np.exp(-(np.tan(np.radians(4)) ** 2) / (0.01 + LOW_PASS_RAD**2) / 2), abs=EXACT)


seeds = st.integers(0, 2**32 - 1)


def assert_same(a, b):
    """Equal, but for one pixel that may lie on a cut-off to the last digit and fall to either side."""
    assert np.count_nonzero(np.abs(a - b) > POSED) <= 1


@settings(max_examples=25, deadline=None)
@given(seeds, st.integers(1, 35))
def test_rotation_about_the_normal_shifts_the_columns(seed, columns):
    rng = np.random.default_rng(seed)
    field, opacity, half = random_field(rng, 6), rng.uniform(0, 1, 6), np.pi * columns / 36
    rotated = turned(field, np.array([0, 0, np.sin(half), np.cos(half)]), 0)
    assert_same(image_of(rotated, opacity=opacity), np.roll(image_of(field, opacity=opacity), columns, axis=1))


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_render_is_invariant_to_rigid_motion_of_field_and_receiver(seed):
    rng = np.random.default_rng(seed)
    field, delta = random_field(rng, 6), random_delta(rng, 6)
    quaternion, shift = rng.standard_normal(4), rng.standard_normal(3)
    quaternion /= np.linalg.norm(quaternion)
    posed, rotated = Receiver("posed", shift, quaternion), turned(field, quaternion, shift)
    assert_same(image_of(rotated, posed, attenuation=delta), image_of(field, attenuation=delta))


def test_blending_of_two_gaussians_matches_the_formula():
    g, s = np.array([0.8, 0.5]), np.array([1 + 2j, -3j])
    delta, opacity = np.array([0.5j, 0.3]), np.array([0.9, 0.4])
    assert oracle.blend_product(g, s, delta) == pytest.approx(
        0.8 * s[0] + 0.5 * s[1] * (1 - 0.8 * (1 - 0.5j)), abs=EXACT
    )
    assert oracle.blend_alpha(g, s, opacity) == pytest.approx(0.72 * s[0] + 0.2 * s[1] * (1 - 0.72), abs=EXACT)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_blending_rules_agree_in_limits(seed):
    rng = np.random.default_rng(seed)
    g, s, opacity = rng.uniform(0, 1, (7, 4)), rng.standard_normal(7) + 1j, rng.uniform(0, 1, 7)
    # Attenuation zero is opacity one; attenuation one hides nothing; full footprints are the paper's equations.
    assert oracle.blend_product(g, s, np.zeros(7)) == pytest.approx(oracle.blend_alpha(g, s, np.ones(7)), abs=EXACT)
    assert oracle.blend_product(g, s, np.ones(7)) == pytest.approx(s @ g, abs=1e2 * EXACT)
    delta = random_delta(rng, 7)
    paper = sum(np.prod(delta[:i]) * s[i] for i in range(7))
    assert oracle.blend_product(np.ones(7), s, delta) == pytest.approx(paper, abs=EXACT)
    # Weights of the alpha blend are a partition: equal signals give that signal times the opaque share.
    covered = 1 - np.prod(1 - opacity[:, None] * g, axis=0)
    assert oracle.blend_alpha(g, np.full(7, 2j), opacity) == pytest.approx(2j * covered, abs=EXACT)


def test_render_requires_exactly_one_blending_rule():
    field = random_field(np.random.default_rng(0), 2)
    with pytest.raises(TypeError, match="either"):
        image_of(field, size=(2, 2))
    image = image_of({name: value[:0] for name, value in field.items()}, size=(2, 3), opacity=np.zeros(0))
    assert image.shape == (2, 3)
    assert not image.any()
