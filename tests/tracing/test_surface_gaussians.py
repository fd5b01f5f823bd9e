"""Gaussians on surfaces that change traced paths: weights, factors, derivatives."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, HEIGHT, LENGTH, WALLS, WIDTH, receiver, room, transmitters
from double_precision import Tensor64
from traced_rooms import write_xml
from wrf_mi_scenes.build_laboratory import sheet

import wrf_mi
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Receiver, Record
from wrf_mi.receivers.instruments import Instrument
from wrf_mi.tracing import RayTracer, TraceOptions
from wrf_mi.tracing.options import DISC, FACTOR
from wrf_mi.tracing.paths.surface_gaussians import NEAREST, SIZE, Interactions, SurfaceGaussians
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions

SPACING_M = 0.5
UP, EAST = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
FLOAT32 = 1e-6  # Relative; centres are stored in single precision


def on_floor(*places, height_m=0.0, normal=UP):
    position = np.array([[x, y, height_m] for x, y in places])
    return Interactions(position, np.broadcast_to(normal, position.shape))


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return room(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING})


def traced(scene, depth=2):
    return TracedField(scene, transmitters(6), receiver(), TracedOptions(TraceOptions(depth=depth, rays=4096)))


def covered(side):
    """Gaussians where its paths meet surfaces, attached."""
    gaussians = SurfaceGaussians.covering(side.interactions, SPACING_M)
    side.attach(gaussians)
    return gaussians


def gain(side, parameters, rows=None):
    re, im = side(parameters, rows).gain
    return re.numpy() + 1j * im.numpy()


def test_weights_are_gaussians_of_the_distance_on_the_same_plane():
    """Points at another height or on a wall are not on the floor, however near."""
    discs = np.array([[0.0, 0, 0, 0, 0, 1], [0.6, 0, 0, 0, 0, 1]]).T
    gaussians = SurfaceGaussians(discs, SIZE * SPACING_M)
    index, weight = gaussians.near(on_floor((0.2, 0.1)))
    expected = np.exp(-np.array([0.04 + 0.01, 0.16 + 0.01]) / (2 * (SIZE * SPACING_M) ** 2))
    np.testing.assert_allclose(np.bincount(index[0], weight[0]), expected, rtol=FLOAT32)
    assert np.count_nonzero(weight) == 2
    place = (0.2, 0.1)
    for far in (on_floor(place, height_m=0.1), on_floor(place, normal=EAST), on_floor((9.0, 9.0))):
        assert not gaussians.near(far)[1].any()


def test_gaussians_cover_each_plane_where_enough_paths_meet_it():
    """Two parallel planes within a cell get Gaussians of their own, a cell of few points none."""
    places = [tuple(place) for place in np.random.default_rng(0).uniform(-0.2, 0.2, (8, 2))]
    groups = on_floor(*places), on_floor(*places, height_m=0.1), on_floor((3.0, 3.0))
    gaussians = SurfaceGaussians.covering(Interactions(*map(np.concatenate, zip(*groups, strict=True))), SPACING_M)
    assert len(gaussians) == 2
    np.testing.assert_allclose(np.sort(gaussians.discs[2]), [0, 0.1], atol=FLOAT32)
    np.testing.assert_allclose(gaussians.discs[:2].T, [np.mean(places, axis=0)] * 2, atol=FLOAT32)
    assert (gaussians.discs[5] == 1).all()


def test_parameters_restore_the_same_gaussians():
    places = [tuple(place) for place in np.random.default_rng(1).uniform(0, 3, (200, 2))]
    gaussians = SurfaceGaussians.covering(on_floor(*places), SPACING_M)
    np.testing.assert_array_equal(SurfaceGaussians.of(gaussians.parameters(), SPACING_M).discs, gaussians.discs)
    assert SurfaceGaussians.of({}, SPACING_M) is None


def test_factor_multiplies_the_paths_that_meet_a_gaussian(scene):
    """One Gaussian under the ceiling, against NumPy: paths that the ceiling reflects change by exp(w (a + j b))."""
    side = traced(scene, depth=1)
    before = gain(side, {})
    met, path = side.interactions, np.flatnonzero(side.exists)
    on_ceiling = np.isclose(met.position_m[:, 2], HEIGHT)
    centre = met.position_m[on_ceiling][0]
    side.attach(SurfaceGaussians(np.array([[*centre, 0, 0, 1.0]]).T, 0.3))
    ratio = gain(side, {FACTOR: Tensor64(np.array([[0.2], [0.5]]))})[path] / before[path]
    distance = np.linalg.norm(met.position_m[on_ceiling] - centre, axis=1)
    weight = np.where(distance < 1.2, np.exp(-np.square(distance) / 0.18), 0)
    expected = np.exp(weight * (0.2 + 0.5j))
    changed = np.abs(ratio - 1) > 1e-9
    assert changed.sum() == np.count_nonzero(weight) < len(path)
    np.testing.assert_allclose(np.sort(np.angle(ratio[changed])), np.sort(np.angle(expected)), atol=1e-9)
    np.testing.assert_allclose(np.sort(np.abs(ratio[changed])), np.sort(np.abs(expected)), rtol=1e-9)


def test_zero_factors_leave_paths_unchanged_and_batches_agree(scene):
    side = traced(scene)
    before, gaussians = gain(side, {}), covered(side)
    zeros = Tensor64(gaussians.parameters()[FACTOR].astype(float))
    np.testing.assert_allclose(gain(side, {FACTOR: zeros}), before, rtol=1e-12)
    factor = {FACTOR: Tensor64(np.random.default_rng(0).normal(0, 0.3, (2, len(gaussians))))}
    after = gain(side, factor)
    assert np.abs(after - before).max() > 0.01 * np.abs(before).max()
    rows = after.reshape(len(side), -1)[[4, 1]].ravel()
    np.testing.assert_allclose(gain(side, factor, mi.UInt32([4, 1])), rows, rtol=1e-12)


def test_derivatives_agree_with_finite_differences(scene):
    side, rng = traced(scene), np.random.default_rng(2)
    start, direction = rng.normal(0, 0.3, (2, 2, len(covered(side))))
    weights = [Float64(rng.normal(0, 1e6, len(gain(side, {})))) for _ in range(2)]

    def value(factor):
        re, im = side({FACTOR: factor}).gain
        return dr.sum(re * weights[0] + im * weights[1])

    factor = Tensor64(start)
    dr.enable_grad(factor)
    dr.backward(value(factor))
    slope = float((dr.grad(factor).numpy() * direction).sum())
    plus, minus = (float(value(Tensor64(start + step * direction))[0]) for step in (1e-5, -1e-5))
    assert slope == pytest.approx((plus - minus) / 2e-5, rel=1e-7)


def test_other_search_of_paths_keeps_the_gaussians(scene, tmp_path):
    """A receiver that moved has other paths, with weights of their own."""
    side = traced(scene)
    gaussians = covered(side)
    factor = {FACTOR: Tensor64(np.full((2, len(gaussians)), 0.2))}
    side.search(side.receiver.position_m + np.array([0.3, 0, 0]))
    moved = gain(side, factor)
    assert gaussians.parameters()[DISC].shape == (6, len(gaussians))
    assert np.abs(moved - gain(side, {})).max() > 0.05 * np.abs(moved).max()
    assert side.form[-1] % NEAREST == 0


@pytest.mark.slow
def test_calibration_learns_a_patch_that_no_surface_has(tmp_path):
    """Half of the metal ceiling is plasterboard, which the scene does not say: channels away from the training rows.

    Materials of whole surfaces cannot explain it. The run that is opened again predicts the same.
    """
    middle, upright = LENGTH / 2, np.array([0.0, 0, 0, 1])
    half = "itu_plasterboard", sheet(2, HEIGHT, (middle, LENGTH), (0.0, WIDTH))
    patched = {**WALLS, "ceiling": ("itu_metal", sheet(2, HEIGHT, (0.0, middle), (0.0, WIDTH))), "board": half}
    rng = np.random.default_rng(0)
    tx = np.column_stack([rng.uniform(0.5, 5.5, 120), rng.uniform(0.5, 4.5, 120), rng.uniform(0.8, 1.2, 120)])
    stations, hz = (Receiver("rx", np.array([3.0, 2.4, 0.5]), upright),), FREQUENCY_HZ * np.array([1, 1.02, 1.05])
    options = TraceOptions(depth=1, rays=4096)
    channel = RayTracer(write_xml(tmp_path / "true", patched), Instrument("csi", stations, hz), options)(tx)[0]
    official = np.arange(90), np.arange(90, 120)
    record = Record(
        "room", "csi", tx, stations, channel[None].astype(np.complex64), official=official, frequencies_hz=hz
    )
    scene = write_xml(tmp_path / "stated", {**WALLS, **CEILING})
    scores = {}
    for parts in ("gain,materials", "gain,materials,surface"):
        settings = [f"calibration={parts}", "depth=1", "rays=4096", "transmission=false", "steps=300"]
        run = wrf_mi.train(record, "ray-tracing", out=tmp_path / parts, scene=scene, settings=settings)
        report = run.predict(tx[90:], 0).mean
        scores[parts] = float(np.median(record.task.score(report, record.observation[0, 90:])))
        np.testing.assert_allclose(wrf_mi.open_run(run.folder, record).predict(tx[90:], 0).mean, report, rtol=1e-6)
    assert scores["gain,materials,surface"] > scores["gain,materials"] + 3
