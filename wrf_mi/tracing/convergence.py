"""Depth, rays and kinds of path chosen so that received power is converged to a stated error.

On a sample of the transmitters, settings grow one after the other and the change in received power says when to stop:

1. *depth*, from 1, with few rays, until two changes on end stay below the part's share of the error and so does what
   is still to come, taken to go on as the last two changes did: each further interaction adds a share q of the last,
   in all q / (1 - q) times the last change (geometric series; in a room, power falls by about as much at each bounce).
2. *rays*, doubled, until two changes on end stay below the share.
3. *diffraction*, then *scattering*: on where they change power by more than the share, and then rays again.

The change is the largest over all sampled pairs, in dB; a pair that has no path on one side only counts as
infinite. Where an array reports spectra, waves interfere and power alone does not tell: there the change is that of
power or that of the reported spectrum, whichever is larger. A spectrum that changes by a share e of itself (relative L2
norm of the difference) counts as 20 log10(1 + e) dB: that of a magnitude which is larger by this share. The shares are
equal and their sum is the target, so that parts that each stay within their share leave the sum within the target. What
this does not see: places that are not in the sample, and errors of materials and mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Antenna, InputError, Paths, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..core.types import IntArray
from ..receivers import rssi_dbm
from .options import MAX_DEPTH, MAX_RAYS, TraceOptions
from .solve import FIRST_RAYS, Prepared, trace_paths

logger = logging.getLogger(__name__)

Spectra = Callable[[Paths], NDArray[Any]]
"""What an instrument reports of paths."""

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
        change_db: largest change against the setting before, of received power or of a spectrum; None for the first.
        kept: whether the setting was taken.
        spectrum: largest change of a reported spectrum, relative L2; None for the first, and where none are reported.
    """

    part: str
    value: int | bool
    change_db: float | None
    kept: bool
    spectrum: float | None = None


@dataclass(frozen=True)
class Choice:
    """Settings and how far they are converged.

    Attributes:
        options: that were chosen.
        target_db: error that was asked for.
        error_db: estimated error of what is judged by: what is left of each part, added.
        trials: all that was tried, in order.
        judged_by: power, or power and spectrum.
    """

    options: TraceOptions
    target_db: float
    error_db: float
    trials: tuple[Trial, ...]
    judged_by: tuple[str, ...] = ("power",)

    @property
    def spectrum_error(self) -> float | None:
        """The estimated error as a share of a spectrum, relative L2; None where none are reported."""
        return float(10 ** (self.error_db / 20) - 1) if "spectrum" in self.judged_by else None

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

        return finite(asdict(self) | {"spectrum_error": self.spectrum_error})


def remainder(changes: Sequence[float]) -> float:
    """What is still to come after these changes, if the series goes on like its last two (see the module)."""
    last = changes[-1]
    if last == 0:
        return 0.0
    if len(changes) < 2 or not np.isfinite(changes[-2:]).all():
        return float("inf")
    q = last / changes[-2] if changes[-2] > 0 else np.inf
    return float(last * q / (1 - q)) if q <= STEEPEST else float("inf")


@dataclass(frozen=True)
class _Change:
    """Between two settings: the larger of both in dB, and that of spectra as it is, where there are any."""

    db: float
    spectrum: float | None


class _Sampled:
    """Received power, and spectra, of sampled transmitters under several settings."""

    def __init__(
        self,
        scene: Any,
        positions: FloatArray,
        receivers: Sequence[Receiver],
        tx_antenna: Antenna,
        spectra: Spectra | None,
    ) -> None:
        self.scene, self._spectra = scene, spectra
        self._ends: dict[str, Any] = {"receivers": receivers, "tx_antenna": tx_antenna}
        self._prepared = Prepared(scene)
        self._known: dict[TraceOptions, tuple[FloatArray, FloatArray | None]] = {}
        rows = np.unique(np.linspace(0, len(positions) - 1, min(SAMPLE, len(positions))).round().astype(int))
        self.positions = positions[rows]

    def seen(self, options: TraceOptions) -> tuple[FloatArray, FloatArray | None]:
        """Received power [n_rx, n] in dBm, NaN where no path arrives, and spectra [n_rx, n, height, width]."""
        if options not in self._known:
            here = self.positions[self._few()] if options.sampled else self.positions
            paths = trace_paths(self.scene, here, options=options, prepared=self._prepared, **self._ends).paths
            images = None if self._spectra is None else np.asarray(self._spectra(paths))
            self._known[options] = np.asarray(rssi_dbm(paths), float), images
        return self._known[options]

    def _few(self) -> IntArray:
        last = len(self.positions) - 1
        return np.unique(np.linspace(0, last, min(SAMPLED_KINDS, last + 1)).round().astype(int))

    def change(self, options: TraceOptions, other: TraceOptions) -> _Change:
        """Largest change between two settings, on the positions of the smaller sample."""
        one, two = self.seen(options), self.seen(other)
        if options.sampled != other.sampled:
            few = self._few()
            one, two = (
                s if o.sampled else (s[0][:, few], None if s[1] is None else s[1][:, few])
                for s, o in ((one, options), (two, other))
            )
        (a, before), (b, after) = one, two
        spectrum = None if before is None or after is None else _relative(before, after)
        if (np.isnan(a) != np.isnan(b)).any():
            return _Change(float("inf"), spectrum)
        power = float(np.nanmax(np.abs(a - b), initial=0.0))
        return _Change(max(power, float(20 * np.log10(1 + (spectrum or 0.0)))), spectrum)


