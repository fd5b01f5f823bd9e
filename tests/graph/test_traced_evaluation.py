"""Fields that are trained by tracing: ``mi.render`` with the plugins in place of splatting, in the same graph."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import yaml
from made_spectra import RECEIVERS, small_field
from small_fits import QUICK, official, settings
from traced_rooms import FREQUENCY_HZ, SHOEBOX, receiver, room, write_xml
from wrf_mi_plugins.blend_rays import blend_rays
from wrf_mi_plugins.bundles import all_lists, ray_bundles
from wrf_mi_plugins.ray_response import ray_footprints

from wrf_mi.backend.device import on_device, to_tensor
from wrf_mi.core import InputError, Receiver, Record, pixel_directions
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.registry import resolve
from wrf_mi.core.settings import with_settings
from wrf_mi.gaussians import Encoding, WrfGs, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.footprint import depth_order
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import EVALUATIONS
from wrf_mi.graph.graph import Batch, Graph
from wrf_mi.graph.receivers import Form
from wrf_mi.graph.settings import TracedConfig
from wrf_mi.runs.api import open_run, train
from wrf_mi.tasks.scores import ssim
from wrf_mi.tracing.paths.field_calculator import slab
from wrf_mi.tracing.paths.instrument_parameters import pose_names, receiver_pose
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.step import device_pose
from wrf_mi.training.trainer import Trainer

Float64: Any = dr.float64_array_t(mi.Float)
SIZE, FINE = (30, 60), (45, 180)
TX = np.random.default_rng(5).uniform(-1, 1, (3, 3))
SMALL_DEG, CONE = 2.0, 0.1
"""Standard deviation of a Gaussian, and of its direction in rad: they overlap, so that each hides others."""
MODELS = {
    "wrf-gs": WrfGs(Encoding(2, 4.0, 2, 1.0), layers=2, width=16, signal_widths=(16, 8)),
    "wrf-gs+": WrfGsPlus(Encoding(2, 4.0, 2, 1.0), layers=3, width=16, skip=1),
}

SAME_FOOTPRINT = 1e-3
"""Of gradients of one sum over the same responses: float32 kernels whose sums over threads add in another order."""
PROJECTED = 0.15
"""Of gradients traced and splatted. The projection leaves out a Gaussian's lean against the line of sight, of first
order in its size: 2 degrees are 0.035, which a derivative by shape or turn multiplies by up to the cut-off, three, and
a turn of a nearly round Gaussian changes little else. 4 degrees would have twice as much (0.31 was seen)."""
SLAB = 1e-3
"""Of the slab's transmission in float32, and of the 1e-8 under the root of a grey of 0.01."""
DIFFERENCE = 2e-2
"""Of a float32 central difference with a step of 2 % and its third-order term."""
STILL_LEARNS = 0.9
"""Median SSIM of the true field's geometry with a fitted network; untrained it has 0.5 to 0.7."""


def parameters(model: str, at: Receiver = RECEIVERS[0], count: int = 15) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    values = MODELS[model].init(random_gaussians([at], count, rng, (1.0, 3.0), SMALL_DEG, 0.4, 1.0), rng)
    values["log_scale"] = values["log_scale"] + rng.normal(0, 0.2, (3, count))
    values["rotation"] = rng.standard_normal((4, count))
    away = np.linalg.norm(values["position"] - at.position_m[:, None], axis=0)
    direction = at.to_world @ (np.array([[0.6], [0.3], [0.7]]) + rng.normal(0, CONE, (3, count)))
    values["position"] = at.position_m[:, None] + away * direction / np.linalg.norm(direction, axis=0)
    return {name: np.asarray(value, np.float32) for name, value in values.items()}


def gradients(values: dict[str, np.ndarray], of: Any, weights: np.ndarray) -> dict[str, np.ndarray]:
    """Derivatives of a weighted sum of ``of(params)`` by every parameter."""
    params = {name: to_tensor(value) for name, value in values.items()}
    dr.enable_grad(params)
    dr.backward(dr.sum(of(params) * on_device(weights, mi.Float)))
    return {name: dr.grad(value).numpy().astype(float) for name, value in params.items()}


