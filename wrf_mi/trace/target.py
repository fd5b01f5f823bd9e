"""Depth, rays and kinds of path chosen so that received power is converged to a stated error.

On a sample of the transmitters, settings grow one after the other and the change in received power says when to stop:

1. *depth*, from 1, with few rays, until two changes on end stay below the part's share of the error and so does what
   is still to come, taken to go on as the last two changes did: each further interaction adds a share q of the last,
   in all q / (1 - q) times the last change (geometric series; in a room, power falls by about as much at each bounce).
2. *rays*, doubled, until two changes on end stay below the share.
3. *diffraction*, then *scattering*: on where they change power by more than the share, and then rays again.

The change is the largest over all sampled pairs, in dB; a pair that has no path on one side only counts as
infinite. The shares are equal and their sum is the target, so that parts that each stay within their share leave the
sum within the target. What this does not see: places that are not in the sample, and errors of materials and mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ..core import InputError, Receiver
from ..core.angles import FloatArray
from ..core.types import IntArray
from ..receive import rssi_dbm
from .options import MAX_DEPTH, MAX_RAYS, TraceOptions
from .solve import FIRST_RAYS, Prepared, trace_paths

logger = logging.getLogger(__name__)

SAMPLE = 24
"""Transmitters on which convergence is judged."""
SAMPLED_KINDS = 6
"""Of these for diffraction and scattering, whose paths are drawn at random: each transmitter is a search of its own."""
CHOSEN_KINDS = ("diffraction", "scattering")
"""Kinds of path that may be switched on."""
PARTS = 5
"""Depth, rays, diffraction, scattering, their rays: each may take the same share of the error."""
MOST_SAMPLED_RAYS = 1 << 19
"""With diffraction or scattering every transmitter is a search of its own, whose time and memory grow with the rays."""
STEEPEST = 0.95
"""Largest q that is extrapolated; with a larger one the series is not seen to converge."""


@dataclass(frozen=True)
class Trial:
    """One setting that was tried.

    Attributes:
        part: depth, rays, diffraction or scattering.
        value: of the setting that was tried.
        change_db: largest change in received power against the setting before; None for the first.
        kept: whether the setting was taken.
    """

    part: str
    value: int | bool
    change_db: float | None
    kept: bool


@dataclass(frozen=True)
class Choice:
    """Settings and how far they are converged.

    Attributes:
        options: that were chosen.
        target_db: error that was asked for.
        error_db: estimated error of received power: what is left of each part, added.
        trials: all that was tried, in order.
    """

    options: TraceOptions
    target_db: float
    error_db: float
    trials: tuple[Trial, ...]

    @property
    def reached(self) -> bool:
        """Whether the estimate is within the target."""
        return self.error_db <= self.target_db

    def plain(self) -> dict[str, Any]:
        """As JSON can hold it; infinite changes and errors as ``"infinite"``."""

        def finite(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: finite(one) for key, one in value.items()}
            if isinstance(value, list | tuple):
                return [finite(one) for one in value]
            return "infinite" if isinstance(value, float) and np.isinf(value) else value

        return finite(asdict(self))


def remainder(changes: Sequence[float]) -> float:
    """What is still to come after these changes, if the series goes on like its last two (see the module)."""
    last = changes[-1]
    if last == 0:
        return 0.0
    if len(changes) < 2 or not np.isfinite(changes[-2:]).all():
        return float("inf")
    q = last / changes[-2] if changes[-2] > 0 else np.inf
    return float(last * q / (1 - q)) if q <= STEEPEST else float("inf")


class _Sampled:
    """Received power of sampled transmitters under several settings."""

    def __init__(self, scene: Any, positions: FloatArray, receivers: Sequence[Receiver]) -> None:
        self.scene, self.receivers = scene, receivers
        self._prepared = Prepared(scene)
        self._known: dict[TraceOptions, FloatArray] = {}
        rows = np.unique(np.linspace(0, len(positions) - 1, min(SAMPLE, len(positions))).round().astype(int))
        self.positions = positions[rows]

    def power(self, options: TraceOptions) -> FloatArray:
        """Received power [n_rx, n] in dBm, NaN where no path arrives."""
        if options not in self._known:
            here = self.positions[self._few()] if options.sampled else self.positions
            found = trace_paths(self.scene, here, self.receivers, options, prepared=self._prepared)
            self._known[options] = np.asarray(rssi_dbm(found.paths), float)
        return self._known[options]

    def _few(self) -> IntArray:
        last = len(self.positions) - 1
        return np.unique(np.linspace(0, last, min(SAMPLED_KINDS, last + 1)).round().astype(int))

    def change(self, options: TraceOptions, other: TraceOptions) -> float:
        """Largest change in received power, dB, between two settings, on the positions of the smaller sample."""
        a, b = self.power(options), self.power(other)
        if options.sampled != other.sampled:
            a, b = (p if o.sampled else p[:, self._few()] for p, o in ((a, options), (b, other)))
        if (np.isnan(a) != np.isnan(b)).any():
            return float("inf")
        return float(np.nanmax(np.abs(a - b), initial=0.0))


def choose_options(
    scene: Any,
    tx_pos_m: ArrayLike,
    receivers: Receiver | Sequence[Receiver],
    target_db: float,
    options: TraceOptions,
    kinds: Sequence[str] = CHOSEN_KINDS,
) -> Choice:
    """Depth, rays and kinds of path for a stated error of received power.

    Args:
        scene: from `wrf_mi.trace.open_scene`.
        tx_pos_m: transmitter positions [n, 3], metres; a sample of them is traced.
        receivers: one or several.
        target_db: error of received power to reach, dB.
        options: what stays as it is: kinds that are on, seed, antennas. Depth and rays are chosen.
        kinds: that may be switched on, of `CHOSEN_KINDS`.

    Returns:
        The choice. Where the estimate stays above the target (a warning says so), the largest settings are taken.

    Raises:
        InputError: a target that is no positive number.
    """
    if not (np.isfinite(target_db) and target_db > 0):
        raise InputError(f"target-error {target_db}: give a number of dB above 0")
    everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    sample = _Sampled(scene, np.atleast_2d(np.asarray(tx_pos_m, float)), everyone)
    share, trials = target_db / PARTS, list[Trial]()
    now, left = _depth(sample, replace(options, diffraction=False, scattering=False), share, trials)
    now, more = _rays(sample, now, share, trials)
    left += more
    now = replace(now, diffraction=options.diffraction, scattering=options.scattering)
    for kind in CHOSEN_KINDS:
        if kind not in kinds or getattr(options, kind):
            continue
        change = sample.change(now, replace(now, **{kind: True}))
        trials.append(Trial(kind, True, change, change > share))
        if change > share:
            now = replace(now, **{kind: True})
        else:
            left += change
    if now.sampled:
        # Paths that are drawn at random, or along edges, need rays of their own.
        now, more = _rays(sample, now, share, trials, MOST_SAMPLED_RAYS)
        left += more
    choice = Choice(now, target_db, left, tuple(trials))
    if not choice.reached:
        logger.warning("received power is converged to %.2g dB, not to the %.2g dB asked for", left, target_db)
    return choice


def _depth(sample: _Sampled, options: TraceOptions, share: float, trials: list[Trial]) -> tuple[TraceOptions, float]:
    now, changes = replace(options, max_depth=1, rays=FIRST_RAYS), list[float]()
    trials.append(Trial("depth", 1, None, True))
    while now.max_depth < MAX_DEPTH:
        deeper = replace(now, max_depth=now.max_depth + 1)
        changes.append(sample.change(now, deeper))
        trials.append(Trial("depth", deeper.max_depth, changes[-1], True))
        now = deeper
        if len(changes) > 1 and max(changes[-2:]) <= share and remainder(changes) <= share:
            break
    return now, remainder(changes)


def _rays(
    sample: _Sampled, options: TraceOptions, share: float, trials: list[Trial], most: int = MAX_RAYS
) -> tuple[TraceOptions, float]:
    now, calm, change = options, 0, float("inf")
    assert isinstance(now.rays, int)
    while calm < 2 and now.rays < most:
        twice = 2 * now.rays
        more = replace(now, rays=twice)
        change = sample.change(now, more)
        trials.append(Trial("rays", twice, change, True))
        calm = calm + 1 if change <= share else 0
        now = more
        assert isinstance(now.rays, int)
    return now, change
