"""Planes and materials of surfaces as parameters of traced fields, and corrected scenes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, HEIGHT, LENGTH, PARTITION, WALLS, WIDTH, receiver, room, transmitters
from small_fits import stop_after
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import InputError, Receiver, Record, Split
from wrf_mi.core.settings import with_settings
from wrf_mi.graph.settings import TRACED_NAMES, TracedConfig
from wrf_mi.receivers.receiver_models import CsiReceiver
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.training.config import calibration_config
from wrf_mi.training.trainer import Trainer

# isort: split
import drjit as dr
import mitsuba as mi

from wrf_mi.core.arrays import planar_array
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT, MaterialGrouping, PlaneTables, read_materials
from wrf_mi.tracing.search.surfaces import scene_surfaces

Float64 = dr.float64_array_t(mi.Float)
Tensor64 = dr.tensor_t(Float64)

OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)
FILE_M = 1e-6
"""Corners of mesh files are float32: 5e-7 m at 6 m, and as much again after a reflection."""
GAIN = 3e-6
"""Relative; gains change with lengths, which follow float32 corners."""
SHIFT_M, TILT_RAD = 0.05, 0.02
MATERIALS: tuple[MaterialGrouping, ...] = ("named", "surface")
TURNED = np.array([[np.cos(TILT_RAD), 0, np.sin(TILT_RAD)], [0, 1, 0], [-np.sin(TILT_RAD), 0, np.cos(TILT_RAD)]])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Any:
    return room(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING, **PARTITION})


def ceiling(shift_m: float, tilted: bool) -> Any:
    """The ceiling, shifted upwards, tilted about y through its centre."""
    made = sheet(2, HEIGHT, (0.0, LENGTH), (0.0, WIDTH))
    centre = np.array([LENGTH / 2, WIDTH / 2, HEIGHT])
    made.vertices = (np.asarray(made.vertices) - centre) @ (TURNED if tilted else np.eye(3)).T + centre
    made.vertices[:, 2] += shift_m / (TURNED[2, 2] if tilted else 1)
    return {"ceiling": ("itu_metal", made)}


def plane_of(scene: Any, name: str) -> int:
    surfaces = scene_surfaces(scene)
    return int(surfaces.plane[surfaces.first_face[surfaces.names.index(name)]])


def moved_values(scene: Any, shift_m: float, tilted: bool) -> dict[str, Any]:
    """Parameters that move the ceiling of `scene` as `ceiling` does."""
    surfaces, plane = scene_surfaces(scene), plane_of(scene, "ceiling")
    shift, tilt = np.zeros(len(surfaces.normal)), np.zeros((len(surfaces.normal), 2))
    up = surfaces.normal[plane, 2]
    shift[plane] = shift_m * up
    if tilted:
        # A tilt is the tangent of the angle: (n + t a + t b) is normalised.
        tilt[plane] = surfaces.axes[plane] @ [np.tan(TILT_RAD) * up, 0.0, 0.0]
    return {SHIFT: Tensor64(shift), TILT: Tensor64(tilt)}


def tensors(traced: TracedField) -> dict[str, Any]:
    return {name: Tensor64(value.astype(float)) for name, value in traced.parameters().items()}


def strongest(traced: TracedField, parameters: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of all paths in ascending order, and their gains."""
    paths, there = traced(parameters), traced.exists
    length = paths.length_m.numpy()[there]
    gain = (paths.gain[0].numpy() + 1j * paths.gain[1].numpy())[there]
    order = np.argsort(length)
    return length[order], gain[order]


@pytest.mark.parametrize(("shift_m", "tilted"), [(SHIFT_M, False), (0.0, True), (-SHIFT_M, True)])
def test_paths_at_moved_planes_are_those_of_a_moved_mesh(tmp_path: Path, shift_m: float, tilted: bool) -> None:
    """Lengths and gains of reflections at a shifted and tilted ceiling, from a mesh of it and from parameters."""
    options, array = TracedOptions(replace(OPTIONS, depth=1)), receiver((30, 20, 10))
    stated = TracedField(room(tmp_path / "stated", CEILING), transmitters(4), array, options)
    there = TracedField(room(tmp_path / "there", ceiling(shift_m, tilted)), transmitters(4), array, options)
    length, gain = strongest(stated, moved_values(stated.scene, shift_m, tilted))
    expected = strongest(there, {})
    assert len(length) == 8
    np.testing.assert_allclose(length, expected[0], atol=FILE_M)
    np.testing.assert_allclose(gain, expected[1], rtol=GAIN, atol=GAIN * np.abs(gain).max())
    assert np.abs(length - strongest(stated, {})[0]).max() > 0.005


