"""R2F2: the downlink from path parameters that an optimisation finds in the uplink.

Source: Vasisht, Kumar, Rahul and Katabi, "Eliminating channel feedback in next-generation cellular networks" (SIGCOMM
2016), sections 4 and 5: a channel is a sum over few paths, each of a length, a direction and a complex gain; the paths
that fit the uplink best over all antennas and subcarriers, added one by one from peaks of a matched filter and refined
by non-linear least squares, are evaluated at the downlink's frequencies. Differences from the paper:

- Paths are fitted to antennas and subcarriers themselves, for any array; the paper's transform of a uniform line of
  antennas to angles is unitary, so that the least squares are the same.
- The paper has a line of a few antennas in the far field and known frequencies. For other data the wave model with the
  best downlink of a few validation rows is chosen: spherical waves, plane waves or a gain for each antenna (the latter
  without known elements). Without known frequencies, bands that follow each other at once are compared with bands that
  have a subcarrier between them, the carrier of 802.11.
- The Bayesian information criterion chooses the number of paths up to ``max_paths``; the paper sets a threshold of the
  residual.
- The solver is Levenberg and Marquardt's with exact derivatives (`wrf_mi.models.uplink.uplink_paths`).

Training rows choose the kind of wave front alone. The method is exact on noise-free channels of few, well separated
paths. Where paths are many or closer than the resolution of array and band, the error grows with the distance of the
bands.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ...core import InputError, Prediction, Record, Split
from ...core.settings import CheckedSettings, Count, Positive
from ...training.session import FitSession, OnProgress
from ..model import Arrays, Fitted, Inputs, Model, Problem, keyed, under
from .csi_bands import Bands, bands_of, known_rows, relative_error
from .uplink_paths import Paths, find_paths
from .uplink_waves import Complex, waves_of

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
    max_paths: Count = 100
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


class R2F2(Fitted):
    """Downlink from paths of the uplink, with the chosen wave model ``kind`` and bands."""

    def __init__(self, kind: str, bands: Bands, settings: PathSettings) -> None:
        self.kind, self.bands, self.settings = kind, bands, settings
        self.waves = waves_of(kind, bands, settings.max_distance_m)

    def predict(self, inputs: Inputs, receiver: int) -> Prediction:
        """Downlink coefficients [m, antennas, subcarriers] of the uplinks of ``inputs``."""
        paths = self.paths(np.asarray(inputs.uplink, complex))
        found = self.waves.evaluate(paths.theta, paths.gains, self.bands.downlink_hz)
        return Prediction(found.astype(np.complex64))

    def paths(self, h: Complex) -> Paths:
        """Paths of uplinks [m, antennas, f]."""
        return find_paths(self.waves, h, self.settings.max_paths, self.settings.between, self.settings.final)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Wave model, bands and settings."""
        settings = {name: np.array(value) for name, value in asdict(self.settings).items()}
        return self.bands.arrays(self.kind) | keyed("settings/", settings)


def fit(problem: Problem, split: Split, session: FitSession) -> R2F2:
    """Choose the wave model and, where frequencies are unknown, the bands."""
    return R2F2(*choose(MODEL.name, problem.record, split, problem.settings, session.report), problem.settings)


def load(arrays: Arrays, problem: Problem, folder: Path) -> R2F2:
    """The model that `R2F2.arrays` described."""
    settings = {name: value.item() for name, value in under("settings/", arrays).items()}
    return R2F2(*Bands.load(arrays), PathSettings(**settings))


SOURCE = "Vasisht et al., Eliminating channel feedback in next-generation cellular networks (SIGCOMM 2016)"
MODEL = Model("r2f2", ("csi",), PathSettings, fit, load, SOURCE, uplink="required", headings=True)
