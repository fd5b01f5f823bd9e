"""The physics model for spatial spectra: a traced room of which the rest is learned.

Element signals are a coherent sum of specular paths: those of the given mesh, with displaced planes and fitted
materials (`wrf_mi.models.physics.spectrum_fit`); those of surfaces that the mesh lacks
(`wrf_mi.models.physics.spectrum_search`), which also hide what is behind them; each times a learned complex amplitude
that varies slowly with the transmitter's image. All phases come from path lengths, so what is learned holds between
and beyond the training rows. What is left of spectra near a transmitter is added as kriging would, or kriging of the
spectra takes the room's place (`wrf_mi.models.physics.spectrum_residual`). Every step has to lower the loss of
validation rows, which are taken from the training rows; the last fit uses all of these. Few rows are fitted by
`wrf_mi.models.physics.spectrum_few`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields
from itertools import pairwise
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import Antenna, InputError, Prediction, Receiver, Record, receiver_arrays, stored_receivers
from ...core.angles import FloatArray
from ...core.receivers import receiver_index
from ...core.types import IntArray
from ...tasks import require
from .spectrum_few import FEW_ROWS, fitted_to_few
from .spectrum_fit import Constants, Maps
from .spectrum_gains import Slabs
from .spectrum_model import SEARCHED_ROWS, Chaining, Fit, Room, Spectrometer, SpectrumModel, begin
from .spectrum_rays import Things
from .spectrum_residual import Rest

Arrays = dict[str, NDArray[Any]]
FORMAT = 2
"""Version of `SpectrumPhysics.arrays`."""
CHUNK_SIZE = 256
"""Transmitters that are predicted together: more are no faster each, and all would take three times their spectra."""


@dataclass(frozen=True)
class SpectrumSettings:
    """Settings of the physics model for spectra.

    Attributes:
        reflections: of a path by the mesh at most.
        passed: surfaces that a path may pass through at most.
        rays: that search for chains of planes.
        chains: of planes at most, those of fewest reflections.
        offset_sd_m: how far the mesh's planes may be off, standard deviation in metres.
        surfaces: that are sought beside the mesh at most in a round; 0: none.
        surface_gain: by how much the logarithm of the likelihood has to grow for one.
        rounds: of surfaces, planes and materials.
        amplitudes: learn how strong each chain is, and how that varies with the place.
        scale_m: distance over which that varies, metres.
        rest: mix predictions of the room with kriging of the training rows.
        steps: of an optimiser.
        validation: share of the training rows that choose.
    """

    reflections: int = 2
    passed: int = 1
    rays: int = 1 << 16
    chains: int = 4000
    offset_sd_m: float = 0.03
    surfaces: int = 16
    surface_gain: float = 30.0
    rounds: int = 2
    amplitudes: bool = True
    scale_m: float = 1.0
    rest: bool = True
    steps: int = 15
    validation: float = 0.15

    def __post_init__(self) -> None:
        """Reject what no fit can use.

        Raises:
            InputError: naming the setting.
        """
        for name in ("reflections", "passed", "surfaces", "rounds", "steps", "chains", "rays"):
            if getattr(self, name) < 0:
                raise InputError(f"setting {name}: {getattr(self, name)}; choose 0 or more")
        for name in ("offset_sd_m", "scale_m", "surface_gain"):
            if not getattr(self, name) > 0:
                raise InputError(f"setting {name}: {getattr(self, name)}; choose more than 0")
        if not 0 < self.validation < 1:
            raise InputError(f"setting validation: {self.validation}; choose more than 0 and less than 1")


class SpectrumPhysics:
    """Predicts spectra at any position of a transmitter.

    Args:
        models: one for each receiver.
        facts: what was fitted, plain numbers, for `summary`.
    """

    task = "spectrum"
    uses_heading = False

    def __init__(self, models: tuple[SpectrumModel, ...], facts: Mapping[str, Any]) -> None:
        self.models, self._facts = models, dict(facts)

    @property
    def receivers(self) -> tuple[Receiver, ...]:
        """That report."""
        return tuple(model.instrument.receiver for model in self.models)

    def predict(self, tx_pos_m: ArrayLike, receiver: int | str, tx_heading_rad: ArrayLike | None = None) -> Prediction:
        """Spectra of transmitters [m, 3] (metres) at one receiver, grey in 0..1: [m, height, width].

        The receiver is given by its name, or by its number from 0.
        The antenna is isotropic, so a heading changes nothing. The deviation of a pixel is that of validation rows;
        where nothing was fitted, that of the predicted spectrum itself; an array of it is read-only.

        Raises:
            InputError: positions of another shape or not finite, or no such receiver.
        """
        positions = np.asarray(tx_pos_m, float)
        if positions.ndim != 2 or positions.shape[1] != 3 or not np.isfinite(positions).all():
            raise InputError(f"transmitters: shape {positions.shape}; give finite positions [m, 3] in metres")
        model = self.models[receiver_index(self.receivers, receiver)]
        one = model.instrument
        mean = np.empty((len(positions), one.height, one.width), np.float32)
        # The same for all transmitters, or for all pixels of one: held once, not for each.
        error = np.empty((len(positions), 1, 1)) if model.error is None else model.error.astype(float)
        for first in range(0, len(positions), CHUNK_SIZE):
            own = slice(first, first + CHUNK_SIZE)
            mean[own] = model.spectra(positions[own])
            if model.error is None:
                error[own] = mean[own].std(axis=(1, 2), keepdims=True)
        return Prediction(mean, np.broadcast_to(error, mean.shape))

    def arrays(self) -> Arrays:
        """All that is needed to predict again, see `from_arrays`; the mesh's triangles are among it."""
        out: Arrays = {"format": np.array(FORMAT), "receivers": np.array(len(self.models))}
        for key, value in self._facts.items():
            out[f"fact/{key}"] = np.asarray(value)
        for index, model in enumerate(self.models):
            one, parts = model.instrument, model.room.things.corners
            slabs, given, maps = model.constants.slabs, model.room.slabs, model.maps
            own: Arrays = {
                **receiver_arrays([one.receiver]),
                "tx_antenna": np.array(astuple(one.tx_antenna)),
                "frequency_hz": np.array(one.frequency_hz),
                "size": np.array([one.height, one.width]),
                "thing_names": np.array(model.room.things.names, dtype=str),
                "thing_faces": np.array([len(part) for part in parts], np.int64),
                "triangles_m": np.concatenate([np.zeros((0, 3, 3)), *parts]),
                "chain": model.chain,
                "passed": np.array(model.passed),
                "offset_m": model.constants.offset_m,
                "slabs": np.stack([slabs.permittivity, slabs.conductivity, slabs.thickness_m]),
                "given_slabs": np.stack([given.permittivity, given.conductivity, given.thickness_m]),
                "learned": np.array(model.learned),
            }
            if maps is not None:
                own |= {"map_chain": maps.chain, "map_centre_m": maps.centre_m, "map_weight": maps.weight}
                own["map_scale_m"] = np.array(maps.scale_m)
            if model.rest is not None:
                rest = model.rest
                own |= {f"rest_{one.name}": np.asarray(getattr(rest, one.name)) for one in fields(Rest)}
            if model.error is not None:
                own["error"] = model.error
            out |= {f"{index}/{key}": value for key, value in own.items()}
        return out

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], scene: Any | None = None) -> Self:
        """The physics model of what `arrays` gave; ``scene`` is not needed.

        Raises:
            InputError: arrays of another version.
        """
        if int(arrays.get("format", np.array(-1))) != FORMAT:
            raise InputError(f"physics for spectra: format {arrays.get('format')}, not {FORMAT}; fit it again")
        models = []
        for index in range(int(arrays["receivers"])):
            own = {key.partition("/")[2]: value for key, value in arrays.items() if key.startswith(f"{index}/")}
            (receiver,), tx_antenna = stored_receivers(own), Antenna(*map(str, own["tx_antenna"]))
            height, width = (int(size) for size in own["size"])
            instrument = Spectrometer(receiver, float(own["frequency_hz"]), height, width, tx_antenna)
            edges = np.cumsum([0, *own["thing_faces"]])
            parts = tuple(own["triangles_m"][a:b] for a, b in pairwise(edges))
            room = Room(Things(tuple(str(name) for name in own["thing_names"]), parts), Slabs(*own["given_slabs"]))
            maps = None
            if "map_chain" in own:
                maps = Maps(own["map_chain"], own["map_centre_m"], float(own["map_scale_m"]), own["map_weight"])
            rest = None
            if "rest_image" in own:
                place_m, length_m, weight, image, mean, share = (own[f"rest_{one.name}"] for one in fields(Rest))
                rest = Rest(place_m, float(length_m), weight, image, mean, float(share))
            constants = Constants(own["offset_m"], Slabs(*own["slabs"]))
            models.append(
                SpectrumModel(
                    instrument,
                    room,
                    int(own["learned"]),
                    own["chain"],
                    int(own["passed"]),
                    constants,
                    maps,
                    rest,
                    own.get("error"),
                )
            )
        facts = {key.partition("/")[2]: value.tolist() for key, value in arrays.items() if key.startswith("fact/")}
        return cls(tuple(models), facts)

    def summary(self) -> dict[str, Any]:
        """What was fitted: chains, surfaces, amplitudes, displacements, losses on validation rows after each step."""
        return dict(self._facts)


