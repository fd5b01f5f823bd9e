"""One receiver's part of `wrf_mi.models.physics.spectrum`: a traced room with learned mirrors and amplitudes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.constants import speed_of_light

from ...core import Antenna, Receiver
from ...core.angles import FloatArray
from ...core.antenna import ANTENNA
from ...core.types import IntArray
from ...receivers.array import bartlett_spectrum, minmax_scale
from ...tracing.material_parameters import read_materials
from .spectrum_fit import Constants, Maps, Waves, fit_constants, fit_maps, map_places, scan_offsets
from .spectrum_gains import Antennas, Slabs
from .spectrum_loss import Grid
from .spectrum_rays import ChainTable, Met, Things, find_chains, opened
from .spectrum_residual import MIXES, RESIDUALS, Rest, RestKind
from .spectrum_search import Search
from .spectrum_sheets import KINDS, Frame, Known, Sheet, frames_of

ComplexArray = NDArray[np.complex128]
Arrays = dict[str, NDArray[Any]]

SEARCHED_ROWS = 300
"""Rows with which the first values of the constants are sought: a few dozen numbers."""
DEVIATIONS = (0.1, 0.2, 0.4)
"""Standard deviations of the amplitudes' Gaussians that validation rows choose from, beside none at all."""


@dataclass(frozen=True)
class Spectrometer:
    """What reports spectra at one place.

    Attributes:
        receiver: its pose and array.
        frequency_hz: of the carrier.
        height: of a spectrum.
        width: of a spectrum.
        tx_antenna: antenna of the transmitters.
    """

    receiver: Receiver
    frequency_hz: float
    height: int
    width: int
    tx_antenna: Antenna = ANTENNA

    @property
    def array_m(self) -> FloatArray:
        """Elements [m, 3], receiver's frame, metres."""
        assert self.receiver.array_m is not None, "see `wrf_mi.models.physics.spectrum.fit_spectrum`"
        return self.receiver.array_m

    @property
    def antennas(self) -> Antennas:
        """Antennas of the transmitters and of the elements."""
        receiver = self.receiver
        return self.tx_antenna.mounted(), receiver.antenna.mounted(receiver.orientation_xyzw)

    @property
    def elements_m(self) -> FloatArray:
        """Elements less the origin, world frame [m, 3]."""
        return np.asarray(self.array_m @ self.receiver.to_world.T)

    @cached_property
    def grid(self) -> Grid:
        """Directions on which fits compare."""
        return Grid.of(self.height, self.width, self.array_m, self.frequency_hz)

    def report(self, signals: ComplexArray) -> NDArray[np.float32]:
        """Spectra of element signals [n, m] as the instrument scales them, [n, height, width]."""
        images = np.empty((len(signals), self.height, self.width), np.float32)
        for row, signal in enumerate(signals):
            image = bartlett_spectrum(signal, self.array_m, self.frequency_hz, self.height, self.width)
            images[row] = minmax_scale(image)
        return images


@dataclass(frozen=True)
class Room:
    """What is given of a room: objects of triangles and their materials. Without objects: free space."""

    things: Things
    slabs: Slabs

    @classmethod
    def of(cls, scene: Any | None) -> Room:
        """Triangles and materials of a ``sionna.rt.Scene``; None: free space."""
        if scene is None:
            return cls(Things((), ()), Slabs(*np.zeros((3, 0))))
        from ...tracing.surfaces import scene_surfaces

        surfaces, known = scene_surfaces(scene), read_materials(scene)
        edges = surfaces.first_face
        parts = tuple(surfaces.triangles[a:b] for a, b in pairwise(edges))
        index = [known.names.index(scene.objects[name].radio_material.name) for name in surfaces.names]
        slabs = Slabs(known.permittivity[index], known.conductivity[index], known.thickness_m[index])
        return cls(Things(surfaces.names, parts), slabs)


@dataclass(frozen=True)
class Chaining:
    """How chains of planes are sought: see `wrf_mi.models.physics.spectrum_rays.find_chains`."""

    reflections: int
    passed: int
    rays: int
    most: int
    seed: int


