"""Downlink from paths of the uplink: what R2F2 and OptML share, down to which wave model suits the data.

Left open by both papers, which have a line of a few antennas far from everything and frequencies in hand: arrays whose
size is not small against the distance of walls and users, arrays whose elements nobody wrote down, frequencies that
nobody wrote down. What is open is chosen by the downlink of a few validation rows, among: spherical waves, plane waves
and a gain of each antenna's own (the latter alone without elements); without frequencies, bands that follow each other
at once or with one subcarrier between them (the carrier, which 802.11 leaves out in the middle).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Record, Split
from ...training.session import OnProgress
from ..method import Method
from .csi_bands import Bands, bands_of, relative_error, training_rows
from .uplink_paths import Paths, find_paths
from .uplink_waves import Complex, Waves, waves_of

Kind = Literal["auto", "spherical", "plane", "free"]
BOTH_GAPS = (1, 2)
"""Spacings between the last uplink and the first downlink subcarrier, where the data do not tell."""


@dataclass(frozen=True)
class PathSettings:
    """Settings of the search for paths.

    Attributes:
        wavefront: ``spherical``, ``plane``, ``free`` (a gain of each antenna's own) or ``auto``, chosen on validation
            rows.
        max_paths: most paths of a row.
        max_distance_m: longest path, metres.
        between: steps of refinement of all paths after each addition.
        final: steps after the last.
        spacing_hz: distance of subcarriers where the data do not tell; that of 802.11 at 20 MHz.
        choice_rows: validation rows that choose what is open.
    """

    wavefront: Kind = "auto"
    max_paths: int = 40
    max_distance_m: float = 100.0
    between: int = 1
    final: int = 15
    spacing_hz: float = 312.5e3
    choice_rows: int = 16

    def __post_init__(self) -> None:
        """Refuse what is no search.

        Raises:
            InputError: naming the setting.
        """
        counts = (self.max_paths, self.choice_rows)
        if min(counts) < 1 or min(self.between, self.final) < 0 or not self.max_distance_m > 0:
            raise InputError(
                f"paths: {self.max_paths} paths within {self.max_distance_m} m, {self.between} and {self.final} steps, "
                f"{self.choice_rows} rows to choose by; choose positive numbers"
            )
        if self.wavefront not in ("auto", "spherical", "plane", "free"):
            raise InputError(f"wavefront {self.wavefront!r}: choose auto, spherical, plane or free")


def choose(
    method: Method, record: Record, split: Split, settings: PathSettings, on_progress: OnProgress
) -> tuple[str, Bands]:
    """The wave model and the bands whose extrapolation fits the downlink of validation rows best.

    The median over rows and antennas counts: rows alone are few. Where nothing is open, nothing is tried. Without
    validation rows, training rows decide.

    Raises:
        InputError: as `bands_of` and `training_rows`, or a wave front that needs elements where there are none.
    """
    train, validation = training_rows(method, record, split)
    first = bands_of(record, settings.spacing_hz)
    if first.elements_m is None:
        if settings.wavefront in ("spherical", "plane"):
            raise InputError(
                f"{record.name}: {settings.wavefront} waves need the array's elements and the frequencies; "
                "give both or choose wavefront=free"
            )
        kinds: tuple[str, ...] = ("free",)
    else:
        kinds = ("spherical", "plane", "free") if settings.wavefront == "auto" else (settings.wavefront,)
    options = [
        (kind, bands)
        for bands in ([first] if first.known else [bands_of(record, settings.spacing_hz, g) for g in BOTH_GAPS])
        for kind in kinds
    ]
    if len(options) == 1:
        return options[0]
    judges = validation if len(validation) else train
    judges = judges[np.linspace(0, len(judges) - 1, min(settings.choice_rows, len(judges))).round().astype(int)]
    assert record.uplink is not None
    uplink, truth = record.uplink[judges].astype(complex), record.observation[0, judges]
    errors = []
    for number, (kind, bands) in enumerate(options):
        on_progress(f"choosing a wave model: {kind}", number / len(options))
        waves = waves_of(kind, bands, settings.max_distance_m)
        paths = find_paths(waves, uplink, settings.max_paths, settings.between, settings.final)
        errors.append(float(np.median(relative_error(downlink(waves, paths, bands), truth))))
    return options[int(np.argmin(errors))]


def downlink(waves: Waves, paths: Paths, bands: Bands) -> Complex:
    """What paths give at the downlink's subcarriers, [n, antennas, g]."""
    return waves.evaluate(paths.theta, paths.gains, bands.downlink_hz)


def bands_arrays(kind: str, bands: Bands) -> dict[str, NDArray[Any]]:
    """Arrays from which `bands_from` makes the same again."""
    arrays = {
        "wavefront": np.array(kind),
        "uplink_hz": bands.uplink_hz,
        "downlink_hz": bands.downlink_hz,
        "antennas": np.array(bands.antennas),
        "known": np.array(bands.known),
    }
    return arrays if bands.elements_m is None else arrays | {"elements_m": bands.elements_m}


def bands_from(arrays: Mapping[str, NDArray[Any]]) -> tuple[str, Bands]:
    """Wave model and bands of `bands_arrays`."""
    bands = Bands(
        arrays["uplink_hz"],
        arrays["downlink_hz"],
        int(arrays["antennas"]),
        arrays.get("elements_m"),
        bool(arrays["known"]),
    )
    return str(arrays["wavefront"]), bands
