"""Gaussians at the start of a fit, and density control."""

from typing import Any, cast

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from changed_folders import refusal
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import expit, logit
from scipy.stats import kstest

from wrf_mi.backend.device import to_float
from wrf_mi.core import InputError, Receiver, Record, azimuth_elevation, rotation_matrix
from wrf_mi.gaussians import gaussians_from_points, random_gaussians
from wrf_mi.gaussians.initial import LEAST_OPACITY, RESET_OPACITY, SPLIT_SHRINK, DensityChange, adapt, reset_opacity
from wrf_mi.scene.scan.points import read_points
from wrf_mi.training.config import InitialConfig
from wrf_mi.training.initial import initial_gaussians
from wrf_mi.training.loop import FitState

FLOAT32_EPS = 1e-6
"""Relative rounding of one or two float32 operations, with room."""
SMALLEST_P = 1e-3
"""Level of the tests on drawn samples. The seeds are fixed: a pass stays a pass."""


def random_parameters(n: int, seed: int = 0, opacity: bool = True, **log_scale: Any) -> dict[str, np.ndarray]:
    rng, rows = np.random.default_rng(seed), {"position": 3, "log_scale": 3, "rotation": 4, "signal": 2}
    parameters = {name: rng.standard_normal((count, n)) for name, count in rows.items()}
    parameters["log_scale"] = parameters["log_scale"] / 2 - 2  # some are cloned and some split
    if opacity:
        parameters["opacity"] = rng.uniform(-3, 3, (1, n))
    return {name: values.astype(np.float32) for name, values in (parameters | log_scale).items()}


def one_round(parameters: dict[str, np.ndarray], view_gradient_norm: Any, **changes: Any) -> DensityChange:
    n = parameters["position"].shape[1]
    arguments = {"distance_m": np.ones(n), "rng": np.random.default_rng(1), "max_gaussians": 10 * n}
    return adapt(parameters, np.asarray(view_gradient_norm, float), **({"growth_fraction": 0.25} | arguments | changes))


def counts(change: DensityChange, n: int) -> tuple[int, int, int]:
    """Numbers of cloned, split and removed Gaussians: both parts of a split one are fresh, one of a clone is."""
    alive = len(np.unique(change.source))
    grown, fresh = len(change.source) - alive, int(change.fresh.sum())
    return 2 * grown - fresh, fresh - grown, n - alive


def test_small_gaussians_are_cloned_and_large_ones_split():
    log_scale = np.full((3, 8), np.log(0.01))
    log_scale[1, 5] = np.log(0.5)  # one axis is enough
    parameters = random_parameters(8, log_scale=log_scale)
    change = one_round(parameters, [1, 9, 2, 3, 4, 8, 5, 6])
    assert counts(change, 8) == (1, 1, 0)
    # The two largest gradients, 1 and 5, have copies behind the old ones.
    np.testing.assert_array_equal(change.source, [0, 1, 2, 3, 4, 5, 6, 7, 1, 5])
    # The original of a clone is kept; both parts of a split Gaussian are new.
    np.testing.assert_array_equal(np.flatnonzero(change.fresh), [5, 8, 9])
    for name, values in change.parameters.items():
        for part, old in ((1, 1), (8, 1), (5, 5), (9, 5)):
            before, after = parameters[name][:, old].astype(float), values[:, part].astype(float)
            if name == "opacity":  # two of these let through what one of the old let through
                np.testing.assert_allclose((1 - expit(after)) ** 2, 1 - expit(before), rtol=FLOAT32_EPS)
            elif name == "position" and old == 5:
                assert not np.array_equal(after, before)
            elif name == "log_scale" and old == 5:
                np.testing.assert_allclose(np.exp(before - after), SPLIT_SHRINK, rtol=FLOAT32_EPS)
            else:
                np.testing.assert_array_equal(after, before)