@dataclass(frozen=True)
class SpectrumModel:
    """A fitted room at one receiver.

    Attributes:
        instrument: that reports.
        room: its objects, the learned ones last, and their materials as given.
        learned: how many of the objects are learned.
        chain: of planes, [c, reflections].
        passed: surfaces that a path may pass through at most.
        constants: fitted.
        maps: learned amplitudes, or None.
        rest: kriging that predictions of the room are mixed with, or None.
        error: root mean square of what predictions missed on rows that the choice was made on [height, width], or None.
    """

    instrument: Spectrometer
    room: Room
    learned: int
    chain: IntArray
    passed: int
    constants: Constants
    maps: Maps | None
    rest: Rest | None
    error: NDArray[np.float32] | None

    @cached_property
    def opened(self) -> Any:
        """The room in Mitsuba, or None for free space."""
        return opened(self.room.things) if self.room.things.names else None

    @cached_property
    def table(self) -> ChainTable:
        """Its chains, ready for transmitters."""
        return ChainTable(self.opened, self.instrument.receiver.position_m, self.chain, self.passed)

    def waves(self, tx_pos_m: FloatArray) -> Waves:
        """Waves of transmitters [n, 3]."""
        one = self.instrument
        return Waves(self.table, tx_pos_m, one.elements_m, one.antennas, one.frequency_hz)

    def factor(self, met: Met) -> ComplexArray:
        """Amplitude of each path beside its gain, [p]."""
        return np.ones(len(met), complex) if self.maps is None else self.maps.amplitude(met)

    def signals(self, waves: Waves) -> ComplexArray:
        """Element signals [n, m]."""
        gain = waves.gain(self.constants) * self.factor(waves.met)
        out: ComplexArray = waves.sum @ (gain[:, None] * waves.steering(self.constants.offset_m))
        return out

    def spectra(self, tx_pos_m: FloatArray) -> NDArray[np.float32]:
        """What the instrument is predicted to report of transmitters [n, 3], 0..1, [n, height, width]."""
        images = self.instrument.report(self.signals(self.waves(tx_pos_m)))
        return images if self.rest is None else self.rest(tx_pos_m, images)

    def frames(self, tx_pos_m: FloatArray) -> list[Frame]:
        """Families of planes to look for further surfaces in."""
        surfaces = self.table.surfaces
        if surfaces is None:
            points = np.concatenate([tx_pos_m, self.instrument.receiver.position_m[None]])
            # Without walls: as far as a metre beyond what is known to be inside.
            points = np.stack([points.min(axis=0) - 1.0, points.max(axis=0) + 1.0])
            return frames_of(np.zeros((0, 3)), np.zeros(0), points)
        corners = surfaces.triangles
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        areas = np.bincount(surfaces.plane, area, len(surfaces.normal)).astype(float)
        return frames_of(surfaces.normal, areas, corners.reshape(-1, 3))

    def with_sheets(
        self, sheets: list[Sheet], frames: list[Frame], how: Chaining, alone: bool = False
    ) -> SpectrumModel:
        """The same with further surfaces and the chains that they make, without learned amplitudes.

        Args:
            sheets: to add.
            frames: of these.
            how: chains are sought.
            alone: learned surfaces reflect only what no other surface does; they hide in any case.
        """
        things = self.room.things.with_sheets(np.stack([sheet.corners(frames) for sheet in sheets]))
        kinds = np.array([KINDS[sheet.kind] for sheet in sheets]).T

        def more(slabs: Slabs) -> Slabs:
            columns = (slabs.permittivity, slabs.conductivity, slabs.thickness_m)
            return Slabs(*(np.concatenate(pair) for pair in zip(columns, kinds, strict=True)))

        room, both = opened(things), Room(things, more(self.room.slabs))
        chain = find_chains(
            room, self.instrument.receiver.position_m, how.reflections, how.passed, how.rays, how.seed, how.most
        )
        if alone:
            faces, learned = room[1].first_face, len(things.names) - self.learned - len(sheets)
            own = np.append(np.searchsorted(faces, room[1].face, side="right") > learned, False)
            chain = chain[~own[chain].any(axis=1) | (np.count_nonzero(chain >= 0, axis=1) == 1)]
        # Planes are numbered anew: each keeps the displacement of the object that it belongs to.
        offset, old, new = np.zeros(len(room[1].normal)), self.table.surfaces, room[1]
        if old is not None:
            faces = old.first_face[:-1]
            offset[new.plane[faces]] = self.constants.offset_m[old.plane[faces]]
        constants = Constants(offset, more(self.constants.slabs))
        other = replace(
            self, room=both, learned=self.learned + len(sheets), chain=chain, constants=constants, maps=None
        )
        other.__dict__["opened"] = room
        return other

    def replaced(self, **changes: Any) -> SpectrumModel:
        """`dataclasses.replace` that keeps what is opened already."""
        other = replace(self, **changes)
        for name, needs in (("opened", {"room"}), ("table", {"room", "chain", "passed"})):
            if name in self.__dict__ and not needs & set(changes):
                other.__dict__[name] = self.__dict__[name]
        return other


