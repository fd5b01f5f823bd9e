"""Variables of a radio map: names, units and descriptions."""

from __future__ import annotations

from dataclasses import dataclass

POWER, BEST = "power_dbm", "best_receiver"


@dataclass(frozen=True)
class Variable:
    """A variable of a map.

    Attributes:
        units: unit in the notation of UDUNITS; powers in decibels name theirs as CF does.
        long_name: description.
    """

    units: str
    long_name: str


VARIABLES = {
    POWER: Variable("dBm", "expected received power"),
    "power_std_db": Variable("dB", "standard deviation of the received power"),
    "coverage_probability": Variable("1", "probability that the received power exceeds the threshold"),
    "path_gain_db": Variable("dB", "path gain, gains of both antennas included"),
    "traced_share": Variable("dBm", "received power that the traced side of the model states alone"),
    "learned_share": Variable("dBm", "received power that the learned side of the model states alone"),
    "share_difference_db": Variable("dB", "traced share less learned share"),
    "delay_spread_s": Variable("s", "root mean square delay spread of the traced paths"),
    "azimuth_spread_deg": Variable("degree", "circular standard deviation of the azimuth of arrival of the paths"),
    "k_factor_db": Variable("dB", "power of the strongest traced path over that of all others"),
}
"""Variables of each receiver and position, in the order of a file; a map has those that its model states."""
SHARES = ("traced_share", "learned_share")
LEVELS = (POWER, *SHARES)
"""Variables in the unit of the task's level."""