def _relative(a: FloatArray, b: FloatArray) -> float:
    """Largest relative L2 difference of images [..., height, width]; 0 of two that are dark, infinite of one."""
    difference, size = (np.sqrt(np.square(x, dtype=float).sum(axis=(-2, -1))) for x in (a - b, b))
    share = np.divide(difference, size, out=np.where(difference > 0, np.inf, 0.0), where=size > 0)
    return float(share.max(initial=0.0))


def choose_options(
    scene: Any,
    tx_pos_m: ArrayLike,
    receivers: Receiver | Sequence[Receiver],
    target_db: float,
    options: TraceOptions,
    kinds: Sequence[str] = CHOSEN_KINDS,
    spectra: Spectra | None = None,
    tx_antenna: Antenna = ANTENNA,
) -> Choice:
    """Depth, rays and kinds of path for a stated error of received power, and of spectra where they are reported.

    Args:
        scene: from `wrf_mi.tracing.open_scene`.
        tx_pos_m: transmitter positions [n, 3], metres; a sample of them is traced.
        receivers: one or several.
        target_db: error to reach, dB.
        options: what stays as it is: kinds that are on, seed. Depth and rays are chosen.
        kinds: that may be switched on, of `CHOSEN_KINDS`.
        spectra: what is reported of paths, [n_rx, n, height, width], as `wrf_mi.tracing.tracer.Instrument.observe`
            does;
            None: power alone is judged by.
        tx_antenna: antenna of the transmitters.

    Returns:
        The choice. Where the estimate stays above the target (a warning says so), the largest settings are taken.

    Raises:
        InputError: a target that is no positive number.
    """
    if not (np.isfinite(target_db) and target_db > 0):
        raise InputError(f"target-error {target_db}: give a number of dB above 0")
    everyone = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    sample = _Sampled(scene, np.atleast_2d(np.asarray(tx_pos_m, float)), everyone, tx_antenna, spectra)
    share, trials = target_db / PARTS, list[Trial]()
    now, left = _depth(sample, replace(options, diffraction=False, scattering=False), share, trials)
    now, more = _rays(sample, now, share, trials)
    left += more
    now = replace(now, diffraction=options.diffraction, scattering=options.scattering)
    for kind in CHOSEN_KINDS:
        if kind not in kinds or getattr(options, kind):
            continue
        change = sample.change(now, replace(now, **{kind: True}))
        trials.append(Trial(kind, True, change.db, change.db > share, change.spectrum))
        if change.db > share:
            now = replace(now, **{kind: True})
        else:
            left += change.db
    if now.sampled:
        # Paths that are drawn at random, or along edges, need rays of their own.
        now, more = _rays(sample, now, share, trials, MOST_SAMPLED_RAYS)
        left += more
    judged = ("power",) if spectra is None else ("power", "spectrum")
    choice = Choice(now, target_db, left, tuple(trials), judged)
    if not choice.reached:
        what = "received power is" if spectra is None else "power and spectra are"
        logger.warning("%s converged to %.2g dB, not to the %.2g dB asked for", what, left, target_db)
    return choice


def _depth(sample: _Sampled, options: TraceOptions, share: float, trials: list[Trial]) -> tuple[TraceOptions, float]:
    now, changes = replace(options, max_depth=1, rays=FIRST_RAYS), list[float]()
    trials.append(Trial("depth", 1, None, True))
    while now.max_depth < MAX_DEPTH:
        deeper = replace(now, max_depth=now.max_depth + 1)
        change = sample.change(now, deeper)
        changes.append(change.db)
        trials.append(Trial("depth", deeper.max_depth, change.db, True, change.spectrum))
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
        found = sample.change(now, more)
        change = found.db
        trials.append(Trial("rays", twice, change, True, found.spectrum))
        calm = calm + 1 if change <= share else 0
        now = more
        assert isinstance(now.rays, int)
    return now, change
