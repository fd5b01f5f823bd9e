"""Fields that are trained by tracing: ``mi.render`` with the plugins in place of splatting, in the same graph."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import yaml
from made_spectra import RECEIVERS, small_field, spectra_predictor
from small_fits import QUICK, official, settings
from traced_rooms import FREQUENCY_HZ, SHOEBOX, receiver, room, write_xml
from wrf_mi_plugins.blend_rays import blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import ray_footprints

from wrf_mi.backend.device import on_device, to_tensor
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import InputError, Record, pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.gaussians import Encoding, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.footprint import depth_order
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import EVALUATIONS
from wrf_mi.graph.graph import Batch, Graph
from wrf_mi.graph.settings import TracedConfig
from wrf_mi.receivers.registry import ObservationSpec
from wrf_mi.runs.api import open_run, train
from wrf_mi.tasks.scores import ssim
from wrf_mi.tracing.paths.instrument_parameters import pose_names, receiver_pose
from wrf_mi.tracing.slabs import slab
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.step import device_pose
from wrf_mi.training.trainer import Trainer

SIZE, FINE = (30, 60), (45, 180)
TX = np.random.default_rng(5).uniform(-1, 1, (3, 3))
SMALL_DEG, CONE = 2.0, 0.1
"""Standard deviation of a Gaussian, and of its direction in rad: they overlap, so that each hides others."""
MODELS: dict[str, Any] = {
    "wrf-gs": WrfGs(Encoding(2, 4.0, 2, 1.0), layers=2, width=16, signal_widths=(16, 8)),
    "wrf-gs+": WrfGsPlus(Encoding(2, 4.0, 2, 1.0), layers=3, width=16, skip=1),
}

SAME_FOOTPRINT = 1e-3
"""Of gradients of one sum over the same responses: float32 kernels whose sums over threads add in another order."""
PROJECTED = 0.15
"""Of gradients traced and splatted. The projection leaves out a Gaussian's lean against the line of sight, of first
order in its size: 2 degrees are 0.035, which a derivative by shape or turn multiplies by up to the cut-off, three, and
a turn of a nearly round Gaussian changes little else. 4 degrees would have twice as much (0.31 was seen)."""
SLAB = 1e-3  # Of the slab's transmission in float32, and of the 1e-8 under the root of a grey of 0.01
DIFFERENCE = 2e-2  # Of a float32 central difference with a step of 2 % and its third-order term
STILL_LEARNS = 0.9  # Median SSIM of the true field's geometry with a fitted network; untrained it has 0.5 to 0.7


def parameters(model, at=RECEIVERS[0], count=15):
    rng = np.random.default_rng(2)
    values = MODELS[model].init(random_gaussians([at], count, rng, (1.0, 3.0), SMALL_DEG, 0.4, 1.0), rng)
    values["log_scale"] = values["log_scale"] + rng.normal(0, 0.2, (3, count))
    values["rotation"] = rng.standard_normal((4, count))
    away = np.linalg.norm(values["position"] - at.position_m[:, None], axis=0)
    direction = at.to_world @ (np.array([[0.6], [0.3], [0.7]]) + rng.normal(0, CONE, (3, count)))
    values["position"] = at.position_m[:, None] + away * direction / np.linalg.norm(direction, axis=0)
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def gradients(values, of, weights):
    """Derivatives of a weighted sum of ``of(params)`` by every parameter."""
    params = {name: to_tensor(value) for name, value in values.items()}
    dr.enable_grad(params)
    dr.backward(dr.sum(of(params) * on_device(weights, mi.Float)))
    return {name: dr.grad(value).numpy().astype(float) for name, value in params.items()}


def reported(graph, tx, number=0, traced_field=None):
    """What a receiver observes of transmitters, as a function of parameters."""
    pose, plane = device_pose(graph.receivers[number]), perception_plane(*graph.form.size, mi.Float)
    rows = on_device(np.arange(len(tx)), mi.UInt32)
    batch = Batch(to_tensor(np.ascontiguousarray(tx.T)), rows, dr.opaque(mi.UInt32, number), pose, plane)
    observe = graph.observation(number, traced_field)
    return lambda params: observe(params, batch)


def assert_close(found, expected, tolerance):
    """Each parameter's gradient, relative to its length; none may be zero, which all would match."""
    for name, gradient in expected.items():
        length = np.linalg.norm(gradient)
        assert length > 0, name
        assert np.linalg.norm(found[name] - gradient) <= tolerance * length, name