def test_angular_size_decides_between_clone_and_split():
    """The same Gaussian is split near the receiver and cloned far from it."""
    parameters = random_parameters(2, log_scale=np.full((3, 2), np.log(0.2)))
    change = one_round(parameters, [1.0, 1.0], distance_m=np.array([1.0, 10.0]), growth_fraction=1.0)
    assert counts(change, 2) == (1, 1, 0)
    np.testing.assert_array_equal(np.flatnonzero(change.fresh), [0, 2, 3])


def test_split_positions_are_drawn_from_the_gaussian():
    """In the Gaussian's own axes the parts lie as its density: each coordinate over its scale is standard normal."""
    scales = np.array([0.3, 1.0, 3.0])
    parameters = random_parameters(400, log_scale=np.log(scales)[:, None] + np.zeros(400))
    change = one_round(parameters, np.ones(400), growth_fraction=1.0)
    assert counts(change, 400) == (0, 400, 0)
    shift = (change.parameters["position"] - parameters["position"][:, change.source]).T
    axes = rotation_matrix(parameters["rotation"][:, change.source].T)
    for coordinate in (np.einsum("nij,ni->nj", axes, shift) / scales).T:
        assert kstest(coordinate, "norm").pvalue > SMALLEST_P


def test_transparent_and_unseen_gaussians_are_pruned():
    parameters = random_parameters(5)
    parameters["opacity"][0] = [0, logit(LEAST_OPACITY) - 0.1, logit(LEAST_OPACITY) + 0.1, 0, 0]
    change = one_round(parameters, [1, 1, 1, 0, 1], growth_fraction=0.0)
    np.testing.assert_array_equal(change.source, [0, 2, 4])
    # Without opacities (product blending) only those that no pixel saw go.
    change = one_round(random_parameters(5, opacity=False), [1, 1, 1, 0, 1], growth_fraction=0.0)
    np.testing.assert_array_equal(change.source, [0, 1, 2, 4])


@pytest.mark.parametrize("opacity", [True, False])
def test_pruning_keeps_at_least_one_gaussian(opacity):
    parameters = random_parameters(4, opacity=opacity)
    if opacity:
        parameters["opacity"][0] = [-20, -19, -18, -19]
    change = one_round(parameters, np.zeros(4))
    assert change.parameters["position"].shape == (3, 1)
    assert change.source[0] == (2 if opacity else 0)


@settings(deadline=None, max_examples=60)
@given(st.integers(1, 30), st.integers(1, 40), st.floats(0, 1), st.integers(0, 1000), st.booleans())
def test_invariants_of_a_density_round(n, max_gaussians, growth_fraction, seed, opacity):
    parameters = random_parameters(n, seed, opacity)
    before = {name: values.copy() for name, values in parameters.items()}
    rng = np.random.default_rng(seed)
    view_gradient_norm, distance = rng.uniform(0, 1, n) * rng.integers(0, 2, n), rng.uniform(0.5, 5, n)
    limits = {"max_gaussians": max_gaussians, "growth_fraction": growth_fraction}
    change = one_round(parameters, view_gradient_norm, distance_m=distance, **limits)
    count = len(change.source)
    assert count >= 1
    # Growth ends at the most; a field that is larger to begin with is not cut.
    cloned, split, pruned = counts(change, n)
    assert count <= max(max_gaussians, n - pruned)
    assert min(cloned, split) >= 0
    assert cloned + split <= round(growth_fraction * (n - pruned))
    for name, values in change.parameters.items():
        assert values.shape == (before[name].shape[0], count)
        assert values.dtype == np.float32
        np.testing.assert_array_equal(parameters[name], before[name])  # the old set is left as it was
        # What is left is as it was; only the opacity of a clone's original has changed.
        old = ~change.fresh
        if name == "opacity":
            old &= np.bincount(change.source, minlength=n)[change.source] == 1
        np.testing.assert_array_equal(values[:, old], before[name][:, change.source[old]])


