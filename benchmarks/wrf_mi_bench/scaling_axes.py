"""Cost against work: what each part of the package is measured on when its sizes grow."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from wrf_mi_scenes.divided import cluttered_room, divided_room

from wrf_mi.backend.device import to_float, to_tensor
from wrf_mi.core import Receiver, Record
from wrf_mi.core.arrays import planar_array
from wrf_mi.gaussians import FIELDS, InitialGaussians, random_gaussians
from wrf_mi.gaussians.chunks import gaussians_in_parts
from wrf_mi.gaussians.render import splat
from wrf_mi.gaussians.tiles import perception_plane
from wrf_mi.models.physics.selection import kind_of
from wrf_mi.receivers import bartlett_spectrum, element_signals
from wrf_mi.receivers.instruments import SpectrumInstrument
from wrf_mi.runs.timing import Call
from wrf_mi.synthetic.laboratory import FREQUENCY_HZ, RECEIVER, SPACING_M, transmitter_path
from wrf_mi.tracing import TraceOptions, open_scene, trace_paths
from wrf_mi.tracing.surfaces import scene_surfaces
from wrf_mi.tracing.tracer import RayTracer
from wrf_mi.training.config import TrainConfig
from wrf_mi.training.fields import make_field
from wrf_mi.training.predictor import Predictor
from wrf_mi.training.step import device_pose

from .traced import random_field, scene_of

HEIGHT, WIDTH = 90, 360
COVER_DEG2 = 7.0**2 * 270
"""Squared angular size times number: that of the default field, so that as many Gaussians overlap at every number."""
GAUSSIANS, ELEMENTS = 1000, 16
"""Where another size grows."""
SMALL = 90
"""Gaussians of the field that predicts for thousands of transmitters."""
OPTIONS = TraceOptions(max_depth=2, rays=1 << 14)

Make = Callable[[int], Call]


@dataclass(frozen=True)
class Axis:
    """One call whose cost is measured while one size grows.

    Attributes:
        name: of the axis, for JSON.
        title: what is called, for the table.
        work: what the size counts.
        sizes: ascending.
        make: makes the call ready for a size; not part of the time.
    """

    name: str
    title: str
    work: str
    sizes: tuple[int, ...]
    make: Make


def _pose(receiver: Receiver) -> Any:
    return device_pose(receiver)


def _splat(count: int, height: int = HEIGHT, width: int = WIDTH) -> Call:
    gaussians, receiver = random_field(0, "alpha", count, float(np.sqrt(COVER_DEG2 / count)), opacity=0.4)
    pose, plane = _pose(receiver), perception_plane(height, width, mi.Float)
    return lambda: splat(gaussians, pose, plane)


def _splat_directions(directions: int) -> Call:
    finer = round(np.sqrt(directions / (HEIGHT * WIDTH)))
    return _splat(GAUSSIANS, HEIGHT * finer, WIDTH * finer)


def _integrator(count: int) -> Call:
    """`mi.render` after the geometry changed, Mitsuba's BVH included."""
    gaussians, receiver = random_field(0, "alpha", count, float(np.sqrt(COVER_DEG2 / count)), opacity=0.4)
    scene = scene_of(gaussians, receiver)
    params = mi.traverse(scene)
    data = params["gaussians.data"].numpy().copy()

    def call() -> Any:
        params["gaussians.data"] = to_float(data)
        params.update()
        return mi.render(scene)

    return call


def _start(count: int) -> InitialGaussians:
    return random_gaussians([RECEIVER], count, np.random.default_rng(0), size_deg=float(np.sqrt(COVER_DEG2 / count)))


def _networks(count: int) -> Call:
    """Both the geometry and the signals of WRF-GS+ for one transmitter, by its networks."""
    field = FIELDS["wrf-gs+"]()
    params = {k: to_tensor(v) for k, v in field.init(_start(count), np.random.default_rng(0)).items()}
    tx = to_tensor(transmitter_path(1).T)
    return lambda: vars(gaussians_in_parts(field, params, tx))


def _field(transmitters: int) -> Call:
    field = make_field(TrainConfig().resolved(transmitter_path(transmitters)))
    predictor = Predictor(field, field.init(_start(SMALL), np.random.default_rng(0)), [RECEIVER], HEIGHT, WIDTH)
    tx = transmitter_path(transmitters)
    return lambda: predictor(tx)


def _instrument() -> SpectrumInstrument:
    array_m = planar_array(4, 4, SPACING_M)
    receivers = (replace(RECEIVER, array_m=array_m),)
    return SpectrumInstrument(receivers, np.array([FREQUENCY_HZ]), size=(HEIGHT, WIDTH))


def _tracer(transmitters: int) -> Call:
    tracer, tx = RayTracer("laboratory", _instrument(), OPTIONS), transmitter_path(transmitters)
    return lambda: tracer(tx)


