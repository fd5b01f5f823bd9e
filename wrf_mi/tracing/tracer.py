"""Ray tracing as a model of a data set: from transmitter positions to what its receivers report."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.angles import FloatArray
from ..core.carriers import by_carrier
from ..core.types import IntArray
from ..receivers.instruments import Instrument
from .options import DEFAULTS, TraceOptions
from .result import TraceResult, recompute
from .scenes import open_scene
from .solve import Prepared, keeps_direction, trace_paths


class RayTracer:
    """Traces a scene and reports as an instrument would.

    Attributes:
        scene: the ``sionna.rt.Scene``, at the instrument's carrier.
        instrument: what is reported.
        options: what is traced.
    """

    def __init__(
        self, scene: str | Path, instrument: Instrument, options: TraceOptions = DEFAULTS, material: str | None = None
    ) -> None:
        """Open a scene.

        Args:
            scene: see `wrf_mi.tracing.open_scene`.
            instrument: what is reported, see `wrf_mi.tasks.Task.instrument`.
            options: what is traced.
            material: of a bare mesh.

        Raises:
            InputError: a scene that cannot be opened.
        """
        self.instrument = instrument
        self.options = options
        self._at = cache(partial(open_scene, scene, material=material))
        self.scene = self._at(instrument.carrier_hz)
        self._prepared = Prepared(self.scene)

    def trace(
        self,
        tx_pos_m: ArrayLike,
        progress: bool = False,
        first_row: int = 0,
        carriers_hz: FloatArray | None = None,
    ) -> TraceResult:
        """Paths from transmitter positions to all receivers.

        Args:
            tx_pos_m: positions [n, 3], metres.
            progress: show a bar on standard error.
            first_row: what errors call the first position.
            carriers_hz: carrier of each position [n], Hz, at which the scene's materials and the paths' gains are
                taken; the paths are searched for once. None: the instrument's for all.

        Raises:
            InputError: a position inside a solid object, or a material that is not known at one of the carriers.
        """
        ends = self.instrument.receivers, self.options, progress, self._prepared, first_row
        traced = trace_paths(self.scene, tx_pos_m, *ends, self.instrument.tx_antenna)
        if carriers_hz is None:
            return traced

        def gains(carrier_hz: float, which: IntArray) -> NDArray[Any]:
            return recompute(traced.select(which), self._at(carrier_hz)).paths.gain

        paths = traced.paths
        if len(paths):
            paths = replace(paths, gain=by_carrier(carriers_hz[paths.tx], gains))
        return replace(traced, paths=paths, carriers_hz=carriers_hz)

    def observe(self, traced: TraceResult) -> NDArray[Any]:
        """What every receiver reports of traced paths, [n_rx, n, ...], each row at its carrier."""
        return self.instrument.observe_rows(traced.paths, traced.carriers_hz)

    def rays(self, tx_pos_m: ArrayLike) -> int:
        """How many rays search if these positions [n, 3] (metres) are the first: ``"auto"`` is settled on them."""
        positions, receivers = self._prepared.placed(np.asarray(tx_pos_m, float), tuple(self.instrument.receivers))
        ends = positions, np.stack([receiver.position_m for receiver in receivers])
        return self._prepared.rays(*(ends if keeps_direction(self.options) else ends[::-1]), self.options)

    def __call__(self, tx_pos_m: ArrayLike) -> NDArray[Any]:
        """What every receiver reports for transmitter positions [n, 3] (metres), [n_rx, n, ...]."""
        return self.observe(self.trace(tx_pos_m))