@pytest.mark.parametrize("model", MODELS)
def test_traced_gradients_match_the_sum_along_rays(model):
    """For a batch of three: no transmitter's derivative is taken at another's Gaussians.

    The reference sums all Gaussians on all rays by the blending kernel itself, without Mitsuba's scene and ray tracing.
    """
    values, field = parameters(model), MODELS[model]
    weights = np.random.default_rng(3).normal(size=3 * SIZE[0] * SIZE[1])
    pose = device_pose(RECEIVERS[0])
    columns = [on_device(column, mi.Float) for column in pixel_directions(*SIZE).reshape(-1, 3).T]
    bundles = ray_bundles(columns, *SIZE)

    def along_rays(params):
        greys = []
        for row in TX:
            gaussians = field.gaussians(params, to_tensor(row[:, None]))
            footprints = ray_footprints(gaussians, pose)
            lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
            re, im = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
            greys.append(dr.sqrt(re * re + im * im + 1e-8))
        return dr.concat(greys)

    traced = reported(Graph(field, RECEIVERS[:1], ObservationSpec("pixel", SIZE), evaluation="traced"), TX)
    assert_close(gradients(values, traced, weights), gradients(values, along_rays, weights), SAME_FOOTPRINT)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    "form", [ObservationSpec("pixel", FINE), ObservationSpec("power", FINE)], ids=lambda form: form.receiver
)
def test_traced_gradients_match_splatting_for_small_gaussians(model, form):
    """Of every parameter, on the hemisphere of spectra and on the full sphere of one antenna."""
    values = parameters(model)
    if form.receiver == "power":
        values["level"] = np.full((1, 1), -1.0, np.float32)
        values["position"] = values["position"] * np.where(np.arange(15) % 2, 1, -1)
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 if form.receiver == "power" else 3 * FINE[0] * FINE[1])
    traced, splatted = (
        gradients(values, reported(Graph(MODELS[model], RECEIVERS[:1], form, evaluation=name), TX), weights)
        for name in ("traced", "splatted")
    )
    assert_close(traced, splatted, PROJECTED)


def test_traced_pose_gradient_matches_splatting_for_small_gaussians():
    """Position and turn of the receiver, which its sensor's ``to_world`` carries."""
    tensors = {name: to_tensor(value) for name, value in parameters("wrf-gs+").items()}
    gaussians, plane = MODELS["wrf-gs+"].gaussians(tensors, to_tensor(TX.T)), perception_plane(*FINE, mi.Float)
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 * FINE[0] * FINE[1])

    def greys(name):
        evaluate = EVALUATIONS[name](None, TracedConfig())

        def of(params):
            re, im = evaluate(gaussians, receiver_pose(RECEIVERS[0], params, mi.Float), plane, False, params)
            return dr.sqrt(re * re + im * im + 1e-8)

        return of

    values = dict(zip(pose_names(RECEIVERS[0]), (np.full(3, 0.01), np.array([0.02, -0.01, 0.03])), strict=True))
    traced, splatted = (gradients(values, greys(name), weights) for name in ("traced", "splatted"))
    assert_close(traced, splatted, PROJECTED)


