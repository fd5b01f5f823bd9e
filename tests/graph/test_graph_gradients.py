"""Gradients of Gaussians and paths in one graph by every kind of parameter, against differences in float64."""

from fnmatch import fnmatchcase

import drjit as dr
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, PARTITION, WALLS, receiver, room, transmitters
from double_precision import Tensor64

from wrf_mi.backend.vectors import Float64
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Encoding, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.options import FACTOR
from wrf_mi.tracing.paths.instrument_parameters import receiver_pose
from wrf_mi.tracing.paths.surface_gaussians import SurfaceGaussians
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions

TOLERANCE = 1e-6
"""Error of a derivative along a direction of standard normal numbers, relative to the gradient's norm: the standard
deviation of such derivatives. Central differences in float64."""
ROUNDING = 2e-15
"""Rounding of the terms of the loss, relative to the sum of their magnitudes; differences divide it by the step."""
SIZE_M = 0.3  # Standard deviation of Gaussians on surfaces
STEP = 1e-6  # So small that no pixel crosses a footprint's cut-off, where the field jumps
HEIGHT, WIDTH, BATCH = 12, 40, 2
ELEMENTS_M = planar_array(3, 3, 0.16)

MODELS = {
    "pixel": PixelReceiver(HEIGHT, WIDTH, ELEMENTS_M, FREQUENCY_HZ, "coherent"),
    "pixel-power": PixelReceiver(HEIGHT, WIDTH, ELEMENTS_M, FREQUENCY_HZ, "power"),
    "array": ArrayReceiver(HEIGHT, WIDTH, ELEMENTS_M, FREQUENCY_HZ, "coherent", instrument_scale=True),
    "rssi": PowerReceiver(HEIGHT, WIDTH, (FREQUENCY_HZ,)),
    "csi": CsiReceiver(HEIGHT, WIDTH, (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ)),
}


KINDS = (
    *("material.*.permittivity", "material.*.conductivity", "plane.shift", "plane.tilt", "receiver.array.gain"),
    *("receiver.array.position", "receiver.array.turn", "receiver.array.pattern", "pattern.transmitter"),
    *("field.position", "field.log_scale", "field.rotation", "field.opacity", "field.signal", FACTOR),
)
"""Kinds of parameters; the field has networks, too."""


@pytest.fixture(scope="module")
def both(request, tmp_path_factory):
    """A traced component with reflections and transmissions, a learned one, and generic values of all parameters."""
    rng = np.random.default_rng(5)
    scene, array = room(tmp_path_factory.mktemp("room"), {**WALLS, **CEILING, **PARTITION}), receiver((30, 20, 10))
    options = TraceOptions(depth=2, transmission=True, rays=4096)
    how = TracedOptions(options, pattern_degree=2, materials=request.param, planes=True)
    traced = TracedField(scene, transmitters(BATCH), array, how)
    values = {name: value.astype(float) for name, value in traced.parameters().items()}
    values[traced.gain_name][0] = np.log(300.0)  # the learned component's size
    met = traced.interactions
    gaussians = SurfaceGaussians(np.column_stack([met.position_m, met.normal])[::5].T, SIZE_M)
    traced.attach(gaussians)
    values[FACTOR] = rng.normal(0, 0.2, (2, len(gaussians)))
    # An encoding of positions that hardly changes: it is detached on purpose, so differences alone would see it.
    encoding = Encoding(position_octaves=1, position_scale_m=1e12, tx_octaves=2)
    field = WrfGsPlus(encoding=encoding, layers=3, width=16, skip=2)
    start = field.init(random_gaussians([array], 25, rng, opacity=0.4), rng)
    start["log_scale"] += rng.normal(0, 0.3, start["log_scale"].shape).astype(np.float32)
    start["rotation"] = rng.standard_normal(start["rotation"].shape).astype(np.float32)
    values |= {f"field.{name}": value.astype(float) for name, value in start.items()}
    moved = ("receiver.array.position", "receiver.array.turn", "receiver.array.pattern", "pattern.transmitter")
    for name in (*moved, "receiver.array.gain", "plane.shift", "plane.tilt"):
        values[name] += rng.normal(0, 0.02, values[name].shape)
    return traced, field, values


def terms_of(both, model, weight):
    """The weighted observation of a receiver, whose sum is the loss."""
    traced, field, _ = both
    plane, tx_pos = perception_plane(HEIGHT, WIDTH, Float64), Tensor64(np.ascontiguousarray(traced.tx_pos_m.T))

    def terms(parameters):
        field_parameters = {
            name.removeprefix("field."): v for name, v in parameters.items() if name.startswith("field.")
        }
        pose = receiver_pose(traced.receiver, parameters, Float64)
        learned = learned_field(field.gaussians(field_parameters, tx_pos), pose, plane, model.sphere)
        return model(traced(parameters), learned) * weight

    return terms


@pytest.mark.gradcheck
@pytest.mark.parametrize(
    ("both", "name"), [*(("named", name) for name in MODELS), ("surface", "csi")], indirect=["both"]
)
def test_gradients_of_both_components(name, both):
    model, rng = MODELS[name], np.random.default_rng(2)
    terms = terms_of(both, model, Float64(rng.standard_normal(BATCH * int(np.prod(model.shape)))))
    parameters = {n: Tensor64(value) for n, value in both[2].items()}
    dr.enable_grad(parameters)
    dr.backward(dr.sum(terms(parameters)))
    gradient = {n: dr.grad(p).numpy() for n, p in parameters.items()}
    parameters = {n: dr.detach(p) for n, p in parameters.items()}
    rounding, errors = ROUNDING * float(np.abs(terms(parameters).numpy()).sum()) / STEP, {}
    for n, p in parameters.items():
        direction = rng.standard_normal(p.shape)
        ends = [terms(parameters | {n: Tensor64(p.numpy() + s * STEP * direction)}).numpy().sum() for s in (1, -1)]
        numeric, analytic = (ends[0] - ends[1]) / (2 * STEP), float((gradient[n] * direction).sum())
        errors[n] = abs(numeric - analytic) / (TOLERANCE * np.linalg.norm(gradient[n]) + rounding)
    assert all(any(fnmatchcase(n, kind) for n in gradient) for kind in KINDS)
    # Rounding hides only slopes of a metal, which waves do not enter.
    hidden = {n for n, slope in gradient.items() if rounding > 0.01 * np.linalg.norm(slope)}
    assert hidden <= {"material.itu_metal.permittivity", "material.itu_metal.conductivity"}
    assert max(errors.values()) < 1, errors