def reported(graph: Graph, tx: np.ndarray, number: int = 0, side: Any = None) -> Any:
    """What a receiver reports of transmitters, as a function of parameters."""
    pose, plane = device_pose(graph.receivers[number]), perception_plane(*graph.form.size, mi.Float)
    batch = Batch(
        to_tensor(np.ascontiguousarray(tx.T)),
        on_device(np.arange(len(tx)), mi.UInt32),
        dr.opaque(mi.UInt32, number),
        pose,
        plane,
    )
    report = graph.report(number, side)
    return lambda params: report(params, batch)


def assert_close(found: dict[str, np.ndarray], expected: dict[str, np.ndarray], tolerance: float) -> None:
    """Each parameter's gradient, relative to its length; none may be zero, which all would match."""
    for name, one in expected.items():
        length = np.linalg.norm(one)
        assert length > 0, name
        assert np.linalg.norm(found[name] - one) <= tolerance * length, name


@pytest.mark.parametrize("model", MODELS)
def test_traced_gradients_match_the_sum_along_rays(model: str) -> None:
    """For a batch of three: no transmitter's derivative is taken at another's Gaussians.

    The reference sums all Gaussians on all rays by the blending kernel itself, without Mitsuba's scene and ray tracing.
    """
    values, field = parameters(model), MODELS[model]
    weights = np.random.default_rng(3).normal(size=3 * SIZE[0] * SIZE[1])
    pose = device_pose(RECEIVERS[0])
    columns = [on_device(column, mi.Float) for column in pixel_directions(*SIZE).reshape(-1, 3).T]
    bundles = ray_bundles(columns, *SIZE)

    def along_rays(params: Any) -> Any:
        greys = []
        for row in TX:
            gaussians = field.gaussians(params, to_tensor(row[:, None]))
            footprints = ray_footprints(gaussians, pose)
            lists = all_lists(depth_order(footprints.depth, gaussians.position), bundles)
            re, im = blend_rays(footprints, gaussians.signal, lists, bundles, gaussians.blending)
            greys.append(dr.sqrt(re * re + im * im + 1e-8))
        return dr.concat(greys)

    traced = reported(Graph(field, RECEIVERS[:1], Form("pixel", SIZE), evaluation="traced"), TX)
    assert_close(gradients(values, traced, weights), gradients(values, along_rays, weights), SAME_FOOTPRINT)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("form", [Form("pixel", FINE), Form("power", FINE)], ids=lambda form: form.receiver)
def test_traced_gradients_match_splatting_for_small_gaussians(model: str, form: Form) -> None:
    """Of every parameter, on the hemisphere of spectra and on the full sphere of one antenna."""
    values = parameters(model)
    if form.receiver == "power":
        values["level"] = np.full((1, 1), -1.0, np.float32)
        values["position"] = values["position"] * np.where(np.arange(15) % 2, 1, -1)
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 if form.receiver == "power" else 3 * FINE[0] * FINE[1])
    found = [
        gradients(values, reported(Graph(MODELS[model], RECEIVERS[:1], form, evaluation=name), TX), weights)
        for name in ("traced", "splatted")
    ]
    assert_close(*found, PROJECTED)


def test_traced_pose_gradient_matches_splatting_for_small_gaussians() -> None:
    """Position and turn of the receiver, which its sensor's ``to_world`` carries."""
    gaussians = MODELS["wrf-gs+"].gaussians(
        {name: to_tensor(value) for name, value in parameters("wrf-gs+").items()}, to_tensor(TX.T)
    )
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 * FINE[0] * FINE[1])
    plane = perception_plane(*FINE, mi.Float)

    def greys(name: str) -> Any:
        evaluate = resolve(EVALUATIONS[name])(None, TracedConfig())

        def of(params: Any) -> Any:
            pose = receiver_pose(RECEIVERS[0], params, mi.Float)
            re, im = evaluate(gaussians, pose, plane, False, params)
            return dr.sqrt(re * re + im * im + 1e-8)

        return of

    values = dict(zip(pose_names(RECEIVERS[0]), (np.full(3, 0.01), np.array([0.02, -0.01, 0.03])), strict=True))
    assert_close(*(gradients(values, greys(name), weights) for name in ("traced", "splatted")), PROJECTED)