def fit_spectrum(
    record: Record,
    rows: IntArray,
    scene: Any | None,
    settings: SpectrumSettings = SpectrumSettings(),
    seed: int = 0,
    on_progress: Callable[[str, float], None] = lambda what, share: None,
) -> SpectrumPhysics:
    """Fit the physics model to spectra.

    Args:
        record: of spectra, with array and carrier.
        rows: that train. Fewer than `wrf_mi.models.physics.spectrum_few.FEW_ROWS` fit planes, materials and the mix
            with kriging alone; without rows, or with rows at fewer than
            `wrf_mi.models.physics.spectrum_few.LEAST_PLACES` places, the room is traced as given.
        scene: opened ``sionna.rt.Scene`` at the carrier, or None: free space and learned surfaces.
        settings: see there.
        seed: of validation rows and of the rays.
        on_progress: hears what is done, and the share of all that is done, 0..1.

    Raises:
        InputError: a record of another task, or without array or carrier.
    """
    require(record, "spectrum", why="this physics model predicts spectra")
    if any(one.array_m is None for one in record.receivers) or record.frequencies_hz is None:
        raise InputError(f"{record.name}: array or carrier unknown; state array and frequency_hz in gateway_info.yml")
    rows = np.asarray(rows, np.int64)
    height, width = record.observation.shape[-2:]
    models: list[SpectrumModel] = []
    facts: dict[str, Any] = {}
    for index, receiver in enumerate(record.receivers):

        def heard(what: str, share: float, index: int = index, name: str = receiver.name) -> None:
            on_progress(f"{name}: {what}", (index + share) / len(record.receivers))

        carrier_hz, tx_antenna = float(record.frequencies_hz[0]), record.tx_antenna
        instrument = Spectrometer(receiver, carrier_hz, height, width, tx_antenna)
        heard("chains of planes", 0.0)
        how = Chaining(settings.reflections, settings.passed, settings.rays, settings.chains, seed)
        model = begin(instrument, scene, how)
        usable = rows[~np.isnan(record.observation[index, rows]).any(axis=(1, 2))]
        if len(usable):
            spectra = np.asarray(record.observation[index], np.float32)
            if len(usable) < FEW_ROWS:
                limits = settings.offset_sd_m, settings.steps, settings.rest, seed
                model, own = fitted_to_few(model, record.tx_pos_m, spectra, usable, *limits, heard)
            else:
                model, own = _fitted(model, record.tx_pos_m, spectra, usable, settings, how, heard)
            facts |= {f"{receiver.name}.{key}": value for key, value in own.items()}
        models.append(model)
    return SpectrumPhysics(tuple(models), facts)