def _physics(transmitters: int) -> Call:
    """The physics model's prediction in a room without training rows: the physics alone."""
    one = transmitter_path(1)
    image = np.zeros((1, 1, HEIGHT, WIDTH), np.float32)
    instrument = _instrument()
    own = instrument.receivers, image
    record = Record("none", "spectrum", one, *own, frequencies_hz=instrument.frequencies_hz)
    kind = kind_of(record, True)
    scene = open_scene("laboratory", FREQUENCY_HZ)
    model = kind.fit(record, np.zeros(0, np.int64), scene, kind.settings(), 0, lambda what, share: None)
    tx = transmitter_path(transmitters)
    return lambda: model.predict(tx, 0).mean


def _square(elements: int) -> Any:
    side = int(np.sqrt(elements))
    return planar_array(side, side, SPACING_M)


@cache
def _paths() -> Any:
    scene = open_scene("laboratory", FREQUENCY_HZ)
    return trace_paths(scene, transmitter_path(64), RECEIVER, OPTIONS).paths


def _antennas_of_paths(elements: int) -> Call:
    array_m = _square(elements)
    return lambda: element_signals(_paths(), RECEIVER, array_m, FREQUENCY_HZ)


def _spectrum_of(elements: int, height: int = HEIGHT, width: int = WIDTH) -> Call:
    rng, array_m = np.random.default_rng(0), _square(elements)
    signals = rng.standard_normal((8, elements)) + 1j * rng.standard_normal((8, elements))
    return lambda: bartlett_spectrum(signals, array_m, FREQUENCY_HZ, height, width)


def _spectrum_of_directions(directions: int) -> Call:
    finer = round(np.sqrt(directions / (HEIGHT * WIDTH)))
    return _spectrum_of(ELEMENTS, HEIGHT * finer, WIDTH * finer)


def _opened(kind: str, triangles: int) -> Any:
    near = np.concatenate([transmitter_path(1), RECEIVER.position_m[None]])
    mesh = divided_room(triangles) if kind == "walls" else cluttered_room(triangles, near)
    with tempfile.TemporaryDirectory() as work:
        file = Path(work) / "room.ply"
        mesh.export(file, vertex_normal=False)
        return open_scene(file, FREQUENCY_HZ, material="concrete")


def _trace(kind: str, triangles: int) -> Call:
    """One transmitter in an opened mesh: its planes, rays, paths and gains."""
    scene, tx = _opened(kind, triangles), transmitter_path(1)
    return lambda: len(trace_paths(scene, tx, RECEIVER, OPTIONS).paths)


def _planes(kind: str, triangles: int) -> Call:
    scene = _opened(kind, triangles)
    return lambda: len(scene_surfaces(scene).normal)


TENS, HALF_TENS = (10**3, 10**4, 10**5, 300_000, 10**6), (1000, 3000, 10_000, 30_000, 100_000)
DIRECTIONS = tuple(HEIGHT * WIDTH * k for k in (1, 4, 9, 16))
ANTENNAS, TRANSMITTERS = (16, 64, 256, 1024), (1, 16, 256, 4096)
TRIANGLES = (10**2, 10**3, 10**4, 10**5, 10**6)

AXES: list[Axis] = [
    Axis("gaussians-splat", "splatting", "Gaussians", TENS, _splat),
    Axis("gaussians-integrator", "Mitsuba integrator, geometry new", "Gaussians", HALF_TENS, _integrator),
    Axis("gaussians-networks", "networks of WRF-GS+", "Gaussians", HALF_TENS, _networks),
    Axis("directions-splat", "splatting", "directions", DIRECTIONS, _splat_directions),
    Axis("directions-array", "Bartlett spectrum", "directions", DIRECTIONS, _spectrum_of_directions),
    Axis("antennas-paths", "paths", "antennas", ANTENNAS, _antennas_of_paths),
    Axis("antennas-spectrum", "Bartlett spectrum", "antennas", ANTENNAS, _spectrum_of),
    Axis("transmitters-field", "WRF-GS+ of 90 Gaussians", "transmitters", TRANSMITTERS, _field),
    Axis("transmitters-physics", "physics", "transmitters", TRANSMITTERS, _physics),
    Axis("transmitters-tracer", "ray tracer", "transmitters", TRANSMITTERS, _tracer),
    Axis("triangles-planes", "finding planes, divided walls", "triangles", TRIANGLES, partial(_planes, "walls")),
    Axis("triangles-walls", "one trace, divided walls", "triangles", TRIANGLES, partial(_trace, "walls")),
    Axis("triangles-clutter", "one trace, clutter", "triangles", TRIANGLES, partial(_trace, "clutter")),
]
"""All that is measured. Networks and integrator end at 1e5 Gaussians: a call of ten times as many takes gigabytes."""
