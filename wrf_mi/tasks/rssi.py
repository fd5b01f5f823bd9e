"""Signal strengths."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import Task
from ..core.angles import FloatArray
from ..receivers.scaling import SQUARED_MAGNITUDE_EPS
from .one_antenna import ALONE, JOINT, sums_of_rays
from .scores import abs_error_db


class Rssi(Task):
    """Observations are powers in dBm, float32, NaN where nothing was received, scored by the absolute error."""

    name = "rssi"
    block, label, higher_is_better = "abs_error_db", "absolute error (dB)", False
    score = staticmethod(abs_error_db)
    axes, in_decibel, units = 0, True, ("dBm", "dB")
    has_offsets, tells_phases = True, False
    shares_law, may_be_silent, has_readings, follows_heading = True, True, True, True
    kriged_about_paths, trusts_stated_std = True, True
    settings = ALONE
    # Paths through walls of two surfaces each, and shadowing by the carrier's body.
    settings_with_scene = (*JOINT, "traced.depth=6", "traced.reflections=2", "traced.pattern_degree=3")
    loss_unit = 10.0  # dB: errors are then of the size that the learning rates expect
    receiver = receiver_with_scene = "power"
    # Best of 0 to 1.6 m in a tenfold cross-validation, in the order of time, on flat-ble's training run.
    neighbours, softening_m = 100, 0.4
    heading, quantity = "received signal strength", "RSSI (dBm)"
    level_kind, level_note = "power", "received power as the receiver observes it"
    note = (
        "The absolute error in dB counts rows that were received; IDW averages the nearest training rows "
        "that the same receiver received by inverse squared distance, 0.4 m added; held-out training rows choose their "
        "number."
    )

    def floor_db(self, observed: NDArray[Any]) -> float:
        """The lowest power."""
        # The tracer finds no path through many walls; what was measured there is the weakest of all.
        return float(np.nanmin(observed))

    def error_size(self, mean: NDArray[Any]) -> FloatArray:
        """Equal sizes: the magnitude of a power in decibels says nothing about its error."""
        return np.ones(mean.shape)

    def of_rays(self, parts: tuple[Any, Any], shape: tuple[int, int, int], offset: Any, receiver: Any) -> Any:
        """Powers in dBm [batch, 1]."""
        import drjit as dr

        re, im = sums_of_rays(parts, shape[2])
        decibels = float(10 / np.log(10)) * dr.log(re * re + im * im + SQUARED_MAGNITUDE_EPS)
        return type(offset)(dr.gather(type(re), offset.array, receiver) + decibels, (shape[1], 1))
