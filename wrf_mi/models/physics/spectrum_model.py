"""Spectra of one receiver: a traced room with learned mirrors and amplitudes, and its fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.angles import FloatArray
from ...core.settings import CheckedSettings, Inside, Positive
from ...core.types import IntArray
from ...tracing.search import shoot
from ...tracing.surfaces import Surfaces
from ...tracing.walls import plane_centres
from .spectrum_fit import (
    MIXES,
    RESIDUALS,
    Constants,
    Maps,
    ResidualField,
    ResidualKriging,
    fit_constants,
    fit_maps,
    map_centres,
    scan_offsets,
)
from .spectrum_rays import ChainTable, Room
from .spectrum_search import KINDS, Frame, KnownPaths, Search, Sheet, frames_of
from .spectrum_waves import ComplexArray, Spectrometer, Waves

SEARCHED_ROWS = 300
"""Rows of the first fit of the constants, which are a few dozen numbers."""
DEVIATIONS = (0.1, 0.2, 0.4)
"""Prior standard deviations of the amplitudes' Gaussians among which validation rows choose."""


@dataclass(frozen=True)
class SpectrumSettings(CheckedSettings):
    """Settings of the physics model for spectra.

    Attributes:
        reflections: reflections of a path by the mesh at most.
        passed: surfaces that a path may pass through at most.
        rays: rays that search for chains of planes.
        chains: chains of planes at most, those of fewest reflections.
        offset_sd_m: standard deviation of the mesh's planes from their true offsets, metres.
        surfaces: further surfaces beside the mesh at most in a round; 0: none.
        surface_gain: least gain of a further surface in the logarithm of the likelihood.
        rounds: rounds of surfaces, planes and materials.
        amplitudes: learn the amplitude of each chain, and how it varies with the position.
        scale_m: distance over which amplitudes vary, metres.
        rest: mix predictions of the room with kriging of the training rows.
        steps: steps of an optimiser.
        validation: share of the training rows that choose.
    """

    reflections: int = 2
    passed: int = 1
    rays: int = 1 << 16
    chains: int = 4000
    offset_sd_m: Positive = 0.03
    surfaces: int = 16
    surface_gain: Positive = 30.0
    rounds: int = 2
    amplitudes: bool = True
    scale_m: Positive = 1.0
    rest: bool = True
    steps: int = 15
    validation: Inside = 0.15


@dataclass(frozen=True)
class SpectrumModel:
    """A fitted room at one receiver.

    Attributes:
        instrument: array that reports the spectra.
        room: its objects, the learned ones last, and their materials as given.
        learned: number of learned objects.
        chain, passed: chains of planes [c, reflections], and surfaces that a path may pass through at most.
        constants: fitted displacements and materials.
        maps, residual: learned amplitudes and residual kriging, or None.
        error: root mean square error of predictions of validation rows [height, width], or None.
    """

    instrument: Spectrometer
    room: Room
    learned: int
    chain: IntArray
    passed: int
    constants: Constants
    maps: Maps | None = None
    residual: ResidualKriging | None = None
    error: NDArray[np.float32] | None = None

    @cached_property
    def opened(self) -> Any:
        """The room in Mitsuba with its planes, or None for free space."""
        return self.room.open()

    @cached_property
    def table(self) -> ChainTable:
        """Its chains, ready for transmitters."""
        return ChainTable(self.opened, self.instrument.receiver.position_m, self.chain, self.passed)

    def waves(self, tx_pos_m: FloatArray) -> Waves:
        """Waves of transmitters [n, 3]."""
        return Waves(self.table, tx_pos_m, self.instrument)

    def factor(self, waves: Waves) -> ComplexArray:
        """Learned amplitude of each path, [p]."""
        return np.ones(len(waves.paths), complex) if self.maps is None else self.maps.amplitude(waves.paths)

    def path_waves(self, waves: Waves) -> ComplexArray:
        """Wave of each path at the elements [p, m]."""
        gain = waves.gain(self.constants.slabs) * self.factor(waves)
        return np.asarray(gain[:, None] * waves.steering(self.constants.offset_m))

    def signals(self, waves: Waves) -> ComplexArray:
        """Element signals [n, m]."""
        return np.asarray(waves.sum @ self.path_waves(waves))

    def spectra(self, tx_pos_m: FloatArray) -> NDArray[np.float32]:
        """Predicted spectra of transmitters [n, 3], 0..1, [n, height, width]."""
        images = self.instrument.report(self.signals(self.waves(tx_pos_m)))
        return images if self.residual is None else self.residual(tx_pos_m, images)

    def frames(self, tx_pos_m: FloatArray) -> list[Frame]:
        """Families of planes in which further surfaces are sought."""
        surfaces = self.table.surfaces
        if surfaces is None:
            points = np.concatenate([tx_pos_m, self.instrument.receiver.position_m[None]])
            # Without walls: the axes of the coordinates, to a metre beyond transmitters and receiver.
            points = np.stack([points.min(axis=0) - 1.0, points.max(axis=0) + 1.0])
            return frames_of(np.eye(3), np.ones(3), points)
        return frames_of(surfaces.normal, plane_centres(surfaces)[1], surfaces.triangles.reshape(-1, 3))

    def with_sheets(
        self, sheets: list[Sheet], frames: list[Frame], settings: SpectrumSettings, seed: int, single: bool = False
    ) -> SpectrumModel:
        """The model with further surfaces and their chains, without learned amplitudes.

        If ``single``, learned surfaces reflect only in chains of one reflection; they hide in any case.
        """
        slabs = KINDS[:, [sheet.kind for sheet in sheets]]
        room = self.room.with_sheets(np.stack([sheet.corners(frames) for sheet in sheets]), slabs)
        opened = room.open()
        assert opened is not None
        new, old = opened[1], self.table.surfaces
        chain = find_chains(opened, self.instrument.receiver.position_m, settings, seed)
        learned = self.learned + len(sheets)
        if single:
            first = len(room.names) - learned
            of_learned = np.append(new.object_of(new.face) >= first, False)
            chain = chain[~of_learned[chain].any(axis=1) | (np.count_nonzero(chain >= 0, axis=1) == 1)]
        # Planes are numbered anew: each keeps the displacement of the object to which it belongs.
        offset = np.zeros(len(new.normal))
        if old is not None:
            faces = old.first_face[:-1]
            offset[new.plane[faces]] = self.constants.offset_m[old.plane[faces]]
        constants = Constants(offset, np.concatenate([self.constants.slabs, slabs], axis=1))
        model = replace(self, room=room, learned=learned, chain=chain, constants=constants, maps=None)
        model.__dict__["opened"] = opened
        return model

    def replaced(self, **changes: Any) -> SpectrumModel:
        """`dataclasses.replace` that keeps the opened room and its table where they stay valid."""
        model = replace(self, **changes)
        for name, needs in (("opened", {"room"}), ("table", {"room", "chain", "passed"})):
            if name in self.__dict__ and not needs & set(changes):
                model.__dict__[name] = self.__dict__[name]
        return model


