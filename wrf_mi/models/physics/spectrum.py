"""The physics model for spatial spectra: a traced room with kriging of its residuals (steps: ``docs/physics.md``).

Element signals are a coherent sum of specular paths: those of the given mesh, with displaced planes and fitted
materials (`spectrum_fit`), and those of surfaces that the mesh lacks (`spectrum_search`), which also obstruct; each
times a learned complex amplitude that varies slowly with the transmitter's image. Every step must lower the loss of
validation rows, or with few rows that of rows held out in turn.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fclusterdata

from ...core import Antenna, InputError, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.types import IntArray
from ...tasks import require
from ...training.session import OnProgress, quiet
from ..model import Arrays, field_arrays, from_field_arrays, keyed, under
from .selection import PhysicsModel, physics_model
from .spectrum_fit import MIXES, Constants, Maps, ResidualKriging
from .spectrum_model import SEARCHED_ROWS, Fit, SpectrumModel, SpectrumSettings, begin
from .spectrum_rays import Room
from .spectrum_waves import Spectrometer

logger = logging.getLogger(__name__)

DEFAULTS = SpectrumSettings()
FORMAT = 2
"""Version of `SpectrumPhysics.arrays`."""
FEW_ROWS = 40
"""With fewer rows held-out rows choose: a quarter of them is too few for validation."""
LEAST_POSITIONS = 4
"""Least number of positions for a choice: with fewer each would be predicted from two others."""
ONE_POSITION = 1 / 16
"""Rows within that distance, in wavelengths, are at one position: their spectra hardly differ."""
GROUPS = 5
"""Groups of rows that are held out in turn."""
SCANS = 3
"""Scans of the planes for other minima."""
LEAST_ERROR = 1e-3
"""Mean squared error that counts as well explained: the effect of eight bits and small objects."""
AS_GIVEN = "room as given"


@dataclass(eq=False, repr=False)
class SpectrumPhysics(PhysicsModel):
    """Predicts spectra, grey in 0..1, [m, height, width]; made by `fit_spectrum`.

    The standard deviation of a pixel is the error on validation rows; without a fit, that of the predicted spectrum.
    The transmitter's antenna is isotropic, so headings change nothing.

    Attributes:
        models: model of each receiver.
        fit_facts: entries of `summary`.
    """

    models: tuple[SpectrumModel, ...]
    fit_facts: dict[str, Any]
    chunk_size: ClassVar[int] = 256

    def __post_init__(self) -> None:
        """Name the receivers."""
        self.receivers = tuple(model.instrument.receiver for model in self.models)

    def _predict(self, tx_pos_m: FloatArray, receiver: int) -> tuple[Any, Any]:
        model = self.models[receiver]
        mean = model.spectra(tx_pos_m)
        return mean, mean.std(axis=(1, 2), keepdims=True) if model.error is None else model.error.astype(float)

    def arrays(self) -> Arrays:
        """Arrays for `from_arrays`, the mesh's triangles included."""
        out: Arrays = {"format": np.array(FORMAT), "receivers": np.array(len(self.models))}
        out |= keyed("fact/", {key: np.asarray(value) for key, value in self.fit_facts.items()})
        for index, model in enumerate(self.models):
            instrument, corners = model.instrument, model.room.corners
            stored: Arrays = {
                **receiver_arrays([instrument.receiver]),
                "tx_antenna": np.array(astuple(instrument.tx_antenna)),
                "frequency_hz": np.array(instrument.frequency_hz),
                "size": np.array([instrument.height, instrument.width]),
                "thing_names": np.array(model.room.names, dtype=str),
                "thing_faces": np.array([len(part) for part in corners], np.int64),
                "triangles_m": np.concatenate([np.zeros((0, 3, 3)), *corners]),
                "chain": model.chain,
                "passed": np.array(model.passed),
                "offset_m": model.constants.offset_m,
                "slabs": model.constants.slabs,
                "given_slabs": model.room.slabs,
                "learned": np.array(model.learned),
            }
            if model.maps is not None:
                stored |= field_arrays(model.maps, "map_")
            if model.residual is not None:
                stored |= field_arrays(model.residual, "rest_")
            if model.error is not None:
                stored["error"] = model.error
            out |= keyed(f"{index}/", stored)
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """The model that `arrays` stored.

        Raises:
            InputError: arrays of another version.
        """
        if int(arrays.get("format", np.array(-1))) != FORMAT:
            raise InputError(f"physics for spectra: format {arrays.get('format')}, not {FORMAT}; fit it again")
        models = []
        for index in range(int(arrays["receivers"])):
            stored = under(f"{index}/", arrays)
            (receiver,), tx_antenna = stored_receivers(stored), Antenna(*map(str, stored["tx_antenna"]))
            height, width = (int(size) for size in stored["size"])
            corners = (stored["triangles_m"][a:b] for a, b in pairwise(np.cumsum([0, *stored["thing_faces"]])))
            model = SpectrumModel(
                Spectrometer(receiver, float(stored["frequency_hz"]), height, width, tx_antenna),
                Room(tuple(map(str, stored["thing_names"])), tuple(corners), stored["given_slabs"]),
                int(stored["learned"]),
                stored["chain"],
                int(stored["passed"]),
                Constants(stored["offset_m"], stored["slabs"]),
                from_field_arrays(Maps, stored, "map_") if "map_chain" in stored else None,
                from_field_arrays(ResidualKriging, stored, "rest_") if "rest_image" in stored else None,
                stored.get("error"),
            )
            models.append(model)
        return cls(tuple(models), {key: value.tolist() for key, value in under("fact/", arrays).items()})

    def summary(self) -> dict[str, Any]:
        """Chains, surfaces, amplitudes, displacements, and losses on validation rows after each step."""
        return dict(self.fit_facts)


