"""The NumPy oracle against closed forms, symmetries and sampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from wrf_mi_bench import field_oracle as oracle

from wrf_mi.core import Receiver, azimuth_elevation, pixel_directions, rotation_matrix, unit_vectors
from wrf_mi.core.angles import FloatArray
from wrf_mi.gaussians.footprint import CUTOFF, LOW_PASS_RAD, MIN_COSINE, NEAR_M

EXACT = 1e-12
"""A few roundings of float64 on values near one."""
POSED = 1e-9
"""As EXACT, after turning and moving everything by metres; footprints amplify by up to d / (s_min) m ~ 1e3."""
SAMPLED = 0.02
"""A variance of 200,000 samples scatters by sqrt(2 / n) = 0.3 %, and the tangent plane leaves (s / d)^2 = 1e-4."""

ORIGIN = Receiver("origin", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
PLAIN = np.array([[0.0, 0.0, 0.0, 1.0]])


def paper_jacobian_covariance(centre_m: ArrayLike, covariance_m2: ArrayLike, height: int, width: int) -> FloatArray:
    """The papers' J Sigma J^T [n, 2, 2] of the equirectangular map at centres [n, 3], in pixels squared, column first.

    Its column variance grows as 1 / cos^2(elevation). Source: WRF-GS+, the projection model; Zwicker et al., "EWA
    splatting" (2002).
    """
    x, y, z = np.moveaxis(np.asarray(centre_m, float), -1, 0)
    ground, distance = np.hypot(x, y), np.sqrt(x * x + y * y + z * z)
    longitude = np.stack([-y, x, np.zeros_like(x)], axis=-1) / ground[:, None] ** 2
    latitude = np.stack([-x * z, -y * z, ground**2], axis=-1) / (ground * distance**2)[:, None]
    jacobian = np.stack([longitude * width / (2 * np.pi), latitude * height / (np.pi / 2)], axis=-2)
    return jacobian @ np.asarray(covariance_m2, float) @ np.swapaxes(jacobian, -1, -2)


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


def test_tangent_basis_is_orthonormal_everywhere():
    directions = np.concatenate([pixel_directions(7, 12).reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    frame = np.concatenate([directions[:, None], oracle.tangent_basis(directions)], axis=1)
    assert frame @ np.swapaxes(frame, 1, 2) == pytest.approx(np.broadcast_to(np.eye(3), frame.shape), abs=EXACT)
    assert np.linalg.det(frame) == pytest.approx(1, abs=EXACT)


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


@settings(max_examples=25, deadline=None)
@given(seeds)
def test_render_is_invariant_to_storage_order_at_equal_depth(seed):
    rng = np.random.default_rng(seed)
    field = random_field(rng, 6) | {"opacity": rng.uniform(0, 1, 6)}
    field["mean_m"][3:] = [[0, 0, 2], [0, 2, 0], [2, 0, 0]]
    field["scale_m"][3:] = 2.0  # so that all three overlap
    order = rng.permutation(6)
    assert np.array_equal(image_of(field), image_of({name: value[order] for name, value in field.items()}))


@settings(max_examples=25, deadline=None)
@given(seeds, st.complex_numbers(max_magnitude=5), st.booleans())
def test_field_is_linear_in_the_signal(seed, factor, product):
    rng = np.random.default_rng(seed)
    field, second = random_field(rng, 5), random_field(rng, 5)["signal"]
    field |= {"attenuation": random_delta(rng, 5)} if product else {"opacity": rng.uniform(0, 1, 5)}
    signals = field["signal"], second, field["signal"] + factor * second
    a, b, mixed = (image_of(field | {"signal": signal}, size=(9, 18)) for signal in signals)
    assert mixed == pytest.approx(a + factor * b, abs=1e2 * EXACT)


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


def test_papers_jacobian_is_the_derivative_of_the_pixel_coordinates():
    rng, centre, step = np.random.default_rng(1), np.array([-1.0, 2.0, 1.5]), 1e-6

    def pixels(point):
        return np.array(azimuth_elevation(point)) * [180 / (2 * np.pi), 45 / (np.pi / 2)]

    jacobian = np.stack([(pixels(centre + e) - pixels(centre - e)) / (2 * step) for e in step * np.eye(3)], axis=1)
    sigma = oracle.covariance_matrix(rng.uniform(0.1, 1, (1, 3)), rng.standard_normal((1, 4)))
    ours = paper_jacobian_covariance(centre[None], sigma, 45, 180)[0]
    assert ours == pytest.approx(jacobian @ sigma[0] @ jacobian.T, rel=1e-6)  # central differences in float64


@pytest.mark.parametrize("elevation_deg", [0, 2, 60, 89])
def test_covariance_of_the_paper_is_stretched_in_azimuth(elevation_deg):
    """Equal in pixels at the horizon; the azimuth's standard deviation is 1 / cos(elevation) times ours above."""
    rng = np.random.default_rng(2)
    mean = 3 * at(50, elevation_deg)[None]
    scale, quaternion = rng.uniform(0.01, 0.1, (1, 3)), rng.standard_normal((1, 4))
    ours = oracle.project(mean, scale, quaternion, ORIGIN).covariance[0] - LOW_PASS_RAD**2 * np.eye(2)
    stretch = np.diag([1 / np.cos(np.radians(elevation_deg)), 1]) * 180 / np.pi
    paper = paper_jacobian_covariance(mean, oracle.covariance_matrix(scale, quaternion), 90, 360)[0]
    assert paper == pytest.approx(stretch @ ours @ stretch, rel=POSED)


def both_footprints(elevation_deg, sigma_rad, directions):
    """Of a round Gaussian at azimuth 100: ours, and exp(-m^2 / 2) on the pixel plane with the paper's covariance."""
    centre = at(100, elevation_deg)
    ours = oracle.footprint(single(centre, 2.0, 2.0 * np.sqrt(sigma_rad**2 - LOW_PASS_RAD**2)), 0, directions)
    covariance = paper_jacobian_covariance(2.0 * centre[None], (2.0 * sigma_rad) ** 2 * np.eye(3)[None], 90, 360)[0]
    azimuth, elevation = np.degrees(azimuth_elevation(directions))
    offset = np.stack([(azimuth + 80) % 360 - 180, elevation - elevation_deg], axis=-1)
    return ours, np.exp(-np.einsum("...i,ij,...j->...", offset, np.linalg.inv(covariance), offset) / 2)


def test_covariances_agree_to_first_order_at_the_horizon():
    """Within two standard deviations of the centre the difference is of second order: each halving quarters it."""
    departures = []
    for sigma in np.radians([4.0, 2.0, 1.0]):
        azimuth, elevation = np.meshgrid(*[np.linspace(-2, 2, 21) * sigma] * 2)
        ours, paper = both_footprints(0, sigma, unit_vectors(azimuth + np.radians(100), elevation))
        departures.append(np.abs(ours - paper).max())
    assert departures[-1] < 1e-3
    assert np.divide(departures[:-1], departures[1:]) == pytest.approx(4, rel=0.1)


def test_covariances_differ_near_the_zenith_like_the_map():
    """Two degrees from the zenith, 180 columns away is 4 degrees away; the paper's plane makes it 180 / 86 widths."""
    ours, paper = both_footprints(88, np.radians(3), at(280, 88))
    assert ours == pytest.approx(np.exp(-((np.tan(np.radians(4)) / np.radians(3)) ** 2) / 2), rel=POSED)
    assert paper == pytest.approx(np.exp(-((180 * np.cos(np.radians(88)) / 3) ** 2) / 2), rel=POSED)
    assert ours > 3 * paper