@dataclass
class Fit:
    """Fits a `SpectrumModel` to rows [n, 3] with spectra [n, height, width].

    ``rows`` train and ``validation`` chooses among these; ``settings.steps`` are those of the constants, and amplitudes
    take four times as many.
    """

    instrument: Spectrometer
    tx_pos_m: FloatArray
    spectra: NDArray[np.float32]
    rows: IntArray
    validation: IntArray
    settings: SpectrumSettings

    def __post_init__(self) -> None:
        """Take the spectra's shapes on the grid."""
        self.shapes = self.instrument.grid.shapes(self.spectra)

    def losses(self, model: SpectrumModel, rows: IntArray, waves: Waves | None = None) -> FloatArray:
        """Loss of each of some rows."""
        signals = model.signals(waves or model.waves(self.tx_pos_m[rows]))
        return self.instrument.grid.loss(signals, self.shapes[rows])

    def validation_loss(self, model: SpectrumModel) -> float:
        """Mean loss of the validation rows."""
        return float(self.losses(model, self.validation).mean())

    def constants(self, model: SpectrumModel, rows: IntArray, rounds: int) -> SpectrumModel:
        """The model with fitted planes and materials, after ``rounds`` scans of the planes for other minima."""
        if not len(model.constants.vector()) or not len(rows):
            return model
        waves, shapes = model.waves(self.tx_pos_m[rows]), self.shapes[rows]
        factor = model.factor(waves)
        prior = Constants(np.zeros(len(model.constants.offset_m)), model.room.slabs)
        found, sd = model.constants, self.settings.offset_sd_m
        for turn in range(max(rounds, 1)):
            if turn < rounds:
                found = scan_offsets(waves, shapes, found, sd, factor)
            found = fit_constants(waves, shapes, found, prior, sd, self.settings.steps, factor)
        return model.replaced(constants=found)

    def surfaces(self, model: SpectrumModel, seed: int) -> SpectrumModel:
        """The model with further surfaces as far as they lower the validation rows' loss; see `Search`."""
        frames = model.frames(self.tx_pos_m[self.rows])
        search, signals = self._search(model, frames, self.rows)
        found = search(signals, self.settings.surfaces, self.settings.surface_gain)
        # Sheet by sheet on validation rows, by their change at first order.
        judge, signals = self._search(model, frames, self.validation)
        before, kept = judge.loss(signals), []
        for sheet in found:
            row, added = judge.change(sheet)
            after = judge.loss(signals[row] + added, row)
            if after.sum() < before[row].sum():
                signals[row] += added
                before[row] = after
                kept.append(sheet)
        best, lowest = model, self.validation_loss(model)
        for count in sorted({len(kept), (len(kept) + 1) // 2} - {0}, reverse=True):
            for single in (False, True):
                trial = model.with_sheets(kept[:count], frames, self.settings, seed, single)
                loss = self.validation_loss(trial)
                if loss < lowest:
                    best, lowest = trial, loss
        return best

    def _search(self, model: SpectrumModel, frames: list[Frame], rows: IntArray) -> tuple[Search, ComplexArray]:
        """A search with some rows, and their element signals."""
        tx = self.tx_pos_m[rows]
        waves = model.waves(tx)
        known = KnownPaths.of(model.table, waves.paths, model.path_waves(waves), tx)
        return Search(frames, self.instrument, tx, self.shapes[rows], known), waves.sum @ known.wave

    def amplitudes(self, model: SpectrumModel) -> tuple[SpectrumModel, float, int]:
        """Learned amplitudes if they lower the validation rows' loss significantly.

        These rows have chosen the surfaces already, and nine choices are tried: a gain must exceed its standard error.

        Returns:
            The model, the prior deviation (0: none) and up to how many reflections chains vary with the position.
        """
        waves, held_out = model.waves(self.tx_pos_m[self.rows]), model.waves(self.tx_pos_m[self.validation])
        before = self.losses(model, self.validation, held_out)
        best, most, chosen = model, 0.0, (0.0, -1)
        for reflections in (-1, 0, 1):
            for deviation in DEVIATIONS:
                trial = self.mapped(model, self.rows, deviation, reflections, waves)
                gain = before - self.losses(trial, self.validation, held_out)
                if gain.mean() > max(most, gain.std() / np.sqrt(len(gain))):
                    best, most, chosen = trial, gain.mean(), (deviation, reflections)
        return best, *chosen

    def mapped(
        self, model: SpectrumModel, rows: IntArray, deviation: float, reflections: int, waves: Waves | None = None
    ) -> SpectrumModel:
        """The model with amplitudes of its chains, which vary with the position up to so many reflections."""
        waves = waves or model.waves(self.tx_pos_m[rows])
        maps = map_centres(waves.paths, model.table.length, self.settings.scale_m, reflections)
        steps = 4 * self.settings.steps
        return model.replaced(maps=fit_maps(waves, self.shapes[rows], model.constants, maps, deviation, steps))

    def residual_field(self, model: SpectrumModel) -> ResidualField | None:
        """The field whose kriging predicts validation rows best; None: none helps."""
        truth, position = self.spectra[self.validation], self.tx_pos_m[self.validation]
        before = np.square(model.spectra(position) - truth).mean(axis=(1, 2))
        most, best = 0.0, None
        for field in (*RESIDUALS, *MIXES.values()):
            trial = self.with_residual(model, self.rows, field)
            gain = before - np.square(trial.spectra(position) - truth).mean(axis=(1, 2))
            if gain.mean() > max(most, gain.std() / np.sqrt(len(gain))):
                most, best = float(gain.mean()), field
        return best

    def with_residual(self, model: SpectrumModel, rows: IntArray, field: ResidualField | None) -> SpectrumModel:
        """The model with kriging of the residuals of some rows; unchanged without a field."""
        if field is None:
            return model
        position, spectra = self.tx_pos_m[rows], self.spectra[rows]
        wavelength_m = self.instrument.wavelength_m
        return model.replaced(
            residual=ResidualKriging.of(position, spectra, model.spectra(position), field, wavelength_m)
        )


def find_chains(
    opened_room: tuple[Any, Surfaces], receiver_m: FloatArray, settings: SpectrumSettings, seed: int
) -> IntArray:
    """Chains of planes seen from a receiver [3] in metres: shape [c, reflections], -1 beyond the last plane."""
    depth = settings.reflections + settings.passed
    found = shoot(*opened_room, receiver_m, settings.rays, depth, settings.reflections, seed)
    order = np.argsort(np.count_nonzero(found >= 0, axis=1), kind="stable")
    return found[order[: settings.chains]]


def begin(instrument: Spectrometer, scene: Any | None, settings: SpectrumSettings, seed: int) -> SpectrumModel:
    """The room as given, with the chains of planes that the receiver sees."""
    room = Room.of(scene)
    none = np.full((0, max(settings.reflections, 1)), -1)
    model = SpectrumModel(instrument, room, 0, none, settings.passed, Constants(np.zeros(0), room.slabs))
    if scene is None:
        return model
    chain = find_chains(model.opened, instrument.receiver.position_m, settings, seed)
    return model.replaced(chain=chain, constants=Constants(np.zeros(len(model.opened[1].normal)), room.slabs))
