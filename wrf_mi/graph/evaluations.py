"""Ways to evaluate the Gaussians of a graph on a receiver's directions, by name.

`Splatted` projects Gaussians to the plane of directions. ``traced`` follows rays through them with the Mitsuba plugin
`wrf_traced`; the plugins import this package, so they are imported where they are asked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ..core import InputError
from ..core.registry import resolve
from ..gaussians import Gaussians
from ..gaussians.footprint import Pose
from ..gaussians.skip import NOTHING, Skip
from ..gaussians.tiles import Plane
from ..tracing.field_calculator import Complex
from .learned import learned_field
from .settings import SPLATTED, TRACED, TracedConfig

EVALUATIONS: Mapping[str, str] = {
    SPLATTED: "wrf_mi.graph.evaluations:Splatted",
    TRACED: "wrf_mi_plugins.evaluation:Traced",
}
"""Addresses of classes of (scene or None, `TracedConfig`) whose objects are an `Evaluation`."""


class Evaluation(Protocol):
    """Complex signal of Gaussians on a receiver's directions.

    Attributes:
        recordable: whether Dr.Jit can record a call (`dr.freeze`).
    """

    recordable: bool

    def __call__(
        self,
        gaussians: Gaussians,
        pose: Pose,
        plane: Plane,
        sphere: bool,
        params: Mapping[str, Any],
        skip: Skip = NOTHING,
    ) -> Complex:
        """Real and imaginary part [batch * directions], see `wrf_mi.graph.learned.learned_field`.

        Args:
            gaussians: of one field for a batch of transmitters.
            pose: of the receiver.
            plane: pixels of a hemisphere.
            sphere: the lower hemisphere too.
            params: parameters of the graph by name, those of the scene's materials among them.
            skip: what is not evaluated; ``traced`` has none.
        """
        ...

    def release(self) -> None:
        """Let go of what the last call kept for its reverse pass."""
        ...


class Splatted:
    """Gaussians splatted on the plane of directions (`wrf_mi.gaussians`); walls of a scene are no part of it."""

    recordable = True

    def __init__(self, scene: Any | None, traced: TracedConfig) -> None:
        pass

    def __call__(
        self,
        gaussians: Gaussians,
        pose: Pose,
        plane: Plane,
        sphere: bool,
        params: Mapping[str, Any],
        skip: Skip = NOTHING,
    ) -> Complex:
        """See `Evaluation`."""
        return learned_field(gaussians, pose, plane, sphere, skip)

    def release(self) -> None:
        """See `Evaluation`: nothing is kept."""


def evaluation_of(name: str, scene: Any | None, traced: TracedConfig) -> Evaluation:
    """The evaluation of a name.

    Args:
        name: a key of `EVALUATIONS`.
        scene: from `wrf_mi.tracing.open_scene`; None: none.
        traced: what of the scene is trained.

    Raises:
        InputError: no evaluation of that name, or one that cannot serve the scene.
    """
    if name not in EVALUATIONS:
        raise InputError(f"setting evaluation: {name!r} is unknown; choose from {', '.join(EVALUATIONS)}")
    made: Evaluation = resolve(EVALUATIONS[name])(scene, traced)
    return made