def test_planes_move_as_in_numpy(scene: Any) -> None:
    surfaces = scene_surfaces(scene)
    change = np.random.default_rng(0).normal(0, 0.05, (len(surfaces.normal), 3))
    expected = surfaces.moved_planes(change[:, 0], change[:, 1:])
    normal, offset = PlaneTables.of(surfaces).moved({SHIFT: Tensor64(change[:, 0]), TILT: Tensor64(change[:, 1:])})
    np.testing.assert_allclose(np.stack([c.numpy() for c in normal], axis=1), expected[0], atol=1e-14)
    np.testing.assert_allclose(offset.numpy(), expected[1], atol=1e-14)


def test_zero_parameters_leave_paths_unchanged(scene: Any) -> None:
    """To rounding; surfaces start from their named material."""
    plain = TracedField(scene, transmitters(3), receiver(), TracedOptions(OPTIONS))
    each = TracedField(scene, transmitters(3), receiver(), TracedOptions(OPTIONS, materials="surface", planes=True))
    assert not {SHIFT, TILT} & set(plain.parameters())
    assert {SHIFT, TILT} <= set(each.parameters())
    for parameters in ({}, tensors(each)):
        length, gain = strongest(each, parameters)
        expected = strongest(plain, tensors(plain) if parameters else {})
        np.testing.assert_allclose(length, expected[0], rtol=1e-14)
        np.testing.assert_allclose(gain, expected[1], rtol=1e-12, atol=1e-18)


def test_fixed_planes_take_no_kernels(scene: Any) -> None:
    """Without parameters of planes the kernels are those of a field without movable planes."""

    def kernels(options: TracedOptions, *names: str) -> list[str]:
        traced = TracedField(scene, transmitters(3), receiver(), options)
        parameters = {name: value for name, value in tensors(traced).items() if name in names}
        dr.enable_grad(parameters)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            paths = traced(parameters)
            dr.backward(dr.sum(paths.gain[0] * paths.length_m))
            dr.eval([dr.grad(value) for value in parameters.values()])
            return [entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])]

    plain, free = TracedOptions(OPTIONS), TracedOptions(OPTIONS, planes=True)
    gain = "receiver.array.gain"
    assert kernels(plain, gain) == kernels(free, gain)
    assert kernels(free, gain, SHIFT) != kernels(free, gain)


def test_each_surface_has_a_material(scene: Any) -> None:
    """A surface's material changes only the paths that meet the surface."""
    options = TracedOptions(replace(OPTIONS, depth=1), materials="surface")
    traced = TracedField(scene, transmitters(2), receiver(), options)
    names = [name.partition("/")[0] for name in traced.slabs.names]
    assert sorted(names) == sorted({**WALLS, **CEILING, **PARTITION})
    values = traced.parameters()
    shape = values["material.surface.permittivity"].shape
    assert shape == values["material.surface.conductivity"].shape == (len(names),)
    before = strongest(traced, tensors(traced))[1]
    changes = {}
    for name in ("west", "north", "partition"):
        other = {key: value.copy() for key, value in values.items()}
        other["material.surface.permittivity"][names.index(name)] += 1
        after = strongest(traced, {key: Tensor64(value.astype(float)) for key, value in other.items()})[1]
        changes[name] = np.flatnonzero(np.abs(after - before) > 1e-6 * np.abs(before))
    assert all(0 < len(places) < len(before) for places in changes.values())
    assert not set(changes["west"]) & set(changes["north"])


def test_material_that_is_not_a_slab_is_refused(scene: Any) -> None:
    for grouping in MATERIALS:
        traced = TracedField(scene, transmitters(2), receiver(), TracedOptions(OPTIONS, materials=grouping))
        traced._slab_of_face[:] = -1  # as of a material without a permittivity
        with pytest.raises(InputError, match="is not a slab"):
            traced.search(receiver().position_m)


