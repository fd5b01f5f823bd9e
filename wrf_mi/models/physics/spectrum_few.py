"""The physics model for spectra where training rows are few: which of its parts predict is decided by rows held out.

A few rows tell planes and materials of the given mesh, for which there are priors, but neither further surfaces nor
amplitudes, and none can be spared as validation rows. So all that the physics model may become is fitted anew without
each of some groups of rows: the room as given, the room with fitted planes and materials, kriging of the spectra, and
mixes of the last two. What predicts the rows held out best is fitted to all rows. Rows at one place are held out
together.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fclusterdata
from scipy.constants import speed_of_light

from ...core.angles import FloatArray
from ...core.types import IntArray
from .spectrum_model import Fit, SpectrumModel
from .spectrum_residual import MIXES

logger = logging.getLogger(__name__)

FEW_ROWS = 40
"""With fewer rows what is fitted is chosen here: a quarter of them is too few to choose anything."""
LEAST_PLACES = 4
"""Rows at fewer places cannot judge: each would be predicted from two others."""
ONE_PLACE = 1 / 16
"""Rows within that distance, in wavelengths, are at one place: their spectra hardly differ."""
GROUPS = 5
"""That are held out in turn."""
SCANS = 3
"""Of the planes for other minima."""
LEAST_ERROR = 1e-3
"""Mean squared error that counts as well explained, as there are eight bits and small objects."""
AS_GIVEN = "room as given"


def fitted_to_few(
    model: SpectrumModel,
    tx_pos_m: FloatArray,
    spectra: NDArray[np.float32],
    rows: IntArray,
    offset_sd_m: float,
    steps: int,
    rest: bool,
    seed: int,
    on_progress: Callable[[str, float], None],
) -> tuple[SpectrumModel, dict[str, Any]]:
    """Fit what rows held out choose.

    Args:
        model: the room as given.
        tx_pos_m: of the record [n, 3], metres.
        spectra: of the record [n, height, width].
        rows: that train.
        offset_sd_m: standard deviation of the planes' displacements, metres.
        steps: of the fit of planes and materials.
        rest: kriging may be used.
        seed: of the groups.
        on_progress: hears what is done, and the share of all that is done, 0..1.

    Returns:
        The fitted model and facts: what was chosen, and the error of all choices on rows held out, root mean square.
    """
    place, seen, everyone = tx_pos_m[rows], spectra[rows], np.arange(len(rows))
    group = groups(place, speed_of_light / model.instrument.frequency_hz, seed)
    if not len(group):
        text = "%s: %d training rows at fewer than %d places cannot tell what to fit: the room is traced as given"
        logger.warning(text, model.instrument.receiver.name, len(rows), LEAST_PLACES)
        return model, {"chosen": AS_GIVEN}
    fit = Fit(model, place, seen, everyone, everyone[:0], offset_sd_m, steps)
    predicted: dict[str, NDArray[np.float32]] = {}
    for number in range(GROUPS):
        on_progress("rows held out", number / (GROUPS + 1))
        own, out = np.flatnonzero(group != number), np.flatnonzero(group == number)
        for name, trial in _trials(fit, model, own, rest) if len(out) else ():
            predicted.setdefault(name, np.empty_like(seen))[out] = trial.spectra(place[out])
    square = {name: np.square(images - seen) for name, images in predicted.items()}
    # Structural similarity falls nearly linearly with the logarithm, and no row that is hard to predict decides alone.
    score = {name: float(np.log(each.mean(axis=(1, 2)) + LEAST_ERROR).mean()) for name, each in square.items()}
    chosen = min(score, key=lambda name: score[name])
    on_progress("all rows", GROUPS / (GROUPS + 1))
    best = dict(_trials(fit, model, everyone, rest))[chosen]
    facts: dict[str, Any] = {"chosen": chosen}
    facts |= {f"held-out error, {name}": round(float(np.sqrt(each.mean())), 4) for name, each in square.items()}
    facts["plane_offsets_m"] = [round(float(x), 4) for x in best.constants.offset_m]
    logger.info("%s: %d training rows: %s, chosen by rows held out", model.instrument.receiver.name, len(rows), chosen)
    return best.replaced(error=np.sqrt(square[chosen].mean(axis=0)).astype(np.float32)), facts


def groups(place_m: FloatArray, wavelength_m: float, seed: int) -> IntArray:
    """Group of each position [n, 3], 0 to `GROUPS` - 1, those at one place in one; empty below `LEAST_PLACES`."""
    if len(place_m) < LEAST_PLACES:
        return np.zeros(0, np.int64)
    label = fclusterdata(place_m, ONE_PLACE * wavelength_m, "distance", method="single") - 1
    places = int(label.max()) + 1
    if places < LEAST_PLACES:
        return np.zeros(0, np.int64)
    return np.asarray(np.random.default_rng([seed, 4]).permutation(places)[label] % GROUPS)


def _trials(fit: Fit, model: SpectrumModel, rows: IntArray, rest: bool) -> Iterator[tuple[str, SpectrumModel]]:
    """All that the physics model may become, fitted to some rows, by name."""
    yield AS_GIVEN, model
    room = fit.constants(model, rows, SCANS)
    yield "room with fitted planes and materials", room
    for name, kind in MIXES.items() if rest else ():
        yield name, fit.with_rest(room, rows, kind)