def test_opacity_reset():
    before = np.array([[-9.0, logit(RESET_OPACITY), 0.0, 5.0]], np.float32)
    after = reset_opacity(before)
    np.testing.assert_allclose(after, [[-9.0, *[logit(RESET_OPACITY)] * 3]], rtol=FLOAT32_EPS)
    assert after.dtype == np.float32


def adam_step(state: FitState) -> None:
    dr.backward(sum(dr.sum(dr.square(p.array + 1)) for p in state.adam.values()))
    state.adam.step()


def trained_state(n: int) -> tuple[FitState, dict[str, np.ndarray]]:
    """A state after three steps with gradients that are not zero, a network's weight among its parameters."""
    log_scale = np.full((3, n), np.log(1e-3))
    log_scale[:, 4:5] = 0.0  # large enough to be split
    state = FitState({"net.bias": np.zeros((4, 1), np.float32)} | random_parameters(n, log_scale=log_scale))
    state.adam.set_learning_rate(0.1)
    for _ in range(3):
        adam_step(state)
    state.mean = {name: mi.TensorXf(values + 7) for name, values in state.params().items()}
    state.view_gradient_norm, state.view_gradient_steps = to_float(np.arange(n)), 3
    return state, state.params()


def test_density_round_keeps_momentum_of_old_gaussians():
    n = 6
    state, before = trained_state(n)
    first, second, count = state.moments()
    assert count == 3
    assert all(m.any() and v.any() for m, v in zip(first.values(), second.values(), strict=True))
    of_gaussians = {name: values for name, values in before.items() if name != "net.bias"}
    change = one_round(of_gaussians, [0, 1, 2, 3, 9, 8], growth_fraction=0.4)
    assert counts(change, n) == (1, 1, 1)
    mean = state.mean_params()
    state.change_density(change)
    assert state.gaussians == 7
    new_first, new_second, new_count = state.moments()
    new_mean = state.mean_params()
    assert new_count == 3  # Adam's bias correction goes on for all
    for name, values in change.parameters.items():
        np.testing.assert_array_equal(state.params()[name], values)
        for new, old in ((new_first, first), (new_second, second)):
            assert not new[name][:, change.fresh].any()
            np.testing.assert_array_equal(new[name][:, ~change.fresh], old[name][:, change.source[~change.fresh]])
        fresh = change.fresh.copy()
        if name == "opacity":  # that of the clone's original has changed with the clone's
            fresh |= np.bincount(change.source, minlength=n)[change.source] == 2
            assert fresh.sum() == change.fresh.sum() + 1
        np.testing.assert_array_equal(new_mean[name][:, fresh], values[:, fresh])
        np.testing.assert_array_equal(new_mean[name][:, ~fresh], mean[name][:, change.source[~fresh]])
    for new, old in ((new_first, first), (new_second, second), (state.params(), before), (new_mean, mean)):
        np.testing.assert_array_equal(new["net.bias"], old["net.bias"])
    assert state.view_gradient_steps == 0
    np.testing.assert_array_equal(state.view_gradient_norm.numpy(), np.zeros(7))


def test_opacity_reset_clears_only_its_momentum():
    state, before = trained_state(5)  # opacity is the last parameter: the step count must not come from it
    first, _, _ = state.moments()
    state.set_param("opacity", reset_opacity(before["opacity"]))
    new_first, new_second, count = state.moments()
    assert count == 3
    assert not new_first["opacity"].any()
    assert not new_second["opacity"].any()
    np.testing.assert_array_equal(new_first["signal"], first["signal"])
    np.testing.assert_allclose(state.params()["opacity"].max(), logit(RESET_OPACITY), rtol=FLOAT32_EPS)
    assert {int(t[0]) for _, _, _, (t, _, _, _) in state.adam.state.values()} == {3}


def test_best_parameters_are_not_modified_later():
    """Dr.Jit gives memory of an array that is summed to in place to the next one of that size."""
    state, _ = trained_state(4)
    state.keep_best(1.0)
    for _ in range(3):
        state.view_gradient_norm += to_float(np.ones(4))
        dr.eval(state.view_gradient_norm)
    assert state.best is not None
    np.testing.assert_array_equal(state.best["view_gradient_norm"], np.arange(4))