def record_of(receivers: tuple[Receiver, ...], tx: np.ndarray, observation: np.ndarray, task: str) -> Record:
    hz = FREQUENCY_HZ * np.array([1, 1.02]) if task == "csi" else np.array([FREQUENCY_HZ])
    return Record("room", task, tx, receivers, observation, frequencies_hz=hz)


def trainer_of(record: Record, scene: Any, parts: str, *settings: str) -> Trainer:
    """Paths alone, trained on all rows."""
    rows = np.arange(len(record))
    common = (
        "traced.rays=4096",
        "optimiser.warm_up=10",
        "holdout_steps_fraction=0",
        "patience=0",
        f"batch={len(record)}",
    )
    config = with_settings(calibration_config(parts.split(","), record.task == "spectrum"), [*common, *settings])
    return Trainer(record, Split("all", 0, rows, rows[:0], rows[:0]), config, scene=scene)


def test_training_finds_a_lowered_and_tilted_ceiling(scene: Any, tmp_path: Path) -> None:
    tx, model = transmitters(12, seed=3), CsiReceiver(2, 4, (FREQUENCY_HZ, 1.02 * FREQUENCY_HZ))
    options = TracedOptions(replace(OPTIONS, depth=1), planes=True)
    true = TracedField(room(tmp_path, {**WALLS, **ceiling(-0.02, True), **PARTITION}), tx, receiver(), options)
    observed = model(true({}), None).numpy().reshape(len(tx), -1, 2).astype(float) @ [1, 1j]
    record = record_of((receiver(),), tx, observed[None].astype(np.complex64), "csi")
    rates = "traced.shift=0.002", "traced.tilt=0.002", "traced.depth=1", "traced.reflections=1", "steps=500"
    trainer = trainer_of(record, scene, "planes", *rates)
    assert set(trainer.state.adam) == {SHIFT, TILT}
    trainer.run()
    miss = np.abs(trainer.predictor()(tx) - observed).mean() / np.abs(observed).mean()
    plane, values = plane_of(scene, "ceiling"), trainer.state.params()
    expected = {name: value.numpy() for name, value in moved_values(scene, -0.02, True).items()}
    # Height at the reflections, not at the centre: over 0.3 m of the ceiling, shift and tilt are hardly distinct.
    spot = np.array([3.0, 2.3, HEIGHT])
    surfaces = scene_surfaces(scene)

    def height(parameters: dict[str, Any]) -> float:
        normals, offset_m = surfaces.moved_planes(parameters[SHIFT], parameters[TILT])
        normal = normals[plane]
        return float((offset_m[plane] - normal[:2] @ spot[:2]) / normal[2])

    assert miss < 0.02
    assert height(values) == pytest.approx(height(expected), abs=3e-3)
    assert abs(height(expected) - HEIGHT) > 0.015


def test_receivers_share_planes_and_keep_their_recordings(scene: Any) -> None:
    """A new search at a receiver, and its steps, leave the recorded steps of the others unchanged."""
    array = planar_array(3, 3, 0.16)
    moving = replace(receiver((10, 5, 0)), array_m=array)
    other = Receiver("tag", np.array([1.0, 4.0, 2.0]), moving.orientation_xyzw, array_m=array)
    tx, spectra = transmitters(4), np.random.default_rng(0).uniform(0, 1, (2, 4, 8, 16)).astype(np.float32)
    record = record_of((moving, other), tx, spectra, "spectrum")
    settings = "traced.materials=surface", "traced.material=0.05", "traced.position=1e-4", "steps=40"
    trainer = trainer_of(record, scene, "planes", "traced.depth=2", *settings)
    names = {SHIFT, TILT, "material.surface.permittivity", "receiver.array.position", "receiver.tag.position"}
    assert names <= set(trainer.state.adam)
    trainer.run(stop=stop_after(10))
    first, second = trainer.steps.recorded[0, 0, False, False], trainer.steps.recorded[1, 0, False, False]
    recordings = second.frozen.n_recordings
    before = trainer.state.params()
    # As a step does once the receiver has moved by more than a quarter of a wavelength.
    side = trainer.sides[0]
    assert side is not None
    side.search(moving.position_m + np.array([0.05, 0, 0]))
    trainer.run(stop=stop_after(6))
    assert [side.searches for side in trainer.sides if side is not None] == [1, 0]
    assert trainer.steps.recorded[0, 1, False, False] is not first
    assert trainer.steps.recorded[1, 0, False, False] is second
    assert (0, 0, True, False) not in trainer.steps.recorded
    assert second.frozen.n_recordings == recordings
    # Steps at either receiver move the planes.
    assert np.abs(trainer.state.params()[SHIFT] - before[SHIFT]).max() > 0


