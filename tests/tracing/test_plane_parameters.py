"""Planes and materials of surfaces as parameters of traced fields, and corrected scenes."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, HEIGHT, LENGTH, PARTITION, WALLS, WIDTH, receiver, room, transmitters
from double_precision import Tensor64
from small_fits import stop_after
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.core import InputError, Record, Split
from wrf_mi.core.arrays import planar_array
from wrf_mi.core.settings import with_settings
from wrf_mi.graph.settings import TRACED_NAMES, TracedConfig
from wrf_mi.receivers.receiver_models import CsiReceiver
from wrf_mi.tracing import TraceOptions, open_scene
from wrf_mi.tracing.paths.corrected_scene import write_corrected_scene
from wrf_mi.tracing.paths.scene_parameters import SHIFT, TILT, read_materials
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions
from wrf_mi.tracing.search.surfaces import scene_surfaces
from wrf_mi.training.config import calibration_config
from wrf_mi.training.trainer import Trainer

OPTIONS = TraceOptions(depth=2, transmission=True, rays=4096)
FILE_M = 1e-6  # Corners of mesh files are float32: 5e-7 m at 6 m, and as much again after a reflection
GAIN = 3e-6  # Relative; gains change with lengths, which follow float32 corners
SHIFT_M, TILT_RAD = 0.05, 0.02
TURNED = np.array([[np.cos(TILT_RAD), 0, np.sin(TILT_RAD)], [0, 1, 0], [-np.sin(TILT_RAD), 0, np.cos(TILT_RAD)]])


def ceiling(shift_m, tilted):
    """The ceiling, shifted upwards, tilted about y through its centre."""
    mesh, centre = sheet(2, HEIGHT, (0.0, LENGTH), (0.0, WIDTH)), np.array([LENGTH / 2, WIDTH / 2, HEIGHT])
    mesh.vertices = (np.asarray(mesh.vertices) - centre) @ (TURNED if tilted else np.eye(3)).T + centre
    mesh.vertices[:, 2] += shift_m / (TURNED[2, 2] if tilted else 1)
    return {"ceiling": ("itu_metal", mesh)}


def ceiling_of(scene):
    """Planes of a scene, and which of them the ceiling has."""
    surfaces = scene_surfaces(scene)
    return surfaces, int(surfaces.plane[surfaces.first_face[surfaces.names.index("ceiling")]])


def moved_values(scene, shift_m, tilted):
    """Parameters that move the ceiling of `scene` as `ceiling` does."""
    surfaces, plane = ceiling_of(scene)
    shift, tilt, up = np.zeros(len(surfaces.normal)), np.zeros((len(surfaces.normal), 2)), surfaces.normal[plane, 2]
    shift[plane] = shift_m * up
    if tilted:  # a tilt is the tangent of the angle: (n + t a + t b) is normalised
        tilt[plane] = surfaces.axes[plane] @ [np.tan(TILT_RAD) * up, 0.0, 0.0]
    return {SHIFT: shift, TILT: tilt}


def tensors(values):
    return {name: Tensor64(np.asarray(value, float)) for name, value in values.items()}


def strongest(traced, parameters):
    """Lengths of all paths in ascending order, and their gains."""
    paths, exists = traced(parameters), traced.exists
    length, gain = paths.length_m.numpy()[exists], (paths.gain[0].numpy() + 1j * paths.gain[1].numpy())[exists]
    order = np.argsort(length)
    return length[order], gain[order]


def assert_same_paths(paths, expected):
    """To the rounding of mesh files."""
    np.testing.assert_allclose(paths[0], expected[0], atol=FILE_M)
    np.testing.assert_allclose(paths[1], expected[1], rtol=GAIN, atol=GAIN * np.abs(paths[1]).max())


@pytest.mark.parametrize(("shift_m", "tilted"), [(SHIFT_M, False), (0.0, True), (-SHIFT_M, True)])
def test_paths_at_moved_planes_are_those_of_a_moved_mesh(tmp_path, shift_m, tilted):
    """Lengths and gains of reflections at a shifted and tilted ceiling, from a mesh of it and from parameters."""
    options, array = TracedOptions(replace(OPTIONS, depth=1)), receiver((30, 20, 10))
    stated_field = TracedField(room(tmp_path / "stated", CEILING), transmitters(4), array, options)
    moved = TracedField(room(tmp_path / "moved", ceiling(shift_m, tilted)), transmitters(4), array, options)
    paths = strongest(stated_field, tensors(moved_values(stated_field.scene, shift_m, tilted)))
    assert len(paths[0]) == 8
    assert_same_paths(paths, strongest(moved, {}))
    assert np.abs(paths[0] - strongest(stated_field, {})[0]).max() > 0.005


def test_zero_parameters_leave_paths_unchanged(box):
    """To rounding; surfaces start from their named material."""
    plain = TracedField(box, transmitters(3), receiver(), TracedOptions(OPTIONS))
    each = TracedField(box, transmitters(3), receiver(), TracedOptions(OPTIONS, materials="surface", planes=True))
    assert not {SHIFT, TILT} & set(plain.parameters())
    assert {SHIFT, TILT} <= set(each.parameters())
    for ours, theirs in (({}, {}), (each.parameters(), plain.parameters())):
        length, gain = strongest(each, tensors(ours))
        expected = strongest(plain, tensors(theirs))
        np.testing.assert_allclose(length, expected[0], rtol=1e-14)
        np.testing.assert_allclose(gain, expected[1], rtol=1e-12, atol=1e-18)


def test_fixed_planes_take_no_kernels(box):
    """Without parameters of planes the kernels are those of a field without movable planes."""

    def kernels(planes, *names):
        traced = TracedField(box, transmitters(3), receiver(), TracedOptions(OPTIONS, planes=planes))
        parameters = tensors({name: traced.parameters()[name] for name in ("receiver.array.gain", *names)})
        dr.enable_grad(parameters)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            paths = traced(parameters)
            dr.backward(dr.sum(paths.gain[0] * paths.length_m))
            dr.eval([dr.grad(value) for value in parameters.values()])
            return [entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])]

    assert kernels(False) == kernels(True) != kernels(True, SHIFT)


def test_each_surface_has_a_material(box):
    """A surface's material changes only the paths that meet the surface."""
    options = TracedOptions(replace(OPTIONS, depth=1), materials="surface")
    traced = TracedField(box, transmitters(2), receiver(), options)
    names = [name.partition("/")[0] for name in traced.slabs.names]
    assert sorted(names) == sorted({**WALLS, **CEILING, **PARTITION})
    values, permittivity = traced.parameters(), "material.surface.permittivity"
    assert values[permittivity].shape == values["material.surface.conductivity"].shape == (len(names),)
    before, changes = strongest(traced, tensors(values))[1], {}
    for name in ("west", "north", "partition"):
        raised = values[permittivity] + (np.array(names) == name)
        after = strongest(traced, tensors({**values, permittivity: raised}))[1]
        changes[name] = np.flatnonzero(np.abs(after - before) > 1e-6 * np.abs(before))
    assert all(0 < len(places) < len(before) for places in changes.values())
    assert not set(changes["west"]) & set(changes["north"])