def fit_spectrum(
    record: Record,
    rows: IntArray,
    scene: Any | None,
    settings: SpectrumSettings = DEFAULTS,
    seed: int = 0,
    on_progress: OnProgress = quiet,
) -> SpectrumPhysics:
    """Fit the physics model to ``rows`` of spectra; arguments as ``fit`` of `physics_model`.

    Fewer rows than `FEW_ROWS` fit planes, materials and the mix with kriging alone; without rows, or with rows at fewer
    than `LEAST_POSITIONS` positions, the room is traced as given.
    ``seed`` is that of validation rows and of the rays.

    Raises:
        InputError: a record of another task, or without array or carrier.
    """
    require(record, "spectrum", why="this physics model predicts spectra")
    if any(receiver.array_m is None for receiver in record.receivers) or record.frequencies_hz is None:
        raise InputError(f"{record.name}: array or carrier unknown; state array and frequency_hz in gateway_info.yml")
    rows = np.asarray(rows, np.int64)
    height, width = record.observation.shape[-2:]
    models: list[SpectrumModel] = []
    facts: dict[str, Any] = {}
    for index, receiver in enumerate(record.receivers):

        def report(
            stage: str, share: float, _: object = None, /, *, index: int = index, name: str = receiver.name
        ) -> None:
            on_progress(f"{name}: {stage}", (index + share) / len(record.receivers))

        instrument = Spectrometer(receiver, float(record.frequencies_hz[0]), height, width, record.tx_antenna)
        report("chains of planes", 0.0)
        model = begin(instrument, scene, settings, seed)
        usable = np.sort(rows[~np.isnan(record.observation[index, rows]).any(axis=(1, 2))])
        if len(usable):
            spectra = np.asarray(record.observation[index, usable], np.float32)
            order = np.random.default_rng([seed, 3]).permutation(len(usable))
            held = min(max(round(settings.validation * len(usable)), 20), len(usable) // 4)
            split, fit_rows = (order[held:], order[:held]), _fitted
            if len(usable) < FEW_ROWS:
                split, fit_rows = (np.arange(len(usable)), order[:0]), _fitted_to_few
            fit = Fit(instrument, record.tx_pos_m[usable], spectra, *split, settings)
            model, found = fit_rows(fit, model, seed, report)
            facts |= keyed(f"{receiver.name}.", found)
        models.append(model)
    return SpectrumPhysics(tuple(models), facts)


MODEL = physics_model("spectrum", SpectrumSettings, fit_spectrum, SpectrumPhysics.from_arrays, gaps=("map_centre_m",))


def _fitted(fit: Fit, model: SpectrumModel, seed: int, on_progress: OnProgress) -> tuple[SpectrumModel, dict[str, Any]]:
    """The model fitted to training rows, and facts."""
    settings = fit.settings
    everyone, truth = np.arange(len(fit.spectra)), fit.spectra[fit.validation]
    losses: dict[str, Any] = {"as given": fit.validation_loss(model)}

    def note(step: str, share: float) -> None:
        losses[step] = fit.validation_loss(model)
        on_progress(f"{step}: loss of validation rows {losses[step]:.4f}", share)

    model = fit.constants(model, fit.rows[:SEARCHED_ROWS], rounds=3)
    note("planes and materials", 0.2)
    for turn in range(settings.rounds if settings.surfaces else 0):
        before = model.learned
        model = fit.surfaces(model, seed)
        again = fit.constants(model, fit.rows[:SEARCHED_ROWS], rounds=0)
        model = min(model, again, key=fit.validation_loss)
        note(f"surfaces, round {turn + 1}", 0.2 + 0.5 * (turn + 1) / settings.rounds)
        if model.learned == before:
            break
    deviation, reflections = 0.0, -1
    if settings.amplitudes:
        model, deviation, reflections = fit.amplitudes(model)
        note("amplitudes", 0.85)
    field = fit.residual_field(model) if settings.rest else None
    predicted = fit.with_residual(model, fit.rows, field).spectra(fit.tx_pos_m[fit.validation])
    error = np.sqrt(np.square(predicted - truth).mean(axis=0)).astype(np.float32)
    if deviation:
        model = fit.mapped(model.replaced(maps=None), everyone, deviation, reflections)
    model = fit.with_residual(model, everyone, field)
    facts = {
        "chains": len(model.chain) + 1,
        "surfaces": model.learned,
        "gaussians": 0 if model.maps is None else len(model.maps.chain),
        "amplitude_deviation": deviation,
        "amplitude_reflections": reflections,
        "rest_length_m": 0.0 if model.residual is None else model.residual.length_m,
        "traced_share": 1.0 if model.residual is None else model.residual.share,
        "plane_offsets_m": [round(float(x), 4) for x in model.constants.offset_m],
        **{f"loss {step}": round(value, 5) for step, value in losses.items()},
    }
    return model.replaced(error=error), facts


def _fitted_to_few(
    fit: Fit, model: SpectrumModel, seed: int, on_progress: OnProgress
) -> tuple[SpectrumModel, dict[str, Any]]:
    """The candidate that predicts held-out rows best, and facts: the choice and the error of each candidate."""
    name, tx_pos_m, spectra = model.instrument.receiver.name, fit.tx_pos_m, fit.spectra
    group = groups(tx_pos_m, model.instrument.wavelength_m, seed)
    if not len(group):
        text = "%s: %d training rows at fewer than %d places cannot tell what to fit: the room is traced as given"
        logger.warning(text, name, len(tx_pos_m), LEAST_POSITIONS)
        return model, {"chosen": AS_GIVEN}
    predicted: dict[str, NDArray[np.float32]] = {}
    for number in range(GROUPS):
        on_progress("held-out rows", number / (GROUPS + 1))
        train, out = np.flatnonzero(group != number), np.flatnonzero(group == number)
        for label, trial in _trials(fit, model, train) if len(out) else ():
            predicted.setdefault(label, np.empty_like(spectra))[out] = trial.spectra(tx_pos_m[out])
    square = {label: np.square(images - spectra) for label, images in predicted.items()}
    # Structural similarity falls nearly linearly with the logarithm, and no row that is hard to predict dominates.
    score = {label: float(np.log(each.mean(axis=(1, 2)) + LEAST_ERROR).mean()) for label, each in square.items()}
    chosen = min(score, key=lambda label: score[label])
    on_progress("all rows", GROUPS / (GROUPS + 1))
    best = dict(_trials(fit, model, fit.rows))[chosen]
    facts: dict[str, Any] = {"chosen": chosen}
    facts |= {f"held-out error, {label}": round(float(np.sqrt(each.mean())), 4) for label, each in square.items()}
    facts["plane_offsets_m"] = [round(float(x), 4) for x in best.constants.offset_m]
    logger.info("%s: %d training rows: %s, chosen by rows held out", name, len(tx_pos_m), chosen)
    return best.replaced(error=np.sqrt(square[chosen].mean(axis=0)).astype(np.float32)), facts


def groups(position_m: FloatArray, wavelength_m: float, seed: int) -> IntArray:
    """Group of each row [n], 0 to `GROUPS` - 1, rows at one position in one group; empty below `LEAST_POSITIONS`."""
    if len(position_m) < LEAST_POSITIONS:
        return np.zeros(0, np.int64)
    label = fclusterdata(position_m, ONE_POSITION * wavelength_m, "distance", method="single") - 1
    count = int(label.max()) + 1
    if count < LEAST_POSITIONS:
        return np.zeros(0, np.int64)
    return np.asarray(np.random.default_rng([seed, 4]).permutation(count)[label] % GROUPS)


def _trials(fit: Fit, model: SpectrumModel, rows: IntArray) -> Iterator[tuple[str, SpectrumModel]]:
    """Candidates fitted to some rows, by name."""
    yield AS_GIVEN, model
    room = fit.constants(model, rows, SCANS)
    yield "room with fitted planes and materials", room
    for name, field in MIXES.items() if fit.settings.rest else ():
        yield name, fit.with_residual(room, rows, field)