def _fitted(
    model: SpectrumModel,
    tx_pos_m: FloatArray,
    spectra: NDArray[np.float32],
    rows: IntArray,
    settings: SpectrumSettings,
    how: Chaining,
    on_progress: Callable[[str, float], None],
) -> tuple[SpectrumModel, dict[str, Any]]:
    order = np.random.default_rng([how.seed, 3]).permutation(np.sort(rows))
    held = min(max(round(settings.validation * len(rows)), 20), len(rows) // 4)
    validation, train = order[:held], order[held:]
    known = np.sort(rows)
    place = np.full(len(tx_pos_m), -1)
    place[known] = np.arange(len(known))
    fit = Fit(
        model, tx_pos_m[known], spectra[known], place[train], place[validation], settings.offset_sd_m, settings.steps
    )
    losses: dict[str, Any] = {"as given": float(fit.losses(model, fit.validation).mean())}

    def note(what: str, share: float) -> None:
        losses[what] = float(fit.losses(model, fit.validation).mean())
        on_progress(f"{what}: loss of validation rows {losses[what]:.4f}", share)

    model = fit.constants(model, fit.rows[:SEARCHED_ROWS], rounds=3)
    note("planes and materials", 0.2)
    for turn in range(settings.rounds if settings.surfaces else 0):
        before = model.learned
        model = fit.surfaces(model, settings.surfaces, settings.surface_gain, how)
        again = fit.constants(model, fit.rows[:SEARCHED_ROWS], rounds=0)
        if fit.losses(again, fit.validation).mean() < fit.losses(model, fit.validation).mean():
            model = again
        note(f"surfaces, round {turn + 1}", 0.2 + 0.5 * (turn + 1) / settings.rounds)
        if model.learned == before:
            break
    deviation, reflections = 0.0, -1
    if settings.amplitudes:
        model, deviation, reflections = fit.amplitudes(model, settings.scale_m)
        note("amplitudes", 0.85)
    kind = fit.rest_kind(model) if settings.rest else None
    predicted = fit.with_rest(model, fit.rows, kind).spectra(tx_pos_m[validation])
    error = np.sqrt(np.square(predicted - spectra[validation]).mean(axis=0)).astype(np.float32)
    everyone = np.arange(len(known))
    if deviation:
        model = fit.mapped(model.replaced(maps=None), everyone, settings.scale_m, deviation, reflections)
    model = fit.with_rest(model, everyone, kind)
    facts = {
        "chains": len(model.chain) + 1,
        "surfaces": model.learned,
        "gaussians": 0 if model.maps is None else len(model.maps.chain),
        "amplitude_deviation": deviation,
        "amplitude_reflections": reflections,
        "rest_length_m": 0.0 if model.rest is None else model.rest.length_m,
        "traced_share": 1.0 if model.rest is None else model.rest.share,
        "plane_offsets_m": [round(float(x), 4) for x in model.constants.offset_m],
        **{f"loss {what}": round(value, 5) for what, value in losses.items()},
    }
    return model.replaced(error=error), facts