class Fit:
    """Fits a `SpectrumModel` to some rows.

    Args:
        model: of which the instrument is used.
        tx_pos_m: all rows that may be used [n, 3].
        spectra: of them [n, height, width].
        rows: that train, of these.
        validation: that choose.
        offset_sd_m: standard deviation of the planes' displacements.
        steps: of L-BFGS for constants; for amplitudes four times as many.
    """

    def __init__(
        self,
        model: SpectrumModel,
        tx_pos_m: FloatArray,
        spectra: NDArray[np.float32],
        rows: IntArray,
        validation: IntArray,
        offset_sd_m: float,
        steps: int,
    ) -> None:
        self._tx, self.rows, self.validation, self._spectra = tx_pos_m, rows, validation, spectra
        self.shapes = model.instrument.grid.shapes(spectra)
        self._sd, self._steps = offset_sd_m, steps

    def losses(self, model: SpectrumModel, rows: IntArray, waves: Waves | None = None) -> FloatArray:
        """Loss of each of some rows."""
        signals = model.signals(waves or model.waves(self._tx[rows]))
        return model.instrument.grid.loss(signals, self.shapes[rows])[0]

    def constants(self, model: SpectrumModel, rows: IntArray, rounds: int) -> SpectrumModel:
        """Planes and materials; with ``rounds`` the planes are scanned for other minima so many times."""
        if not len(model.constants.vector()) or not len(rows):
            return model
        grid, waves = model.instrument.grid, model.waves(self._tx[rows])
        factor = model.factor(waves.met)
        prior = Constants(np.zeros(len(model.constants.offset_m)), model.room.slabs)
        for turn in range(max(rounds, 1)):
            start = model.constants
            if turn < rounds:
                start = scan_offsets(waves, self.shapes[rows], grid, start, self._sd, factor)
            found = fit_constants(waves, self.shapes[rows], grid, start, prior, self._sd, self._steps, factor)
            model = model.replaced(constants=found)
        return model

    def surfaces(self, model: SpectrumModel, most: int, least_gain: float, how: Chaining) -> SpectrumModel:
        """Further surfaces, as far as they lower the validation rows' loss."""
        frames = model.frames(self._tx[self.rows])
        search, signals = self._search(model, frames, self.rows)
        found = search(signals, most, least_gain)
        # One after the other on rows that did not choose them, by what they change at first order.
        judge, seen = self._search(model, frames, self.validation)
        shapes, kept = self.shapes[self.validation], []
        before = model.instrument.grid.loss(seen, shapes)[0]
        for sheet in found:
            row, added = judge.change(sheet)
            after = model.instrument.grid.loss(seen[row] + added, shapes[row])[0]
            if after.sum() < before[row].sum():
                seen[row] += added
                before[row] = after
                kept.append(sheet)
        best, lowest = model, self.losses(model, self.validation).mean()
        for count in sorted({len(kept), (len(kept) + 1) // 2} - {0}, reverse=True):
            for alone in (False, True):
                trial = model.with_sheets(kept[:count], frames, how, alone)
                loss = self.losses(trial, self.validation).mean()
                if loss < lowest:
                    best, lowest = trial, loss
        return best

    def _search(self, model: SpectrumModel, frames: list[Frame], rows: IntArray) -> tuple[Search, ComplexArray]:
        """A search with some rows, and what is explained of them."""
        one, tx = model.instrument, self._tx[rows]
        waves = model.waves(tx)
        known = Known.of(model.table, waves, model.constants, model.factor(waves.met), tx)
        search = Search(
            frames,
            tx,
            one.receiver.position_m,
            one.elements_m,
            one.antennas,
            one.frequency_hz,
            self.shapes[rows],
            one.grid,
            known,
        )
        return search, waves.sum @ known.wave

    def amplitudes(self, model: SpectrumModel, scale_m: float) -> tuple[SpectrumModel, float, int]:
        """Learned amplitudes if they lower the validation rows' loss for sure; their deviation and reflections.

        These rows have chosen the surfaces already, and ten choices are tried: a gain has to exceed its standard error.

        Returns:
            The model, the deviation (0: none) and up to how many reflections chains vary with the place (-1: none).
        """
        waves, held_out = model.waves(self._tx[self.rows]), model.waves(self._tx[self.validation])
        before = self.losses(model, self.validation, held_out)
        best, most, chosen = model, 0.0, (0.0, -1)
        for reflections in (-1, 0, 1):
            for deviation in DEVIATIONS:
                trial = self.mapped(model, self.rows, scale_m, deviation, reflections, waves)
                gain = before - self.losses(trial, self.validation, held_out)
                if gain.mean() > max(most, gain.std() / np.sqrt(len(gain))):
                    best, most, chosen = trial, gain.mean(), (deviation, reflections)
        return best, *chosen

    def mapped(
        self,
        model: SpectrumModel,
        rows: IntArray,
        scale_m: float,
        deviation: float,
        reflections: int,
        waves: Waves | None = None,
    ) -> SpectrumModel:
        """Learned amplitudes of chains, with the place for those of few reflections."""
        waves = waves or model.waves(self._tx[rows])
        maps = map_places(waves.met, model.table.length, scale_m, reflections)
        found = fit_maps(
            waves,
            self.shapes[rows],
            model.instrument.grid,
            model.constants,
            maps,
            deviation,
            4 * self._steps,
        )
        return model.replaced(maps=found)

    def rest_kind(self, model: SpectrumModel) -> RestKind | None:
        """The rest with which validation rows are predicted best; None: none helps."""
        truth, place = self._spectra[self.validation], self._tx[self.validation]
        before = np.square(model.spectra(place) - truth).mean(axis=(1, 2))
        most, best = 0.0, None
        for kind in (*RESIDUALS, *MIXES.values()):
            gain = before - np.square(self.with_rest(model, self.rows, kind).spectra(place) - truth).mean(axis=(1, 2))
            if gain.mean() > max(most, gain.std() / np.sqrt(len(gain))):
                most, best = float(gain.mean()), kind
        return best

    def with_rest(self, model: SpectrumModel, rows: IntArray, kind: RestKind | None) -> SpectrumModel:
        """The model with the rest of some rows; as it is without a kind."""
        if kind is None:
            return model
        wavelength_m = speed_of_light / model.instrument.frequency_hz
        place = self._tx[rows]
        return model.replaced(rest=Rest.of(place, self._spectra[rows], model.spectra(place), kind, wavelength_m))


def begin(instrument: Spectrometer, scene: Any | None, how: Chaining) -> SpectrumModel:
    """The room as given, with the chains of planes that the receiver sees."""
    room = Room.of(scene)
    none = np.full((0, max(how.reflections, 1)), -1)
    model = SpectrumModel(instrument, room, 0, none, how.passed, Constants(np.zeros(0), room.slabs), None, None, None)
    if scene is None:
        return model
    chain = find_chains(
        model.opened, instrument.receiver.position_m, how.reflections, how.passed, how.rays, how.seed, how.most
    )
    planes = len(model.opened[1].normal)
    return model.replaced(chain=chain, constants=Constants(np.zeros(planes), room.slabs))
