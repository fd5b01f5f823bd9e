"""Choice of depth, rays and kinds of path by convergence of the received power to a stated error.

On a sample of the transmitters, settings grow one after the other until the change is below an equal share of the error
(``docs/speed.md`` has the steps and the change). The remainder of the depth extrapolates the last two changes as a
geometric series: each further interaction adds a share q of the last, in all q / (1 - q) times the last change (in a
room, power falls by about as much at each bounce).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import Antenna, InputError, Paths, Receiver
from ..core.angles import FloatArray
from ..core.antenna import ANTENNA
from ..receivers import rssi_dbm
from .options import MAX_DEPTH, MAX_RAYS, TraceOptions
from .paths.result import TraceResult
from .paths.solve import FIRST_RAYS, Prepared, spread, trace_paths
from .sionna.scattering import scatters

logger = logging.getLogger(__name__)

Spectra = Callable[[Paths], NDArray[Any]]  # observations [n_rx, n, height, width] of an instrument for paths

SAMPLE = 24  # transmitters on which convergence is judged
SAMPLED_KINDS = 6  # transmitters for diffraction and scattering, where each transmitter takes a separate search
CHOSEN_KINDS = ("diffraction", "scattering")  # kinds of path that are switched on where they count
PARTS = 5  # depth, rays, diffraction, scattering, their rays: each takes an equal share of the error
MOST_SAMPLED_RAYS = 1 << 19  # largest number of rays with diffraction or scattering, with which time and memory grow
STEEPEST = 0.95  # largest q that is extrapolated; a series with a larger one does not count as convergent


@dataclass(frozen=True)
class Trial:
    """A setting that was tried."""

    part: str  # depth, rays, diffraction or scattering
    value: int | bool  # the setting's value
    change_db: float | None  # largest change against the previous setting, of power or spectrum; None for the first
    kept: bool  # whether the setting was taken
    spectrum: float | None = None  # largest change of an observed spectrum, relative L2; None for the first, or without


@dataclass(frozen=True)
class Choice:
    """Chosen options and their estimated error."""

    options: TraceOptions  # the chosen options
    target_db: float  # requested error
    error_db: float  # estimated error: the sum of the parts' remainders
    trials: tuple[Trial, ...]  # all settings that were tried, in order
    judged_by: tuple[str, ...] = ("power",)  # power, or power and spectrum

    @property
    def spectrum_error(self) -> float | None:
        """Estimated error as a share of a spectrum, relative L2; None without spectra."""
        return float(10 ** (self.error_db / 20) - 1) if "spectrum" in self.judged_by else None

    @property
    def reached(self) -> bool:
        """Whether the estimate is within the target."""
        return self.error_db <= self.target_db

    def plain(self) -> dict[str, Any]:
        """JSON-compatible values; infinite changes and errors as ``"infinite"``."""

        def finite(value: Any) -> Any:
            if isinstance(value, dict):
                return {key: finite(part) for key, part in value.items()}
            if isinstance(value, list | tuple):
                return [finite(part) for part in value]
            return "infinite" if value == float("inf") else value

        return finite(asdict(self) | {"spectrum_error": self.spectrum_error})


def remainder(changes: Sequence[float]) -> float:
    """Remainder of a series of changes if it continues like its last two (see the module)."""
    last = changes[-1]
    if last == 0:
        return 0.0
    if len(changes) < 2 or not np.isfinite(changes[-2:]).all():
        return float("inf")
    q = last / changes[-2] if changes[-2] > 0 else np.inf
    return float(last * q / (1 - q)) if q <= STEEPEST else float("inf")


@dataclass
class _Search:
    """Observations of sampled transmitters [n, 3] under several settings, and the settings that were tried."""

    trace: Callable[..., TraceResult]
    positions_m: FloatArray
    spectra: Spectra | None
    share_db: float  # largest change of a part that counts as converged
    trials: list[Trial] = field(default_factory=lambda: [Trial("depth", 1, None, True)])
    observations: dict[tuple[TraceOptions, bool], tuple[FloatArray, FloatArray | None]] = field(default_factory=dict)

    def _observed(self, options: TraceOptions, few: bool) -> tuple[FloatArray, FloatArray | None]:
        """Received power [n_rx, n] in dBm, NaN where no path arrives, and spectra [n_rx, n, height, width]."""
        if (options, few) not in self.observations:
            sample = self.positions_m[spread(len(self.positions_m), SAMPLED_KINDS)] if few else self.positions_m
            paths = self.trace(tx_pos_m=sample, options=options).paths
            spectra = None if self.spectra is None else np.asarray(self.spectra(paths))
            self.observations[options, few] = rssi_dbm(paths), spectra
        return self.observations[options, few]

    def change(self, part: str, value: int | bool, options: TraceOptions, least_db: float = -1.0) -> float:
        """Largest change in dB by another value of a setting, which is kept where the change is above a least one."""
        setting: dict[str, Any] = {part: value}
        other = replace(options, **setting)
        # Each transmitter takes a search of its own where paths are sampled, so fewer of them are compared.
        few = options.sampled or other.sampled
        (a, before), (b, after) = self._observed(options, few), self._observed(other, few)
        spectrum = None
        if before is not None and after is not None:
            # Relative L2 difference of images: 0 if both are dark, infinite if the second one alone is.
            size, by = (np.sqrt(np.square(x, dtype=float).sum(axis=(-2, -1))) for x in (after, before - after))
            share = np.divide(by, size, out=np.where(by > 0, np.inf, 0.0), where=size > 0)
            spectrum = float(share.max(initial=0.0))
        change = float("inf")  # a pair of devices that gains or loses its only path
        if (np.isnan(a) == np.isnan(b)).all():
            power = float(np.nanmax(np.abs(a - b), initial=0.0))
            change = max(power, float(20 * np.log10(1 + (spectrum or 0.0))))
        self.trials.append(Trial(part, value, change, change > least_db, spectrum))
        return change

    def depth(self, options: TraceOptions) -> tuple[TraceOptions, float]:
        """Options with the converged depth, and the remainder in dB."""
        now, changes = replace(options, depth=1, rays=FIRST_RAYS), list[float]()
        while now.depth < MAX_DEPTH:
            changes.append(self.change("depth", now.depth + 1, now))
            now = replace(now, depth=now.depth + 1)
            # Twice: one more bounce may change nothing at the sampled positions, and the next one may.
            if len(changes) > 1 and max(*changes[-2:], remainder(changes)) <= self.share_db:
                break
        return now, remainder(changes)

    def rays(self, options: TraceOptions, most: int = MAX_RAYS) -> tuple[TraceOptions, float]:
        """Options with the converged number of rays, and the last change in dB."""
        assert isinstance(options.rays, int)
        rays, calm, change = options.rays, 0, float("inf")
        while calm < 2 and rays < most:
            change = self.change("rays", 2 * rays, replace(options, rays=rays))
            rays *= 2
            calm = calm + 1 if change <= self.share_db else 0  # once may be chance: each number has other rays
        return replace(options, rays=rays), change

    def kinds(self, options: TraceOptions, kinds: Sequence[str], error_db: float) -> tuple[TraceOptions, float]:
        """Options with those further kinds of path that change more than a share, and the error with all others, dB."""
        for kind in CHOSEN_KINDS:
            if kind in kinds and not getattr(options, kind):
                change_db = self.change(kind, True, options, self.share_db)
                if change_db > self.share_db:
                    options = replace(options, **{kind: True})
                else:
                    error_db += change_db
        return options, error_db


def choose_options(
    scene: Any,
    tx_pos_m: ArrayLike,
    receivers: Receiver | Sequence[Receiver],
    target_db: float,
    options: TraceOptions,
    *,
    kinds: Sequence[str] = CHOSEN_KINDS,
    spectra: Spectra | None = None,
    tx_antenna: Antenna = ANTENNA,
) -> Choice:
    """Choose depth, rays and kinds of path for a stated error of received power, and of spectra if there are any.

    A sample of the transmitters [n, 3] is traced. Kept are kinds of path that are on in ``options``, and the seed;
    ``kinds`` of `CHOSEN_KINDS` may be switched on. ``spectra``: see `wrf_mi.receivers.instruments.Instrument`;
    None: power alone is judged. Where the estimate stays above ``target_db`` (a warning says so), the largest settings
    are taken.

    Raises:
        InputError: a target that is no positive number.
    """
    if not (np.isfinite(target_db) and target_db > 0):
        raise InputError(f"target-error {target_db}: give a number of dB above 0")
    if not scatters(scene, options):
        kinds = [kind for kind in kinds if kind != CHOSEN_KINDS[1]]
    trace = partial(trace_paths, scene, receivers=receivers, tx_antenna=tx_antenna, prepared=Prepared(scene))
    positions = np.atleast_2d(np.asarray(tx_pos_m, float))
    search = _Search(trace, positions[spread(len(positions), SAMPLE)], spectra, target_db / PARTS)
    now, depth_db = search.depth(replace(options, diffraction=False, scattering=False))
    now, error_db = search.rays(now)
    error_db += depth_db
    now = replace(now, diffraction=options.diffraction, scattering=options.scattering)
    now, error_db = search.kinds(now, kinds, error_db)
    if now.sampled:
        # Paths that are drawn at random, or along edges, need more rays.
        now, change_db = search.rays(now, MOST_SAMPLED_RAYS)
        error_db += change_db
    judged = ("power",) if spectra is None else ("power", "spectrum")
    choice = Choice(now, target_db, error_db, tuple(search.trials), judged)
    if not choice.reached:
        what = "received power is" if spectra is None else "power and spectra are"
        logger.warning("%s converged to %.2g dB, not to the %.2g dB asked for", what, error_db, target_db)
    return choice