@pytest.mark.parametrize("grouping", ["named", "surface"])
def test_material_that_is_not_a_slab_is_refused(grouping, box):
    traced = TracedField(box, transmitters(2), receiver(), TracedOptions(OPTIONS, materials=grouping))
    traced._slab_of_face[:] = -1  # as of a material without a permittivity
    with pytest.raises(InputError, match="is not a slab"):
        traced.search(receiver().position_m)


def record_of(receivers, tx, observation, task):
    hz = FREQUENCY_HZ * np.array([1, 1.02] if task == "csi" else [1])
    return Record("room", task, tx, receivers, observation, frequencies_hz=hz)


def trainer_of(record, scene, groups, *settings):
    """Paths alone, trained on all rows."""
    rows, ends = np.arange(len(record)), ("holdout_steps_fraction=0", "patience=0", f"batch={len(record)}")
    common = "traced.rays=4096", "optimiser.warm_up=10", *ends, *settings
    config = with_settings(calibration_config(groups.split(","), record.task.settings_of_paths), common)
    return Trainer(record, Split("all", 0, rows, rows[:0], rows[:0]), config, scene=scene)


def test_training_finds_a_lowered_and_tilted_ceiling(box, tmp_path):
    tx, model = transmitters(12, seed=3), CsiReceiver(2, 4, (FREQUENCY_HZ, 1.02 * FREQUENCY_HZ))
    options = TracedOptions(replace(OPTIONS, depth=1), planes=True)
    true = TracedField(room(tmp_path, {**WALLS, **ceiling(-0.02, True), **PARTITION}), tx, receiver(), options)
    observed = model(true({}), None).numpy().reshape(len(tx), -1, 2).astype(float) @ [1, 1j]
    record = record_of((receiver(),), tx, observed[None].astype(np.complex64), "csi")
    rates = "traced.shift=0.002", "traced.tilt=0.002", "traced.depth=1", "traced.reflections=1", "steps=500"
    trainer = trainer_of(record, box, "planes", *rates)
    assert set(trainer.state.adam) == {SHIFT, TILT}
    trainer.run()
    assert np.abs(trainer.predictor()(tx) - observed).mean() < 0.02 * np.abs(observed).mean()
    surfaces, plane = ceiling_of(box)

    def height(parameters):
        """At the reflections, not at the centre: over 0.3 m of the ceiling, shift and tilt are hardly distinct."""
        normals, offset_m = surfaces.moved_planes(parameters[SHIFT], parameters[TILT])
        return float((offset_m[plane] - normals[plane, :2] @ [3.0, 2.3]) / normals[plane, 2])

    expected = height(moved_values(box, -0.02, True))
    assert height(trainer.state.params()) == pytest.approx(expected, abs=3e-3)
    assert abs(expected - HEIGHT) > 0.015


