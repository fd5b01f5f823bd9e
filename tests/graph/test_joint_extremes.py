"""Gaussians and paths in one graph in ill-conditioned geometries, values and derivatives."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from box_room import CEILING, FREQUENCY_HZ, HEIGHT, LENGTH, WALLS, WIDTH, receiver, room
from scipy.constants import speed_of_light
from wrf_mi_scenes.build_laboratory import sheet

from wrf_mi.backend.device import on_device
from wrf_mi.backend.vectors import Float64
from wrf_mi.core import Antenna
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import Encoding, WrfGsPlus, random_gaussians
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.graph.evaluations import learned_field
from wrf_mi.receivers.receiver_models import ArrayReceiver, CsiReceiver, PixelReceiver, PowerReceiver
from wrf_mi.tracing import TraceOptions
from wrf_mi.tracing.paths.instrument_parameters import receiver_pose
from wrf_mi.tracing.paths.traced_field import TracedField, TracedOptions

VALUE, GRADIENT = 1e-4, 1e-3  # bounds on relative errors in norm of float32, as in the stress benchmark
DIFFERENCE = 1e-5  # of central differences in float64, relative to the sum of the terms' magnitudes
STEP = 1e-6  # of the differences, in natural steps of the parameters (`natural`)
SIZE, ELEMENTS_M = (8, 24), planar_array(3, 3, 0.16)
MODELS: dict[str, Any] = {
    "array": ArrayReceiver(*SIZE, ELEMENTS_M, FREQUENCY_HZ),
    "pixel": PixelReceiver(*SIZE, ELEMENTS_M, FREQUENCY_HZ),
    "rssi": PowerReceiver(*SIZE, (FREQUENCY_HZ,)),
    "csi": CsiReceiver(*SIZE, (FREQUENCY_HZ, 1.01 * FREQUENCY_HZ)),
}
FLOOR = {"floor": ("itu_glass", sheet(2, 0.0, (0.0, LENGTH), (0.0, WIDTH)))}
# A door and a panel in a wall's plane, and a partition of two layers 2 cm apart.
COPLANAR = {
    "door": ("itu_glass", sheet(0, 0.0, (1.0, 3.5), (0.0, 2.1))),
    "panel": ("itu_metal", sheet(1, WIDTH, (1.5, 4.5), (0.2, 2.0))),
    "partition": ("itu_plasterboard", sheet(0, 3.1, (0.0, 2.6), (0.0, 2.0))),
    "layer": ("itu_plasterboard", sheet(0, 3.12, (0.0, 2.6), (0.0, 2.0))),
}
LOW_M = 1e-3  # height of both antennas above the floor: line of sight and reflection cancel to a thousandth
LEFT = 0.01  # remaining share of the paths where the Gaussians cancel them
NEAR_M = np.array([[1.9, 1.8, 1.3], [2.1, 1.7, 1.2]])
PLACES: dict[str, tuple[Any, Any, Any]] = {
    "coplanar planes": (COPLANAR, NEAR_M, (4.2, 2.9, 0.4)),
    "grazing paths": ({}, np.array([[0.6, 1.8, LOW_M], [0.5, 2.9, 2 * LOW_M]]), (5.6, 2.9, LOW_M)),
    # Searched 2 cm in front of a wall and evaluated on it, where its reflection and the direct path coincide.
    "antenna on a wall": ({}, NEAR_M, (LENGTH - 0.02, 2.9, 1.4)),
    "cancelling components": ({}, NEAR_M[:1], (4.2, 2.9, 0.4)),
    "many paths": ({}, np.random.default_rng(5).uniform(0.15, 0.85, (160, 3)) * (LENGTH, WIDTH, HEIGHT), (4, 2.9, 0.4)),
}
"""Parts of the scene beside the room, transmitters and receiver by name."""


def natural(name: str) -> float:
    """A step of a parameter that changes phases or logarithms by about 1."""
    return speed_of_light / (2 * np.pi * FREQUENCY_HZ) if name.endswith((".position", ".shift")) else 1.0


def rounded(values: dict[str, Any]) -> dict[str, np.ndarray]:
    return {name: np.asarray(value, np.float32).astype(float) for name, value in values.items()}


def tensor(value: Any, kind: Any) -> Any:
    array = np.ascontiguousarray(value)
    tensor_type: Any = dr.tensor_t(kind)
    return tensor_type(on_device(array.ravel(), kind), array.shape)


class Joint:
    """Both components at a place, and parameters that float32 holds."""

    def __init__(self, name: str, folder: Any) -> None:
        parts, self.tx_pos_m, position_m = PLACES[name]
        rng = np.random.default_rng(7)
        self.receiver = replace(receiver((30, 20, 10), position_m), antenna=Antenna(frame="array"))
        depth = 3 if name in ("coplanar planes", "many paths") else 2
        options = TraceOptions(depth=depth, reflections=2, transmission=bool(parts), rays=1 << 13)
        how = TracedOptions(options, 2, materials="surface", planes=True)
        self.traced = TracedField(
            room(folder, {**WALLS, **CEILING, **FLOOR, **parts}), self.tx_pos_m, self.receiver, how
        )
        # An encoding of positions that hardly changes, as it is detached.
        self.field = WrfGsPlus(encoding=Encoding(1, 1e6, 2), layers=2, width=16, skip=1)
        start = self.field.init(random_gaussians([self.receiver], 25, rng, opacity=0.4, signal=0.5), rng)
        values: dict[str, Any] = {f"field.{key}": value for key, value in start.items()} | self.traced.parameters()
        values["field.rotation"] = rng.normal(size=values["field.rotation"].shape)
        values[self.traced.gain_name] = values[self.traced.gain_name] + [np.log(100.0), 0.0]
        if name == "coplanar planes":
            for key, size in {"plane.shift": 1e-3, "plane.tilt": 0.01, "pattern.transmitter": 0.01}.items():
                values[key] = rng.normal(0, size, values[key].shape)
        elif name == "antenna on a wall":
            values["receiver.array.position"] = [0.02, 0, 0]
        self.values = rounded(values)
        if name == "cancelling components":
            learned, traced = (
                self.observation(MODELS["csi"], component=component) for component in ("learned", "traced")
            )
            factor = -(learned[0] + 1j * learned[1]) / (traced[0] + 1j * traced[1]) * (1 + LEFT)
            gain = self.values[self.traced.gain_name] + [np.log(np.abs(factor)), np.angle(factor)]
            self.values = rounded(self.values | {self.traced.gain_name: gain})

    def observation(
        self, model: Any, kind: Any = Float64, values: Any = None, component: str = "", weight: Any = None
    ) -> Any:
        """Observation [n] of both components or one, with ``weight`` also derivatives of its weighted sum by name."""
        params = {name: tensor(value, kind) for name, value in (self.values | (values or {})).items()}
        dr.enable_grad(params)
        field_parameters = {name.removeprefix("field."): p for name, p in params.items() if name.startswith("field.")}
        pose, plane = receiver_pose(self.receiver, params, kind), perception_plane(*SIZE, kind)
        learned = learned_field(
            self.field.gaussians(field_parameters, tensor(self.tx_pos_m.T, kind)), pose, plane, model.sphere
        )
        observation = model(
            None if component == "learned" else self.traced(params), None if component == "traced" else learned
        )
        shown = dr.detach(observation).numpy().astype(float)
        if weight is None:
            return shown
        dr.backward(dr.sum(observation * on_device(weight, kind)))
        return shown, {name: np.asarray(dr.grad(p).numpy(), float) for name, p in params.items()}


@pytest.mark.parametrize(
    ("name", "receivers"),
    [
        ("grazing paths", ("rssi",)),
        # Some 150 kernels each, of which most tests have none: 5 to 20 seconds.
        *(pytest.param(name, tuple(MODELS), marks=pytest.mark.slow) for name in PLACES),
    ],
)
def test_joint_graph_of_float32_is_that_of_float64(name, receivers, tmp_path):
    """And derivatives by the paths' parameters in float64 are central differences."""
    joint, rng = Joint(name, tmp_path), np.random.default_rng(3)
    values = joint.values.items()
    scales = {key: np.abs(value) if key.startswith("field.") else natural(key) for key, value in values}
    # The receiver's pose moves Gaussians over edges of pixels, where observations jump.
    paths = [key for key in scales if not key.startswith(("field.", "receiver.array.position", "receiver.array.turn"))]
    for kind in receivers:
        model = MODELS[kind]
        weight = rng.normal(size=len(joint.tx_pos_m) * int(np.prod(model.shape))).astype(np.float32)
        (observation, single), (expected, slopes) = (
            joint.observation(model, of, weight=weight) for of in (mi.Float, Float64)
        )
        # A sum of waves that cancel is accurate to the waves.
        waves = (
            [expected]
            if kind == "rssi"
            else [joint.observation(model, component=component) for component in ("traced", "learned")]
        )
        assert np.linalg.norm(observation - expected) < VALUE * max(map(np.linalg.norm, waves)), kind
        norms = {key: np.linalg.norm(slope * scales[key]) for key, slope in slopes.items()}
        for key, slope in slopes.items():
            error = np.linalg.norm((single[key] - slope) * scales[key])
            assert error < GRADIENT * max(norms[key], GRADIENT * max(norms.values())), (kind, key)
        steps = {key: rng.normal(size=slopes[key].shape) * natural(key) for key in paths}
        above, below = (
            joint.observation(model, values={key: joint.values[key] + size * steps[key] for key in paths}) @ weight
            for size in (STEP, -STEP)
        )
        analytic = sum(float((slopes[key] * step).sum()) for key, step in steps.items())
        largest = sum(np.linalg.norm(slopes[key] * step) for key, step in steps.items())
        assert abs((above - below) / (2 * STEP) - analytic) < DIFFERENCE * largest, kind