def made_record(rows=60):
    """Spectra of twelve Gaussians of 4 degrees, and where they stand."""
    rng, field = np.random.default_rng(0), small_field("wrf-gs+", 32)
    start = random_gaussians(RECEIVERS[:1], 12, rng, (1.0, 4.0), 4.0, 0.5, 1.0)
    values = field.init(start, rng)
    values |= {name: 4 * value for name, value in values.items() if name.startswith("deform.signal.")}
    tx = np.random.default_rng(1).uniform(-1, 1, (rows, 3))
    spectra = spectra_predictor(field, values, RECEIVERS[:1], *SIZE)(tx)
    spectra, (train, test) = np.minimum(spectra / spectra.max(), 1)[None], np.split(np.arange(rows), [40])
    return Record("made", "spectrum", tx, RECEIVERS[:1], spectra, official=(train, test)), start


FEW_STEPS = (
    *("steps=60", "batch=2", "holdout_steps_fraction=0"),
    *("network.width=32", "network.layers=3", "optimiser.network=5e-3"),
)


def test_traced_training_scores_like_splatting_and_reuses_kernels():
    """The traced fit's median SSIM lies in the splatted one's 95 % bootstrap interval over the test rows."""
    record, start = made_record()
    split, earlier_kernels, new = official(record), set[str](), list[int]()
    scores: dict[str, np.ndarray] = {}

    def count_kernels(progress):
        # A kernel is its code, constants included, whether this process or another one compiled it.
        kernels = {entry["hash"] for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT}
        new.append(len(kernels - earlier_kernels))
        earlier_kernels.update(kernels)

    for name, progress in (("splatted", lambda progress: None), ("traced", count_kernels)):
        config = settings(*FEW_STEPS, f"evaluation={name}", "log_every=10", "validate_every=1000")
        trainer = Trainer(record, split, config, initial=start)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, name == "traced"):
            dr.kernel_history_clear()
            trainer.run(progress)
        scores[name] = ssim(trainer.predictor().of_rows(record, split.test, 0), record.observation[0, split.test])
    # A scene whose parameters keep derivatives hands them to whatever is traced in the process later.
    evaluation: Any = trainer.graph.evaluation
    scene_params = [scene.params[key] for scene in evaluation._scenes for key in scene.params.keys()]  # noqa: SIM118
    assert scene_params
    assert not dr.grad_enabled(scene_params)
    draws = np.random.default_rng(0).choice(scores["splatted"], (4000, len(split.test)))
    low, high = np.percentile(np.median(draws, axis=1), (2.5, 97.5))
    assert STILL_LEARNS < low <= np.median(scores["traced"]) <= high
    assert new[0] > 0
    assert new[1:-1] == [0] * 4  # the last line has the kernels of the final score, too


WALLS_HZ = FREQUENCY_HZ
INSIDE = receiver([2.0, 2.0, 1.0])


def behind_the_ceiling(folder, **traced):
    """Gaussians above a room, seen from inside it by tracing, and its graph."""
    form = ObservationSpec("pixel", SIZE, np.array([WALLS_HZ]))
    scene = room(folder)
    graph = Graph(MODELS["wrf-gs+"], [INSIDE], form, scene, TracedConfig(rays=1 << 10, **traced), evaluation="traced")
    values = parameters("wrf-gs+", INSIDE)
    values["position"] = (6 * (values["position"].T - INSIDE.position_m) + INSIDE.position_m).T.astype(np.float32)
    values["log_scale"] += np.log(6, dtype=np.float32)
    return graph, values