TILTED = Receiver("a", np.array([5.0, 0.3, 1.0]), np.array([0.5, -0.5, -0.5, 0.5]))
UPSIDE_DOWN = Receiver("b", np.array([-40.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0, 0.0]))
POINTS = np.array([[0.5, 1.25, -2.0], [3.0, 4.5, 5.0], [6.0, -7.75, 8.0], [0.0, 0.0, 0.25], [1.0, 2.0, 3.0]])


def test_random_gaussians_fill_each_receivers_hemisphere():
    size_deg = 7.0
    start = random_gaussians([TILTED, UPSIDE_DOWN], 4001, np.random.default_rng(0), (1.0, 8.0), size_deg)
    assert start.position_m.shape == (4001, 3)
    shares = np.array_split(np.arange(4001), 2)
    for receiver, share in zip((TILTED, UPSIDE_DOWN), shares, strict=True):
        local = (start.position_m[share] - receiver.position_m) @ receiver.to_world
        (azimuth, elevation), distance = azimuth_elevation(local), np.linalg.norm(local, axis=1)
        assert 1.0 <= distance.min() <= distance.max() <= 8.0
        # Uniform on the sphere: the sine of the elevation is; a margin of one size reaches below the horizon.
        low = -np.sin(np.radians(size_deg))
        for drawn, ends in ((distance, (1, 7)), (azimuth, (0, 2 * np.pi)), (np.sin(elevation), (low, 1 - low))):
            assert kstest(drawn, "uniform", ends).pvalue > SMALLEST_P
        np.testing.assert_allclose(np.degrees(np.arctan(start.scale_m[share] / distance)), size_deg, rtol=1e-9)


def test_fewer_gaussians_than_receivers():
    start = random_gaussians([TILTED, UPSIDE_DOWN], 1, np.random.default_rng(0))
    assert start.count == 1
    assert np.isfinite(start.position_m).all()


def test_initial_geometry():
    start = random_gaussians([TILTED], 9, np.random.default_rng(2), opacity=0.3)
    weights = start.geometry()
    np.testing.assert_allclose(weights["position"].T, start.position_m, rtol=FLOAT32_EPS)
    np.testing.assert_allclose(np.exp(weights["log_scale"]), np.tile(start.scale_m, (3, 1)), rtol=FLOAT32_EPS)
    np.testing.assert_array_equal(rotation_matrix(weights["rotation"].T), np.tile(np.eye(3), (9, 1, 1)))
    np.testing.assert_allclose(expit(start.opacity_logit()), 0.3, rtol=FLOAT32_EPS)


def test_initial_scale_is_the_gap_to_neighbours():
    """A square grid's nearest three points lie one step away (at a corner two, and one across)."""
    grid = np.stack(np.meshgrid(np.arange(5), np.arange(5), [2.0], indexing="ij"), axis=-1).reshape(-1, 3) * 0.5
    start = gaussians_from_points(grid, 25, np.random.default_rng(0))
    order = np.lexsort(start.position_m.T[::-1])
    np.testing.assert_array_equal(start.position_m[order], grid)
    corner = np.isin(grid[:, 0], [0, 2]) & np.isin(grid[:, 1], [0, 2])
    expected = np.where(corner, 0.5 * np.sqrt((1 + 1 + 2) / 3), 0.5)
    np.testing.assert_allclose(start.scale_m[order], expected)


def test_initial_positions_are_points_of_the_cloud():
    cloud = np.random.default_rng(3).normal(size=(50, 3))
    first = gaussians_from_points(cloud, 10, np.random.default_rng(4))
    assert len({tuple(p) for p in first.position_m} & {tuple(p) for p in cloud}) == 10
    # The gap is that between chosen points, which is wider than between all.
    apart = np.sort(np.linalg.norm(first.position_m[:, None] - first.position_m, axis=2), axis=1)[:, 1:4]
    np.testing.assert_allclose(first.scale_m, np.sqrt((apart**2).mean(axis=1)))
    # Points on top of each other still have a size.
    assert (gaussians_from_points(np.zeros((6, 3)), 6, np.random.default_rng(0)).scale_m > 0).all()