def made_record(rows: int = 60) -> tuple[Record, Any]:
    """Spectra of twelve Gaussians of 4 degrees, and where they stand."""
    rng = np.random.default_rng(0)
    start = random_gaussians(RECEIVERS[:1], 12, rng, (1.0, 4.0), 4.0, 0.5, 1.0)
    field = small_field("wrf-gs+", 32)
    values = field.init(start, rng)
    values |= {name: 4 * value for name, value in values.items() if name.startswith("deform.signal.")}
    tx, every = np.random.default_rng(1).uniform(-1, 1, (rows, 3)), np.arange(rows)
    spectra = Predictor.of_field(field, values, RECEIVERS[:1], *SIZE)(tx)
    spectra = np.minimum(spectra / spectra.max(), 1)[None]
    own = {"official": (every[:40], every[40:])}
    return Record("made", "spectrum", tx, RECEIVERS[:1], spectra, **own), start


FEW_STEPS = (
    "steps=60",
    "batch=2",
    "holdout_steps_fraction=0",
    "network.width=32",
    "network.layers=3",
    "optimiser.network=5e-3",
)


def test_traced_training_scores_like_splatting_and_reuses_kernels() -> None:
    """The traced fit's median SSIM lies in the splatted one's 95 % bootstrap interval over the test rows."""
    record, start = made_record()
    split, scores = official(record), {}
    seen: set[str] = set()
    new: list[int] = []

    def count_kernels(progress: Any) -> None:
        kernels = {one["hash"] for one in dr.kernel_history() if one["type"] == dr.KernelType.JIT}
        new.append(len(kernels - seen))
        seen.update(kernels)

    for name in ("splatted", "traced"):
        own = settings(*FEW_STEPS, f"evaluation={name}", "log_every=10", "validate_every=1000")
        trainer = Trainer(record, split, own, initial=start)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, name == "traced"):
            dr.kernel_history_clear()
            trainer.run(count_kernels if name == "traced" else lambda progress: None)
        if name == "traced":
            # A scene whose parameters keep derivatives hands them to whatever is traced in the process later.
            kept = [one.params[key] for one in trainer.graph.evaluation._scenes for key in one.params.keys()]  # noqa: SIM118
            assert kept
            assert not dr.grad_enabled(kept)
        scores[name] = ssim(trainer.predictor().of_rows(record, split.test, 0), record.observation[0, split.test])
    draws = np.random.default_rng(0).choice(scores["splatted"], (4000, len(split.test)))
    low, high = np.percentile(np.median(draws, axis=1), (2.5, 97.5))
    assert STILL_LEARNS < low <= np.median(scores["traced"]) <= high
    # A kernel is its code, constants included, whether this process or another one compiled it.
    assert new[0] > 0
    # The last line has the kernels of the final score, too.
    assert new[1:-1] == [0] * 4


WALLS_HZ = FREQUENCY_HZ
INSIDE = receiver([2.0, 2.0, 1.0])


def behind_the_ceiling(folder: Path, **traced: Any) -> tuple[Graph, dict[str, np.ndarray]]:
    """Gaussians above a room, seen from inside it by tracing, and its graph."""
    form = Form("pixel", SIZE, np.array([WALLS_HZ]))
    scene = room(folder)
    graph = Graph(MODELS["wrf-gs+"], [INSIDE], form, scene, TracedConfig(rays=1 << 10, **traced), evaluation="traced")
    values = parameters("wrf-gs+", INSIDE)
    values["position"] = (6 * (values["position"].T - INSIDE.position_m) + INSIDE.position_m).T.astype(np.float32)
    values["log_scale"] += np.log(6, dtype=np.float32)
    return graph, values


