"""Detection of cross-polarised links, which are rarely meant."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..core import Antenna, Receiver
from ..core.angles import FloatArray
from ..receivers import received_power
from .options import TraceOptions
from .paths.result import TraceResult, recompute
from .paths.solve import spread, trace_paths

logger = logging.getLogger(__name__)

GAIN_DB = 10.0
"""Gain in median power by the other polarisation above which a link counts as cross-polarised. Reflections turn the
polarisation of some paths, but a co-polarised link keeps most of its power."""
SAMPLE = 256
"""Transmitters on which the gain is judged."""
TRACED, ROUGH = 32, TraceOptions(transmission=True, max_depth=2, max_reflections=1, rays=1 << 12)
"""Transmitters and options of the trace for models that do not trace all transmitters at once."""


def cross_polarized(traced: TraceResult, scene: Any) -> dict[str, float]:
    """Gains in dB, `GAIN_DB` or more, by the names of receivers whose polarisation is turned by 90 degrees.

    Of the paths of `SAMPLE` transmitters, evenly spaced, in the scene in which they were traced.
    """
    sample = traced.select(np.isin(traced.paths.tx, spread(len(traced.tx_pos_m), SAMPLE)))
    if sample.carriers_hz is not None:  # both at the scene's carrier
        sample = recompute(sample, scene)
    stated = _median_power(sample)
    receivers = tuple(replace(rx, antenna=rx.antenna.turned) for rx in traced.receivers)
    turned = _median_power(recompute(replace(sample, receivers=receivers), scene))
    tiny = np.finfo(np.float32).tiny
    gain_db = 10 * np.log10(np.maximum(turned, tiny) / np.maximum(stated, tiny))
    return {rx.name: float(g) for rx, g in zip(traced.receivers, gain_db, strict=True) if g >= GAIN_DB}


def warn_of_cross_polarization(traced: TraceResult, scene: Any) -> None:
    """Warn of receivers that `cross_polarized` finds, naming the option that turns their polarisation."""
    found = cross_polarized(traced, scene)
    if not found:
        return
    first, count = next(iter(found)), len(traced.receivers)
    now = next(rx.antenna for rx in traced.receivers if rx.name == first)
    who = f"receiver {first}" if count == 1 else f"{len(found)} of {count} receivers (first: {first})"
    options = f"--rx-polarization {now.turned.polarization}" + (" or --rx-frame world" if now.frame == "array" else "")
    logger.warning(
        "%s: turning the receive polarisation by 90 degrees raises the median traced power by %.0f dB; "
        "state the antenna in the data, or try %s (now: %s, frame %s)",
        who,
        found[first],
        options,
        now.polarization,
        now.frame,
    )


def check_polarization(scene: Any, tx_pos_m: FloatArray, receivers: Sequence[Receiver], tx_antenna: Antenna) -> None:
    """Trace a few of the transmitters [n, 3], metres, and warn of cross-polarised receivers."""
    few = tx_pos_m[spread(len(tx_pos_m), TRACED)]
    traced = trace_paths(scene, few, receivers, ROUGH, tx_antenna=tx_antenna, check=False)
    warn_of_cross_polarization(traced, scene)


def _median_power(traced: TraceResult) -> FloatArray:
    """Median over the transmitters with a path of the power at each receiver [n_rx]; 0 without any path."""
    power = received_power(traced.paths)
    reached = np.zeros(power.shape, bool)
    reached[traced.paths.rx, traced.paths.tx] = True
    return np.array([np.median(row[some]) if some.any() else 0.0 for row, some in zip(power, reached, strict=True)])
