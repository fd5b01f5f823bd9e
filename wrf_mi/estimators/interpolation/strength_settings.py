"""Settings of kriging of signal strengths."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import ClassVar, Literal

from ...core.settings import names_of
from ..model import Problem
from .kriging import KrigingSettings
from .strength_terms import OF_HEADINGS, Hyperparameters

STOP_M, STOP_RAD, STOP_ROWS = 0.1, 0.2, 20  # consecutive rows so near, so little turned and so many at most are joined
RECEIVER_SD_DB = 4.0  # standard deviation of each receiver's offset from the common one: antennas and their mounting
Shadowing = Literal["default", "searched", "likelihood", "none", "trees"]
SHADOWINGS: tuple[Shadowing, ...] = ("default", "searched", "likelihood", "none", "trees")
DEFAULT, BY_SEARCH, LIKELIHOOD, NONE, TREES = SHADOWINGS
"""Origins of shadowing, see `StrengthSettings.shadowing`."""


@dataclass(frozen=True)
class StrengthSettings(KrigingSettings, Hyperparameters):
    """Settings of kriging of signal strengths.

    Hyperparameters that are stated hold, whatever a search or the likelihood says of others.

    Attributes:
        transmit_dbm: transmit power a priori, gains of both antennas included; null: the level of the training rows,
            or 0 dBm without any.
        shadowing: what is added to the mean: kriging with hyperparameters that are ``default``, ``searched`` by
            stretches that are held out, or of the greatest ``likelihood``; ``none``; or randomised ``trees``; null:
            that whose predictions of held-out rows have the smallest error.
    """

    transmit_dbm: float | None = None
    shadowing: Shadowing | None = None
    FIXED: ClassVar[Mapping[str, float]] = {
        "receiver_sd_db": RECEIVER_SD_DB,
        "search_rows": 500,
        "stop_m": STOP_M,
        "stop_rad": STOP_RAD,
        "stop_rows": STOP_ROWS,
    }

    @property
    def hyperparameters(self) -> Hyperparameters:
        """Stated hyperparameters, and the default ones."""
        return Hyperparameters(**{each.name: getattr(self, each.name) for each in fields(Hyperparameters)})


DEFAULT_SETTINGS = StrengthSettings()
POOLED_ONLY = names_of(StrengthSettings) - names_of(KrigingSettings)
"""Settings that kriging of each receiver alone lacks."""


def unused_of_pooled(problem: Problem) -> dict[str, str]:
    """Settings without effect on pooled strengths: of headings that do not count, and of kriging without it."""
    s, record, unused = problem.settings, problem.record, dict[str, str]()
    if s.shadowing in (NONE, TREES):
        unused |= dict.fromkeys(names_of(Hyperparameters) - {"lever_m"}, f"shadowing={s.shadowing}")
    if not s.heading or record.tx_heading_rad is None:
        unused |= dict.fromkeys(OF_HEADINGS, "heading=false" if not s.heading else "the data have no headings")
    return unused