def test_slab_attenuates_traced_gaussians_behind_it(tmp_path: Path) -> None:
    """At every direction: transmission of a vertical wave, closed form in float64 (ITU-R P.2040, eq. 43)."""
    graph, values = behind_the_ceiling(tmp_path)
    params = {name: to_tensor(value) for name, value in values.items()}
    free = Graph(MODELS["wrf-gs+"], [INSIDE], graph.form, evaluation="traced")
    through, without = (reported(one, TX)(params).numpy().astype(float).reshape(3, *SIZE) for one in (graph, free))
    plasterboard = graph.scene.radio_materials["itu_plasterboard"]
    constants = (
        float(np.ravel(getattr(plasterboard, name))[0])
        for name in ("relative_permittivity", "conductivity", "thickness")
    )
    up = Float64(pixel_directions(*SIZE)[..., 2].ravel())
    factor = slab(up, *map(Float64, constants), WALLS_HZ).transmitted_tm
    expected = np.hypot(factor.real.numpy(), factor.imag.numpy()).reshape(SIZE)
    lit = without > 0.01
    assert lit.sum() > 100
    np.testing.assert_allclose((through / without)[lit], np.broadcast_to(expected, lit.shape)[lit], rtol=SLAB)
    assert expected[lit[0]].max() < 0.97  # it is no free space


@pytest.mark.parametrize("materials", ["named", "surface"])
def test_traced_derivative_by_wall_materials(tmp_path: Path, materials: str) -> None:
    """Of parameters that the paths have, too: against central differences."""
    graph, values = behind_the_ceiling(tmp_path, materials=materials)
    side = graph.trace(TX, 0)[0]
    assert side is not None
    own = side.parameters()
    names = [name for name in own if name.startswith("material.")]
    values |= {name: own[name] for name in names}
    report = reported(graph, TX)  # of Gaussians alone
    weights = np.random.default_rng(3).uniform(0.5, 1.5, 3 * SIZE[0] * SIZE[1])
    found = gradients(values, report, weights)

    def total(name: str, index: int, step: float) -> float:
        moved = values[name].copy()
        moved[index] += step
        params = {n: to_tensor(v) for n, v in (values | {name: moved}).items()}
        with dr.suspend_grad():
            return float(report(params).numpy().astype(float) @ weights)

    crossed = {name: int(np.abs(found[name]).argmax()) for name in names if found[name].any()}
    assert len(crossed) >= 2
    for name, index in crossed.items():
        numeric = (total(name, index, 2e-2) - total(name, index, -2e-2)) / 4e-2
        assert found[name][index] == pytest.approx(numeric, rel=DIFFERENCE), name


def test_traced_run_with_a_scene_reproduces_its_score(tmp_path: Path) -> None:
    """Gaussians and paths in one graph, trained, stored, opened: by rays through the scene's walls each time."""
    record, _ = made_record(24)
    tx = np.random.default_rng(1).uniform([2.5, 2.5, 0.8], [4.5, 4.0, 1.6], (24, 3))
    at = replace(INSIDE, array_m=planar_array(4, 4, 0.06))
    own = Record("made", "spectrum", tx, (at,), record.observation, frequencies_hz=np.array([WALLS_HZ]))
    scene = write_xml(tmp_path / "room", SHOEBOX)
    asked = ["steps=4", *QUICK[:-1], "validate_every=2", "traced.rays=1024", "batch=2"]
    train(
        own,
        tmp_path / "run",
        "wrf-gs+",
        scene=scene,
        settings=asked,
        receiver="pixel",
        evaluation="traced",
        split="random",
    )
    stored = np.load(tmp_path / "run" / "predictions.npz")
    rows = stored["row"]
    again = open_run(tmp_path / "run", own).predict(tx[rows]).mean
    np.testing.assert_allclose(again, stored["prediction"].reshape(again.shape), atol=1e-5)
    config = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert config["settings"]["evaluation"] == "traced"


def test_untraceable_settings_are_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"set traced.shift=0 and traced.tilt=0, or evaluation=splatted"):
        behind_the_ceiling(tmp_path, shift=1e-3)
    with pytest.raises(InputError, match="evaluation: 'cast'; choose from splatted, traced"):
        with_settings(TrainConfig(), ["evaluation=cast"])
    record, _ = made_record(24)
    with pytest.raises(InputError, match=r"--evaluation belongs to Gaussians .*, not to idw"):
        train(record, tmp_path / "idw", "idw", evaluation="traced")