@pytest.mark.parametrize(
    ("points", "count", "message"),
    [
        (np.zeros((9, 2)), 4, r"expected shape \[m, 3\], got \[9, 2\]"),
        (np.zeros((9, 3)), 10, "9 points for 10 Gaussians"),
        (np.zeros((9, 3)), 3, "9 points for 3 Gaussians"),
        (np.where(np.arange(27).reshape(9, 3) == 13, np.nan, 1.0), 4, "row 5: not a number"),
    ],
)
def test_invalid_point_clouds_are_refused(points, count, message):
    with pytest.raises(InputError, match=message):
        gaussians_from_points(points, count, np.random.default_rng(0))


@pytest.mark.parametrize("name", ["cloud.ply", "cloud.xyz", "cloud.npz"])
def test_points_are_read(name, tmp_path):
    if name == "cloud.npz":
        np.savez(tmp_path / name, points=POINTS)
    else:
        trimesh.PointCloud(POINTS).export(tmp_path / name)
    points = read_points(tmp_path / name)
    assert points.dtype == np.float64
    np.testing.assert_allclose(points, POINTS, rtol=FLOAT32_EPS)


def test_points_far_from_the_origin_are_no_start(tmp_path):
    """Their Gaussians would lie on steps of half a metre."""
    np.savez(tmp_path / "utm.npz", points=POINTS + np.array([701_362.56, 4_485_513.72, 0.0]))
    config = InitialConfig(points=str(tmp_path / "utm.npz"))
    record = cast(Record, None)  # points need none
    with pytest.raises(InputError, match=r"utm.npz: coordinates up to 4485518 m"):
        initial_gaussians(config, record, np.arange(1), np.random.default_rng(0))


def test_mesh_vertices_are_read_as_points(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.export(tmp_path / "box.obj")
    points = read_points(tmp_path / "box.obj")
    np.testing.assert_allclose(np.sort(points, axis=0), np.sort(box.vertices, axis=0))


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("junk.npz", b"no archive"),
        ("junk.ply", b"ply\n\xff\x00junk"),
        ("empty.ply", b""),
        ("words.xyz", b"x y z\none two three\n"),
        ("short.xyz", b"1 2\n3 4\n"),
        ("other.foo", b"1 2 3\n"),
        ("cut.ply", trimesh.PointCloud(POINTS).export(file_type="ply")[:-20]),
    ],
)
def test_files_without_points_are_refused(name, content, tmp_path):
    (tmp_path / name).write_bytes(content)
    assert str(tmp_path / name) in refusal(read_points, tmp_path / name, "no points to be read")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"vertices": POINTS}, "no array points or xyz_m in it"),
        ({"points": POINTS[:, :2]}, r"expected points of shape \[m, 3\], got \[5, 2\]"),
        ({"points": POINTS[:0]}, "no points in it"),
        ({"points": np.array(["a", "b"])}, "no points to be read"),
        ({"points": np.where(POINTS == -7.75, np.inf, POINTS)}, "point 3: not finite"),
    ],
)
def test_arrays_without_points_are_refused(arrays, message, tmp_path):
    np.savez(tmp_path / "cloud.npz", **arrays)
    with pytest.raises(InputError, match=message):
        read_points(tmp_path / "cloud.npz")


def test_missing_files_and_files_of_several_meshes_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_points(tmp_path / "none.ply")
    # A file of several meshes has no vertices of its own.
    trimesh.Scene([trimesh.creation.box(), trimesh.creation.icosphere(subdivisions=0)]).export(tmp_path / "scene.glb")
    with pytest.raises(InputError, match="no points in it"):
        read_points(tmp_path / "scene.glb")
