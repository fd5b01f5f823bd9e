"""Whether receive antennas are polarised as what arrives: cross-polarised links are rarely meant."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..core import Antenna, Receiver
from ..core.angles import FloatArray
from .options import TraceOptions
from .result import TraceResult, recompute
from .solve import trace_paths

logger = logging.getLogger(__name__)

GAIN_DB = 10.0
"""So much more median power with the other polarisation is taken for a mistake. Reflections at walls turn the
polarisation of some paths, but of a link that is polarised as meant most power keeps it."""
SAMPLE = 256
"""Transmitters on which it is judged."""
TRACED, ROUGH = 32, TraceOptions(transmission=True, max_depth=2, max_reflections=1, rays=1 << 12)
"""Transmitters, and what is traced, where a model does not trace all of them at once."""


def cross_polarized(traced: TraceResult, scene: Any) -> dict[str, float]:
    """Receivers whose median power would grow by `GAIN_DB` if their polarisation were turned by 90 degrees.

    Args:
        traced: paths; those of `SAMPLE` transmitters, evenly spaced, are evaluated.
        scene: that they were traced in.

    Returns:
        The gain in dB by the receivers' names.
    """
    count = len(traced.tx_pos_m)
    chosen = np.unique(np.linspace(0, count - 1, min(SAMPLE, count)).round().astype(int))
    sample = traced.select(np.isin(traced.paths.tx, chosen))
    if sample.carriers_hz is not None:  # both at the scene's carrier
        sample = recompute(sample, scene)
    stated = _median_power(sample)
    turned = _median_power(recompute(sample, scene, rx_antennas=[one.antenna.turned for one in traced.receivers]))
    tiny = np.finfo(np.float32).tiny
    gain_db = 10 * np.log10(np.maximum(turned, tiny) / np.maximum(stated, tiny))
    return {one.name: float(g) for one, g in zip(traced.receivers, gain_db, strict=True) if g >= GAIN_DB}


def warn_of_cross_polarization(traced: TraceResult, scene: Any) -> None:
    """Warn of receivers that `cross_polarized` finds, naming the option that turns their polarisation."""
    found = cross_polarized(traced, scene)
    if not found:
        return
    first, count = next(iter(found)), len(traced.receivers)
    now = next(one.antenna for one in traced.receivers if one.name == first)
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
    """Trace a few transmitters and warn of cross-polarised receivers, for models that trace by themselves.

    Args:
        scene: ``sionna.rt.Scene``.
        tx_pos_m: transmitters [n, 3], metres.
        receivers: with their antennas.
        tx_antenna: antenna of the transmitters.
    """
    few = np.unique(np.linspace(0, len(tx_pos_m) - 1, min(TRACED, len(tx_pos_m))).round().astype(int))
    traced = trace_paths(scene, tx_pos_m[few], receivers, ROUGH, tx_antenna=tx_antenna, check=False)
    warn_of_cross_polarization(traced, scene)


def _median_power(traced: TraceResult) -> FloatArray:
    """Median over the transmitters with a path of the power at each receiver [n_rx]; 0 without any path."""
    paths, power = traced.paths, np.zeros((len(traced.receivers), len(traced.tx_pos_m)))
    reached = np.zeros(power.shape, bool)
    reached[paths.rx, paths.tx] = True
    np.add.at(power, (paths.rx, paths.tx), np.abs(paths.gain) ** 2)
    return np.array([np.median(own[there]) if there.any() else 0.0 for own, there in zip(power, reached, strict=True)])