def test_receivers_share_planes_and_keep_their_recordings(box):
    """A new search at a receiver, and its steps, leave the recorded steps of the others unchanged."""
    moving = replace(receiver((10, 5, 0)), array_m=planar_array(3, 3, 0.16))
    other = replace(moving, name="tag", position_m=np.array([1.0, 4.0, 2.0]))
    tx, spectra = transmitters(4), np.random.default_rng(0).uniform(0, 1, (2, 4, 8, 16)).astype(np.float32)
    record = record_of((moving, other), tx, spectra, "spectrum")
    settings = "traced.materials=surface", "traced.material=0.05", "traced.position=1e-4", "steps=40"
    trainer = trainer_of(record, box, "planes", "traced.depth=2", *settings)
    names = {SHIFT, TILT, "material.surface.permittivity", "receiver.array.position", "receiver.tag.position"}
    assert names <= set(trainer.state.adam)
    trainer.run(stop=stop_after(10))
    recorded, before = trainer.steps.recorded, trainer.state.params()
    first, second = recorded[0, 0, False], recorded[1, 0, False]
    recordings = second.frozen.n_recordings
    # As a step does once the receiver has moved by more than a quarter of a wavelength.
    trainer.plan.traced_fields[0].search(moving.position_m + np.array([0.05, 0, 0]))
    trainer.run(stop=stop_after(6))
    recorded = trainer.steps.recorded
    assert [field.searches for field in trainer.plan.traced_fields] == [1, 0]
    assert recorded[0, 1, False] is not first
    assert recorded[1, 0, False] is second
    assert (0, 0, False) not in recorded
    assert second.frozen.n_recordings == recordings
    # Steps at either receiver move the planes.
    assert np.abs(trainer.state.params()[SHIFT] - before[SHIFT]).max() > 0


def test_planes_have_no_learning_rate_by_default(box):
    """Every parameter has a rate, and a prefix by which training recognises it."""
    options, fixed = TracedOptions(OPTIONS, 1, materials="surface", planes=True), TracedConfig()
    free = TracedConfig(shift=0.01, tilt=0.02)
    names = TracedField(box, transmitters(1), receiver(), options).parameters()
    assert all(name.startswith(TRACED_NAMES) for name in names)
    still = {SHIFT, TILT, "receiver.array.position", "receiver.array.turn"}
    assert {name for name in names if fixed.rate(name) == 0} == still
    assert (free.rate(SHIFT), free.rate(TILT)) == (0.01, 0.02)
    assert (free.moves_planes, fixed.moves_planes) == (True, False)


def test_corrected_scene_has_moved_planes_and_stays_closed(box, tmp_path):
    """Its paths are those of the parameters; the corners of the room stay shared."""
    rng, options, tx = np.random.default_rng(2), TracedOptions(replace(OPTIONS, depth=1)), transmitters(3)
    traced = TracedField(box, tx, receiver((30, 20, 10)), replace(options, planes=True))
    count = len(traced.surfaces.normal)
    values = {SHIFT: rng.normal(0, 0.02, count), TILT: rng.normal(0, 0.01, (count, 2))}
    again = open_scene(write_corrected_scene(tmp_path / "corrected", box, values), FREQUENCY_HZ)
    expected = strongest(TracedField(again, tx, receiver((30, 20, 10)), options), {})
    assert_same_paths(strongest(traced, tensors(values)), expected)
    for scene in (box, again):  # eight of the room and four of the partition, before as after
        assert len(np.unique(np.round(scene_surfaces(scene).triangles.reshape(-1, 3), 4), axis=0)) == 12
    with pytest.raises(ValueError, match="planes"):
        write_corrected_scene(tmp_path / "other", box, {SHIFT: np.zeros(count + 1)})


def test_plain_sionna_rt_opens_a_corrected_scene_below_the_range_of_its_materials(box, tmp_path):
    from sionna import rt

    write_corrected_scene(tmp_path / "corrected", box, {})
    plain = rt.load_scene(str(tmp_path / "corrected" / "scene.xml"), merge_shapes=False)
    plain.frequency = FREQUENCY_HZ  # Sionna RT knows concrete from 1 GHz
    for name, thing in plain.objects.items():
        material = box.objects[name].radio_material
        for quantity in ("relative_permittivity", "conductivity", "thickness"):
            values = (
                float(np.ravel(getattr(radio_material, quantity))[0])
                for radio_material in (thing.radio_material, material)
            )
            assert next(values) == pytest.approx(next(values), rel=1e-4), (name, quantity)


def test_corrected_scene_has_the_fitted_constants_of_named_materials(box, tmp_path):
    """Training has one number for each quantity of a material, in an array of one."""
    slabs, name = read_materials(box), next(iter(box.objects.values())).radio_material.name
    permittivity = slabs.permittivity[slabs.names.index(name)]
    raised = {f"material.{name}.permittivity": np.log([permittivity + 1.0])}  # permittivity 1 + exp(x)
    again = open_scene(write_corrected_scene(tmp_path / "corrected", box, raised), FREQUENCY_HZ)
    assert np.isclose(read_materials(again).permittivity, permittivity + 2.0, rtol=1e-5).any()
