"""Spectra of a trained field at new transmitter positions."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..backend.device import on_device, to_tensor
from ..core import InputError, Receiver
from ..core.receivers import receiver_index
from ..field.gaussians import Gaussians
from ..graph.graph import Field, Graph
from ..hybrid.combine import PixelReceiver
from ..splat.skip import NOTHING, Skip
from ..splat.tiles import perception_plane
from .step import CompiledPredictor, Params, device_pose
from .still import StillField, stands_still

TOGETHER = 16
"""Transmitters whose paths and Gaussians are evaluated together."""


class Predictor:
    """Evaluates one field for any receiver and image size.

    Args:
        field: the model.
        params: its parameters as NumPy arrays, and those of the traced side.
        receivers: poses, by which spectra are asked for.
        height: rows of a spectrum.
        width: columns.
        skip: what is not evaluated.
        operator: where the field's geometry and attenuation do not depend on the transmitter, predict by the linear
            map from signals to pixels (`wrf_mi.splat.operator`), built at the first prediction. It leaves nothing out,
            whatever ``skip`` says.
        store: folder in which operators are kept from process to process; None: in memory alone.
        graph: of the field, these receivers and a scene; None: the field alone, seen by pixel receivers.
    """

    def __init__(
        self,
        field: Field,
        params: Mapping[str, NDArray[np.float32]],
        receivers: Sequence[Receiver],
        height: int,
        width: int,
        skip: Skip = NOTHING,
        operator: bool = False,
        store: Path | None = None,
        graph: Graph | None = None,
    ) -> None:
        self.receivers, self.graph = tuple(receivers), graph or Graph(field, receivers, (height, width))
        # The operator and the recorded prediction are the magnitude at each direction.
        self._pixels = self.graph.scene is None and all(type(model) is PixelReceiver for model in self.graph.models)
        self._poses = [device_pose(r) for r in self.receivers]
        self._plane = perception_plane(height, width, mi.Float)
        self._field, self._skip, self._count = field, skip, -1
        self._by_operator, self._store = operator and self._pixels and stands_still(field), store
        self._still: StillField | None = None
        self.update({name: to_tensor(values) for name, values in params.items()})

    def update(self, params: Params) -> None:
        """Use other parameters (Dr.Jit tensors) from now on."""
        if params["position"].shape[1] != self._count:
            # A recording holds for one number of Gaussians, see `Trainer.record_functions`.
            self._predict, self._count = CompiledPredictor(self._field, self._skip), params["position"].shape[1]
        self._params, self._still = params, None
        dr.eval(self._params)

    def gaussians(self, tx_pos_m: ArrayLike) -> Gaussians:
        """The field's Gaussians for transmitter positions [m, 3] (metres), world frame."""
        columns = np.ascontiguousarray(np.asarray(tx_pos_m, np.float32).reshape(-1, 3).T)
        return self._field.gaussians(self._params, to_tensor(columns)).spread()

    def still(self) -> StillField:
        """The field as operators; forgotten when parameters change."""
        if self._still is None:
            params = {name: dr.detach(values).numpy() for name, values in self._params.items()}
            size = self._plane.height, self._plane.width
            self._still = StillField(self._field, params, self.receivers, *size, self._store)
        return self._still

    def _reported(self, tx_pos_m: NDArray[np.float64], receiver: int) -> NDArray[np.float32]:
        """What a receiver reports of both sides, flat; positions without paths are learned ones alone."""
        side = self.graph.trace(tx_pos_m, receiver)
        with dr.suspend_grad():
            if side is not None:
                side.refresh(self._params)
            tx = to_tensor(np.ascontiguousarray(tx_pos_m.T, np.float32))
            slots = on_device(np.arange(len(tx_pos_m)), mi.UInt32)
            report = self.graph.report(receiver, side)
            found: NDArray[np.float32] = report(self._params, tx, slots, self._poses[receiver], self._plane).numpy()
        return found

    def __call__(self, tx_pos_m: ArrayLike, receiver: int | str = 0) -> NDArray[np.float32]:
        """Spectra of transmitters at one receiver.

        Args:
            tx_pos_m: positions [m, 3], world frame, metres.
            receiver: name, or number from 0, of one of ``receivers``.

        Returns:
            Greys [m, height, width].

        Raises:
            InputError: positions of another shape or not finite, or no such receiver.
        """
        index = receiver_index(self.receivers, receiver)
        positions = np.asarray(tx_pos_m, np.float32)
        if positions.ndim != 2 or positions.shape[1] != 3:
            raise InputError(f"transmitter positions: expected shape [m, 3], got {list(positions.shape)}")
        bad = np.flatnonzero(~np.isfinite(positions).all(axis=1))
        if len(bad):
            raise InputError(f"transmitter positions, row {bad[0] + 1}: not a finite number")
        if self._by_operator:
            try:
                return self.still()(positions, index)
            except MemoryError as error:
                warnings.warn(f"operator: {error}; spectra are splatted one by one", stacklevel=2)
                self._by_operator = False
        height, width = self._plane.height, self._plane.width
        out = np.empty((len(positions), height, width), np.float32)
        if not self._pixels:
            self.graph.check(np.asarray(tx_pos_m, float))
            for start in range(0, len(positions), TOGETHER):
                part = slice(start, start + TOGETHER)
                out[part] = self._reported(np.asarray(tx_pos_m, float)[part], index).reshape(-1, height, width)
            return out
        for image, position in zip(out, positions, strict=True):
            tx = to_tensor(position[:, None])
            image[:] = self._predict(self._params, tx, self._poses[index], self._plane).numpy().reshape(height, width)
        return out