def test_slab_attenuates_traced_gaussians_behind_it(tmp_path):
    """At every direction: transmission of a vertical wave, closed form in float64 (ITU-R P.2040, eq. 43)."""
    graph, values = behind_the_ceiling(tmp_path)
    params = {name: to_tensor(value) for name, value in values.items()}
    free = Graph(MODELS["wrf-gs+"], [INSIDE], graph.form, evaluation="traced")
    through, without = (reported(g, TX)(params).numpy().astype(float).reshape(3, *SIZE) for g in (graph, free))
    board = graph.scene.radio_materials["itu_plasterboard"]
    names = "relative_permittivity", "conductivity", "thickness"
    up = Float64(pixel_directions(*SIZE)[..., 2].ravel())
    constants = (Float64(float(np.ravel(getattr(board, name))[0])) for name in names)
    factor = slab(*(up, *constants, WALLS_HZ)).transmitted_tm
    expected = np.hypot(factor.real.numpy(), factor.imag.numpy()).reshape(SIZE)
    lit = without > 0.01
    assert lit.sum() > 100
    np.testing.assert_allclose((through / without)[lit], np.broadcast_to(expected, lit.shape)[lit], rtol=SLAB)
    assert expected[lit[0]].max() < 0.97  # it is no free space


@pytest.mark.parametrize("materials", ["named", "surface"])
def test_traced_derivative_by_wall_materials(tmp_path, materials):
    """Of parameters that the paths have, too: against central differences."""
    graph, values = behind_the_ceiling(tmp_path, materials=materials)
    named_values = graph.trace(TX, 0)[0].parameters().items()
    walls, observe = {name: value for name, value in named_values if name.startswith("material.")}, reported(graph, TX)
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 * SIZE[0] * SIZE[1])
    derivatives = gradients(values | walls, observe, weights)

    def total(name, index, step):
        moved = walls[name].copy()
        moved[index] += step
        params = {n: to_tensor(v) for n, v in (values | walls | {name: moved}).items()}
        with dr.suspend_grad():
            return float(observe(params).numpy().astype(float) @ weights)

    crossed = {name: int(np.abs(derivatives[name]).argmax()) for name in walls if derivatives[name].any()}
    assert len(crossed) >= 2
    for name, index in crossed.items():
        numeric = (total(name, index, 2e-2) - total(name, index, -2e-2)) / 4e-2
        assert derivatives[name][index] == pytest.approx(numeric, rel=DIFFERENCE), name


def test_traced_run_with_a_scene_reproduces_its_score(tmp_path):
    """Gaussians and paths in one graph, trained, stored, opened: by rays through the scene's walls each time."""
    tx = np.random.default_rng(1).uniform([2.5, 2.5, 0.8], [4.5, 4.0, 1.6], (24, 3))
    station, spectra = replace(INSIDE, array_m=planar_array(4, 4, 0.06)), made_record(24)[0].observation
    record = Record("made", "spectrum", tx, (station,), spectra, frequencies_hz=np.array([WALLS_HZ]))
    asked = ["steps=4", *QUICK[:-1], "validate_every=2", "traced.rays=1024", "batch=2"]
    how: dict[str, Any] = {
        "receiver": "pixel",
        "evaluation": "traced",
        "split": "random",
        "scene": write_xml(tmp_path, SHOEBOX),
    }
    run = train(record, "wrf-gs+", out=tmp_path / "run", settings=asked, **how).folder
    stored = np.load(run / "predictions.npz")
    again = open_run(run, record).predict(tx[stored["row"]]).mean
    np.testing.assert_allclose(again, stored["prediction"].reshape(again.shape), atol=1e-5)
    assert yaml.safe_load((run / "config.yaml").read_text())["settings"]["evaluation"] == "traced"


def test_untraceable_settings_are_refused_in_one_line(tmp_path):
    with pytest.raises(InputError, match=r"set traced.shift=0 and traced.tilt=0, or evaluation=splatted"):
        behind_the_ceiling(tmp_path, shift=1e-3)
    with pytest.raises(InputError, match="evaluation: 'cast'; choose from splatted, traced"):
        with_settings(TrainConfig(), ["evaluation=cast"])
    record, _ = made_record(24)
    with pytest.raises(InputError, match=r"--evaluation belongs to Gaussians .*, not to idw"):
        train(record, "idw", out=tmp_path / "idw", evaluation="traced")
