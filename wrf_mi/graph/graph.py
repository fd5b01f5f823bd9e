"""One graph of both sides: Gaussians evaluated by splatting, paths evaluated on planes, receivers that report both.

    tx position ─► Gaussians ─ splat ─► L(u) ─┐
                                              ├─► receiver model ─► spectrum
    tx position ─► chains of planes ─► T ─────┘

Every argument that training changes is a parameter by name: those of the field (`wrf_mi.field`), and of the traced
side ``material.*``, ``receiver.*`` and ``pattern.*`` (`wrf_mi.hybrid.traced.TracedField`). Without a scene the tracer
is not imported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Antenna, InputError, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..field import Factorised, WrfGs, WrfGsPlus
from ..hybrid.combine import ArrayReceiver, PixelReceiver
from ..hybrid.learned import learned_field
from ..hybrid.pose import receiver_pose
from ..project.footprint import Pose
from ..splat.tiles import Plane
from .settings import DEFAULT, ReceiverModel, TracedConfig

if TYPE_CHECKING:
    from ..hybrid.traced import TracedField

Field = WrfGs | WrfGsPlus | Factorised
Report = Callable[[Mapping[str, Any], Any, Any, Pose, Plane], Any]
"""``report(params, tx_pos, slots, pose, plane)``: flat observations of a batch of transmitters, differentiable."""


class Graph:
    """Gaussians, the traced paths of a scene, and receivers.

    Args:
        field: the Gaussians.
        receivers: poses, antennas and arrays.
        size: height and width of a spectrum.
        receiver: receiver model; ``auto``: ``array`` with a scene, else ``pixel``.
        frequencies_hz: of the carrier [1]; None: not known.
        scene: from `wrf_mi.trace.open_scene`, at the carrier; None: Gaussians alone.
        traced: what is traced, and rates.
        tx_antenna: antenna of the transmitters.

    Raises:
        InputError: a receiver model or a scene for which array or carrier are not known.
    """

    def __init__(
        self,
        field: Field,
        receivers: Sequence[Receiver],
        size: tuple[int, int],
        receiver: ReceiverModel = "auto",
        frequencies_hz: FloatArray | None = None,
        scene: Any | None = None,
        traced: TracedConfig = DEFAULT,
        tx_antenna: Antenna = ANTENNA,
    ) -> None:
        kind = receiver if receiver != "auto" else "pixel" if scene is None else "array"
        known = frequencies_hz is not None and all(one.array_m is not None for one in receivers)
        if not known and (kind == "array" or scene is not None):
            what = "a scene" if scene is not None else "setting receiver: array"
            raise InputError(
                f"{what} needs the antenna array and the carrier; state array and frequency_hz in the data"
            )
        self.field, self.receivers, self.scene, self.traced = field, tuple(receivers), scene, traced
        self._tx_antenna = tx_antenna
        hz = float("nan") if frequencies_hz is None else float(frequencies_hz[0])
        self.models = tuple(_model(kind, size, one, hz) for one in receivers)

    @cached_property
    def _prepared(self) -> Any:
        from ..trace.solve import Prepared

        return Prepared(self.scene)

    def check(self, tx_pos_m: FloatArray) -> None:
        """Refuse transmitters [n, 3] and receivers inside the scene's solids, warn of those near surfaces.

        Raises:
            InputError: naming the transmitter or receiver, and the solid.
        """
        if self.scene is not None:
            self._prepared.check(tx_pos_m, self.receivers)

    def check_polarization(self, tx_pos_m: FloatArray) -> None:
        """Warn of receivers that are polarised across what arrives of transmitters [n, 3]."""
        if self.scene is not None:
            from ..trace.polarization import check_polarization

            check_polarization(self.scene, tx_pos_m, self.receivers, self._tx_antenna)

    def trace(self, tx_pos_m: ArrayLike, number: int) -> TracedField | None:
        """The traced side of transmitters [n, 3] at one receiver; None without a scene."""
        if self.scene is None:
            return None
        from ..hybrid.traced import TracedField, TracedOptions
        from ..trace import TraceOptions

        t = self.traced
        what = TraceOptions(
            transmission=t.transmission,
            max_depth=t.depth,
            max_reflections=min(t.reflections, t.depth),
            reflection=t.reflections > 0,
            rays=t.rays,
        )
        ends: dict[str, Any] = {"tx_antenna": self._tx_antenna, "materials": t.materials, "planes": t.moves_planes}
        options = TracedOptions(what, t.pattern_degree, **ends)
        return TracedField(self.scene, tx_pos_m, self.receivers[number], options, prepared=self._prepared)

    def parameters(self, sides: Sequence[TracedField | None]) -> dict[str, NDArray[np.float32]]:
        """Starting values of the traced side's parameters that a rate moves, by name; sides of all receivers."""
        values: dict[str, NDArray[np.float32]] = {}
        for side in sides:
            if side is not None:
                values |= {name: v for name, v in side.parameters().items() if self.traced.rate(name) > 0}
        return values

    def moved(self, number: int) -> bool:
        """Whether training moves a receiver."""
        return self.scene is not None and (self.traced.position > 0 or self.traced.turn > 0)

    def report(self, number: int, side: TracedField | None) -> Report:
        """What a receiver reports, as a function of parameters, for transmitters of a traced side."""
        model, receiver, moved = self.models[number], self.receivers[number], self.moved(number)

        def report(params: Mapping[str, Any], tx_pos: Any, slots: Any, pose: Pose, plane: Plane) -> Any:
            paths = None if side is None else side(params, slots)
            here = receiver_pose(receiver, params, mi.Float) if moved else pose
            return model(paths, learned_field(self.field.gaussians(params, tx_pos), here, plane, model.sphere))

        return report

    def arrays(self, number: int, side: TracedField | None) -> list[Any]:
        """What a report reads on the device beside its arguments: a recording takes it as inputs."""
        if side is None and not isinstance(self.models[number], ArrayReceiver):
            return []
        return [self.models[number].arrays(mi.Float), [] if side is None else side.arrays]

    def match_gain(
        self, number: int, side: TracedField, params: Mapping[str, Any], observed: NDArray[Any]
    ) -> dict[str, NDArray[np.float32]]:
        """The receiver's starting gain, with which the traced side alone reports what was observed, on average."""
        from ..hybrid.joint import MATCHING, View, missing_gain

        view = View(self.receivers[number], self.models[number], observed, side)
        gain = np.zeros(2, np.float32)
        for _ in range(MATCHING):
            gain[0] += missing_gain(view, side, {**params, side.gain_name: mi.TensorXf(gain)})
        return {side.gain_name: gain}


def _model(kind: str, size: tuple[int, int], receiver: Receiver, frequency_hz: float) -> PixelReceiver:
    elements = np.zeros((0, 3)) if receiver.array_m is None else receiver.array_m
    if kind == "pixel":
        return PixelReceiver(*size, elements, frequency_hz)
    return ArrayReceiver(*size, elements, frequency_hz, instrument_scale=True)
