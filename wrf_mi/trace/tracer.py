"""Ray tracing as a model of a data set: from transmitter positions to what its receivers report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..receive.instruments import Instrument
from .options import DEFAULTS, TraceOptions
from .result import TraceResult
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
            scene: see `wrf_mi.trace.open_scene`.
            instrument: what is reported, see `wrf_mi.tasks.Task.instrument`.
            options: what is traced.
            material: of a bare mesh.

        Raises:
            InputError: a scene that cannot be opened.
        """
        self.instrument = instrument
        self.options = options
        self.scene = open_scene(scene, instrument.carrier_hz, material=material)
        self._prepared = Prepared(self.scene)

    def trace(self, tx_pos_m: ArrayLike, progress: bool = False, first_row: int = 0) -> TraceResult:
        """Paths from transmitter positions [n, 3] (metres), ``first_row`` and following, to all receivers."""
        ends = self.instrument.receivers, self.options, progress, self._prepared, first_row
        return trace_paths(self.scene, tx_pos_m, *ends, self.instrument.tx_antenna)

    def rays(self, tx_pos_m: ArrayLike) -> int:
        """How many rays search if these positions [n, 3] (metres) are the first: ``"auto"`` is settled on them."""
        positions, receivers = self._prepared.placed(np.asarray(tx_pos_m, float), tuple(self.instrument.receivers))
        ends = positions, np.stack([receiver.position_m for receiver in receivers])
        return self._prepared.rays(*(ends if keeps_direction(self.options) else ends[::-1]), self.options)

    def __call__(self, tx_pos_m: ArrayLike) -> NDArray[Any]:
        """What every receiver reports for transmitter positions [n, 3] (metres), [n_rx, n, ...]."""
        return self.instrument.observe(self.trace(tx_pos_m).paths)
