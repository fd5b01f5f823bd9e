"""Downlink from paths of the uplink: settings and choice of the wave model, shared by R2F2 and OptML.

The papers have a line of a few antennas in the far field and known frequencies. For other data the wave model with the
best downlink of a few validation rows is chosen: spherical waves, plane waves or a gain for each antenna (the latter
without known elements). Without known frequencies, bands that follow each other at once are compared with bands with a
subcarrier between them, the carrier of 802.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...core import InputError, Record, Split
from ...core.settings import CheckedSettings, Count, Positive
from ...training.session import OnProgress
from .csi_bands import Bands, bands_of, known_rows, relative_error
from .uplink_paths import find_paths
from .uplink_waves import waves_of

Kind = Literal["auto", "spherical", "plane", "free"]
BOTH_GAPS = (1, 2)
"""Spacings between the last uplink and the first downlink subcarrier, where frequencies are unknown."""


@dataclass(frozen=True)
class PathSettings(CheckedSettings):
    """Settings of the search for paths.

    Attributes:
        wavefront: ``spherical``, ``plane``, ``free`` (a gain for each antenna) or ``auto``, chosen on validation rows.
        max_paths: most paths of a row.
        max_distance_m: longest path, metres.
        between: steps of refinement of all paths after each addition.
        final: steps of refinement after the last addition.
        spacing_hz: distance of subcarriers where the data have no frequencies; that of 802.11 at 20 MHz.
        choice_rows: validation rows that choose the wave model.
    """

    wavefront: Kind = "auto"
    max_paths: Count = 40
    max_distance_m: Positive = 100.0
    between: int = 1
    final: int = 15
    spacing_hz: Positive = 312.5e3
    choice_rows: Count = 16


def choose(
    name: str, record: Record, split: Split, settings: PathSettings, on_progress: OnProgress
) -> tuple[str, Bands]:
    """The wave model and the bands whose extrapolation fits the downlink of validation rows best.

    The criterion is the median over rows and antennas. Without validation rows, training rows decide.

    Raises:
        InputError: as `bands_of` and `known_rows`, or a wave front that needs elements where there are none.
    """
    train, validation = known_rows(name, record, split)
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
        for bands in ([first] if first.known else [bands_of(record, settings.spacing_hz, gap) for gap in BOTH_GAPS])
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
        predicted = waves.evaluate(paths.theta, paths.gains, bands.downlink_hz)
        errors.append(float(np.median(relative_error(predicted, truth))))
    return options[int(np.argmin(errors))]
