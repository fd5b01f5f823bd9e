"""Evaluation of the Gaussians of a graph on a receiver's directions, by name.

``splatted`` projects Gaussians to the plane of directions. ``traced`` follows rays through them with the Mitsuba plugin
`wrf_traced`: the package of the plugins adds it by an entry point.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import drjit as dr

from ..backend.vectors import Complex, Pose
from ..core import InputError
from ..core.registry import Registry
from ..gaussians import Gaussians
from ..gaussians.blend import splat
from ..gaussians.tiles import TiledPlane
from .settings import SPLATTED, TracedConfig


class Evaluation:
    """Complex signal of Gaussians on a receiver's directions, here splatted: walls of a scene have no effect.

    ``scene`` is from `wrf_mi.tracing.open_scene`, None without one, ``traced`` has the parameters that are trained.
    ``recordable``: whether Dr.Jit can record a call (`dr.freeze`).
    """

    recordable = True

    def __init__(self, scene: Any | None, traced: TracedConfig) -> None:
        pass

    def __call__(
        self, gaussians: Gaussians, pose: Pose, plane: TiledPlane, sphere: bool, params: Mapping[str, Any]
    ) -> Complex:
        """Real and imaginary part [batch * directions], see `learned_field`.

        ``params``: parameters of the graph by name, those of the scene's materials among them.
        """
        return learned_field(gaussians, pose, plane, sphere)

    def release(self) -> None:
        """Drop the references that the last call kept for its reverse pass."""


EVALUATIONS: Registry[type[Evaluation]] = Registry("evaluation", "wrf_mi.evaluations", {SPLATTED: Evaluation})
"""`Evaluation` and its subclasses by name."""


def evaluation_named(name: str) -> type[Evaluation]:
    """The evaluation of a name (InputError: no installed package has it)."""
    if name not in EVALUATIONS:
        raise InputError(f"evaluation {name!r}: no installed package adds it; install wrf_mi again")
    return EVALUATIONS[name]


def learned_field(gaussians: Gaussians, pose: Pose, plane: TiledPlane, sphere: bool = False) -> Complex:
    """Complex signal on the upper hemisphere or the full sphere. Differentiable in Gaussians and pose.

    Gaussians are those of one field for a batch of transmitters, ``plane`` has the pixels of a hemisphere. With
    ``sphere``, the lower hemisphere is as seen by the receiver after half a turn about its x axis. Returns the real and
    imaginary part, [batch * directions]: of each transmitter the pixels of the upper hemisphere, then those of the
    lower one, both in the order of `wrf_mi.core.pixel_directions`.
    """
    upper = splat(gaussians, pose, plane)
    if not sphere:
        return upper
    lower = splat(gaussians, facing_down(pose), plane)
    tensor_type: Any = dr.tensor_t(type(upper[0]))
    shape = (gaussians.batch, plane.pixels)
    pairs = ([tensor_type(half, shape) for half in halves] for halves in zip(upper, lower, strict=True))
    re, im = (dr.concat(pair, axis=1).array for pair in pairs)
    return re, im


def facing_down(pose: Pose) -> Pose:
    """The pose after half a turn about the receiver's x axis: its upper hemisphere is the lower one of ``pose``."""
    return Pose(pose.position, [[row[0], -row[1], -row[2]] for row in pose.to_world])