def test_planes_have_no_learning_rate_by_default(scene: Any) -> None:
    """Every parameter has a rate, and a prefix by which training recognises it."""
    options = TracedOptions(OPTIONS, 1, materials="surface", planes=True)
    names = TracedField(scene, transmitters(1), receiver(), options).parameters()
    assert all(name.startswith(TRACED_NAMES) for name in names)
    fixed = {name for name in names if TracedConfig().rate(name) == 0}
    assert fixed == {SHIFT, TILT, "receiver.array.position", "receiver.array.turn"}
    free = TracedConfig(shift=0.01, tilt=0.02)
    assert (free.rate(SHIFT), free.rate(TILT)) == (0.01, 0.02)
    assert free.moves_planes
    assert not TracedConfig().moves_planes


def test_corrected_scene_has_moved_planes_and_stays_closed(scene: Any, tmp_path: Path) -> None:
    """Its paths are those of the parameters; the corners of the room stay shared."""
    rng, options = np.random.default_rng(2), TracedOptions(replace(OPTIONS, depth=1))
    traced = TracedField(scene, transmitters(3), receiver((30, 20, 10)), replace(options, planes=True))
    count = len(traced.surfaces.normal)
    values = {SHIFT: rng.normal(0, 0.02, count), TILT: rng.normal(0, 0.01, (count, 2))}
    folder = write_corrected_scene(tmp_path / "corrected", scene, values)
    again = open_scene(folder, FREQUENCY_HZ)
    length, gain = strongest(traced, {name: Tensor64(value) for name, value in values.items()})
    expected = strongest(TracedField(again, transmitters(3), receiver((30, 20, 10)), options), {})
    np.testing.assert_allclose(length, expected[0], atol=FILE_M)
    np.testing.assert_allclose(gain, expected[1], rtol=GAIN, atol=GAIN * np.abs(gain).max())

    def corners(folder_scene: Any) -> int:
        return len(np.unique(np.round(scene_surfaces(folder_scene).triangles.reshape(-1, 3), 4), axis=0))

    # Eight of the room and four of the partition, before as after.
    assert corners(scene) == corners(again) == 12
    with pytest.raises(ValueError, match="planes"):
        write_corrected_scene(tmp_path / "other", scene, {SHIFT: np.zeros(count + 1)})


def test_plain_sionna_rt_opens_a_corrected_scene_below_the_range_of_its_materials(scene: Any, tmp_path: Path) -> None:
    from sionna import rt

    write_corrected_scene(tmp_path / "corrected", scene, {})
    plain = rt.load_scene(str(tmp_path / "corrected" / "scene.xml"), merge_shapes=False)
    plain.frequency = FREQUENCY_HZ  # Sionna RT knows concrete from 1 GHz
    for name, thing in plain.objects.items():
        stated = scene.objects[name].radio_material
        for quantity in ("relative_permittivity", "conductivity", "thickness"):
            values = (float(np.ravel(getattr(one, quantity))[0]) for one in (thing.radio_material, stated))
            assert next(values) == pytest.approx(next(values), rel=1e-4), (name, quantity)


def test_corrected_scene_has_the_fitted_constants_of_named_materials(scene: Any, tmp_path: Path) -> None:
    """Training has one number for each quantity of a material, in an array of one."""
    slabs = read_materials(scene)
    name = next(iter(scene.objects.values())).radio_material.name
    stated = slabs.permittivity[slabs.names.index(name)]
    raised = {f"material.{name}.permittivity": np.log([stated + 1.0])}  # permittivity 1 + exp(x)
    again = open_scene(write_corrected_scene(tmp_path / "corrected", scene, raised), FREQUENCY_HZ)
    assert np.isclose(read_materials(again).permittivity, stated + 2.0, rtol=1e-5).any()
